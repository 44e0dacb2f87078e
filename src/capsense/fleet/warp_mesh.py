"""Triangle meshes as the Warp kernels take them: nearest points, by a tree of boxes.

The twin of these functions is :mod:`capsense.solver.bodies.outline`, whose trees they take.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

_FAR = wp.constant(1e30)
LEVELS = 30
"""Most levels of a mesh's tree of boxes."""
stack = wp.types.vector(length=LEVELS + 2, dtype=wp.int32)
"""Boxes that are still to be looked into."""


@wp.struct
class Outlines:
    """Outlines of all shapes, of size 1."""

    kind: wp.array(dtype=wp.int32)  # code of outline.py, 0 for none
    closed: wp.array(dtype=wp.int32)
    sizes: wp.array(dtype=wp.vec3)  # of primitives
    first: wp.array(dtype=wp.int32)  # first triangle of a mesh
    count: wp.array(dtype=wp.int32)
    box: wp.array(dtype=wp.int32)  # first box of its tree
    levels: wp.array(dtype=wp.int32)
    triangles: wp.array2d(dtype=wp.vec3)  # (all triangles, 3)
    low: wp.array(dtype=wp.vec3)  # corners of all boxes
    high: wp.array(dtype=wp.vec3)


@wp.struct
class Hit:
    """The nearest point of an outline."""

    off: wp.float32  # distance [m], negative inside
    way: wp.vec3  # to the nearest point [m]
    faces: wp.int32  # normals: one on a face or a mesh, two at an edge, none at a corner
    first: wp.vec3
    second: wp.vec3


@wp.func
def _box2(outlines: Outlines, k: int, p: wp.vec3):
    """Squared distance to a box of a tree."""
    d = wp.max(wp.max(outlines.low[k] - p, p - outlines.high[k]), wp.vec3())
    return wp.dot(d, d)


@wp.func
def _to_triangle(outlines: Outlines, m: int, p: wp.vec3):
    """Way to the nearest point of a triangle.

    After C. Ericson, *Real-Time Collision Detection* (2005), section 5.1.5. Within the edges it is
    the way to the plane, which rounding spoils the least.
    """
    a = outlines.triangles[m, 0] - p
    u = outlines.triangles[m, 1] - outlines.triangles[m, 0]
    v = outlines.triangles[m, 2] - outlines.triangles[m, 0]
    d1 = -wp.dot(u, a)
    d2 = -wp.dot(v, a)
    uv = wp.dot(u, v)
    d3 = d1 - wp.dot(u, u)
    d4 = d2 - uv
    d5 = d1 - uv
    d6 = d2 - wp.dot(v, v)
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    way = a
    if d1 <= 0.0 and d2 <= 0.0:
        way = a
    elif d3 >= 0.0 and d4 <= d3:
        way = a + u
    elif d6 >= 0.0 and d5 <= d6:
        way = a + v
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        way = a + d1 / wp.max(d1 - d3, 1e-30) * u
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        way = a + d2 / wp.max(d2 - d6, 1e-30) * v
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / wp.max((d4 - d3) + (d5 - d6), 1e-30)
        way = a + (1.0 - w) * u + w * v
    else:
        normal = wp.normalize(wp.cross(u, v))
        way = wp.dot(normal, a) * normal
    return way


@wp.func
def to_mesh(outlines: Outlines, u: int, p: wp.vec3):
    hit = Hit()
    levels = outlines.levels[u]
    count = outlines.count[u]
    root = outlines.box[u]
    leaves = 1 << (levels - 1)
    best = float(_FAR)
    room = stack()
    top = int(1)
    while top > 0:
        top -= 1
        k = room[top]
        if _box2(outlines, root + k, p) < best:
            if k >= leaves - 1:
                q = wp.int64(k - leaves + 1)
                whole = wp.int64(count)
                start = wp.int32((q * whole) >> wp.int64(levels - 1))
                stop = wp.int32(((q + wp.int64(1)) * whole) >> wp.int64(levels - 1))
                for m in range(start, stop):
                    way = _to_triangle(outlines, outlines.first[u] + m, p)
                    square = wp.dot(way, way)
                    if square < best:
                        best = square
                        hit.way = way
            else:
                near = 2 * k + 1
                far = 2 * k + 2
                if _box2(outlines, root + far, p) < _box2(outlines, root + near, p):
                    near = 2 * k + 2
                    far = 2 * k + 1
                room[top] = far
                room[top + 1] = near
                top += 2
    hit.off = wp.sqrt(best)
    hit.faces = 1
    if outlines.closed[u] != 0 and _inside(outlines, u, p) != 0:
        hit.off = -hit.off
    return hit


