"""Panels fine enough for the capacitances of an empty domain to meet a tolerance."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import RESOLUTIONS, Design
from capsense.errors import DesignError, FieldError
from capsense.field.background import Terminals, solve_empty
from capsense.field.boundary import POWER
from capsense.field.cache import default_settings

Array = NDArray[np.float64]

_STEP = 1.5
"""How much finer panels are from one solution to the next."""
_ORDER = 1.5
"""Errors of capacitances go with the size of panels to this power, about: charge at rims goes like
1/√distance."""
_SMALL = 0.01
"""Entries below this part of √(C_ii C_jj) are compared with that, not with themselves."""


class Refinement(NamedTuple):
    """The first panels that meet a tolerance, or the finest that were solved."""

    resolution: float
    """``[build] resolution`` of the design that gives these panels."""
    panels: int
    """How many there are."""
    capacitance: Array
    """Maxwell matrix of the n electrodes in the empty domain [F], shape (n, n)."""
    errors: Array
    """Estimated relative errors of its entries, shape (n, n); those of entries below 1 % of
    √(C_ii C_jj) are over that."""
    met: bool
    """Whether no estimated error is above the tolerance."""


def refine(
    design: Design, tolerance: float, progress: Callable[[str], None] = lambda _: None
) -> Refinement:
    """Refine panels until the capacitances of a design's empty domain meet a tolerance.

    The design is solved with panels 1.5 times as wide as its own, then with its own, then with ever
    finer ones. The error of a solution is estimated by its distance from the one before it, with
    the order of convergence of charge at rims (Richardson's extrapolation). It tells of panels
    only, not of sizes and permittivities. No field is built: it takes boundary elements alone.

    Args:
        design: The design.
        tolerance: Largest relative error of each entry, above 0 and below 1.
        progress: Called with what is being done.

    Raises:
        DesignError: The tolerance is no number between 0 and 1.
        FieldError: The design does not fit in memory with its own panels.
    """
    if not 0.0 < tolerance < 1.0:
        raise DesignError(f"tolerance is {tolerance:g}; give a number above 0 and below 1")
    own = design.resolution
    found: Refinement | None = None
    resolution = own / _STEP
    while resolution <= RESOLUTIONS[1]:
        try:
            matrix, panels = _electrodes(design, resolution / own, progress)
        except FieldError:
            if found is None or math.isinf(found.errors.max()):
                raise
            break  # finer panels do not fit
        errors = np.full(matrix.shape, np.inf)
        if found is not None:
            ratio = (panels / found.panels) ** (1 / POWER)
            if ratio < 1.05:  # the design cannot be cut finer
                break
            scale = np.maximum(np.abs(matrix), _SMALL * _geometric_mean(matrix))
            errors = np.abs(matrix - found.capacitance) / scale / (ratio**_ORDER - 1.0)
        found = Refinement(resolution, panels, matrix, errors, bool(errors.max() <= tolerance))
        if found.met:
            break
        resolution *= _STEP
    assert found is not None
    return found


def _electrodes(design: Design, finer: float, progress: Callable[[str], None]) -> tuple[Array, int]:
    """Matrix of the electrodes with panels finer than the design's own, and their number."""
    solution, _, matrix = solve_empty(design, default_settings(design).refined(finer), progress)
    n = len(design.electrodes)
    return Terminals(design, matrix).empty[:n, :n], solution.model.panels.size


def _geometric_mean(matrix: Array) -> Array:
    """√(C_ii C_jj) of all entries, shape (n, n)."""
    own = np.sqrt(matrix.diagonal())
    return np.asarray(own[:, None] * own)
