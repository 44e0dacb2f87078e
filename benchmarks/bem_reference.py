"""Boundary elements for reference figures: bodies in front of flat patches in a grounded box.

Written apart from the package's own boundary elements, so that neither checks itself. Panels are
flat, triangles or quadrilaterals, and carry one charge density each. Potentials and fields of a
panel are in closed form; the other integral of a pair is a Gauss rule on the smaller of the two,
the denser the nearer they are. The box's floor is met by images, its walls are panels.

The sensor's panels are eliminated first: its matrix S is factorised once, and a body's charges see

    A = P − B S⁻¹ Bᵀ,   ΔC = Φᵀ A⁻¹ Φ,   Φ = B S⁻¹ U

with P the body's own matrix, B the potentials of the sensor's panels on the body's, and U the unit
potentials of the electrodes. No difference of two large numbers is taken. A floating conductor adds
its potential as an unknown, and that its charge is zero (or −C_g v) as an equation; a dielectric's
rows say that the normal displacement is continuous. Units are metres, 4π eps0 = 1 inside.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.linalg
from bem_integrals import NODES, WEIGHTS, curved_fluxes, fluxes, potentials
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import capsense as cs
from capsense.constants import EPS0

Array = NDArray[np.float64]
Size = Callable[[Array], Array]
"""Wanted panel size [m] at points [m], (n, 3) -> (n,)."""
FARADS = 4 * math.pi * EPS0
"""Of a capacitance of one metre."""


@dataclass
class Curved:
    """Points on the true surface behind some panels, and which smooth piece each belongs to."""

    points: Array
    """(n, q, 3) [m]."""
    normals: Array
    weights: Array
    """Areas [m²], (n, q)."""
    piece: NDArray[np.int64]


class Panels:
    """Flat panels from their corners, (n, 4, 3), counter-clockwise from outside; the floor is 0."""

    def __init__(self, corners: Array) -> None:
        self.corners = np.ascontiguousarray(corners)
        diagonals = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        cross = np.cross(*diagonals) / 2
        self.area = np.linalg.norm(cross, axis=1)
        self.normal = cross / self.area[:, None]
        first = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], diagonals[0]), axis=1) / 2
        share = (first / self.area)[:, None]
        self.center = share * corners[:, :3].mean(axis=1)
        self.center += (1 - share) * corners[:, [0, 2, 3]].mean(axis=1)
        self.reach = np.linalg.norm(corners - self.center[:, None], axis=2).max(axis=1)

    def __len__(self) -> int:
        return len(self.area)

    @property
    def args(self) -> tuple[Array, ...]:
        """As the kernels take them."""
        return self.corners, self.normal, self.center, self.area, self.reach

    def potentials(self, other: Panels) -> Array:
        """(n, m), m² · m."""
        same = other is self
        out = potentials(*self.args, *other.args, same, NODES, WEIGHTS)
        return np.tril(out) + np.tril(out, -1).T if same else out

    def fluxes(self, other: Panels) -> Array:
        """Fluxes of the other's panels, and of their images, through these; none of its own."""
        out = fluxes(*self.args, *other.args, other is self, False, NODES, WEIGHTS)
        return out - fluxes(*self.args, *other.args, False, True, NODES, WEIGHTS)

    def own_fluxes(self, curved: Curved | None) -> Array:
        """Fluxes within a closed body; half of every panel's flux leaves through the others."""
        out = fluxes(*self.args, *self.args, True, False, NODES, WEIGHTS)
        if curved is not None:
            curved_fluxes(
                curved.points, curved.normals, curved.weights, curved.piece, self.reach, out
            )
        np.fill_diagonal(out, 2 * math.pi * self.area - out.sum(axis=0))
        return out - fluxes(*self.args, *self.args, False, True, NODES, WEIGHTS)


def triangles(corners: Array) -> Array:
    """Triangles (n, 3, 3) as panels (n, 4, 3)."""
    return corners[:, [0, 1, 2, 2]]


