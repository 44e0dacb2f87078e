"""Means of 1/r between clusters of one surface, each given by four points, or its moments."""

from __future__ import annotations

import math

import numpy as np

from capsense._dense import WIDTH, mirror, padded, three
from capsense._jit import compiled, kernel
from capsense._simd import (
    WIDE,
    at,
    dot,
    horizontal_sum,
    madd,
    put_span,
    rsqrt,
    singles,
    vadd,
    vmadd,
    vmul,
    vsub,
    where_above,
    wide_span,
    wide_splat,
)
from capsense.field.face_kernels import smooth
from capsense.solver.bodies.panel_kernels import rectangle_potential
from capsense.solver.tree.rigid import ROUND, SOFT

FAR = 0.75
"""Clusters farther apart than so many of their joint extents are met by their moments; nearer ones
point by point, and in closed form if they are of one surface."""
_AWAY = 1e3
"""Where columns are that are no clusters' [m]."""
_TOGETHER = 64
"""Pairs of rectangles that are met at a time."""
_SQUARE = 2.97
"""Mean of 1/r in a square, times its side."""
_UPON = 0.1
"""Rectangles nearer to each other than so many of their shorter side lie upon each other."""


@kernel
def quadrature4(a, center, v, out):
    """Four points of equal weight with a centre and the two largest of its second moments.

    Args:
        a: Second central moments [m²], shape (3, 3); lost.
        center: [m], shape (3,).
        v: Room to work in, shape (3, 3).
        out: Filled [m], shape (4, 3).

    Returns:
        Length of a uniform rod with the largest second moment, and the distance below which 1/r
        from the points is bounded [m].
    """
    for i in range(3):
        for k in range(3):
            v[i, k] = 1.0 if i == k else 0.0
    for _ in range(6):  # Jacobi's rotations
        for p in range(2):
            for q in range(p + 1, 3):
                if abs(a[p, q]) < 1e-12 * (abs(a[p, p]) + abs(a[q, q])) + 1e-300:
                    continue
                angle = 0.5 * math.atan2(2.0 * a[p, q], a[q, q] - a[p, p])
                c, s = math.cos(angle), math.sin(angle)
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
    least = 0
    for i in range(1, 3):
        if a[i, i] < a[least, least]:
            least = i
    first, second = (least + 1) % 3, (least + 2) % 3
    if a[first, first] < a[second, second]:
        first, second = second, first
    long = math.sqrt(max(a[first, first], 0.0))
    short = math.sqrt(max(a[second, second], 0.0))
    for i in range(3):
        x, y = long * v[i, first], short * v[i, second]
        out[0, i], out[1, i] = center[i] + x + y, center[i] + x - y
        out[2, i], out[3, i] = center[i] - x + y, center[i] - x - y
    extent = math.sqrt(12.0) * long
    return extent, math.sqrt((SOFT * extent) ** 2 + ROUND * max(a[least, least], 0.0))


@compiled
def points_of_each(center, spread):
    """Four points, and distances below which 1/r is bounded, of clusters: (k, 4, 3) and (k,)."""
    count = center.shape[0]
    points, soft = np.empty((count, 4, 3)), np.empty(count)
    moments, turn = np.empty((3, 3)), np.empty((3, 3))
    for k in range(count):
        for i in range(3):
            for j in range(3):
                moments[i, j] = spread[k, i, j]
        _, soft[k] = quadrature4(moments, center[k], turn, points[k])
    return points, soft


