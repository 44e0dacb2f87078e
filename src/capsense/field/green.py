"""Compact Green's function of a grounded design.

With all terminals of a design at 0 V, a unit charge at q makes the potential G(p, q) =
1/|p − q| + g(p, q) at p, in units where 4π eps0 = 1. g is the answer of the floor, which is that of
the image q* of the charge in it, and of everything else, which lowers the potential further:

  g(p, q) = −1/|p − q*| − ψ(p)·ψ(q)

The modes ψ_k, and the potentials φ⁰_i of the terminals, are those of a few hundred point charges s,
each with its image in the floor, where no body can be: behind the electrodes, inside of layers and
housings, and outside of the walls. Farther from the sensor fewer charges and fewer modes do, so
that there are three representations of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import NDArray

from capsense.errors import FieldError
from capsense.field import plane_tables
from capsense.field.boundary import BoundarySolution
from capsense.field.green_points import (
    GreenSettings,
    Surroundings,
    design_box,
    far_points,
    outside,
    training_points,
    wall_sources,
)
from capsense.field.plane_tables import GapTable

Array = NDArray[np.float64]
Table = NDArray[np.float32]

LEVELS = ("near", "middle", "far")
"""Representations, each for points farther from the sensor than the one before."""
TABLES = tuple(f"{level}_{name}" for level in LEVELS for name in ("sources", "modes", "phi"))
"""Fields of a :class:`GreenFunction` in single precision."""

_MIDDLE = 0.05
"""Beyond this distance from the design [m], errors count less and less."""


@dataclass(frozen=True, eq=False)
class GreenFunction:
    """The grounded Green's function of a design and the potentials of its terminals.

    Lengths are in the design's ``unit``, those that functions take and give in metres. All tables
    are single precision and contiguous. With b_s(p) = 1/|p − s| − 1/|p − s*|, s* the image of s in
    the floor, ψ_k(p) = Σ_s b_s(p) modes[s, k] and φ⁰_i(p) = Σ_s b_s(p) phi[s, i].
    """

    floor: float
    """Height of the grounded floor [m]."""
    near_sources: Table
    """Point charges of the near representation [m], shape (s, 3)."""
    near_modes: Table
    """Coefficients of the modes ψ [m^½], those that reach farthest first, shape (s, modes)."""
    near_phi: Table
    """Coefficients of the potentials φ⁰ with a terminal at 1 V [V·m], shape (s, terminals)."""
    middle_sources: Table
    """Point charges of the middle representation [m], shape (m, 3)."""
    middle_modes: Table
    """Coefficients of the first modes, shape (m, middle modes); the others are zero there."""
    middle_phi: Table
    """Coefficients of the potentials φ⁰, shape (m, terminals)."""
    far_sources: Table
    """Point charges of the far representation [m], shape (f, 3)."""
    far_modes: Table
    """Coefficients of the first modes, shape (f, far modes); the others are zero far away."""
    far_phi: Table
    """Coefficients of the potentials φ⁰, shape (f, terminals)."""
    box: Array
    """Lower and upper corner of electrodes, conductors and layers [m], shape (2, 3)."""
    blends: Array
    """Distances from ``box`` where the middle representation starts and the near one ends, and
    where the far one starts and the middle one ends [m], shape (2, 2)."""
    clearance: float
    """Distance from the design's surfaces down to which the modes were fitted [m]."""
    misfit: float
    """Relative difference of ψ·ψ from the boundary elements, over all pairs of points of the fit.

    It overstates by far what it costs a capacitance, which sees averages over bodies.
    """
    unit: float = 1.0
    """Length unit of all other fields [m]."""
    gap: GapTable | None = None
    """What bodies in the first millimetres add, of a flat design."""

    @property
    def n_modes(self) -> int:
        """Number of modes of the near representation."""
        return self.near_modes.shape[1]

    def distance(self, points: Array) -> Array:
        """Distance from ``box`` [m], zero inside, shape (n, 3) -> (n,)."""
        return self.unit * outside(self.box, points / self.unit)

    def shares(self, points: Array) -> Array:
        """Share of each representation, smoothsteps between them, shape (n, 3) -> (3, n)."""
        distance = self.distance(points) / self.unit
        up_to = [np.zeros(len(points))]  # of a representation and those before
        for start, end in self.blends:
            t = np.clip((end - distance) / (end - start), 0.0, 1.0)
            up_to.append(t * t * (3 - 2 * t))
        return np.diff([*up_to, np.ones(len(points))], axis=0)

    def psi(self, points: Array) -> Array:
        """Modes at points [m], [1/m^½], shape (n, 3) -> (n, modes)."""
        modes = self._sum(points, self.near_modes, self.middle_modes, self.far_modes)
        return modes / math.sqrt(self.unit)

    def phi0(self, points: Array) -> Array:
        """Potential [V] of each terminal at 1 V, others at 0, shape (n, 3) -> (n, terminals)."""
        return self._sum(points, self.near_phi, self.middle_phi, self.far_phi)

    def _sum(self, points: Array, *tables: Table) -> Array:
        """Potentials of all representations' charges, each where it has a share, (n, k)."""
        out = np.zeros((len(points), tables[0].shape[1]))
        sources_of = self.near_sources, self.middle_sources, self.far_sources
        for sources, table, part in zip(sources_of, tables, self.shares(points), strict=True):
            here = np.flatnonzero(part)
            values = basis(points[here] / self.unit, sources, self.floor) @ table.astype(np.float64)
            out[here, : table.shape[1]] += part[here, None] * values
        return out

    def psi_and_phi0(self, points: Array) -> tuple[Array, Array]:
        """:meth:`psi` and :meth:`phi0` at once, in half of the time."""
        terminals = self.near_phi.shape[1]
        found = self._sum(points, *(
            np.hstack([phi, modes]) for phi, modes in (
                (self.near_phi, self.near_modes), (self.middle_phi, self.middle_modes),
                (self.far_phi, self.far_modes),
            )
        ))  # fmt: skip
        return found[:, terminals:] / math.sqrt(self.unit), found[:, :terminals]

    def g(self, p: Array, q: Array) -> Array:
        """Potential at p of the design's answer to unit charges at q [1/m], (n, 3), (m, 3)."""
        images = q * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * self.unit * self.floor]
        return -1 / _distances(p, images) - self.psi(p) @ self.psi(q).T


