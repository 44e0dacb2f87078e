"""The gap law of many environments as Warp kernels: how it changes as near bodies move.

The lengths of field lines are differenced as a body moves, as they are nearly linear in its pose;
what the table has of them, and the share of a cell, are differentiated. For bodies that are pressed
out of the face, what they are moved by is differentiated at the point that touches. In a cover
they stand lower by as much, up to its largest compression, which is differentiated apart.
Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import math

import warp as wp

from capsense.fleet.warp_cut import Response, smooth
from capsense.fleet.warp_gap import (
    compressed_length,
    lengths,
    line_length,
    met_by,
    nearest_cell,
    place_of,
    strain_place,
)
from capsense.fleet.warp_mesh import Outlines
from capsense.fleet.warp_near import GapLaw, NearBodies, nearest_of
from capsense.fleet.warp_outline import nearest
from capsense.solver.gap.gap_kernels import REACH

wp.set_module_options({"enable_backward": False})

_REACH0, _REACH1 = wp.constant(REACH[0]), wp.constant(REACH[1])
_PI = wp.constant(math.pi)
_STEP = wp.constant(5e-3)
"""Step of central differences, over the validity distance."""
_FLAT = wp.constant(1e-3)
"""What overlaps by so much less than a lowest point, over the validity distance, counts as that."""
_STEEP = wp.constant(0.2)
"""Surfaces that touch count as no steeper than that: the least cosine of their normals."""


@wp.struct
class Slopes:
    """What derivatives are made of; t terminals and nodes, n electrodes, l leaves.

    What is near is differentiated about where bodies stand, by the places in ``NearBodies.body``.
    """

    volts: wp.array3d(dtype=wp.float32)  # with an electrode at 1 V, (t, n, v)
    charge: wp.array3d(dtype=wp.float32)  # on leaves [m], (l, lead, v)
    pull: wp.array3d(dtype=wp.spatial_vector)  # forces on leaves, (l, lead, v)
    part: wp.array4d(dtype=wp.spatial_vector)  # of their part, the node's last, (p, n + 1, b, v)
    lift: wp.array2d(dtype=wp.spatial_vector)  # of what presses a body out, (b, v)
    sink: wp.array4d(dtype=wp.float32)  # of their part by ``NearBodies.sunk``, (p, n + 1, b, v)


@wp.func
def _moved(at: wp.transform, way: int, change: float):
    """A pose that is moved along x, y or z [m], or turned about one of them [rad]."""
    p = wp.transform_get_translation(at)
    q = wp.transform_get_rotation(at)
    axis = wp.vec3()
    axis[way % 3] = 1.0
    if way < 3:
        p += change * axis
    else:
        half = 0.5 * change
        s = wp.sin(half)
        q = wp.quat(s * axis[0], s * axis[1], s * axis[2], wp.cos(half)) * q
    return wp.transform(p, q)


@wp.func
def _slope_of(gap: GapLaw, c: int, col: int, length: float):
    """The table's change over the length in series at a cell, and its derivative by the length."""
    k, s = place_of(gap, length)
    low = gap.change[c, k, col]
    high = gap.change[c, k + 1, col]
    whole = length + gap.series[c]
    value = ((1.0 - s) * low + s * high) / whole
    slope = -value / whole
    if s > 0.0 and s < 1.0:
        slope += (high - low) / (gap.log_ratio * length * whole)
    return value, slope


