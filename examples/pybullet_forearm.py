"""PyBullet: a robot arm carries six electrodes along a person's moving forearm.

Run it: ``python examples/pybullet_forearm.py [FOLDER]``. It needs no display. A table, a plot
and an animation go to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pybullet as p
from forearm_story import (
    PAD,
    PAD_BOX,
    PAD_SIZE,
    PERSON,
    RATE,
    REST,
    ROBOT,
    ROBOT_BASE,
    SECONDS,
    SHOULDER,
    Record,
    check,
    draw,
    person_angles,
    save,
    sensor_target,
)
from sticks import Rod

import capsense as cs
from capsense.humans import Part

STEP = 0.002
"""Time step [s]."""


def robot_text() -> str:
    """The robot with the pad on its flange as URDF."""
    text, above, inertia = '<robot name="robot"><link name="base">', "base", _inertia(2.0)
    text += inertia + "</link>"
    for name, axis, origin, end, radius in ROBOT:
        part = Part((0.0, 0.0, 0.0), end, radius)
        pad = ""
        if name == ROBOT[-1][0]:
            pad = _shape(PAD_BOX, f'<box size="{_text(PAD_SIZE)}"/>')
        capsule = f'<capsule radius="{radius}" length="{part.shape.length}"/>'
        text += (
            f'<link name="{name}">{inertia}{_shape(part.pose, capsule)}{pad}</link>'
            f'<joint name="{name}" type="revolute"><parent link="{above}"/><child link="{name}"/>'
            f'<origin xyz="{_text(origin)}"/><axis xyz="{_text(axis)}"/>'
            '<limit lower="-3.1" upper="3.1" effort="200" velocity="10"/></joint>'
        )
        above = name
    return text + "</robot>"


def load(client: int, text: str, pose: cs.Pose, folder: str) -> int:
    """Load a URDF from a text, its base fixed to the world."""
    file = Path(folder) / f"{abs(hash(text))}.urdf"  # Bullet remembers files by their names
    file.write_text(text)
    return p.loadURDF(
        str(file), pose.position, pose.quaternion, useFixedBase=True, physicsClientId=client
    )


def names_of_joints(client: int, body: int) -> list[str]:
    """Names in the order of the joints."""
    count = p.getNumJoints(body, physicsClientId=client)
    return [p.getJointInfo(body, k, physicsClientId=client)[1].decode() for k in range(count)]


def capsules(client: int, robot: int, person: int) -> list[Rod]:
    """All capsules of robot and person, to be drawn."""
    out = []
    for body, whose in ((robot, "robot"), (person, "person")):
        for link in range(p.getNumJoints(body, physicsClientId=client)):
            mass = cs.Pose(*p.getLinkState(body, link, physicsClientId=client)[:2])
            for shape in p.getCollisionShapeData(body, link, physicsClientId=client):
                if shape[2] == p.GEOM_CAPSULE:
                    pose = mass @ cs.Pose(*shape[5:7])
                    length, radius, _ = shape[3]
                    ends = pose.apply([(0, 0, -length / 2), (0, 0, length / 2)])
                    out.append((ends[0], ends[1], radius, whose))
    return out


def main(folder: Path) -> Record:
    """Run the story, check it, and draw it."""
    client = p.connect(p.DIRECT)
    with tempfile.TemporaryDirectory() as scratch:
        robot = load(client, robot_text(), ROBOT_BASE, scratch)
        person = load(client, PERSON.urdf(), SHOULDER, scratch)
    floor = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
    p.createMultiBody(0, floor, physicsClientId=client)
    for body in (robot, person):
        for link in range(-1, p.getNumJoints(body, physicsClientId=client)):
            p.setCollisionFilterGroupMask(body, link, 0, 0, physicsClientId=client)
    p.setTimeStep(STEP, physicsClientId=client)
    joints = {
        name.removeprefix(f"{PERSON.name}_"): k
        for k, name in enumerate(names_of_joints(client, person))
    }
    flange = len(ROBOT) - 1

    def robot_angles(t: float) -> np.ndarray:
        """Joint angles [rad] that bring the sensor to its target.

        Bullet solves for a link's centre of mass, which here is its origin.
        """
        pose = sensor_target(t) @ PAD.inverse()
        return np.array(
            p.calculateInverseKinematics(
                robot, flange, pose.position, pose.quaternion, maxNumIterations=100,
                residualThreshold=1e-6, physicsClientId=client,
            )
        )  # fmt: skip

    def drive(t: float, *, at_once: bool = False) -> None:
        """Set the targets of all motors, or the state itself."""
        targets = [(robot, k, a) for k, a in enumerate(robot_angles(t))]
        targets += [(person, joints[n], a) for n, a in person_angles(t).items()]
        for body, joint, angle in targets:
            if at_once:
                p.resetJointState(body, joint, angle, physicsClientId=client)
            p.setJointMotorControl2(
                body, joint, p.POSITION_CONTROL, angle, force=500, physicsClientId=client
            )

    for k, angle in enumerate(REST):
        p.resetJointState(robot, k, angle, physicsClientId=client)
    for _ in range(20):
        drive(0.0, at_once=True)

    sensor = cs.pybullet.attach(
        client, robot, link="flange", pose_in_link=PAD, design="six_patch",
        materials={"right_arm": "human"}, grounding={"right_arm": 100e-12},
    )  # fmt: skip
    record = Record(sensor.electrode_names)
    stride = round(1 / (RATE * STEP))
    for step in range(round(SECONDS / STEP)):
        if step % stride == 0:
            record.add(step * STEP, sensor.read(), sensor.pose, capsules(client, robot, person))
            drive(step * STEP)
        p.stepSimulation(physicsClientId=client)
    p.disconnect(physicsClientId=client)
    save(record, folder)
    draw(record, folder, "six_patch carried along a forearm, in PyBullet")
    check(record)
    return record


def _shape(pose: cs.Pose, geometry: str) -> str:
    origin = f'<origin xyz="{_text(pose.position)}"/>'  # nothing here is turned
    return "".join(
        f"<{kind}>{origin}<geometry>{geometry}</geometry></{kind}>"
        for kind in ("visual", "collision")
    )


def _inertia(mass: float) -> str:
    moment = " ".join(f'{k}="0.01"' for k in ("ixx", "iyy", "izz"))
    cross = " ".join(f'{k}="0"' for k in ("ixy", "ixz", "iyz"))
    return f'<inertial><mass value="{mass}"/><inertia {moment} {cross}/></inertial>'


def _text(values: object) -> str:
    return " ".join(f"{v:.9g}" for v in np.ravel(values))  # type: ignore[call-overload]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
