"""Convex primitives with exact signed distances, in the body's own frame.

Full sizes, metres; capsule and cylinder lie along local z.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import Frozen, read_only
from capsense.errors import SceneError
from capsense.scene.pose import Vec3, checked_floats

if TYPE_CHECKING:
    import trimesh


Array = NDArray[np.float64]


class ShapeKind(IntEnum):
    """Kinds of shapes, and what their ``params`` mean."""

    BOX = 0
    """Half edge lengths."""
    SPHERE = 1
    """Radius, 0, 0."""
    CAPSULE = 2
    """Radius, half length without caps, 0."""
    CYLINDER = 3
    """Radius, half length, 0."""
    ELLIPSOID = 4
    """Three radii."""
    MESH = 5
    """Half edge lengths of the local bounding box."""
    LAYERS = 6
    """Half edge lengths of the local bounding box."""
    SURFACE = 7
    """Half edge lengths of the local bounding box."""


class Shape(Frozen, ABC):
    """A solid or a surface in its own frame."""

    kind: ClassVar[ShapeKind]
    """What sort of shape it is."""

    @cached_property
    def params(self) -> Array:
        """Sizes [m], see :class:`ShapeKind`, shape (3,), read-only."""
        return read_only(0.5 * np.ptp(self.bounds(), axis=0))

    @cached_property
    def packed(self) -> tuple[float, ...]:
        """``params`` and the centre of the local bounding box [m], six numbers."""
        return (*self.params.tolist(), *self.bounds().mean(axis=0).tolist())

    def measured_in(self, unit: float) -> Self:
        """This shape with lengths in a unit [m]; the last one is kept."""
        if unit == 1.0:
            return self
        held: tuple[float, Self] | None = self.__dict__.get("_measured")
        if held is None or held[0] != unit:
            held = self.__dict__["_measured"] = unit, self._measured_in(unit)
        return held[1]

    @abstractmethod
    def _measured_in(self, unit: float) -> Self:
        """As :meth:`measured_in`, each time anew."""

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume [m³]."""

    @abstractmethod
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m] in the local frame, shape (2, 3)."""

    @abstractmethod
    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,).

        Raises:
            SceneError: The points do not have shape (n, 3), or the shape has no inside.
        """

    @abstractmethod
    def to_trimesh(self) -> trimesh.Trimesh:
        """A surface mesh of the shape in its local frame, for drawing and for checks."""


def as_points(points: ArrayLike) -> Array:
    """Check points of shape (n, 3) and return them as floats.

    Raises:
        SceneError: Another shape.
    """
    out = np.asarray(points, dtype=float)
    if out.ndim != 2 or out.shape[1] != 3:
        raise SceneError(f"points have shape {out.shape}; give (n, 3)")
    return out


def _size(shape: str, name: str, value: object) -> float:
    """Check one length [m]: finite and positive."""
    (number,) = checked_floats((value,), 1, f"{shape}: {name}", "give one length in metres")
    if number <= 0:
        raise SceneError(f"{shape}: {name} is {number:g} m; give a length above zero")
    return number


def _sizes(shape: str, name: str, values: object) -> Vec3:
    """Check three lengths [m]: finite and positive."""
    a, b, c = checked_floats(values, 3, f"{shape}: {name}", "give three lengths in metres")
    if min(a, b, c) <= 0:
        raise SceneError(f"{shape}: {name} is {(a, b, c)} m; every length must be above zero")
    return a, b, c


def _frozen(*values: float) -> Array:
    return read_only(np.array(values))


