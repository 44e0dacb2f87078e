"""Where the planes of the online lattice lie, and how its storeys thin out with height.

Planes follow the edges and faces of a design's sheets and layers and spread out with distance from
them. High above the sensor fields are smooth: there, neighbouring planes merge pairwise, storey
after storey, so that most nodes lie where they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from capsense.design.geometry import Surface
from capsense.design.model import Design

Array = NDArray[np.float64]
Groups = list[list[int]]

_LEAN = 2.0
"""Width of merged lines, at most, over the height of the joint: it may lean so far that the links
beside it keep half of their weight (see ``lattice._join_storeys``)."""


@dataclass(frozen=True)
class LatticeSettings:
    """Spacings of the online lattice; all lengths in metres."""

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
    """Edges closer to each other than this share one lattice plane."""
    storey: float = 0.022
    """Height of the first storey above the design's highest part; each one doubles it."""
    thinning: float = 0.35
    """In-plane spacing of a storey, at most, over its height above the design; 0: one storey."""

    def refined(self, factor: float) -> LatticeSettings:
        """Return settings with ``factor`` times as many nodes along each axis."""
        return LatticeSettings(
            self.edge / factor, self.growth / factor, self.far / factor, self.face / factor,
            self.growth_z / factor, self.far_z / factor, self.tall / factor,
            self.merge / max(1.0, factor), self.storey, self.thinning / factor,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """A tensor-product part of the lattice between two heights."""

    axes: tuple[Array, Array, Array]
    """Node coordinates [m]; the first and last of each are walls, or the storeys below and
    above."""
    faces: tuple[Array, Array, Array]
    """Where the cross-section that a node stands for ends, between each node and the next [m]."""
    groups: tuple[Groups, Groups] | None
    """Lines along x and y of the storey below that each inner line goes on from; None: lowest."""


def plan_storeys(design: Design, s: LatticeSettings) -> list[StoreyPlan]:
    """Lay the planes of all storeys, lowest first."""
    x, y, z = plan_axes(design, s)
    top = max([b.surface.bounds[1, 2] for b in design.sheets] + [v.upper[2] for v in design.layers])
    plans: list[StoreyPlan] = []
    lines = [(x, _middles(x)), (y, _middles(y))]
    groups: tuple[Groups, Groups] | None = None
    first, height = 1, s.storey
    while s.thinning > 0.0:
        last = int(np.searchsorted(z, top + height - 1e-9))
        if last > len(z) - 4:
            break
        limit = min(s.thinning * (z[last + 1] - top), _LEAN * (z[last + 1] - z[last]))
        found = [_pair_up(faces, limit) for _, faces in lines]
        if last > first and any(len(g) > 1 for part in found for g in part):
            plans.append(_storey(lines, z, first, last, groups))
            lines = [_merged(*line, part) for line, part in zip(lines, found, strict=True)]
            groups, first = (found[0], found[1]), last + 1
        height *= 2.0
    plans.append(_storey(lines, z, first, len(z) - 2, groups))
    return plans


def _storey(
    lines: list[tuple[Array, Array]],
    z: Array,
    first: int,
    last: int,
    groups: tuple[Groups, Groups] | None,
) -> StoreyPlan:
    own = z[first - 1 : last + 2]
    (x, fx), (y, fy) = lines
    return StoreyPlan((x, y, own), (fx, fy, _middles(own)), groups)


def _middles(c: Array) -> Array:
    return 0.5 * (c[1:] + c[:-1])


def _pair_up(faces: Array, limit: float) -> Groups:
    """Pair neighbouring inner lines whose joint width is at most ``limit``, from both ends inward.

    ``faces`` bound the lines' widths: inner line i, counted from 1, lies between faces i − 1 and i.
    """
    n = len(faces) - 1
    left: Groups = []
    right: Groups = []
    low, high = 1, n
    while high - low >= 3:
        for side, a, b in ((left, low, low + 1), (right, high - 1, high)):
            side.append([a, b] if faces[b] - faces[a - 1] <= limit else [a if side is left else b])
        low += len(left[-1])
        high -= len(right[-1])
    rest = list(range(low, high + 1))
    if len(rest) == 2 and faces[rest[1]] - faces[rest[0] - 1] <= limit:
        middle = [rest]
    else:
        middle = [[i] for i in rest]
    return left + middle + right[::-1]


def _merged(c: Array, faces: Array, groups: Groups) -> tuple[Array, Array]:
    """Lines at the middle of what each group stands for, and the faces between them."""
    width = np.diff(faces)
    inner = [float(np.average(c[g], weights=width[np.array(g) - 1])) for g in groups]
    ends = [faces[0], *(faces[g[-1]] for g in groups)]
    return np.array([c[0], *inner, c[-1]]), np.array(ends)


# -- planes along one axis --------------------------------------------------------------------


def plan_axes(design: Design, s: LatticeSettings) -> tuple[Array, Array, Array]:
    """Lay the planes of the lowest storey along x and y, and all planes along z."""
    lower, upper = design.domain.lower, design.domain.upper
    sheets = [b.surface for b in design.sheets]
    out = []
    for axis in range(3):
        edges = np.concatenate([_sheet_planes(sheet, axis) for sheet in sheets])
        edges = _merge(edges, s.merge, lower[axis], upper[axis])
        faces = np.array([[la.lower[axis], la.upper[axis]] for la in design.layers]).ravel()
        planes = _merge(np.concatenate([edges, faces]), s.merge, lower[axis], upper[axis])
        if axis < 2:
            gaps = np.diff(np.concatenate([[lower[axis]], edges, [upper[axis]]]))
            size = np.clip(0.5 * np.minimum(gaps[1:], gaps[:-1]), 1.2 * s.merge, s.edge)
            growth, far = s.growth, s.far
        else:
            size, growth, far = np.full(len(edges), s.face), s.growth_z, s.far_z
        tall = s.tall if axis == 2 else 0.0
        out.append(_graded(lower[axis], upper[axis], planes, edges, size, growth, far, tall))
    return out[0], out[1], out[2]


def _sheet_planes(sheet: Surface, axis: int) -> Array:
    """Coordinates that lattice planes should follow: edges and faces across an axis, bounds."""
    rims = sheet.rims
    flat = np.abs(rims[:, 0, axis] - rims[:, 1, axis]) < 1e-9
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    # short segments are the facets of an arc, not edges worth a plane of their own
    total: dict[float, float] = {}
    for c, ell in zip(np.round(rims[flat, 0, axis], 9), length[flat], strict=True):
        total[c] = total.get(c, 0.0) + ell
    keep = [c for c, ell in total.items() if ell > 0.002]
    return np.concatenate([keep, sheet.bounds[:, axis]])


def _merge(values: Array, distance: float, lower: float, upper: float) -> Array:
    """Sort, drop what lies on the walls, and replace close groups by their middle."""
    values = np.unique(np.round(values, 9))
    values = values[(values > lower + distance / 2) & (values < upper - distance / 2)]
    groups: list[list[float]] = []
    for v in values:
        if groups and v - groups[-1][0] < distance:
            groups[-1].append(v)
        else:
            groups.append([v])
    return np.array([(g[0] + g[-1]) / 2 for g in groups])


def _graded(
    lower: float,
    upper: float,
    planes: Array,
    edges: Array,
    size: Array,
    growth: float,
    far: float,
    tall: float,
) -> Array:
    """Lay planes through ``planes``, spaced by ``size`` at ``edges`` and growing from there.

    The spacing is at most ``far``, or the fraction ``tall`` of the distance from the edges.
    """
    stops = np.concatenate([[lower], planes, [upper]])
    out = [lower]
    for a, b in pairwise(stops):
        t = np.linspace(a, b, 801)
        mid = 0.5 * (t[1:] + t[:-1])
        away = np.abs(mid[:, None] - edges[None])
        h = (size[None] + growth * away).min(axis=1)
        h = np.minimum(h, np.maximum(far, tall * away.min(axis=1)))
        count = np.concatenate([[0.0], np.cumsum(np.diff(t) / h)])
        n = max(1, int(np.ceil(count[-1] - 0.1)))
        out.extend(np.interp(np.arange(1, n) * count[-1] / n, count, t))
        out.append(b)
    return np.array(out)
