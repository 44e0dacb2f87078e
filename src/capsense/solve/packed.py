"""Lattice, scene and right-hand sides as the kernels take them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from capsense._simd import LANES, aligned_zeros
from capsense.field.background import BackgroundField
from capsense.scene import Scene, TriMesh
from capsense.scene.layers import Layers
from capsense.solve.column_kernels import BODY
from capsense.solve.conductors import Conductors
from capsense.solve.finding_kernels import COUPLE, CUT, ENERGY, LINK, NODE, STOREY, TIE, UNIT
from capsense.solve.load_kernels import Setup
from capsense.solve.matter_kernels import MATTER
from capsense.solve.pcg_kernels import Operator
from capsense.solve.trace_kernels import ROOM

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_NO_GRIDS = np.zeros(1, np.float32)
_LOCK = threading.Lock()
_PACKED: WeakKeyDictionary[BackgroundField, PackedLattice] = WeakKeyDictionary()


class Lanes:
    """The terminals' potentials, eight to a block, from terminal ``first`` on."""

    def __init__(self, first: int, potentials: Array) -> None:
        self.first, self.place = first, slice(first, first + LANES)
        part = potentials[:, self.place]
        self.held = part.shape[1]
        """Lanes that belong to terminals; those behind belong to floating conductors."""
        self.phi = aligned_zeros((len(potentials), LANES), np.float32)
        self.phi[:, : self.held] = part


class Block:
    """Room for the solution of eight right-hand sides."""

    def __init__(self, n_nodes: int) -> None:
        self.r, self.z, self.p = (aligned_zeros((n_nodes, LANES), np.float32) for _ in range(3))
        self.value, self.drop = np.empty((0, LANES)), np.empty((0, LANES))

    def fit(self, n_ties: int, n_energies: int) -> None:
        """Have room for so many ties and energy terms."""
        if len(self.value) < n_ties:
            self.value = aligned_zeros((2 * n_ties, LANES), np.float64)
        if len(self.drop) < n_energies:
            self.drop = aligned_zeros((2 * n_energies, LANES), np.float64)


