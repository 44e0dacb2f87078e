"""Point clouds as surfaces: of scanners, of perspective depth cameras, of samples on a shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.shape import as_points
from capsense.scene.surface_mesh import SHEET_THICKNESS, RestSurface, SurfaceMesh

Array = NDArray[np.float64]

_NEAR = 8
"""Neighbours that tell how much surface a point stands for, and how it is inclined."""
_FEWEST = 16
_MOST = 50_000


def point_surface(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    spacing: float | None = None,
    thickness: float = SHEET_THICKNESS,
) -> SurfaceMesh:
    """The surface that a cloud of points lies on, as a shape: a small flat piece at each of them.

    Pieces are equilateral triangles with the second moments of the square that a point stands
    for, π d² / 8 with d the distance of its eighth neighbour. They do not touch each other; the
    shape has no inside. So it suits conductors; a dielectric is a sheet of ``thickness``.

    Args:
        points: Points [m], shape (n, 3), at least 16.
        normals: Normals of any length, shape (n, 3), those of one side pointing alike; by default
            those of planes through each point and its eight neighbours, towards the origin.
        spacing: Points in one cell of a cubic grid of this pitch [m] become one, in their middle;
            by default all stay.
        thickness: Of a dielectric [m].

    Raises:
        SceneError: Wrong shapes, fewer than 16 or more than 50,000 points, a number that is not
            finite, or a normal without length.
    """
    p = as_points(points)
    n = None if normals is None else as_points(normals)
    if n is not None and n.shape != p.shape:
        raise SceneError(f"normals have shape {n.shape}, but points {p.shape}; give one a point")
    for name, values in (("points", p), ("normals", p if n is None else n)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise SceneError(f"{name}[{bad[0]}] is {values[bad[0]].tolist()}; give finite numbers")
    if spacing is not None:
        p, n = _merged(p, n, spacing)
    if not _FEWEST <= len(p) <= _MOST:
        raise SceneError(
            f"there are {len(p)} points; give {_FEWEST} to {_MOST:,}, of which spacing=0.005 "
            "makes one in every 5 mm"
        )
    from scipy.spatial import cKDTree

    distance, near = cKDTree(p).query(p, k=_NEAR + 1)
    n = _fitted(p, near) if n is None else _unit(n)
    side = np.sqrt(np.pi / _NEAR) * np.maximum(distance[:, -1], 1e-9)  # of the square
    across = _unit(np.cross(n, np.eye(3)[np.abs(n).argmin(axis=1)]))
    turn = 2 * np.pi / 3 * np.arange(3)[:, None, None]
    arms = np.cos(turn) * across + np.sin(turn) * np.cross(n, across)  # (3, n, 3)
    corners = p[:, None] + np.sqrt(2 / 3) * side[:, None, None] * arms.transpose(1, 0, 2)
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return SurfaceMesh(vertices, RestSurface(vertices, faces, thickness))


def _merged(p: Array, n: Array | None, spacing: float) -> tuple[Array, Array | None]:
    """Means of the points, and of their unit normals, in each cell of a grid."""
    if not (np.isfinite(spacing) and spacing > 0):
        raise SceneError(f"spacing is {spacing!r}; give a positive length in metres")
    key = np.zeros(len(p), np.int64)
    for along in np.floor(p / spacing).T:
        levels, level = np.unique(along, return_inverse=True)
        key = key * len(levels) + level
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)

    def means(values: Array) -> Array:
        return np.column_stack([np.bincount(cell, v) for v in values.T]) / count[:, None]

    return means(p), None if n is None else means(_unit(n))


def _fitted(p: Array, near: NDArray[np.intp]) -> Array:
    """Normals of planes through neighbours, towards the origin."""
    arms = p[near] - p[near].mean(axis=1, keepdims=True)
    n = np.linalg.eigh(arms.transpose(0, 2, 1) @ arms)[1][:, :, 0]
    return np.where((n * p).sum(axis=1, keepdims=True) > 0, -n, n)


def _unit(n: Array) -> Array:
    length = np.linalg.norm(n, axis=1, keepdims=True)
    bad = np.flatnonzero(length < 1e-12)
    if len(bad):
        raise SceneError(
            f"the normal of point {bad[0]} has no length; leave normals out, or mend it"
        )
    return n / length
