"""Contact mechanics of a cover in many environments, as Warp kernels: overlaps and forces.

The twin of these kernels is :mod:`capsense.solver.gap.touch_kernels`. Lengths are over the solver's
``length``, forces in newtons.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from capsense.fleet.warp_cut import WarpActiveTree
from capsense.fleet.warp_mesh import Outlines
from capsense.fleet.warp_near import NearBodies, nearest_of
from capsense.fleet.warp_outline import farthest_point, middle_height, reach_down
from capsense.solver.gap.touch_kernels import COARSE, EXACT, FINE, STEPS, Foundation

wp.set_module_options({"enable_backward": False})

_COARSE, _FINE, _STEPS, _EXACT = (wp.constant(x) for x in (COARSE, FINE, STEPS, EXACT))
_FAR = wp.constant(1e30)
"""Stands for an infinite height."""
_BESIDE = wp.constant(1e29)
"""Heights above this stand for infinite ones."""
_DOUBLINGS = wp.constant(30)
"""Of the compression that a force is searched up to, at most."""


@wp.struct
class WarpFoundation:
    """A cover as an elastic foundation, and the m electrodes below it, see ``Foundation``."""

    length: wp.float32  # of what kernels take for a length of one [m]
    lower: wp.vec3
    upper: wp.vec3
    strain: wp.array(dtype=wp.float32)
    stress: wp.array(dtype=wp.float32)  # [N per square unit]
    low: wp.array(dtype=wp.vec2)
    high: wp.array(dtype=wp.vec2)
    raster: wp.array3d(dtype=wp.float32)  # area of each in the cells of a raster


@wp.struct
class CoverContacts:
    """Bodies that may be pressed into the cover, in every view."""

    active: wp.array2d(dtype=wp.int32)  # whether a body may be pressed in, (b, v)
    force: wp.array2d(dtype=wp.float32)  # that holds it [N], NaN for none, (b, v)
    grid: wp.array2d(dtype=wp.vec4)  # lower corner of cells below it, and their size, (b, v)
    height: wp.array3d(dtype=wp.float32)  # of its underside over the cover's face, (cells, b, v)
    least: wp.array2d(dtype=wp.float32)  # of these heights, (b, v)
    depth: wp.array2d(dtype=wp.float32)  # largest compression by it, not limited, (b, v)
    elastic: wp.array2d(dtype=wp.float32)  # force that the cover carries below it [N], (b, v)


def pack_foundation(cover: Foundation, length: float, device: Any) -> WarpFoundation:
    """Lay a foundation out for the kernels; ``length`` is that of the solver [m]."""
    out = WarpFoundation()
    out.length, out.lower, out.upper = length, wp.vec3(*cover.lower), wp.vec3(*cover.upper)
    for name, kind in (
        ("strain", wp.float32), ("stress", wp.float32), ("low", wp.vec2), ("high", wp.vec2),
    ):  # fmt: skip
        values = np.ascontiguousarray(getattr(cover, name), np.float32)
        setattr(out, name, wp.array(values, dtype=kind, device=device))
    raster = np.diff(np.diff(cover.sums, axis=1), axis=2).astype(np.float32)
    out.raster = wp.array(np.ascontiguousarray(raster), dtype=wp.float32, device=device)
    return out


@wp.kernel
def find_contacts(
    outlines: Outlines, cover: WarpFoundation, cut: WarpActiveTree, near: NearBodies,
    forces: wp.array2d(dtype=wp.float32), out: CoverContacts,
):  # fmt: skip
    """Enter bodies that may be pressed in, and a coarse grid of cells below each."""
    b, v = wp.tid()
    e = v // near.sensors
    out.active[b, v] = 0
    u = near.choice[e, b]
    if cut.node[b * cut.clusters, v] < 0 or outlines.kind[u] == 0:
        return
    at = near.pose[b, v]
    scale = near.scale[e, b]
    force = forces[e, b]
    top = cover.upper[2]
    middle = middle_height(outlines, u, at, scale)
    lowest = middle - reach_down(outlines, u, wp.transform_get_rotation(at), scale)
    if not (middle >= top and (force > 0.0 or lowest < top)):
        return
    low = wp.vec2()
    high = wp.vec2()
    for i in range(2):
        way = wp.vec3()
        way[i] = 1.0
        low[i] = wp.max(farthest_point(outlines, u, at, scale, -way)[i], cover.lower[i])
        high[i] = wp.min(farthest_point(outlines, u, at, scale, way)[i], cover.upper[i])
    if low[0] < high[0] and low[1] < high[1]:
        out.active[b, v] = 1
        out.force[b, v] = force
        size = (high - low) / float(_COARSE)
        out.grid[b, v] = wp.vec4(low[0], low[1], size[0], size[1])


@wp.kernel
def undersides(
    outlines: Outlines, cover: WarpFoundation, near: NearBodies, side: int, out: CoverContacts
):
    """Heights of undersides over the cover's face, a row of ``side`` cells each, (side, b, v)."""
    row, b, v = wp.tid()
    if out.active[b, v] == 0:
        return
    grid = out.grid[b, v]
    for col in range(side):
        x = grid[0] + grid[2] * (float(row) + 0.5)
        y = grid[1] + grid[3] * (float(col) + 0.5)
        out.height[row * side + col, b, v] = _underside(outlines, cover, near, out, x, y, b, v)


