"""Adapt link weights so that the online lattice reproduces the accurate empty-domain fields.

Near an electrode's edge the field is singular and the plain weights are too large: the lattice
sees the electrode half a cell larger than it is. The weights are changed as little as possible
(relative least squares) such that the accurate fields leave small residuals at free nodes.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import lsmr

from capsense.field.lattice import Lattice

Array = NDArray[np.float64]

_LOWEST, _HIGHEST = -0.8, 4.0
"""Bounds on the relative change of a weight; weights stay positive."""
_TOTALS = 100.0
"""Weight of energies and charges against the residuals of nodes."""
_UNRESOLVED = 1.0
"""Relative error of an energy or a charge beyond which a lattice counts as too coarse."""


def calibrate(
    lattice: Lattice, potentials: Array, capacitance: Array, strength: float = 0.22
) -> tuple[Array, Array]:
    """Return adapted link weights (3, n) and half-link weights (cuts, 2) [F].

    ``potentials`` are the accurate fields at the nodes [V], shape (n, terminals), and
    ``capacitance`` [F] the terminals' accurate matrix. Minimises
    ``|R d + r|² + |E d + e|² + strength² |d|²`` where d is the relative change of each weight, r
    the nodal residuals relative to the flux that passes the node, and e the errors of energies
    and charges, where these are large. Half-links of crossed links come in the order of
    ``lattice.cuts``: lower node to sheet, upper node to sheet.
    """
    links = _Links(lattice, potentials)
    rows, rhs = _totals(links, capacitance)
    free = lattice.unknown
    for k in range(potentials.shape[1]):
        flux = links.weight * links.drop[:, k]
        through = links.sum_abs(flux)
        scale = np.where(free & (through > 0), 1.0 / np.maximum(through, 1e-300), 0.0)
        rows.append(sp.diags(scale) @ links.incidence @ sp.diags(flux))
        rhs.append(-scale * (links.incidence @ flux))
    matrix, target = sp.vstack(rows).tocsr(), np.concatenate(rhs)
    change = np.zeros(len(links.weight))
    fixed = np.zeros(len(change), dtype=bool)
    for _ in range(4):
        open_ = sp.diags((~fixed).astype(float))
        part = lsmr(matrix @ open_, target - matrix @ (change * fixed), damp=strength, maxiter=60)[
            0
        ]
        change = np.where(fixed, change, part)
        outside = (change < _LOWEST) | (change > _HIGHEST)
        if not (outside & ~fixed).any():
            break
        change = np.clip(change, _LOWEST, _HIGHEST)
        fixed |= outside
    change = np.clip(change, _LOWEST, _HIGHEST)
    return links.scatter(links.weight * (1.0 + change))


def _totals(links: _Links, capacitance: Array) -> tuple[list[sp.spmatrix], list[Array]]:
    """Rows that make the fields' energies, and the terminals' charges, the capacitances.

    Only for designs with details that the lattice does not resolve. There a body that swallows the
    sensor would take away more energy than there is. Elsewhere the rows gain nothing, and cost
    accuracy at range.
    """
    rows, rhs = [], []
    n = len(capacitance)
    for i in range(n):
        for j in range(n):
            scale = 1.0 / np.sqrt(capacitance[i, i] * capacitance[j, j])
            flux = links.weight * links.drop[:, i]
            parts = [flux * links.leaving[:, j]]
            if j <= i:
                parts.append(flux * links.drop[:, j])
            for part in parts:
                rows.append(sp.csr_matrix(_TOTALS * scale * part))
                rhs.append(_TOTALS * scale * (capacitance[i, j] - part.sum(keepdims=True)))
    if np.abs(rhs).max() <= _TOTALS * _UNRESOLVED:
        return [], []
    return rows, rhs


class _Links:
    """All links and half-links with at least one free end, as flat arrays."""

    def __init__(self, lattice: Lattice, potentials: Array) -> None:
        self._lattice = lattice
        n, cuts = lattice.n_nodes, lattice.cuts
        whole = lattice.weights > 0
        for axis in range(3):
            whole[axis, cuts.node[cuts.axis == axis]] = False
        self._axis, self._node = np.nonzero(whole)
        a, b = self._node, lattice.home[lattice.beyond(self._axis, self._node)]
        w = lattice.weights[self._axis, self._node]
        drop = potentials[a] - potentials[b]
        rows, cols, values = [a, b], [np.arange(len(a))] * 2, [np.ones(len(a)), -np.ones(len(a))]
        weights, drops = [w], [drop]
        n_terminals = potentials.shape[1]
        names = np.arange(n_terminals)
        leaving = [
            (lattice.owner[a][:, None] == names) * 1.0 - (lattice.owner[b][:, None] == names)
        ]
        half = half_link_weights(lattice)
        first = len(a)
        for side, who in enumerate((cuts.lower_owner, cuts.upper_owner)):
            end = lattice.beyond(cuts.axis, cuts.node) if side else cuts.node
            held = np.zeros((len(end), potentials.shape[1]))
            driven = np.flatnonzero(who >= 0)
            held[driven, who[driven]] = 1.0
            rows.append(end)
            cols.append(first + np.arange(len(end)))
            values.append(np.ones(len(end)))
            weights.append(half[:, side])
            drops.append(potentials[end] - held)
            leaving.append((lattice.owner[end][:, None] == names) * 1.0 - held)
            first += len(end)
        self.weight, self.drop = np.concatenate(weights), np.concatenate(drops)
        self.leaving = np.concatenate(leaving)
        """+1 where a link leaves a terminal, −1 where it enters one, shape (links, terminals)."""
        self.incidence = sp.csr_matrix(
            (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))),
            shape=(n, len(self.weight)),
        )
        self._n_whole = len(a)

    def sum_abs(self, flux: Array) -> Array:
        """Sum of |flux| over the links at each node, shape (n,)."""
        return abs(self.incidence) @ np.abs(flux)

    def scatter(self, weight: Array) -> tuple[Array, Array]:
        """Return lattice arrays from the flat list."""
        out = np.zeros_like(self._lattice.weights)
        out[self._axis, self._node] = weight[: self._n_whole]
        n_cuts = len(self._lattice.cuts)
        half = weight[self._n_whole :].reshape(2, n_cuts).T
        return out, np.ascontiguousarray(half)


def half_link_weights(lattice: Lattice) -> Array:
    """Geometric weights [F] of the half-links of crossed links, shape (cuts, 2)."""
    cuts = lattice.cuts
    w = lattice.weights[cuts.axis, cuts.node]
    least = 1e-3
    return np.stack([w / np.maximum(cuts.lower, least), w / np.maximum(cuts.upper, least)], axis=1)
