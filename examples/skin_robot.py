"""A robot arm with sixteen sensors on its shells, and a person: what skin_stops.py moves.

Four rings of four quarter shells, each an ``arm_segment`` with six electrodes. A ring is a body of
its own: its sensors do not see its own housing, which their design describes, but those of the
others.
"""

from __future__ import annotations

import math

import numpy as np

import capsense as cs
from capsense.humans import Build, arm
from capsense.humans.formats import mjcf_body

SHELL_RADIUS, SHELL_LENGTH = 0.048, 0.090
"""Radius of the electrodes and length of a ring [m], as in the design."""
RINGS = (0.105, 0.197)
"""Middles of the two rings on each link, from its joint [m]."""
LINK_LENGTH, JOINT_RADIUS = 0.302, 0.045
BASE_HEIGHT = 0.95
"""Height of the shoulder above the floor [m]."""
RING_NAMES = ("upper_1", "upper_2", "fore_1", "fore_2")
SIDES = (0, 90, 180, 270)
"""Where on a ring a sensor sits: angle about the link's z, from its x [°]."""
SITES = tuple(f"{ring}_{side}" for ring in RING_NAMES for side in SIDES)
JOINTS = ("turn", "shoulder", "elbow")

PERSON = arm(Build("female", percentile=50), "right")
MATERIALS = {f"{PERSON.name}*": "human", "torso": "human", "head": "human"}
GROUNDING: dict[str, float | str] = dict.fromkeys(MATERIALS, 100e-12)


def model_text(shoulder: cs.Pose) -> str:
    """The world as MJCF: floor, robot with its rings, and a person.

    Args:
        shoulder: The person's right shoulder: x forwards, y left, z up.
    """
    body = shoulder.apply([(-0.02, 0.20, -0.55), (-0.02, 0.20, -0.05), (0.0, 0.20, 0.22)])
    person = mjcf_body(PERSON, shoulder).replace("<body ", '<body gravcomp="1" ')
    motors = [*JOINTS, *(f"{PERSON.name}_{j.name}" for j in PERSON.joints)]
    position = "".join(f'<position joint="{m}" kp="400" kv="40"/>' for m in motors)
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/>'
        '<default><geom contype="0" conaffinity="0"/><joint armature="0.1"/></default>'
        '<worldbody><geom name="floor" type="plane" size="3 3 .1"/>'
        f'<geom name="pedestal" type="cylinder" size="0.06 {(BASE_HEIGHT - 0.06) / 2}" '
        f'pos="0 0 {(BASE_HEIGHT - 0.06) / 2}"/>'
        f'<body name="upper" pos="0 0 {BASE_HEIGHT}" gravcomp="1">'
        f'<joint name="turn" axis="0 0 1"/><joint name="shoulder" axis="0 1 0"/>{_link(0)}'
        f'<body name="fore" pos="0 0 {LINK_LENGTH}" gravcomp="1"><joint name="elbow" axis="0 1 0"/>'
        f'{_link(2)}<geom name="tip" type="sphere" size="0.043" pos="0 0 0.29"/>'
        "</body></body>"
        f'<geom name="torso" type="capsule" size="0.14" fromto="{_text(body[:2])}"/>'
        f'<geom name="head" type="sphere" size="0.09" pos="{_text(body[2])}"/>'
        f"{person}</worldbody><actuator>{position}</actuator></mujoco>"
    )


def _link(first: int) -> str:
    """A joint's ball and the two rings behind it, each with four sites."""
    text = f'<geom type="sphere" size="{JOINT_RADIUS}"/>'
    for name, height in zip(RING_NAMES[first : first + 2], RINGS, strict=True):
        text += (
            f'<body name="{name}" pos="0 0 {height}" gravcomp="1">'
            f'<geom type="cylinder" size="{SHELL_RADIUS} {SHELL_LENGTH / 2}"/>'
        )
        for side in SIDES:
            c, s = math.cos(math.radians(side)), math.sin(math.radians(side))
            place = _text((SHELL_RADIUS * c, SHELL_RADIUS * s, 0))
            text += (
                f'<site name="{name}_{side}" pos="{place}" xyaxes="{_text((-s, c, 0, 0, 0, 1))}"/>'
            )
        text += "</body>"
    return text


def _text(values: object) -> str:
    return " ".join(f"{v:.9g}" for v in np.ravel(values))  # type: ignore[call-overload]
