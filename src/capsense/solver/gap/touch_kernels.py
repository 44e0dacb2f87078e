"""Contact mechanics of the cover of a flat design, compiled: undersides, forces and depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense._by_reference import by_reference
from capsense._jit import compiled, kernel
from capsense.cover import Cover
from capsense.design.geometry import Surface
from capsense.solver.bodies.outline import middle_height, nearest, reach_down

STEPS = 60
"""Steps up to a surface at most."""
COARSE, FINE = 16, 32
"""Cells along each side of the grid that finds a contact, and of that which it is integrated on."""
EXACT = 1e-4
"""How exactly heights are found, over the cover's thickness."""
_RASTER = 32
"""Cells along each side of the raster that an electrode's outline is kept on."""
_ROUNDING = 1e-12
"""Areas in common with an electrode, over its own, that are no more than this are rounding."""
_BISECTIONS = 200
"""Bisections at most; double precision is reached before."""


@by_reference
class Foundation(NamedTuple):
    """A cover as an elastic foundation, and the outlines of the electrodes below it.

    Lengths are in the length unit of the design.
    """

    lower: NDArray[Any]
    """Lower corner, shape (3,)."""
    upper: NDArray[Any]
    """Upper corner, undeformed, shape (3,)."""
    strain: NDArray[Any]
    stress: NDArray[Any]
    """Table of strains and pressures [N per square unit], shape (n,) each."""
    low: NDArray[Any]
    """Lower corner of each electrode, shape (m, 2)."""
    high: NDArray[Any]
    """Upper corner, shape (m, 2)."""
    sums: NDArray[Any]
    """Its area below and left of the corners of a raster of it, shape (m, n + 1, n + 1)."""


def foundation(cover: Cover, electrodes: Sequence[Surface], unit: float) -> Foundation:
    """The foundation of a cover on level electrodes, in a length unit [m], as kernels take it."""
    sums = np.zeros((len(electrodes), _RASTER + 1, _RASTER + 1))
    bounds = np.array([surface.bounds[:, :2] for surface in electrodes], float)
    for k, surface in enumerate(electrodes):
        points, size = np.empty((_RASTER**2, 2)), np.empty(2)
        _grid(bounds[k, 0], bounds[k, 1], points, size)
        inside, area = np.zeros(len(points), bool), 0.0
        for facet in surface.facets:
            outline = facet.footprint
            inside |= shapely.contains_xy(outline, points[:, 0], points[:, 1])
            area += outline.area
        cells = inside.reshape(_RASTER, _RASTER) * (area / max(int(inside.sum()), 1))
        sums[k, 1:, 1:] = cells.cumsum(axis=0).cumsum(axis=1)
    return Foundation(
        np.array(cover.lower, float), np.array(cover.upper, float),
        np.array(cover.law.strain, float), unit**2 * np.array(cover.law.stress, float),
        np.ascontiguousarray(bounds[:, 0]), np.ascontiguousarray(bounds[:, 1]), sums,
    )  # fmt: skip


def no_foundation() -> Foundation:
    """What designs without a cover have."""
    none, few = np.zeros(0), np.zeros((0, 2))
    return Foundation(np.zeros(3), np.zeros(3), none, none, few, few, np.zeros((0, 1, 1)))


@compiled
def undersides(
    bodies: NDArray[np.void], points: NDArray[Any], highest: float, exact: float
) -> NDArray[Any]:
    """Heights of the lowest point of any of some bodies above points (k, 2) of a plane [m].

    Infinite where there is none below ``highest`` [m]. Found by stepping up by the distance to the
    nearest point (sphere tracing; J. C. Hart, *The Visual Computer* 12, 1996).

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY` with outlines, shape (b,).
        points: Where [m], shape (k, 2).
        highest: Where the search ends [m].
        exact: How exactly the surface is found [m].
    """
    out = np.empty(points.shape[0])
    point, room = np.empty(9), np.empty(140)
    low = math.inf
    for b in range(bodies.shape[0]):
        low = min(low, middle_height(bodies[b]) - reach_down(bodies[b]))
    for k in range(points.shape[0]):
        z, out[k] = low - exact, math.inf
        for _ in range(STEPS):
            off = math.inf
            for b in range(bodies.shape[0]):
                way, _ = nearest(bodies[b], points[k, 0], points[k, 1], z, point, room)
                off = min(off, way)
            if off < exact:
                out[k] = z
                break
            z += off
            if z > highest:
                break
    return out


