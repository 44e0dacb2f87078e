"""Means of 1/r between clusters, each given by four points."""

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
BARRIER = 1e5
"""Energy of charge that is out of reach [1/m]."""
LIFTED = 1e-5
"""Clusters that were moved by less than this [m] count as where they are."""
_UPON = 0.1
"""Rectangles nearer to each other than so many of their shorter side lie upon each other."""
_WIDE = 4.0
"""Sides of a cluster, over its distance from a flat design, from which on its images are bounded:
four points are good to 0.1 % of their mean up to there."""


@compiled
def leaf_pairs(leaves, floor):
    """Mean of 1/r between bodies and within changing ones, and of -1/r to all images in the floor.

    Args:
        leaves: The clusters.
        floor: Height of the floor [m].

    Returns:
        Shape (l, l) [1/m].
    """
    points, extent, owner, soft = leaves.points, leaves.extent, leaves.owner, leaves.soft
    n = points.shape[0]
    out = np.empty((n, n), np.float32)
    image = np.empty((n, 4, 3))
    for j in range(n):
        for q in range(4):
            image[j, q, 0], image[j, q, 1] = points[j, q, 0], points[j, q, 1]
            image[j, q, 2] = 2.0 * floor - points[j, q, 2]
    shapes, mirrored = cluster_moments(points, extent), cluster_moments(image, extent)
    flat, below, rectangles = _flat(points, soft), _flat(image, soft), _rectangles(leaves)
    line, room = np.empty(shapes.shape[1], np.float32), np.empty((28, shapes.shape[1]), np.float32)
    behind = 0  # clusters of bodies before this one's
    for i in range(n):
        if owner[i] != owner[behind]:
            behind = i
        _far_means(shapes, i, mirrored, i + 1, line)
        _near_means(flat, i, below, i + 1, line, room)
        for j in range(i + 1):
            out[i, j] = -line[j]
        if behind > 0:
            _far_means(shapes, i, shapes, behind, line)
            _near_means(flat, i, flat, behind, line, room)
            for j in range(behind):
                out[i, j] += line[j]
        if leaves.within[i] > 0.0:
            _far_means(shapes, i, shapes, i, line)
            _near_rectangles(rectangles, extent, i, behind, line, room)
            line[i] = _self_mean(_arm(points[i, 0], points[i, 1]), _arm(points[i, 0], points[i, 2]))
            for j in range(behind, i + 1):
                out[i, j] += leaves.within[i] * line[j]
        for j in range(i):
            out[j, i] = out[i, j]
        out[i, i] += BARRIER * leaves.beyond[i] ** 3
    _add_lifted(leaves, out)
    return out


@compiled
def _add_lifted(leaves, out):
    """Add to pairs of a rigid body what they meet each other more for being lifted."""
    points, true = leaves.points, leaves.true
    n = points.shape[0]
    lifted = np.zeros(n, np.bool_)
    for i in range(n):
        for q in range(4):
            for k in range(3):
                if abs(points[i, q, k] - true[i, q, k]) > LIFTED:
                    lifted[i] = leaves.within[i] == 0.0
    for i in range(n):
        for j in range(i):
            if (lifted[i] or lifted[j]) and leaves.owner[i] == leaves.owner[j]:
                soft = max(leaves.soft[i], leaves.soft[j])
                more = mean_inverse(points[i], points[j], soft)
                more -= mean_inverse(true[i], true[j], soft)
                out[i, j] += more
                out[j, i] += more


@compiled
def bound_images(leaves, rows, pairs, green):
    """Let no cluster meet its own images in a flat design more than in a mirror at its face.

    Four points a distance d from their images stand for a wide rectangle as if it were met by as
    much as 1/(4 d) more than it is. Charge on it would cost too little energy, or none. Gradients
    do not follow this bound; it takes effect for bodies much wider than their gap only.

    Args:
        leaves: The clusters.
        rows: Their rows, shape (l, w).
        pairs: As of :func:`leaf_pairs`; the diagonal is raised.
        green: Green's function of the design.
    """
    if green.cover > 1.0:
        return
    points, image = leaves.points, np.empty((4, 3))
    for j in range(points.shape[0]):
        inverse, lowest = 0.0, points[j, 0, 2]
        for q in range(4):
            lowest = min(lowest, points[j, q, 2])
            inverse += 0.25 / max(points[j, q, 2] - green.box[1, 2], 1e-9)
            image[q, 0], image[q, 1] = points[j, q, 0], points[j, q, 1]
            image[q, 2] = 2.0 * green.floor - points[j, q, 2]
        side = math.sqrt(12.0 * _arm(points[j][0], points[j][1]) * _arm(points[j][0], points[j][2]))
        if inverse * side < _WIDE or lowest < green.box[1, 2]:
            continue
        met = mean_inverse(points[j], image, 0.0)
        for k in range(green.lead, rows.shape[1]):
            met += float(rows[j, k]) ** 2
        extra = met - _mirror_mean(2.0 / (inverse * side)) / side
        pairs[j, j] += max(0.0, extra) * smooth(10.0 * extra / met)


