"""Reduced triangle meshes moved to the mean place of the surface that they stand for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.surface import tree_kernels

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDS = 2
_SWEEPS = 8
_FARTHEST = 0.3
"""A triangle is not moved by more than this part of its size."""
_FINE = 20
"""Of surfaces of so many times as many triangles, centroids tell enough."""
_INNER = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6
"""Barycentric coordinates of three points that integrate quadratic functions."""


def fitted(vertices: Array, faces: Index, triangles: Array) -> Array:
    """Move vertices along their normals until every triangle lies at its surface's mean height.

    Triangles with corners on a curved surface lie within it, so that a round body comes out too
    small. To first order a conductor's capacitance depends on the mean height alone.

    Args:
        vertices: Vertices of the reduced surface [m], shape (n, 3).
        faces: Its triangles, wound like those of the surface, shape (m, 3).
        triangles: Corners of the surface [m], shape (k, 3, 3).

    Returns:
        Vertices [m], shape (n, 3).
    """
    inner = _INNER if len(triangles) < _FINE * len(faces) else np.full((1, 3), 1 / 3)
    points = (inner @ triangles).reshape(-1, 3)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    double = np.linalg.norm(cross, axis=1)
    weights = np.repeat(double, len(inner))
    normals = np.repeat(cross / np.maximum(double, 1e-300)[:, None], len(inner), axis=0)
    moved = np.array(vertices)
    for _ in range(_ROUNDS):
        moved += _step(moved, faces, points, normals, weights)
    return moved


def _step(vertices: Array, faces: Index, points: Array, normals: Array, weights: Array) -> Array:
    corners = np.ascontiguousarray(vertices[faces])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    planes = cross / np.maximum(double, 1e-300)[:, None]
    centers = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    sums = np.zeros((len(faces), 2))
    tree_kernels.add_offsets(points, normals, weights, corners, planes, centers, reach, sums)
    height = sums[:, 1] / np.maximum(sums[:, 0], 1e-300)
    limit = _FARTHEST * np.sqrt(0.5 * double)
    height = np.clip(height, -limit, limit)

    n, corner = len(vertices), faces.reshape(-1)
    average = np.stack([np.bincount(corner, np.repeat(cross[:, k], 3), n) for k in range(3)], 1)
    average = average / np.maximum(np.linalg.norm(average, axis=1), 1e-300)[:, None]
    along = np.einsum("mki,mi->mk", average[faces], planes)
    share = double[:, None] * along
    norm = np.maximum(np.bincount(corner, np.repeat(double, 3), n), 1e-300)
    move = np.zeros(n)
    for _ in range(_SWEEPS):
        lack = height - (move[faces] * along).mean(axis=1)
        move += np.bincount(corner, (share * lack[:, None]).reshape(-1), n) / norm
    return move[:, None] * average