def spread(stops: Array, size: Callable[[Array], Array]) -> Array:
    """Cuts from the first stop to the last, all stops among them, about ``size`` apart."""
    out = [stops[:1]]
    for a, b in pairwise(stops):
        x = a + (b - a) * (1 - np.cos(np.linspace(0, math.pi, 121))) / 2
        rate = 1 / size(x)
        count = np.concatenate([[0], np.cumsum(np.diff(x) * (rate[1:] + rate[:-1]) / 2)])
        n = max(1, math.ceil(count[-1] - 0.3))
        out += [np.interp(np.arange(1, n) / n * count[-1], count, x), [b]]
    return np.concatenate(out)


def graded(half: float, count: float, power: float) -> Callable[[Array], Array]:
    """Cell sizes of ``count`` cells on [−half, half], dense at both ends."""

    def size(x: Array) -> Array:
        inward = np.maximum(1 - np.abs(x) / half, (2 / count) ** power)
        return half * power * inward ** (1 - 1 / power) * 2 / count

    return size


def ends(half: float) -> Array:
    """Both ends and the middle."""
    return np.array([-half, 0.0, half])


def face(axis: int, at: float, u: Array, v: Array) -> Array:
    """A grid of rectangles across an axis, facing along it: sign of ``at`` decides."""
    corners = np.zeros((len(u) - 1, len(v) - 1, 4, 3))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    corners[..., axis] = at
    for k, (i, j) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        corners[..., k, a] = u[i : len(u) - 1 + i, None]
        corners[..., k, b] = v[None, j : len(v) - 1 + j]
    out = corners.reshape(-1, 4, 3)
    return out if at >= 0 else out[:, ::-1]


