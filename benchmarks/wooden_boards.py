"""Boards of wood over ``six_patch``, as bodies and as layers of the design.

    python benchmarks/wooden_boards.py

Boundary elements solve the design with the board as one more layer, and without it. What changes,
beside what the simulator reads of the board as a body. Takes ten minutes; ``--coarse`` three.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

import capsense as cs
from capsense.design.model import Design, Layer
from capsense.field.boundary import Accuracy, BoundarySolution, terminals

SIZES = (0.3, 0.3, 0.03), (0.44, 0.4, 0.02), (0.3, 0.3, 0.006)
GAPS = 0.01, 0.02
MIDDLE = np.array([0.02, 0.01])


def diagonal(design: Design, scale: float) -> np.ndarray:
    """Self capacitances of the electrodes [fF]."""
    solution = BoundarySolution(design, Accuracy(scale))
    charges = solution.terminal_charges(solution.densities(np.eye(len(terminals(design)))))
    return 1e15 * np.diag(charges)[: len(design.electrodes)]


def main() -> None:
    """Print both, electrode by electrode."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--coarse", action="store_true", help="panels of the usual size only")
    scales = (1.0,) if parser.parse_args().coarse else (1.0, 0.8)
    design, wood = cs.load_design("six_patch"), cs.MATERIALS["wood"]
    empty = {scale: diagonal(design, scale) for scale in scales}
    sims = {p: cs.Simulator("six_patch", preset=p) for p in ("fast", "standard", "fine")}
    for size in SIZES:
        for gap in GAPS:
            low = np.append(MIDDLE - np.array(size[:2]) / 2, gap)
            layer = Layer("board", "wood", wood.eps_r, low, low + size)
            print(f"{size} m at {1e3 * gap:g} mm, changes of E1 to E6 [fF]")
            for scale in scales:
                change = diagonal(replace(design, layers=(*design.layers, layer)), scale)
                print(f"  layer, panels × {scale:g}:", np.round(change - empty[scale], 1))
            pose = cs.Pose((*MIDDLE, gap + size[2] / 2))
            scene = cs.Scene([cs.Body(cs.Box(size), pose, wood)])
            for preset, sim in sims.items():
                print(f"  body, {preset}:", np.round(1e15 * np.diag(sim.step(scene).delta), 1))


if __name__ == "__main__":
    main()
