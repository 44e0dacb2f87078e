"""CapSense and the paper's scheme as methods of ``peers.py``."""

from __future__ import annotations

import numpy as np
from peers_iterative import TOLERANCE
from peers_task import DESIGN, SIZE, Array, bar_corners, design, within

import capsense as cs
from capsense.field.background import BuildSettings
from capsense.field.planes import LatticeSettings, plan_axes
from capsense.mesh import TetMesh
from capsense.simulator import Method
from capsense.solve.masked import GROUNDED, MaskedSolver


class CapSense:
    """Whole ``Simulator.step``, from bodies to ΔC, default tolerance."""

    name = "CapSense"
    returns_change = True
    settings = "Simulator.step, default tolerance"

    def __init__(self, refine: float = 1.0, method: Method = "perturbation") -> None:
        lattice = LatticeSettings()
        chosen = BuildSettings(lattice=lattice if refine == 1.0 else lattice.refined(refine))
        self._sim = cs.Simulator(DESIGN, settings=chosen, method=method)
        self._bar = cs.Body(cs.Box(tuple(SIZE)), material="steel")
        facts = self._sim.describe()
        self.n_tets = int(facts["tetrahedra"])
        self.unknowns = int(self._sim.background.lattice.unknown.sum())
        self.baseline: Array = self._sim.baseline

    def step(self, x: float, gap: float) -> Array:
        """ΔC [F] with the bar at x [m], gap [m]."""
        pose = cs.Pose((x, 0.0, gap + SIZE[2] / 2))
        return self._sim.step(cs.Scene([self._bar.moved(pose)])).delta


class PaperOnLattice(CapSense):
    """``Simulator(method="masked")`` on the planes of CapSense's own default lattice."""

    name = "the paper's scheme, CapSense's planes"
    settings = (
        "Simulator(method='masked').step as it comes: every node of a masked tetrahedron held"
    )

    def __init__(self) -> None:
        super().__init__(method="masked")
        planes = np.array([len(axis) for axis in plan_axes(design(), LatticeSettings())])
        self.n_tets, self.unknowns = int(6 * (planes - 1).prod()), int(planes.prod())


class PaperScheme:
    """The scheme of Schöffmann et al. 2022 on a conforming mesh: centroids, residual update, solve.

    Every node of a tetrahedron whose centroid lies in the bar is held at 0 V.
    """

    name = "the paper's scheme"
    settings = (
        "MaskedSolver: Jacobi-CG for one electrode after the other, warm start, tolerance "
        f"{TOLERANCE:g}, energy form"
    )

    def __init__(self, mesh: TetMesh) -> None:
        self._solver = MaskedSolver(mesh, design().electrode_names, tolerance=TOLERANCE)
        x, y, z = (np.ascontiguousarray(c) for c in mesh.centroids.T)
        self._centroids = (x, y, z)
        self.n_tets, self.unknowns = mesh.n_tets, mesh.n_points

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        inside = within(self._centroids, *bar_corners(x, gap))
        return self._solver.step(inside.astype(np.int64) - 1, [GROUNDED])
