"""Layers of dipoles, which stand for the polarisation of a thin sheet across it; 4π eps0 = 1.

A leaf of a layer has a charge q on its front and -q on its back, a thickness t apart. What it meets
of the design and of other bodies is the difference of both faces. The dipoles of one sheet do not
meet each other beyond what each has in itself: an even layer makes no field outside. Its charge
takes 4π t / S of energy on an area S, and 1 / (eps - 1) times that for what polarises it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.solver.placement.placement_kernels import ActiveClusters


@kernel
def charged(leaves, j):
    """Whether a leaf is of charges, not of a layer of dipoles."""
    offset = leaves.offset[j]
    return offset[0] == 0.0 and offset[1] == 0.0 and offset[2] == 0.0


@compiled
def faces_of(leaves):
    """The leaves, those of layers as their front and back, in the same order.

    Returns:
        The faces, and the row of each leaf's first one and the number of all, shape (l + 1,).
    """
    n = leaves.points.shape[0]
    first = np.zeros(n + 1, np.int64)
    for j in range(n):
        first[j + 1] = first[j] + (1 if charged(leaves, j) else 2)
    count = first[n]
    if count == n:
        return leaves, first
    points, true, offset = np.empty((count, 4, 3)), np.empty((count, 4, 3)), np.empty((count, 3))
    extent, soft, beyond = np.empty(count), np.empty(count), np.empty(count)
    owner, within = np.empty(count, np.int64), np.empty(count)
    known, size = np.empty((count, 2), np.int64), np.empty(count)
    for j in range(n):
        for i in range(first[j], first[j + 1]):
            sign = 1.0 - 2.0 * (i - first[j])
            for k in range(3):
                offset[i, k] = leaves.offset[j, k]
                for q in range(4):
                    points[i, q, k] = leaves.points[j, q, k] + sign * offset[i, k]
                    true[i, q, k] = leaves.true[j, q, k] + sign * offset[i, k]
            extent[i], soft[i] = leaves.extent[j], leaves.softening_length[j]
            beyond[i], owner[i] = leaves.outside_fraction[j], leaves.owner[j]
            within[i], size[i] = leaves.self_interaction_weight[j], leaves.size[j]
            known[i, 0], known[i, 1] = leaves.table_rows[j, 0], leaves.table_rows[j, 1]
    faces = ActiveClusters(
        points, true, extent, soft, beyond, owner, within, known, size, offset
    )
    return faces, first


@compiled
def joined_rows(rows, first):
    """Rows of leaves from those of their faces, front less back, (f, w) -> (l, w)."""
    n, width = first.shape[0] - 1, rows.shape[1]
    out = np.empty((n, width), np.float32)
    for j in range(n):
        i = first[j]
        for k in range(width):
            out[j, k] = rows[i, k]
        if first[j + 1] > i + 1:
            for k in range(width):
                out[j, k] -= rows[i + 1, k]
    return out


@compiled
def joined_pairs(pairs, first):
    """Pairs of leaves from those of their faces, (f, f) -> (l, l)."""
    half = joined_rows(pairs, first)
    n = first.shape[0] - 1
    out = np.empty((n, n), np.float32)
    for j in range(n):
        line = half[j]
        for k in range(n):
            out[j, k] = line[first[k]]
            if first[k + 1] > first[k] + 1:
                out[j, k] -= line[first[k] + 1]
    return out


@compiled
def face_charges(charge, first):
    """Charges on faces from those of leaves, (l, m) -> (f, m)."""
    out = np.empty((first[-1], charge.shape[1]))
    for j in range(charge.shape[0]):
        for i in range(first[j], first[j + 1]):
            sign = 1.0 - 2.0 * (i - first[j])
            for k in range(charge.shape[1]):
                out[i, k] = sign * charge[j, k]
    return out
