"""How large people are; arms and legs, as chains of capsules with joints.

At rest, all angles zero, a limb hangs straight down: x points forwards, y to the left, z up. The
limb's frame stands at the shoulder or hip centre. Positive angles bend as the joint's name says,
on both sides of the body alike.

Lengths of segments are fractions of stature: R. Drillis and R. Contini, "Body Segment
Parameters", Report 1166-03, New York University, 1966, as printed in D. A. Winter,
"Biomechanics and Motor Control of Human Movement", 4th ed., Wiley, 2009, figure 4.1. Masses of
segments are fractions of body mass: Winter, table 4.1.

Circumferences are means over 4082 men and 1986 women: C. C. Gordon et al., "2012 Anthropometric
Survey of U.S. Army Personnel: Methods and Summary Statistics" (ANSUR II), NATICK/TR-15/007,
2014. Those of upper arm and forearm were taken flexed, so they are the largest. The survey's
people are fit adults; others are reached with ``girth``.

The spread of stature is the distance of the 5th from the 95th percentile in R. L. Huston,
"Principles of Biomechanics", CRC Press, 2009 (men 1.649 to 1.869 m, women 1.518 to 1.724 m),
divided by 2 · 1.645, as for a normal distribution.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from statistics import NormalDist
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np

from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.humans.chain import Chain, Joint, LimbPart, Segment
from capsense.humans.formats import to_mjcf, to_urdf
from capsense.scene import Body, Material, Pose
from capsense.scene.materials import Grounding, checked_grounding
from capsense.scene.pose import checked_pose

Sex = Literal["female", "male"]
Side = Literal["left", "right"]

DATA: Mapping[str, Any] = tomllib.loads(
    resources.files("capsense.humans").joinpath("people.toml").read_text(encoding="utf-8")
)
"""The tables of ``people.toml``: sizes of people, and the segments of their limbs."""
LENGTHS: Mapping[str, float] = MappingProxyType(DATA["lengths"])
"""Lengths as fractions of stature (Drillis and Contini 1966)."""
MASSES: Mapping[str, float] = MappingProxyType(DATA["masses"])
"""Masses as fractions of body mass (Winter 2009)."""
STATURE: Mapping[Sex, tuple[float, float]] = MappingProxyType(DATA["stature"])
"""Mean [m] (ANSUR II) and standard deviation [m] (Huston 2009) of stature."""
CIRCUMFERENCES: Mapping[str, Mapping[Sex, float]] = MappingProxyType(DATA["circumferences"])
"""Mean circumferences [m] at mean stature (ANSUR II)."""
HAND_BREADTH: Mapping[Sex, float] = MappingProxyType(DATA["hand_breadth"])
"""Mean breadth of the hand at the knuckles [m] at mean stature (ANSUR II)."""
ANKLE = 0.13
"""Circumference of the ankle as a fraction of stature; an estimate, rounded."""
BODY_MASS_INDEX = 25.0
"""Body mass over stature squared [kg/m²] that masses are reckoned with; an assumption."""


@dataclass(frozen=True)
class Build:
    """The size of a person.

    Lengths follow stature; circumferences follow stature and ``girth``.

    Raises:
        SceneError: Another sex, or a number out of range.
    """

    sex: Sex = "male"
    stature: float | None = None
    """Height of the body [m]; by default that of the percentile."""
    percentile: float = 50.0
    """Percentile of stature within the sex; ignored where stature is given."""
    girth: float = 1.0
    """Factor on all circumferences. Those of forearms spread by about a tenth."""

    def __post_init__(self) -> None:
        if self.sex not in get_args(Sex):
            raise SceneError(f'sex is {self.sex!r}; choose "female" or "male"')
        _within("percentile", self.percentile, 0.1, 99.9, "")
        _within("girth", self.girth, 0.5, 2.0, "")
        if self.stature is None:
            mean, spread = STATURE[self.sex]
            stature = NormalDist(mean, spread).inv_cdf(self.percentile / 100)
            object.__setattr__(self, "stature", stature)
        else:
            _within("stature", self.stature, 0.8, 2.3, " m")

    @property
    def height(self) -> float:
        """Height of the body [m]."""
        assert self.stature is not None
        return self.stature

    @property
    def mass(self) -> float:
        """Body mass [kg]."""
        return BODY_MASS_INDEX * self.height**2

    def length(self, name: str) -> float:
        """A length [m] of :data:`LENGTHS`."""
        return LENGTHS[name] * self.height

    def segment_mass(self, name: str) -> float:
        """The mass [kg] of a segment of :data:`MASSES`."""
        return MASSES[name] * self.mass

    def radius(self, name: str) -> float:
        """The radius [m] of the circle that has a circumference of :data:`CIRCUMFERENCES`."""
        if name == "ankle":
            around = ANKLE * self.height
        else:
            around = CIRCUMFERENCES[name][self.sex] * self._scale
        return self.girth * around / (2 * math.pi)

    @property
    def hand_breadth(self) -> float:
        """Breadth of the hand at the knuckles [m]."""
        return self.girth * HAND_BREADTH[self.sex] * self._scale

    @property
    def hand_thickness(self) -> float:
        """Thickness [m] of a hand whose section is a stadium of known breadth and circumference.

        Around a stadium of breadth b and thickness t run 2 (b − t) + π t.
        """
        around = 2 * math.pi * self.radius("hand")
        return (around - 2 * self.hand_breadth) / (math.pi - 2)

    @property
    def _scale(self) -> float:
        return self.height / STATURE[self.sex][0]


def _within(name: str, value: object, low: float, high: float, unit: str) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not low <= value <= high:  # type: ignore[operator]
        raise SceneError(f"{name} is {value!r}; give a number from {low:g} to {high:g}{unit}")


@dataclass(frozen=True)
class Limb(Chain):
    """An arm or a leg; made by :func:`arm` and :func:`leg`."""

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
        checked_pose(pose)
        tie = checked_grounding(grounding)
        if not isinstance(tie, str):
            tie /= sum(len(s.parts) for s in self.segments)
        where = self.forward(angles, degrees=degrees)
        return [
            Body(part.shape, pose @ where[segment.name] @ part.pose, material, tie, name)
            for segment in self.segments
            for name, part in self.named_parts(segment)
        ]

    def mjcf(self, pose: Pose = Pose(), **options: object) -> str:  # noqa: B008
        """A MuJoCo model of the limb; see :func:`capsense.humans.formats.to_mjcf`."""
        return to_mjcf(self, pose, **options)  # type: ignore[arg-type]

    def urdf(self) -> str:
        """A URDF of the limb; see :func:`capsense.humans.formats.to_urdf`."""
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


def arm(build: Build = Build(), side: Side = "right") -> Limb:
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


def leg(build: Build = Build(), side: Side = "right") -> Limb:
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
            mean = [(a, b, sum(map(build.radius, n)) / len(n)) for a, b, n in data["parts"]]
            parts = _along(length, mean)
        joints = tuple(
            Joint(
                joint, (s * x + 0.0, float(y), s * z + 0.0), math.radians(low), math.radians(high)
            )
            for joint, (x, y, z), low, high in data["joints"]
        )
        mass = build.segment_mass(name)
        segments.append(Segment(name.replace(" ", "_"), origin, joints, parts, mass))
        origin = (0.0, 0.0, -length)
    return Limb(f"{side}_{kind}", tuple(segments))


def _sign(side: str) -> float:
    """1 for the right side; axes that mirror change their sign on the left."""
    if side not in get_args(Side):
        raise SceneError(f'side is {side!r}; choose "left" or "right"')
    return 1.0 if side == "right" else -1.0


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