@wp.kernel
def local_slopes(outlines: Outlines, gap: GapLaw, green: Response, near: NearBodies, out: Slopes):
    """Derivatives of the local change of a chunk's cells by the poses of near bodies."""
    v, p = wp.tid()
    columns = gap.columns.shape[1]
    for k in range(near.count[v]):
        for col in range(columns + 1):
            out.part[p, col, k, v] = wp.spatial_vector()
            out.sink[p, col, k, v] = 0.0
    grounded = gap.owner[p] < 0
    if near.count[v] == 0 or (grounded and near.columns[v] == gap.terminals):
        return
    for q in range(gap.chunks[p], gap.chunks[p + 1]):
        met = met_by(outlines, gap, near, q, grounded, v)
        if met != wp.int64(0):
            for c in range(gap.blocks[q], gap.blocks[q + 1]):
                x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
                best, high, k = nearest_cell(outlines, gap, green, near, met, x, v)
                if k >= 0 and high > best:
                    b = near.body[k, v]
                    sunk = near.sunk[b, v]
                    if best < _REACH1 * (gap.validity + sunk):
                        way, up = _turns(outlines, gap, green, near, x, x, b, v)
                        if sunk > 0.0:
                            low = x + wp.vec3(0.0, 0.0, sunk)
                            way, _up = _turns(outlines, gap, green, near, x, low, b, v)
                        for col in range(columns + 1):
                            slope, sink = _cell_slope(gap, c, col, sunk, best, high, way, up)
                            out.part[p, col, k, v] = out.part[p, col, k, v] + slope
                            out.sink[p, col, k, v] = out.sink[p, col, k, v] + sink
                if gap.below[c] >= 0.0:
                    _add_compressed_slope(outlines, gap, near, out, met, c, p, v)


@wp.func
def _turns(
    outlines: Outlines, gap: GapLaw, green: Response, near: NearBodies, x: wp.vec3, y: wp.vec3,
    b: int, v: int,
):  # fmt: skip
    """Differences of the lengths of two field lines from x over those of a body's pose.

    The body is lower than it stands by as much as y is above x.
    They step where the nearest point comes to another face or edge, so that they are taken on the
    side where it does not.
    """
    e = v // near.sensors
    u = near.choice[e, b]
    scale = near.scale[e, b]
    at = near.pose[b, v]
    here = nearest(outlines, u, at, scale, y)
    best, high = lengths(gap, green, here, x)
    step = _STEP * gap.validity
    arm = wp.max(scale * near.radius[u], gap.validity)
    way = wp.spatial_vector()
    up = wp.spatial_vector()
    six = int(6)  # not unrolled
    for r in range(six):
        change = wp.where(r < 3, step, step / arm)
        one = nearest(outlines, u, _moved(at, r, change), scale, y)
        two = nearest(outlines, u, _moved(at, r, -change), scale, y)
        a, d = lengths(gap, green, one, x)
        f, g = lengths(gap, green, two, x)
        if (one.faces == here.faces) == (two.faces == here.faces):
            change = 2.0 * change
        elif one.faces == here.faces:
            f = best
            g = high
        else:
            a = best
            d = high
        way[r] = (a - f) / change
        up[r] = (d - g) / change
    return way, up


@wp.func
def _cell_slope(
    gap: GapLaw, c: int, col: int, sunk: float, best: float, high: float, way: wp.spatial_vector,
    up: wp.spatial_vector,
):  # fmt: skip
    """Derivatives of what a cell changes in a column, from those of the two lengths.

    The second is by how much lower than it is solved for the body stands, ``sunk``.
    """
    scale = gap.validity + sunk
    place = (best / scale - _REACH0) / (_REACH1 - _REACH0)
    inner = wp.clamp(place, 0.0, 1.0)
    weight = 1.0 - smooth(place)
    fade = -6.0 * inner * (1.0 - inner) / ((_REACH1 - _REACH0) * scale)
    true, by_true = _slope_of(gap, c, col, best)
    lifted, by_lifted = _slope_of(gap, c, col, high)
    area = gap.areas[c] / (4.0 * _PI)
    by_best = fade * (true - lifted) + weight * by_true
    sink = -by_best * way[2] - fade * best / scale * (true - lifted)
    return area * (by_best * way - weight * by_lifted * up), area * sink


