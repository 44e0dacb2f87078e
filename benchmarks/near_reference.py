"""References of ΔC for conductors in the first millimetres, over boards of rectilinear sheets.

``near_map.py --make`` and ``--check`` run it. Boundary elements of the sensor, the domain's walls
and the bodies together, apart from the package's own. All charge is that of sheets in vacuum:
conductors' rows say that the potential is given, those of a layer's faces that the normal
displacement is continuous. With S the sensor's matrix, R what a body's charges do to its rows, B
the potentials of its charges on the body and P the body's own matrix,

    ΔC = Φᵀ (P − B S⁻¹ R)⁻¹ Φ,   Φ = B S⁻¹ U,

so that no difference of two large numbers is taken. Panels of planes that face each other lie on
the same lines, and grow with the distance from edges and from a body's nearest place. Units are
metres, 4π eps0 = 1 inside.

Known limits: electrodes are rectilinear and flat, layers upright boxes; conducting bodies only,
boxes flat or tilted about x or y.
"""

from __future__ import annotations

import json
import math
import time
import tomllib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import shapely
from bem_reference import FARADS, Panels, box_panels, ends, face, graded, revolved, spread
from near_integrals import fluxes, potentials
from numpy.typing import NDArray
from reference_more import profile
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.design import parse_design

Array = NDArray[np.float64]
Row = dict[str, Any]
FEMTO = 1e-15
SCALES, ORDER = (1.7, 1.2), 2.25
"""Panel sizes of the two meshes, and the power of them that errors go with."""
GOOD = 0.006
"""Error of a reference that needs no third mesh."""
AGREE = 0.04
"""Meshes that differ by more than this make no reference."""
LEAST = 0.01
"""Least error of a reference: finite elements of a covered pad are 0.5 to 1 % above."""
GROWTH = 0.45
"""Of panels with the distance from a place where they are small."""
OWN_EDGE, GAP_SHARE, SQUARE = 0.005, 0.35, 0.28
"""Least panels over: a sheet's width; a gap; the root of twice a radius times the gap."""
MOST = 6500
"""Panels of a scene."""


@dataclass(frozen=True)
class Feature:
    """A line across an axis where panels are small along it."""

    axis: int
    at: float
    low: float
    """Its ends along the other axis [m]."""
    high: float
    z: float
    least: float


# -- the sensor's planes --------------------------------------------------------------------------


class Layout:
    """A design's sheets and layers, and what a place of a horizontal plane is."""

    def __init__(self, design: cs.Design) -> None:
        self.design = design
        self.sheets: list[tuple[float, shapely.Polygon, int]] = []
        for k, sheet in enumerate(design.sheets):
            owner = k if k < len(design.electrodes) else -1
            for facet in sheet.surface.facets:
                if abs(facet.axes[2, 2]) < 0.999:
                    raise ValueError(f"{sheet.name} is not horizontal")
                if abs(facet.axes[0, 0] - 1) > 1e-9:
                    raise ValueError(f"{sheet.name} has axes of its own")
                moved = shapely.affinity.translate(facet.polygon, *facet.origin[:2])
                self.sheets.append((float(facet.origin[2]), moved, owner))
        heights = [z for z, *_ in self.sheets]
        heights += [float(v[2]) for k in design.layers for v in (k.lower, k.upper)]
        self.heights = sorted({round(z, 9) for z in heights})
        self.top = max(self.heights)

    def edges(self) -> list[tuple[float, Array, float]]:
        """Height, ends (2, 2), and the sheet's width at each edge of a sheet."""
        out = []
        for z, polygon, _ in self.sheets:
            for ring in (polygon.exterior, *polygon.interiors):
                points = np.asarray(ring.coords)
                width = float(np.ptp(points, axis=0).min())
                out += [(z, points[i : i + 2], width) for i in range(len(points) - 1)]
        return out

    def eps(self, x: float, y: float, z: float) -> float:
        """Permittivity at a point."""
        for layer in self.design.layers:
            if ((layer.lower < (x, y, z)) & (layer.upper > (x, y, z))).all():
                return layer.eps_r
        return 1.0

    def owner(self, x: float, y: float, z: float) -> int | None:
        """Electrode there, −1 for ground, None where nothing conducts."""
        for height, polygon, owner in self.sheets:
            if abs(height - z) < 1e-8 and polygon.contains(shapely.Point(x, y)):
                return owner
        return None


def stops(layout: Layout, body: Array | None) -> tuple[Array, Array]:
    """Lines along x and y that every plane has: edges of sheets and layers and a flat box's."""
    points = [e for _, e, _ in layout.edges()]
    points += [np.stack([k.lower[:2], k.upper[:2]]) for k in layout.design.layers]
    points += [body] if body is not None else []
    both = np.concatenate(points)
    return tuple(np.unique(np.round(both[:, k], 9)) for k in (0, 1))  # type: ignore[return-value]