class Workspace:
    """All that a step needs and that the next one does not ask for.

    Sensors of one design hand it on to each other: it stays in the processor's caches.
    """

    def __init__(self, mesh: PackedLattice) -> None:
        n, pairs = mesh.stored.shape
        self.operator = Operator(
            aligned_zeros((3, n), np.float32), np.ones(n, np.float32), np.zeros(n, np.float32),
            mesh.storeys, mesh.joints, mesh.ceiling, mesh.parent, np.unique(mesh.parent) - 1,
            np.zeros(len(mesh.ceiling), np.float32),
        )  # fmt: skip
        self.setup = Setup(
            np.zeros(n, np.float32), np.zeros((3, n), np.float32), np.zeros(n + 1, np.int64)
        )
        self.inside, self.inside_nodes = np.full(n, -1, np.int64), np.empty(n, np.int64)
        self.counts, self.room = np.zeros(5, np.int64), np.zeros(1, ROOM)[0]
        self.matter, self.touched = np.zeros((3, n), MATTER), np.empty(3 * n, np.int64)
        self.matter["series"] = 1.0
        self.within = np.zeros(pairs)
        self.fit(max(4096, n // 4))
        self.sums = aligned_zeros((4, LANES), np.float64)
        self.factors = aligned_zeros((3, LANES), np.float32)
        self._blocks: list[Block] = []

    def fit(self, size: int) -> None:
        """Have room for so many ties, energy terms and couplings."""
        self.ties, self.energies = np.zeros(size, TIE), np.zeros(size, ENERGY)
        self.couples = np.zeros(size, COUPLE)

    def blocks(self, count: int) -> list[Block]:
        """Room for so many times eight right-hand sides."""
        while len(self._blocks) < count:
            self._blocks.append(Block(len(self.inside)))
        return self._blocks[:count]


class PackedLattice:
    """The lattice and its empty-domain operator, packed for the kernels; shared by sensors."""

    def __init__(self, background: BackgroundField) -> None:
        la = background.lattice
        self.weight, self.extra = _base_operator(background)
        self.unknown = (la.owner == -1).astype(np.uint8)
        sizes = [(s.first, *s.shape) for s in la.storeys]
        highest = np.array([s.shape for s in la.storeys]) - 1
        highest[:-1, 2] -= 1
        self.scan_storeys = np.zeros(len(sizes), STOREY)
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
        self.nodes = np.zeros(la.n_nodes, NODE)
        self.nodes["owner"], self.nodes["kink"] = la.owner, la.kink
        self.links = np.zeros((3, la.n_nodes), LINK)
        self.links["weight"], self.links["eps_r"], self.links["cut"] = self.weight, la.eps_r, -1
        self.links["cut"][la.cuts.axis, la.cuts.node] = np.arange(len(la.cuts))
        self.cuts = np.zeros(len(la.cuts), CUT)
        self.cuts["half"] = background.half_weights / UNIT
        self.cuts["length"] = np.stack([la.cuts.lower, la.cuts.upper], axis=1)
        self.cuts["owner"] = np.stack([la.cuts.lower_owner, la.cuts.upper_owner], axis=1)
        self.ceiling, self.parent, self.home = la.joints.ceiling, la.joints.parent, la.home
        ends = self.storeys[:, 0] + self.storeys[:, 1:].prod(axis=1)
        self.joints = np.array([0, *np.searchsorted(self.ceiling, ends)])
        self.pairs = np.tril_indices(len(background.terminals))
        self.stored = self._stored_energies(background)
        self._potentials = background.potentials
        self._lanes: list[Lanes] = []
        self.spare: list[Workspace] = []
        """Workspaces that no step is using."""

    def lanes(self, count: int) -> list[Lanes]:
        """The potentials of the first ``count`` blocks."""
        if len(self._lanes) < count:
            with _LOCK:
                while len(self._lanes) < count:
                    self._lanes.append(Lanes(LANES * len(self._lanes), self._potentials))
        return self._lanes[:count]

    @contextmanager
    def workspace(self) -> Iterator[Workspace]:
        """Room for a step; what a step has left that failed is not used again."""
        try:
            work = self.spare.pop()
        except IndexError:
            work = Workspace(self)
        yield work
        self.spare.append(work)

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


def packed_lattice(background: BackgroundField) -> PackedLattice:
    """The one packed lattice of all sensors that share a field."""
    with _LOCK:
        if background not in _PACKED:
            _PACKED[background] = PackedLattice(background)
        return _PACKED[background]


def _base_operator(background: BackgroundField) -> tuple[Array32, Array32]:
    """Weights of the links in the empty domain, (3, n), and ties to what is held, (n,)."""
    la = background.lattice
    weight = la.weights / UNIT
    extra = np.zeros(la.n_nodes)
    cuts, half = la.cuts, background.half_weights / UNIT
    if len(cuts):
        weight[cuts.axis, cuts.node] = 0.0
        np.add.at(extra, cuts.node, half[:, 0])
        np.add.at(extra, la.beyond(cuts.axis, cuts.node), half[:, 1])
    return weight.astype(np.float32), extra.astype(np.float32)


def pack_bodies(scene: Scene, conductors: Conductors) -> tuple[NDArray[np.void], Array32]:
    """Bodies as the scan takes them, and the grids of meshes and layers, one after the other."""
    packed = scene.pack()
    bodies = np.zeros(len(packed), BODY)
    for name, values in (
        ("kind", packed.kinds), ("params", packed.params), ("rotation", packed.rotation),
        ("position", packed.position), ("bounds", packed.bounds),
        ("conductor", conductors.index), ("eps_r", conductors.eps_r),
    ):  # fmt: skip
        bodies[name] = values
    for k in np.flatnonzero(conductors.index < 0):
        bodies["breadth"][k] = packed.shapes[k].breadth  # of a mesh, known by its grid alone
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
