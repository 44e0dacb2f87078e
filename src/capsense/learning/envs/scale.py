"""How changes of capacitance are scaled for policies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

UNIT = 10e-15
"""Changes of capacitance are given in this unit [F]."""
LIMIT = 100.0
"""Numbers are held within ± this."""
TARES = 16
"""Conversions of a channel that its zero is the mean of."""
NOISE = 0.1
"""Where :func:`compressed` turns from straight to logarithmic, 1 fF in the unit above: what one
conversion of the chips that the environments draw has as noise at most."""


def compressed(change: NDArray[np.floating]) -> NDArray[np.float64]:
    """Changes of capacitance within ±1: ``asinh(x / 0.1) / asinh(1000)``, x in 10 fF.

    Straight within the noise of a chip, and logarithmic above. So a policy gets a power law of
    the distance as a straight line, and noise as it is. The scale is fixed: nothing has to be
    saved with a policy, as running means would have to.

    Args:
        change: Changes in units of 10 fF, within ±100.
    """
    return np.arcsinh(np.asarray(change, float) / NOISE) / math.asinh(LIMIT / NOISE)
