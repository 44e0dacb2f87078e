"""Means of 1/r between clusters, each given by four points."""

from __future__ import annotations

import math

import numpy as np

from capsense.surface.vector_kernels import fast, rsqrt

_FAR = 1.5
"""Clusters farther apart than so many of their joint extents are met by their moments."""
_SOFT = 0.15
"""Distance, as a part of the larger extent, below which 1/r of two points is bounded: clusters
that coincide then have less energy between them than each has alone."""


@fast
def leaf_pairs(points, extent, owner, floor, out):
    """Mean of 1/r between bodies, and of -1/r to all images in the floor.

    Args:
        points: Four points of each cluster [m], shape (l, 4, 3).
        extent: Extents [m], shape (l,).
        owner: Body of each cluster, ascending, shape (l,).
        floor: Height of the floor [m].
        out: Filled [1/m], shape (l, l).
    """
    n = points.shape[0]
    image = points.copy()
    for j in range(n):
        for q in range(4):
            image[j, q, 2] = 2.0 * floor - points[j, q, 2]
    shapes, mirrored = _moments(points, extent), _moments(image, extent)
    line = np.empty(n, np.float32)
    behind = 0  # clusters of bodies before this one's
    for i in range(n):
        if owner[i] != owner[behind]:
            behind = i
        _far_means(shapes, i, mirrored, line[: i + 1])
        for j in range(i + 1):
            if line[j] < 0.0:
                line[j] = mean_inverse(points[i], image[j], max(extent[i], extent[j]))
            out[i, j] = -line[j]
        if behind > 0:
            _far_means(shapes, i, shapes, line[:behind])
            for j in range(behind):
                if line[j] < 0.0:
                    line[j] = mean_inverse(points[i], points[j], max(extent[i], extent[j]))
                out[i, j] += line[j]
        for j in range(i):
            out[j, i] = out[i, j]


@fast
def _moments(points, extent):
    """Centre, the two arms and the reach of each cluster, a column each, shape (10, l)."""
    out = np.empty((10, points.shape[0]), np.float32)
    for j in range(points.shape[0]):
        for i in range(3):
            out[i, j] = 0.5 * (points[j, 0, i] + points[j, 3, i])
            out[3 + i, j] = 0.5 * (points[j, 0, i] - points[j, 1, i])
            out[6 + i, j] = 0.5 * (points[j, 0, i] - points[j, 2, i])
        out[9, j] = _FAR * extent[j]
    return out


@fast
def _far_means(shapes, i, others, out):
    """Means of 1/r between cluster i and others, by second moments; -1 for those that are near."""
    half, one = np.float32(0.5), np.float32(1.0)
    x, y, z, reach = shapes[0, i], shapes[1, i], shapes[2, i], shapes[9, i]
    ax, ay, az = shapes[3, i], shapes[4, i], shapes[5, i]
    bx, by, bz = shapes[6, i], shapes[7, i], shapes[8, i]
    own = ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz
    for j in range(out.shape[0]):
        dx, dy, dz = x - others[0, j], y - others[1, j], z - others[2, j]
        cx, cy, cz = others[3, j], others[4, j], others[5, j]
        ex, ey, ez = others[6, j], others[7, j], others[8, j]
        square = dx * dx + dy * dy + dz * dz
        inverse = rsqrt(square + np.float32(1e-12))
        a = ax * dx + ay * dy + az * dz
        b = bx * dx + by * dy + bz * dz
        c = cx * dx + cy * dy + cz * dz
        e = ex * dx + ey * dy + ez * dz
        whole = own + cx * cx + cy * cy + cz * cz + ex * ex + ey * ey + ez * ez
        along = np.float32(3.0) * (a * a + b * b + c * c + e * e) * inverse * inverse
        value = inverse * (one + half * (along - whole) * inverse * inverse)
        far = reach + others[9, j]
        out[j] = value if square > far * far else -one


@fast
def mean_inverse(first, second, extent):
    """Mean of a bounded 1/r [1/m] over four points of each of two clusters, shapes (4, 3)."""
    bound = (_SOFT * extent) ** 4
    total = 0.0
    for p in range(4):
        for q in range(4):
            x = first[p, 0] - second[q, 0]
            y = first[p, 1] - second[q, 1]
            z = first[p, 2] - second[q, 2]
            s = x * x + y * y + z * z
            total += 1.0 / math.sqrt(math.sqrt(s * s + bound))
    return total / 16.0