@wp.func
def _add_compressed_slope(
    outlines: Outlines, gap: GapLaw, near: NearBodies, out: Slopes, met: wp.int64, c: int, p: int,
    v: int,
):  # fmt: skip
    """Add the derivatives of what a cell changes as a body is pressed into the cover above it."""
    x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top - gap.cover)
    length, k = compressed_length(outlines, gap, near, met, x, v)
    if k < 0 or length <= gap.cover - gap.limit:
        return
    b = near.body[k, v]
    way = line_turns(outlines, gap, near, x + wp.vec3(0.0, 0.0, near.sunk[b, v]), b, v)
    m, _share = strain_place(gap, length, gap.below[c])
    rest = gap.below[c] * gap.eps
    low = 1.0 / (rest + (1.0 - gap.strains[m]) * gap.cover)
    high = 1.0 / (rest + (1.0 - gap.strains[m + 1]) * gap.cover)
    slope = -gap.areas[c] / (4.0 * _PI * gap.cover * (high - low) * wp.pow(rest + length, 2.0))
    for col in range(gap.columns.shape[1] + 1):
        value = slope * (gap.pressed[c, m + 1, col] - gap.pressed[c, m, col])
        out.part[p, col, k, v] = out.part[p, col, k, v] + value * way
        out.sink[p, col, k, v] = out.sink[p, col, k, v] - value * way[2]


@wp.func
def line_turns(
    outlines: Outlines, gap: GapLaw, near: NearBodies, x: wp.vec3, b: int, v: int
):  # fmt: skip
    """Differences of the length of a field line through the cover over those of a body's pose."""
    e = v // near.sensors
    u = near.choice[e, b]
    scale = near.scale[e, b]
    at = near.pose[b, v]
    step = _STEP * gap.validity
    arm = wp.max(scale * near.radius[u], gap.validity)
    way = wp.spatial_vector()
    six = int(6)  # not unrolled
    for r in range(six):
        change = wp.where(r < 3, step, step / arm)
        one = nearest(outlines, u, _moved(at, r, change), scale, x)
        two = nearest(outlines, u, _moved(at, r, -change), scale, x)
        far = 2.0 * gap.cover
        way[r] = (line_length(one, far) - line_length(two, far)) / (2.0 * change)
    return way


@wp.kernel
def press_slopes(outlines: Outlines, gap: GapLaw, near: NearBodies, out: Slopes):
    """Derivative of what presses a body out of the face by its pose."""
    v = wp.tid()
    for k in range(near.count[v]):
        b = near.body[k, v]
        out.lift[b, v] = wp.spatial_vector()
        deepest = float(0.0)
        most = int(0)
        for p in range(gap.owner.shape[0]):
            if near.below[b, v] > 0.0 and near.depth[p, b, v] > deepest:
                deepest = near.depth[p, b, v]
                most = p
        if deepest > 0.0:
            up = wp.min(deepest, near.below[b, v])
            point = near.foot[b, v]
            normal = wp.vec3(0.0, 0.0, -1.0)
            if gap.top - point[2] > deepest + _FLAT * gap.validity:  # it is beside all cells
                point, normal = _touching(outlines, gap, near, b, most, v)
                point[2] = point[2] - up
            origin = wp.transform_get_translation(near.pose[b, v]) - wp.vec3(0.0, 0.0, up)
            slope = normal / wp.max(-normal[2], _STEEP)
            out.lift[b, v] = wp.spatial_vector(slope, wp.cross(point - origin, slope))


@wp.func
def _touching(outlines: Outlines, gap: GapLaw, near: NearBodies, b: int, p: int, v: int):
    """The point of a body, pressed out, that touches a cell of a chunk, and its normal."""
    least = float(1.0e30)
    point = wp.vec3()
    normal = wp.vec3(0.0, 0.0, -1.0)
    for q in range(gap.chunks[p], gap.chunks[p + 1]):
        for c in range(gap.blocks[q], gap.blocks[q + 1]):
            x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
            hit = nearest_of(outlines, near, b, v, x)
            if hit.off < least:
                least = hit.off
                point = x
                if hit.faces > 0:
                    normal = hit.first
    return point, normal
