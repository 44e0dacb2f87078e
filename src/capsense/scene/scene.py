"""Scenes: the bodies around a sensor at one instant, and whether they touch its electrodes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number, shorten
from capsense.errors import SceneError
from capsense.scene.materials import Grounding, Material, checked_grounding, checked_material
from capsense.scene.mesh_shape import SHEET_THICKNESS, RestSurface, SurfaceMesh
from capsense.scene.pose import Pose, checked_pose
from capsense.scene.shapes import Shape

Array = NDArray[np.float64]


@dataclass(frozen=True, init=False, eq=False)
class Body:
    """One object of the scene.

    Args:
        shape: The solid.
        pose: Where it stands in the sensor frame.
        material: A :class:`Material`, or the name of a known one.
        grounding: ``"grounded"``, that is on earth; ``"floating"``; the capacitance [F] that ties
            the body to earth; ``"local"``, on the local ground of the sensor, as a link of the
            same robot; or :class:`~capsense.scene.materials.Ties` to both. It matters for
            conductors only.
        name: Optional; unique within a scene.
        conductor: Optional; bodies of one name are one conductor, such as the limbs of a person,
            whether they touch or not. Their grounding is that of the whole conductor, and must be
            the same. It matters for conductors only.
        force: Normal force that presses it onto the cover of a design [N], such as the contact
            force of a simulator; it then decides how deep the body lies in the cover, whatever the
            height of its pose. By default the overlap with the cover does.

    Raises:
        SceneError: An argument is of the wrong kind or out of range.
    """

    shape: Shape
    pose: Pose
    material: Material
    grounding: Grounding
    name: str | None
    force: float | None
    conductor: str | None

    def __init__(
        self,
        shape: Shape,
        pose: Pose = Pose(),  # noqa: B008, a pose is immutable
        material: Material | str = "steel",
        grounding: Grounding = "grounded",
        name: str | None = None,
        force: float | None = None,
        conductor: str | None = None,
    ) -> None:
        if not isinstance(shape, Shape):
            mesh = hasattr(shape, "vertices") and hasattr(shape, "faces")
            fix = (
                "TriMesh(mesh.vertices, mesh.faces)"
                if mesh
                else ("Box, Sphere, Capsule, Cylinder, Ellipsoid or TriMesh")
            )
            raise SceneError(f"shape is {shape!r}; give a {fix}")
        for what, given in (("body name", name), ("conductor", conductor)):
            if not (given is None or (isinstance(given, str) and given)):
                raise SceneError(f"{what} is {given!r}; give a non-empty string or None")
        fields = self.__dict__
        fields["shape"] = shape
        fields["pose"] = checked_pose(pose)
        fields["material"] = checked_material(material)
        fields["grounding"] = checked_grounding(grounding)
        fields["name"] = name
        fields["force"] = checked_force(force)
        fields["conductor"] = conductor

    def pressed(self, force: float | None) -> Body:
        """Return the same body under a normal force [N]; the rest is shared.

        Raises:
            SceneError: The force is no finite number from 0 on.
        """
        body = object.__new__(Body)
        body.__dict__.update(self.__dict__)
        body.__dict__["force"] = checked_force(force)
        return body

    def moved(self, pose: Pose) -> Body:
        """Return the same body at another pose; shape and material are shared.

        Raises:
            SceneError: ``pose`` is not a :class:`Pose`.
        """
        body = object.__new__(Body)
        body.__dict__.update(self.__dict__)
        body.__dict__["pose"] = checked_pose(pose)
        return body


def checked_force(force: float | None) -> float | None:
    """A contact force [N], or None.

    Raises:
        SceneError: It is no finite number from 0 on.
    """
    if force is None:
        return None
    value = as_number(force)
    if not 0.0 <= value < math.inf:
        raise SceneError(
            f"force is {shorten(force)}; give a finite number in N, from 0 on, or None"
        )
    return value


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
        self.material = checked_material(material)
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

    def update(self, vertices: ArrayLike, pose: Pose | None = None) -> Body:
        """Deform the surface, and return it as a body.

        Args:
            vertices: Points [m], shape (n, 3) or (1, n, 3), as models give that take batches; an
                array or a tensor of PyTorch, on any device, whose gradients are left out.
            pose: Frame of the vertices in the sensor frame; the sensor frame itself by default.

        Raises:
            SceneError: Another shape, numbers that are not finite, or no :class:`Pose`.
        """
        points = np.asarray(vertices.detach().cpu() if hasattr(vertices, "detach") else vertices)
        self.vertices = points[0] if points.ndim == 3 and len(points) == 1 else points
        return self.body() if pose is None else self.body().moved(pose)

    def body(self) -> Body:
        """The surface as it is now, as a body of a scene in the sensor frame."""
        return Body(self._shape, Pose(), self.material, self.grounding, self.name)


_SHOWN = 8
"""Bodies that are listed when a scene is printed."""
_HUGE = 25
"""A body whose smallest side is so many domains was meant in millimetres."""
_FAR = 50
"""So was one that is so many domains away."""


@dataclass(frozen=True, eq=False)
class PackedScene:
    """The geometry of a scene as flat arrays, in the order of its bodies."""

    kinds: NDArray[np.int64]
    """:class:`~capsense.scene.shapes.ShapeKind` of every body, shape (n,)."""
    params: Array
    """Sizes [m], see :class:`~capsense.scene.shapes.ShapeKind`, shape (n, 3)."""
    rotation: Array
    """Rotation matrices, body's frame to sensor frame, shape (n, 3, 3)."""
    position: Array
    """Origins of the bodies' frames [m] in the sensor frame, shape (n, 3)."""
    bounds: Array
    """Lower and upper corners of the bounding boxes [m] in the sensor frame, shape (n, 2, 3)."""
    shapes: tuple[Shape, ...]
    """The shapes themselves."""

    def __len__(self) -> int:
        return len(self.shapes)


