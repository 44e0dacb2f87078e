"""Arms and legs: chains of capsules with joints.

At rest, all angles zero, a limb hangs straight down: x points forwards, y to the left, z up. The
limb's frame stands at the shoulder or hip centre. Positive angles bend as the joint's name says,
on both sides of the body alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.humans.anthropometry import DATA, Build
from capsense.scene import Body, Capsule, Material, Pose
from capsense.scene.pose import Vec3
from capsense.scene.scene import Grounding, checked_grounding

Side = Literal["left", "right"]


@dataclass(frozen=True)
class LimbPart:
    """A capsule of a segment, in the segment's frame."""

    start: Vec3
    """Centre of one cap [m]."""
    end: Vec3
    """Centre of the other cap [m]."""
    radius: float
    """Radius [m]."""

    @cached_property
    def shape(self) -> Capsule:
        """The solid."""
        return Capsule(self.radius, math.dist(self.start, self.end))

    @cached_property
    def pose(self) -> Pose:
        """Where the solid stands in the segment's frame."""
        start, end = np.array(self.start), np.array(self.end)
        x, y, z = (end - start) / np.linalg.norm(end - start)
        turn = (1.0, 0.0, 0.0, 0.0) if z < -1 + 1e-12 else (-y, x, 0.0, 1.0 + z)
        return Pose(0.5 * (start + end), turn)


@dataclass(frozen=True)
class Joint:
    """A hinge at the origin of a segment."""

    name: str
    axis: Vec3
    """Unit axis in the segment's frame, after the joints before it have turned."""
    lower: float
    """Smallest angle [rad]."""
    upper: float
    """Largest angle [rad]."""


@dataclass(frozen=True)
class Segment:
    """A rigid segment; it hangs on the one before it."""

    name: str
    origin: Vec3
    """Its joint centre [m] in the frame of the segment before, or of the limb."""
    joints: tuple[Joint, ...]
    """Its joints; the first turns all the others."""
    parts: tuple[LimbPart, ...]
    mass: float
    """Mass [kg]."""


@dataclass(frozen=True)
class Limb:
    """An arm or a leg; made by :func:`arm` and :func:`leg`."""

    name: str
    """Prefix of the names of its bodies, ``"right_arm"`` say."""
    segments: tuple[Segment, ...]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """All joints in order, from the body outwards."""
        return tuple(j for s in self.segments for j in s.joints)

    def forward(
        self, angles: Mapping[str, float] | None = None, *, degrees: bool = False
    ) -> dict[str, Pose]:
        """Poses of the segments in the limb's frame.

        Args:
            angles: Angle of each joint by name [rad]; those not given are zero.
            degrees: Whether the angles are in degrees.

        Raises:
            SceneError: There is no such joint, or it does not bend so far.
        """
        checked = self._checked(angles or {}, degrees)
        poses, here = {}, Pose()
        for segment in self.segments:
            here = here @ Pose(segment.origin)
            for joint in segment.joints:
                half = 0.5 * checked.get(joint.name, 0.0)
                x, y, z = (math.sin(half) * a for a in joint.axis)
                here = here @ Pose((0, 0, 0), (x, y, z, math.cos(half)))
            poses[segment.name] = here
        return poses

    def bodies(
        self,
        pose: Pose = Pose(),  # noqa: B008, a pose is immutable
        angles: Mapping[str, float] | None = None,
        *,
        degrees: bool = False,
        material: Material | str = "human",
        grounding: Grounding = 100e-12,
    ) -> list[Body]:
        """The limb as bodies of a scene.

        Args:
            pose: The limb's frame (shoulder or hip centre) in the sensor frame.
            angles: Angle of each joint by name [rad]; those not given are zero.
            degrees: Whether the angles are in degrees.
            material: What it is made of.
            grounding: ``"grounded"``, ``"floating"``, or the capacitance [F] that ties the
                whole person to ground; the bodies share it. A standing person has about 100 pF.

        Raises:
            SceneError: A joint, an angle, the material or the grounding is wrong.
        """
        if not isinstance(pose, Pose):
            raise SceneError(f"pose is {pose!r}; give a Pose(position, quaternion)")
        tie = checked_grounding(grounding)
        if not isinstance(tie, str):
            tie /= sum(len(s.parts) for s in self.segments)
        where = self.forward(angles, degrees=degrees)
        return [
            Body(part.shape, pose @ where[segment.name] @ part.pose, material, tie, name)
            for segment in self.segments
            for name, part in self.named_parts(segment)
        ]

    def named_parts(self, segment: Segment) -> list[tuple[str, LimbPart]]:
        """The parts of a segment with the names of their bodies."""
        return [(f"{self.name}_{segment.name}_{k}", p) for k, p in enumerate(segment.parts, 1)]

    def mjcf(self, pose: Pose = Pose(), **options: object) -> str:  # noqa: B008
        """A MuJoCo model of the limb; see :func:`capsense.humans.formats.to_mjcf`."""
        from capsense.humans.formats import to_mjcf

        return to_mjcf(self, pose, **options)  # type: ignore[arg-type]

    def urdf(self) -> str:
        """A URDF of the limb; see :func:`capsense.humans.formats.to_urdf`."""
        from capsense.humans.formats import to_urdf

        return to_urdf(self)

    def _checked(self, angles: Mapping[str, float], degrees: bool) -> dict[str, float]:
        """Angles [rad], refused where a joint is missing or does not bend so far."""
        joints = {j.name: j for j in self.joints}
        out = {}
        for name, value in angles.items():
            if name not in joints:
                raise SceneError(f"{self.name} has no joint {name!r}; {suggest(name, joints)}")
            joint = joints[name]
            angle = math.radians(value) if degrees else float(value)
            if not joint.lower - 1e-9 <= angle <= joint.upper + 1e-9:
                raise SceneError(
                    f"{self.name}: {name} is {math.degrees(angle):.4g} degrees; it bends from "
                    f"{math.degrees(joint.lower):.4g} to {math.degrees(joint.upper):.4g}"
                )
            out[name] = angle
        return out


