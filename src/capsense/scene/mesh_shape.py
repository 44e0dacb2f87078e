"""Shapes made of triangles: rigid meshes, surfaces that deform, surfaces through points."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import Frozen, read_only
from capsense.errors import SceneError
from capsense.scene.shapes import Shape, ShapeKind, as_points
from capsense.scene.surface import (
    checked_mesh,
    checked_thickness,
    checked_vertices,
    clean_surface,
    connected_parts,
    enclosed_volume,
    is_closed,
)

if TYPE_CHECKING:
    import trimesh

    from capsense.scene.geometry_kernels import Boxes


Array = NDArray[np.float64]


class TriangleShape(Shape):
    """A shape that is given by triangles."""

    vertices: Array
    """Points [m], shape (n, 3), read-only."""

    faces: NDArray[np.int64]
    """Vertex indices, shape (m, 3), read-only."""

    def __repr__(self) -> str:
        size = " × ".join(f"{v:.3g}" for v in np.ptp(self.vertices, axis=0))
        return f"<{type(self).__name__}: {len(self.faces)} triangles, {size} m>"

    def signed_distance(self, points: ArrayLike) -> Array:
        """Exact distance to the nearest triangle [m], negative inside.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,).

        Raises:
            SceneError: The points do not have shape (n, 3), or the surface is not closed.
        """
        self._require_inside("signed distances")
        return self.ray_distance(points)

    def distance(self, points: ArrayLike) -> Array:
        """Exact distance to the nearest triangle [m], of open surfaces too.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,), nowhere negative.

        Raises:
            SceneError: The points do not have shape (n, 3).
        """
        return np.abs(self.ray_distance(points))

    @property
    @abstractmethod
    def closed(self) -> bool:
        """Whether the surface has an inside."""

    def ray_distance(self, points: ArrayLike, *, down: bool = False) -> Array:
        """As :meth:`signed_distance`; of an open surface, one ray along z tells what is inside."""
        from capsense.scene.geometry_kernels import signed_distances

        p = as_points(points) * (1.0, 1.0, -1.0 if down else 1.0)
        out = np.empty(len(p))
        signed_distances(self._turned_boxes if down else self._boxes, p, out)
        return out

    @cached_property
    def _boxes(self) -> Boxes:
        from capsense.scene.geometry_kernels import boxed

        return boxed(self.vertices[self.faces])

    @cached_property
    def _turned_boxes(self) -> Boxes:
        from capsense.scene.geometry_kernels import boxed

        return boxed(self.vertices[self.faces] * (1.0, 1.0, -1.0))

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    @abstractmethod
    def _require_inside(self, what: str) -> None:
        """Raise a SceneError that says why there is no ``what``, if the surface is not closed."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class TriMesh(TriangleShape):
    """A triangle mesh, moved rigidly.

    It may be open, hold faces twice, cross itself, and wind any way: the solver takes the surface
    as it is. What asks for its inside, such as dielectrics and signed distances, needs a closed
    one. Of a closed mesh, overlapping parts act as their union; a part inside another with its
    normals reversed is a cavity.

    Args:
        vertices: Points [m], shape (n, 3). Coinciding ones are merged.
        faces: Indices of the corners of every triangle, shape (m, 3). The winding is fixed.

    Raises:
        SceneError: The mesh is longer than 10 m, holds a bad number or index, or has no triangle.
    """

    vertices: Array
    """Cleaned vertices [m], shape (n, 3), read-only."""
    faces: NDArray[np.int64]
    """Cleaned faces, shape (m, 3), read-only; normals out where the mesh is closed."""
    _flaw: str = field(repr=False)
    """Why the mesh has no inside; empty where it has one."""

    kind = ShapeKind.MESH

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        v, f, flaw = clean_surface(vertices, faces)
        self.__dict__.update(vertices=read_only(v), faces=read_only(f), _flaw=flaw)

    def _measured_in(self, unit: float) -> TriMesh:
        out = object.__new__(TriMesh)
        vertices = read_only(np.round(self.vertices / unit, 12))  # the same of scaled ones
        out.__dict__.update(vertices=vertices, faces=self.faces, _flaw=self._flaw)
        return out

    @property
    def closed(self) -> bool:
        """Whether the mesh has an inside."""
        return not self._flaw

    @cached_property
    def parts(self) -> int:
        """Number of connected parts; parts share no vertex."""
        return int(connected_parts(self.faces, len(self.vertices)).max()) + 1

    @cached_property
    def pieces(self) -> tuple[TriMesh, ...]:
        """Connected parts of a thousandth of the area or more, and the others together."""
        label = connected_parts(self.faces, len(self.vertices))
        corners = self.vertices[self.faces]
        area = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        share = np.bincount(label, area) / area.sum()
        label = np.where(share[label] < 0.001, -1, label)
        chosen = [self.faces[label == k] for k in np.unique(label)]
        return tuple(TriMesh(self.vertices, faces) for faces in chosen)

    @cached_property
    def piece_bounds(self) -> Array:
        """Lower and upper corners of the pieces [m], shape (2, n, 3)."""
        return np.stack([piece.bounds() for piece in self.pieces], axis=1)

    @cached_property
    def volume(self) -> float:
        self._require_inside("a volume")
        return enclosed_volume(self.vertices, self.faces)

    def bounds(self) -> Array:
        return self._bounds

    @cached_property
    def _bounds(self) -> Array:
        return read_only(np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)]))

    def _require_inside(self, what: str) -> None:
        flaw = self._flaw
        if flaw:
            raise SceneError(
                f"TriMesh: {flaw}, so it has no inside, and no {what}; conductors need none; else "
                "fill the holes (trimesh.repair.fill_holes) or pass the convex hull "
                "(mesh.convex_hull)"
            )


