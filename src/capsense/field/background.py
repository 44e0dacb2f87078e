"""The field of a design in its empty domain."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from capsense.design.model import Design, Role
from capsense.errors import FieldError
from capsense.field.boundary import Accuracy, BoundarySolution, terminals
from capsense.field.face import has_even_face
from capsense.field.gap_table import gap_table_of, table_solution
from capsense.field.green import GreenFunction, build_green

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

NUMERICS = 20
"""Raise it when the same design and settings give other fields than before: it is part of the cache
key, and fields of the old numerics are then no longer used."""


@dataclass(frozen=True)
class MeshSettings:
    """Spacings of the planes whose cells are split into tetrahedra; all lengths in metres."""

    edge: float = 0.0036
    """Largest spacing beside an electrode's edge, in the plane."""
    growth: float = 0.53
    """Growth of the in-plane spacing per unit distance from the nearest edge."""
    far: float = 0.06
    """Largest in-plane spacing."""
    face: float = 0.0024
    """Spacing beside an electrode's face, across the plane."""
    growth_z: float = 0.207
    """Growth of the spacing across the plane per unit distance from the nearest face."""
    far_z: float = 0.013
    """Largest spacing across the plane …"""
    tall: float = 0.074
    """… or, where that is more, this fraction of the distance from the nearest face."""
    merge: float = 0.0008
    """Edges closer to each other than this share one plane."""

    def refined(self, factor: float) -> MeshSettings:
        """Return settings with ``factor`` times as many nodes along each axis."""
        finer = {name: value / factor for name, value in vars(self).items()}
        return MeshSettings(**{**finer, "merge": self.merge / max(1.0, factor)})


@dataclass(frozen=True)
class BuildSettings:
    """How finely a sensor is resolved. The background field depends on ``panel_scale`` only."""

    panel_scale: float = 1.0
    """Panel sizes of the boundary elements, as multiples of the default."""
    mesh: MeshSettings = field(default_factory=MeshSettings)
    """Mesh of the method ``"fem_masked"``, which the field does not depend on."""

    def refined(self, factor: float) -> BuildSettings:
        """Return settings with panels and mesh finer by a factor along each axis."""
        return BuildSettings(self.panel_scale / factor, self.mesh.refined(factor))


@dataclass(frozen=True, eq=False)
class BackgroundField:
    """Field and capacitances of a design without any object in its domain."""

    capacitance: Array
    """Maxwell matrix [F] of all terminals, shape (terminals, terminals)."""
    terminals: tuple[str, ...]
    """Names: electrodes in matrix order, then shields, then floating conductors, then the local
    ground, if it is not earthed."""
    n_panels: int
    """Size of the boundary-element system."""
    green: GreenFunction
    """Answer of the grounded design to charges anywhere, and the terminals' potentials."""


_WRONG = 1e-4
"""Mutual capacitances of the wrong sign that are smaller, over √(C_ii C_jj), are rounding errors of
conductors that are screened from each other."""

_STAGES = {
    "boundary elements: factorising": 0.1,
    "response to charges: where": 0.15,
    "response to charges: boundary elements": 0.2,
    "response to charges: fit": 0.25,
}
"""Share of a build's time that is over when a stage begins; 0 for the others."""


def build_background(
    design: Design,
    settings: BuildSettings | None = None,
    progress: Progress | None = None,
) -> BackgroundField:
    """Solve the empty domain of a design by boundary elements and fit its Green's function.

    All of it is done in the length unit of the design, so that scaled designs have the same fields.

    ``progress`` is called with a stage's name and the fraction done, which never falls.

    Raises:
        FieldError: The geometry needs more panels than fit, or a result is not finite.
    """
    settings = settings or BuildSettings()
    tell = (lambda stage, fraction: None) if progress is None else progress

    def begin(stage: str) -> None:
        count = re.fullmatch(r"response to (?:a )?(plane|compression): (\d+) of (\d+)", stage)
        if count:
            start, share = (0.4, 0.5) if count[1] == "plane" else (0.9, 0.1)
            tell(stage, start + share * (int(count[2]) - 1) / int(count[3]))
        else:
            tell(stage, _STAGES.get(stage, 0.0))

    names, unit = tuple(terminals(design)), design.unit
    # Bits depend on how many threads a BLAS has. They wait without sleeping, too: beside other
    # processes most of the time of a small design goes to that.
    with threadpool_limits(1, "blas"):
        solution, densities, capacitance = solve_empty(design, settings, begin)
        green = build_green(solution, densities, begin)
        count = len(densities)
        if has_even_face(solution.design):
            solution = table_solution(solution, settings.panel_scale)  # the finer one is given up
            table = gap_table_of(solution, settings.panel_scale, green, begin)
            green = replace(green, gap=table)
    green = replace(green, unit=unit)
    tell("done", 1.0)
    return BackgroundField(capacitance, names, count, green)


