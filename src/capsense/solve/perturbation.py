"""The online solver: what a scene changes in the capacitances of a design, step after step.

Unknown is u = φ − φ⁰, the change of each terminal's potential. See ``docs/theory.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.errors import SceneError, SolveError
from capsense.field.background import BackgroundField
from capsense.scene import Scene, TriMesh
from capsense.scene.layers import Layers
from capsense.solve import pcg_kernels as pcg
from capsense.solve import trace_kernels as tracing
from capsense.solve.column_kernels import BODY, MAX_STRETCHES

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

LANES = pcg.LANES
_NO_GRIDS = np.zeros(1, np.float32)
_UNIT = EPS0 * 1e-3
"""Operator entries are stored in this unit [F], which makes them of order one."""
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
        self._mesh = _Mesh(background, self._base_weight)
        self._diagonal, self._active = np.ones(n, np.float32), np.zeros(n, np.float32)
        self._inverse, self._woken = np.zeros(n, np.float32), np.empty(n, np.int64)
        self._share = np.zeros(len(la.joints), np.float32)
        self._stamp, self._mark = np.zeros(n, np.int64), 0
        self._inside, self._inside_nodes = np.full(n, -1, np.int64), np.empty(n, np.int64)
        self._counts = np.zeros(4, np.int64)
        self._found = _Found(self._mesh, max(4096, n // 4))
        self._pool: list[_Block] = []
        self._blocks: list[_Block] = []
        self._lanes: tuple[object, ...] = ()
        self._rested = True

    def reset(self) -> None:
        """Forget the last solution."""
        for block in self._blocks:
            block.u[:] = 0.0
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
        conductors = _Conductors(scene, self.frequency)
        n_tie, n_energy, n_couple = self._trace(scene, conductors)
        lanes, grounds = conductors.lanes(n_terminals)
        self._prepare(scene, lanes, n_terminals + len(grounds))
        energy, iterations, left, goal = self._solve_blocks(n_tie, n_energy, lanes)
        energy = energy[: n_terminals + len(grounds), : n_terminals + len(grounds)]
        conductors.add_couplings(energy, self._found.couples[:n_couple], lanes)
        delta = _reduce(energy, n_terminals, grounds)
        if not np.isfinite(delta).all():
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
        weight = la.weights / _UNIT
        extra = np.zeros(la.n_nodes)
        cuts, half = la.cuts, self.background.half_weights / _UNIT
        if len(cuts):
            weight[cuts.axis, cuts.node] = 0.0
            np.add.at(extra, cuts.node, half[:, 0])
            np.add.at(extra, la.beyond(cuts.axis, cuts.node), half[:, 1])
        return weight.astype(np.float32), extra.astype(np.float32)

    def _trace(self, scene: Scene, conductors: _Conductors) -> tuple[int, int, int]:
        bodies, grids = _pack_bodies(scene, conductors)
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
            )  # fmt: skip
            if status == tracing.FULL:
                ties, energies, couples, _ = self._counts.tolist()
                return ties, energies, couples
            if status == tracing.CROWDED:
                raise SceneError(
                    f"more than {MAX_STRETCHES} stretches of bodies lie on one line "
                    "through the domain; join small bodies into one mesh"
                )
            self._found = _Found(mesh, 2 * len(found.ties))

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
            self._pool.append(_Block(first, self.background.potentials))
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
                self.tolerance / _UNIT, self.relative_tolerance * np.maximum(0.2 * start, 1e-9)
            )
            rest = np.zeros(LANES)
            done = pcg.solve(
                self._found.weight, self._diagonal, self._active, self._inverse, mesh.storeys,
                mesh.ceiling, mesh.parent, self._share, block.rhs, block.u, block.r, block.z,
                block.p, block.ap, wanted, self.max_iterations, rest,
            )  # fmt: skip
            iterations = max(iterations, done)
            left, goal = max(left, rest.max() * _UNIT), max(goal, wanted.max() * _UNIT)
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
        return energy * _UNIT, iterations, left, goal


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


class _Conductors:
    """Which bodies conduct, and what ties them to ground."""

    def __init__(self, scene: Scene, frequency: float) -> None:
        self.index = np.full(len(scene), -1, dtype=np.int64)
        self.eps_r = np.ones(len(scene))
        ties: list[float] = []
        for i, body in enumerate(scene):
            if body.material.is_conductor(frequency):
                self.index[i] = len(ties)
                known = {"grounded": np.inf, "floating": 0.0}
                ties.append(known[body.grounding] if isinstance(body.grounding, str)
                            else float(body.grounding))  # fmt: skip
            else:
                self.eps_r[i] = body.material.at(frequency).eps_r
        self._ties = np.array(ties)
        self.parent = np.arange(max(1, len(ties)))

    def _root(self, c: int) -> int:
        while self.parent[c] != c:
            c = int(self.parent[c])
        return c

    def lanes(self, n_terminals: int) -> tuple[NDArray[np.int64], Array]:
        """Lane of each conductor (−1: at ground) and capacitance to ground of each lane [F]."""
        roots = [self._root(c) for c in range(len(self._ties))]
        total = np.zeros(len(self._ties))
        for c, root in enumerate(roots):
            total[root] += self._ties[c]
        floating = sorted({r for r in roots if np.isfinite(total[r])})
        lanes = np.full(max(1, len(roots)), -1, dtype=np.int64)
        for c, root in enumerate(roots):
            if root in floating:
                lanes[c] = n_terminals + floating.index(root)
        return lanes, total[floating] if floating else np.zeros(0)

    def add_couplings(
        self, energy: Array, couples: NDArray[np.void], lanes: NDArray[np.int64]
    ) -> None:
        """Add links that run from one conductor straight to another."""
        for first, second, weight in couples.tolist():
            a, b = lanes[first], lanes[second]
            if a == b:
                continue
            w = weight * _UNIT
            for lane in (a, b):
                if lane >= 0:
                    energy[lane, lane] += w
            if a >= 0 and b >= 0:
                energy[a, b] -= w
                energy[b, a] -= w


class _Block:
    """Eight right-hand sides, from lane ``first`` on."""

    def __init__(self, first: int, potentials: Array) -> None:
        self.first = first
        self.phi = np.zeros((len(potentials), LANES), np.float32)
        part = potentials[:, first : first + LANES]
        self.phi[:, : part.shape[1]] = part
        self.held = np.arange(first, first + LANES)
        """Terminal of each lane, or −1."""
        self.held[part.shape[1] :] = -1
        self.rhs, self.u, self.r, self.z, self.p, self.ap = (
            np.zeros_like(self.phi) for _ in range(6)
        )
        self.value = np.empty((0, LANES))
        self.drop = np.empty((0, LANES))


class _Found:
    """Room for what the scan of a scene finds."""

    def __init__(self, mesh: _Mesh, size: int) -> None:
        n, pairs = mesh.stored.shape
        self.weight, self.extra = np.empty((3, n), np.float32), np.empty(n, np.float32)
        self.within = np.zeros(pairs)
        self.ties = np.zeros(size, tracing.TIE)
        self.energies = np.zeros(size, tracing.ENERGY)
        self.couples = np.zeros(size, tracing.COUPLE)


class _Mesh:
    """The lattice and its empty-domain operator, packed for the kernels."""

    def __init__(self, background: BackgroundField, weight: Array32) -> None:
        la = background.lattice
        sizes = [(s.first, *s.shape) for s in la.storeys]
        highest = np.array([s.shape for s in la.storeys]) - 1
        highest[:-1, 2] -= 1
        self.scan_storeys = np.zeros(len(sizes), tracing.STOREY)
        self.storeys = np.array(sizes, dtype=np.int64)
        self.scan_storeys["first"], self.scan_storeys["shape"] = (
            self.storeys[:, 0], self.storeys[:, 1:]
        )  # fmt: skip
        self.scan_storeys["begin"] = (
            np.cumsum([0, *self.storeys[:, 1:].ravel()])[:-1].reshape(-1, 3)
        )  # fmt: skip
        self.scan_storeys["lowest"][1:, 2] = 1
        self.scan_storeys["highest"] = highest
        self.axes = np.concatenate([c for s in la.storeys for c in s.axes])
        self.faces = np.concatenate([[*f, np.inf] for s in la.storeys for f in s.faces])
        self.nodes = np.zeros(la.n_nodes, tracing.NODE)
        self.nodes["owner"], self.nodes["kink"] = la.owner, la.kink
        self.links = np.zeros((3, la.n_nodes), tracing.LINK)
        self.links["weight"], self.links["eps_r"], self.links["cut"] = weight, la.eps_r, -1
        self.links["cut"][la.cuts.axis, la.cuts.node] = np.arange(len(la.cuts))
        self.cuts = np.zeros(len(la.cuts), tracing.CUT)
        self.cuts["half"] = background.half_weights / _UNIT
        self.cuts["length"] = np.stack([la.cuts.lower, la.cuts.upper], axis=1)
        self.cuts["owner"] = np.stack([la.cuts.lower_owner, la.cuts.upper_owner], axis=1)
        self.ceiling, self.parent, self.home = la.joints.ceiling, la.joints.parent, la.home
        self.pairs = np.tril_indices(len(background.terminals))
        self.stored = self._stored_energies(background)

    def _stored_energies(self, background: BackgroundField) -> Array32:
        """Energies of each node's links to the next ones, for each pair of terminals, (n, pairs).

        Marks the nodes whose three links are all whole; only these are filled in.
        """
        la, phi = background.lattice, background.potentials
        whole = (self.links["weight"] > 0) & (self.links["cut"] < 0)
        plain = np.flatnonzero(whole.all(axis=0))
        self.nodes["plain"][plain] = True
        out = np.zeros((la.n_nodes, len(self.pairs[0])), np.float32)
        for axis in range(3):
            drop = phi[plain] - phi[la.beyond(axis, plain)]
            weight = self.links["weight"][axis, plain, None]
            out[plain] += weight * drop[:, self.pairs[0]] * drop[:, self.pairs[1]]
        return out


def _pack_bodies(scene: Scene, conductors: _Conductors) -> tuple[NDArray[np.void], Array32]:
    """Bodies as the scan takes them, and the grids of meshes and layers, one after the other."""
    packed = scene.pack()
    bodies = np.zeros(len(packed), BODY)
    for name, values in (
        ("kind", packed.kinds), ("params", packed.params), ("rotation", packed.rotation),
        ("position", packed.position), ("bounds", packed.bounds),
        ("conductor", conductors.index), ("eps_r", conductors.eps_r),
    ):  # fmt: skip
        bodies[name] = values
    parts: list[Array32] = []
    offset = 0
    for i, shape in enumerate(packed.shapes):
        if not isinstance(shape, TriMesh | Layers):
            continue
        if isinstance(shape, TriMesh):
            size, inverse = shape.grid.values.shape, 1.0 / shape.grid.cell
        else:
            size, inverse = tuple(shape.grid.shape.tolist()), shape.grid.inverse
        bodies["grid_shape"][i], bodies["grid_first"][i] = size, offset
        bodies["grid_origin"][i], bodies["grid_inv"][i] = shape.grid.origin, inverse
        parts.append(shape.grid.values.ravel())
        offset += parts[-1].size
    return bodies, np.concatenate(parts) if parts else _NO_GRIDS