@wp.func
def _underside(
    outlines: Outlines, cover: WarpFoundation, near: NearBodies, out: CoverContacts, x: float,
    y: float, b: int, v: int,
):  # fmt: skip
    """Height of the lowest point of a body above a place, by sphere tracing, see the twin."""
    e = v // near.sensors
    at = near.pose[b, v]
    scale = near.scale[e, b]
    u = near.choice[e, b]
    top = cover.upper[2]
    exact = _EXACT * (top - cover.lower[2])
    middle = middle_height(outlines, u, at, scale)
    highest = top
    if not wp.isnan(out.force[b, v]):
        highest = middle
    z = middle - reach_down(outlines, u, wp.transform_get_rotation(at), scale) - exact
    height = float(_FAR)
    going = int(1)
    for _ in range(_STEPS):
        if going == 1:
            off = nearest_of(outlines, near, b, v, wp.vec3(x, y, z)).off
            if off < exact:
                height = z - top
                going = 0
            else:
                z += off
                if z > highest:
                    going = 0
    return height


@wp.kernel
def refine_grid(cover: WarpFoundation, out: CoverContacts):
    """Make the grid of each body a fine one, of what may be pressed in by the coarse one."""
    b, v = wp.tid()
    if out.active[b, v] == 0:
        return
    coarse = out.grid[b, v]
    cells = int(_COARSE * _COARSE)
    least = float(_FAR)
    for k in range(cells):
        least = wp.min(least, out.height[k, b, v])
    limit = float(0.0)
    if not wp.isnan(out.force[b, v]):
        limit = least + cover.upper[2] - cover.lower[2]
    start = wp.vec2(float(_COARSE), float(_COARSE))
    end = wp.vec2(-1.0, -1.0)
    for k in range(cells):
        if least > _BESIDE or out.height[k, b, v] < limit:
            cell = wp.vec2(float(k // _COARSE), float(k % _COARSE))
            start = wp.min(start, cell)
            end = wp.max(end, cell)
    grid = wp.vec4()
    for i in range(2):
        low = wp.max(start[i] - 0.5, 0.0)
        high = wp.min(end[i] + 1.5, float(_COARSE))
        grid[i] = coarse[i] + coarse[2 + i] * low
        grid[2 + i] = coarse[2 + i] * (high - low) / float(_FINE)
    out.grid[b, v] = grid


@wp.func
def _pressure(strain: float, cover: WarpFoundation):
    """Pressure at a strain; past the table its last slope continues."""
    if strain <= 0.0:
        return float(0.0)
    k = int(1)
    while k < cover.strain.shape[0] - 1 and strain > cover.strain[k]:
        k += 1
    slope = (cover.stress[k] - cover.stress[k - 1]) / (cover.strain[k] - cover.strain[k - 1])
    return cover.stress[k - 1] + slope * (strain - cover.strain[k - 1])


@wp.func
def _contact_force(cover: WarpFoundation, out: CoverContacts, depth: float, b: int, v: int):
    """Force on a body whose lowest cell is so deep in the cover [N]."""
    thickness = cover.upper[2] - cover.lower[2]
    grid = out.grid[b, v]
    least = out.least[b, v]
    total = float(0.0)
    for k in range(_FINE * _FINE):
        total += _pressure((depth - (out.height[k, b, v] - least)) / thickness, cover)
    return total * grid[2] * grid[3]


@wp.func
def _depth_of_force(cover: WarpFoundation, out: CoverContacts, force: float, b: int, v: int):
    """How deep the lowest cell below a body is in the cover as it carries a force."""
    low = float(0.0)
    high = cover.upper[2] - cover.lower[2]
    steps = int(0)
    while steps < _DOUBLINGS and _contact_force(cover, out, high, b, v) < force:
        high = 2.0 * high
        steps += 1
    middle = 0.5 * high
    while low < middle and middle < high:
        if _contact_force(cover, out, middle, b, v) < force:
            low = middle
        else:
            high = middle
        middle = 0.5 * (low + high)
    return high


@wp.kernel
def carry(cover: WarpFoundation, near: NearBodies, out: CoverContacts):
    """Lower or raise bodies that a force holds, and work out what the cover carries, (b, v)."""
    b, v = wp.tid()
    if out.active[b, v] == 0:
        return
    least = float(_FAR)
    for k in range(_FINE * _FINE):
        least = wp.min(least, out.height[k, b, v])
    if least > _BESIDE:
        out.active[b, v] = 0
        return
    out.least[b, v] = least
    depth = -least
    force = out.force[b, v]
    if not wp.isnan(force):
        depth = wp.min(depth, 0.0)
        if force > 0.0:
            depth = _depth_of_force(cover, out, force, b, v)
        at = near.pose[b, v]
        down = wp.vec3(0.0, 0.0, depth + least)
        near.pose[b, v] = wp.transform(
            wp.transform_get_translation(at) - down, wp.transform_get_rotation(at)
        )
    out.depth[b, v] = depth
    out.elastic[b, v] = _contact_force(cover, out, depth, b, v)


@wp.kernel
def electrode_forces(
    cover: WarpFoundation, near: NearBodies, contacts: CoverContacts,
    due: wp.array(dtype=wp.int32), force: wp.array3d(dtype=wp.float32),
    compression: wp.array3d(dtype=wp.float32),
    total: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Force above each electrode [N] and largest compression there [m]; and that of all [N]."""
    i, v = wp.tid()
    e = v // near.sensors
    s = v % near.sensors
    if due[e] == 0:
        return
    limit = cover.strain[cover.strain.shape[0] - 1] * (cover.upper[2] - cover.lower[2])
    own = float(0.0)
    whole = float(0.0)
    deepest = float(0.0)
    for b in range(contacts.active.shape[0]):
        if contacts.active[b, v] != 0 and contacts.elastic[b, v] > 0.0:
            whole += contacts.elastic[b, v]
            for k in range(_FINE * _FINE):
                pressed = contacts.depth[b, v] - (contacts.height[k, b, v] - contacts.least[b, v])
                if pressed > 0.0:
                    area = _area_above(cover, contacts.grid[b, v], i, k)
                    if area > 0.0:
                        own += area * _pressure(pressed / (cover.upper[2] - cover.lower[2]), cover)
                        deepest = wp.max(deepest, wp.min(pressed, limit))
    force[e, s, i] = own
    compression[e, s, i] = cover.length * deepest
    if i == 0:
        total[e, s] = whole


@wp.func
def _area_above(cover: WarpFoundation, grid: wp.vec4, i: int, k: int):
    """Area of an electrode below a cell of a fine grid."""
    count = cover.raster.shape[1]
    low = cover.low[i]
    size = (cover.high[i] - low) / float(count)
    x0 = wp.max((grid[0] + grid[2] * float(k // _FINE) - low[0]) / size[0], 0.0)
    y0 = wp.max((grid[1] + grid[3] * float(k % _FINE) - low[1]) / size[1], 0.0)
    x1 = wp.min((grid[0] + grid[2] * float(k // _FINE + 1) - low[0]) / size[0], float(count))
    y1 = wp.min((grid[1] + grid[3] * float(k % _FINE + 1) - low[1]) / size[1], float(count))
    area = float(0.0)
    for a in range(wp.int32(x0), wp.int32(wp.ceil(x1))):
        across = wp.min(x1, float(a + 1)) - wp.max(x0, float(a))
        for c in range(wp.int32(y0), wp.int32(wp.ceil(y1))):
            along = wp.min(y1, float(c + 1)) - wp.max(y0, float(c))
            area += across * along * cover.raster[i, a, c]
    return area
