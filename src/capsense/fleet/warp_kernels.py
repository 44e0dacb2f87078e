"""The step of many environments as Warp kernels, with so many clusters for each body.

A *view* is one sensor in one environment. What belongs to a view has its number as the last index,
so that neighbouring threads of a GPU touch neighbouring numbers. Every body is cut into K clusters:
starting from the whole, the one that is largest against its distance from the design is split. The
cluster that is split keeps its place for the first part, and the second part takes the next one,
so that the change from clusters to charge functions, and of matrices with it, is done in place.

Symbols and formulas are those of ``docs/theory.md``; lengths in metres, 4π eps0 = 1. The twin of
these kernels is :mod:`capsense.surface.step` with the same cut.
"""

from __future__ import annotations

import warp as wp

from capsense.surface.pair_kernels import BARRIER, FAR, SOFT
from capsense.surface.place_kernels import DEEP, FAR_LEAST, GAP, NEAR_LEAST, SHORE, STEEP

wp.set_module_options({"enable_backward": False, "fast_math": True})

WIDTH = 64
"""Columns of a table that a thread works out at a time."""
row = wp.types.vector(length=WIDTH, dtype=wp.float32)

_NEAREST = wp.constant(1e-3)
_HALF = wp.constant(0.5)
_DROPPED = wp.constant(1e-5)
"""Functions whose pivot is so small against their own energy are left out."""
_GAP0, _GAP1, _GAP2, _GAP3 = (wp.constant(x) for x in GAP)
_DEEP, _STEEP, _SHORE = wp.constant(DEEP), wp.constant(STEEP), wp.constant(SHORE)
_SOFT, _FAR, _BARRIER = wp.constant(SOFT), wp.constant(FAR), wp.constant(BARRIER)
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)
_WIDTH = wp.constant(WIDTH)


@wp.struct
class Shapes:
    """All shapes, of size 1, one behind the other."""

    first: wp.array(dtype=wp.int32)  # first cluster of a shape
    functions: wp.array(dtype=wp.int32)  # how many functions have energies
    block: wp.array(dtype=wp.int64)  # where its energies begin
    radius: wp.array(dtype=wp.float32)
    kids: wp.array2d(dtype=wp.int32)  # parts of a cluster, from 0 within the shape; -1 for none
    function: wp.array(dtype=wp.int32)
    charge: wp.array(dtype=wp.float32)
    center: wp.array(dtype=wp.vec3)
    points: wp.array2d(dtype=wp.vec3)
    extent: wp.array(dtype=wp.float32)
    energy: wp.array(dtype=wp.float32)
    impedance: wp.array(dtype=wp.float32)


@wp.struct
class Places:
    """What stands in the places of all environments, (e, b)."""

    choice: wp.array2d(dtype=wp.int32)
    scale: wp.array2d(dtype=wp.float32)
    softness: wp.array2d(dtype=wp.float32)
    tie: wp.array2d(dtype=wp.float32)
    neutral: wp.array2d(dtype=wp.int32)
    hidden: wp.array2d(dtype=wp.int32)  # whether a sensor does not see a place, (s, b)


@wp.struct
class Response:
    """Green's function of the design."""

    near: wp.array(dtype=wp.vec3)
    near_table: wp.array2d(dtype=row)  # (sources, passes)
    far: wp.array(dtype=wp.vec3)
    far_table: wp.array2d(dtype=row)
    lead: wp.int32
    terminals: wp.int32
    floor: wp.float32
    cover: wp.float32
    blend0: wp.float32
    blend1: wp.float32
    box0: wp.vec3
    box1: wp.vec3
    room0: wp.vec3
    room1: wp.vec3
    unit: wp.float32  # 4π eps0 [F/m]
    empty: wp.array2d(dtype=wp.float32)  # matrix in the empty domain [F]
    screened: wp.array2d(dtype=wp.float32)  # bound of what it changes by [F]