@compiled
def _mirror_mean(t):
    """Mean of 1/r between parallel unit squares a distance t apart, one above the other."""
    a, b, square = math.sqrt(1.0 + t * t), math.sqrt(2.0 + t * t), t * t
    whole = 2.0 * math.log((1.0 + b) / a) - t * math.atan(1.0 / (t * b))
    first = 0.5 * (b + (1.0 + square) * math.log((1.0 + b) / a))
    first -= 0.5 * (a + square * math.log((1.0 + a) / t))
    return 4.0 * (whole - 2.0 * first + (b**3 - 2.0 * a**3 + t**3) / 3.0)


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
def _far_means(shapes, i, others, count, out):
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
def _flat(points, soft):
    """Coordinates of the four points of each cluster, and its bound of 1/r: columns, (13, l)."""
    out = np.empty((13, points.shape[0]), np.float32)
    for j in range(points.shape[0]):
        for q in range(4):
            for i in range(3):
                out[3 * q + i, j] = points[j, q, i]
        out[12, j] = soft[j]
    return out


@compiled
def _near_means(flat, i, others, length, out, room):
    """Replace what is negative in a line by :func:`mean_inverse` of cluster i and those others."""
    count, n, width = 0, flat.shape[1], room.shape[1]
    for j in range(length):
        if at(out, j) < 0.0:
            for k in range(12):
                room[k, count] = at(others, k * n + j)
            bound = max(flat[12, i], others[12, j])
            room[12, count] = bound * bound * bound * bound + np.float32(1e-24)
            room[13, count] = j
            count += 1
    zero = splat(np.float32(0.0))
    for k in range(0, count, SIMD_WIDTH):
        total, bound = zero, span(room, 12 * width + k)
        for q in range(4):
            o = 3 * q * width + k
            ux, uy, uz = span(room, o), span(room, o + width), span(room, o + 2 * width)
            for p in range(4):
                o = 3 * p * n + i
                dx = vsub(splat(at(flat, o)), ux)
                dy = vsub(splat(at(flat, o + n)), uy)
                dz = vsub(splat(at(flat, o + 2 * n)), uz)
                square = dot(dx, dy, dz, dx, dy, dz, zero)
                fourth = vmadd(square, square, bound)
                total = vadd(total, rsqrt(vmul(fourth, rsqrt(fourth))))
        put_span(room, k, madd(np.float32(1.0 / 16.0), total, zero))  # the points are done with
    for k in range(count):
        out[int(room[13, k])] = at(room, k)


@compiled
def mean_inverse(first, second, soft):
    """Mean of 1/r [1/m] over four points of each of two clusters, shapes (4, 3).

    Distances count as ``soft`` [m] where they are much smaller.
    """
    bound = np.float32(soft**4 + 1e-24)
    total = np.float32(0.0)
    for p in range(4):
        for q in range(4):
            x = np.float32(first[p, 0] - second[q, 0])
            y = np.float32(first[p, 1] - second[q, 1])
            z = np.float32(first[p, 2] - second[q, 2])
            s = x * x + y * y + z * z
            fourth = s * s + bound
            total += rsqrt(fourth * rsqrt(fourth))
    return total / np.float32(16.0)


@compiled
def _arm(first, second):
    """Half the distance [m] between two of the four points."""
    total = 0.0
    for i in range(3):
        total += (first[i] - second[i]) ** 2
    return 0.5 * math.sqrt(total)


@compiled
def _rectangles(leaves):
    """The four points of clusters and :func:`rectangle_potential`'s frames, columns, (26, l).

    Those of rigid bodies, which nothing asks for, are left as they are.
    """
    points = leaves.points
    out = np.empty((26, points.shape[0]), np.float32)
    for j in range(points.shape[0]):
        if leaves.within[j] == 0.0:
            continue
        long, short = _arm(points[j, 0], points[j, 2]), _arm(points[j, 0], points[j, 1])
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
        table: As of :func:`_rectangles`, shape (26, l).
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
