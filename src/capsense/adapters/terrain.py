"""Wide terrains: of a height field that is larger than any mesh, only what lies near a sensor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.meshes import height_field, solid_mesh
from capsense.scene import TriMesh

Array = NDArray[np.float64]

_TILE = 0.6
"""Tiles are about so wide [m], or a cell of the terrain if that is wider."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """A height field, given out in tiles."""

    heights: Array
    """Heights [m] over z = 0 of its frame, rows along y and columns along x, (rows, columns)."""
    half: tuple[float, float]
    """Half extents along x and y [m]."""
    base: float
    """Depth of its floor below z = 0 [m]."""
    solid: bool
    """Whether tiles have walls and a floor, as matter that does not conduct must have."""
    label: str
    """What it is called, for messages."""
    _tiles: dict[tuple[int, int], TriMesh] = field(default_factory=dict, repr=False)

    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m] in its frame, shape (2, 3)."""
        x, y = self.half
        low, high = float(self.heights.min()), float(self.heights.max())
        return np.array([[-x, -y, min(low, -self.base)], [x, y, high]])

    def near(self, centre: Array, reach: float) -> list[TriMesh]:
        """The tiles within a distance [m] along x and y of a point in its frame, shape (3,)."""
        along = [self._range(axis, centre[axis], reach) for axis in (0, 1)]
        return [self._tile(row, column) for row in along[1] for column in along[0]]

    def _cells(self, axis: int) -> tuple[int, int, float]:
        """Cells along x (0) or y (1), those of a tile, and the width of a cell [m]."""
        cells = self.heights.shape[1 - axis] - 1
        width = 2 * self.half[axis] / cells
        return cells, max(1, round(_TILE / width)), width

    def _range(self, axis: int, at: float, reach: float) -> range:
        cells, many, width = self._cells(axis)
        low, high = ((at + side * reach + self.half[axis]) / (many * width) for side in (-1, 1))
        last = -(-cells // many)
        return range(max(0, int(np.floor(low))), min(last, int(np.floor(high)) + 1))

    def _tile(self, row: int, column: int) -> TriMesh:
        if (row, column) not in self._tiles:
            (nx, mx, dx), (ny, my, dy) = self._cells(0), self._cells(1)
            rows = slice(row * my, min((row + 1) * my, ny) + 1)
            columns = slice(column * mx, min((column + 1) * mx, nx) + 1)
            part = self.heights[rows, columns]
            half = 0.5 * dx * (part.shape[1] - 1), 0.5 * dy * (part.shape[0] - 1)
            vertices, faces = height_field(part, half, self.base)
            vertices[:, 0] += columns.start * dx - self.half[0] + half[0]
            vertices[:, 1] += rows.start * dy - self.half[1] + half[1]
            if not self.solid:
                faces = faces[: 2 * (part.shape[0] - 1) * (part.shape[1] - 1)]
            self._tiles[row, column] = solid_mesh(vertices, faces, self.label)
        return self._tiles[row, column]
