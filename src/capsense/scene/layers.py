"""Layered depth images: what depth cameras and peeled views turn into."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import read_only
from capsense.errors import SceneError
from capsense.scene.shapes import Shape, ShapeKind, as_points
from capsense.scene.surface import checked_mesh, checked_thickness

if TYPE_CHECKING:
    import trimesh


Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_MAX_PIXELS = 4_000_000


@dataclass(frozen=True, init=False, eq=False)
class Layers(Shape):
    """Sorted intervals of depth at the pixels of a regular grid.

    In its own frame depth grows along z; the pixel in column i and row j stands at
    ``x = (i + 1/2) width / columns - width / 2`` and ``y = (j + 1/2) height / rows - height / 2``.

    Args:
        front: Depth [m] at which the solid begins, shape (rows, columns), or (layers, rows,
            columns) in any order. There is no interval where it or ``back`` is not finite, or
            where it is not less than ``back``. Overlapping intervals are united.
        back: Depth [m] at which the solid ends, same shape.
        size: Width (along x) and height (along y) of the image [m].

    Raises:
        SceneError: Wrong shapes or sizes, or no pixel holds an interval.
    """

    front: Array32 = field(repr=False)
    """Depths [m] at which the intervals of every pixel begin, ascending, NaN where there are no
    more; shape (slots, rows, columns), read-only."""
    back: Array32 = field(repr=False)
    """Depths [m] at which they end, same shape, read-only."""
    size: tuple[float, float]
    """Width and height of the image [m]."""
    _reach: Array = field(repr=False)
    """Least and greatest column, row and depth [m] of the intervals, shape (2, 3)."""

    kind = ShapeKind.LAYERS

    def __init__(self, front: ArrayLike, back: ArrayLike, size: tuple[float, float]) -> None:
        from capsense.scene.image_kernels import sort_slots

        f, b = (np.asarray(values, dtype=float, order="C") for values in (front, back))
        if f.ndim not in (2, 3) or not f.size:
            raise SceneError(
                f"Layers: front has shape {f.shape}; give (rows, columns) or "
                "(layers, rows, columns)"
            )
        if b.shape != f.shape:
            raise SceneError(f"Layers: back has shape {b.shape}, but front has {f.shape}")
        if f[0].size * (f.shape[1] if f.ndim == 2 else 1) > _MAX_PIXELS:
            raise SceneError(
                f"Layers: the image has {f.shape} pixels; give at most {_MAX_PIXELS:,}"
            )
        wide = _checked_size("Layers", size)
        if f.ndim == 2:
            f, b = f[None], b[None]
        low, high = np.empty((2, *f.shape), np.float32)
        reach = np.empty((2, 3))
        slots = sort_slots(f, b, low, high, reach)
        if slots == 0:
            raise SceneError("Layers: no pixel holds an interval; front must be less than back")
        first, last = read_only(low[:slots]), read_only(high[:slots])
        self.__dict__.update(front=first, back=last, size=wide, _reach=reach)

    def _measured_in(self, unit: float) -> Layers:
        out = object.__new__(Layers)
        ends = {name: read_only(getattr(self, name) / unit) for name in ("front", "back")}
        size = self.size[0] / unit, self.size[1] / unit
        out.__dict__.update(ends, size=size, _reach=self._reach / [1.0, 1.0, unit])
        return out

    @property
    def resolution(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return self.front.shape[1], self.front.shape[2]

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel [m]."""
        return self.size[0] / self.front.shape[2], self.size[1] / self.front.shape[1]

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Whether a slot holds an interval at a pixel, shape (slots, rows, columns)."""
        return ~np.isnan(self.front)

    @cached_property
    def volume(self) -> float:
        """Volume [m³]: depth times area of the pixels."""
        depth = self.back.astype(float) - self.front
        return float(np.nansum(depth)) * self.pixel[0] * self.pixel[1]

    def bounds(self) -> Array:
        low, high = self._reach
        scale = np.array([*self.pixel, 1.0])
        shift = np.array([0.5 * self.size[0], 0.5 * self.size[1], 0.0])
        return np.array([low * scale - shift, high * scale - shift])

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface along the view [m], negative inside.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,); infinite where the pixel that a point lies in holds no interval.

        Raises:
            SceneError: The points do not have shape (n, 3).
        """
        p = as_points(points)
        rows, columns = self.resolution
        column = np.floor((p[:, 0] + 0.5 * self.size[0]) / self.pixel[0])
        row = np.floor((p[:, 1] + 0.5 * self.size[1]) / self.pixel[1])
        within = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        out = np.full(len(p), np.inf)
        at = row[within].astype(int), column[within].astype(int)
        z = p[within, 2]
        levels = np.maximum(self.front[:, *at] - z, z - self.back[:, *at])
        out[within] = np.where(np.isnan(levels), np.inf, levels).min(axis=0)
        return out

    def to_trimesh(self) -> trimesh.Trimesh:
        """One block for every pixel and slot, for drawing."""
        import trimesh

        slot, row, column = np.nonzero(self.hit)
        f, b = (a[slot, row, column].astype(float) for a in (self.front, self.back))
        dx, dy = self.pixel
        middle = np.column_stack(
            [(column + 0.5) * dx - 0.5 * self.size[0], (row + 0.5) * dy - 0.5 * self.size[1],
             0.5 * (f + b)]
        )  # fmt: skip
        box = trimesh.creation.box()
        extent = np.column_stack([np.broadcast_to(self.pixel, (len(f), 2)), b - f])
        vertices = middle[:, None] + box.vertices[None] * extent[:, None]
        faces = box.faces[None] + 8 * np.arange(len(f))[:, None, None]
        return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


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
    from capsense.scene.image_kernels import pair, scan

    v, f = checked_mesh(vertices, faces)
    wide = _checked_size("render_depth", size)
    rows, columns = _checked_resolution(resolution)
    sheet = 0.0 if thickness is None else checked_thickness(thickness)
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
    return Raster(front, back, wide)


def _checked_size(owner: str, size: tuple[float, float]) -> tuple[float, float]:
    """Check width and height [m]."""
    wide = tuple(float(s) for s in size)
    if len(wide) != 2 or not all(np.isfinite(s) and s > 0 for s in wide):
        raise SceneError(f"{owner}: size is {size!r}; give (width, height) in metres")
    return wide[0], wide[1]


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
    if not (whole and rows > 0 and columns > 0 and rows * columns <= _MAX_PIXELS):
        raise SceneError(
            f"render_depth: resolution is {resolution!r}; give (rows, columns), at most 4,000,000 "
            "pixels"
        )
    return rows, columns
