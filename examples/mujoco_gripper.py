"""MuJoCo: a gripper with a pad on each finger finds a block, grasps it by touch, and lifts it.

Run it: ``python examples/mujoco_gripper.py``. It needs no display. The fingers close fast while
nothing is near, slowly once a pad feels the block, and stop when a pad carries a set force.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

import capsense as cs

RATE = 50.0
"""Readings per second [Hz]."""
SECONDS = 6.0
"""How long the gripper has [s]."""
FAST, SLOW = 0.03, 0.004
"""Speeds at which a finger closes [m/s]."""
NEAR = 20e-15
"""Change of capacitance [F] from which on a finger closes slowly."""
GRIP = 3.0
"""Force at which a finger stops [N]."""
LIFT, HEIGHT = 0.05, 0.06
"""Speed of the lift [m/s], and how high it goes [m]."""
SITES = ("left_pad", "right_pad")
FILM = 1e-4
"""Thickness of the film on the pads [m]: the fingers' faces are those of the film."""

MODEL = f"""
<mujoco>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <default>
    <geom friction="1 0.02 0.001" solref="0.004 1"/>
    <default class="finger">
      <joint type="slide" range="0 0.06" damping="20" armature="0.1"/>
      <position kp="2000" dampratio="1"/>
    </default>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="hand" pos="0 0 .02" gravcomp="1">
      <joint name="lift" type="slide" axis="0 0 1" damping="50" armature="1"/>
      <geom type="box" size=".09 .01 .01" pos="0 0 .09" mass="1" contype="0" conaffinity="0"/>
      <body name="left" pos="-.07 0 0" gravcomp="1">
        <joint name="left" class="finger" axis="1 0 0"/>
        <geom type="box" size=".005 .006 .006" pos="-.005 0 0" mass=".05"/>
        <site name="left_pad" pos="{-FILM} 0 0" euler="0 90 0"/>
      </body>
      <body name="right" pos=".07 0 0" gravcomp="1">
        <joint name="right" class="finger" axis="-1 0 0"/>
        <geom type="box" size=".005 .006 .006" pos=".005 0 0" mass=".05"/>
        <site name="right_pad" pos="{FILM} 0 0" euler="0 -90 0"/>
      </body>
    </body>
    <body name="block" pos=".012 0 .02">
      <freejoint/>
      <geom name="block" type="box" size=".02 .02 .02" mass=".1"/>
    </body>
  </worldbody>
  <actuator>
    <position class="finger" joint="left"/>
    <position class="finger" joint="right"/>
    <position joint="lift" kp="5000" dampratio="1"/>
  </actuator>
</mujoco>"""


@dataclass
class Row:
    """One reading of both fingers."""

    time: float
    """Time [s]."""
    place: np.ndarray
    """How far each finger has closed [m], shape (2,)."""
    change: np.ndarray
    """Change of each pad's capacitance [F], shape (2,)."""
    force: np.ndarray
    """Force that each pad's film carries [N], shape (2,)."""
    height: float
    """How high the block has been lifted [m]."""
    state: str
    """What the gripper does: it closes, lifts or holds."""


def story(design: cs.Simulator | str = "gripper_pad") -> list[Row]:
    """Grasp the block and lift it."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pads = cs.mujoco.attach_skin(
        model, data, SITES, design, materials={"block": "steel"}, grounding={"block": "floating"}
    )
    rows: list[Row] = []
    target, start, state = np.zeros(3), float(data.body("block").xpos[2]), "closes"
    for step in range(round(SECONDS * RATE)):
        both = pads.read()
        readings = [both[site] for site in SITES]
        change = np.array([reading.delta[0, 0] for reading in readings])
        force = np.array([reading.touch.total if reading.touch else 0.0 for reading in readings])
        if state == "closes":
            speed = np.where(change < NEAR, FAST, SLOW) * (force < GRIP)
            target[:2] += speed / RATE
            state = "closes" if speed.any() else "lifts"
        elif state == "lifts":
            target[2] += LIFT / RATE
            state = "lifts" if target[2] < HEIGHT else "holds"
        height = float(data.body("block").xpos[2]) - start
        rows.append(Row(step / RATE, data.qpos[1:3].copy(), change, force, height, state))
        data.ctrl[:] = target
        mujoco.mj_step(model, data, round(1.0 / (RATE * model.opt.timestep)))
    return rows


def check(rows: list[Row]) -> None:
    """The block is felt before it is touched, and held at the force that was asked for."""
    change, force = np.array([r.change for r in rows]), np.array([r.force for r in rows])
    for pad in range(2):
        first = int(np.flatnonzero(force[:, pad] > 0.05)[0])
        assert change[first - 1, pad] > NEAR, "it is felt before it is touched"
    assert rows[-1].state == "holds"
    assert abs(rows[-1].height - HEIGHT) < 0.005, f"it is lifted by {rows[-1].height} m"
    assert np.all(np.abs(force[-1] - GRIP) < 0.5 * GRIP), f"it is held at {force[-1]} N"


def main(design: cs.Simulator | str = "gripper_pad") -> list[Row]:
    """Play it, print a table, and check it."""
    rows = story(design)
    print("   t     fingers [mm]      change [fF]         force [N]     block")
    for row in rows[:: round(0.25 * RATE)]:
        place, change = row.place * 1e3, row.change * 1e15
        print(
            f"{row.time:4.2f} s {place[0]:6.2f} {place[1]:6.2f} {change[0]:9.1f} {change[1]:9.1f}"
            f" {row.force[0]:8.2f} {row.force[1]:8.2f} {row.height * 1e3:6.1f} mm  {row.state}"
        )
    check(rows)
    return rows


if __name__ == "__main__":
    main()