def wanted(features: list[Feature], axis: int, x: Array, across: Array, z: float,
           scale: float) -> Array:  # fmt: skip
    """Panel size along an axis at x, in a strip ``across`` (2,) of the other one."""
    mine = [f for f in features if f.axis == axis]
    at, low, high, height, least = np.array([(f.at, f.low, f.high, f.z, f.least) for f in mine]).T
    side = np.maximum(0, np.maximum(low - across[1], across[0] - high))
    away = np.sqrt((x[:, None] - at) ** 2 + side**2 + (z - height) ** 2)
    return scale * (scale * least + GROWTH * away).min(axis=1)


def lines(features: list[Feature], axis: int, span: Array, across: Array, z: float,
          scale: float) -> Array:  # fmt: skip
    """Cuts of a span: those of the densest plane, thinned where this one may be coarser."""
    flat = [Feature(f.axis, f.at, f.low, f.high, 0.0, f.least) for f in features]
    fine = spread(span, lambda x: wanted(flat, axis, x, across, 0.0, scale))
    middle = (fine[1:] + fine[:-1]) / 2
    count = np.diff(fine) / wanted(features, axis, middle, across, z, scale)
    keep, total = [0], 0.0
    for k in range(len(count)):
        total += count[k]
        if total > 0.7:
            keep.append(k + 1)
            total = 0.0
    if keep[-1] != len(fine) - 1:
        if len(keep) > 1 and total < 0.4:
            keep.pop()
        keep.append(len(fine) - 1)
    return fine[keep]


def cells(features: list[Feature], xs: Array, ys: Array, z: float, scale: float) -> list[Array]:
    """Panels, facing up, of every cell of the stops, (n, 4, 3) each, x by x."""
    out = []
    for x in pairwise(xs):
        for y in pairwise(ys):
            u = lines(features, 0, np.array(x), np.array(y), z, scale)
            v = lines(features, 1, np.array(y), np.array(x), z, scale)
            out.append(face(2, 1.0, u, v) + np.array([0, 0, z - 1.0]))
    return out


def upright(features: list[Feature], lower: Array, upper: Array, scale: float,
            rows: Array, xy: tuple[Array, Array]) -> Array:  # fmt: skip
    """The four sides of a box, facing out, at heights ``rows``; ``xy`` are stops inside."""
    out = []
    for axis in (0, 1):
        other = 1 - axis
        span = xy[other]
        span = span[(span > lower[other] - 1e-9) & (span < upper[other] + 1e-9)]
        for at, sign in ((lower[axis], -1.0), (upper[axis], 1.0)):
            cuts = [
                lines(features, other, np.array(s), np.array([at, at]), float(rows[0]), scale)
                for s in pairwise(span)
            ]
            along = np.concatenate([c[:-1] for c in cuts] + [cuts[-1][-1:]])
            u, v = (along, rows) if axis == 0 else (rows, along)
            panels = face(axis, sign, u, v)
            panels[..., axis] = at
            out.append(panels)
    return np.concatenate(out)


# -- the body -------------------------------------------------------------------------------------


def lowest(body: Row) -> Array:
    """Depth of each corner or end below the centre: the lowest point [m] in the sensor frame."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    size, at = np.array(body["size"]), np.array(body["position"])
    if body["shape"] == "box":
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * size / 2 @ turn.T
        low = corners[:, 2] < corners[:, 2].min() + 1e-9
        return at + corners[low].mean(axis=0)
    length = size[1] if body["shape"] == "capsule" else 0.0
    end = turn[:, 2] * length / 2 * (-1 if turn[2, 2] >= 0 else 1)
    if abs(turn[2, 2]) < 1e-6:
        end = np.zeros(3)
    return at + end - [0, 0, size[0]]


def is_flat(body: Row) -> bool:
    """Whether it is a box with faces along the axes."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    return body["shape"] == "box" and np.abs(turn - np.eye(3)).max() < 1e-6


