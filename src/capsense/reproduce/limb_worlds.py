"""Scenario 2's worlds: one limb, and a sensor that is put where it should be.

The world's origin is the middle of a forearm or of a lower leg, whose axis lies along x, its far
end at −x; z is up. The sensor looks down. What Schöffmann et al. 2022 do not give, sizes of their
participants and the ways of their sensor, is chosen here; the four offsets are those that Erickson
et al. 2019 (arXiv 1904.02111) estimate.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.adapters import AttachedSensor
from capsense.humans import Build, Limb, arm, leg
from capsense.humans.formats import mjcf_body
from capsense.scene import Pose
from capsense.scene.materials import Grounding

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


View = Literal["geometry", "depth_camera"]

PIXELS = 64
"""Rows and columns of the depth image."""
WIDTH = 0.5
"""Width and height of the depth image [m], as wide as the domain."""


class MujocoWorld:
    """The limb and the sensor in MuJoCo; its depth camera needs no OpenGL."""

    def __init__(self, place: Course, sim: cs.Simulator, view: View, grounding: Grounding) -> None:
        import mujoco

        body = mjcf_body(place.limb, place.frame)
        self._model = mujoco.MjModel.from_xml_string(
            '<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>'
            f'{body}<body name="sensor" mocap="true"><site name="pad"/>'
            f'<camera name="pad" euler="180 0 0" projection="orthographic" fovy="{WIDTH}" '
            f'resolution="{PIXELS} {PIXELS}"/></body></worldbody>'
            '<sensor><rangefinder camera="pad" data="depth"/></sensor></mujoco>'
        )
        self._data = mujoco.MjData(self._model)
        self.move(sensor_pose(0.0, 0.0, place.thickest + GAP[0], 0.0, 0.0))
        self.sensor: AttachedSensor = cs.mujoco.attach(
            self._model, self._data, "pad", sim, perception=view, default_material="human",
            default_grounding=grounding,
        )  # fmt: skip

    def move(self, pose: Pose) -> None:
        """Put the sensor frame at a pose in the world."""
        import mujoco

        x, y, z, w = pose.quaternion
        self._data.mocap_pos[0] = pose.position
        self._data.mocap_quat[0] = (w, x, y, z)
        mujoco.mj_forward(self._model, self._data)


class PybulletWorld:
    """The limb and the sensor in PyBullet; its depth camera is TinyRenderer."""

    def __init__(
        self, client: int, place: Course, sim: cs.Simulator, view: View, grounding: Grounding
    ) -> None:
        import pybullet as p

        self._client = client
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "limb.urdf"
            file.write_text(place.limb.urdf(), encoding="utf-8")
            p.loadURDF(
                str(file), place.frame.position, place.frame.quaternion, useFixedBase=1,
                physicsClientId=client,
            )  # fmt: skip
        self._body = p.createMultiBody(0, physicsClientId=client)
        image: dict[str, Any] = (
            {"size": WIDTH, "resolution": PIXELS} if view == "depth_camera" else {}
        )
        self.move(sensor_pose(0.0, 0.0, place.thickest + GAP[0], 0.0, 0.0))
        self.sensor: AttachedSensor = cs.pybullet.attach(
            client, self._body, design=sim, perception=view, default_material="human",
            default_grounding=grounding, **image,
        )  # fmt: skip

    def move(self, pose: Pose) -> None:
        """Put the sensor frame at a pose in the world."""
        import pybullet as p

        p.resetBasePositionAndOrientation(
            self._body, pose.position, pose.quaternion, physicsClientId=self._client
        )


LimbWorld = MujocoWorld | PybulletWorld
"""A simulated world with a sensor in it."""


@contextmanager
def opened(
    simulator: str, place: Course, sim: cs.Simulator, view: View, grounding: Grounding
) -> Iterator[LimbWorld]:
    """A world in ``"mujoco"`` or ``"pybullet"``."""
    if simulator == "mujoco":
        yield MujocoWorld(place, sim, view, grounding)
        return
    import pybullet as p

    client = p.connect(p.DIRECT)
    try:
        yield PybulletWorld(client, place, sim, view, grounding)
    finally:
        p.disconnect(client)


def read_poses(world: LimbWorld, poses: tuple[Pose, ...]) -> np.ndarray:
    """Self-capacitances at poses one after another [F], shape (n, electrodes)."""
    world.sensor.reset()
    out = []
    for pose in poses:
        world.move(pose)
        out.append(world.sensor.read().self_capacitance)
    return np.array(out)
