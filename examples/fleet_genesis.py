"""A forearm falls past a sensor in many environments of Genesis, each with its own start.

    pip install torch genesis-world 'capsense[warp]'
    python examples/fleet_genesis.py [ENVIRONMENTS]

Genesis compiles its own kernels at the first run, which takes minutes on a CPU.
"""

from __future__ import annotations

import sys

import genesis as gs
import numpy as np
import torch

from capsense.adapters.genesis import Capacitance

STEP, STEPS, EVERY = 0.005, 60, 6


def main(environments: int = 16) -> np.ndarray:
    """Return the changes of the matrices [F], shape (readings, environments, 6, 6)."""
    if not gs._initialized:
        gs.init(backend=gs.cpu, logging_level="warning")
    scene = gs.Scene(sim_options=gs.options.SimOptions(dt=STEP), show_viewer=False)
    looks = gs.morphs.Box(size=(0.02, 0.2, 0.2), pos=(-0.02, 0.0, 1.0), fixed=True)
    wall = scene.add_entity(looks)
    arm = scene.add_entity(gs.morphs.Cylinder(radius=0.035, height=0.24, euler=(90.0, 0.0, 0.0)))
    pad = scene.add_sensor(
        Capacitance(
            entity_idx=wall.idx, pos_offset=(0.02, 0.0, 0.0), euler_offset=(0.0, 90.0, 0.0),
            options={"materials": {"cylinder*": "human"}},
        )
    )  # fmt: skip
    scene.build(n_envs=environments)
    starts = torch.tensor([[0.0, 0.0, 1.2]]).repeat(environments, 1)
    starts[:, 0] = torch.linspace(0.07, 0.15, environments)
    arm.set_pos(starts)
    found = []
    for k in range(STEPS):
        scene.step()
        if k % EVERY == 0:
            found.append(pad.read().delta[:, 0].numpy(force=True))
            near, far = (1e15 * found[-1][e, 0, 0] for e in (0, -1))
            print(f"{1e3 * (k + 1) * STEP:5.0f} ms: {near:7.1f} fF at 7 cm, {far:6.1f} at 15 cm")
    return np.array(found)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