def basis(points: Array, sources: NDArray[np.floating], floor: float) -> Array:
    """Potential of unit charges and their images in the floor [1/m], (n, 3), (s, 3) -> (n, s)."""
    return _basis(
        np.ascontiguousarray(points.T), np.ascontiguousarray(sources.T, np.float64), floor
    )


@njit(cache=True, fastmath=True, error_model="numpy")
def _basis(points: Array, sources: Array, floor: float) -> Array:
    """As :func:`basis`, of coordinates in rows, (3, n), (3, s) -> (n, s)."""
    x, y, z = sources
    out = np.empty((points.shape[1], sources.shape[1]))
    for i in range(len(out)):
        a, b, c = points[0, i], points[1, i], points[2, i]
        for k in range(len(x)):
            across = (a - x[k]) ** 2 + (b - y[k]) ** 2
            up, down = c - z[k], c + z[k] - 2 * floor
            out[i, k] = 1 / np.sqrt(across + up * up) - 1 / np.sqrt(across + down * down)
    return out


_SIGNS = 64
"""Random signs of all points of the fit that tell the misfit: on average, the squared norm of a
matrix times random signs is that of the matrix (Hutchinson, *A stochastic estimator of the trace of
the influence matrix*, Commun. Stat. Simul. Comput. 19, 1990)."""
_FINE = 1e-11
"""Regularisation of the fit of φ⁰."""


