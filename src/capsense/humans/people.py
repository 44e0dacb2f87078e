"""A whole person: trunk, neck, head, arms, legs, hands and feet.

The person's frame stands midway between the hip centres: x points forwards, y to the left, z up.
Sizes of trunk and head are from ANSUR II, the heights of hips, shoulders and chin from Drillis and
Contini, masses from Winter (see :mod:`capsense.humans.build`), ranges of joints from Norkin and
White (American Academy of Orthopaedic Surgeons). Estimates: one joint each stands for all of the
lumbar spine, at the height of the iliac crests, and of the neck, midway between suprasternale and
cervicale; how the face is shaped; the postures.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from capsense.humans.build import DATA, Build
from capsense.humans.chain import LimbPart, Segment, scaled_masses
from capsense.humans.limb import Hands, Limb, Side, arm_segments, joints_of, leg_segments

SIDES: tuple[Side, ...] = ("left", "right")
"""The sides of a person, in the order of the segments."""


def _on_both_sides(angles: Mapping[str, float]) -> Mapping[str, float]:
    return MappingProxyType(
        {f"{side}_{name}": math.radians(value) for name, value in angles.items() for side in SIDES}
    )


POSTURES: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {name: _on_both_sides(angles) for name, angles in DATA["postures"].items()}
)
"""Angles [rad] of the joints of a person who is ``"standing"``, ``"sitting"`` or ``"lying"``."""
ON_BACK = (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))
"""How the frame of a person is turned who lies on the back, the head towards -x: a quaternion."""


def person(
    build: Build = Build(),  # noqa: B008, a build is immutable
    *,
    hands: Hands = "simple",
    name: str = "person",
) -> Limb:
    """A whole person; the frame stands midway between the hip centres.

    Segments: pelvis, chest (with the waist), neck, head; and with the prefixes ``left_`` and
    ``right_`` those of :func:`~capsense.humans.arm` and :func:`~capsense.humans.leg`.

    Joints: lumbar_flexion and neck_flexion (forwards), lumbar_lateral and neck_lateral (to the
    left), lumbar_rotation and neck_rotation (to the left); and with the prefixes those of arms,
    legs and hands. :data:`POSTURES` has angles of all joints that are not zero.

    Args:
        build: Size of the person.
        hands: ``"simple"``, five capsules each, or ``"detailed"``, with all finger joints, as
            :func:`~capsense.humans.hand` makes them.
        name: Prefix of the names of bodies; it tells people apart who share a scene.

    Raises:
        SceneError: Other hands.
    """
    segments = _trunk(build)
    lumbar = build.level("iliac crest")
    for side, y in zip(SIDES, (1.0, -1.0), strict=True):
        shoulder = (
            0.0, 0.5 * y * build.shoulder_spacing, build.length("shoulder height") - lumbar
        )  # fmt: skip
        segments += _hung(arm_segments(build, side, hands), side, "chest", shoulder)
    for side, y in zip(SIDES, (1.0, -1.0), strict=True):
        place = (0.0, 0.5 * y * build.hip_spacing, 0.0)
        segments += _hung(leg_segments(build, side), side, "pelvis", place)
    return Limb(name, tuple(segments), POSTURES["standing"])


def _hung(
    segments: tuple[Segment, ...], side: str, parent: str, origin: tuple[float, float, float]
) -> list[Segment]:
    """The segments of a limb, with prefixes, hung on the trunk."""
    return [
        replace(
            s,
            name=f"{side}_{s.name}",
            origin=origin if s.parent is None else s.origin,
            joints=tuple(replace(j, name=f"{side}_{j.name}") for j in s.joints),
            parent=parent if s.parent is None else f"{side}_{s.parent}",
        )
        for s in segments
    ]


def _trunk(build: Build) -> list[Segment]:
    """Pelvis, chest, neck and head."""
    hip, lumbar = build.length("hip height"), build.level("iliac crest")
    rib, top = build.level("tenth rib"), build.level("suprasternale")
    base = 0.5 * (top + build.level("cervicale"))
    chest, waist, hips = (build.section(name) for name in ("chest", "waist", "hips"))
    bottom = min(build.level("crotch") + 0.5 * hips[1], 0.5 * (hip + lumbar)) - hip
    pelvis = _pair(hips, hips, bottom, lumbar - hip)
    upper = top - 0.5 * chest[1] - lumbar
    sides = (waist[0] - waist[1] + chest[1], chest[1])
    thorax = (
        *_pair(waist, waist, 0.0, rib - lumbar),
        *_pair(sides, chest, rib - lumbar, upper),
        LimbPart((0.0, 0.0, upper), (0.0, 0.0, base - lumbar), build.radius("neck")),
        *_girdle(build, base, lumbar),
    )
    throat, skull, middle = _head(build, base)
    joints = {name: joints_of(data) for name, data in DATA["trunk"].items()}
    mass = build.segment_mass("thorax and abdomen")
    neck = Segment("neck", (0.0, 0.0, base - lumbar), joints["neck"], throat, 0.0, "chest")
    head = Segment("head", middle, (), skull, 0.0, "neck")
    return [
        Segment("pelvis", (0.0, 0.0, 0.0), (), pelvis, build.segment_mass("pelvis")),
        Segment("chest", (0.0, 0.0, lumbar - hip), joints["chest"], thorax, mass, "pelvis"),
        *scaled_masses((neck, head), build.segment_mass("head and neck")),
    ]


def _pair(
    low: tuple[float, float], high: tuple[float, float], bottom: float, top: float
) -> tuple[LimbPart, ...]:
    """Two capsules side by side, as broad and deep as two sections at their ends."""
    radius = 0.5 * high[1]
    ends = [
        (0.5 * breadth - 0.5 * depth, z) for (breadth, depth), z in ((low, bottom), (high, top))
    ]
    return tuple(
        LimbPart((0.0, y * ends[0][0], ends[0][1]), (0.0, y * ends[1][0], ends[1][1]), radius)
        for y in (1.0, -1.0)
    )


def _girdle(build: Build, base: float, lumbar: float) -> tuple[LimbPart, ...]:
    """The capsules from the base of the neck to the shoulders."""
    y, z = 0.5 * build.shoulder_spacing, build.length("shoulder height") - lumbar
    radius = build.radius("forearm")
    return tuple(
        LimbPart((0.0, 0.2 * k * y, base - lumbar), (0.0, k * y, z), radius) for k in (1.0, -1.0)
    )


def _head(
    build: Build, base: float
) -> tuple[tuple[LimbPart, ...], tuple[LimbPart, ...], tuple[float, float, float]]:
    """Neck; skull and face; the middle of the skull [m], from the base of the neck."""
    breadth, length = build.section("head")
    radius, half = 0.5 * breadth, 0.5 * (length - breadth)
    middle = (0.01 * build.height, 0.0, build.height - radius - base)
    around = build.radius("neck")
    throat = min(middle[2], middle[2] + radius - around - 0.1 * radius)
    face = 0.7 * radius
    chin = build.length("chin height") + face - (build.height - radius)
    skull = LimbPart((-half, 0.0, 0.0), (half, 0.0, 0.0), radius)
    front = half + 0.8 * (radius - face)
    return (
        (LimbPart((0.0, 0.0, 0.0), (middle[0], 0.0, throat), around),),
        (skull, LimbPart((front, 0.0, 0.0), (front, 0.0, chin), face)),
        middle,
    )
