"""Rigid bodies of any form: triangle meshes."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._thread_pool import Frozen
from capsense.errors import SceneError
from capsense.scene.materials import Material
from capsense.scene.materials import material as find_material
from capsense.scene.pose import Pose
from capsense.scene.scene import Body, Grounding, checked_grounding
from capsense.scene.shapes import Shape, ShapeKind, as_points
from capsense.scene.surface import (
    checked_mesh,
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
        v.setflags(write=False)
        f.setflags(write=False)
        fields = self.__dict__
        fields["vertices"] = v
        fields["faces"] = f
        fields["_flaw"] = flaw

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
        out = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        out.setflags(write=False)
        return out

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
        if not (np.isfinite(thickness) and thickness > 0):
            raise SceneError(f"thickness is {thickness!r}; give a positive length in metres")
        v, f = checked_mesh(vertices, faces)
        f = f.copy()
        v.setflags(write=False)
        f.setflags(write=False)
        self.__dict__.update(vertices=v, faces=f, thickness=float(thickness))

    @cached_property
    def closed(self) -> bool:
        """Whether the surface has an inside: it has no rim, and its faces wind alike."""
        return is_closed(self.faces, len(self.vertices))

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
        v.setflags(write=False)
        self.__dict__.update(vertices=v, faces=rest.faces, rest=rest)

    @property
    def closed(self) -> bool:
        """Whether the surface has an inside."""
        return self.rest.closed

    @cached_property
    def volume(self) -> float:
        self._require_inside("volume")
        return abs(enclosed_volume(self.vertices, self.faces))

    def bounds(self) -> Array:
        used = self.rest.used
        v = self.vertices if len(used) == len(self.vertices) else self.vertices[used]
        return np.array([v.min(axis=0), v.max(axis=0)])

    def _require_inside(self, what: str) -> None:
        if not self.closed:
            raise SceneError(
                f"SurfaceMesh: the surface is open or its faces wind differently, so it has no "
                f"inside, and no {what}; conductors need none; else close it (coinciding vertices "
                "must be one) and wind its faces alike"
            )


class DeformableSurface:
    """A triangle mesh whose vertices may be replaced at every step.

    Its triangles carry the charge, so it may be open, which makes it a thin sheet. The first
    vertices tell which triangles belong together; give a form without creases.

    Args:
        vertices: Points [m] in the sensor frame, shape (n, 3).
        faces: Vertex indices, shape (m, 3). Those of a closed surface should wind alike.
        thickness: That of an open surface of a dielectric, such as cloth [m]; conductors and
            closed surfaces need none.
        material: As for :class:`~capsense.scene.scene.Body`.
        grounding: As for :class:`~capsense.scene.scene.Body`.
        name: As for :class:`~capsense.scene.scene.Body`.

    Raises:
        SceneError: Wrong shapes or values.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        thickness: float = SHEET_THICKNESS,
        material: Material | str = "human",
        grounding: Grounding = "grounded",
        name: str | None = None,
    ) -> None:
        self._rest = RestSurface(vertices, faces, thickness)
        self._shape = SurfaceMesh(self._rest.vertices, self._rest)
        self.material = material if isinstance(material, Material) else find_material(material)
        self.grounding = checked_grounding(grounding)
        self.name = name

    @property
    def faces(self) -> NDArray[np.int64]:
        """Vertex indices, shape (m, 3)."""
        return self._rest.faces

    @property
    def vertices(self) -> Array:
        """The vertices [m] in the sensor frame, shape (n, 3); set them to deform the surface.

        Raises:
            SceneError: Set to another shape, or to numbers that are not finite.
        """
        return self._shape.vertices

    @vertices.setter
    def vertices(self, vertices: ArrayLike) -> None:
        self._shape = SurfaceMesh(vertices, self._rest)

    def body(self) -> Body:
        """The surface as it is now, as a body of a scene in the sensor frame."""
        return Body(self._shape, Pose(), self.material, self.grounding, self.name)