@compiled
def extents(bodies: NDArray[np.void]) -> NDArray[Any]:
    """What outlines span: x and y from and to, the lowest point, and the middle [m], (b, 6).

    Rows of bodies without an outline are infinite.
    """
    out = np.full((bodies.shape[0], 6), np.inf)
    point, room = np.empty(9), np.empty(140)
    for b in range(bodies.shape[0]):
        body = bodies[b]
        if body.outline == 0:
            continue
        far = 1e4 * body.scale
        for axis in range(2):
            for side in range(2):
                x, y = body.position[0], body.position[1]
                if axis == 0:
                    x += far if side == 1 else -far
                else:
                    y += far if side == 1 else -far
                nearest(body, x, y, body.position[2], point, room)
                out[b, 2 * axis + side] = point[axis]
        out[b, 5] = middle_height(body)
        out[b, 4] = out[b, 5] - reach_down(body)
    return out


@kernel
def pressure(strain: float, cover: Foundation) -> float:
    """Pressure at a strain [N per square unit]; past the table its last slope continues."""
    if strain <= 0.0:
        return 0.0
    k = 1
    while k < cover.strain.shape[0] - 1 and strain > cover.strain[k]:
        k += 1
    slope = (cover.stress[k] - cover.stress[k - 1]) / (cover.strain[k] - cover.strain[k - 1])
    return cover.stress[k - 1] + slope * (strain - cover.strain[k - 1])


@compiled
def contact_force(height: NDArray[Any], area: float, depth: float, cover: Foundation) -> float:
    """Force that holds a body at a depth [N].

    Args:
        height: Height of its underside over the cover's face at cells, infinite beside it.
        area: Area of a cell.
        depth: How far it is lowered.
        cover: The cover.
    """
    thickness, total = cover.upper[2] - cover.lower[2], 0.0
    for k in range(height.shape[0]):
        total += pressure((depth - height[k]) / thickness, cover)
    return total * area


@compiled
def depth_of_force(height: NDArray[Any], area: float, force: float, cover: Foundation) -> float:
    """How far a body has to be lowered for a force to be carried.

    Without a force, to where it just touches, if it is in the cover. Arguments as of
    :func:`contact_force`.
    """
    low = height.min()
    if force <= 0.0:
        return min(0.0, low)
    high = low + cover.upper[2] - cover.lower[2]
    while contact_force(height, area, high, cover) < force:
        high = low + 2.0 * (high - low)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        if contact_force(height, area, middle, cover) < force:
            low = middle
        else:
            high = middle
    return high


