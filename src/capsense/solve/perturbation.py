"""The online solver: what a scene changes in the capacitances of a design, step after step.

Unknown is u = φ − φ⁰, the change of each terminal's potential. See ``docs/theory.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.errors import SceneError, SolveError
from capsense.field.background import BackgroundField
from capsense.scene import Scene
from capsense.solve import pcg_kernels as pcg
from capsense.solve import trace_kernels as tracing
from capsense.solve.column_kernels import MAX_STRETCHES, PART
from capsense.solve.conductors import Conductors
from capsense.solve.finding_kernels import UNIT
from capsense.solve.matter_kernels import MATTER
from capsense.solve.packed import Block, Found, PackedLattice, pack_bodies

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

LANES = pcg.LANES
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
        la = background.lattice
        n = la.n_nodes
        self._n_terminals = len(background.terminals)
        self._base_weight, self._base_extra = self._base_operator()
        self._mesh = PackedLattice(background, self._base_weight)
        self._diagonal, self._active = np.ones(n, np.float32), np.zeros(n, np.float32)
        self._inverse, self._woken = np.zeros(n, np.float32), np.empty(n, np.int64)
        self._share = np.zeros(len(la.joints), np.float32)
        self._stamp, self._mark = np.zeros(n, np.int64), 0
        self._inside, self._inside_nodes = np.full(n, -1, np.int64), np.empty(n, np.int64)
        self._counts, self._room = np.zeros(5, np.int64), np.zeros(1, tracing.ROOM)[0]
        self._matter, self._touched = np.zeros((3, n), MATTER), np.empty(3 * n, np.int64)
        self._matter["series"] = 1.0
        self._found = Found(self._mesh, max(4096, n // 4))
        self._pool: list[Block] = []
        self._blocks: list[Block] = []
        self._lanes: tuple[object, ...] = ()
        self._rested = True

    def reset(self) -> None:
        """Forget the last solution."""
        for block in self._blocks:
            for values in (block.u, block.r, block.p, block.ap):
                values[:] = 0.0
        self._rested = True
        self._active[:] = 0.0

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
        conductors = Conductors(scene, self.frequency)
        n_tie, n_energy, n_couple = self._trace(scene, conductors)
        lanes, grounds = conductors.lanes(n_terminals)
        self._prepare(scene, lanes, n_terminals + len(grounds))
        energy, iterations, left, goal = self._solve_blocks(n_tie, n_energy, lanes)
        energy = energy[: n_terminals + len(grounds), : n_terminals + len(grounds)]
        conductors.add_couplings(energy, self._found.couples[:n_couple], lanes)
        delta = _reduce(energy, n_terminals, grounds)
        if not np.isfinite(delta).all():
            self.reset()  # nothing of it must reach the next step
            raise SolveError("a step gave a capacitance that is not finite")
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
        stacked = np.concatenate([b.u for b in self._blocks], axis=1)
        out = stacked[:, : self._n_terminals].astype(float)
        la = self.background.lattice
        inside = (self._active == 0) & la.unknown
        out[inside] = -self.background.potentials[inside]
        out = out[la.home]
        return out

    # -- the stages ---------------------------------------------------------------------------

    def _base_operator(self) -> tuple[Array32, Array32]:
        la = self.background.lattice
        weight = la.weights / UNIT
        extra = np.zeros(la.n_nodes)
        cuts, half = la.cuts, self.background.half_weights / UNIT
        if len(cuts):
            weight[cuts.axis, cuts.node] = 0.0
            np.add.at(extra, cuts.node, half[:, 0])
            np.add.at(extra, la.beyond(cuts.axis, cuts.node), half[:, 1])
        return weight.astype(np.float32), extra.astype(np.float32)

    def _trace(self, scene: Scene, conductors: Conductors) -> tuple[int, int, int]:
        bodies, grids = pack_bodies(scene, conductors)
        near, parts = np.empty(len(scene), np.int64), np.empty(len(scene), PART)
        mesh = self._mesh
        while True:
            found = self._found
            found.weight[:] = self._base_weight
            found.extra[:] = self._base_extra
            conductors.parent[:] = np.arange(len(conductors.parent))
            status = tracing.trace(
                mesh.scan_storeys, mesh.axes, mesh.faces, mesh.nodes, mesh.links, mesh.cuts,
                mesh.ceiling, mesh.parent, mesh.home, mesh.stored, bodies, grids, CONTACT,
                conductors.parent, found.weight, found.extra, self._inside, self._inside_nodes,
                found.ties, found.energies, found.couples, found.within, self._counts,
                self._room, near, parts, self._matter, self._touched,
            )  # fmt: skip
            if status == tracing.FULL:
                ties, energies, couples, _, _ = self._counts.tolist()
                return ties, energies, couples
            if status == tracing.CROWDED:
                raise SceneError(
                    f"more than {MAX_STRETCHES} stretches of bodies lie on one line "
                    "through the domain; join small bodies into one mesh"
                )
            self._found = Found(mesh, 2 * len(found.ties))

    def _prepare(self, scene: Scene, lanes: NDArray[np.int64], n_lanes: int) -> None:
        """Build diagonal and preconditioner; carry the last solution over."""
        la = self.background.lattice
        found, mesh = self._found, self._mesh
        n_woken = pcg.factorise(
            found.weight, found.extra, la.owner, mesh.storeys, mesh.ceiling, mesh.parent,
            self._share, self._diagonal, self._active, self._inverse, self._woken,
        )  # fmt: skip
        signature = (len(scene), *lanes.tolist())
        if signature != self._lanes:
            self._assign_lanes(n_lanes)
            self._lanes = signature
        if not self._rested:
            woken = self._woken[:n_woken]
            for block in self._blocks:
                block.u[woken] = -block.phi[woken]
        self._rested = False

    def _assign_lanes(self, n_lanes: int) -> None:
        """Have as many blocks as needed; the lanes of terminals keep their solution."""
        for first in range(LANES * len(self._pool), n_lanes, LANES):
            self._pool.append(Block(first, self.background.potentials))
        self._blocks = self._pool[: -(-n_lanes // LANES)]
        for block in self._blocks:
            block.u[:, max(0, self._n_terminals - block.first) :] = 0.0

    def _solve_blocks(
        self, n_tie: int, n_energy: int, lanes: NDArray[np.int64]
    ) -> tuple[Array, int, float, float]:
        mesh, count = self._mesh, len(self._blocks)
        ties, energies = self._found.ties[:n_tie], self._found.energies[:n_energy]
        energy = np.zeros((count * LANES, count * LANES))
        iterations, left, goal = 0, 0.0, self.tolerance
        for block in self._blocks:
            block.rhs[:] = 0.0
            block.value = np.empty((n_tie, LANES))
            block.drop = np.empty((n_energy, LANES))
            local = np.where((lanes >= block.first) & (lanes < block.first + LANES), lanes, -1)
            pcg.load_scene(
                block.phi, np.where(local >= 0, local - block.first, -1), block.held, ties,
                energies, block.rhs, block.value, block.drop,
            )  # fmt: skip
        for i, first in enumerate(self._blocks):
            for j, second in enumerate(self._blocks[i:], start=i):
                part = np.zeros((LANES, LANES))
                pcg.gram(ties, first.value, second.value, part)
                pcg.gram(energies, first.drop, second.drop, part)
                _place(energy, i, j, part)
        rows, columns = mesh.pairs
        energy[rows, columns] += self._found.within
        energy[columns, rows] = energy[rows, columns]
        for i, block in enumerate(self._blocks):
            start = np.abs(np.diag(energy))[i * LANES : (i + 1) * LANES]
            wanted = np.maximum(
                self.tolerance / UNIT, self.relative_tolerance * np.maximum(0.2 * start, 1e-9)
            )
            rest = np.zeros(LANES)
            done = pcg.solve(
                self._found.weight, self._diagonal, self._active, self._inverse, mesh.storeys,
                mesh.ceiling, mesh.parent, self._share, block.rhs, block.u, block.r, block.z,
                block.p, block.ap, wanted, self.max_iterations, rest,
            )  # fmt: skip
            iterations = max(iterations, done)
            left, goal = max(left, rest.max() * UNIT), max(goal, wanted.max() * UNIT)
        for i, first in enumerate(self._blocks):
            for j, second in enumerate(self._blocks[i:], start=i):
                part = np.zeros((LANES, LANES))
                self._mark += 1
                pcg.sparse_inner(
                    ties, energies, self._stamp, self._mark, self._active, first.rhs, second.u,
                    part,
                )  # fmt: skip
                pcg.inner(first.u, second.r, part)
                if i == j:
                    part = 0.5 * (part + part.T)
                _place(energy, i, j, -part)
        return energy * UNIT, iterations, left, goal


def _place(energy: Array, i: int, j: int, part: Array) -> None:
    rows, cols = slice(i * LANES, (i + 1) * LANES), slice(j * LANES, (j + 1) * LANES)
    energy[rows, cols] += part
    if i != j:
        energy[cols, rows] += part.T


def _reduce(energy: Array, n: int, grounds: Array) -> Array:
    """Eliminate floating conductors, each tied to ground through ``grounds`` [F]."""
    if not len(grounds):
        return energy
    seen = n + np.flatnonzero(np.diag(energy)[n:] > 0)  # the others meet no lattice line
    inner = energy[np.ix_(seen, seen)] + np.diag(grounds[seen - n])
    outer = energy[:n, seen]
    return energy[:n, :n] - outer @ np.linalg.solve(inner, outer.T)
