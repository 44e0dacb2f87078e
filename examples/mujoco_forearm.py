"""MuJoCo: a robot arm carries six electrodes along a person's moving forearm.

Run it: ``python examples/mujoco_forearm.py [FOLDER]``. It needs no display and no OpenGL. A
table, a plot and an animation go to the folder (``out`` by default). With ``--depth`` the sensor
sees the image of an orthographic depth camera of 64 x 64 pixels, not the shapes themselves.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from forearm_story import (
    METAL,
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
from capsense.humans.formats import mjcf_body

PIXELS = 64
"""Along each side of the depth image, which is as wide as the sensor's domain."""


def model_text(depth: bool) -> str:
    """The world as MJCF: floor, robot with the pad on its flange, the person's arm."""
    robot, ends = "", ""
    for name, axis, origin, end, radius in ROBOT:
        robot += (
            f'<body name="robot_{name}" pos="{_text(origin)}" gravcomp="1">'
            f'<joint name="robot_{name}" axis="{_text(axis)}" damping="2"/>'
            f'<geom type="capsule" fromto="0 0 0 {_text(end)}" size="{radius}"/>'
        )
        ends += "</body>"
    pad = (
        f'<geom name="pad" type="box" pos="{_text(PAD_BOX.position)}" '
        f'size="{_text(np.divide(PAD_SIZE, 2))}"/>'
        f'<site name="wrist_pad" pos="{_text(PAD.position)}"/>'
    )
    sensor = ""
    if depth:  # a camera looks along its −z, so it is turned half round
        pad += (
            f'<camera name="wrist_pad" pos="{_text(PAD.position)}" euler="180 0 0" '
            f'projection="orthographic" resolution="{PIXELS} {PIXELS}" fovy="0.5"/>'
        )
        sensor = '<sensor><rangefinder camera="wrist_pad" data="depth"/></sensor>'
    person = mjcf_body(PERSON, SHOULDER).replace("<body ", '<body gravcomp="1" ')
    motors = [f"robot_{name}" for name, *_ in ROBOT]
    motors += [f"{PERSON.name}_{j.name}" for j in PERSON.joints]
    position = "".join(f'<position joint="{m}" kp="400" kv="30"/>' for m in motors)
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        '<default><geom contype="0" conaffinity="0"/><joint armature="0.1"/></default>'
        f'<worldbody><geom name="floor" type="plane" size="2 2 .1"/>'
        f'<body name="robot" pos="{_text(ROBOT_BASE.position)}">{robot}{pad}{ends}</body>'
        f"{person}</worldbody><actuator>{position}</actuator>{sensor}</mujoco>"
    )


def attach(model: mujoco.MjModel, data: mujoco.MjData, depth: bool) -> Any:
    """Six electrodes on the pad: they feel the person, and the robot's own links."""
    if depth:
        return cs.mujoco.attach(
            model, data, site="wrist_pad", design="six_patch", perception="depth_camera",
            default_material="human", default_grounding=100e-12,
        )  # fmt: skip
    return cs.mujoco.attach(
        model, data, site="wrist_pad", design="six_patch",
        materials={"right_arm*": "human"}, grounding={"right_arm*": 100e-12},
    )  # fmt: skip


class Ride:
    """The way of the sensor along the arm, in simulated time."""

    def __init__(self, depth: bool = False) -> None:
        self.model = mujoco.MjModel.from_xml_string(model_text(depth))
        self.data = mujoco.MjData(self.model)
        self._robot = np.arange(len(ROBOT))  # of the state as of the motors: robot, then person
        self._person = {joint.name: len(ROBOT) + k for k, joint in enumerate(PERSON.joints)}
        data = self.data
        data.qpos[self._robot] = REST
        for name, angle in person_angles(0.0).items():
            data.qpos[self._person[name]] = angle
        for _ in range(200):  # to the beginning of the way
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            data.qpos[self._robot] = step_towards(self.model, data, sensor_target(0.0), self._robot)
        data.ctrl[:] = data.qpos
        mujoco.mj_forward(self.model, data)
        self.sensor = attach(self.model, data, depth)

    @property
    def over(self) -> bool:
        """Whether the story has ended."""
        return self.data.time >= SECONDS - 0.5 * self.model.opt.timestep

    def go_on(self, rate: float) -> None:
        """Tell the motors where to go, and simulate up to the next reading of so many in 1 s."""
        data = self.data
        data.ctrl[self._robot] = step_towards(
            self.model, data, sensor_target(data.time), self._robot
        )
        for name, angle in person_angles(data.time).items():
            data.ctrl[self._person[name]] = angle
        mujoco.mj_step(self.model, data, round(1 / (rate * self.model.opt.timestep)))


def step_towards(
    model: mujoco.MjModel, data: mujoco.MjData, target: cs.Pose, joints: np.ndarray
) -> np.ndarray:
    """Joint angles [rad] one damped least-squares step closer to a pose of the site."""
    site = data.site("wrist_pad")
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site.id)
    jacobian = jacobian[:, joints]
    turn = target.rotation @ site.xmat.reshape(3, 3).T
    quaternion, spin = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    mujoco.mju_quat2Vel(spin, quaternion, 1.0)
    error = np.concatenate([target.position - site.xpos, spin])
    gain = jacobian @ jacobian.T + 1e-4 * np.eye(6)
    return data.qpos[joints] + jacobian.T @ np.linalg.solve(gain, error)


def parts(model: mujoco.MjModel, data: mujoco.MjData, meshes: dict[int, Any]) -> list[Part]:
    """All capsules of the world, to be drawn; ``meshes`` keeps theirs."""
    out: list[Part] = []
    for k in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_CAPSULE)).tolist():
        if k not in meshes:
            meshes[k] = capsule(float(model.geom_size[k, 0]), 2 * float(model.geom_size[k, 1]))
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[k])
        w, x, y, z = quaternion.tolist()
        person = model.geom(k).name.startswith(PERSON.name)
        out.append((meshes[k], cs.Pose(tuple(data.geom_xpos[k]), (x, y, z, w)),
                    SKIN if person else METAL))  # fmt: skip
    return out


def main(folder: Path, depth: bool = False) -> Record:
    """Run the story, check it, and draw it."""
    ride = Ride(depth)
    record, meshes = Record(ride.sensor.electrode_names), dict[int, Any]()
    while not ride.over:
        reading = ride.sensor.read()
        record.add(ride.data.time, reading, ride.sensor.pose, parts(ride.model, ride.data, meshes))
        ride.go_on(RATE)
    save(record, folder)
    seen = ", seen by a depth camera" if depth else ""
    draw(record, folder, f"six_patch carried along a forearm, in MuJoCo{seen}")
    check(record)
    return record


def _text(values: object) -> str:
    return " ".join(f"{v:.9g}" for v in np.ravel(values))  # type: ignore[call-overload]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    parser.add_argument("--depth", action="store_true", help="see a depth image, not shapes")
    options = parser.parse_args()
    main(options.folder, options.depth)