def build_green(
    solution: BoundarySolution,
    densities: Array,
    progress: Callable[[str], None] = lambda _: None,
    settings: GreenSettings | None = None,
) -> GreenFunction:
    """Fit the compact Green's function of a design to its boundary elements.

    Args:
        solution: The factorised boundary elements.
        densities: Their densities with each terminal at 1 V in turn, shape (panels, terminals).
        progress: Called with what is being done.
        settings: Sizes; default :class:`GreenSettings`.

    Raises:
        FieldError: The result is not finite.
    """
    settings = settings or GreenSettings()
    model, design = solution.model, solution.design
    floor = model.floor
    progress("response to charges: where")
    surface = Surroundings(design, model)
    walls = wall_sources(design, settings)
    near, middle, far = (
        np.concatenate([surface.sources(count, spacing, settings.depth), walls])
        for count, spacing in (
            (settings.near_sources, settings.near_spacing),
            (settings.middle_sources, settings.middle_spacing),
            (settings.far_sources, settings.far_spacing),
        )
    )
    points, distances = training_points(surface, near, settings)
    progress("response to charges: boundary elements")
    answers = solution.answers(points)
    phi = answers.of_densities(densities)
    progress("response to charges: fit")
    weight = _near_weight(distances)
    fit = _Fit(basis(points, near, floor) * weight, settings.regularisation)
    modes = fit.factor(-answers.between(weight * fit.matrix), settings.modes)
    near_phi = _fit_phi(points, distances, near, floor, phi)

    away = [far_points(surface, near, settings, start) for start, _ in settings.blends]
    there = [basis(x, near, floor) for x, _ in away]
    psi = fit.matrix @ (modes * fit.scale[:, None])
    counts = [min(n, modes.shape[1]) for n in (settings.middle_modes, settings.far_modes)]
    seen = [_weight(d) * (b @ modes) for (_, d), b in zip(away, there, strict=True)]
    turn = _turn((seen[1], 0), (seen[0], counts[1]), (psi, counts[0]))
    modes, psi = modes @ turn, psi @ turn
    signs = np.random.default_rng(2).choice([-1.0, 1.0], (len(points), _SIGNS))
    wanted = -weight * answers.by(weight * signs)
    misfit = float(np.linalg.norm(wanted - psi @ (psi.T @ signs)) / np.linalg.norm(wanted))
    tables = [near, _rounded(modes), near_phi]
    for sources, (x, d), b, count in zip((middle, far), away, there, counts, strict=True):
        fit = _Fit(basis(x, sources, floor) * _weight(d), settings.regularisation)
        tables += [
            sources, _rounded(fit.solve(_weight(d) * (b @ modes[:, :count]))),
            _fit_phi(x, d, sources, floor, b @ near_phi),
        ]  # fmt: skip
    if not all(np.isfinite(t).all() for t in tables):
        raise FieldError(f"the Green's function of design {design.name!r} is not finite")
    numbers = {
        "floor": floor, "box": design_box(design), "blends": np.array(settings.blends),
        "clearance": surface.clearance(settings), "misfit": misfit, "unit": 1.0,
    }  # fmt: skip
    return from_arrays({**dict(zip(TABLES, tables, strict=True)), **numbers})


def to_arrays(green: GreenFunction) -> dict[str, NDArray[Any]]:
    """All of a Green's function by the names of its fields."""
    out = {name: np.asarray(value) for name, value in vars(green).items() if name != "gap"}
    return out if green.gap is None else out | plane_tables.to_arrays(green.gap)


def from_arrays(arrays: Mapping[str, Any]) -> GreenFunction:
    """Undo :func:`to_arrays`; tables of any precision become single precision.

    Raises:
        KeyError: A field is missing.
    """

    def value(name: str) -> Any:
        if name in TABLES:
            return np.ascontiguousarray(arrays[name], dtype=np.float32)
        given = np.array(arrays[name], dtype=float)
        return given if given.ndim else float(given)

    own = {f.name: value(f.name) for f in fields(GreenFunction) if f.name != "gap"}
    return GreenFunction(**own, gap=plane_tables.from_arrays(arrays))