def empty_capacitance(design: Design, settings: BuildSettings | None = None) -> Array:
    """Maxwell matrix of a design's empty domain alone, as :func:`build_background` has it [F].

    It takes boundary elements, and none of the rest of a field: no bodies can be solved with it.

    Returns:
        Shape (terminals, terminals), to the last bit ``BackgroundField.capacitance``.

    Raises:
        FieldError: The geometry needs more panels than fit, or a result is not finite.
    """
    with threadpool_limits(1, "blas"):
        return solve_empty(design, settings or BuildSettings(), lambda _: None)[2]


def warn_of_signs(design: Design, capacitance: Array) -> None:
    """Warn where conductors come out with less than no capacitance between them.

    No entry of a Maxwell matrix off its diagonal is positive: with one conductor at 1 V, potentials
    are nowhere below 0, and charges of those at ground not above it (maximum principle). One that
    is positive has an error of at least its size.

    Args:
        design: The design.
        capacitance: Maxwell matrix of its terminals in the empty domain [F], shape (t, t).
    """
    own = np.sqrt(capacitance.diagonal())
    share = np.triu(capacitance / own / own[:, None], 1)
    i, j = divmod(int(share.argmax()), len(share))
    if share[i, j] > _WRONG:
        names = terminals(design)
        warnings.warn(
            f"design {design.name!r}: the panels are too coarse for its baseline; the mutual "
            f"capacitance of {names[i]} and {names[j]} has the wrong sign, by "
            f"{1e12 * capacitance[i, j]:.2g} pF; raise [build] resolution above "
            f"{design.resolution:g}: capsense design FILE --tolerance 1% finds one that is enough",
            stacklevel=4,
        )


def solve_empty(
    design: Design, settings: BuildSettings, begin: Callable[[str], None]
) -> tuple[BoundarySolution, Array, Array]:
    """Boundary elements in the design's unit, their densities, and the Maxwell matrix [F]."""
    solution = BoundarySolution(design.in_units, Accuracy(settings.panel_scale), begin)
    densities = solution.densities(np.eye(solution.model.n_terminals))
    capacitance = solution.terminal_charges(densities)
    capacitance = 0.5 * design.unit * (capacitance + capacitance.T)
    if not (np.isfinite(densities).all() and np.isfinite(capacitance).all()):
        raise FieldError(f"the background field of design {design.name!r} is not finite")
    return solution, densities, capacitance