@dataclass(frozen=True, init=False, eq=False)
class Scene:
    """An immutable, ordered collection of bodies.

    Args:
        bodies: The bodies, any iterable.

    Raises:
        SceneError: Something is not a :class:`Body`, two bodies share a name, or bodies of one
            conductor have different groundings.
    """

    bodies: tuple[Body, ...]

    def __init__(self, bodies: Iterable[Body] = ()) -> None:
        if isinstance(bodies, Body):
            raise SceneError("Scene takes a list of bodies; write Scene([body])")
        try:
            items = tuple(bodies)
        except TypeError:
            raise SceneError(f"Scene takes a list of bodies, not {bodies!r}") from None
        names: set[str] = set()
        grounding: dict[str, Grounding] = {}
        for i, body in enumerate(items):
            if not isinstance(body, Body):
                fix = f"; write Body({body!r}, ...)" if isinstance(body, Shape) else ""
                raise SceneError(f"bodies[{i}] is {body!r}, not a Body{fix}")
            if body.name is not None:
                if body.name in names:
                    raise SceneError(f"two bodies are named {body.name!r}; names must differ")
                names.add(body.name)
            if body.conductor is not None:
                first = grounding.setdefault(body.conductor, body.grounding)
                if first != body.grounding:
                    raise SceneError(
                        f"bodies of conductor {body.conductor!r} have groundings {first!r} and "
                        f"{body.grounding!r}; give all of them that of the whole conductor"
                    )
        self.__dict__["bodies"] = items

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{b.name or 'unnamed'} ({type(b.shape).__name__})" for b in self.bodies[:_SHOWN]
        )
        more = f" and {len(self) - _SHOWN} more" if len(self) > _SHOWN else ""
        return f"<Scene of {len(self)}: {shown or 'nothing'}{more}>"

    def __iter__(self) -> Iterator[Body]:
        return iter(self.bodies)

    def __len__(self) -> int:
        return len(self.bodies)

    def __getitem__(self, key: int | str) -> Body:
        """Return a body by its index or its name.

        Raises:
            KeyError: No body of that name.
            IndexError: No body at that index.
        """
        if isinstance(key, str):
            for body in self.bodies:
                if body.name == key:
                    return body
            known = ", ".join(repr(b.name) for b in self.bodies if b.name is not None)
            raise KeyError(f"no body named {key!r}; named bodies: {known or 'none'}")
        return self.bodies[key]

    def warn_of_units(self, domain: float) -> None:
        """Warn of a scene in millimetres: all of it is far too large, or far too far away.

        Args:
            domain: Width of what the sensor sees [m].
        """
        if not self.bodies:
            return
        first = self.bodies[0]
        name = first.name or "bodies[0]"
        fix = "nothing changes its readings; lengths are metres, so multiply millimetres by 1e-3"
        sizes = [np.ptp(body.shape.bounds(), axis=0) for body in self.bodies]
        if all(size.min() > _HUGE * domain for size in sizes):
            sides = " × ".join(f"{side:g}" for side in sizes[0])
            warnings.warn(
                f"{name} is {sides} m, far more than the {domain:g} m that the sensor sees, as are "
                f"all other bodies, and {fix}",
                stacklevel=3,
            )
        elif all(
            np.linalg.norm(body.pose.position) > _FAR * domain + size.max()
            for body, size in zip(self.bodies, sizes, strict=True)
        ):
            place = ", ".join(f"{x:g}" for x in first.pose.position)
            warnings.warn(
                f"{name} is at ({place}) m, far beyond the {domain:g} m that the sensor sees, as "
                f"are all other bodies, and {fix}",
                stacklevel=3,
            )

    def pack(self) -> PackedScene:
        """Lay the geometry out as flat arrays for the solver's kernels."""
        from capsense.scene.geometry_kernels import place_bodies

        n = len(self.bodies)
        shapes = tuple([b.shape for b in self.bodies])
        table = np.array(
            [(b.shape.kind, *b.shape.packed, *b.pose.quaternion, *b.pose.position)
             for b in self.bodies]
        ).reshape(n, 14)  # fmt: skip
        rotation = np.empty((n, 3, 3))
        bounds = np.empty((n, 2, 3))
        place_bodies(table, rotation, bounds)
        kinds = table[:, 0].astype(np.int64)
        return PackedScene(kinds, table[:, 1:4], rotation, table[:, 11:], bounds, shapes)