def features_of(layout: Layout, body: Row | None) -> list[Feature]:
    """Where panels of horizontal planes are small."""
    out = []
    gap, foot = math.inf, np.zeros((2, 2))
    if body is not None:
        low = lowest(body)
        gap = max(low[2] - layout.top, 1e-5)
        foot = footprint(body)
    for z, ends_, width in layout.edges():
        axis = int(abs(ends_[1, 0] - ends_[0, 0]) > 1e-9)  # x is constant along it: 0
        reach = np.sort(ends_[:, 1 - axis])
        least = OWN_EDGE * width
        box = np.stack([ends_.min(axis=0), ends_.max(axis=0)])
        away = np.linalg.norm(np.maximum(0, np.maximum(box[0] - foot[1], foot[0] - box[1])))
        if body is not None:
            least = min(least, GAP_SHARE * (gap + layout.top - z) + 0.2 * away)
        out.append(Feature(axis, float(ends_[0, axis]), *reach.tolist(), z, least))
    for layer in layout.design.layers:
        thick = float(layer.upper[2] - layer.lower[2])
        for axis in (0, 1):
            for at in (layer.lower[axis], layer.upper[axis]):
                out.append(Feature(axis, float(at), float(layer.lower[1 - axis]),
                                   float(layer.upper[1 - axis]), float(layer.upper[2]),
                                   0.4 * thick))  # fmt: skip
    if body is None:
        return out
    sheets = [np.asarray(p.exterior.coords) for _, p, owner in layout.sheets if owner >= 0]
    if body["shape"] == "box":
        low_edges = foot if is_flat(body) else low_strip(body)
        for axis in (0, 1):
            for at in np.unique(low_edges[:, axis]):
                low_x, high_x = low_edges[:, 1 - axis]
                a, b = np.zeros(2), np.zeros(2)
                a[axis] = b[axis] = at
                a[1 - axis], b[1 - axis] = low_x, high_x
                edge = shapely.LineString([a, b])
                away = min(edge.distance(shapely.Polygon(s)) for s in sheets)
                least = min(GAP_SHARE * gap, 0.04 * min(body["size"][:2])) + 0.2 * away
                out.append(Feature(axis, float(at), float(low_x), float(high_x), float(low[2]),
                                   least))  # fmt: skip
    else:
        least = min(SQUARE * math.sqrt(2 * body["size"][0] * gap), SQUARE * body["size"][0])
        turn = Rotation.from_quat(body["quaternion"]).as_matrix()
        reach = np.zeros(2)
        if body["shape"] == "capsule" and abs(turn[2, 2]) < 0.02:
            reach = np.abs(turn[:2, 2]) * body["size"][1] / 2
        for axis in (0, 1):
            mine = float(low[axis])
            spots = {mine - reach[axis], mine, mine + reach[axis]}
            for at in spots:
                out.append(Feature(axis, float(at), low[1 - axis] - reach[1 - axis],
                                   low[1 - axis] + reach[1 - axis], layout.top, least))  # fmt: skip
    return out


def low_strip(body: Row) -> Array:
    """Ends (2, 2) of a tilted box's lowest edge in x and y [m]."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    size, at = np.array(body["size"]), np.array(body["position"])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * size / 2 @ turn.T + at
    low = corners[corners[:, 2] < corners[:, 2].min() + 1e-9]
    return np.round(np.stack([low[:, :2].min(axis=0), low[:, :2].max(axis=0)]), 9)


def footprint(body: Row) -> Array:
    """Bounds (2, 2) in x and y [m]."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    size, at = np.array(body["size"]), np.array(body["position"])[:2]
    if body["shape"] == "box":
        half = (np.abs(turn) @ size / 2)[:2]
    else:
        length = size[1] if body["shape"] == "capsule" else 0.0
        half = size[0] + np.abs(turn[:2, 2]) * length / 2
    return np.round(np.stack([at - half, at + half]), 9)


