"""What a sensor reads at an instant."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.cover import Touch

if TYPE_CHECKING:
    from capsense.field.background import Charges
    from capsense.readout.conversions import Counts, Held

Array = NDArray[np.float64]


class KeptField(Protocol):
    """What a reading knows of the field around the sensor."""

    def potentials(self, points: Array) -> Array: ...

    def charges(self) -> Charges | None: ...


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
    shield_coupling: Array = field(repr=False)
    """Charge on each electrode per volt on all shields together [F], shape (M,)."""
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
    _field: KeptField | None = field(default=None, repr=False)

    @property
    def error(self) -> float:
        """Estimated error of the largest entry [F], ``stats.solver_error``."""
        return self.stats.solver_error

    @property
    def held(self) -> Held | None:
        """What the chip's registers hold, ``counts.held()``, where a readout is configured."""
        return None if self.counts is None else self.counts.held()

    def potentials(self, points: ArrayLike) -> Array:
        """Potentials at points in front of the sensor [V], for drawing.

        They are those of the compact Green's function: right to some per cent from 2 mm in front of
        the electrodes on, and of no meaning behind them. Bodies that float are at the potential
        they take.

        Args:
            points: Points [m] in the sensor frame, shape (n, 3).

        Returns:
            Shape (n, terminals), in the order of ``simulator.background.terminals``: each at 1 V in
            its own column, all others at 0.

        Raises:
            SceneError: The points do not have shape (n, 3).
            ValueError: The field was not kept.
        """
        from capsense.scene.shapes import as_points

        return self._kept("potentials").potentials(as_points(points))

    def charges(self) -> Charges | None:
        """Charges on the bodies, for drawing.

        Returns:
            Places and densities; None where no body was near.

        Raises:
            ValueError: The field was not kept.
        """
        return self._kept("charges").charges()

    def _kept(self, what: str) -> KeptField:
        if self._field is None:
            raise ValueError(
                f"the reading has no {what}, as its field was not kept; write "
                "step(scene, keep_field=True)"
            )
        return self._field

    def with_field(self, known: KeptField) -> Reading:
        """The same reading, which keeps what is known of its field."""
        return replace(self, _field=known)

    @property
    def self_capacitance(self) -> Array:
        """What a self-mode channel measures [F], shape (M,).

        Electrode i is driven, shields are driven with it, all other electrodes are grounded:
        the diagonal of the Maxwell matrix plus the (negative) coupling to the shields.
        """
        return np.diag(self.capacitance) + self.shield_coupling

    @property
    def mutual_capacitance(self) -> Array:
        """Mutual capacitances ``-C_ij`` [F] off the diagonal, zero on it, shape (M, M)."""
        out = -self.capacitance
        np.fill_diagonal(out, 0.0)
        return out