class _Primitive(Shape):
    """A shape that is a few lengths, its bounding box centred on its origin."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            check = _size if f.type == "float" else _sizes
            checked = check(type(self).__name__, f.name, getattr(self, f.name))
            object.__setattr__(self, f.name, checked)

    def _measured_in(self, unit: float) -> Self:
        lengths = [getattr(self, f.name) for f in fields(self)]  # type: ignore[arg-type]
        return type(self)(*(
            tuple(x / unit for x in each) if isinstance(each, tuple) else each / unit
            for each in lengths
        ))  # fmt: skip

    @cached_property
    def packed(self) -> tuple[float, ...]:
        return (*self.params.tolist(), 0.0, 0.0, 0.0)

    @property
    @abstractmethod
    def _corner(self) -> ArrayLike:
        """Upper corner of the bounding box [m], shape (3,)."""

    def bounds(self) -> Array:
        corner = np.asarray(self._corner)
        return np.array([-corner, corner])


@dataclass(frozen=True)
class Box(_Primitive):
    """A box of full edge lengths ``size`` [m], centred on its origin.

    Raises:
        SceneError: A length is not a positive finite number.
    """

    size: Vec3

    kind = ShapeKind.BOX

    @cached_property
    def params(self) -> Array:
        return _frozen(*(0.5 * s for s in self.size))

    @property
    def volume(self) -> float:
        return math.prod(self.size)

    @property
    def _corner(self) -> Array:
        return self.params

    def signed_distance(self, points: ArrayLike) -> Array:
        q = np.abs(as_points(points)) - self.params
        return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.box(extents=self.size)


@dataclass(frozen=True)
class Sphere(_Primitive):
    """A ball of ``radius`` [m].

    Raises:
        SceneError: The radius is not a positive finite number.
    """

    radius: float

    kind = ShapeKind.SPHERE

    @cached_property
    def params(self) -> Array:
        return _frozen(self.radius, 0.0, 0.0)

    @property
    def volume(self) -> float:
        return 4 / 3 * math.pi * self.radius**3

    @property
    def _corner(self) -> tuple[float, ...]:
        return (self.radius,) * 3

    def signed_distance(self, points: ArrayLike) -> Array:
        return np.linalg.norm(as_points(points), axis=1) - self.radius

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        return trimesh.creation.icosphere(subdivisions=4, radius=self.radius)


@dataclass(frozen=True)
class Capsule(_Primitive):
    """A cylinder along z with half balls on both ends: ``length`` [m] is without the caps.

    Raises:
        SceneError: A length is not a positive finite number.
    """

    radius: float
    length: float

    kind = ShapeKind.CAPSULE

    @cached_property
    def params(self) -> Array:
        return _frozen(self.radius, 0.5 * self.length, 0.0)

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * (self.length + 4 / 3 * self.radius)

    @property
    def _corner(self) -> tuple[float, ...]:
        return self.radius, self.radius, 0.5 * self.length + self.radius

    def signed_distance(self, points: ArrayLike) -> Array:
        p = as_points(points).copy()
        half = 0.5 * self.length
        p[:, 2] -= np.clip(p[:, 2], -half, half)
        return np.linalg.norm(p, axis=1) - self.radius

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        # made for radius 1, as trimesh drops triangles of less than 1e-8
        mesh = trimesh.creation.capsule(height=self.length / self.radius, count=(64, 64))
        mesh.apply_scale(self.radius)
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        return mesh


@dataclass(frozen=True)
class Cylinder(_Primitive):
    """A cylinder of ``radius`` and full ``length`` [m] along z.

    Raises:
        SceneError: A length is not a positive finite number.
    """

    radius: float
    length: float

    kind = ShapeKind.CYLINDER

    @cached_property
    def params(self) -> Array:
        return _frozen(self.radius, 0.5 * self.length, 0.0)

    @property
    def volume(self) -> float:
        return math.pi * self.radius**2 * self.length

    @property
    def _corner(self) -> tuple[float, ...]:
        return self.radius, self.radius, 0.5 * self.length

    def signed_distance(self, points: ArrayLike) -> Array:
        p = as_points(points)
        side = np.hypot(p[:, 0], p[:, 1]) - self.radius
        end = np.abs(p[:, 2]) - 0.5 * self.length
        outside = np.hypot(np.maximum(side, 0.0), np.maximum(end, 0.0))
        return outside + np.minimum(np.maximum(side, end), 0.0)

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        mesh = trimesh.creation.cylinder(1.0, height=self.length / self.radius, sections=128)
        mesh.apply_scale(self.radius)
        return mesh


@dataclass(frozen=True)
class Ellipsoid(_Primitive):
    """An ellipsoid of the three half axes ``radii`` [m] along x, y, z.

    Raises:
        SceneError: A length is not a positive finite number.
    """

    radii: Vec3

    kind = ShapeKind.ELLIPSOID

    @cached_property
    def params(self) -> Array:
        return _frozen(*self.radii)

    @property
    def volume(self) -> float:
        return 4 / 3 * math.pi * math.prod(self.radii)

    @property
    def _corner(self) -> Array:
        return self.params

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface, exact to about 1e-9 of the smallest radius.

        With y = |p|, the nearest surface point is x_i = r_i² y_i / (r_i² + t), t being the
        largest root of F(t) = Σ (r_i y_i / (r_i² + t))² − 1 (Eberly, "Distance from a point to
        an ellipse, an ellipsoid, or a hyperellipsoid"). F is convex and falling there, so
        Newton's method, started where 0 <= F <= 2, approaches the root from one side. In terms
        of s = t + min r² no digits are lost. Coordinates are kept 1e-9 off the planes of
        symmetry, where the root is not simple.
        """
        from capsense.scene.ellipsoid_kernels import ellipsoid_distances

        return ellipsoid_distances(np.ascontiguousarray(as_points(points)), self.params)

    def to_trimesh(self) -> trimesh.Trimesh:
        import trimesh

        mesh = trimesh.creation.icosphere(subdivisions=4)
        mesh.apply_scale(self.radii)
        return mesh
