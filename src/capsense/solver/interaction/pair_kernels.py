"""Means of 1/r between clusters, each given by four points."""

from __future__ import annotations

import math

import numpy as np

from capsense._dense import mirror, three
from capsense._jit import compiled, kernel
from capsense._simd import (
    WIDE,
    at,
    dot,
    madd,
    put_span,
    rsqrt,
    vadd,
    vmadd,
    vmul,
    vsub,
    wide_span,
    wide_splat,
)
from capsense.field.face_kernels import on_face, smooth
from capsense.solver.interaction.layer_kernels import charged
from capsense.solver.tree.mean_kernels import (
    add_line,
    add_means,
    arm,
    cluster_moments,
    far_means,
    rectangles,
)

LIFTED = 1e-5
"""Clusters that were moved by less than this [m] count as where they are."""
WIDE_CLUSTER = 4.0
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
    points, extent, owner, soft = (
        leaves.points,
        leaves.extent,
        leaves.owner,
        leaves.softening_length,
    )
    n = points.shape[0]
    out = np.zeros((n, n), np.float32)
    image = np.empty((n, 4, 3))
    for j in range(n):
        for q in range(4):
            image[j, q, 0], image[j, q, 1] = points[j, q, 0], points[j, q, 1]
            image[j, q, 2] = 2.0 * floor - points[j, q, 2]
    shapes, mirrored = cluster_moments(points, extent), cluster_moments(image, extent)
    flat, below = _flat(points, soft), _flat(image, soft)
    line, room = np.empty(shapes.shape[1], np.float32), np.empty((14, shapes.shape[1]), np.float32)
    behind = 0  # clusters of bodies before this one's
    for i in range(n):
        if owner[i] != owner[behind]:
            behind = i
        if far_means(shapes, i, mirrored, i + 1, line):
            _near_means(flat, i, below, i + 1, line, room)
        add_line(line, -1.0, (np.int64(0), i + 1), out, i)
        if behind > 0:
            if far_means(shapes, i, shapes, behind, line):
                _near_means(flat, i, flat, behind, line, room)
            add_line(line, 1.0, (np.int64(0), behind), out, i)
        out[i, i] += leaves.barrier[i]
    tables, start = (
        (shapes, rectangles(points, leaves.self_interaction_weight), leaves.table_rows),
        np.int64(0),
    )
    for i in range(n):
        if i + 1 == n or owner[i + 1] != owner[i]:
            if leaves.self_interaction_weight[i] > 0.0:
                body = start, start, i + 1, leaves.size[i]
                add_means(points, extent, body, leaves.self_interaction_weight, tables, out)
            start = i + 1
    _add_lifted(leaves, flat, line, room, out)
    mirror(out)
    return out


@compiled
def _add_lifted(leaves, flat, line, room, out):
    """Add to pairs of a rigid body what they meet each other more for being lifted.

    Args:
        leaves: The clusters.
        flat: :func:`_flat` of their points.
        line, room: Room to work in.
        out: Rows up to the diagonal are added to [1/m], shape (l, l).
    """
    points, true, owner = leaves.points, leaves.true, leaves.owner
    n = points.shape[0]
    lifted, some = np.zeros(n, np.bool_), False
    for i in range(n):
        for q in range(4):
            for k in range(3):
                if abs(points[i, q, k] - true[i, q, k]) > LIFTED:
                    lifted[i] = leaves.self_interaction_weight[i] == 0.0 and charged(leaves, i)
        some = some or lifted[i]
    if not some:
        return
    before, unlifted = _flat(true, leaves.softening_length), np.empty(line.shape[0], np.float32)
    for i in range(n):
        for j in range(i):
            wanted = owner[i] == owner[j] and (lifted[i] or lifted[j])
            line[j] = unlifted[j] = np.float32(-1.0) if wanted else np.float32(0.0)
        _near_means(flat, i, flat, i, line, room)
        _near_means(before, i, before, i, unlifted, room)
        for j in range(i):
            out[i, j] += line[j] - unlifted[j]


@compiled
def bound_images(leaves, rows, pairs, green):
    """Let no cluster meet its own images in a design more than in a mirror at its face.

    Four points a distance d from their images stand for a wide rectangle as if it were met by as
    much as 1/(4 d) more than it is. Charge on it would cost too little energy, or none. Gradients
    do not follow this bound; it takes effect for bodies much wider than their gap only.

    Args:
        leaves: The clusters.
        rows: Their rows, shape (l, w).
        pairs: As of :func:`leaf_pairs`; the diagonal is raised.
        green: Green's function of the design.
    """
    if not green.space.has_face:
        return
    points, image, face = leaves.points, np.empty((4, 3)), green.gap.face[1, 2]
    for j in range(points.shape[0]):
        if not charged(leaves, j):
            continue
        inverse, lowest = 0.0, math.inf
        for q in range(4):
            p = points[j, q]
            height = on_face(p[0], p[1], p[2], green.gap.curvature)[2] - face
            lowest = min(lowest, height)
            inverse += 0.25 / max(height, 1e-9)
            image[q, 0], image[q, 1] = points[j, q, 0], points[j, q, 1]
            image[q, 2] = 2.0 * green.floor - points[j, q, 2]
        side = math.sqrt(12.0 * arm(points[j][0], points[j][1]) * arm(points[j][0], points[j][2]))
        if inverse * side < WIDE_CLUSTER or lowest < 0.0:
            continue
        met = mean_inverse(points[j], image, 0.0)
        for k in range(green.phi_columns, rows.shape[1]):
            met += float(rows[j, k]) ** 2
        extra = met - _mirror_mean(2.0 / (inverse * side)) / side
        pairs[j, j] += max(0.0, extra) * smooth(10.0 * extra / met)


@kernel
def _mirror_mean(t):
    """Mean of 1/r between parallel unit squares a distance t apart, one above the other."""
    a, b, square = math.sqrt(1.0 + t * t), math.sqrt(2.0 + t * t), t * t
    whole = 2.0 * math.log((1.0 + b) / a) - t * math.atan(1.0 / (t * b))
    first = 0.5 * (b + (1.0 + square) * math.log((1.0 + b) / a))
    first -= 0.5 * (a + square * math.log((1.0 + a) / t))
    return 4.0 * (whole - 2.0 * first + (b**3 - 2.0 * a**3 + t**3) / 3.0)


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


@kernel
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
    zero = wide_splat(np.float32(0.0))
    for k in range(0, count, WIDE):
        total, bound = zero, wide_span(room, 12 * width + k)
        for q in range(4):
            o = 3 * q * width + k
            ux, uy, uz = three(room, o, width)
            for p in range(4):
                o = 3 * p * n + i
                dx = vsub(wide_splat(at(flat, o)), ux)
                dy = vsub(wide_splat(at(flat, o + n)), uy)
                dz = vsub(wide_splat(at(flat, o + 2 * n)), uz)
                square = dot(dx, dy, dz, dx, dy, dz, zero)
                fourth = vmadd(square, square, bound)
                total = vadd(total, rsqrt(vmul(fourth, rsqrt(fourth))))
        put_span(room, k, madd(np.float32(1.0 / 16.0), total, zero))  # the points are done with
    for k in range(count):
        out[int(room[13, k])] = at(room, k)


@kernel
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