def _weight(distances: Array) -> Array:
    """What errors count at distances from the design, shape (n, 1)."""
    return (np.sqrt(distances + 2e-3) / (1 + distances / _MIDDLE))[:, None]


def _near_weight(distances: Array) -> Array:
    """Error of ψ·ψ of the near representation, (n, 1): near the design ψ·ψ is large."""
    return (distances**0.75 / (1 + distances / _MIDDLE))[:, None]


def _rounded(table: Array) -> Table:
    """Single precision with 11 binary digits, which pack well.

    Only the modes' tables, which are large, are rounded.
    """
    bits = np.ascontiguousarray(table, dtype=np.float32).view(np.int32)
    return ((bits + (1 << 11)) & ~((1 << 12) - 1)).view(np.float32)


# -- fit ---------------------------------------------------------------------------------------


class _Fit:
    """Regularised least squares for the charges of given weighted potentials."""

    def __init__(self, matrix: Array, regularisation: float) -> None:
        self.scale = np.linalg.norm(matrix, axis=0)
        self.matrix = matrix / self.scale
        gram = self.matrix.T @ self.matrix
        gram[np.diag_indices_from(gram)] += regularisation * np.linalg.norm(gram)
        self.lower = np.linalg.cholesky(gram)

    def solve(self, values: Array) -> Array:
        """Charges that make weighted potentials, shape (points, k) -> (sources, k)."""
        found = scipy.linalg.cho_solve((self.lower, True), self.matrix.T @ values)
        return found / self.scale[:, None]

    def factor(self, inner: Array, rank: int) -> Array:
        """Charges X of the leading modes of a kernel K, near (B X) (B X)ᵀ.

        Args:
            inner: Bᵀ K B with :attr:`matrix` as B, shape (sources, sources). Only the symmetric
                part counts.
            rank: Largest number of modes.
        """
        half = scipy.linalg.solve_triangular(self.lower, inner, lower=True)
        half = scipy.linalg.solve_triangular(self.lower, half.T, lower=True)
        first = max(0, len(half) - rank)
        value, vector = scipy.linalg.eigh(
            0.5 * (half + half.T), subset_by_index=(first, len(half) - 1)
        )
        keep = value > 1e-9 * value[-1]
        modes = vector[:, keep] * np.sqrt(value[keep])
        found = scipy.linalg.solve_triangular(self.lower, modes, lower=True, trans="T")
        return found / self.scale[:, None]


def _fit_phi(points: Array, distances: Array, sources: Array, floor: float, phi: Array) -> Array:
    """Charges (sources, k) that make the potentials ``phi`` (points, k).

    Errors count as they do for modes, times the distance: of the weights that were tried, the one
    with the smallest errors of φ⁰ at all distances.
    """
    weight = _weight(distances) * distances[:, None]
    return _Fit(basis(points, sources, floor) * weight, _FINE).solve(phi * weight)


def _turn(*stages: tuple[Array, int]) -> Array:
    """Orthogonal matrix (modes, modes) that sorts modes by what they are worth.

    Of each stage, values (points, modes) and a count: modes from that one on hold as much as can be
    of the values, the first of them most.
    """
    turn = np.eye(stages[0][0].shape[1])
    for values, first in stages:
        rest = values @ turn[:, first:]
        vector = np.linalg.eigh(rest.T @ rest)[1][:, ::-1]
        turn[:, first:] = turn[:, first:] @ vector
    return turn


def _distances(p: Array, q: Array) -> Array:
    """Distances between points [m], (n, 3), (m, 3) -> (n, m)."""
    square = sum((p[:, None, a] - q[None, :, a]) ** 2 for a in range(3))
    return np.sqrt(square)