@compiled
def add_means(points, extent, body, weight, tables, out):
    """Add the weighted means of 1/r within a body: between its clusters, and of each with itself.

    Args:
        points, extent: Of the clusters [m], shapes (l, 4, 3), (l,).
        body: The body's first cluster, the first whose row is wanted, the one behind its last, and
            how many times as large as in its table of means it is.
        weight: Of each row up to the diagonal, shape (l,).
        tables: :func:`cluster_moments` and :func:`rectangles` of the clusters; and their rows in
            the table of means, -1 for none, and where it stands, shape (l, 2).
        out: Rows up to the diagonal are added to [1/m], shape (l, l).
    """
    start, first, stop, size = body
    shapes, frames, known = tables
    line = np.zeros(shapes.shape[1] + WIDE, np.float32)
    near, room = np.empty((2, _TOGETHER), np.int64), np.empty((53, _TOGETHER), np.float32)
    count = np.int64(0)
    for i in range(first, stop):
        far_means(shapes, i, shapes, i, line)
        row, table = known[i, 0], singles(known[i, 1])
        if row >= 0:
            line[i] = table[row * (row + 3) // 2] / size
        else:
            line[i] = _self_mean(arm(points[i, 0], points[i, 1]), arm(points[i, 0], points[i, 2]))
        for j in range(start, i + 1, WIDE):
            end = min(j + WIDE, i + 1)
            if not _some_below_zero(line, j):
                add_line(line, weight[i], (j, end), out, i)
                continue
            for k in range(j, end):
                if line[k] < 0.0 and row >= 0 and known[k, 0] >= 0:
                    high, low = max(row, known[k, 0]), min(row, known[k, 0])
                    line[k] = table[high * (high + 1) // 2 + low] / size
                if line[k] < 0.0:
                    near[0, count], near[1, count] = i, k
                    count += 1
                else:
                    out[i, k] += weight[i] * line[k]
            if count + WIDE > _TOGETHER:
                _add_rectangles(frames, extent, near, count, weight, room, out)
                count = np.int64(0)
    _add_rectangles(frames, extent, near, count, weight, room, out)


@kernel
def _some_below_zero(line, start):
    """Whether one of the sixteen numbers of a line from ``start`` on is below zero."""
    zero, one = wide_splat(np.float32(0.0)), wide_splat(np.float32(1.0))
    return horizontal_sum(where_above(zero, wide_span(line, start), one, zero)) > 0.0


@kernel
def add_line(line, factor, span, out, row):
    """Add some numbers of a line, times a factor, to a row of ``out``; from span[0] to span[1]."""
    (start, stop), factor = span, np.float32(factor)
    whole, o = stop - (stop - start) % WIDE, row * out.shape[1]
    for j in range(start, whole, WIDE):
        put_span(out, o + j, madd(factor, wide_span(line, j), wide_span(out, o + j)))
    for j in range(whole, stop):
        out[row, j] += factor * line[j]


@compiled
def means_between(points):
    """Means of 1/r between all clusters of a body, shape (k, 4, 3) -> (k, k)."""
    n = points.shape[0]
    out, weight, known = np.zeros((n, n), np.float32), np.ones(n), np.full((n, 2), -1)
    extent = np.empty(n)
    for j in range(n):
        extent[j] = extent_of(points[j])
    tables = cluster_moments(points, extent), rectangles(points, weight), known
    add_means(points, extent, (np.int64(0), np.int64(0), n, 1.0), weight, tables, out)
    mirror(out)
    return out


@compiled
def patch_means(center, area):
    """About the means of 1/r between patches of a surface, and of each with itself.

    Args:
        center: Their middles [m], shape (3, n).
        area: Their areas [m²], shape (n,).

    Returns:
        Shape (n, n) [1/m]; bounded as in a square as large as the larger one.
    """
    n = area.shape[0]
    out = np.empty((n, n))
    for i in range(n):
        line, x, y, z, own = out[i], center[0, i], center[1, i], center[2, i], area[i]
        for j in range(n):
            square = (center[0, j] - x) ** 2 + (center[1, j] - y) ** 2 + (center[2, j] - z) ** 2
            bound = max(area[j], own) / (_SQUARE * _SQUARE)
            line[j] = 1.0 / math.sqrt(math.sqrt(square * square + bound * bound))
    return out


@compiled
def cluster_moments(points, extent):
    """Centre, the two arms and the reach of each cluster, a column each, shape (10, w).

    There are a multiple of ``WIDTH`` columns; the last are no clusters', and far away.
    """
    out = np.zeros((10, padded(points.shape[0], WIDTH)), np.float32)
    for j in range(points.shape[0], out.shape[1]):
        out[0, j] = _AWAY
    for j in range(points.shape[0]):
        for i in range(3):
            out[i, j] = 0.5 * (points[j, 0, i] + points[j, 3, i])
            out[3 + i, j] = 0.5 * (points[j, 0, i] - points[j, 1, i])
            out[6 + i, j] = 0.5 * (points[j, 0, i] - points[j, 2, i])
        out[9, j] = FAR * extent[j]
    return out


@kernel
def far_means(shapes, i, others, count, out):
    """Means of 1/r between cluster i and the first others, by second moments; -1 for near ones.

    Returns:
        Whether there are near ones.
    """
    some = wide_splat(np.float32(0.0))
    width, zero, near = shapes.shape[1], wide_splat(np.float32(0.0)), wide_splat(np.float32(-1.0))
    x, y, z = wide_splat(shapes[0, i]), wide_splat(shapes[1, i]), wide_splat(shapes[2, i])
    ax, ay, az = shapes[3, i], shapes[4, i], shapes[5, i]
    bx, by, bz = shapes[6, i], shapes[7, i], shapes[8, i]
    own = wide_splat(ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz)
    reach = wide_splat(shapes[9, i])
    for j in range(0, count, WIDE):
        ox, oy, oz = three(others, j, width)
        dx, dy, dz = vsub(x, ox), vsub(y, oy), vsub(z, oz)
        cx, cy, cz = three(others, 3 * width + j, width)
        ex, ey, ez = three(others, 6 * width + j, width)
        square = dot(dx, dy, dz, dx, dy, dz, wide_splat(np.float32(1e-12)))
        inverse = rsqrt(square)
        second = vmul(inverse, inverse)
        a = madd(ax, dx, madd(ay, dy, madd(az, dz, zero)))
        b = madd(bx, dx, madd(by, dy, madd(bz, dz, zero)))
        c, e = dot(cx, cy, cz, dx, dy, dz, zero), dot(ex, ey, ez, dx, dy, dz, zero)
        whole = dot(cx, cy, cz, cx, cy, cz, dot(ex, ey, ez, ex, ey, ez, own))
        along = vmadd(a, a, vmadd(b, b, vmadd(c, c, vmul(e, e))))
        excess = madd(np.float32(1.5), vmul(along, second), madd(np.float32(-0.5), whole, zero))
        value = vmadd(vmul(inverse, second), excess, inverse)
        far = vadd(reach, wide_span(others, 9 * width + j))
        limit = vmul(far, far)
        put_span(out, j, where_above(square, limit, value, near))
        some = where_above(square, limit, some, near)
    return horizontal_sum(some) < 0.0


@kernel
def arm(first, second):
    """Half the distance [m] between two of the four points."""
    total = 0.0
    for i in range(3):
        total += (first[i] - second[i]) ** 2
    return 0.5 * math.sqrt(total)


@kernel
def extent_of(points):
    """Length [m] of a uniform rod with the largest second moment of four points, shape (4, 3)."""
    return math.sqrt(12.0) * max(arm(points[0], points[1]), arm(points[0], points[2]))


@compiled
def rectangles(points, wanted):
    """The four points of clusters and :func:`rectangle_potential`'s frames, columns, (26, l).

    Those that are not ``wanted`` (l,) are left as they are.
    """
    out = np.empty((26, points.shape[0]), np.float32)
    for j in range(points.shape[0]):
        if wanted[j] == 0.0:
            continue
        long, short = arm(points[j, 0], points[j, 2]), arm(points[j, 0], points[j, 1])
        for i in range(3):
            for q in range(4):
                out[3 * q + i, j] = points[j, q, i]
            out[12 + i, j] = 0.5 * (points[j, 0, i] + points[j, 3, i])
            out[15 + i, j] = 0.5 * (points[j, 0, i] - points[j, 2, i]) / (long + 1e-9)
            out[18 + i, j] = 0.5 * (points[j, 0, i] - points[j, 1, i]) / (short + 1e-9)
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            out[21 + i, j] = out[15 + a, j] * out[18 + b, j] - out[15 + b, j] * out[18 + a, j]
        out[24, j], out[25, j] = math.sqrt(3.0) * long + 1e-9, math.sqrt(3.0) * short + 1e-9
    return out


@kernel
def _add_rectangles(table, extent, near, count, weight, room, out):
    """Add the weighted means of 1/r between pairs of rectangles of one surface.

    It is that over four points on one of them, the other in closed form, and the other way about:
    the larger one counts in closed form.

    Args:
        table: As of :func:`rectangles`, shape (26, l).
        extent: Of the clusters [m], shape (l,).
        near: The two numbers of each pair, shape (2, w).
        count: How many pairs there are.
        weight: Of the first of each, shape (l,).
        room: Room to work in, shape (53, w).
        out: As there.
    """
    n, width = table.shape[1], room.shape[1]
    for k in range(count):
        i, j = near[0, k], near[1, k]
        for q in range(26):
            room[q, k], room[26 + q, k] = at(table, q * n + i), at(table, q * n + j)
        ratio = (extent[i] / extent[j]) ** 4
        room[52, k] = ratio / (1.0 + ratio)
    for k in range(0, count, WIDE):
        mine = theirs = wide_splat(np.float32(0.0))
        for q in range(4):
            point, other = 3 * q * width + k, (26 + 3 * q) * width + k
            mine = vadd(mine, rectangle_potential(room, 12 * width + k, room, other))
            theirs = vadd(theirs, rectangle_potential(room, 38 * width + k, room, point))
        put_span(room, k, vmadd(wide_span(room, 52 * width + k), vsub(mine, theirs), theirs))
    for k in range(count):
        i, j = near[0, k], near[1, k]
        out[i, j] += weight[i] * _upon(table, i, j, 0.25 * at(room, k))


@kernel
def _upon(table, i, j, value):
    """Bound a mean of 1/r between rectangles that all but coincide, as the two faces of a foil.

    Four points find some per cent more than a rectangle has with itself: equal and opposite charge
    on the two faces would cost less than no energy. Near each other they have what one has with
    itself, less 2π times their distance over its area.
    """
    short = 2.0 * min(table[25, i], table[25, j])
    gap = 0.0
    for q in range(3):
        gap += float(table[12 + q, i] - table[12 + q, j]) ** 2
    gap = math.sqrt(gap)
    if gap >= _UPON * short:
        return value
    own, area = 1.0, 0.0
    for x in (i, j):
        own *= _self_mean(table[24, x] / math.sqrt(3.0), table[25, x] / math.sqrt(3.0))
        area = max(area, 4.0 * float(table[24, x]) * float(table[25, x]))
    bound = math.sqrt(own) - 2.0 * math.pi * gap / area
    return value + smooth(1.0 - gap / (_UPON * short)) * min(0.0, bound - value)


@kernel
def _self_mean(first, second):
    """Mean of 1/r [1/m] within a rectangle of two given standard deviations [m]."""
    a, b = math.sqrt(12.0) * first + 1e-9, math.sqrt(12.0) * second + 1e-9
    d = math.sqrt(a * a + b * b)
    return 2.0 * (a * a * b * math.log((b + d) / a) + a * b * b * math.log((a + d) / b)
                  + (a**3 + b**3 - d**3) / 3.0) / (a * a * b * b)  # fmt: skip
