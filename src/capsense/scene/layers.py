"""Layered depth images: what depth cameras, peeled views and deforming surfaces turn into."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.shape import Shape, ShapeKind, as_lines, as_points

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

STEP_SLOPE = 3.0
"""Slope of a surface, depth over width, from which a jump between two pixels narrows to a step."""
HEADER = 2
"""Numbers in front of a grid's table: reciprocal of a pixel's height [1/m], limit of a step [m]."""
TABLE = 10
"""Numbers a slot: first and last column, first and last row, nearest front, farthest back [m],
and how far its silhouette reaches, in pixels: least and largest column, least and largest row."""
BLOCK = 4
"""Pixels along the side of a block; it shares its outer ones with its neighbours. Of each block
are kept the nearest front, the farthest front, the nearest back and the farthest back [m]."""
_NO_OUTLINES: Array32 = np.empty((0, 0, 2), np.float32)
_MAX_PIXELS = 4_000_000


@dataclass(frozen=True, eq=False)
class LayerGrid:
    """A layered depth image as the compiled kernels read it, in the body's frame."""

    values: Array32
    """Flat: ``HEADER`` numbers, ``TABLE`` numbers for each slot, front and back [m] and margin
    [pixels] of every pixel, shape (slots, rows, columns, 3), and bounds of blocks of pixels."""
    shape: Ints
    """Slots, rows and columns, shape (3,)."""
    origin: Array
    """Centre of the first pixel (x, y) [m], and zero, shape (3,)."""
    inverse: float
    """Reciprocal of the pixel's width [1/m]."""


