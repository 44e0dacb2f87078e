"""Scenario 2: who takes part, and how the sensor rides along their limbs.

The world's origin is the middle of a forearm or of a lower leg, whose axis lies along x, its far
end at −x; z is up. The sensor looks down. What Schöffmann et al. 2022 do not give, sizes of their
participants and the ways of their sensor, is chosen here; the four offsets are those that Erickson
et al. 2019 (arXiv 1904.02111) estimate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from capsense.humans import Build, Limb, arm, leg
from capsense.scene import Pose

Array = NDArray[np.float64]
Which = Literal["arm", "leg"]

PARTICIPANTS: dict[str, Build] = {
    "1": Build("female", percentile=5, girth=0.92),
    "2": Build("female", percentile=50),
    "3": Build("male", percentile=30, girth=1.10),
    "4": Build("male", percentile=60, girth=0.95),
    "5": Build("male", percentile=95, girth=1.05),
}
"""Five bodies from small and slender to tall."""
RIDES = 20
"""Rides for each participant, by turns along the right arm and the right leg."""
SEED = 2022
SPEED = 0.05
"""Along the limb [m/s], as in the dressing study of Erickson et al. 2018."""
RATE = 5.0
"""Samples per second [Hz]."""
LENGTH = 0.20
"""Way along the limb [m], half to either side of the segment's middle."""
LATERAL = 0.08
"""Greatest offset to either side [m]."""
GAP = (0.015, 0.12)
"""Smallest and greatest distance of the electrodes' middle above the limb's thickest part [m]."""
TURN = math.radians(22.5)
"""Greatest pitch, and greatest yaw, to either side [rad]."""
CLEARANCE = 0.01
"""Least distance of the sensor's plate from the skin [m]; offsets that lead closer are redrawn."""
PLATE = (0.115, 0.085)
"""Size of the sensor's plate [m]."""
_SEGMENTS: dict[Which, str] = {"arm": "forearm", "leg": "shank"}
_HALF_ROOT = math.sqrt(0.5)
_DOWN = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Course:
    """A limb laid out for the sensor to ride along."""

    limb: Limb
    frame: Pose
    """The limb's own frame in the world."""
    thickest: float
    """Radius of the segment's thickest part [m]."""


@dataclass(frozen=True, eq=False)
class Ride:
    """One way of the sensor."""

    which: Which
    time: Array
    """[s], shape (n,)."""
    offsets: Array
    """Lateral [m], gap [m], pitch and yaw [rad] at the start and at the end, shape (2, 4)."""
    poses: tuple[Pose, ...]
    """The sensor frame in the world at each time."""


def course(build: Build, which: Which) -> Course:
    """A participant's right arm or leg, straight, the middle of its lower part at the origin."""
    limb = (arm if which == "arm" else leg)(build, "right")
    at_rest = limb.forward()
    names = [segment.name for segment in limb.segments]
    number = names.index(_SEGMENTS[which])
    top, bottom = (at_rest[names[number + k]].position[2] for k in (0, 1))
    frame = Pose((-0.5 * (top + bottom), 0.0, 0.0), (0.0, _HALF_ROOT, 0.0, _HALF_ROOT))
    return Course(limb, frame, max(p.radius for p in limb.segments[number].parts))


def rides(participant: str, count: int = RIDES) -> list[Ride]:
    """The first rides of a participant; the same at every call."""
    build = PARTICIPANTS[participant]
    courses: dict[Which, Course] = {"arm": course(build, "arm"), "leg": course(build, "leg")}
    out = []
    for number in range(count):
        random = np.random.default_rng([SEED, int(participant), number])
        which: Which = "arm" if number % 2 == 0 else "leg"
        out.append(_draw(courses[which], which, random))
    return out


def _draw(place: Course, which: Which, random: np.random.Generator) -> Ride:
    """Offsets at both ends at random, changing evenly between, until the plate stays clear."""
    low = np.array([-LATERAL, GAP[0], -TURN, -TURN])
    high = np.array([LATERAL, GAP[1], TURN, TURN])
    time = np.arange(round(LENGTH / SPEED * RATE) + 1) / RATE
    share = (time / time[-1])[:, None]
    way = 1.0 if random.random() < 0.5 else -1.0
    along = way * LENGTH * (share[:, 0] - 0.5)
    while True:
        offsets = random.uniform(low, high, (2, 4))
        states = offsets[0] + share * (offsets[1] - offsets[0])
        poses = tuple(
            sensor_pose(x, lateral, place.thickest + gap, pitch, yaw)
            for x, (lateral, gap, pitch, yaw) in zip(along, states, strict=True)
        )
        if clearance(place, poses) > CLEARANCE:
            return Ride(which, time, offsets, poses)


def sensor_pose(x: float, y: float, z: float, pitch: float, yaw: float) -> Pose:
    """A sensor that looks down, turned by yaw about the vertical after pitch about its own y.

    Args:
        x, y, z: Middle of the electrode plane [m].
        pitch: Positive raises the end at +x [rad].
        yaw: Positive turns counterclockwise as seen from above [rad].
    """
    turned = Pose((x, y, z), (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)))
    tilted = Pose((0.0, 0.0, 0.0), (0.0, -math.sin(0.5 * pitch), 0.0, math.cos(0.5 * pitch)))
    return turned @ tilted @ _DOWN


def clearance(place: Course, poses: tuple[Pose, ...]) -> float:
    """Least distance between the plate's face and the limb over all poses [m]."""
    x, y = (np.linspace(-0.5 * size, 0.5 * size, 5) for size in PLATE)
    face = np.stack([*np.meshgrid(x, y), np.zeros((5, 5))], axis=-1).reshape(-1, 3)
    points = np.concatenate([pose.apply(face) for pose in poses])
    bodies = place.limb.bodies(place.frame)
    return min(
        float(body.shape.signed_distance(body.pose.inverse().apply(points)).min())
        for body in bodies
    )
