"""Accuracy over boards with pours and substrates: ``python benchmarks/boards.py [design ...]``.

The bar is added to the design as one more grounded conductor and solved with the package's
boundary elements; its effect follows by reciprocity, ΔC_ij = −∮ φ⁰_i σ_j dS over the bar, from the
empty domain's potential φ⁰ and the charge σ on the bar. The online solver is compared with it.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace

import numpy as np
from references import box

import capsense as cs
from capsense.design.model import Conductor, Role
from capsense.field.boundary import GROUND, Accuracy, BoundarySolution, terminals

SIZE = (0.15, 0.15, 0.02)
"""The bar [m]."""
CASES = ((0.0, 2), (0.0, 5), (0.0, 10), (0.03, 10), (0.0, 20), (0.0, 50), (0.05, 50))
"""Where the bar is along x [m], and its gap [mm]."""


def reference(design: cs.Design, centre: np.ndarray, empty: tuple, scale: float) -> np.ndarray:
    """ΔC [F] by the bar at ``centre`` [m]."""
    surface = box(centre, np.array(SIZE))
    bar = Conductor("bar", Role.GROUND, surface)
    full = BoundarySolution(replace(design, conductors=(*design.conductors, bar)), Accuracy(scale))
    density = full.densities(np.eye(len(terminals(design))))
    panels = full.model.panels
    half = np.array(SIZE) / 2 + 1e-9
    mine = (full.model.owner == GROUND) & (np.abs(panels.centers - centre) <= half).all(axis=1)
    weights = panels.weights[mine]
    panel, _ = np.nonzero(weights)
    solution, charges = empty
    phi = solution.potential(panels.quad[mine][weights > 0], charges)
    delta = -phi.T @ (weights[weights > 0][:, None] * density[mine][panel])
    return 0.5 * (delta + delta.T)


def main() -> None:
    """Print the errors."""
    for name in sys.argv[1:] or ("stripe", "patch", "meander"):
        design = cs.load_design(name)
        solution = BoundarySolution(design)
        charges = solution.densities(np.eye(len(terminals(design))))
        sim = cs.Simulator(design)
        print(f"{name}: {solution.model.panels.size} panels", flush=True)
        for x, gap in CASES:
            start = time.perf_counter()
            centre = np.array([x, 0.0, 1e-3 * gap + SIZE[2] / 2])
            wanted = reference(design, centre, (solution, charges), 1.0)
            body = cs.Body(cs.Box(SIZE), cs.Pose(tuple(centre)), "steel")
            found = sim.step(cs.Scene([body])).delta
            n = len(found)
            wanted = wanted[:n, :n]
            off = 100 * np.diag(found / wanted - 1)
            cross = ~np.eye(n, dtype=bool)
            mutual = 100 * np.abs(found / wanted - 1)[cross]
            print(
                f"  x {1e3 * x:.0f} mm, gap {gap} mm: ΔC_11 {1e15 * wanted[0, 0]:.3f} fF, diagonal "
                f"{np.abs(off).max():.1f} %, mutual {mutual.max():.1f} % of itself "
                f"({time.perf_counter() - start:.0f} s)",
                flush=True,
            )


if __name__ == "__main__":
    main()
