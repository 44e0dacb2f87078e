"""Arms, legs and hands, as trees of capsules with joints; what they share with whole people.

At rest, all angles zero, a limb hangs straight down: x points forwards, y to the left, z up. The
limb's frame stands at the shoulder, hip or wrist centre. Positive angles bend as the joint's name
says, on both sides of the body alike.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from capsense.errors import SceneError
from capsense.humans.build import DATA, Build
from capsense.humans.chain import Chain, Joint, LimbPart, Segment
from capsense.humans.fingers import hand_segments
from capsense.humans.formats import to_mjcf, to_urdf
from capsense.scene import Body, Material, Pose
from capsense.scene.materials import Grounding
from capsense.scene.pose import checked_pose

Side = Literal["left", "right"]
Hands = Literal["simple", "detailed"]


@dataclass(frozen=True)
class Limb(Chain):
    """A limb or person; made by :func:`arm`, :func:`leg`, :func:`hand` and :func:`person`."""

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
            pose: The limb's frame (shoulder, hip or wrist centre, or between the hips) in the
                sensor frame.
            angles: Angle of each joint by name [rad]; those not given are zero.
            degrees: Whether the angles are in degrees.
            material: What it is made of.
            grounding: ``"grounded"``, ``"floating"``, or the capacitance [F] that ties the
                whole person to ground, :func:`~capsense.humans.capacitance_to_ground` say. The
                bodies are one conductor of the limb's name.

        Raises:
            SceneError: A joint, an angle, the material or the grounding is wrong.
        """
        checked_pose(pose)
        where = {n: pose @ at for n, at in self.forward(angles, degrees=degrees).items()}
        return [
            Body(
                part.shape,
                where[segment.name] @ part.pose,
                material,
                grounding,
                name,
                conductor=self.name,
            )
            for segment in self.segments
            for name, part in self.named_parts(segment)
        ]

    def on_floor(
        self,
        angles: Mapping[str, float] | None = None,
        *,
        degrees: bool = False,
        turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
        floor: float = 0.0,
    ) -> Pose:
        """The pose of the limb's frame, above the origin, whose lowest point is on a floor.

        Args:
            angles: Angle of each joint by name [rad]; those not given are zero.
            degrees: Whether the angles are in degrees.
            turn: Quaternion (x, y, z, w) of the frame, :data:`~capsense.humans.ON_BACK` say.
            floor: Height of the floor [m]; soles or a seat lift it.

        Raises:
            SceneError: A joint, an angle or the quaternion is wrong.
        """
        turned, where = Pose((0.0, 0.0, 0.0), turn), self.forward(angles, degrees=degrees)
        low = min(
            float((turned @ where[s.name]).apply([p.start, p.end])[:, 2].min()) - p.radius
            for s in self.segments
            for p in s.parts
        )
        return Pose((0.0, 0.0, floor - low), turn)

    def mjcf(self, pose: Pose = Pose(), **options: object) -> str:  # noqa: B008
        """A MuJoCo model of the limb; see :func:`capsense.humans.formats.to_mjcf`."""
        return to_mjcf(self, pose, **options)  # type: ignore[arg-type]

    def urdf(self) -> str:
        """A URDF of the limb; see :func:`capsense.humans.formats.to_urdf`."""
        return to_urdf(self)


def arm(
    build: Build = Build(),  # noqa: B008, a build is immutable
    side: Side = "right",
    *,
    hand: Hands = "simple",
) -> Limb:
    """An arm: upper arm, forearm and hand.

    Joints: shoulder_flexion, shoulder_abduction, shoulder_rotation (inwards), elbow_flexion,
    forearm_pronation, wrist_flexion, wrist_deviation (to the thumb). At rest the palm faces the
    body and the thumb points forwards. Ranges are the normal ones of C. C. Norkin and D. J.
    White, "Measurement of Joint Motion" (American Academy of Orthopaedic Surgeons).

    Args:
        build: Size of the person.
        side: ``"left"`` or ``"right"``.
        hand: ``"simple"``, five capsules that are one segment, or ``"detailed"``, as
            :func:`hand` makes it.

    Raises:
        SceneError: Another side or hand.
    """
    return Limb(f"{_sided(side)}_arm", arm_segments(build, side, hand))


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
    return Limb(f"{_sided(side)}_leg", leg_segments(build, side))


def hand(build: Build = Build(), side: Side = "right") -> Limb:  # noqa: B008
    """A hand with all its joints, which hangs on the wrist.

    At rest the fingers hang down side by side, the palm faces the body, and the thumb points
    forwards and down. Segments: palm; thumb_metacarpal, thumb_proximal, thumb_distal; and of index,
    middle, ring and little, such as index_proximal, index_intermediate, index_distal. At rest
    their frames are parallel.

    Joints: wrist_flexion, wrist_deviation; thumb_cmc_flexion (to the fingers),
    thumb_cmc_abduction (out of the plane of the palm), thumb_mcp_flexion, thumb_ip_flexion; and of
    each finger, such as index_mcp_flexion, index_mcp_abduction (away from the middle finger; of
    the middle finger, to the thumb), index_pip_flexion, index_dip_flexion. For sources see
    :mod:`capsense.humans.fingers`.

    Args:
        build: Size of the person.
        side: ``"left"`` or ``"right"``.

    Raises:
        SceneError: Another side.
    """
    mirror = _sign(side)
    wrist = joints_of(DATA["arm"][-1]["joints"], mirror)
    return Limb(f"{side}_hand", hand_segments(build, mirror, wrist, (0.0, 0.0, 0.0)))


def arm_segments(build: Build, side: Side, hand: Hands) -> tuple[Segment, ...]:
    """The segments of an arm, see :func:`arm`."""
    if hand not in get_args(Hands):
        raise SceneError(f'hand is {hand!r}; choose "simple" or "detailed"')
    found = _segments("arm", build, side)
    if hand == "simple":
        return found
    *above, last = found
    detailed = hand_segments(build, _sign(side), last.joints, last.origin)
    return (*above, replace(detailed[0], parent=last.parent), *detailed[1:])


def leg_segments(build: Build, side: Side) -> tuple[Segment, ...]:
    """The segments of a leg, see :func:`leg`."""
    return _segments("leg", build, side)


def _segments(kind: str, build: Build, side: Side) -> tuple[Segment, ...]:
    """The segments of a limb that ``people.toml`` describes."""
    mirror = _sign(side)
    out: list[Segment] = []
    origin, parent = (0.0, 0.0, 0.0), None
    for data in DATA[kind]:
        name, length = data["name"], build.length(data["name"])
        if name in ("hand", "foot"):
            parts = _hand(build) if name == "hand" else _foot(build, mirror)
        else:
            mean = [(a, b, sum(map(build.radius, n)) / len(n)) for a, b, n in data["parts"]]
            parts = _along(length, mean)
        mass = build.segment_mass(name)
        name = name.replace(" ", "_")
        out.append(Segment(name, origin, joints_of(data["joints"], mirror), parts, mass, parent))
        origin, parent = (0.0, 0.0, -length), name
    return tuple(out)


def joints_of(data: Iterable[Any], mirror: float = 1.0) -> tuple[Joint, ...]:
    """Joints as ``people.toml`` lists them; those of the left side mirror."""
    return tuple(
        Joint(
            name,
            (mirror * x + 0.0, float(y), mirror * z + 0.0),
            math.radians(low),
            math.radians(high),
        )
        for name, (x, y, z), low, high in data
    )


def _sided(side: str) -> str:
    """The name of a side, checked."""
    _sign(side)
    return side


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
