"""Surfaces whose vertices change at every step: cloth, soft pads, posed bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.scene.body import Body, Grounding, checked_grounding
from capsense.scene.materials import Material
from capsense.scene.materials import material as find_material
from capsense.scene.pose import Pose
from capsense.scene.surface_mesh import SHEET_THICKNESS, RestSurface, SurfaceMesh

Array = NDArray[np.float64]


class DeformableSurface:
    """A triangle mesh whose vertices may be replaced at every step.

    Its triangles carry the charge, so it may be open, which makes it a thin sheet. The first
    vertices tell which triangles belong together; give a form without creases.

    Args:
        vertices: Points [m] in the sensor frame, shape (n, 3).
        faces: Vertex indices, shape (m, 3). Those of a closed surface should wind alike.
        thickness: That of an open surface of a dielectric, such as cloth [m]; conductors and
            closed surfaces need none.
        material: As for :class:`~capsense.scene.body.Body`.
        grounding: As for :class:`~capsense.scene.body.Body`.
        name: As for :class:`~capsense.scene.body.Body`.

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