@wp.struct
class WarpCut:
    """Clusters and functions of every view, K for each place; n = b K."""

    pose: wp.array2d(dtype=wp.transform)  # of the bodies in the sensor frame, (b, v)
    node: wp.array2d(dtype=wp.int32)  # cluster in each place, -1 for none, (n, v)
    score: wp.array2d(dtype=wp.float32)
    split: wp.array2d(dtype=wp.int32)  # place of the cluster that was split for this one, (n, v)
    part: wp.array2d(dtype=wp.float32)  # share of the first part, (n, v)
    number: wp.array2d(dtype=wp.int32)  # function of the shape, -1 for none, (n, v)
    points: wp.array3d(dtype=wp.vec3)  # (n, 4, v)
    extent: wp.array2d(dtype=wp.float32)
    beyond: wp.array2d(dtype=wp.float32)
    near: wp.array2d(dtype=wp.float32)  # share of the near sources, (n, v)


@wp.func
def _smooth(x: float):
    y = wp.clamp(x, 0.0, 1.0)
    return y * y * (3.0 - 2.0 * y)


@wp.func
def _off(p: wp.vec3, low: wp.vec3, high: wp.vec3):
    """How far a point is from a box along each axis."""
    return wp.vec3(
        wp.max(wp.max(low[0] - p[0], p[0] - high[0]), 0.0),
        wp.max(wp.max(low[1] - p[1], p[1] - high[1]), 0.0),
        wp.max(wp.max(low[2] - p[2], p[2] - high[2]), 0.0),
    )


@wp.func
def _need(shapes: Shapes, green: Response, at: wp.transform, scale: float, node: int):
    """Extent of a cluster over its distance from the design; 0 for a single panel."""
    if shapes.kids[node, 0] < 0:
        return float(0.0)
    size = scale * shapes.extent[node]
    p = wp.transform_point(at, scale * shapes.center[node])
    away = wp.length(_off(p, green.box0, green.box1))
    return size / (wp.max(away, _HALF * size) + _NEAREST)


@wp.kernel
def choose(
    shapes: Shapes, places: Places, green: Response, bodies: wp.array2d(dtype=wp.transform),
    sensors: wp.array2d(dtype=wp.transform), clusters: int, cut: WarpCut,
):  # fmt: skip
    """Cut every body that a sensor sees into clusters."""
    b, v = wp.tid()
    e = v // sensors.shape[1]
    s = v % sensors.shape[1]
    u = places.choice[e, b]
    o = b * clusters
    for j in range(clusters):
        cut.node[o + j, v] = -1
        cut.number[o + j, v] = -1
    if u < 0 or places.hidden[s, b] != 0:
        return
    at = wp.transform_multiply(wp.transform_inverse(sensors[e, s]), bodies[e, b])
    cut.pose[b, v] = at
    scale = places.scale[e, b]
    away = _off(wp.transform_get_translation(at), green.room0, green.room1)
    if wp.max(away[0], wp.max(away[1], away[2])) > scale * shapes.radius[u]:
        return
    first = shapes.first[u]
    cut.node[o, v] = first
    cut.score[o, v] = _need(shapes, green, at, scale, first)
    if places.neutral[e, b] == 0:
        cut.number[o, v] = 0
    for j in range(1, clusters):
        best = int(0)
        most = float(0.0)
        for i in range(j):
            if cut.score[o + i, v] > most:
                most = cut.score[o + i, v]
                best = i
        if most > 0.0:
            k = cut.node[o + best, v]
            x = first + shapes.kids[k, 0]
            y = first + shapes.kids[k, 1]
            cut.split[o + j, v] = best
            cut.part[o + j, v] = shapes.charge[x] / shapes.charge[k]
            cut.number[o + j, v] = shapes.function[k]
            cut.node[o + best, v] = x
            cut.node[o + j, v] = y
            cut.score[o + best, v] = _need(shapes, green, at, scale, x)
            cut.score[o + j, v] = _need(shapes, green, at, scale, y)
        else:
            cut.score[o + j, v] = 0.0