def body_panels(layout: Layout, body: Row, features: list[Feature], scale: float,
                xy: tuple[Array, Array]) -> Array:  # fmt: skip
    """A body's panels in the sensor frame, facing out."""
    size, at = np.array(body["size"]), np.array(body["position"])
    low = lowest(body)
    gap = max(low[2] - layout.top, 1e-5)
    if is_flat(body):
        lower, upper = np.round(at - size / 2, 9), np.round(at + size / 2, 9)
        xs, ys = (s[(s >= lower[k]) & (s <= upper[k])] for k, s in enumerate(xy))
        bottom = np.concatenate(cells(features, xs, ys, float(lower[2]), scale))[:, ::-1]
        rough = 0.05 * min(size[:2])
        own = [
            Feature(axis, float(b[axis]), *(float(v[1 - axis]) for v in (lower, upper)),
                    float(upper[2]), rough)
            for axis in (0, 1) for b in (lower, upper)
        ]  # fmt: skip
        one = tuple(np.array([a, b]) for a, b in zip(lower, upper, strict=True))[:2]
        top = np.concatenate(cells(own, *one, float(upper[2]), scale))
        least = min(GAP_SHARE * gap, 0.2 * size[2])

        def tall(z: Array) -> Array:
            down, up = z - lower[2], upper[2] - z
            return scale * np.minimum(2 * least + GROWTH * down, 0.2 * size[2] + GROWTH * up)

        rows = spread(np.array([lower[2], upper[2]]), tall)
        wide = [Feature(f.axis, f.at, f.low, f.high, f.z, 3 * f.least) for f in features]
        return np.concatenate([bottom, top, upright(wide, lower, upper, scale, rows, (xs, ys))])
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    samples = []
    for _, e, _ in layout.edges():
        n = max(2, min(400, math.ceil(np.linalg.norm(e[1] - e[0]) / 5e-4)))
        samples.append(e[0] + np.linspace(0, 1, n)[:, None] * (e[1] - e[0]))
    tree = cKDTree(np.concatenate(samples))

    def fine(local: Array) -> tuple[Array, Array]:
        points = local @ turn.T + at
        up = np.maximum(points[:, 2] - layout.top, gap)
        return up, 0.4 * up + GROWTH * tree.query(points[:, :2], eps=0.05)[0]

    if body["shape"] == "box":
        half = size / 2
        about_y = abs(turn[2, 0]) > 1e-6
        edge = -np.sign(turn[2, 0 if about_y else 1]) * half[0 if about_y else 1]
        nowhere = np.array([1e3])
        places = (np.array([edge]), nowhere) if about_y else (nowhere, np.array([edge]))
        rims = (*places, scale * GAP_SHARE * gap)

        def flat_size(local: Array) -> Array:
            return scale * np.minimum(fine(local)[1], 0.3 * size.max())

        corners = box_panels(half, flat_size, 10 / scale, rims)
        return corners @ turn.T + at
    radius = size[0]

    def size_of(local: Array) -> Array:
        up, edge = fine(local)
        return scale * np.minimum(np.minimum(SQUARE * np.sqrt(2 * radius * up), edge), radius / 2)

    outline, corners_at = profile(body["shape"], list(size))
    total = math.pi * radius + (size[1] if body["shape"] == "capsule" else 0.0)
    corners, _ = revolved(outline, np.array([0, *corners_at, total]), size_of)
    return corners @ turn.T + at


# -- solution -------------------------------------------------------------------------------------


def sensor_panels(layout: Layout, features: list[Feature], xy: tuple[Array, Array],
                  scale: float) -> tuple[Array, Array, Array]:  # fmt: skip
    """Panels, whose they are (−1: ground, −2: a layer's face), and permittivities (n, 2)."""
    parts: list[Array] = []
    owners: list[int] = []
    eps: list[tuple[float, float]] = []

    def add(corners: Array, owner: int, front: float, back: float) -> None:
        parts.append(corners)
        owners.extend([owner] * len(corners))
        eps.extend([(front, back)] * len(corners))

    xs, ys = xy
    middles = [(x, y) for x in (xs[1:] + xs[:-1]) / 2 for y in (ys[1:] + ys[:-1]) / 2]
    for z in layout.heights:
        kinds = []
        for x, y in middles:
            owner = layout.owner(x, y, z)
            front, back = layout.eps(x, y, z + 1e-7), layout.eps(x, y, z - 1e-7)
            kinds.append((-2 if owner is None else owner, front, back))
        for corners, (owner, front, back) in zip(
            cells(features, xs, ys, z, scale), kinds, strict=True
        ):
            if owner > -2 or front != back:
                add(corners, owner, front, back)
    for layer in layout.design.layers:
        thick = layer.upper[2] - layer.lower[2]
        n = max(2, round(4 / scale))
        rows = layer.lower[2] + thick * (1 - np.cos(np.linspace(0, math.pi, n + 1))) / 2
        add(upright(features, layer.lower, layer.upper, scale, rows, xy), -2, 1.0, layer.eps_r)
    low, high = layout.design.domain.lower, layout.design.domain.upper
    if not layout.design.domain.open:
        half, middle = (high - low) / 2, (high + low) / 2
        cuts = [spread(ends(h), graded(h, 8 / scale, 1.4)) for h in half]
        bottom = -half[2] + np.array([0.0, 0.012, 0.035])
        heights = np.concatenate([bottom, cuts[2][cuts[2] > bottom[-1] + 0.015]])
        for axis in (0, 1):
            u = {0: cuts[0], 1: cuts[1], 2: heights}
            for side in (-half[axis], half[axis]):
                add(face(axis, side, u[(axis + 1) % 3], u[(axis + 2) % 3]) + middle, -1, 1.0, 1.0)
        add(face(2, half[2], cuts[0], cuts[1]) + middle, -1, 1.0, 1.0)
    return np.concatenate(parts), np.array(owners), np.array(eps)


