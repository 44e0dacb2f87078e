"""Means of 1/r between clusters of one surface, each given by four points, or its moments."""

from __future__ import annotations

import math

import numpy as np

from capsense._dense import WIDTH
from capsense._jit import compiled
from capsense._simd import (
    SIMD_WIDTH,
    at,
    dot,
    madd,
    put_span,
    rsqrt,
    singles,
    span,
    splat,
    vadd,
    vmadd,
    vmul,
    vsub,
    where_above,
)
from capsense.elements.panel_kernels import rectangle_potential
from capsense.field.green_kernels import smooth

FAR = 0.75
"""Clusters farther apart than so many of their joint extents are met by their moments; nearer ones
point by point, and in closed form if they are of one surface."""
_UPON = 0.1
"""Rectangles nearer to each other than so many of their shorter side lie upon each other."""


@compiled
def means_within(points, extent, size, i, start, tables, line, room):
    """Fill a line with the means of 1/r within a body: of cluster i, those before it, and itself.

    Args:
        points, extent: Of the clusters [m], shapes (l, 4, 3), (l,).
        size: How many times as large as in its table of means the body is.
        i, start: The cluster, and the first one of its body.
        tables: :func:`cluster_moments` and :func:`rectangles` of the clusters; and their rows in
            the table of means, -1 for none, and where it stands, shape (l, 2).
        line: Filled from ``start`` to ``i`` [1/m], shape (w,).
        room: Room to work in, shape (28, w).
    """
    shapes, frames, known = tables
    far_means(shapes, i, shapes, i, line)
    row = known[i, 0]
    if row >= 0:
        table, o = singles(known[i, 1]), row * (row + 1) // 2
        for j in range(start, i + 1):
            if known[j, 0] >= 0:
                line[j] = table[o + known[j, 0]] / size
    else:
        line[i] = _self_mean(arm(points[i, 0], points[i, 1]), arm(points[i, 0], points[i, 2]))
    _near_rectangles(frames, extent, i, start, line, room)


@compiled
def means_between(points, extent):
    """Means of 1/r between all clusters of a body, shapes (k, 4, 3), (k,) -> (k, k)."""
    n = points.shape[0]
    out, wanted, known = np.empty((n, n), np.float32), np.ones(n), np.full((n, 2), -1)
    tables = cluster_moments(points, extent), rectangles(points, wanted), known
    width = tables[0].shape[1]
    line, room = np.empty(width, np.float32), np.empty((28, width), np.float32)
    for i in range(n):
        means_within(points, extent, 1.0, i, 0, tables, line, room)
        for j in range(i + 1):
            out[i, j] = out[j, i] = line[j]
    return out


@compiled
def cluster_moments(points, extent):
    """Centre, the two arms and the reach of each cluster, a column each, shape (10, w).

    There are as many columns as :func:`room_for` says; the last are no clusters'.
    """
    out = np.zeros((10, room_for(points.shape[0])), np.float32)
    for j in range(points.shape[0]):
        for i in range(3):
            out[i, j] = 0.5 * (points[j, 0, i] + points[j, 3, i])
            out[3 + i, j] = 0.5 * (points[j, 0, i] - points[j, 1, i])
            out[6 + i, j] = 0.5 * (points[j, 0, i] - points[j, 2, i])
        out[9, j] = FAR * extent[j]
    return out