@wp.func
def _lift(p: wp.vec3, gap: float, green: Response):
    """Keep a point off a flat design, as ``place_kernels.lift``."""
    away = wp.vec3(
        wp.max(wp.max(green.box0[0] - p[0], p[0] - green.box1[0]), 0.0),
        wp.max(wp.max(green.box0[1] - p[1], p[1] - green.box1[1]), 0.0),
        wp.max(p[2] - green.box1[2], 0.0),
    )
    way = wp.length(away)
    if way >= 2.0 * gap:
        return p
    q = p
    if way == 0.0:
        depth = green.box1[2] - p[2]
        axis = 2
        to = green.box1[2] + gap
        for i in range(2):
            if p[i] - green.box0[i] < depth:
                depth = p[i] - green.box0[i]
                axis = i
                to = green.box0[i] - gap
            if green.box1[i] - p[i] < depth:
                depth = green.box1[i] - p[i]
                axis = i
                to = green.box1[i] + gap
        q[axis] = to
        return q
    ratio = (gap + way * way / (4.0 * gap)) / way
    for i in range(3):
        edge = wp.min(p[i], green.box1[i])
        if i < 2:
            edge = wp.max(edge, green.box0[i])
        q[i] = edge + ratio * (p[i] - edge)
    return q


@wp.kernel
def place(
    shapes: Shapes, places: Places, green: Response, sensors: int, clusters: int, cut: WarpCut
):
    """Points of all clusters in the sensor frame, and where they stand to design and walls."""
    i, v = wp.tid()
    k = cut.node[i, v]
    if k < 0:
        return
    b = i // clusters
    scale = places.scale[v // sensors, b]
    at = cut.pose[b, v]
    size = scale * shapes.extent[k]
    p0 = wp.transform_point(at, scale * shapes.points[k, 0])
    p3 = wp.transform_point(at, scale * shapes.points[k, 3])
    c = 0.5 * (p0 + p3)
    out = wp.length(_off(c, green.room0, green.room1))
    deep = float(0.0)
    if green.cover < 1.0:
        depth = wp.min(1.0, green.box1[2] - c[2])
        for d in range(2):
            depth = wp.min(depth, _STEEP * (c[d] - green.box0[d]))
            depth = wp.min(depth, _STEEP * (green.box1[d] - c[d]))
        deep = depth - _DEEP
    cut.beyond[i, v] = _smooth(wp.max(out, deep) / _SHORE)
    gap = wp.max(_GAP3, wp.min(_GAP1, wp.max(_GAP0, size * size / _GAP2)) - green.cover)
    for q in range(4):
        p = wp.transform_point(at, scale * shapes.points[k, q])
        if green.cover < 1.0:
            p = _lift(p, gap, green)
        cut.points[i, q, v] = p
    cut.extent[i, v] = size
    middle = 0.5 * (cut.points[i, 0, v] + cut.points[i, 3, v])
    away = wp.length(_off(middle, green.box0, green.box1))
    cut.near[i, v] = _smooth((green.blend1 - away) / (green.blend1 - green.blend0))


@wp.func
def _unit(p: wp.vec3, source: wp.vec3, floor: float, least: float):
    """Potential of a unit charge and its image in the floor."""
    dx = p[0] - source[0]
    dy = p[1] - source[1]
    dz = p[2] - source[2]
    ez = p[2] + source[2] - 2.0 * floor
    across = dx * dx + dy * dy
    return 1.0 / wp.sqrt(wp.max(across + dz * dz, least * least)) - 1.0 / wp.sqrt(across + ez * ez)


@wp.kernel
def rows(green: Response, cut: WarpCut, out: wp.array3d(dtype=wp.float32)):
    """Means of φ⁰ and ψ over all clusters, (n, w, v): 64 columns a thread."""
    i, part, v = wp.tid()
    total = row()
    if cut.node[i, v] >= 0:
        p0 = cut.points[i, 0, v]
        p1 = cut.points[i, 1, v]
        p2 = cut.points[i, 2, v]
        p3 = cut.points[i, 3, v]
        inner = 0.25 * (1.0 - cut.beyond[i, v])
        near = cut.near[i, v]
        if near < 1.0 and inner > 0.0 and part < green.far_table.shape[1]:
            for s in range(green.far.shape[0]):
                q = green.far[s]
                value = (
                    _unit(p0, q, green.floor, _FAR_LEAST) + _unit(p1, q, green.floor, _FAR_LEAST)
                    + _unit(p2, q, green.floor, _FAR_LEAST) + _unit(p3, q, green.floor, _FAR_LEAST)
                )  # fmt: skip
                total += (1.0 - near) * inner * value * green.far_table[s, part]
        if near > 0.0 and inner > 0.0:
            for s in range(green.near.shape[0]):
                q = green.near[s]
                value = (
                    _unit(p0, q, green.floor, _NEAR_LEAST) + _unit(p1, q, green.floor, _NEAR_LEAST)
                    + _unit(p2, q, green.floor, _NEAR_LEAST)
                    + _unit(p3, q, green.floor, _NEAR_LEAST)
                )  # fmt: skip
                total += near * inner * value * green.near_table[s, part]
    for c in range(_WIDTH):
        out[i, part * _WIDTH + c, v] = total[c]


@wp.func
def _mean(cut: WarpCut, i: int, j: int, v: int, mirrored: float, floor: float):
    """Mean of 1/r between two clusters, the second one mirrored in the floor where that is 1."""
    a0 = cut.points[i, 0, v]
    a1 = cut.points[i, 1, v]
    a2 = cut.points[i, 2, v]
    a3 = cut.points[i, 3, v]
    flip = wp.vec3(1.0, 1.0, 1.0 - 2.0 * mirrored)
    lift = wp.vec3(0.0, 0.0, 2.0 * mirrored * floor)
    b0 = wp.cw_mul(flip, cut.points[j, 0, v]) + lift
    b1 = wp.cw_mul(flip, cut.points[j, 1, v]) + lift
    b2 = wp.cw_mul(flip, cut.points[j, 2, v]) + lift
    b3 = wp.cw_mul(flip, cut.points[j, 3, v]) + lift
    d = 0.5 * (a0 + a3 - b0 - b3)
    square = wp.dot(d, d)
    size = cut.extent[i, v] + cut.extent[j, v]
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a0 - a1)
        y = 0.5 * (a0 - a2)
        z = 0.5 * (b0 - b1)
        w = 0.5 * (b0 - b2)
        inverse = 1.0 / wp.sqrt(square)
        second = inverse * inverse
        whole = wp.dot(x, x) + wp.dot(y, y) + wp.dot(z, z) + wp.dot(w, w)
        ax = wp.dot(x, d)
        ay = wp.dot(y, d)
        az = wp.dot(z, d)
        aw = wp.dot(w, d)
        along = 3.0 * (ax * ax + ay * ay + az * az + aw * aw) * second
        return inverse * (1.0 + 0.5 * (along - whole) * second)
    bound = _SOFT * wp.max(cut.extent[i, v], cut.extent[j, v])
    fourth = bound * bound * bound * bound + 1.0e-24
    total = float(0.0)
    for p in range(4):
        a = cut.points[i, p, v]
        total += _soft(a - b0, fourth) + _soft(a - b1, fourth)
        total += _soft(a - b2, fourth) + _soft(a - b3, fourth)
    return total / 16.0


