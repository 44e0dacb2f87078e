"""The twin of the Warp kernels: the same clusters, solved by the core in double precision."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.field.green_kernels import Green
from capsense.solver.gap.gap_kernels import (
    extent_of_body,
    fabric_change,
    local_change,
    move,
    near_bodies,
    press_out,
)
from capsense.solver.gradients.gradient_kernels import jacobian
from capsense.solver.interaction.pair_kernels import LIFTED, bound_images, leaf_pairs
from capsense.solver.packing import PackedBodies, View
from capsense.solver.placement.placement_kernels import leaf_rows, placed
from capsense.solver.selection.selection_kernels import ActiveTree, Functions, functions_of
from capsense.solver.surface_solver import SurfaceSolver
from capsense.solver.system import lossy, step
from capsense.solver.system.network_kernels import (
    as_nodes,
    coarse_of,
    congruent,
    mixed,
    potentials_of,
    with_nodes,
)
from capsense.solver.system.system_kernels import System, assembled, leaf_charges, reduced

Array = NDArray[np.float64]


def _smooth(x: Array) -> Array:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def cut_of(
    green: Green, bodies: NDArray[np.void], trees: list, count: int, favoured: list[Array]
) -> ActiveTree:
    """Clusters by what is largest against its distance from the design, ``count`` for each body.

    What crosses a wall counts as larger, by twice its share of the body's length. Of wide bodies,
    which have more than 12 functions for each cluster, clusters count by the fourth root of s³/d⁴
    for an extent s and a distance d, and four times the share.
    Those that are not split have one function more, which is not solved for, and are represented by
    themselves none the less. Of clusters that are as large to 1e-5, those are split whose functions
    are ``favoured``.
    """
    rows: list[tuple] = []
    leaves: list[int] = []
    for b, (body, tree) in enumerate(zip(bodies, trees, strict=True)):
        center = body["position"] + body["scale"] * tree.center @ body["rotation"].T
        low, high = green.box
        away = np.linalg.norm(np.maximum(np.maximum(low - center, center - high), 0.0), axis=1)
        size = body["scale"] * tree.extent
        need = np.where(tree.children[:, 0] < 0, 0.0, size / (np.maximum(away, 0.5 * size) + 1e-3))
        room = np.minimum(
            (center - green.active_bounds[0]).min(1), (green.active_bounds[1] - center).min(1)
        )
        crossing = _smooth(2.0 - 4.0 * np.abs(room) / (size + 1e-9))
        crossing *= _smooth((size - 0.03) / 0.03) * tree.extent / tree.extent[0]
        wide = (len(tree.extent) + 1) // 2 > 12 * count
        if wide:
            need *= (tree.extent[0] / tree.extent) ** 0.25
        need += np.where(tree.children[:, 0] < 0, 0.0, (4.0 if wide else 2.0) * crossing)
        if favoured:
            need *= 1.0 + 1e-5 * np.isin(tree.function, favoured[b])
        heap, split = [(-need[0], 0)], set()
        while len(heap) < count and heap[0][0] < 0.0:
            _, k = heapq.heappop(heap)
            split.add(k)
            for part in tree.children[k].tolist():
                heapq.heappush(heap, (-need[part], part))
        ends = {k for _, k in heap}
        below = {part for k in ends for part in tree.children[k].tolist() if part >= 0}
        used = sorted(split | ends | below)
        place = {k: len(rows) + i for i, k in enumerate(used)}
        for k in used:
            whole, fade, above = float(k not in split), float(k in split), float(k not in below)
            leaf, children, share = -1, (-1, -1), 0.0
            if k in split or (k in ends and tree.children[k, 0] >= 0):
                x, y = tree.children[k].tolist()
                children, share = (place[x], place[y]), tree.charge[x] / tree.charge[k]
            if k not in split:
                leaf = len(leaves)
                leaves.append(place[k])
            rows.append((b, k, *children, share, leaf, whole, fade, above))
    body, node, first, second, share, leaf, whole, fade, above = (
        np.array(c) for c in zip(*rows, strict=True)
    )
    children = np.stack([first, second], axis=1)
    parts = (1.0 - whole)[:, None] * np.stack([share, 1.0 - share], axis=1)
    there = np.ones(len(node))
    return ActiveTree(
        body, node, children, share, parts, leaf, whole, fade, above, there, np.array(leaves)
    )


def _add_barrier(cut: ActiveTree, functions: Functions, system: System, barrier: Array) -> None:
    """Add the energy of charge that is out of reach; with pairs, in single precision, it would hide
    1e-3 of a matrix."""
    total, n = len(system.diagonal), functions.solved
    on = leaf_charges(cut, functions, np.eye(total), len(barrier)).T
    energy = (on * barrier) @ on.T
    system.matrix[:] += energy[:n, :n]
    system.rest[:] += energy[n:, :n]
    system.diagonal[:] += np.diag(energy)


@contextmanager
def same_functions(count: int) -> Iterator[list[Array]]:
    """Let solvers take the charge functions that a fleet on Warp takes, ``count`` for each body.

    Yields:
        A list for the numbers of the functions of each body that are taken where two clusters are
        equally large.
    """
    shapes: list = []
    favoured: list[Array] = []
    pack = SurfaceSolver.pack

    def packed(solver: SurfaceSolver, view: View, time: float | None = None) -> PackedBodies:
        out = pack(solver, view, time)
        shapes[:] = out.shapes
        return out

    def prepared(bodies: NDArray[np.void], green: Green, *_: float) -> tuple:
        cut = cut_of(green, bodies, [shape.tree for shape in shapes], count, favoured)
        leaves = placed(bodies, cut, green)
        rows = leaf_rows(leaves.points, leaves.outside_fraction, green)
        functions = functions_of(bodies, cut, leaves.outside_fraction)
        inside = leaves._replace(barrier=np.zeros_like(leaves.barrier))
        pairs = leaf_pairs(inside, green.floor)
        bound_images(leaves, rows, pairs, green)
        system = assembled(bodies, cut, functions, rows, pairs, green.phi_columns)
        for f in range(functions.solved, len(system.diagonal)):
            body, x = bodies[functions.body[f]], functions.number[f]
            shape = shapes[functions.body[f]]
            own = shape.potential_coefficients[x, x]
            if body["neumann_to_dirichlet"] != 0:
                own = own + body["inverse_susceptibility"] * shape.neumann_to_dirichlet[x, x]
            system.diagonal[f] = own / body["scale"]
        _add_barrier(cut, functions, system, leaves.barrier)
        return cut, leaves, functions, system

    def solve(bodies: NDArray[np.void], green: Green, *others: float) -> step.Solution:
        near, fabric = near_bodies(bodies, green, False), np.zeros((green.terminals,) * 2)
        fabric_change(bodies, green, fabric)
        if near.any():
            bodies = bodies.copy()
            press_out(bodies, near, green)
        m, nodes, node, capacitance = as_nodes(bodies, near, green)
        cut, leaves, functions, system = prepared(bodies, green)
        if nodes > 0:
            system = with_nodes(system, functions, node, m, nodes)
        delta, left, coarse, x, shift = reduced(functions, system, True)
        charge = leaf_charges(cut, functions, x, len(leaves.points))
        weights = np.zeros((m, m))
        if near.any():
            local_change(bodies, near, node, green, delta)
            weights = potentials_of(delta, m, nodes, capacitance)
            delta = congruent(weights, delta, capacitance)
            left = congruent(weights, left, np.zeros(0))
            charge, coarse = mixed(charge, weights, green.phi_columns), coarse_of(coarse, weights)
        return step.Solution(
            delta[:m, :m] + fabric,
            left[:m, :m],
            coarse[:m],
            charge,
            leaves.points,
            leaves.extent,
            leaves.softening_length,
            leaves.owner,
            functions.solved,
            shift,
            step.estimate(delta, left, coarse[:m], shift, green.electrodes),
            near,
            node,
            weights,
        )

    def slopes(
        solution: step.Solution, bodies: NDArray[np.void], green: Green, *others: float
    ) -> NDArray[np.float64]:
        out, moved = jacobian(solution, bodies, green), bodies.copy()
        leaves = prepared(bodies, green)[1]
        moves = np.abs(leaves.points - leaves.true).max(axis=(1, 2)) > LIFTED
        lifted = solution.near | (np.bincount(leaves.owner, moves, len(bodies)) > 0)
        for b, r in np.ndindex(len(bodies), 6):
            if lifted[b]:
                length = step.DIFFERENCE * green.gap.validity
                length /= 1.0 if r < 3 else max(extent_of_body(bodies[b]), green.gap.validity)
                ends = []
                for sign in (1, -1):
                    move(moved[b], bodies[b], r, sign * length)
                    ends.append(solve(moved, green).delta)
                move(moved[b], bodies[b], 0, 0.0)
                out[b, ..., r] = (ends[0] - ends[1]) / (2.0 * length)
        return out

    with (
        patch.object(SurfaceSolver, "pack", packed),
        patch("capsense.solver.surface_solver.slopes_of", slopes),
        patch("capsense.solver.surface_solver.solve", solve),
        patch.object(lossy, "prepared", prepared),
    ):
        yield favoured


def twin_of(fleet: cs.Fleet) -> cs.Simulator:
    """A simulator with the shapes of a fleet; use it within :func:`same_functions`.

    Fleets on Warp do without the middle one of the Green's function's representations.
    """
    simulator = cs.Simulator(fleet.design)
    simulator._solver = copy(fleet._solver)
    green = simulator._solver.green
    (near, _, far), (_, start) = green.levels, green.blends
    simulator._solver.green = green._replace(
        levels=(near, far, far), blends=np.array([start, start + 1.0])
    )
    usual = simulator._solver.functions_of
    simulator._solver.functions_of = lambda shape, conducting, share=1.0: usual(
        shape, conducting, share * fleet.table.share(shape)
    )
    return simulator
