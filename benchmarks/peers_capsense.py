"""CapSense and the paper's scheme as methods of ``peers.py``."""

from __future__ import annotations

import numpy as np
from peers_iterative import TOLERANCE
from peers_task import DESIGN, SIZE, Array, bar_corners, design, within

import capsense as cs
from capsense.field.background import MeshSettings
from capsense.masked import MaskedScenes, MeshSensor, lattice_sensor, plan_axes
from capsense.masked.solver import GROUNDED, MaskedSolver
from capsense.mesh import TetMesh
from capsense.simulator import PresetName

PUBLISHED_TOLERANCE = 1e-5
"""SciPy's default, with which the published code calls its conjugate gradients."""
_BAR = cs.Body(cs.Box(tuple(SIZE)), material="steel")


class CapSense:
    """Whole ``Simulator.step``, from bodies to ΔC. There is no mesh."""

    name = "CapSense"
    returns_change = True
    n_tets = 0

    def __init__(self, preset: PresetName = "standard") -> None:
        self._sim = cs.Simulator(DESIGN, preset=preset)
        self.settings = f"Simulator.step, preset {preset}"
        self.unknowns = 0
        """Of the last step."""
        self.baseline: Array = self._sim.baseline

    def step(self, x: float, gap: float) -> Array:
        """ΔC [F] with the bar at x [m], gap [m]."""
        reading = self._sim.step(cs.Scene([bar_at(x, gap)]))
        self.unknowns = reading.stats.unknowns
        return reading.delta


class PaperScheme:
    """The scheme of Schöffmann et al. 2022: centroids, residual update, full solve at every step.

    Every node of a tetrahedron whose centroid lies in the bar is held at 0 V. As in the code that
    its authors published (`cape.py`), conjugate gradients start from zero, for one electrode after
    the other, and end at SciPy's default tolerance of 1e-5. Theirs know no preconditioner and have
    their matrix dense; here it is sparse, and the diagonal preconditions.

    With ``warm_start`` it gets what CapSense does besides: it starts from the last step's solution
    and stops where the energy is good enough.
    """

    def __init__(self, mesh: TetMesh, warm_start: bool) -> None:
        tolerance = TOLERANCE if warm_start else PUBLISHED_TOLERANCE
        self.name, self.settings = _named("the paper's scheme", warm_start, tolerance)
        sensor = MeshSensor(mesh, design().electrode_names)
        self._solver = MaskedSolver(sensor, tolerance=tolerance, warm_start=warm_start)
        x, y, z = (np.ascontiguousarray(c) for c in mesh.centroids.T)
        self._centroids = (x, y, z)
        self.n_tets, self.unknowns = mesh.n_tets, mesh.n_points

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        inside = within(self._centroids, *bar_corners(x, gap))
        return self._solver.step(inside.astype(np.int64) - 1, [GROUNDED])


class PaperOnLattice:
    """The same on the default mesh of CapSense's ``method="fem_masked"``.

    The bar's staircase there changes only in some steps; a warm start makes the others cheap.
    """

    returns_change = True

    def __init__(self, warm_start: bool) -> None:
        sim = cs.Simulator(DESIGN)
        self.name, self.settings = _named(
            "the paper's scheme, CapSense's planes", warm_start, PUBLISHED_TOLERANCE
        )
        sensor = lattice_sensor(design(), sim.background.terminals, sim.settings.mesh)
        self._scenes = MaskedScenes(sensor, sim.excitation_frequency, warm_start=warm_start)
        planes = np.array([len(axis) for axis in plan_axes(design(), MeshSettings())])
        self.n_tets, self.unknowns = int(6 * (planes - 1).prod()), int(planes.prod())

    def step(self, x: float, gap: float) -> Array:
        """ΔC [F] with the bar at x [m], gap [m]."""
        return self._scenes.solve(cs.Scene([bar_at(x, gap)])).matrix


def bar_at(x: float, gap: float) -> cs.Body:
    """The bar as a body."""
    return _BAR.moved(cs.Pose((x, 0.0, gap + SIZE[2] / 2)))


def _named(name: str, warm_start: bool, tolerance: float) -> tuple[str, str]:
    start = "warm start, energy form" if warm_start else "from zero"
    settings = f"Jacobi-CG for one electrode after the other, {start}, tolerance {tolerance:g}"
    return f"{name}, warm start" if warm_start else name, settings