@wp.func
def _soft(d: wp.vec3, fourth: float):
    square = wp.dot(d, d)
    return 1.0 / wp.sqrt(wp.sqrt(square * square + fourth))


@wp.kernel
def pairs(green: Response, cut: WarpCut, clusters: int, out: wp.array3d(dtype=wp.float32)):
    """Mean of 1/r between bodies, and of -1/r to images in the floor, (n, n, v)."""
    i, j, v = wp.tid()
    if j > i:
        return
    value = float(0.0)
    if cut.node[i, v] >= 0 and cut.node[j, v] >= 0:
        value = -_mean(cut, i, j, v, 1.0, green.floor)
        if i // clusters != j // clusters:
            value += _mean(cut, i, j, v, 0.0, green.floor)
        if i == j:
            x = cut.beyond[i, v]
            value += _BARRIER * x * x * x
    out[i, j, v] = value
    out[j, i, v] = value


@wp.kernel
def to_functions(cut: WarpCut, clusters: int, values: wp.array3d(dtype=wp.float32)):
    """Integrate what clusters have in the first index with the charge functions, in place."""
    b, c, v = wp.tid()
    o = b * clusters
    for k in range(clusters - 1):
        j = clusters - 1 - k
        if cut.number[o + j, v] >= 0:
            i = o + cut.split[o + j, v]
            x = values[i, c, v]
            y = values[o + j, c, v]
            p = cut.part[o + j, v]
            values[i, c, v] = p * x + (1.0 - p) * y
            values[o + j, c, v] = x - y


