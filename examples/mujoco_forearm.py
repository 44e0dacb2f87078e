"""MuJoCo: a robot arm carries six electrodes along a person's moving forearm.

Run it: ``python examples/mujoco_forearm.py [FOLDER]``. It needs no display and no OpenGL. A
table, a plot and an animation go to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
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
from capsense.humans.export import mjcf_body


def model_text() -> str:
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
    person = mjcf_body(PERSON, SHOULDER).replace("<body ", '<body gravcomp="1" ')
    motors = [f"robot_{name}" for name, *_ in ROBOT]
    motors += [f"{PERSON.name}_{j.name}" for j in PERSON.joints]
    position = "".join(f'<position joint="{m}" kp="400" kv="30"/>' for m in motors)
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        '<default><geom contype="0" conaffinity="0"/><joint armature="0.1"/></default>'
        f'<worldbody><geom name="floor" type="plane" size="2 2 .1"/>'
        f'<body name="robot" pos="{_text(ROBOT_BASE.position)}">{robot}{pad}{ends}</body>'
        f"{person}</worldbody><actuator>{position}</actuator></mujoco>"
    )


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


def capsules(model: mujoco.MjModel, data: mujoco.MjData) -> list[Rod]:
    """All capsules of the world, to be drawn."""
    out = []
    for k in np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_CAPSULE)):
        arm = data.geom_xmat[k].reshape(3, 3)[:, 2] * model.geom_size[k, 1]
        whose = "person" if model.geom(k).name.startswith(PERSON.name) else "robot"
        ends = data.geom_xpos[k] - arm, data.geom_xpos[k] + arm
        out.append((*ends, float(model.geom_size[k, 0]), whose))
    return out


def main(folder: Path) -> Record:
    """Run the story, check it, and draw it."""
    model = mujoco.MjModel.from_xml_string(model_text())
    data = mujoco.MjData(model)
    joints = np.arange(len(ROBOT))  # of the state as of the motors: the robot's, the person's
    person = {joint.name: len(ROBOT) + k for k, joint in enumerate(PERSON.joints)}

    # start at the beginning of the way
    data.qpos[joints] = REST
    for name, angle in person_angles(0.0).items():
        data.qpos[person[name]] = angle
    for _ in range(200):
        mujoco.mj_forward(model, data)
        data.qpos[joints] = step_towards(model, data, sensor_target(0.0), joints)
    data.ctrl[:] = data.qpos
    mujoco.mj_forward(model, data)

    sensor = cs.mujoco.attach(
        model, data, site="wrist_pad", design="six_patch",
        materials={"right_arm*": "human"}, grounding={"right_arm*": 100e-12},
    )  # fmt: skip
    record = Record(sensor.electrode_names)
    stride = round(1 / (RATE * model.opt.timestep))
    for step in range(round(SECONDS / model.opt.timestep)):
        if step % stride == 0:
            record.add(data.time, sensor.read(), sensor.pose, capsules(model, data))
            data.ctrl[joints] = step_towards(model, data, sensor_target(data.time), joints)
            for name, angle in person_angles(data.time).items():
                data.ctrl[person[name]] = angle
        mujoco.mj_step(model, data)
    save(record, folder)
    draw(record, folder, "six_patch carried along a forearm, in MuJoCo")
    check(record)
    return record


def _text(values: object) -> str:
    return " ".join(f"{v:.9g}" for v in np.ravel(values))  # type: ignore[call-overload]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
