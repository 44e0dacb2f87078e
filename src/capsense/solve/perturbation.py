"""The online solver: what a scene changes in the capacitances of a design, step after step.

Unknown is u = φ − φ⁰, the change of each terminal's potential. See ``docs/theory.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense._simd import LANES, aligned_zeros
from capsense.errors import SceneError, SolveError
from capsense.field.background import BackgroundField
from capsense.scene import Scene
from capsense.solve import load_kernels as loading
from capsense.solve import pcg_kernels as pcg
from capsense.solve import trace_kernels as tracing
from capsense.solve.column_kernels import MAX_STRETCHES, PART
from capsense.solve.conductors import Conductors
from capsense.solve.finding_kernels import UNIT
from capsense.solve.packed import Workspace, pack_bodies, packed_lattice

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

CONTACT = 1e-4
"""Thickness [m] of the insulating film that keeps a conductor off an electrode it touches."""


@dataclass(frozen=True, eq=False)
class Perturbation:
    """What a scene does to a design."""

    delta: Array
    """Change of the Maxwell matrix of all terminals [F], shape (terminals, terminals)."""
    iterations: int
    """Conjugate-gradient iterations."""
    error_estimate: float
    """Estimated error of any entry of ``delta`` that iterating on would remove [F]."""
    tolerance: float
    """What ``error_estimate`` was iterated down to [F]."""


class PerturbationSolver:
    """Solves scene after scene, each started from the last one's solution.

    Args:
        background: Field of the design.
        tolerance: Iterate until the error of a capacitance is below this [F] …
        relative_tolerance: … or below this fraction of the largest change.
        frequency: Excitation frequency [Hz]; decides which materials conduct.
        max_iterations: Give up after so many iterations.
    """

    def __init__(
        self,
        background: BackgroundField,
        *,
        tolerance: float = 1e-18,
        relative_tolerance: float = 1e-5,
        frequency: float = 250e3,
        max_iterations: int = 500,
    ) -> None:
        self.background = background
        self.tolerance = tolerance
        self.relative_tolerance = relative_tolerance
        self.frequency = frequency
        self.max_iterations = max_iterations
        self._n_terminals = len(background.terminals)
        self._mesh = packed_lattice(background)
        self._active = np.zeros(background.lattice.n_nodes, np.uint8)
        self._u: list[Array32] = []
        self._n_blocks = 0
        self._lanes: tuple[object, ...] = ()
        self._rested = True

    def reset(self) -> None:
        """Forget the last solution."""
        for u in self._u:
            u[:] = 0.0
        self._rested = True
        self._active[:] = 0

    def step(self, scene: Scene) -> Perturbation:
        """Solve a scene.

        Raises:
            SceneError: More bodies meet on one line than the scan can hold.
            SolveError: The iteration did not converge.
        """
        n_terminals = self._n_terminals
        if len(scene) == 0:
            self.reset()
            return Perturbation(np.zeros((n_terminals, n_terminals)), 0, 0.0, self.tolerance)
        try:
            delta, iterations, left, goal = self._solve_scene(scene)
        except BaseException:
            self.reset()  # half a solution must not reach the next step
            raise
        if iterations >= self.max_iterations and left > goal:
            raise SolveError(
                f"no convergence in {iterations} iterations: estimated error {left:.2e} F, "
                f"asked for {goal:.2e} F"
            )
        return Perturbation(delta, iterations, left, goal)

    def solve(self, scene: Scene) -> tuple[Array, int, float, float]:
        """Return :meth:`step`'s change, iterations, error estimate [F] and tolerance [F]."""
        result = self.step(scene)
        return result.delta, result.iterations, result.error_estimate, result.tolerance

    def potentials(self) -> Array:
        """Change of the potentials at the nodes in the last step [V], shape (n, terminals)."""
        if self._rested:
            return np.zeros((self.background.lattice.n_nodes, self._n_terminals))
        stacked = np.concatenate(self._u[: self._n_blocks], axis=1)
        out = stacked[:, : self._n_terminals].astype(float)
        la = self.background.lattice
        inside = (self._active == 0) & la.unknown
        out[inside] = -self.background.potentials[inside]
        out = out[la.home]
        return out

    # -- the stages ---------------------------------------------------------------------------

    def _solve_scene(self, scene: Scene) -> tuple[Array, int, float, float]:
        """Change of the matrix [F], iterations, error left and asked for [F]."""
        n_terminals = self._n_terminals
        conductors = Conductors(scene, self.frequency)
        with self._mesh.workspace() as work:
            ties, energies, couples = self._trace(work, scene, conductors)
            lanes, grounds = conductors.lanes(n_terminals)
            n_lanes = n_terminals + len(grounds)
            signature = (len(scene), *lanes.tolist())
            if signature != self._lanes:
                self._assign_lanes(n_lanes)
                self._lanes = signature
            energy, iterations, left, goal = self._solve_blocks(work, ties, energies, lanes)
            energy = energy[:n_lanes, :n_lanes]
            conductors.add_couplings(energy, couples, lanes)
            delta = _reduce(energy, n_terminals, grounds)
            if not np.isfinite(delta).all():
                raise SolveError("a step gave a capacitance that is not finite")
        return delta, iterations, left, goal

    def _trace(
        self, work: Workspace, scene: Scene, conductors: Conductors
    ) -> tuple[NDArray[np.void], NDArray[np.void], NDArray[np.void]]:
        """Change the empty domain's operator; return ties, energy terms and couplings."""
        bodies, grids = pack_bodies(scene, conductors)
        near, parts = np.empty(len(scene), np.int64), np.empty(len(scene), PART)
        mesh, weight = self._mesh, work.operator.weight
        while True:
            weight[:] = mesh.weight
            work.setup.extra[:] = mesh.extra
            conductors.parent[:] = np.arange(len(conductors.parent))
            status = tracing.trace(
                mesh.scan_storeys, mesh.axes, mesh.faces, mesh.nodes, mesh.links, mesh.cuts,
                mesh.ceiling, mesh.parent, mesh.home, mesh.stored, bodies, grids, CONTACT,
                conductors.parent, weight, work.setup.extra, work.inside, work.inside_nodes,
                work.ties, work.energies, work.couples, work.within, work.counts, work.room, near,
                parts, work.matter, work.touched,
            )  # fmt: skip
            if status == tracing.FULL:
                n_tie, n_energy, n_couple, _, _ = work.counts.tolist()
                return work.ties[:n_tie], work.energies[:n_energy], work.couples[:n_couple]
            if status == tracing.CROWDED:
                raise SceneError(
                    f"more than {MAX_STRETCHES} stretches of bodies lie on one line "
                    "through the domain; join small bodies into one mesh"
                )
            work.fit(2 * len(work.ties))

    def _assign_lanes(self, n_lanes: int) -> None:
        """Have as many blocks as needed; the lanes of terminals keep their solution."""
        self._n_blocks = -(-n_lanes // LANES)
        while len(self._u) < self._n_blocks:
            self._u.append(aligned_zeros((len(self._active), LANES), np.float32))
        for k, u in enumerate(self._u):
            u[:, max(0, self._n_terminals - k * LANES) :] = 0.0

    def _solve_blocks(
        self,
        work: Workspace,
        ties: NDArray[np.void],
        energies: NDArray[np.void],
        lanes: NDArray[np.int64],
    ) -> tuple[Array, int, float, float]:
        """Energies of all pairs of lanes [F], iterations, error left and asked for [F]."""
        count = self._n_blocks
        blocks, held = work.blocks(count), self._mesh.lanes(count)
        energy = np.zeros((count * LANES, count * LANES))
        rows, columns = self._mesh.pairs
        energy[rows, columns] = energy[columns, rows] = work.within
        own = energy.diagonal().reshape(-1, 1, LANES).copy()
        fresh, self._rested = self._rested, False
        iterations, left, wanted = 0, np.zeros((count, LANES)), np.zeros((count, LANES))
        for k, (block, base) in enumerate(zip(blocks, held, strict=True)):
            block.fit(len(ties), len(energies))
            part = np.zeros((LANES, LANES))
            done = loading.solve_block(
                work.operator, work.setup, self._mesh.unknown, self._active,
                pcg.Vectors(self._u[k], block.r, block.z, block.p), fresh, base.phi, lanes,
                base.first, base.held, ties, energies, block.value, block.drop,
                self.tolerance / UNIT, self.relative_tolerance, self.max_iterations, wanted[k],
                left[k], work.sums, work.factors, own[k], part,
            )  # fmt: skip
            energy[base.place, base.place] += part
            iterations = max(iterations, done)
        for i, first in enumerate(blocks):
            for j, second in enumerate(blocks[i + 1 :], start=i + 1):
                part = np.zeros((LANES, LANES))
                pcg.inner(work.operator, self._u[i], second.r, part)
                part = -part
                loading.add_energies(
                    ties, energies, first.value, first.drop, second.value, second.drop, self._u[j],
                    part,
                )  # fmt: skip
                energy[held[i].place, held[j].place] += part
                energy[held[j].place, held[i].place] += part.T
        goal = max(self.tolerance, float(wanted.max()) * UNIT)
        return energy * UNIT, iterations, float(left.max()) * UNIT, goal


def _reduce(energy: Array, n: int, grounds: Array) -> Array:
    """Eliminate floating conductors, each tied to ground through ``grounds`` [F]."""
    if not len(grounds):
        return energy
    seen = n + np.flatnonzero(np.diag(energy)[n:] > 0)  # the others meet no lattice line
    inner = energy[np.ix_(seen, seen)] + np.diag(grounds[seen - n])
    outer = energy[:n, seen]
    return energy[:n, :n] - outer @ np.linalg.solve(inner, outer.T)
