"""Surfaces whose vertices change at every step: cloth, soft pads, posed bodies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.body import Body, Grounding, checked_grounding
from capsense.scene.layers import Layers
from capsense.scene.materials import Material, material
from capsense.scene.pose import Pose
from capsense.scene.raster import checked_mesh, checked_thickness, checked_vertices, scan_mesh

Array = NDArray[np.float64]


class DeformableSurface:
    """A triangle mesh whose vertices may be replaced at every step.

    It is seen as a layered depth image along z of the sensor frame, taken anew at every step in a
    frame that fits it closely; parts that stand upright to that view are seen by their outlines.

    Args:
        vertices: Points [m] in the sensor frame, shape (n, 3).
        faces: Vertex indices, shape (m, 3). Those of a closed surface should wind alike.
        thickness: None for a closed surface, whose inside is filled; that of a sheet along its
            normal [m] for an open one, half to either side.
        material: As for :class:`~capsense.scene.body.Body`.
        grounding: As for :class:`~capsense.scene.body.Body`.
        resolution: Pixels along the longer side of the view.
        name: As for :class:`~capsense.scene.body.Body`.

    Raises:
        SceneError: Wrong shapes or values, or an open surface without a thickness.
    """

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        thickness: float | None = None,
        material: Material | str = "human",
        grounding: Grounding = "grounded",
        resolution: int = 64,
        name: str | None = None,
    ) -> None:
        self._vertices, self.faces = checked_mesh(vertices, faces)
        self._thickness = checked_thickness(thickness)
        self.thickness = thickness
        self.material = _checked_material(material)
        self.grounding = checked_grounding(grounding)
        if not (isinstance(resolution, int) and 4 <= resolution <= 2000):
            raise SceneError(f"resolution is {resolution!r}; give a whole number from 4 to 2000")
        self.resolution = resolution
        self.name = name
        self.faces.setflags(write=False)
        self._used = np.unique(self.faces)
        if thickness is None:
            _check_closed(self.faces, len(self._vertices))

    @property
    def vertices(self) -> Array:
        """The vertices [m] in the sensor frame, shape (n, 3); set them to deform the surface.

        Raises:
            SceneError: Set to another shape, or to numbers that are not finite.
        """
        return self._vertices

    @vertices.setter
    def vertices(self, vertices: ArrayLike) -> None:
        v = checked_vertices(vertices)
        if v.shape != self._vertices.shape:
            raise SceneError(
                f"vertices have shape {v.shape}, but the surface was made with "
                f"{self._vertices.shape}; make a new one to change its faces"
            )
        self._vertices = v

    def view(self) -> tuple[Layers, Pose]:
        """The surface as it is now: a layered image, and its frame in the sensor frame.

        Raises:
            SceneError: The surface has no extent across the view.
        """
        v = self._vertices if len(self._used) == len(self._vertices) else (
            self._vertices[self._used]
        )  # fmt: skip
        low, high = v.min(axis=0), v.max(axis=0)
        extent = high - low
        pixel = float(extent[:2].max()) / self.resolution
        if pixel <= 0:
            raise SceneError("the surface has no extent along x or y, so no ray along z meets it")
        columns, rows = (math.ceil(float(e) / pixel) + 2 for e in extent[:2])
        centre = 0.5 * (low + high)
        centre[2] = low[2]
        raster = scan_mesh(
            self._vertices - centre, self.faces, (columns * pixel, rows * pixel), (rows, columns),
            self._thickness,
        )  # fmt: skip
        return raster.layers(), Pose(centre)

    def body(self) -> Body:
        """The surface as it is now, as a body of a scene in the sensor frame.

        Raises:
            SceneError: As :meth:`view`.
        """
        layers, pose = self.view()
        return Body(layers, pose, self.material, self.grounding, self.name)


def _checked_material(name: Material | str) -> Material:
    return name if isinstance(name, Material) else material(name)


def _check_closed(faces: NDArray[np.int64], n: int) -> None:
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * n + np.maximum(start, end)
    _, count = np.unique(key, return_counts=True)
    odd = int((count % 2 == 1).sum())
    if odd:
        raise SceneError(
            f"the surface is open ({odd} of {len(count)} edges have a face on one side only), so "
            "it has no inside; give its thickness, or close it (coinciding vertices must be one)"
        )
