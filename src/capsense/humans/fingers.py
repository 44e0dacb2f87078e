"""The hand with all its joints.

Lengths of bones, and where the knuckles lie, are fractions of the length and breadth of the hand:
B. Buchholz, T. J. Armstrong and S. A. Goldstein, "Anthropometric data for describing the kinematics
of the human hand", Ergonomics 35(3), 1992. Ranges of joints: C. C. Norkin and D. J. White,
"Measurement of Joint Motion" (American Academy of Orthopaedic Surgeons). Estimates: diameters of
phalanges, the resting direction and the axes of the thumb, the abduction of fingers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.humans.build import DATA, Build
from capsense.humans.chain import Joint, LimbPart, Segment, scaled_masses

FINGERS: Mapping[str, Any] = DATA["fingers"]
"""Index, middle, ring and little finger, from the thumb on."""
PHALANGES = ("proximal", "intermediate", "distal")
"""Segments of a finger, from the knuckle on."""
THUMB = ("metacarpal", "proximal", "distal")
"""Segments of the thumb, from the wrist on."""
_RANGES: Mapping[str, tuple[float, float]] = DATA["hand_ranges"]


def hand_segments(
    build: Build, mirror: float, wrist: tuple[Joint, ...], origin: tuple[float, float, float]
) -> tuple[Segment, ...]:
    """Palm, thumb and fingers; the frames of all are parallel at rest.

    Args:
        build: Size of the person.
        mirror: 1 for the right hand, -1 for the left one.
        wrist: Joints of the wrist.
        origin: The wrist [m] in the frame of what the hand hangs on.
    """
    length, breadth = build.length("hand"), build.hand_breadth
    along = length / (FINGERS["middle"]["knuckle"][0] + sum(FINGERS["middle"]["phalanges"]))
    half = 0.5 * build.hand_thickness

    def at(place: tuple[float, float]) -> tuple[float, float, float]:
        return breadth * place[1], 0.0, -along * place[0]

    palm = tuple(LimbPart(at(f["base"]), at(f["knuckle"]), half) for f in FINGERS.values())
    out = [Segment("palm", origin, wrist, palm, 0.0)]
    down, across = np.array([0.0, 0.0, -1.0]), np.array([mirror, 0.0, 0.0])
    for name, finger in FINGERS.items():
        away = -1.0 if finger["knuckle"][1] >= 0.0 else 1.0  # from the middle finger
        joints = (
            (
                _joint(f"{name}_mcp_flexion", across, "mcp_flexion"),
                _joint(f"{name}_mcp_abduction", np.array([0.0, away, 0.0]), "mcp_abduction"),
            ),
            *((_joint(f"{name}_{k}_flexion", across, f"{k}_flexion"),) for k in ("pip", "dip")),
        )
        names = [f"{name}_{phalanx}" for phalanx in PHALANGES]
        out += _digit(names, at(finger["knuckle"]), down, finger, joints, along, breadth)
    thumb, spread, turn = DATA["thumb"], *np.radians([DATA["thumb"][k] for k in ("spread", "turn")])
    ahead = np.array([math.sin(spread), 0.0, -math.cos(spread)])
    to_fingers = np.array([0.0, 1.0, 0.0])
    to_palm = mirror * np.array([math.cos(spread), 0.0, math.sin(spread)])
    bend = math.cos(turn) * to_fingers + math.sin(turn) * to_palm
    joints = (
        (
            _joint("thumb_cmc_flexion", to_fingers, "thumb_cmc_flexion"),
            _joint("thumb_cmc_abduction", to_palm, "thumb_cmc_abduction"),
        ),
        *((_joint(f"thumb_{k}_flexion", bend, f"thumb_{k}_flexion"),) for k in ("mcp", "ip")),
    )
    names = [f"thumb_{bone}" for bone in THUMB]
    out += _digit(names, at(thumb["base"]), ahead, thumb, joints, along, breadth)
    return scaled_masses(out, build.segment_mass("hand"))


def _digit(
    names: list[str], origin: tuple[float, float, float], ahead: NDArray[np.float64],
    data: Mapping[str, Any], joints: tuple[tuple[Joint, ...], ...], along: float, breadth: float,
) -> list[Segment]:  # fmt: skip
    """The segments of a finger or thumb, each a capsule; the last ends with its length."""
    out, parent = [], "palm"
    for k, (name, hinges) in enumerate(zip(names, joints, strict=True)):
        length, radius = along * data["phalanges"][k], 0.5 * breadth * data["diameters"][k]
        end = length - (radius if k == len(names) - 1 else 0.0)
        part = LimbPart((0.0, 0.0, 0.0), _vector(end * ahead), radius)
        out.append(Segment(name, origin, hinges, (part,), 0.0, parent))
        origin, parent = _vector(length * ahead), name
    return out


def _joint(name: str, axis: NDArray[np.float64], range_: str) -> Joint:
    low, high = _RANGES[range_]
    return Joint(name, _vector(axis), math.radians(low), math.radians(high))


def _vector(values: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = (float(v) + 0.0 for v in values)
    return x, y, z
