"""The twin of the Warp kernels: the same clusters, solved by the core in double precision."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.elements.matter import UNIT
from capsense.elements.rigid import INSIDE
from capsense.surface.choose_kernels import Cut
from capsense.surface.leaf_kernels import leaf_rows, placed
from capsense.surface.pair_kernels import leaf_pairs
from capsense.surface.solve_kernels import assembled, functions_of, reduced
from capsense.surface.solver import SurfaceSolver

Array = NDArray[np.float64]


def cut_of(solver: SurfaceSolver, bodies: NDArray[np.void], trees: list, count: int) -> Cut:
    """Clusters by what is largest against its distance from the design, ``count`` for each body."""
    rows: list[tuple] = []
    leaves: list[int] = []
    for b, (body, tree) in enumerate(zip(bodies, trees, strict=True)):
        center = body["position"] + body["scale"] * tree.center @ body["rotation"].T
        low, high = solver.green.box
        away = np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0), axis=1)
        size = body["scale"] * tree.extent
        need = np.where(tree.kids[:, 0] < 0, 0.0, size / (np.maximum(away, 0.5 * size) + 1e-3))
        heap, split = [(-need[0], 0)], set()
        while len(heap) < count and heap[0][0] < 0.0:
            _, k = heapq.heappop(heap)
            split.add(k)
            for part in tree.kids[k].tolist():
                heapq.heappush(heap, (-need[part], part))
        used = sorted(split | {part for _, part in heap})
        place = {k: len(rows) + i for i, k in enumerate(used)}
        for k in used:
            if k in split:
                x, y = tree.kids[k].tolist()
                rows.append((b, k, place[x], place[y], tree.charge[x] / tree.charge[k], -1))
            else:
                rows.append((b, k, -1, -1, 0.0, len(leaves)))
                leaves.append(place[k])
    body, node, first, second, share, leaf = (np.array(c) for c in zip(*rows, strict=True))
    kids = np.stack([first, second], axis=1)
    whole = np.ones(len(rows))
    return Cut(body, node, kids, share, leaf, whole, whole.copy(), np.array(leaves))


def change_by_clusters(solver: SurfaceSolver, scene: cs.Scene, count: int) -> Array:
    """Change of the matrix of all terminals [F]."""
    packed, green = solver.pack(solver.look(scene)), solver.green
    if not len(packed.records):
        return np.zeros((green.terminals, green.terminals))
    cut = cut_of(solver, packed.records, [s.tree for s in packed.shapes], count)
    leaves = placed(packed.records, cut, green, INSIDE)
    rows = leaf_rows(leaves.points, leaves.beyond, green)
    pairs = leaf_pairs(leaves, green.floor)
    functions = functions_of(packed.records, cut)
    system = assembled(packed.records, cut, functions, rows, pairs, green.lead)
    return UNIT * reduced(cut, functions, system, False)[0][: green.terminals, : green.terminals]