SHEET_THICKNESS = 1e-3
"""Thickness of an open surface of a dielectric where none is given [m]."""


@dataclass(frozen=True, init=False, eq=False)
class RestSurface(Frozen):
    """What a surface keeps while it deforms; shared by the shapes it takes on.

    Args:
        vertices: Points [m] in the form it had first, shape (n, 3).
        faces: Vertex indices, shape (m, 3). Those of a closed surface should wind alike.
        thickness: That of an open surface of a dielectric, such as cloth [m].

    Raises:
        SceneError: Wrong shapes or types, a number that is not finite, an index out of range.
    """

    vertices: Array
    """Points [m] in the form it had first, shape (n, 3), read-only."""
    faces: NDArray[np.int64]
    """Vertex indices, shape (m, 3), read-only."""
    thickness: float
    """That of an open surface of a dielectric [m]."""

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, thickness: float = SHEET_THICKNESS
    ) -> None:
        number = checked_thickness(thickness)
        v, f = checked_mesh(vertices, faces)
        faces = read_only(f.copy())
        self.__dict__.update(vertices=read_only(v), faces=faces, thickness=number)

    @cached_property
    def closed(self) -> bool:
        """Whether the surface has an inside: it has no rim, and its faces wind alike."""
        return is_closed(self.faces, len(self.vertices))

    def measured_in(self, unit: float) -> RestSurface:
        """This surface with lengths in a unit [m]; the last one is kept."""
        held: tuple[float, RestSurface] | None = self.__dict__.get("_measured")
        if held is None or held[0] != unit:
            rest = RestSurface(self.vertices / unit, self.faces, self.thickness / unit)
            held = self.__dict__["_measured"] = unit, rest
        return held[1]

    @cached_property
    def used(self) -> NDArray[np.int64]:
        """Vertices that faces name, ascending."""
        return np.unique(self.faces)


@dataclass(frozen=True, init=False, eq=False, repr=False)
class SurfaceMesh(TriangleShape):
    """A surface at one instant, open or closed; an open one is a thin sheet.

    Args:
        vertices: Points [m] in the local frame, shape (n, 3).
        rest: What stays while it deforms; of as many vertices.

    Raises:
        SceneError: Vertices of another shape, or one that is not finite.
    """

    vertices: Array
    """Points [m] in the local frame, shape (n, 3), read-only."""
    faces: NDArray[np.int64]
    """Vertex indices, shape (m, 3), read-only; the same array at every instant."""
    rest: RestSurface

    kind = ShapeKind.SURFACE

    def __init__(self, vertices: ArrayLike, rest: RestSurface) -> None:
        v = checked_vertices(vertices)
        if v.shape != rest.vertices.shape:
            raise SceneError(
                f"vertices have shape {v.shape}, but the surface was made with "
                f"{rest.vertices.shape}; make a new one to change its faces"
            )
        self.__dict__.update(vertices=read_only(v), faces=rest.faces, rest=rest)

    def _measured_in(self, unit: float) -> SurfaceMesh:
        return SurfaceMesh(self.vertices / unit, self.rest.measured_in(unit))

    @property
    def closed(self) -> bool:
        """Whether the surface has an inside."""
        return self.rest.closed

    def over(self, low: ArrayLike, high: ArrayLike) -> SurfaceMesh:
        """The triangles over and under a rectangle, all that rays along z from there may cross.

        Args:
            low, high: Corners of the rectangle [m] in the local frame, shape (2,).
        """
        out = object.__new__(SurfaceMesh)
        sides = np.zeros(len(self.vertices), np.uint8)  # of the rectangle that a vertex is beyond
        for axis, (least, most) in enumerate(zip(np.asarray(low), np.asarray(high), strict=True)):
            along = self.vertices[:, axis]
            sides |= ((along < least) * (1 << 2 * axis) + (along > most) * (2 << 2 * axis)).astype(
                np.uint8
            )
        a, b, c = (sides[self.faces[:, q]] for q in range(3))
        faces = read_only(self.faces[(a & b & c) == 0])
        out.__dict__.update(vertices=self.vertices, faces=faces, rest=self.rest)
        return out

    @cached_property
    def volume(self) -> float:
        self._require_inside("volume")
        return abs(enclosed_volume(self.vertices, self.faces))

    def bounds(self) -> Array:
        return self._bounds

    @cached_property
    def _bounds(self) -> Array:
        used = self.rest.used
        v = self.vertices if len(used) == len(self.vertices) else self.vertices[used]
        along = np.ascontiguousarray(v.T)  # NumPy takes six times as long down the columns
        return read_only(np.array([along.min(axis=1), along.max(axis=1)]))

    def _require_inside(self, what: str) -> None:
        if not self.closed:
            raise SceneError(
                f"SurfaceMesh: the surface is open or its faces wind differently, so it has no "
                f"inside, and no {what}; conductors need none; else close it (coinciding vertices "
                "must be one) and wind its faces alike"
            )


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
            f"the normal of point {bad[0]} has no length; leave normals out, or correct it"
        )
    return n / length
