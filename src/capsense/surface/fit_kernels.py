"""Compiled kernel: how far a surface lies from the triangles that stand for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense.scene.geometry_kernels import triangle_distance2

Array = NDArray[np.float64]

_FACING = 0.5
"""Least cosine between normals of a surface and of a triangle that stands for it."""


@kernel
def add_offsets(
    points: Array, normals: Array, weights: Array,
    corners: Array, planes: Array, centers: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """Add the weights of points, and their heights times weights, to the nearest triangles.

    Args:
        points: Points on the surface [m], shape (p, 3).
        normals: The surface's unit normals there, shape (p, 3).
        weights: Weights, shape (p,).
        corners: Triangles [m], shape (n, 3, 3).
        planes: Their unit normals, shape (n, 3). Triangles that face unlike a point's surface
            are passed over.
        centers: Centroids [m], shape (n, 3).
        reach: Distances from centroid to the farthest corner [m], shape (n,).
        out: Sums of weights and of heights [m] times weights, shape (n, 2).
    """
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, where = 1e300, -1
        for k in range(corners.shape[0]):
            dx, dy, dz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if best < 1e300:
                least = reach[k] + best
                if square >= least * least:
                    continue
            along = (
                normals[p, 0] * planes[k, 0] + normals[p, 1] * planes[k, 1]
                + normals[p, 2] * planes[k, 2]
            )  # fmt: skip
            if along <= _FACING:
                continue
            distance = np.sqrt(triangle_distance2(corners[k], x, y, z))
            if distance < best:
                best, where = distance, k
        if where >= 0:
            height = (
                planes[where, 0] * (x - centers[where, 0])
                + planes[where, 1] * (y - centers[where, 1])
                + planes[where, 2] * (z - centers[where, 2])
            )
            out[where, 0] += weights[p]
            out[where, 1] += weights[p] * height
