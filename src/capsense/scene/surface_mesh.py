"""Triangles of a surface that deforms, at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import Frozen
from capsense.errors import SceneError
from capsense.scene.mesh_shape import TriangleShape
from capsense.scene.raster import checked_mesh, checked_vertices
from capsense.scene.shape import ShapeKind
from capsense.scene.surface import enclosed_volume, is_closed

Array = NDArray[np.float64]

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
