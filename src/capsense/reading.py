"""Results: what sensors read, and what solvers find of a scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from capsense.readout.conversions import Counts, Held

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Touch:
    """What bodies press onto the cover of a design, for each of its M electrodes."""

    force: Array
    """Force that the cover carries above each electrode [N], shape (M,)."""
    compression: Array
    """Largest compression of the cover above each electrode [m], shape (M,)."""
    total: float
    """Force that the whole cover carries [N]."""


@dataclass(frozen=True, eq=False)
class Charges:
    """Charges that the terminals draw onto the bodies."""

    points: Array
    """Where they sit [m], shape (n, 3)."""
    density: Array
    """Size of the surface density for each terminal at 1 V [C/m²], shape (n, terminals)."""
    pitch: float
    """Usual distance of neighbours [m]."""


@dataclass(frozen=True, eq=False)
class CapacitanceChange:
    """What a scene changes in the Maxwell matrix of all terminals."""

    matrix: Array
    """Change of the matrix [F], shape (terminals, terminals)."""
    error: float
    """Estimated error of its largest entry [F]; infinite where an electrode lies inside a body."""
    iterations: int = 0
    """Iterations of the linear solver; 0 for a direct one."""
    unknowns: int = 0
    """Unknowns that were solved for, for each terminal."""
    loss: Array | None = None
    """Part of the change in quadrature [F], the same shape, where matter has losses: the complex
    capacitance is ``matrix - 1j * loss``."""
    jacobian: Array | None = None
    """How the matrix changes with the poses of the scene's bodies, where it was asked for, shape
    (bodies, terminals, terminals, 6)."""
    touch: Touch | None = None
    """What its bodies press onto the cover, if the design has one."""
    reason: Callable[[], str] = str
    """Tells what most of the error comes from; nothing, if that is not known."""


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
    def in_contact(self) -> bool:
        """Whether a body touches an electrode or lies inside one, so that the reading means
        nothing; its estimated error is then as large as the largest capacitance."""
        return bool(self.stats.solver_error >= np.abs(self.capacitance).max())

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


@dataclass(frozen=True, eq=False)
class FleetReading:
    """What the sensors of all environments see; e environments, s sensors, n electrodes.

    Arrays of NumPy on the CPU, else of Warp, in single precision, which PyTorch and JAX take by
    DLPack; those are written anew by the next step.
    """

    capacitance: Any
    """Maxwell capacitance matrices [F], shape (e, s, n, n)."""
    delta: Any
    """Their change by the bodies [F], shape (e, s, n, n)."""
    electrode_names: tuple[str, ...]
    error: Any = None
    """Estimated error of the largest entry [F], shape (e, s)."""
    shield_coupling: Any = None
    """Charge on each electrode per volt on all shields together [F], shape (e, s, n), in double
    precision."""
    conductance: Any = None
    """Conductance that matter with losses adds [S], shape (e, s, n, n); None on the CPU where
    there is none."""
    held: Held | None = None
    """What the chips' registers hold, where there is a readout, each of shape (e, s, channels)."""
    jacobian: Any = None
    """Change of the matrices as each body moves along the sensor frame's x, y, z [F/m] and turns
    about axes parallel to these through its origin [F/rad], shape (e, s, b, n, n, 6)."""

    touch: FleetTouch | None = None
    """What is pressed onto the cover, if the design has one; without relaxation and hysteresis."""

    @property
    def self_capacitance(self) -> Array:
        """As of :class:`Reading` [F], shape (e, s, n); copied from the device."""
        own = np.diagonal(_on_host(self.capacitance), axis1=-2, axis2=-1)
        if self.shield_coupling is None:
            return own.copy()
        return np.asarray(own + _on_host(self.shield_coupling))

    @property
    def mutual_capacitance(self) -> Array:
        """As of :class:`Reading` [F], shape (e, s, n, n); copied from the device."""
        out = -_on_host(self.capacitance)
        out[..., range(out.shape[-1]), range(out.shape[-1])] = 0.0
        return np.asarray(out)


@dataclass(frozen=True, eq=False)
class FleetTouch:
    """What bodies press onto the covers of all sensors, see :class:`Touch`."""

    force: Any
    """Force that the cover carries above each electrode [N], shape (e, s, n)."""
    compression: Any
    """Largest compression of the cover above each electrode [m], shape (e, s, n)."""
    total: Any
    """Force that the whole cover carries [N], shape (e, s)."""


def _on_host(values: Any) -> Any:
    """An array of NumPy with the same numbers."""
    return values if isinstance(values, np.ndarray) else values.numpy()