def rectangle(axis: int, at: float, half: Array, cells: list[Callable[[Array], Array]],
              size: Size) -> Array:  # fmt: skip
    """A rectangle across an axis; cells of the two others are no larger than ``size`` anywhere."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    lines = []
    for along, across, cell in ((a, b, cells[0]), (b, a, cells[1])):
        other = np.linspace(-half[across], half[across], 41)

        def wanted(x: Array, along: int = along, across: int = across, other: Array = other,
                   cell: Callable[[Array], Array] = cell) -> Array:  # fmt: skip
            grid = np.zeros((len(x), len(other), 3))
            grid[..., axis] = at
            grid[..., along], grid[..., across] = x[:, None], other
            return np.minimum(cell(x), size(grid.reshape(-1, 3)).reshape(len(x), -1).min(axis=1))

        lines.append(spread(ends(half[along]), wanted))
    return face(axis, at, *lines)


def box_panels(half: Array, size: Size, count: float,
               rims: tuple[Array, Array, float] | None = None) -> Array:  # fmt: skip
    """A box's faces, graded to its edges; ``count`` cells across its longest side.

    ``rims`` are places along x and y [m] where cells shrink to a length.
    """
    cells = [graded(h, max(4.0, count * (h / half.max()) ** 0.5), 2.0) for h in half]
    if rims is not None:
        *places, least = rims
        for k, at in enumerate(places):

            def dense(x: Array, own: Callable[[Array], Array] = cells[k], at: Array = at) -> Array:
                away = np.abs(x[:, None] - at).min(axis=1)
                return np.minimum(own(x), least + 0.5 * away)

            cells[k] = dense
    return np.concatenate(
        [
            rectangle(k, side * half[k], half, [cells[(k + 1) % 3], cells[(k + 2) % 3]], size)
            for k in range(3)
            for side in (-1.0, 1.0)
        ]
    )


def revolved(
    profile: Callable[[Array], tuple[Array, Array]],
    stops: Array,
    size: Size,
    stretch: Array | None = None,
    meridian: Size | None = None,
) -> tuple[Array, Curved]:
    """A solid of revolution about z, perhaps stretched along x, y, z.

    ``profile`` gives radius and height over the arc length from the lower pole; ``stops`` are the
    first cuts, its corners among them; ``size`` is that of panels, ``meridian`` another one along
    the profile, in its arc length before any stretching. Panels are moved along their normals by
    their mean distance from the surface, and grown to its area.
    """
    stretch = np.ones(3) if stretch is None else stretch
    turn = np.linspace(0, 2 * math.pi, 33)

    def place(s: Array, theta: Array) -> Array:
        r, z = profile(s)
        return np.stack([r * np.cos(theta), r * np.sin(theta), z + 0 * theta], axis=-1) * stretch

    def along(s: Array) -> Array:
        grid = place(s[:, None], turn[None])
        return (meridian or size)(grid.reshape(-1, 3)).reshape(len(s), -1).min(axis=1)

    s = spread(stops, along)
    lines = np.linspace(s[0], s[-1], 80)
    reach = np.maximum(profile(lines)[0], 1e-9) * stretch[:2].max()

    def around(theta: Array) -> Array:
        grid = place(lines[None], theta[:, None])
        return (size(grid.reshape(-1, 3)).reshape(len(theta), -1) / reach).min(axis=1)

    theta = spread(np.linspace(0, 2 * math.pi, 5), around)
    nodes = place(s[:, None], theta[None])
    corners = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1]], axis=2)
    corners = corners.reshape(-1, 4, 3)

    a, b = (g.ravel() for g in np.meshgrid(NODES[4, :4], NODES[4, :4], indexing="ij"))
    share = np.outer(WEIGHTS[4, :4], WEIGHTS[4, :4]).ravel()
    ss = (s[:-1, None] + np.diff(s)[:, None] * a)[:, None] + 0 * theta[:-1, None]
    tt = (theta[:-1, None] + np.diff(theta)[:, None] * b)[None] + 0 * ss
    r, _ = profile(ss)
    h = 1e-7
    (ra, za), (rb, zb) = profile(ss - h), profile(ss + h)
    dr, dz = (rb - ra) / (2 * h), (zb - za) / (2 * h)
    normals = np.stack([dz * np.cos(tt), dz * np.sin(tt), -dr], axis=-1) / stretch
    length = np.linalg.norm(normals, axis=-1)
    weights = share * r * np.diff(s)[:, None, None] * np.diff(theta)[:, None] * length
    weights *= stretch.prod()
    count = len(corners)
    middle = (s[1:] + s[:-1]) / 2
    piece = np.repeat(np.searchsorted(stops[1:-1], middle), len(theta) - 1)
    curved = Curved(
        place(ss, tt).reshape(count, -1, 3), (normals / length[..., None]).reshape(count, -1, 3),
        weights.reshape(count, -1), piece,
    )  # fmt: skip
    panels = Panels(corners)
    off = ((curved.points - panels.center[:, None]) * panels.normal[:, None]).sum(axis=2)
    off = (off * curved.weights).sum(axis=1) / curved.weights.sum(axis=1)
    grown = np.sqrt(curved.weights.sum(axis=1) / panels.area)[:, None, None]
    middle = panels.center[:, None]
    return middle + (corners - middle) * grown + (off[:, None] * panels.normal)[:, None], curved


# -- sensor and solution --------------------------------------------------------------------------


@dataclass
class Part:
    """A body: its panels' corners in the sensor frame, and what it is."""

    corners: Array
    kind: str | float
    """grounded, floating, diel, or a capacitance to ground [F]."""
    eps_r: float = 1.0
    curved: Curved | None = None
    """For a dielectric that is not flat-faced."""