@wp.kernel
def assemble(
    shapes: Shapes, places: Places, cut: WarpCut, sensors: int, clusters: int, lead: int,
    potentials: wp.array3d(dtype=wp.float32), matrix: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """The matrix of all functions, its lower half, from their pairs; in place."""
    f, g, v = wp.tid()
    if g > f:
        return
    e = v // sensors
    x = cut.number[f, v]
    y = cut.number[g, v]
    if x < 0 or y < 0:
        matrix[f, g, v] = wp.where(f == g, 1.0, 0.0)
        return
    value = matrix[f, g, v]
    for k in range(lead, potentials.shape[1]):
        value -= potentials[f, k, v] * potentials[g, k, v]
    b = f // clusters
    if b == g // clusters:
        u = places.choice[e, b]
        place = shapes.block[u] + wp.int64(x * shapes.functions[u] + y)
        inside = places.softness[e, b]
        own = shapes.energy[place]
        if inside != 0.0:
            own += inside * shapes.impedance[place]
        value += own / places.scale[e, b]
        if x == 0 and y == 0:
            value += places.tie[e, b]
    matrix[f, g, v] = value


@wp.kernel
def factorise(
    cut: WarpCut, matrix: wp.array3d(dtype=wp.float32), terminals: int,
    potentials: wp.array3d(dtype=wp.float32), dropped: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Cholesky factor L of every matrix; φ⁰ of the functions is replaced by L⁻¹ φ⁰."""
    v = wp.tid()
    n = matrix.shape[0]
    lost = int(0)
    for i in range(n):
        if cut.number[i, v] < 0:
            for t in range(terminals):
                potentials[i, t, v] = 0.0
        else:
            for j in range(i):
                total = matrix[i, j, v]
                for k in range(j):
                    total -= matrix[i, k, v] * matrix[j, k, v]
                matrix[i, j, v] = total / matrix[j, j, v]
            own = matrix[i, i, v]
            total = own
            for k in range(i):
                total -= matrix[i, k, v] * matrix[i, k, v]
            keep = float(1.0)
            if total > _DROPPED * wp.abs(own):
                matrix[i, i, v] = wp.sqrt(total)
            else:
                lost += 1
                keep = 0.0
                matrix[i, i, v] = 1.0
                for k in range(i):
                    matrix[i, k, v] = 0.0
            for t in range(terminals):
                right = keep * potentials[i, t, v]
                for k in range(i):
                    right -= matrix[i, k, v] * potentials[k, t, v]
                potentials[i, t, v] = right / matrix[i, i, v]
    dropped[v] = lost


@wp.kernel
def change(
    green: Response, functions: int, potentials: wp.array3d(dtype=wp.float32),
    capacitance: wp.array4d(dtype=wp.float32), delta: wp.array4d(dtype=wp.float32),
):  # fmt: skip
    """Maxwell matrices of the electrodes and their change [F], (e, s, m, m)."""
    i, j, v = wp.tid()
    e = v // delta.shape[1]
    s = v % delta.shape[1]
    total = float(0.0)
    for f in range(functions):
        total += potentials[f, i, v] * potentials[f, j, v]
    total = wp.min(green.unit * total, green.screened[i, j])
    delta[e, s, i, j] = total
    capacitance[e, s, i, j] = green.empty[i, j] + total
