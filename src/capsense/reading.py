"""What a sensor reads at an instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.cover import Touch

if TYPE_CHECKING:
    from capsense.readout.conversions import Counts

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StepStats:
    """How a step was solved."""

    solver_error: float
    """Estimated error of a capacitance [F]: what more unknowns or iterations would change, and with
    ``"surface"`` 1.5 % of what bodies change.

    As large as the largest capacitance where the reading means nothing: a bare electrode lies
    inside a body, or touches a conductor.
    """
    wall_time: float
    """Time the step took [s]."""
    unknowns: int = 0
    """Charge functions that were solved for, or free nodes of the paper's scheme."""
    iterations: int = 0
    """Iterations of the linear solver; 0 with ``"surface"``, which solves directly."""


@dataclass(frozen=True, eq=False)
class Reading:
    """The capacitances of one instant."""

    capacitance: Array
    """Maxwell capacitance matrix of the electrodes, shields at ground [F], shape (M, M)."""
    delta: Array
    """Change against the empty domain, ``capacitance - baseline`` [F], shape (M, M)."""
    stats: StepStats
    electrode_names: tuple[str, ...]
    _shield_coupling: Array = field(repr=False)
    counts: Counts | None = None
    """What the chip has reported since the reading before, where a readout is configured."""
    jacobian: Array | None = None
    """How ``capacitance`` changes as each body of the scene moves along the sensor frame's x, y, z
    [F/m], then turns about axes parallel to these through its own origin [F/rad], where it was
    asked for, shape (bodies, M, M, 6)."""

    conductance: Array | None = None
    """Conductance matrix G of the electrodes [S], shields at ground, shape (M, M), where matter
    has losses: their admittance is ``G + 1j * 2π f * capacitance`` at the simulator's frequency
    f."""
    touch: Touch | None = None
    """Force [N] and compression [m] of the cover above each electrode, if the design has a
    ``[[cover]]``."""

    @property
    def self_capacitance(self) -> Array:
        """What a self-mode channel measures [F], shape (M,).

        Electrode i is driven, shields are driven with it, all other electrodes are grounded:
        the diagonal of the Maxwell matrix plus the (negative) coupling to the shields.
        """
        return np.diag(self.capacitance) + self._shield_coupling

    @property
    def mutual_capacitance(self) -> Array:
        """Mutual capacitances ``-C_ij`` [F] off the diagonal, zero on it, shape (M, M)."""
        out = -self.capacitance
        np.fill_diagonal(out, 0.0)
        return out
