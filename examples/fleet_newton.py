"""A forearm falls past a sensor in many worlds of Newton, each with its own start and its own size.

    pip install 'capsense[newton]'
    python examples/fleet_newton.py [WORLDS]

Works on the CPU and, where there is one, on a GPU.
"""

from __future__ import annotations

import math
import sys

import newton
import numpy as np
import warp as wp

from capsense.adapters.newton import SensorCapacitance

STEP, STEPS, EVERY = 0.005, 60, 6


def build(worlds: int) -> newton.Model:
    """Worlds with a sensor that looks along x, and a forearm that lies along y."""
    builder = newton.ModelBuilder()
    looks = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.5 * math.pi)
    lies = wp.quat_from_axis_angle(wp.vec3(1.0, 0.0, 0.0), 0.5 * math.pi)
    for distance, radius in zip(
        np.linspace(0.07, 0.15, worlds), 0.03 + 0.01 * (np.arange(worlds) % 2), strict=True
    ):
        world = newton.ModelBuilder()
        world.add_site(-1, xform=wp.transform((0.0, 0.0, 1.0), looks), label="pad")
        arm = world.add_body(xform=wp.transform((float(distance), 0.0, 1.2), lies), label="arm")
        world.add_shape_capsule(arm, radius=float(radius), half_height=0.12, label="forearm")
        builder.add_world(world)
    return builder.finalize()


def main(worlds: int = 16) -> np.ndarray:
    """Return the changes of the matrices [F], shape (readings, worlds, 1, 6, 6)."""
    model = build(worlds)
    solver = newton.solvers.SolverSemiImplicit(model)
    now, after, control = model.state(), model.state(), model.control()
    sensor = SensorCapacitance(model, sites="pad*", materials={"*forearm*": "human"})
    found = []
    for k in range(STEPS):
        now.clear_forces()
        solver.step(now, after, control, None, STEP)
        now, after = after, now
        if k % EVERY == 0:
            sensor.update(now)
            delta = sensor.delta
            found.append(np.array(delta if isinstance(delta, np.ndarray) else delta.numpy()))
            near, far = (1e15 * found[-1][w, 0, 0, 0] for w in (0, -1))
            print(f"{1e3 * (k + 1) * STEP:5.0f} ms: {near:7.1f} fF at 7 cm, {far:6.1f} at 15 cm")
    return np.array(found)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