@dataclass(frozen=True, init=False, eq=False)
class Layers(Shape):
    """Sorted intervals of depth at the pixels of a regular grid.

    In its own frame depth grows along z; the pixel in column i and row j stands at
    ``x = (i + 1/2) width / columns - width / 2`` and ``y = (j + 1/2) height / rows - height / 2``.
    Between pixels, surfaces are interpolated and silhouettes placed as ``docs/depth.md`` says.

    Args:
        front: Depth [m] at which the solid begins, shape (rows, columns), or (layers, rows,
            columns) in any order. There is no interval where it or ``back`` is not finite, or
            where it is not less than ``back``. Overlapping intervals are united.
        back: Depth [m] at which the solid ends, same shape.
        size: Width (along x) and height (along y) of the image [m].

    Raises:
        SceneError: Wrong shapes or sizes, or no pixel holds an interval.
    """

    size: tuple[float, float]
    """Width and height of the image [m]."""
    resolution: tuple[int, int]
    """Rows and columns of the image."""
    grid: LayerGrid = field(repr=False)
    """The image for the kernels, cropped to the pixels that are hit and one more around them."""

    kind = ShapeKind.LAYERS
    max_intervals = 4

    def __init__(self, front: ArrayLike, back: ArrayLike, size: tuple[float, float]) -> None:
        f, b = np.asarray(front, dtype=float), np.asarray(back, dtype=float)
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
        wide = tuple(float(s) for s in size)
        if len(wide) != 2 or not all(np.isfinite(s) and s > 0 for s in wide):
            raise SceneError(f"Layers: size is {size!r}; give (width, height) in metres")
        if f.ndim == 2:
            f, b = f[None], b[None]
        self._build(f, b, wide, _NO_OUTLINES, _NO_OUTLINES)

    @classmethod
    def from_outlines(
        cls, front: Array, back: Array, size: tuple[float, float], rows: Array32, columns: Array32
    ) -> Layers:
        """Make a layered image whose outlines are known between the pixels.

        Args:
            front, back: Shape (layers, rows, columns) [m].
            size: Width and height of the image [m].
            rows: First and last crossing of outlines on every link along a row, as a fraction of
                the link, shape (rows, columns + 1, 2); link i leads to pixel i. Any first above 1
                and last below 0 stand for none.
            columns: The same along columns, shape (rows + 1, columns, 2).

        Raises:
            SceneError: No pixel holds an interval.
        """
        out = object.__new__(cls)
        out._build(front, back, size, rows, columns)
        return out

    @classmethod
    def from_grid(
        cls, grid: LayerGrid, size: tuple[float, float], resolution: tuple[int, int]
    ) -> Layers:
        """Put a layered image together from its parts, such as those written to a file.

        Args:
            grid, size, resolution: What the attributes of these names held.

        Raises:
            SceneError: The parts do not fit together.
        """
        slots, rows, columns = grid.shape.tolist()
        blocks = ((columns + BLOCK - 2) // BLOCK) * ((rows + BLOCK - 2) // BLOCK)
        numbers = HEADER + slots * (TABLE + 3 * rows * columns + 4 * blocks)
        good = min(slots, rows - 2, columns - 2) >= 1 and grid.values.shape == (numbers,)
        if good:
            table = grid.values[HEADER : HEADER + TABLE * slots].reshape(slots, TABLE)
            top = np.array([columns, columns, rows, rows]) - 1
            places = table[:, [0, 1, 2, 3, 6, 7, 8, 9]]  # the kernels take them for indices
            good = bool(np.all((places > -0.5) & (places < np.tile(top + 0.5, 2))))
        if not good or grid.values.dtype != np.float32 or grid.origin.shape != (3,):
            raise SceneError("Layers: the parts of the image do not fit together")
        out = object.__new__(cls)
        out.__dict__.update(size=size, resolution=resolution, grid=grid)
        return out

    def _build(
        self, f: Array, b: Array, size: tuple[float, ...], rows: Array32, columns: Array32
    ) -> None:
        from capsense.scene.layer_build import build_values, sort_slots

        _, ny, nx = f.shape
        dx, dy = size[0] / nx, size[1] / ny
        low, high = np.empty_like(f), np.empty_like(f)
        count = np.empty((ny, nx), np.int64)
        found = sort_slots(f, b, low, high, count)
        slots, j0, j1, i0, i1 = found.tolist()
        if slots == 0:
            raise SceneError("Layers: no pixel holds an interval; front must be less than back")
        limit = STEP_SLOPE * max(dx, dy)
        values = build_values(low, high, count, found, dy, limit, rows, columns)
        origin = np.array([(i0 - 0.5) * dx - 0.5 * size[0], (j0 - 0.5) * dy - 0.5 * size[1], 0.0])
        shape = np.array([slots, j1 - j0 + 3, i1 - i0 + 3])
        fields = self.__dict__
        fields["size"], fields["resolution"] = size, (ny, nx)
        fields["grid"] = LayerGrid(values, shape, origin, 1.0 / dx)

    @property
    def fields(self) -> Array32:
        """Front and back [m] and margin [pixels] on the grid, shape (slots, rows, columns, 3)."""
        slots, rows, columns = self.grid.shape.tolist()
        start, size = HEADER + TABLE * slots, 3 * slots * rows * columns
        return self.grid.values[start : start + size].reshape(slots, rows, columns, 3)

    @property
    def hit(self) -> NDArray[np.bool_]:
        """Whether a slot holds an interval at a pixel of the grid, (slots, rows, columns)."""
        return self.fields[..., 2] > 0

    @property
    def pixel(self) -> tuple[float, float]:
        """Width and height of a pixel [m]."""
        return self.size[0] / self.resolution[1], self.size[1] / self.resolution[0]

    @cached_property
    def params(self) -> Array:
        half = 0.5 * np.ptp(self.bounds(), axis=0)
        half.setflags(write=False)
        return half

    @cached_property
    def volume(self) -> float:
        """Volume [m³]: depth times area of the pixels."""
        f = self.fields[self.hit]
        return float((f[:, 1] - f[:, 0]).sum(dtype=float)) * self.pixel[0] * self.pixel[1]

    def bounds(self) -> Array:
        slots = int(self.grid.shape[0])
        table = self.grid.values[HEADER : HEADER + TABLE * slots].reshape(slots, TABLE)
        low, high = table[:, [6, 8, 4]].min(axis=0), table[:, [7, 9, 5]].max(axis=0)
        scale = (*self.pixel, 1.0)
        return self.grid.origin + np.array([low, high]) * scale

    def signed_distance(self, points: ArrayLike) -> Array:
        """How far points are outside [m], negative inside.

        The sign is exact; the size is measured along the view axis and along rows and columns,
        so it is the distance only beside flat faces.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,).

        Raises:
            SceneError: The points do not have shape (n, 3).
        """
        from capsense.scene.layer_kernels import layer_levels

        p, g = np.ascontiguousarray(as_points(points)), self.grid
        out = np.empty(len(p))
        layer_levels(g.values, g.shape, g.origin, g.inverse, p, out)
        return out

    def line_intervals(self, origins: ArrayLike, direction: ArrayLike) -> Array:
        """Where infinite lines ``origin + t * direction`` run inside the layers.

        Args:
            origins: A point [m] on each line in the local frame, shape (n, 3).
            direction: Direction of the lines, shape (3,) or (n, 3), of any non-zero length.

        Returns:
            Entry and exit of up to four stretches in ascending order, shape (n, 4, 2), filled up
            with ``[inf, -inf]``. Where there are more, some are joined.

        Raises:
            SceneError: Wrong shapes, a number that is not finite, or a zero direction.
        """
        from capsense.scene.layer_kernels import layer_intervals_of_lines

        o, d = as_lines(origins, direction)
        g = self.grid
        out = np.empty((len(o), self.max_intervals, 2))
        layer_intervals_of_lines(
            g.values, g.shape, g.origin, g.inverse, np.ascontiguousarray(o),
            np.ascontiguousarray(d), out,
        )  # fmt: skip
        return out

    def to_trimesh(self) -> trimesh.Trimesh:
        """One block for every pixel and slot, for drawing."""
        import trimesh

        slot, row, column = np.nonzero(self.hit)
        f, b = np.moveaxis(self.fields[slot, row, column, :2].astype(float), 1, 0)
        x, y, _ = self.grid.origin
        middle = np.column_stack(
            [x + column * self.pixel[0], y + row * self.pixel[1], 0.5 * (f + b)]
        )
        box = trimesh.creation.box()
        extent = np.column_stack([np.broadcast_to(self.pixel, (len(f), 2)), b - f])
        vertices = middle[:, None] + box.vertices[None] * extent[:, None]
        faces = box.faces[None] + 8 * np.arange(len(f))[:, None, None]
        return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)