def solve(design: cs.Design, bodies: list[Row], scale: float) -> tuple[Array, int, int]:
    """ΔC [F] of one or more bodies, the nearest first, and panels of the sensor and of these."""
    layout = Layout(design)
    flat = np.concatenate([footprint(b) for b in bodies if is_flat(b)] or [np.zeros((0, 2))])
    xy = stops(layout, flat if len(flat) else None)
    features = features_of(layout, None)
    for body in bodies:
        features = merged(features, features_of(layout, body))
    corners, owner, eps = sensor_panels(layout, features, xy, scale)
    mine = [body_panels(layout, b, features, scale, xy) for b in bodies]
    whose = np.repeat(np.arange(len(bodies)), [len(m) for m in mine])
    floor = np.array([0, 0, design.domain.floor])
    sensor, body = Panels(corners - floor), Panels(np.concatenate(mine) - floor)
    floating = [b["kind"] == "floating" for b in bodies]
    if len(sensor) + len(body) > MOST:
        raise ValueError(f"{len(sensor)} and {len(body)} panels")
    return change(sensor, owner, eps, body, whose, floating), len(sensor), len(body)


def change(sensor: Panels, owner: Array, eps: Array, body: Panels, whose: Array,
           floating: list[bool]) -> Array:  # fmt: skip
    """ΔC [F] by bodies over a sensor; both above the floor z = 0. See ``sensor_panels``."""
    held = np.flatnonzero(owner > -2)
    faces = np.flatnonzero(owner == -2)
    conductors = Panels(sensor.corners[held])
    matrix = np.empty((len(sensor), len(sensor)))
    across = np.empty((len(body), len(sensor)))
    right = np.empty((len(sensor), len(body)))
    matrix[np.ix_(held, held)] = potentials(conductors, conductors)
    across[:, held] = potentials(body, conductors)
    right[held] = across[:, held].T
    if len(faces):
        layers = Panels(sensor.corners[faces])
        matrix[np.ix_(held, faces)] = potentials(conductors, layers)
        matrix[np.ix_(faces, held)] = fluxes(layers, conductors)
        own = fluxes(layers, layers)
        front, back = eps[faces].T
        own[np.diag_indices(len(faces))] += (
            2 * math.pi * (front + back) / (front - back) * layers.area
        )
        matrix[np.ix_(faces, faces)] = own
        across[:, faces] = potentials(body, layers)
        right[faces] = fluxes(layers, body)
    unit = np.zeros((len(sensor), int(owner.max()) + 1))
    driven = np.flatnonzero(owner >= 0)
    unit[driven, owner[driven]] = sensor.area[driven]
    factor = scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)
    answer = scipy.linalg.lu_solve(factor, np.hstack([right, unit]), check_finite=False)
    n = len(body)
    phi = across @ answer[:, n:]
    free = np.flatnonzero(floating)
    matrix = potentials(body, body) - across @ answer[:, :n]
    return induced(matrix, phi, phi, [body.area * (whose == k) for k in free])


def induced(matrix: Array, phi: Array, potential: Array, free: list[Array]) -> Array:
    """ΔC [F] by the charges on n panels of bodies, of which some conductors float.

    Args:
        matrix: What the panels meet of each other, shape (n, n).
        phi: What they meet with each of t terminals at 1 V, shape (n, t).
        potential: The potential there, shape (n, t).
        free: For each floating conductor the areas of its panels, 0 for others, shape (n,).
    """
    n, count = len(matrix), len(free)
    whole = np.zeros((n + count, n + count))
    whole[:n, :n] = matrix
    for t, areas in enumerate(free, start=n):
        whole[t, :n] = whole[:n, t] = areas
    given = np.concatenate([phi, np.zeros((count, phi.shape[1]))])
    delta = FARADS * potential.T @ np.linalg.solve(whole, given)[:n]
    return (delta + delta.T) / 2


def merged(one: list[Feature], two: list[Feature]) -> list[Feature]:
    """All features; of two at a place, the one with smaller panels."""
    out: dict[tuple[float, ...], Feature] = {}
    for f in (*one, *two):
        key = (f.axis, round(f.at, 9), round(f.low, 9), round(f.high, 9), round(f.z, 9))
        if key not in out or f.least < out[key].least:
            out[key] = f
    return list(out.values())


