"""PyBullet: a KUKA iiwa carries six electrodes along a person's moving forearm.

Run it: ``python examples/pybullet_forearm.py [FOLDER]``. It needs no display and no OpenGL. A
table, a plot and an animation go to the folder (``out`` by default). The robot and its meshes come
with PyBullet.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pybullet as p
import pybullet_data
import trimesh
from forearm_story import (
    PERSON,
    RATE,
    SECONDS,
    SHIRT,
    SHOULDER,
    SKIN,
    Record,
    check,
    draw,
    person_angles,
    save,
    sensor_target,
)
from shaded import Part, capsule

import capsense as cs

STEP = 0.002
"""Time step [s]."""
BASE = (0.30, -0.58, 0.30)
"""Foot of the robot, on a pedestal."""
FLANGE = 6
REST = (1.4, 0.4, 0.0, -1.7, 0.0, 1.0, 0.0)
"""Joint angles that the robot starts from [rad]."""
PAD = cs.Pose((0.0, 0.0, 0.058))
"""The sensor frame in the flange's frame: z out of the robot."""
TORSO = (
    ("torso", 0.12, 0.30, (-0.04, 0.185, 0.81), SHIRT),
    ("head", 0.085, 0.05, (-0.02, 0.185, 1.20), SKIN),
)
"""Capsules that stand upright: name, radius, length and middle [m], colour."""


class World:
    """The robot with the pad on its flange, and the person."""

    def __init__(self) -> None:
        self.client = p.connect(p.DIRECT)
        p.setTimeStep(STEP, physicsClientId=self.client)
        folder = Path(pybullet_data.getDataPath())
        self.robot = self._load(folder / "kuka_iiwa" / "model.urdf", cs.Pose(BASE))
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "person.urdf"
            file.write_text(PERSON.urdf())
            self.person = self._load(file, SHOULDER)
        self.static: list[Part] = []
        for name, radius, length, middle, colour in TORSO:
            shape = p.createCollisionShape(
                p.GEOM_CAPSULE, radius=radius, height=length, physicsClientId=self.client
            )
            body = p.createMultiBody(0, shape, -1, middle, physicsClientId=self.client)
            p.addUserData(body, "capsense.body", name, physicsClientId=self.client)
            self.static.append((capsule(radius, length), cs.Pose(middle), colour))
        height = BASE[2]
        pedestal = trimesh.creation.cylinder(0.09, height)
        self.static.append((pedestal, cs.Pose((*BASE[:2], height / 2)), (0.25, 0.26, 0.28)))
        self._meshes = [*self._drawn(self.robot), *self._drawn(self.person)]
        names = [self._joint(self.person, k) for k in range(self._count(self.person))]
        self._joints = {name.removeprefix(f"{PERSON.name}_"): k for k, name in enumerate(names)}
        for body in (self.robot, self.person):
            for link in range(-1, self._count(body)):
                p.setCollisionFilterGroupMask(body, link, 0, 0, physicsClientId=self.client)
        for k, angle in enumerate(REST):
            p.resetJointState(self.robot, k, angle, physicsClientId=self.client)

    def _load(self, file: Path, pose: cs.Pose) -> int:
        return p.loadURDF(
            str(file), pose.position, pose.quaternion, useFixedBase=True,
            physicsClientId=self.client,
        )  # fmt: skip

    def _count(self, body: int) -> int:
        return p.getNumJoints(body, physicsClientId=self.client)

    def _joint(self, body: int, number: int) -> str:
        return p.getJointInfo(body, number, physicsClientId=self.client)[1].decode()

    def drive(self, t: float, *, at_once: bool = False) -> None:
        """Set the targets of all motors, or the state itself.

        Bullet solves for a link's centre of mass, which here is its origin.
        """
        pose = sensor_target(t) @ PAD.inverse()
        angles = p.calculateInverseKinematics(
            self.robot, FLANGE, pose.position, pose.quaternion, maxNumIterations=200,
            residualThreshold=1e-6, physicsClientId=self.client,
        )  # fmt: skip
        targets = [(self.robot, k, a) for k, a in enumerate(angles)]
        targets += [(self.person, self._joints[n], a) for n, a in person_angles(t).items()]
        for body, joint, angle in targets:
            if at_once:
                p.resetJointState(body, joint, angle, physicsClientId=self.client)
            p.setJointMotorControl2(
                body, joint, p.POSITION_CONTROL, angle, force=500, physicsClientId=self.client
            )

    def _drawn(self, body: int) -> list[tuple[int, int, Any, cs.Pose, Any]]:
        """Body and link of each mesh or capsule, the mesh, its pose in the link, its colour."""
        out = []
        for _, link, kind, size, file, *pose, rgba in (
            s[:8] for s in p.getVisualShapeData(body, physicsClientId=self.client)
        ):
            if kind == p.GEOM_MESH:
                mesh = trimesh.load(file.decode(), force="mesh", process=False)
                mesh.merge_vertices(merge_tex=True, merge_norm=True)
                mesh.apply_scale(size)
                colour = np.clip(rgba[:3], 0.0, 0.9)
            elif kind == p.GEOM_CAPSULE:
                mesh, colour = capsule(size[1], size[0]), np.array(SKIN)
            else:
                continue
            out.append((body, link, mesh, cs.Pose(*pose), colour))
        return out

    def parts(self) -> list[Part]:
        """Everything as it stands, to be drawn."""
        out = list(self.static)
        for body, link, mesh, pose, colour in self._meshes:
            frame = cs.Pose(BASE)
            if link >= 0:
                state = p.getLinkState(
                    body, link, computeForwardKinematics=1, physicsClientId=self.client
                )
                frame = cs.Pose(*state[4:6])
            out.append((mesh, frame @ pose, colour))
        return out


def main(folder: Path) -> Record:
    """Run the story, check it, and draw it."""
    world = World()
    for _ in range(50):
        world.drive(0.0, at_once=True)
    people = {name: "human" for name in ("right_arm", "torso", "head")}
    sensor = cs.pybullet.attach(
        world.client, world.robot, link="lbr_iiwa_link_7", pose_in_link=PAD, design="six_patch",
        materials=people, grounding=dict.fromkeys(people, 100e-12),
    )  # fmt: skip
    record = Record(sensor.electrode_names)
    stride = round(1 / (RATE * STEP))
    for step in range(round(SECONDS / STEP)):
        if step % stride == 0:
            record.add(step * STEP, sensor.read(), sensor.pose, world.parts())
            world.drive(step * STEP)
        p.stepSimulation(physicsClientId=world.client)
    p.disconnect(physicsClientId=world.client)
    save(record, folder)
    draw(record, folder, "six_patch on a KUKA iiwa, carried along a forearm, in PyBullet")
    check(record)
    return record


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
