"""Scenes: the bodies around a sensor at one instant."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number
from capsense.errors import SceneError
from capsense.scene.materials import DATA, Material
from capsense.scene.materials import material as find_material
from capsense.scene.pose import Pose
from capsense.scene.shapes import Shape


@dataclass(frozen=True)
class GroundPath:
    """A capacitance to ground, with a resistance in series and one in parallel to both.

    Raises:
        SceneError: A number is out of range.
    """

    capacitance: float
    """[F]"""
    series: float = 0.0
    """Resistance of the body itself, in series [Ω]."""
    leakage: float = math.inf
    """Resistance of shoes and floor, in parallel [Ω]."""
    source: str = ""
    """Where the numbers come from."""

    def __post_init__(self) -> None:
        if not 0 < as_number(self.capacitance) < math.inf:
            raise SceneError(
                f"ground path: capacitance is {self.capacitance!r} F; give a positive number, "
                "like 100e-12"
            )
        if not 0 <= as_number(self.series) < math.inf:
            raise SceneError(f"ground path: series is {self.series!r} Ω; give zero or more")
        if not as_number(self.leakage) > 0:
            raise SceneError(f"ground path: leakage is {self.leakage!r} Ω; give a positive number")

    def impedance(self, frequency: float) -> complex:
        """Impedance from the body to ground at ``frequency`` [Hz], in ohms.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        if not 0 < as_number(frequency) < math.inf:
            raise SceneError(f"frequency is {frequency!r} Hz; give a positive finite number")
        branch = self.series + 1 / (2j * math.pi * frequency * self.capacitance)
        return 1 / (1 / branch + 1 / self.leakage)

    def equivalent_capacitance(self, frequency: float) -> float:
        """Capacitance with the same magnitude of impedance at ``frequency`` [Hz], in farads.

        What ``Body(grounding=...)`` takes. The phase is left out: 13 degrees off a pure
        capacitance for the human-body model at 250 kHz.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        return 1 / (2 * math.pi * frequency * abs(self.impedance(frequency)))


GROUND_PATHS: Mapping[str, GroundPath] = MappingProxyType(
    {name: GroundPath(**figures) for name, figures in DATA["ground_paths"].items()}
)
"""Models of a person's path to ground, by name."""


_LARGEST = 1e-3
"""Capacitances to ground beyond this [F] are slips of the pen."""

Grounding = Literal["grounded", "floating"] | float


@dataclass(frozen=True, init=False, eq=False)
class Body:
    """One object of the scene.

    Args:
        shape: The solid.
        pose: Where it stands in the sensor frame.
        material: A :class:`Material`, or the name of a known one.
        grounding: ``"grounded"``, ``"floating"``, or the capacitance [F] that ties the body to
            ground. It matters for conductors only.
        name: Optional; unique within a scene.

    Raises:
        SceneError: An argument is of the wrong kind or out of range.
    """

    shape: Shape
    pose: Pose
    material: Material
    grounding: Grounding
    name: str | None

    def __init__(
        self,
        shape: Shape,
        pose: Pose = Pose(),  # noqa: B008, a pose is immutable
        material: Material | str = "steel",
        grounding: Grounding = "grounded",
        name: str | None = None,
    ) -> None:
        if not isinstance(shape, Shape):
            raise SceneError(
                f"shape is {shape!r}; give a Box, Sphere, Capsule, Cylinder, Ellipsoid or TriMesh"
            )
        if not (name is None or (isinstance(name, str) and name)):
            raise SceneError(f"body name is {name!r}; give a non-empty string or None")
        fields = self.__dict__
        fields["shape"] = shape
        fields["pose"] = _checked_pose(pose)
        fields["material"] = material if isinstance(material, Material) else find_material(material)
        fields["grounding"] = checked_grounding(grounding)
        fields["name"] = name

    def moved(self, pose: Pose) -> Body:
        """Return the same body at another pose; shape and material are shared.

        Raises:
            SceneError: ``pose`` is not a :class:`Pose`.
        """
        body = object.__new__(Body)
        body.__dict__.update(self.__dict__)
        body.__dict__["pose"] = _checked_pose(pose)
        return body


def _checked_pose(pose: object) -> Pose:
    if not isinstance(pose, Pose):
        raise SceneError(f"pose is {pose!r}; give a Pose(position, quaternion)")
    return pose


def checked_grounding(grounding: object) -> Grounding:
    """Check a grounding.

    Raises:
        SceneError: Neither one of the two words nor a positive capacitance up to 1 mF.
    """
    fix = 'give "grounded", "floating", or a capacitance to ground in farads, like 100e-12'
    if isinstance(grounding, str):
        if grounding == "grounded":
            return "grounded"
        if grounding == "floating":
            return "floating"
        raise SceneError(f"grounding is {grounding!r}; {fix}")
    if isinstance(grounding, bool):
        raise SceneError(f"grounding is {grounding!r}; {fix}")
    try:
        farads = float(grounding)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"grounding is {grounding!r}; {fix}") from None
    if not (math.isfinite(farads) and farads > 0):
        raise SceneError(f"grounding is {farads} F, not a positive finite capacitance; {fix}")
    if farads > _LARGEST:
        raise SceneError(
            f"grounding is {farads:g} farads, more than anything has; 100 pF are 100e-12, and a "
            'body of a large capacitance to ground is "grounded"'
        )
    return farads


Array = NDArray[np.float64]


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
        SceneError: Something is not a :class:`Body`, or two bodies share a name.
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
        for i, body in enumerate(items):
            if not isinstance(body, Body):
                fix = f"; write Body({body!r}, ...)" if isinstance(body, Shape) else ""
                raise SceneError(f"bodies[{i}] is {body!r}, not a Body{fix}")
            if body.name is not None:
                if body.name in names:
                    raise SceneError(f"two bodies are named {body.name!r}; names must differ")
                names.add(body.name)
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
