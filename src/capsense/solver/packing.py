"""The bodies of a scene as the step takes them, and what of that stays from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from operator import is_
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.design.film import Film
from capsense.field.green_kernels import Green
from capsense.reading import Touch
from capsense.scene import Scene, SurfaceMesh
from capsense.scene.scene import PackedScene
from capsense.scene.shapes import Shape
from capsense.solver.bodies.outline import CHANGING, write_triangles
from capsense.solver.gap.gap_kernels import REACH
from capsense.solver.gap.touch import Pressed
from capsense.solver.tree.dynamic_surface import DipoleLayer, DynamicBody, MeshBody
from capsense.solver.tree.matter import Matter
from capsense.solver.tree.near_triangles import Face, near_triangles
from capsense.solver.tree.rigid import BODY, RigidShape

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class View:
    """A scene, and the n bodies of it that reach into the domain."""

    scene: Scene
    packed: PackedScene
    met: NDArray[np.intp]
    """Their places in the scene, shape (n,)."""
    matter: Matter
    """What they are made of."""


@dataclass(frozen=True, eq=False)
class PackedBodies:
    """The bodies of a scene that reach into the domain, as the kernels take them."""

    records: NDArray[np.void]
    """One :data:`BODY` each, or one for each part of a large mesh, shape (n,)."""
    chosen: NDArray[np.intp]
    """Their places in the scene, shape (n,)."""
    matter: Matter
    """What they are made of and what ties them to ground."""
    shapes: list[RigidShape | DynamicBody]
    """What the records point to."""
    offsets: Array
    """From the bodies' origins to those of the parts of them that are solved for [m], (n, 3)."""
    touch: Touch | None = None
    """What they press onto the cover, if the design has one."""
    pressed: Sequence[Pressed] = ()
    """Those that touch the cover."""
    near: list[NamedTuple] = field(default_factory=list)
    """Triangles near the design, and clusters of deforming meshes, that records point to."""

    def refit(self, green: Green, finest: float) -> None:
        """Work out where the clusters of changing bodies are.

        Those near a face get an outline, but for sheets of dielectrics. Triangles of meshes that
        are longer than ``finest`` have parts.
        """
        for record, shape in zip(self.records, self.shapes, strict=True):
            if isinstance(shape, MeshBody):
                self.near.append(shape.enter(record, green.space, finest))
        gap = green.gap
        if not len(gap.areas):
            return
        film = Film(1.0 / gap.curvature, {}) if gap.curvature else None
        face = Face(gap.face, green.box, film, gap.top, gap.top - gap.soft.limit)
        limits = 2.0 * gap.validity, REACH[1] * gap.validity
        for record, shape in zip(self.records, self.shapes, strict=True):
            thin = record["sheet"] + record["layer"] != 0.0
            if thin or not isinstance(shape, DynamicBody):
                continue
            found = near_triangles(shape, record, face, *limits)
            if found is not None:
                self.near.append(found)
                write_triangles(record, found, CHANGING, False)


@dataclass(frozen=True, eq=False)
class BodyTemplate:
    """Records of bodies but for where they stand, which is all that changes at most steps."""

    places: list[int]
    """Body of each part,"""
    found: list[tuple[RigidShape | DynamicBody, float]]
    """Its functions and its size [m]: what the records follow from."""
    records: NDArray[np.void]
    matter: Matter
    """What the parts are made of."""
    shapes: list[RigidShape | DynamicBody]
    everywhere: bool = False
    """Whether each body is solved for as a whole wherever it stands."""

    @cached_property
    def rigid(self) -> bool:
        """Whether no body changes its shape."""
        return all(isinstance(shape, RigidShape) for shape in self.shapes)

    def copied(self) -> NDArray[np.void]:
        """The records anew, from bytes: NumPy takes ten times as long to copy their fields."""
        return np.frombuffer(bytearray(self._bytes), BODY)

    @cached_property
    def _bytes(self) -> bytes:
        return self.records.tobytes()


def layer_of(shape: Shape, conducting: bool) -> list[tuple[DipoleLayer, float]]:
    """The dipoles that go with the charges of a thin sheet of triangles, if it is one."""
    if conducting or not isinstance(shape, SurfaceMesh) or shape.closed:
        return []
    return [(DipoleLayer(shape), 1.0)]


def make_template(
    whole: Matter,
    places: list[int],
    found: list[tuple[RigidShape | DynamicBody, float]],
) -> BodyTemplate:
    """Lay out parts of bodies that are made of ``whole``."""
    shapes, matter = [shape for shape, _ in found], whole.repeated(places)
    records = np.array([s.record for s in shapes], BODY)
    records["scale"] = [size for _, size in found]
    matter.write(records, shapes)
    return BodyTemplate(places, found, records, matter, shapes)


def same(known: list[Shape], bodies: list[Shape]) -> bool:
    """Whether two lists hold the same objects."""
    return len(known) == len(bodies) and all(map(is_, known, bodies))
