"""Rigid bodies of any form: triangle meshes."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.shape import Shape, ShapeKind, as_points
from capsense.scene.surface import clean_surface, connected_parts, enclosed_volume

if TYPE_CHECKING:
    import trimesh

    from capsense.scene.distance_kernels import Boxes

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
        return self._distances(points)

    def distance(self, points: ArrayLike) -> Array:
        """Exact distance to the nearest triangle [m], of open surfaces too.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,), nowhere negative.

        Raises:
            SceneError: The points do not have shape (n, 3).
        """
        return np.abs(self._distances(points))

    @property
    @abstractmethod
    def closed(self) -> bool:
        """Whether the surface has an inside."""

    def _distances(self, points: ArrayLike) -> Array:
        from capsense.scene.distance_kernels import signed_distances

        p = as_points(points)
        out = np.empty(len(p))
        signed_distances(self._boxes, np.ascontiguousarray(p), out)
        return out

    @cached_property
    def _boxes(self) -> Boxes:
        from capsense.scene.distance_kernels import boxed

        return boxed(self.vertices[self.faces])

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
        faces: Indices of the corners of every triangle, shape (m, 3). The winding is mended.

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
