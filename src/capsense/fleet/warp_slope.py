"""The gap law of many environments as Warp kernels: how it changes as near bodies move.

The lengths of field lines are differenced as a body moves, which are nearly linear in its pose; what
the table has of them, and the share of a cell, are differentiated. For bodies that are pressed out
of the face, what they are moved by is differentiated at the point that touches.
Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import math

import warp as wp

from capsense.fleet.warp_cut import Places, Response, Shapes, WarpCut, smooth
from capsense.fleet.warp_gap import lengths, met_by, nearest_cell, place_of
from capsense.fleet.warp_mesh import Outlines
from capsense.fleet.warp_near import GapLaw, Near, nearest_of, overlap
from capsense.fleet.warp_outline import nearest
from capsense.surface.gap_kernels import REACH

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
class NearSlopes:
    """How what is near changes with the poses of near bodies, about what they stand at."""

    part: wp.array4d(dtype=wp.spatial_vector)  # of ``Near.part``, the last one its node's,
    # by the place in ``Near.body``, (p, n + 1, b, v)
    lift: wp.array2d(dtype=wp.spatial_vector)  # of what presses a body out, (b, v)


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
def local_slopes(
    shapes: Shapes, outlines: Outlines, places: Places, gap: GapLaw, green: Response,
    cut: WarpCut, near: Near, out: NearSlopes,
):  # fmt: skip
    """Derivatives of the local change of a chunk's cells by the poses of near bodies."""
    v, p = wp.tid()
    columns = gap.columns.shape[1]
    for k in range(near.count[v]):
        for col in range(columns + 1):
            out.part[p, col, k, v] = wp.spatial_vector()
    if near.count[v] == 0 or (gap.owner[p] < 0 and cut.columns[v] == gap.terminals):
        return
    for q in range(gap.chunks[p], gap.chunks[p + 1]):
        met = met_by(shapes, outlines, places, gap, cut, near, q, gap.owner[p], v)
        if met != wp.int64(0):
            for c in range(gap.blocks[q], gap.blocks[q + 1]):
                _add_slopes(shapes, outlines, places, gap, green, cut, near, met, c, p, v, out)


@wp.func
def _add_slopes(
    shapes: Shapes, outlines: Outlines, places: Places, gap: GapLaw, green: Response,
    cut: WarpCut, near: Near, met: wp.int64, c: int, p: int, v: int, out: NearSlopes,
):  # fmt: skip
    """Add the derivatives of what one cell changes."""
    x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
    best, high, k = nearest_cell(outlines, places, gap, green, cut, near, met, x, v)
    place = (best / gap.validity - _REACH0) / (_REACH1 - _REACH0)
    weight = 1.0 - smooth(place)
    if k < 0 or high <= best or weight <= 0.0:
        return
    e = v // places.hidden.shape[0]
    b = near.body[k, v]
    u = places.choice[e, b]
    at = cut.pose[b, v]
    step = _STEP * gap.validity
    arm = wp.max(places.scale[e, b] * shapes.extent[shapes.first[u]], gap.validity)
    here = nearest_of(outlines, places, cut, b, v, x)
    way = wp.spatial_vector()
    up = wp.spatial_vector()
    six = int(6)  # not unrolled
    for r in range(six):
        change = wp.where(r < 3, step, step / arm)
        one = nearest(outlines, u, _moved(at, r, change), places.scale[e, b], x)
        two = nearest(outlines, u, _moved(at, r, -change), places.scale[e, b], x)
        a, d = lengths(gap, green, one, x)
        f, g = lengths(gap, green, two, x)
        if one.faces == here.faces and two.faces == here.faces:
            change = 2.0 * change
        elif one.faces == here.faces:
            f = best
            g = high
        elif two.faces == here.faces:
            a = best
            d = high
        way[r] = (a - f) / change
        up[r] = (d - g) / change
    area = gap.areas[c] / (4.0 * _PI)
    inner = wp.clamp(place, 0.0, 1.0)
    fade = -6.0 * inner * (1.0 - inner) / ((_REACH1 - _REACH0) * gap.validity)
    for col in range(gap.columns.shape[1] + 1):
        true, by_true = _slope_of(gap, c, col, best)
        lifted, by_lifted = _slope_of(gap, c, col, high)
        slope = (fade * (true - lifted) + weight * by_true) * way - weight * by_lifted * up
        out.part[p, col, k, v] = out.part[p, col, k, v] + area * slope


@wp.kernel
def press_slopes(
    outlines: Outlines, places: Places, gap: GapLaw, cut: WarpCut, near: Near, out: NearSlopes
):
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
                point, normal = _touching(outlines, places, gap, cut, near, b, most, up, v)
                point[2] = point[2] - up
            origin = wp.transform_get_translation(cut.pose[b, v]) - wp.vec3(0.0, 0.0, up)
            slope = normal / wp.max(-normal[2], _STEEP)
            out.lift[b, v] = wp.spatial_vector(slope, wp.cross(point - origin, slope))


@wp.func
def _touching(
    outlines: Outlines, places: Places, gap: GapLaw, cut: WarpCut, near: Near, b: int, p: int,
    up: float, v: int,
):  # fmt: skip
    """The point of a body, pressed out, that touches a cell of a chunk, and its normal."""
    least = float(1.0e30)
    point = wp.vec3()
    normal = wp.vec3(0.0, 0.0, -1.0)
    for q in range(gap.chunks[p], gap.chunks[p + 1]):
        for c in range(gap.blocks[q], gap.blocks[q + 1]):
            x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
            hit = nearest_of(outlines, places, cut, b, v, x)
            if hit.off < least:
                least = hit.off
                point = x
                if hit.faces > 0:
                    normal = hit.first
    return point, normal