@compiled
def heights(
    bodies: NDArray[np.void], spans: NDArray[Any], held: bool, cover: Foundation
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Heights of a body's underside over the cover's face, and the grid that they are on.

    The grid is its lower corner and the size of its cells [m], shape (4,). It covers what the body
    may be pressed into; where a force holds it, what is at most the cover's thickness higher than
    its lowest point.

    Args:
        bodies: Records of its parts, shape (r,).
        spans: Their extents, shape (r, 6).
        held: Whether a force holds it.
        cover: The cover.
    """
    top = cover.upper[2]
    thickness = top - cover.lower[2]
    exact, highest = EXACT * thickness, top
    low, high, size = np.empty(2), np.empty(2), np.empty(2)
    for i in range(2):
        low[i] = max(spans[:, 2 * i].min(), cover.lower[i])
        high[i] = min(spans[:, 2 * i + 1].max(), cover.upper[i])
    if held:
        highest = spans[:, 5].max()
    points = np.empty((COARSE * COARSE, 2))
    _grid(low, high, points, size)
    height = undersides(bodies, points, highest, exact)
    limit = height.min() + thickness if held else top
    start, end = np.full(2, np.inf), np.full(2, -np.inf)
    found = np.isfinite(height).any()
    for k in range(points.shape[0]):
        if not found or height[k] < limit:  # it may be smaller than a cell, or just touch
            for i in range(2):
                start[i] = min(start[i], points[k, i])
                end[i] = max(end[i], points[k, i])
    for i in range(2):
        low[i], high[i] = max(low[i], start[i] - size[i]), min(high[i], end[i] + size[i])
    fine = np.empty((FINE * FINE, 2))
    _grid(low, high, fine, size)
    grid = np.array([low[0], low[1], size[0], size[1]])
    return undersides(bodies, fine, highest, exact) - top, grid


@compiled
def _grid(low: NDArray[Any], high: NDArray[Any], points: NDArray[Any], size: NDArray[Any]) -> None:
    """Fill in the middles of n² equal cells of a rectangle, (n², 2), and their size, (2,)."""
    count = int(math.sqrt(points.shape[0]))
    for i in range(2):
        size[i] = (high[i] - low[i]) / count
    for k in range(points.shape[0]):
        points[k, 0] = low[0] + size[0] * (k // count + 0.5)
        points[k, 1] = low[1] + size[1] * (k % count + 0.5)


@compiled
def electrode_forces(
    height: NDArray[Any], grid: NDArray[Any], depth: float, cover: Foundation,
    force: NDArray[Any], deepest: NDArray[Any],
) -> None:  # fmt: skip
    """Add the elastic forces of a body above electrodes [N], and raise the largest compressions.

    Args:
        height: As of :func:`heights`.
        grid: The same.
        depth: How far the body is lowered [m].
        cover: The cover.
        force: Added to, shape (m,).
        deepest: Raised, shape (m,).
    """
    thickness = cover.upper[2] - cover.lower[2]
    limit = cover.strain[-1] * thickness
    for k in range(height.shape[0]):
        pressed = depth - height[k]
        if pressed <= 0.0:
            continue
        x, y = grid[0] + grid[2] * (k // FINE), grid[1] + grid[3] * (k % FINE)
        load = pressure(pressed / thickness, cover)
        for i in range(cover.low.shape[0]):
            area = _area_in(i, x, y, x + grid[2], y + grid[3], cover)
            if area > _ROUNDING * cover.sums[i, -1, -1]:
                force[i] += area * load
                deepest[i] = max(deepest[i], min(pressed, limit))


@kernel
def _area_in(i: int, x0: float, y0: float, x1: float, y1: float, cover: Foundation) -> float:
    """Area of an electrode in a rectangle [m²]."""
    if x0 >= cover.high[i, 0] or x1 <= cover.low[i, 0]:
        return 0.0
    if y0 >= cover.high[i, 1] or y1 <= cover.low[i, 1]:
        return 0.0
    upper = _area_up_to(i, x1, y1, cover) - _area_up_to(i, x0, y1, cover)
    return upper - _area_up_to(i, x1, y0, cover) + _area_up_to(i, x0, y0, cover)


@kernel
def _area_up_to(i: int, x: float, y: float, cover: Foundation) -> float:
    """Area of an electrode below and left of a point [m²]; linear in the cells of its raster."""
    sums, count = cover.sums, cover.sums.shape[1] - 1
    u = (x - cover.low[i, 0]) / (cover.high[i, 0] - cover.low[i, 0])
    v = (y - cover.low[i, 1]) / (cover.high[i, 1] - cover.low[i, 1])
    u, v = count * min(max(u, 0.0), 1.0), count * min(max(v, 0.0), 1.0)
    a, b = min(int(u), count - 1), min(int(v), count - 1)
    u, v = u - a, v - b
    low = (1.0 - v) * sums[i, a, b] + v * sums[i, a, b + 1]
    return (1.0 - u) * low + u * ((1.0 - v) * sums[i, a + 1, b] + v * sums[i, a + 1, b + 1])


@compiled
def is_over(span: NDArray[Any], cover: Foundation) -> bool:
    """Whether a body of an extent (6,) is over the cover, and not mostly behind its face."""
    low, high = cover.lower, cover.upper
    across = span[0] < high[0] and span[1] > low[0] and span[2] < high[1] and span[3] > low[1]
    return across and span[5] >= high[2] and np.isfinite(span[5])


@compiled
def press(
    bodies: NDArray[np.void], forces: NDArray[Any], cover: Foundation, force: NDArray[Any],
    deepest: NDArray[Any],
) -> float:  # fmt: skip
    """Lower or raise bodies of one part that forces hold, without relaxation and hysteresis.

    Args:
        bodies: Records, whose heights are changed, shape (b,).
        forces: Normal forces on them [N], NaN for none, shape (b,).
        cover: The cover.
        force, deepest: Set to forces [N] and largest compressions above electrodes, (m,) each.

    Returns:
        The force that the whole cover carries [N].
    """
    force[:], deepest[:] = 0.0, 0.0
    total, spans = 0.0, extents(bodies)
    for b in range(bodies.shape[0]):
        held = not math.isnan(forces[b])
        if not is_over(spans[b], cover):
            continue
        if not (held and forces[b] > 0.0) and spans[b, 4] >= cover.upper[2]:
            continue
        height, grid = heights(bodies[b : b + 1], spans[b : b + 1], held, cover)
        if not np.isfinite(height).any():
            continue
        depth, area = 0.0, grid[2] * grid[3]
        if held:
            depth = depth_of_force(height, area, forces[b], cover)
            bodies[b].position[2] -= depth
        elastic = contact_force(height, area, depth, cover)
        if elastic > 0.0:
            electrode_forces(height, grid, depth, cover, force, deepest)
            total += elastic
    return total
