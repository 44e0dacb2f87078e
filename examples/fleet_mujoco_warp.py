"""A forearm falls past a sensor in many worlds of MuJoCo Warp, each with its own start.

    pip install 'capsense[mujoco-warp]'
    python examples/fleet_mujoco_warp.py [WORLDS]

Works on the CPU and, where there is one, on a GPU. It prints the first electrode's change in the
world where the arm comes nearest.
"""

from __future__ import annotations

import sys

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from capsense.adapters.mujoco_warp import CapacitiveSensors

MODEL = """<mujoco>
 <option timestep="0.005"/>
 <worldbody>
  <body name="wall" pos="0 0 1" euler="0 90 0"><site name="pad"/></body>
  <body name="forearm"><freejoint/>
   <geom name="forearm" type="capsule" size="0.04 0.12" euler="90 0 0" mass="1"/></body>
 </worldbody></mujoco>"""
STEPS, EVERY = 60, 6


def main(worlds: int = 16) -> np.ndarray:
    """Return the changes of the matrices [F], shape (readings, worlds, 1, 6, 6)."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    there, on_device = mjw.put_data(model, data, nworld=worlds), mjw.put_model(model)
    start = np.tile(data.qpos, (worlds, 1)).astype(np.float32)
    start[:, 0] = np.linspace(0.07, 0.15, worlds)  # in front of the sensor, which looks along x
    start[:, 2] = 1.2
    wp.copy(there.qpos, wp.array(start, dtype=wp.float32, device=there.qpos.device))
    sensors = CapacitiveSensors(model, there, ["pad"], materials={"forearm": "human"})
    found = []
    for k in range(STEPS):
        mjw.step(on_device, there)
        if k % EVERY == 0:
            mjw.kinematics(on_device, there)
            delta = sensors.read(there).delta
            found.append(np.array(delta if isinstance(delta, np.ndarray) else delta.numpy()))
            near, far = (1e15 * found[-1][w, 0, 0, 0] for w in (0, -1))
            print(f"{1e3 * (k + 1) * 0.005:5.0f} ms: {near:7.1f} fF at 7 cm, {far:6.1f} at 15 cm")
    return np.array(found)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
