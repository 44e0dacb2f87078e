"""Lattice, scene and right-hand sides as the kernels take them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.field.background import BackgroundField
from capsense.scene import Scene, TriMesh
from capsense.scene.layers import Layers
from capsense.solve.column_kernels import BODY
from capsense.solve.conductors import Conductors
from capsense.solve.finding_kernels import COUPLE, CUT, ENERGY, LINK, NODE, STOREY, TIE, UNIT
from capsense.solve.pcg_kernels import LANES

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_NO_GRIDS = np.zeros(1, np.float32)


class Block:
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


class Found:
    """Room for what the scan of a scene finds."""

    def __init__(self, mesh: PackedLattice, size: int) -> None:
        n, pairs = mesh.stored.shape
        self.weight, self.extra = np.empty((3, n), np.float32), np.empty(n, np.float32)
        self.within = np.zeros(pairs)
        self.ties = np.zeros(size, TIE)
        self.energies = np.zeros(size, ENERGY)
        self.couples = np.zeros(size, COUPLE)


class PackedLattice:
    """The lattice and its empty-domain operator, packed for the kernels."""

    def __init__(self, background: BackgroundField, weight: Array32) -> None:
        la = background.lattice
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
        self.links["weight"], self.links["eps_r"], self.links["cut"] = weight, la.eps_r, -1
        self.links["cut"][la.cuts.axis, la.cuts.node] = np.arange(len(la.cuts))
        self.cuts = np.zeros(len(la.cuts), CUT)
        self.cuts["half"] = background.half_weights / UNIT
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