@compiled
def room_for(clusters):
    """Columns of a table of so many clusters."""
    return WIDTH * ((clusters + WIDTH - 1) // WIDTH)


@compiled
def far_means(shapes, i, others, count, out):
    """Means of 1/r between cluster i and the first others, by second moments; -1 for near ones."""
    width, zero, near = shapes.shape[1], splat(np.float32(0.0)), splat(np.float32(-1.0))
    x, y, z = splat(at(shapes, i)), splat(at(shapes, width + i)), splat(at(shapes, 2 * width + i))
    ax, ay, az = shapes[3, i], shapes[4, i], shapes[5, i]
    bx, by, bz = shapes[6, i], shapes[7, i], shapes[8, i]
    own = splat(ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz)
    reach = splat(shapes[9, i])
    for j in range(0, count, SIMD_WIDTH):
        dx, dy, dz = (
            vsub(x, span(others, j)),
            vsub(y, span(others, width + j)),
            vsub(z, span(others, 2 * width + j)),
        )
        cx, cy, cz = (
            span(others, 3 * width + j), span(others, 4 * width + j), span(others, 5 * width + j)
        )  # fmt: skip
        ex, ey, ez = (
            span(others, 6 * width + j), span(others, 7 * width + j), span(others, 8 * width + j)
        )  # fmt: skip
        square = dot(dx, dy, dz, dx, dy, dz, splat(np.float32(1e-12)))
        inverse = rsqrt(square)
        second = vmul(inverse, inverse)
        a = madd(ax, dx, madd(ay, dy, madd(az, dz, zero)))
        b = madd(bx, dx, madd(by, dy, madd(bz, dz, zero)))
        c, e = dot(cx, cy, cz, dx, dy, dz, zero), dot(ex, ey, ez, dx, dy, dz, zero)
        whole = dot(cx, cy, cz, cx, cy, cz, dot(ex, ey, ez, ex, ey, ez, own))
        along = vmadd(a, a, vmadd(b, b, vmadd(c, c, vmul(e, e))))
        excess = madd(np.float32(1.5), vmul(along, second), madd(np.float32(-0.5), whole, zero))
        value = vmadd(vmul(inverse, second), excess, inverse)
        far = vadd(reach, span(others, 9 * width + j))
        put_span(out, j, where_above(square, vmul(far, far), value, near))


@compiled
def arm(first, second):
    """Half the distance [m] between two of the four points."""
    total = 0.0
    for i in range(3):
        total += (first[i] - second[i]) ** 2
    return 0.5 * math.sqrt(total)


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


@compiled
def _near_rectangles(table, extent, i, start, out, room):
    """Replace what is negative in a line by the mean of 1/r between rectangles of one surface.

    It is that over four points on one of them, the other in closed form, and the other way about:
    the larger one counts in closed form.

    Args:
        table: As of :func:`rectangles`, shape (26, l).
        extent: Of the clusters [m], shape (l,).
        i, start: The cluster, and the first of those before it that are looked at.
        out: The line, shape (w,).
        room: Room to work in, shape (28, w).
    """
    count, n, width, own = 0, table.shape[1], room.shape[1], np.empty((26, SIMD_WIDTH), np.float32)
    for k in range(26):
        put_span(own, SIMD_WIDTH * k, splat(at(table, k * n + i)))
    for j in range(start, i):
        if at(out, j) < 0.0:
            for k in range(26):
                room[k, count] = at(table, k * n + j)
            ratio = (extent[i] / extent[j]) ** 4
            room[26, count], room[27, count] = ratio / (1.0 + ratio), j
            count += 1
    for k in range(0, count, SIMD_WIDTH):
        mine = theirs = splat(np.float32(0.0))
        for q in range(4):
            mine = vadd(mine, rectangle_potential(own, 12 * SIMD_WIDTH, room, 3 * q * width + k))
            theirs = vadd(
                theirs, rectangle_potential(room, 12 * width + k, own, 3 * q * SIMD_WIDTH)
            )
        put_span(room, k, vmadd(span(room, 26 * width + k), vsub(mine, theirs), theirs))
    for k in range(count):
        j = int(room[27, k])
        out[j] = _upon(table, i, j, 0.25 * at(room, k))


@compiled
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


@compiled
def _self_mean(first, second):
    """Mean of 1/r [1/m] within a rectangle of two given standard deviations [m]."""
    a, b = math.sqrt(12.0) * first + 1e-9, math.sqrt(12.0) * second + 1e-9
    d = math.sqrt(a * a + b * b)
    return 2.0 * (a * a * b * math.log((b + d) / a) + a * b * b * math.log((a + d) / b)
                  + (a**3 + b**3 - d**3) / 3.0) / (a * a * b * b)  # fmt: skip
