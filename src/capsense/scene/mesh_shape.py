"""Rigid bodies of any form: triangle meshes, whose inside is seen through a distance grid."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.shape import Shape, ShapeKind, as_lines, as_points
from capsense.scene.surface import clean_surface, connected_parts, enclosed_volume

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]

_CELLS_ALONG = 48
_CELLS_ACROSS = 6
_MARGIN = 3
_MAX_NODES = 1_000_000
_MAX_NODES_EVER = 50_000_000


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distances on a regular grid around a mesh, in its local frame."""

    values: NDArray[np.float32]
    """Signed distances [m], negative inside, shape (nx, ny, nz). Exact within two cells of the
    surface; further off they may be too large by up to about a cell."""
    origin: Array
    """First node [m], shape (3,)."""
    cell: float
    """Node spacing [m]."""


@dataclass(frozen=True, init=False, eq=False)
class TriMesh(Shape):
    """A triangle mesh, moved rigidly.

    It may be open, hold faces twice, cross itself, and wind any way: the surface solver takes the
    surface as it is. What asks for its inside, such as dielectrics and everything below, needs a
    closed one.

    Distances and line crossings come from a signed-distance grid that is built at first use and
    kept. Crossings are right to a small part of a cell on smooth and flat surfaces; edges and
    corners are rounded over about half a cell. Overlapping closed parts act as their union;
    a closed part inside another with its normals reversed is a cavity.

    Args:
        vertices: Points [m], shape (n, 3). Coinciding ones are merged.
        faces: Indices of the corners of every triangle, shape (m, 3). The winding is mended.
        cell: Spacing of the distance grid [m]. By default a 48th of the longest extent, finer
            for flat meshes (six cells across the shortest) up to a million nodes.

    Raises:
        SceneError: The mesh is longer than 10 m, holds a bad number or index, has no triangle, or
            ``cell`` is out of range.
    """

    vertices: Array
    """Cleaned vertices [m], shape (n, 3), read-only."""
    faces: NDArray[np.int64]
    """Cleaned faces, shape (m, 3), read-only; normals out where the mesh is closed."""
    cell: float
    """Spacing of the distance grid [m]."""

    kind = ShapeKind.MESH
    max_intervals = 4

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, *, cell: float | None = None) -> None:
        v, f, flaw = clean_surface(vertices, faces)
        v.setflags(write=False)
        f.setflags(write=False)
        extents = np.ptp(v, axis=0)
        fields = self.__dict__
        fields["vertices"] = v
        fields["faces"] = f
        fields["_flaw"] = flaw
        fields["cell"] = _default_cell(extents) if cell is None else _checked_cell(cell, extents)

    @property
    def closed(self) -> bool:
        """Whether the mesh has an inside."""
        return not self.__dict__["_flaw"]

    @cached_property
    def parts(self) -> int:
        """Number of connected parts; parts share no vertex."""
        return int(connected_parts(self.faces, len(self.vertices)).max()) + 1

    @cached_property
    def params(self) -> Array:
        half = 0.5 * np.ptp(self.vertices, axis=0)
        half.setflags(write=False)
        return half

    @cached_property
    def breadth(self) -> float:
        deepest = -float(self.grid.values.min())
        return max(0.0, 2.0 * (deepest - self.cell))  # deep inside, distances may be too large

    @cached_property
    def volume(self) -> float:
        self._require_inside("a volume")
        return enclosed_volume(self.vertices, self.faces)

    def bounds(self) -> Array:
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def grid(self) -> DistanceGrid:
        """The signed-distance grid, built at first use.

        Raises:
            SceneError: The mesh is not closed.

        Warns:
            UserWarning: Walls thinner than a cell are lost; a smaller ``cell`` mends it.
        """
        self._require_inside("signed distances")
        grid = _build_grid(self.vertices[self.faces], self.cell)
        self._warn_of_lost_walls(grid)
        return grid

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside, interpolated on the grid.

        Outside the grid, the way to it is added to the value on its boundary, which is too
        large by at most twice the shorter of the two.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,).

        Raises:
            SceneError: The points do not have shape (n, 3), or the mesh is not closed.
        """
        from capsense.scene.batch_kernels import grid_distances

        p, grid = as_points(points), self.grid
        top = grid.origin + grid.cell * (np.array(grid.values.shape) - 1)
        nearest = np.clip(p, grid.origin, top)
        out = np.empty(len(p))
        grid_distances(grid.values, grid.origin, 1 / grid.cell, nearest, out)
        return out + np.linalg.norm(p - nearest, axis=1)

    def line_intervals(self, origins: ArrayLike, direction: ArrayLike) -> Array:
        """Where infinite lines ``origin + t * direction`` run inside the mesh.

        Args:
            origins: A point [m] on each line in the local frame, shape (n, 3).
            direction: Direction of the lines, shape (3,) or (n, 3), of any non-zero length.

        Returns:
            Entry and exit of up to four stretches in ascending order, shape (n, 4, 2), filled up
            with ``[inf, -inf]``. A fifth and further stretches are joined to the fourth.

        Raises:
            SceneError: Wrong shapes, a number that is not finite, a zero direction, or a mesh that
                is not closed.
        """
        from capsense.scene.batch_kernels import mesh_intervals_of_lines

        o, d = as_lines(origins, direction)
        out = np.empty((len(o), self.max_intervals, 2))
        grid = self.grid
        mesh_intervals_of_lines(
            grid.values, grid.origin, 1 / grid.cell, o, np.ascontiguousarray(d), out
        )
        return out

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    def _require_inside(self, what: str) -> None:
        flaw = self.__dict__["_flaw"]
        if flaw:
            raise SceneError(
                f'TriMesh: {flaw}, so it has no inside, and no {what}; method="surface" needs '
                "none for conductors; else fill the holes (trimesh.repair.fill_holes) or pass the "
                "convex hull (mesh.convex_hull)"
            )

    def _warn_of_lost_walls(self, grid: DistanceGrid) -> None:
        """Warn where the interpolated distance stays above zero for a cell behind the surface."""
        from capsense.scene.batch_kernels import grid_distances

        corners = self.vertices[self.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        inward = -normal / np.maximum(area, 1e-300)[:, None]
        least = np.full(len(corners), np.inf)
        found = np.empty(len(corners))
        for depth in np.linspace(0.2, 1.0, 5) * grid.cell:
            points = corners.mean(axis=1) + depth * inward
            grid_distances(grid.values, grid.origin, 1 / grid.cell, points, found)
            np.minimum(least, found, out=least)
        lost = float(area[least >= 0].sum() / area.sum())
        if lost > 0.01:
            warnings.warn(
                f"TriMesh: {lost:.0%} of the surface belongs to walls thinner than the grid's "
                f"cell of {grid.cell:.3g} m and is lost; pass a smaller cell",
                stacklevel=4,
            )


def _nodes(extents: Array, cell: float) -> NDArray[np.int64]:
    """Numbers of grid nodes; odd, so that the middle plane of a flat mesh holds nodes."""
    return 2 * (np.ceil(0.5 * extents / cell).astype(np.int64) + _MARGIN) + 1


def _default_cell(extents: Array) -> float:
    longest = float(extents.max())
    if extents.min() < 1e-6 * longest:  # a flat sheet
        return longest / _CELLS_ALONG
    cell = float(min(longest / _CELLS_ALONG, extents.min() / _CELLS_ACROSS))
    while math.prod(_nodes(extents, cell).tolist()) > _MAX_NODES:
        cell *= 1.02
    return cell


def _checked_cell(cell: object, extents: Array) -> float:
    try:
        number = float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    longest = float(extents.max())
    if not (0 < number <= longest):
        raise SceneError(f"TriMesh: cell is {cell!r}; give a length [m], at most {longest:g}")
    nodes = np.prod(2.0 * np.ceil(0.5 * extents / number) + 2 * _MARGIN + 1)
    if nodes > _MAX_NODES_EVER:
        raise SceneError(
            f"TriMesh: cell is {number:g} m, which makes a grid of {nodes:.2g} nodes; give a "
            f"larger one (at most {_MAX_NODES_EVER:.2g} nodes)"
        )
    return number


def _build_grid(triangles: Array, cell: float) -> DistanceGrid:
    """Distance grid of a closed surface, corners [m] of shape (m, 3, 3)."""
    from scipy.ndimage import distance_transform_edt

    from capsense.scene.distance_kernels import fill_band, fill_far, set_signs

    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    nodes = _nodes(high - low, cell)
    origin = 0.5 * (low + high) - 0.5 * cell * (nodes - 1)
    triangles = np.ascontiguousarray(triangles)
    distance = np.full(tuple(nodes), np.float32(np.inf))
    nearest = np.empty(distance.shape, dtype=np.int32)
    fill_band(triangles, origin, cell, 2.0 * cell, distance, nearest)
    source = distance_transform_edt(nearest < 0, return_distances=False, return_indices=True)
    fill_far(triangles, origin, cell, source, distance, nearest)
    set_signs(triangles, origin, cell, np.zeros_like(nearest), distance)
    distance.setflags(write=False)
    origin.setflags(write=False)
    return DistanceGrid(distance, origin, float(cell))