def arm(build: Build = Build(), side: Side = "right") -> Limb:  # noqa: B008
    """An arm: upper arm, forearm and hand.

    Joints: shoulder_flexion, shoulder_abduction, shoulder_rotation (inwards), elbow_flexion,
    forearm_pronation, wrist_flexion, wrist_deviation (to the thumb). At rest the palm faces the
    body and the thumb points forwards. Ranges are the normal ones of C. C. Norkin and D. J.
    White, "Measurement of Joint Motion" (American Academy of Orthopaedic Surgeons).

    Args:
        build: Size of the person.
        side: ``"left"`` or ``"right"``.

    Raises:
        SceneError: Another side.
    """
    return _limb("arm", build, side)


def leg(build: Build = Build(), side: Side = "right") -> Limb:  # noqa: B008
    """A leg: thigh, shank and foot.

    Joints: hip_flexion, hip_abduction, hip_rotation (inwards), knee_flexion, ankle_flexion (toes
    up), ankle_inversion. At rest the toes point forwards. Ranges as for :func:`arm`.

    Args:
        build: Size of the person.
        side: ``"left"`` or ``"right"``.

    Raises:
        SceneError: Another side.
    """
    return _limb("leg", build, side)


def _limb(kind: str, build: Build, side: Side) -> Limb:
    """The limb that ``people.toml`` describes."""
    s = _sign(side)
    segments, origin = [], (0.0, 0.0, 0.0)
    for data in DATA[kind]:
        name, length = data["name"], build.length(data["name"])
        if name in ("hand", "foot"):
            parts = _hand(build) if name == "hand" else _foot(build, s)
        else:
            parts = _along(length, [(a, b, _radius(build, n)) for a, b, n in data["parts"]])
        joints = tuple(
            _hinge(joint, (s * x + 0.0, y, s * z + 0.0), low, high)
            for joint, (x, y, z), low, high in data["joints"]
        )
        mass = build.segment_mass(name)
        segments.append(Segment(name.replace(" ", "_"), origin, joints, parts, mass))
        origin = (0.0, 0.0, -length)
    return Limb(f"{side}_{kind}", tuple(segments))


def _radius(build: Build, names: Sequence[str]) -> float:
    """Mean radius [m] of circumferences."""
    return sum(build.radius(name) for name in names) / len(names)


def _sign(side: str) -> float:
    """1 for the right side; axes that mirror change their sign on the left."""
    if side not in get_args(Side):
        raise SceneError(f'side is {side!r}; choose "left" or "right"')
    return 1.0 if side == "right" else -1.0


def _hinge(name: str, axis: tuple[float, float, float], lower: float, upper: float) -> Joint:
    """A joint from its range in degrees."""
    x, y, z = (float(a) for a in axis)
    return Joint(name, (x, y, z), math.radians(lower), math.radians(upper))


def _along(length: float, profile: Iterable[tuple[float, float, float]]) -> tuple[LimbPart, ...]:
    """Coaxial capsules down a segment: from, to as fractions of its length, radius [m]."""
    return tuple(
        LimbPart((0.0, 0.0, -a * length), (0.0, 0.0, -b * length), r) for a, b, r in profile
    )


def _hand(build: Build) -> tuple[LimbPart, ...]:
    """Four fingers side by side, down to the wrist, and a thumb along the foremost."""
    radius = 0.5 * build.hand_thickness
    length, breadth = build.length("hand"), build.hand_breadth
    tip = -(length - radius)
    row = np.linspace(-0.5 * breadth + radius, 0.5 * breadth - radius, 4)
    fingers = [LimbPart((float(x), 0.0, 0.0), (float(x), 0.0, tip), radius) for x in row]
    front = float(row[-1])
    thumb = LimbPart(
        (front, 0.0, -0.15 * length), (front + 1.5 * radius, 0.0, -0.5 * length), 0.8 * radius
    )
    return (*fingers, thumb)


def _foot(build: Build, outwards: float) -> tuple[LimbPart, ...]:
    """Two capsules along the sole and one from the ankle down to the heel."""
    length, breadth = build.length("foot"), build.length("foot breadth")
    radius = 0.25 * breadth
    sole = -build.length("ankle height") + radius
    heel, toe = -0.25 * length + radius, 0.75 * length - radius
    sides = [
        LimbPart((heel, y, sole), (toe, y, sole), radius)
        for y in (-outwards * radius, outwards * radius)
    ]
    thick = 1.4 * radius
    return (*sides, LimbPart((0.0, 0.0, 0.0), (heel + radius, 0.0, sole + thick - radius), thick))