def referenced(design: cs.Design, case: Row) -> Row:
    """The case with ΔC [fF], extrapolated from two meshes, and what that adds as its error.

    "meshes" is the difference of the two; both are largest entries over the largest entry. A third
    mesh follows where the error is above ``GOOD`` and the panels are few enough.
    """
    started = time.perf_counter()
    scales = list(SCALES)
    coarse, *_ = solve(design, case["bodies"], scales[0])
    fine, *panels = solve(design, case["bodies"], scales[1])
    grown = (scales[0] / scales[1]) ** ORDER - 1
    if np.abs(fine - coarse).max() > GOOD * grown * np.abs(fine).max():
        next_scale = scales[1] ** 2 / scales[0]
        try:
            finer, *more = solve(design, case["bodies"], next_scale)
        except ValueError:
            pass
        else:
            coarse, fine, panels = fine, finer, more
            scales = [scales[1], next_scale]
    best = fine + (fine - coarse) / grown
    largest = np.abs(best).max()
    return {
        **case, "delta_fF": [[float(f"{v:.5g}") for v in row] for row in best / FEMTO],
        "mesh": f"near_reference {scales[0]:.3g}/{scales[1]:.3g}",
        "error": round(float(np.abs(best - fine).max() / largest), 4),
        "meshes": round(float(np.abs(fine - coarse).max() / largest), 4), "panels": panels,
        "seconds": round(time.perf_counter() - started, 1),
    }  # fmt: skip


# -- checks ---------------------------------------------------------------------------------------

CHECKED = (
    "bare5 ball10 g1", "bare5 sheet60 g1", "pad10 sheet100 g1", "pad10 sheet100 g2",
    "pad10 finger g0.5", "pad10 cubeedge g1", "pad10c01 ball10 g0.4", "pad10c01 sheet100 g1",
    "pad3 sheet30 g1", "pour10 ball10 g1", "pour10 sheet100 g1", "stripes1 ball10 g1",
    "stripes1 sheet100 g3", "6pb ball10 g0.3", "pad30 floatsheet60 g1",
)  # fmt: skip
"""Scenes of ``near_map.json`` that others have computed."""
FINITE_ELEMENTS = {"pad10 sheet100 g1": 690.7, "pad10 sheet100 g2": 264.5}
"""Largest entries by three-dimensional finite elements [fF]; from the note of that file."""


def polar(radius: float, z: float, least: float, scale: float, up: float) -> Array:
    """Panels of a disc, small at its rim, facing up or down."""

    def size(r: Array) -> Array:
        return scale * np.minimum(scale * least + 0.3 * (radius - r), 0.15 * radius)

    cuts = spread(np.array([0.0, radius]), size)
    turns = np.linspace(0, 2 * math.pi, 4 * round(10 / scale) + 1)
    # polygons of the disc's area
    grown = math.sqrt(2 * math.pi / (len(turns) - 1) / math.sin(2 * math.pi / (len(turns) - 1)))
    x, y = (grown * cuts[:, None] * f(turns) for f in (np.cos, np.sin))
    nodes = np.stack([x, y, 0 * x + z], axis=-1)
    corners = np.stack([nodes[:-1, :-1], nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:]], axis=2)
    corners = corners.reshape(-1, 4, 3)
    return corners if up > 0 else corners[:, ::-1]


def exact_discs(k: float, scale: float) -> float:
    """Love's C11 over 8 eps0 R by these integrals: a disc, and what an equal grounded one adds."""
    radius, up = 0.04, 1e5  # ground is far away
    least = min(0.005, GAP_SHARE * k) * radius
    one = polar(radius, up, least, scale, 1)
    two = polar(radius, up + k * radius, least, scale, -1)
    sensor, body = Panels(one), Panels(two)
    owner, eps = np.zeros(len(one), dtype=int), np.ones((len(one), 2))
    whose = np.zeros(len(two), dtype=int)
    unit = 2 / math.pi * radius * FARADS
    return 1.0 + float(change(sensor, owner, eps, body, whose, [False])[0, 0]) / unit


def check(cases: list[Row], design_of: Any, discs: list[tuple[float, float, float]]) -> None:
    """Print how far these references are from others."""
    for k, own, _ in discs:
        if k in (0.02, 0.05, 0.25, 1.0):
            coarse, fine = (exact_discs(k, s) for s in SCALES)
            best = fine + (fine - coarse) / ((SCALES[0] / SCALES[1]) ** ORDER - 1)
            print(f"Love's discs, k {k:g}: ΔC {100 * ((best - 1) / (own - 1) - 1):+.2f} %, adds "
                  f"{100 * (best - fine) / (own - 1):.2f} %", flush=True)  # fmt: skip
    for case in cases:
        if case["category"] not in CHECKED:
            continue
        try:
            mine = referenced(design_of(case["design"]), case)
        except ValueError as error:
            print(f"{case['category']:24s} {error}")
            continue
        best, known = np.array(mine["delta_fF"]), np.array(case["delta_fF"])
        k = int(np.diag(known).argmax())
        off = np.abs(best - known).max() / known.max()
        text = f"{case['category']:24s} {best[k, k] / known[k, k] - 1:+8.2%}, any entry {off:6.2%}"
        if case["category"] in FINITE_ELEMENTS:
            text += (
                f"; from finite elements {best[k, k] / FINITE_ELEMENTS[case['category']] - 1:+.2%}"
            )
        print(f"{text}; adds {mine['error']:.2%}, panels {mine['panels']}, {mine['seconds']} s",
              flush=True)  # fmt: skip


