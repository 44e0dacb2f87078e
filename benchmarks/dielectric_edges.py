"""Edges of wide dielectrics, and seams of those that touch, over ``six_patch``.

    python benchmarks/dielectric_edges.py

Boxes of permittivity 3 at 10 mm whose edge is over the middle of the sensor, beside 3,000 charge
functions with energies of their own; then boxes of wood in two and in four, beside one box. All of
it also as closed meshes. Takes two minutes, and 2 GB of memory.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

import capsense as cs
from capsense.solver.surface_solver import Preset, SurfaceSolver

Size = tuple[float, float, float]
EDGES: tuple[Size, ...] = ((0.3, 0.26, 0.12), (0.3, 0.6, 0.1), (0.3, 0.3, 0.6))
SEAMS = (0.6, 0.1), (0.4, 0.3), (0.3, 0.05)
"""Width and thickness [m]."""
MATTER = cs.Material("matter", eps_r=3.0)


def as_mesh(size: Size) -> cs.Shape:
    """A box as a closed mesh."""
    mesh = cs.Box(size).to_trimesh()
    return cs.TriMesh(mesh.vertices, mesh.faces)


SHAPES: dict[str, Callable[[Size], cs.Shape]] = {"box": cs.Box, "mesh": as_mesh}


def seam(sim: cs.Simulator, made: Callable[[Size], cs.Shape], at: Size, parts: int) -> np.ndarray:
    """Self capacitances for one block of wood, or two or four that make it up [F], shape (e,).

    Args:
        sim: The simulator.
        made: Makes a body's shape from its size.
        at: Width, thickness and gap of the block [m].
        parts: 1, 2 or 4.
    """
    width, thickness, gap = at
    columns, rows = min(parts, 2), max(parts // 2, 1)
    shape = made((width / columns, width / rows, thickness))
    bodies = []
    for k in range(parts):
        x = (k % columns + 0.5) / columns - 0.5
        y = (k // columns + 0.5) / rows - 0.5
        bodies.append(cs.Body(shape, cs.Pose((x * width, y * width, gap + thickness / 2)), "wood"))
    return np.diag(sim.step(cs.Scene(bodies)).delta)


def main() -> None:
    """Print readings and differences."""
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    sim = cs.Simulator("six_patch")
    many: SurfaceSolver = SurfaceSolver(
        sim.background.green, sim.design, preset=Preset(3000, 1e-3, coarsest=None)
    )
    for size in EDGES:
        for aside in (0.15, 0.1):
            pose = cs.Pose((aside, 0, 0.01 + size[2] / 2))
            scenes = {k: cs.Scene([cs.Body(f(size), pose, MATTER)]) for k, f in SHAPES.items()}
            truth = np.diag(many.solve(scenes["box"]).matrix)[:3]
            print(f"{size} m, {1e3 * aside:g} mm aside, E1 to E3: {np.round(1e15 * truth, 1)} fF")
            for kind, scene in scenes.items():
                found = np.diag(sim.step(scene).delta)[:3]
                print(f"  {kind}: off by {np.round(100 * (found / truth - 1), 1)} %")
    for width, thickness in SEAMS:
        for gap in (0.01, 0.03):
            at = width, thickness, gap
            for kind, made in SHAPES.items():
                one = seam(sim, made, at, 1)
                off = [100 * np.abs(seam(sim, made, at, n) / one - 1).max() for n in (2, 4)]
                print(f"{kind} {at} m, in two, in four: off by {np.round(off, 1)} %")


if __name__ == "__main__":
    main()