@wp.func
def farthest_vertex(outlines: Outlines, u: int, way: wp.vec3):
    """The vertex of a mesh that is farthest along a direction."""
    levels = outlines.levels[u]
    count = wp.int64(outlines.count[u])
    root = outlines.box[u]
    leaves = 1 << (levels - 1)
    out = wp.vec3()
    most = float(-_FAR)
    room = stack()
    top = int(1)
    while top > 0:
        top -= 1
        k = room[top]
        low = wp.cw_mul(outlines.low[root + k], way)
        high = wp.cw_mul(outlines.high[root + k], way)
        best = wp.max(low, high)
        if best[0] + best[1] + best[2] > most:
            if k < leaves - 1:
                room[top] = 2 * k + 1
                room[top + 1] = 2 * k + 2
                top += 2
            else:
                q = wp.int64(k - leaves + 1)
                start = wp.int32((q * count) >> wp.int64(levels - 1))
                stop = wp.int32(((q + wp.int64(1)) * count) >> wp.int64(levels - 1))
                for m in range(start, stop):
                    for corner in range(3):
                        p = outlines.triangles[outlines.first[u] + m, corner]
                        along = wp.dot(p, way)
                        if along > most:
                            most = along
                            out = p
    return out


@wp.func
def _inside(outlines: Outlines, u: int, p: wp.vec3):
    """How often a closed mesh winds around a point, by its crossings of a ray along z."""
    levels = outlines.levels[u]
    count = wp.int64(outlines.count[u])
    root = outlines.box[u]
    leaves = 1 << (levels - 1)
    total = int(0)
    room = stack()
    top = int(1)
    while top > 0:
        top -= 1
        k = room[top]
        low = outlines.low[root + k]
        high = outlines.high[root + k]
        inside = p[0] >= low[0] and p[0] <= high[0] and p[1] >= low[1] and p[1] <= high[1]
        if p[2] <= high[2] and inside:
            if k < leaves - 1:
                room[top] = 2 * k + 1
                room[top + 1] = 2 * k + 2
                top += 2
            else:
                q = wp.int64(k - leaves + 1)
                start = wp.int32((q * count) >> wp.int64(levels - 1))
                stop = wp.int32(((q + wp.int64(1)) * count) >> wp.int64(levels - 1))
                for m in range(start, stop):
                    total += _crossing(outlines, outlines.first[u] + m, p)
    return total


@wp.func
def _crossing(outlines: Outlines, m: int, p: wp.vec3):
    """How a ray upwards from a point crosses a triangle: 1, -1 from behind, else 0."""
    around = int(0)
    for e in range(3):
        a = outlines.triangles[m, e]
        b = outlines.triangles[m, (e + 1) % 3]
        turn = int(0)
        if a[1] <= p[1] and b[1] > p[1]:
            turn = 1
        if a[1] > p[1] and b[1] <= p[1]:
            turn = -1
            swap = a
            a = b
            b = swap
        if turn != 0 and a[0] + (p[1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) > p[0]:
            around += turn
    if around != 0:
        o = outlines.triangles[m, 0]
        one = outlines.triangles[m, 1]
        two = outlines.triangles[m, 2]
        normal = wp.cross(one - o, two - o)
        height = o[2]
        if normal[2] != 0.0:
            height -= (normal[0] * (p[0] - o[0]) + normal[1] * (p[1] - o[1])) / normal[2]
        low = wp.min(o[2], wp.min(one[2], two[2]))
        high = wp.max(o[2], wp.max(one[2], two[2]))
        if wp.clamp(height, low, high) <= p[2]:
            around = 0
    return around