# -- random designs and scenes --------------------------------------------------------------------

KINDS = ("board", "array", "pour", "stripes", "covered board", "covered pads", "large pad",
         "covered pour")  # fmt: skip
STEP = 1e-4
"""Grid of sheets' places [m]; bodies lie half a step off it."""


def _round(value: float, step: float = STEP) -> float:
    return round(round(value / step) * step, 7)


def random_design(name: str, kind: str, rng: np.random.Generator) -> str:
    """A design's text."""
    size = _round(rng.uniform(0.3, 0.6), 0.01)
    back = _round(rng.uniform(0.006, 0.03), 0.001)

    def width(low: float, high: float) -> float:
        return _round(math.exp(rng.uniform(math.log(low), math.log(high))), 2 * STEP)

    pads: list[tuple[float, float, float, float]] = []
    if kind == "stripes":
        w, pitch, length = width(1e-3, 4e-3), 0.0, width(0.02, 0.05)
        pitch, n = _round(w * rng.uniform(1.5, 2.2)), int(rng.integers(3, 5))
        pads = [(_round((k - (n - 1) / 2) * pitch), 0.0, w, length) for k in range(n)]
    else:
        w = width(0.035, 0.06) if kind == "large pad" else width(0.002, 0.025)
        h = _round(w * rng.uniform(0.7, 1.4), 2 * STEP)
        nx = 1 if kind == "large pad" else int(rng.integers(1, 3))
        ny = 2 if kind == "array" else 1
        nx = 2 if "pour" in kind or kind == "array" else nx
        gap = _round(max(1e-3, w * rng.uniform(0.15, 0.6)), 2 * STEP)
        along, up = ([_round((k - (n - 1) / 2) * (a + gap)) for k in range(n)]
                     for n, a in ((nx, w), (ny, h)))  # fmt: skip
        pads = [(x, y, w, h) for x in along for y in up]
    out = [f'name="{name}"\n[domain]\nsize=[{size},{size},{size}]\nbackplane={back}']
    for k, (x, y, w, h) in enumerate(pads):
        out.append(f'[[electrode]]\nname="E{k + 1}"\nshape="rectangle"\nsize=[{w},{h}]\n'
                   f"center=[{x},{y},0.0]")  # fmt: skip
    margin = _round(rng.uniform(0.003, 0.012))
    across = [
        round(2 * max(abs(p[k]) + p[k + 2] / 2 for p in pads) + 2 * margin, 7) for k in (0, 1)
    ]
    thick = float(rng.choice([0.0005, 0.0008, 0.001, 0.0016]))
    area = f"size=[{across[0]},{across[1]}]"
    if "board" in kind or "pour" in kind:
        out.append(f'[[layer]]\nname="board"\neps_r=4.5\n{area}\nz=[{-thick},0.0]')
    if "board" in kind:
        out.append(f'[[conductor]]\nname="gnd"\nrole="ground"\nshape="rectangle"\n{area}\n'
                   f"center=[0.0,0.0,{-thick}]")  # fmt: skip
    if "pour" in kind:
        clear = _round(rng.uniform(3e-4, 1e-3))
        out.append(f'[[conductor]]\nname="pour"\nrole="ground"\nshape="rectangle"\n{area}\n'
                   f"center=[0.0,0.0,0.0]\nclearance={clear}")  # fmt: skip
    if "covered" in kind:
        cover = float(f"{math.exp(rng.uniform(math.log(1e-4), math.log(2e-3))):.2g}")
        eps = round(float(rng.uniform(2.2, 7.0)), 1)
        out.append(f'[[layer]]\nname="cover"\neps_r={eps}\n{area}\nz=[0.0,{cover}]')
    return "\n".join(out) + "\n"


