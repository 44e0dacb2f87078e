"""Scenario 2's worlds: one limb, and a sensor that is put where it should be."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

import capsense as cs
from capsense.adapters.attached import AttachedSensor
from capsense.humans.export import mjcf_body
from capsense.reproduce.limb_rides import Course
from capsense.scene import Pose
from capsense.scene.scene import Grounding

View = Literal["geometry", "depth_camera"]

PIXELS = 64
"""Rows and columns of the depth image."""
WIDTH = 0.5
"""Width and height of the depth image [m], as wide as the domain."""


class LimbWorld(Protocol):
    """A simulated world with a sensor in it."""

    sensor: AttachedSensor

    def move(self, pose: Pose) -> None:
        """Put the sensor frame at a pose in the world."""


class MujocoWorld:
    """The limb and the sensor in MuJoCo; its depth camera needs no OpenGL."""

    sensor: AttachedSensor

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
        mujoco.mj_forward(self._model, self._data)
        self.sensor = cs.mujoco.attach(
            self._model, self._data, "pad", sim, perception=view, default_material="human",
            default_grounding=grounding,
        )  # fmt: skip

    def move(self, pose: Pose) -> None:
        import mujoco

        x, y, z, w = pose.quaternion
        self._data.mocap_pos[0] = pose.position
        self._data.mocap_quat[0] = (w, x, y, z)
        mujoco.mj_forward(self._model, self._data)


class PybulletWorld:
    """The limb and the sensor in PyBullet; its depth camera is TinyRenderer."""

    sensor: AttachedSensor

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
        self.sensor = cs.pybullet.attach(
            client, self._body, design=sim, perception=view, default_material="human",
            default_grounding=grounding, **image,
        )  # fmt: skip

    def move(self, pose: Pose) -> None:
        import pybullet as p

        p.resetBasePositionAndOrientation(
            self._body, pose.position, pose.quaternion, physicsClientId=self._client
        )


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