class Terminals:
    """The terminals of a design: t in all, of which k are driven: n electrodes, then shields.

    Matrices are given for all terminals: behind the driven ones come floating conductors of the
    design, then its local ground, where it is not earthed. They are reduced to the driven ones,
    with their potentials against the local ground, by the network that the others make:

        ``C' = Bᵀ M (B + N U)``,  ``U = −(Nᵀ M N + G)⁻¹ Nᵀ M B``.

    Columns of B are the potentials of all terminals for each driven one at 1 V; columns of N those
    for each free conductor at 1 V: a floating one alone, and the local ground with all that are
    driven against it. G holds the capacitance from the local ground to earth. Whatever charge goes
    out to the driven terminals comes from the local ground, so that electrodes, shields and ground
    together hold what that capacitance lacks: ``C' = C − c cᵀ/(s + C_g)`` without floating
    conductors, c being their capacitances to earth, the rows' sums, and s their sum.

    Args:
        design: The design.
        empty_maxwell: Maxwell matrix of all terminals in the empty domain [F], shape (t, t).
    """

    def __init__(self, design: Design, empty_maxwell: Array) -> None:
        self.electrodes = len(design.electrodes)
        floating = sum(c.role == Role.FLOATING for c in design.conductors)
        self.driven = len(empty_maxwell) - floating - design.local_ground
        """How many electrodes there are, n, and how many terminals are driven, k."""
        self._free = np.eye(len(empty_maxwell))[:, self.driven : self.driven + floating]
        """N: potentials of all terminals for each free conductor at 1 V, shape (t, free)."""
        self._ties = np.zeros(floating)
        """Capacitance of each free conductor to earth [F]."""
        self._floats = design.ground_capacitance is not None
        if design.ground_capacitance is not None:
            board = 1.0 - self._free.sum(axis=1)
            self._free = np.column_stack([self._free, board])
            self._ties = np.append(self._ties, design.ground_capacitance)
        self.empty_maxwell = empty_maxwell
        self.empty: Array = self._reduced(empty_maxwell)
        """Maxwell matrix of the driven terminals in the empty domain [F], shape (k, k)."""
        self.bound: Array = np.maximum(
            -empty_maxwell, 0.0
        )  # coarse meshes may have them the other way
        """Most that each entry changes by [F], shape (t, t): terminals that are screened from each
        other do not couple."""
        np.fill_diagonal(self.bound, np.inf)

    def screened(self, change: Array) -> Array:
        """Bound a change, shape (..., t, t)."""
        return np.minimum(change, self.bound)

    def grounded(self, change: Array) -> Array:
        """Raise diagonals of a change so far that no capacitance to ground is negative, (t, t)."""
        lack = np.minimum((self.empty_maxwell + change).sum(axis=1), 0.0)
        return change - np.diag(lack)

    def change(self, change: NDArray[Any]) -> NDArray[Any]:
        """Change of the driven terminals' matrix by that of all, (..., t, t) -> (..., k, k)."""
        if not len(self._ties):
            return change
        return self._reduced(self.empty_maxwell + change) - self.empty

    def error(self, error: Array, change: NDArray[Any], reduced: NDArray[Any]) -> Array:
        """Estimated errors [F] of matrices against the local ground, shape (...).

        Those of the largest change of an electrode, in proportion: potentials against earth are
        smaller where the local ground is free, and so are the charges of bodies.

        Args:
            error: Of the matrices of all terminals, shape (...).
            change: The changes of these, shape (..., t, t).
            reduced: The same, reduced, shape (..., k, k).
        """
        if not self._floats:
            return error
        n = self.electrodes
        before, after = (
            np.abs(np.diagonal(m, axis1=-2, axis2=-1)[..., :n]).max(axis=-1)
            for m in (change, reduced)
        )
        return np.where(np.isinf(error) | (before == 0.0), error, error * after / np.where(
            before == 0.0, 1.0, before
        ))  # fmt: skip

    def slope(self, change: NDArray[Any], slope: Array) -> Array:
        """Derivative of the electrodes' matrix by that of all terminals.

        Args:
            change: As :meth:`change` takes it, shape (..., t, t).
            slope: Shape (..., b, t, t, 6).

        Returns:
            Shape (..., b, n, n, 6).
        """
        n = self.electrodes
        if not len(self._ties):
            return slope[..., :n, :n, :]
        follow = np.eye(len(self.empty_maxwell), n) - self._free @ np.linalg.solve(
            *self._network(self.empty_maxwell + change, n)
        )
        return np.einsum("...ai,...bacm,...cj->...bijm", follow, slope, follow)

    def _network(self, matrix: NDArray[Any], count: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Nᵀ M N + G of the free conductors, and Nᵀ M B for the first driven terminals."""
        side = self._free.T @ matrix
        return side @ self._free + np.diag(self._ties), side[..., :count]

    def _reduced(self, matrix: NDArray[Any]) -> NDArray[Any]:
        """The matrix of the driven terminals against the local ground, (..., k, k)."""
        k = self.driven
        if not len(self._ties):
            return matrix
        own, cross = self._network(matrix, k)
        return matrix[..., :k, :k] - cross.swapaxes(-1, -2) @ np.linalg.solve(own, cross)
