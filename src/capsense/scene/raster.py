"""Orthographic views of triangle meshes, every layer of them; no simulator and no GL."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.layers import Layers

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_ROOM = 4


@dataclass(frozen=True, eq=False)
class Raster:
    """What the rays of an orthographic view meet of a mesh."""

    front: Array
    """Depth [m] at which each layer begins, NaN where there is none, (layers, rows, columns)."""
    back: Array
    """Depth [m] at which each layer ends, same shape."""
    size: tuple[float, float]
    """Width and height of the view [m]."""

    @property
    def depth(self) -> Array:
        """Depth [m] of the nearest surface, infinity where there is none, (rows, columns)."""
        return np.where(np.isnan(self.front[0]), np.inf, self.front[0])

    def layers(self) -> Layers:
        """The view as a solid.

        Raises:
            SceneError: No pixel's ray meets the mesh.
        """
        return Layers(self.front, self.back, self.size)


def render_depth(
    vertices: ArrayLike,
    faces: ArrayLike,
    size: tuple[float, float],
    resolution: tuple[int, int],
    *,
    thickness: float | None = None,
) -> Raster:
    """View a mesh along z and keep every layer.

    Args:
        vertices: Points [m] in the frame of the view, see :class:`~capsense.scene.layers.Layers`:
            z is depth, the middle of the image lies at x = y = 0. Shape (n, 3).
        faces: Vertex indices, shape (m, 3).
        size: Width and height of the view [m].
        resolution: Rows and columns.
        thickness: None for closed surfaces, which need faces of like winding (else every second
            stretch of a ray counts as inside). Else that of a sheet [m]: it reaches half of it to
            either side, and along z by as much more as it is inclined, up to five times.

    Returns:
        The view. What lies outside it is left out.

    Raises:
        SceneError: Wrong shapes, types or sizes, or a vertex that is not finite.
    """
    from capsense.scene.raster_kernels import pair, scan

    v, f = checked_mesh(vertices, faces)
    wide = tuple(float(s) for s in size)
    if len(wide) != 2 or not all(np.isfinite(s) and s > 0 for s in wide):
        raise SceneError(f"render_depth: size is {size!r}; give (width, height) in metres")
    rows, columns = _checked_resolution(resolution)
    sheet = _checked_thickness(thickness)
    dx, dy = wide[0] / columns, wide[1] / rows
    p = v * (1.0 / dx, 1.0 / dy, 1.0) + (0.5 * columns - 0.5, 0.5 * rows - 0.5, 0.0)
    room = _ROOM
    while True:
        met = np.empty((rows, columns, room, 2), np.float32)
        count = np.zeros((rows, columns), np.int64)
        most = scan(p, f, dx, dy, sheet, met, count)
        if most <= room:
            break
        room = most
    layers = max(1, most if sheet > 0.0 else (most + 1) // 2)
    front, back = np.empty((layers, rows, columns)), np.empty((layers, rows, columns))
    pair(met, count, sheet > 0.0, front, back)
    return Raster(front, back, (wide[0], wide[1]))


def _checked_thickness(thickness: float | None) -> float:
    """Check the thickness of a sheet [m]; 0 for None.

    Raises:
        SceneError: Not a positive finite number.
    """
    if thickness is None:
        return 0.0
    try:
        number = float(thickness)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not (np.isfinite(number) and number > 0):
        raise SceneError(
            f"thickness is {thickness!r}; give a positive length in metres, or None for a closed "
            "surface"
        )
    return number


def _checked_resolution(resolution: object) -> tuple[int, int]:
    """Check rows and columns.

    Raises:
        SceneError: Not two positive whole numbers, or more than four million pixels.
    """
    try:
        rows, columns = (int(n) for n in resolution)  # type: ignore[attr-defined]
        whole = (rows, columns) == tuple(resolution)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        whole, rows, columns = False, 0, 0
    if not (whole and rows > 0 and columns > 0 and rows * columns <= 4_000_000):
        raise SceneError(
            f"render_depth: resolution is {resolution!r}; give (rows, columns), at most 4,000,000 "
            "pixels"
        )
    return rows, columns


def checked_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, Ints]:
    """Check the arrays of a surface, open or closed.

    Raises:
        SceneError: Wrong shapes or types, a vertex that is not finite, an index out of range.
    """
    f = np.asarray(faces)
    if f.ndim != 2 or f.shape[1] != 3 or not len(f):
        raise SceneError(f"faces have shape {f.shape}; give (m, 3), triangles only")
    if f.dtype.kind not in "iu":
        raise SceneError(f"faces have type {f.dtype}; give integer vertex indices")
    v = checked_vertices(vertices)
    low, high = int(f.min()), int(f.max())
    if low < 0 or high >= len(v):
        raise SceneError(
            f"faces name vertices {low} to {high}, but there are {len(v)}; indices run from 0 to "
            f"{len(v) - 1}"
        )
    return v, np.ascontiguousarray(f, dtype=np.int64)


def checked_vertices(vertices: ArrayLike) -> Array:
    """Check the vertices of a surface.

    Raises:
        SceneError: Wrong shape or type, or a vertex that is not finite.
    """
    try:
        v = np.array(vertices, dtype=float, order="C")
    except (TypeError, ValueError, OverflowError):
        raise SceneError("vertices are not numbers; give shape (n, 3), metres") from None
    if v.ndim != 2 or v.shape[1] != 3:
        raise SceneError(f"vertices have shape {v.shape}; give (n, 3), metres")
    if not np.isfinite(v).all():
        bad = int(np.flatnonzero(~np.isfinite(v).all(axis=1))[0])
        raise SceneError(f"vertex {bad} is {v[bad].tolist()}, not finite")
    return v