class Sensor:
    """Rectangles in z = 0 and the walls of the box; ``near`` makes cells smaller somewhere."""

    def __init__(self, design: cs.Design, scale: float, near: Size | None = None) -> None:
        self.floor = float(design.domain.lower[2])
        parts, owners = [], []
        for k, electrode in enumerate(design.electrodes):
            low, high = electrode.surface.bounds
            middle, half = (low + high) / 2, (high - low) / 2
            cells = [graded(h, 14 / scale, 2.6) for h in half[:2]]

            def wanted(x: Array, middle: Array = middle) -> Array:
                return np.full(len(x), np.inf) if near is None else near(x + middle)

            parts.append(rectangle(2, 0.0, half, cells, wanted) + middle)
            owners += [k] * len(parts[-1])
        low, high = design.domain.lower, design.domain.upper
        half, middle = (high - low) / 2, (high + low) / 2
        lines = [spread(ends(h), graded(h, 10 / scale, 1.4)) for h in half]
        lower = np.append(lines[2][0], -half[2] + np.array([0.01, 0.025, 0.05]))
        heights = np.concatenate([lower, lines[2][lines[2] > lower[-1] + 0.015]])
        for axis in (0, 1):
            u = {0: lines[0], 1: lines[1], 2: heights}
            for side in (-half[axis], half[axis]):
                parts.append(face(axis, side, u[(axis + 1) % 3], u[(axis + 2) % 3]) + middle)
        parts.append(face(2, half[2], lines[0], lines[1]) + middle)
        self.panels = Panels(np.concatenate(parts) - [0, 0, self.floor])
        owner = np.full(len(self.panels), -1)
        owner[: len(owners)] = owners
        unit = np.zeros((len(owner), len(design.electrodes)))
        driven = owner >= 0
        unit[driven, owner[driven]] = self.panels.area[driven]
        self.factor = scipy.linalg.cholesky(self.panels.potentials(self.panels), lower=True)
        half_way = scipy.linalg.solve_triangular(self.factor, unit, lower=True)
        self.capacitance = FARADS * half_way.T @ half_way
        self.half_way = half_way

    def change(self, parts: list[Part]) -> Array:
        """ΔC [F] by some bodies."""
        corners = np.concatenate([p.corners for p in parts]) - [0, 0, self.floor]
        owner = np.repeat(np.arange(len(parts)), [len(p.corners) for p in parts])
        body = Panels(corners)
        across = body.potentials(self.panels)
        half = scipy.linalg.solve_triangular(self.factor, across.T, lower=True)
        matrix = body.potentials(body) - half.T @ half
        phi = half.T @ self.half_way
        if all(p.kind == "grounded" for p in parts):
            root = scipy.linalg.solve_triangular(
                scipy.linalg.cholesky(matrix, lower=True), phi, lower=True
            )
            return FARADS * root.T @ root
        right = phi.copy()
        for k, part in enumerate(parts):
            if part.kind == "diel":
                mine = np.flatnonzero(owner == k)
                rest = np.flatnonzero(owner != k)
                one = Panels(corners[mine])
                sensor = one.fluxes(self.panels)
                flux = np.empty((len(mine), len(body)))
                flux[:, mine] = one.own_fluxes(part.curved)
                if len(rest):
                    flux[:, rest] = one.fluxes(Panels(corners[rest]))
                to_sensor = scipy.linalg.solve_triangular(self.factor, sensor.T, lower=True).T
                # x is minus the charge that a driven electrode calls forth
                matrix[mine] = to_sensor @ half - flux
                inside = 2 * math.pi * (part.eps_r + 1) / (part.eps_r - 1)
                matrix[mine, mine] += inside * one.area
                right[mine] = -to_sensor @ self.half_way
        free = [k for k, p in enumerate(parts) if p.kind != "grounded"]
        n = len(body)
        whole = np.zeros((n + len(free), n + len(free)))
        whole[:n, :n] = matrix
        for t, k in enumerate(free):
            mine = np.flatnonzero(owner == k)
            kind = parts[k].kind
            whole[n + t, mine] = body.area[mine]
            whole[mine, n + t] = body.area[mine]
            if not isinstance(kind, str):
                whole[n + t, n + t] = -kind / FARADS
        right = np.concatenate([right, np.zeros((len(free), right.shape[1]))])
        delta = FARADS * phi.T @ scipy.linalg.solve(whole, right)[:n]
        return (delta + delta.T) / 2


def sizes(points: Array, scale: float, largest: float, smallest: float, share: float) -> Size:
    """Panels as a share of the distance to some points [m], between two bounds."""
    tree = cKDTree(points)
    return lambda x: scale * np.clip(share * tree.query(x, eps=0.1)[0], smallest, largest)