def random_body(design: cs.Design, kind: str, rng: np.random.Generator) -> Row:
    """A conductor whose lowest place is above one of the electrodes or beside it."""
    layout = Layout(design)
    bounds = np.array([e.surface.bounds for e in design.electrodes])[:, :, :2]
    one = bounds[rng.integers(len(bounds))]
    room = design.domain.upper[2]
    spot = one.mean(axis=0) + rng.uniform(-0.6, 0.6, 2) * (one[1] - one[0])
    spot = np.array([_round(v) + STEP / 2 for v in spot])

    def log(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    gap = float(f"{log(1e-4 if kind == 'sheet' else 5e-5, 5e-3):.2g}")
    turn = Rotation.identity()
    if kind in ("sheet", "tilted box"):
        shape, size = "box", [_round(log(0.008, 0.1), 2 * STEP), _round(log(0.008, 0.1), 2 * STEP),
                              _round(log(0.002, 0.02), 2 * STEP)]  # fmt: skip
        if kind == "tilted box":
            angle = math.radians(log(2, 40)) * rng.choice([-1, 1])
            turn = Rotation.from_euler(str(rng.choice(["x", "y"])), angle)
    elif kind == "ball":
        shape, size = "sphere", [_round(log(0.004, 0.04))]
    else:
        shape, size = "capsule", [_round(log(0.004, 0.015)), _round(log(0.02, 0.06))]
        lean = float(rng.choice([0.0, math.radians(rng.uniform(15, 75)), math.pi / 2]))
        turn = Rotation.from_euler(str(rng.choice(["x", "y"])), lean)
    out = {"shape": shape, "size": size, "position": [0.0, 0.0, 0.0],
           "quaternion": [round(float(v), 9) for v in turn.as_quat()],
           "kind": "floating" if rng.random() < 0.25 else "grounded", "eps_r": 1.0}  # fmt: skip
    low = lowest(out)
    shift = spot if kind != "sheet" else np.array([_round(v) + STEP / 2 for v in spot * 1.5])
    at = [*(shift if kind == "sheet" else shift - low[:2]), layout.top + gap - low[2]]
    out["position"] = [round(float(v), 9) for v in at]
    if out["position"][2] - low[2] > room - 0.01:
        raise ValueError("too high")
    return out


BODIES = ("sheet", "ball", "finger", "tilted box", "ball", "finger", "sheet")


def make(count: int, seed: int, path: Path, first: int = 0, each: int = 5) -> None:
    """Write ``count`` scenes over random designs, ``each`` over one, that two meshes agree on."""
    note = (
        "Conductors in the first millimetres over random designs; written by "
        f"benchmarks/near_map.py --make {count} --seed {seed}. ΔC [fF], Maxwell form, by "
        "boundary elements (near_reference.py), extrapolated from two meshes; error: what that "
        "adds, meshes: their difference, over the largest entry. Scenes whose meshes differ by "
        "more than 4 %, or need too many panels, are left out. least_error: of any of them. "
        "designs: their files."
    )
    designs: dict[str, str] = {}
    cases: list[Row] = []
    number = first
    while len(cases) < count:
        kind = KINDS[number % len(KINDS)]
        rng = np.random.default_rng([seed, number])
        name = f"{kind.replace(' ', '_')}_{seed}_{number}"
        text = random_design(name, kind, rng)
        number += 1
        try:
            design = parse_design(tomllib.loads(text))
        except cs.CapSenseError as error:
            print(f"{name}: {error}", flush=True)
            continue
        for k in range(each):
            what = BODIES[(number + k) % len(BODIES)]
            try:
                body = random_body(design, what, rng)
                gap = 1e3 * (body["position"][2] + (lowest(body)[2] - body["position"][2])
                             - Layout(design).top)  # fmt: skip
                case = {"design": name, "category": f"{name} {what} {body['kind']} g{gap:.3g}",
                        "bodies": [body]}  # fmt: skip
                case = referenced(design, case)
            except ValueError as error:
                print(f"{name} {what}: left out, {error}", flush=True)
                continue
            print(f"{case['category']}: {np.abs(case['delta_fF']).max():.5g} fF, meshes "
                  f"{case['meshes']:.2%}, error {case['error']:.2%}, panels {case['panels']}, "
                  f"{case['seconds']} s", flush=True)  # fmt: skip
            if case["meshes"] <= AGREE:
                designs[name] = text
                cases.append(case)
                write(path, note, designs, cases)
            if len(cases) >= count:
                break


def write(path: Path, note: str, designs: dict[str, str], cases: list[Row]) -> None:
    """The file, a design and a case a line."""
    rows = ",\n".join(f"  {json.dumps(c)}" for c in cases)
    texts = ",\n".join(f"  {json.dumps(n)}: {json.dumps(t)}" for n, t in designs.items())
    head = f' "note": {json.dumps(note, ensure_ascii=False)},\n "least_error": {LEAST},\n'
    path.write_text(
        f'{{\n{head} "designs": {{\n{texts}\n }},\n "cases": [\n{rows}\n ]\n}}\n',
        encoding="utf-8",
    )
