"""The step: from bodies to the change of the matrix and the charges behind it; 4π eps0 = 1.

Compiled in one piece, so that threads do not wait for each other between its stages.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.field.green import GreenFunction
from capsense.field.green_kernels import Green
from capsense.solver.gap.body_gap_kernels import (
    Facing,
    add_between,
    facing_of,
    hold_apart,
    mark,
    slenderness,
)
from capsense.solver.gap.gap_kernels import (
    extent_of_body,
    fabric_change,
    local_change,
    move,
    near_bodies,
    press_out,
)
from capsense.solver.gap.series_kernels import difference, in_series
from capsense.solver.gradients.gradient_kernels import jacobian
from capsense.solver.interaction.layer_kernels import (
    face_charges,
    faces_of,
    fine_layers,
    joined_pairs,
    joined_rows,
)
from capsense.solver.interaction.pair_kernels import bound_images, leaf_pairs
from capsense.solver.interaction.subpanel_kernels import add_parts
from capsense.solver.placement.placement_kernels import ActiveClusters, leaf_rows, placed
from capsense.solver.placement.truncation_kernels import truncate_to_domain
from capsense.solver.selection.selection_kernels import ActiveTree, Functions, chosen, functions_of
from capsense.solver.system.network_kernels import (
    add_ties,
    any_tied,
    as_nodes,
    coarse_of,
    congruent,
    mixed,
    outside_capacitance,
    potentials_of,
    with_nodes,
)
from capsense.solver.system.system_kernels import (
    System,
    assembled,
    leaf_charges,
    part_of,
    reduced,
)

DIFFERENCE = 3e-3
"""Step of central differences, over the validity distance."""
SERIES = 0.1
"""Assumed relative error of what near dielectrics add."""
FIELD_ERROR = 0.015
"""Assumed relative error of what bodies change, of the Green's function and of panels of which no
function tells. Green's functions hold to 2 % (``gap_table``)."""


class Solution(NamedTuple):
    """What a scene does to a design; 4π eps0 = 1."""

    delta: NDArray[Any]
    """Change of the Maxwell matrix [m], shape (m, m); complex where matter has losses."""
    residual_correction: NDArray[Any]
    """The part of it due to functions outside the system [m], shape (m, m)."""
    discretization_error: NDArray[Any]
    """Estimate of what panels are too coarse for, and of the gap law's error, of its diagonal [m],
    shape (m,)."""
    charge: NDArray[Any]
    """Charge on each leaf for each terminal at 1 V [m], shape (l, m)."""
    points: NDArray[Any]
    """Four points of each leaf [m], shape (l, 4, 3)."""
    extent: NDArray[Any]
    """Extent of each leaf [m], shape (l,)."""
    softening_length: NDArray[Any]
    """Distance below which 1/r from its points is bounded [m], shape (l,)."""
    owner: NDArray[Any]
    """Body of each leaf, shape (l,)."""
    size: int
    """Functions solved for."""
    shift: float
    """What was added to the diagonal to make the matrix definite, relative; 0 in good scenes, and
    -1 where there is no solution, and ``delta`` is not finite."""
    error: float
    """See :func:`estimate` [m]."""
    near: NDArray[Any]
    """Bodies that the gap law applies to, shape (b,)."""
    node: NDArray[Any]
    """Row of each body that is a node of the network, -1 for others, shape (b,)."""
    weights: NDArray[Any]
    """Potentials of terminals and nodes for each terminal at 1 V, (t, m); zero if none is near."""


@compiled
def prepared(
    bodies: NDArray[np.void],
    green: Green,
    threshold: float,
    width: float,
    facing: Facing,
    scored: NDArray[np.void],
) -> tuple[ActiveTree, ActiveClusters, Functions, System]:
    """Choose charge functions, and set up their system.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        green: Green's function of the design.
        threshold: Functions count that take up this part of an electrode's energy alone.
        width: They fade in up to so many times that.
        facing: Conductors that are near each other.
        scored: The records that functions are chosen by.

    Returns:
        The cut, its leaves, its functions and their system.
    """
    cut = chosen(scored, green, threshold, width, facing)
    leaves = placed(bodies, cut, green)
    hold_apart(bodies, facing, leaves, green)
    cut, leaves = truncate_to_domain(cut, leaves)
    faces, first = faces_of(leaves)
    rows = leaf_rows(faces.points, faces.outside_fraction, green)
    pairs = leaf_pairs(faces, green.floor)
    if first[-1] > leaves.points.shape[0]:
        rows, pairs = joined_rows(rows, first), joined_pairs(pairs, first)
    add_parts(bodies, cut, leaves, pairs)
    bound_images(leaves, rows, pairs, green)
    functions = functions_of(bodies, cut, leaves.outside_fraction)
    return cut, leaves, functions, assembled(bodies, cut, functions, rows, pairs, green.phi_columns)


@kernel
def estimate(
    delta: NDArray[Any], left: NDArray[Any], coarse: NDArray[Any], shift: float, electrodes: int
) -> float:
    """Estimated error of the largest entry of the electrodes' rows [m].

    Their columns for shields and floating conductors of the design count, the rows of these do not:
    a shield changes by far more than what it couples to. Where bodies lie within each other or
    within the sensor so that the matrix had to be changed, it is all of the largest diagonal.

    Args:
        delta, left, coarse, shift: As in :class:`Solution`; real.
        electrodes: How many of the terminals are electrodes, the first ones.
    """
    out = 0.0
    for i in range(electrodes):
        if shift > 0.0:
            out = max(out, abs(delta[i, i]))
            continue
        out = max(out, abs(left[i, i]) + coarse[i] + FIELD_ERROR * abs(delta[i, i]))
        for j in range(electrodes, coarse.shape[0]):
            out = max(out, abs(left[i, j]))
    return out


@compiled
def solve(
    bodies: NDArray[np.void], green: Green, threshold: float, width: float, adjoint: bool
) -> Solution:
    """Solve a scene of bodies without losses.

    ``adjoint`` asks for charges that the derivatives of the result follow from; else as
    :func:`prepared`.
    """
    found = _solve(bodies, green, threshold, width, adjoint)
    fabric_change(bodies, green, found.delta)
    return found


@compiled
def _solve(
    bodies: NDArray[np.void], green: Green, threshold: float, width: float, adjoint: bool
) -> Solution:
    """As :func:`solve`, but for a fabric on the cover."""
    soft = near_bodies(bodies, green, np.bool_(True))
    if not soft.any():
        return solve_lifted(bodies, soft, green, threshold, width, adjoint).solution
    bodies = bodies.copy()
    press_out(bodies, soft, green)
    found, own, _ = solve_lifted(bodies, soft, green, threshold, width, adjoint)
    stiff = only(bodies, soft)
    for b in range(stiff.shape[0]):
        stiff[b].inverse_susceptibility = 0.0
    low, high = conductors_of(stiff, green, threshold, width)
    change, doubt = difference(in_series(own, low, high), own), 0.0
    for i in range(green.terminals):
        for j in range(green.terminals):
            found.delta[i, j] += change[i, j]
        if i < green.electrodes:
            doubt = max(doubt, SERIES * abs(change[i, i]))
    return Solution(
        found.delta,
        found.residual_correction,
        found.discretization_error,
        found.charge,
        found.points,
        found.extent,
        found.softening_length,
        found.owner,
        found.size,
        found.shift,
        found.error + doubt,
        found.near | soft,
        found.node,
        found.weights,
    )


@compiled
def conductors_of(
    bodies: NDArray[np.void], green: Green, threshold: float, width: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Change of the Maxwell matrix [m] by conductors: lifted ones, and by the gap law, (m, m)."""
    none, plain = np.zeros(bodies.shape[0], np.bool_), np.bool_(False)
    found = solve_lifted(bodies, none, green, threshold, width, plain)
    return found.lifted, found.solution.delta


@compiled
def only(bodies: NDArray[np.void], wanted: NDArray[np.bool_]) -> NDArray[np.void]:
    """Some bodies, by themselves: what a lift changes of near dielectrics is local."""
    out, first, count = bodies.copy(), np.full(bodies.shape[0], -1), 0
    for b in range(bodies.shape[0]):
        if wanted[b]:
            out[count] = bodies[b]
            if first[bodies[b].group] < 0:
                first[bodies[b].group] = count
            out[count].group = first[bodies[b].group]
            count += 1
    return out[:count]


class Lifted(NamedTuple):
    """What a scene does in which nothing is added to near dielectrics of what the lift removes."""

    solution: Solution
    """Conductors are by the gap law."""
    own: NDArray[Any]
    """Change of the Maxwell matrix by some of the bodies by themselves [m], shape (m, m)."""
    lifted: NDArray[Any]
    """Change of it by all where nothing is added to conductors, either [m], shape (m, m)."""


@compiled
def solve_lifted(
    bodies: NDArray[np.void],
    some: NDArray[np.bool_],
    green: Green,
    threshold: float,
    width: float,
    adjoint: bool,
) -> Lifted:
    """As :func:`solve`, of bodies where the lift has them, for :class:`Lifted`.

    ``some`` are the bodies whose own change is asked for, shape (b,); none of them is a node.
    """
    near, facing = near_bodies(bodies, green, np.bool_(False)), facing_of(bodies)
    placed_as, scored, lifted, tied = bodies, bodies, near.copy(), any_tied(bodies)
    if near.any() or facing.pairs > 0 or tied:
        bodies = bodies.copy()  # what follows changes them
        press_out(bodies, near, green)
    if facing.pairs > 0:
        scored = bodies.copy()
        as_nodes(scored, near, green)
        mark(facing, near)
    m, nodes, node, capacitance = as_nodes(bodies, near, green)
    if facing.pairs == 0:
        scored = bodies
    cut, leaves, functions, system = prepared(bodies, green, threshold, width, facing, scored)
    fine = fine_layers(bodies, functions, system.phi, green)
    own = np.zeros((m, m))
    if some.any():
        few, theirs = part_of(functions, system, some)
        part = reduced(few, theirs, np.bool_(False)).delta
        for i in range(m):
            for j in range(m):
                own[i, j] = part[i, j]
    if nodes > 0:
        system = with_nodes(system, functions, node, m, nodes)
    delta, left, coarse, x, shift = reduced(functions, system, adjoint)
    charge = leaf_charges(cut, functions, x, leaves.points.shape[0])
    leaves, first = faces_of(leaves)
    charge = face_charges(charge, first)
    weights, doubt, plain = np.zeros((m, m)), 0.0, delta
    if near.any() or tied:
        add_between(placed_as, facing, node, delta)
        add_ties(bodies, node, green.local, delta)
        plain = delta.copy()
        local_change(bodies, lifted, node, green, delta)
        before = potentials_of(plain, m, nodes, capacitance)
        plain = congruent(before, plain, capacitance)
        weights = potentials_of(delta, m, nodes, capacitance)
        delta, left = congruent(weights, delta, capacitance), congruent(weights, left, np.zeros(0))
        charge, coarse = mixed(charge, weights, green.phi_columns), coarse_of(coarse, weights)
        thin = slenderness(bodies, lifted, green.gap.validity)
        if thin > 0.0:  # the local change is that by a plane in front of the design
            for i in range(green.electrodes):
                doubt = max(doubt, thin * abs(delta[i, i] - plain[i, i]))
    for b in range(bodies.shape[0]):
        if bodies[b].layer > 0.0:
            part = 1.0 / (1.0 + bodies[b].inverse_susceptibility)
            for i in range(m):
                for j in range(m):
                    delta[i, j] += part * fine[b, i, j]
                    left[i, j] += SERIES * part * fine[b, i, j]
    error = estimate(delta, left, coarse[:m], shift, green.electrodes) + doubt
    solution = Solution(
        delta[:m, :m],
        left[:m, :m],
        coarse[:m],
        charge,
        leaves.points,
        leaves.extent,
        leaves.softening_length,
        leaves.owner,
        functions.solved,
        shift,
        error,
        near,
        node,
        weights,
    )
    return Lifted(solution, own, plain[:m, :m].copy())


@compiled
def _add_outside_slopes(
    solution: Solution, bodies: NDArray[np.void], green: Green, out: NDArray[Any]
) -> None:
    """Add how conductors not at ground are tied to it as their parts come into reach or leave.

    A capacitance C to ground of a conductor at the potential V_i changes ΔC_ij by V_i V_j dC.
    """
    m, moved = green.terminals, bodies.copy()
    potential = np.empty(m)
    for b in range(bodies.shape[0]):
        body = bodies[b]
        outside = 0.0
        if body.free > 0.0:
            outside = outside_capacitance(bodies, body.group, green.space)
        if outside == 0.0 or abs(body.ground_elastance * outside - 1.0) > 1e-9:
            continue  # it has another tie
        if solution.node[b] >= 0:
            for i in range(m):
                potential[i] = solution.weights[solution.node[b], i]
        else:
            potential[:] = 0.0
            for j in range(solution.owner.shape[0]):
                if bodies[solution.owner[j]].group == body.group:
                    for i in range(m):
                        potential[i] += body.ground_elastance * solution.charge[j, i]
        arm = max(extent_of_body(body), green.gap.validity)
        for r in range(6):
            step = DIFFERENCE * green.gap.validity / (1.0 if r < 3 else arm)
            move(moved[b], body, r, step)
            change = outside_capacitance(moved, body.group, green.space)
            move(moved[b], body, r, -step)
            change -= outside_capacitance(moved, body.group, green.space)
            for i in range(m):
                for j in range(m):
                    out[b, i, j, r] += 0.5 * change / step * potential[i] * potential[j]
        move(moved[b], body, 0, 0.0)


@compiled
def slopes_of(
    solution: Solution, bodies: NDArray[np.void], green: Green, threshold: float, width: float
) -> NDArray[Any]:
    """How the Maxwell matrix changes with the pose of each body, as ``gradient_kernels.jacobian``.

    Bodies near the design are lifted, and pressed out of it. What that changes is not in the
    adjoint, so that their slopes are central differences of the step itself, 12 more of it; so are
    those of layers of dipoles.
    """
    out, m = jacobian(solution, bodies, green), green.terminals
    moved = bodies.copy()
    for b in range(bodies.shape[0]):
        if not solution.near[b] and bodies[b].layer == 0.0:
            continue
        step = DIFFERENCE * green.gap.validity
        arm = max(extent_of_body(bodies[b]), green.gap.validity)
        for r in range(6):
            delta = step if r < 3 else step / arm
            move(moved[b], bodies[b], r, delta)
            after = solve(moved, green, threshold, width, np.bool_(False)).delta
            move(moved[b], bodies[b], r, -delta)
            before = solve(moved, green, threshold, width, np.bool_(False)).delta
            for i in range(m):
                for j in range(m):
                    out[b, i, j, r] = (after[i, j] - before[i, j]) / (2.0 * delta)
        move(moved[b], bodies[b], 0, 0.0)
    _add_outside_slopes(solution, bodies, green, out)
    return out


@compiled
def solve_each(
    bodies: NDArray[np.void], first: NDArray[np.int64], green: Green, threshold: float, width: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int64]]:
    """Solve k scenes without losses, one after another.

    Args:
        bodies: Records of all, scene after scene.
        first: First body of each scene, and their number, shape (k + 1,).
        green, threshold, width: As in :func:`prepared`.

    Returns:
        Changes of the Maxwell matrix [m], (k, m, m), not finite where there is no solution; their
        :func:`estimate` [m], (k,); and the functions solved for, (k,).
    """
    k, m = first.shape[0] - 1, green.terminals
    delta, error, size = np.zeros((k, m, m)), np.zeros(k), np.zeros(k, np.int64)
    for scene in range(k):
        if first[scene] < first[scene + 1]:
            part = bodies[first[scene] : first[scene + 1]]
            found = solve(part, green, threshold, width, np.bool_(False))
            size[scene], error[scene] = found.size, found.error
            for i in range(m):
                for j in range(m):
                    delta[scene, i, j] = found.delta[i, j]
    return delta, error, size


Array = NDArray[np.float64]

_PART = 2000
"""Points at a time."""


def potential_change(green: GreenFunction, solution: Solution, points: Array) -> Array:
    """What bodies change in the terminals' potentials at points [V], (n, 3) -> (n, terminals).

    A terminal is at 1 V in its own column; bodies that float take the potential they get.
    """
    charge = solution.charge[:, : green.near_phi.shape[1]]
    leaves = solution.points.reshape(-1, 3)
    spread = np.repeat(0.25 * charge, 4, axis=0)
    modes = green.psi(leaves).T @ spread
    image = leaves * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * green.floor]
    least = np.repeat(0.3 * solution.extent, 4)  # no point of the surface is nearer than that
    out = np.empty((len(points), charge.shape[1]))
    for k in range(0, len(points), _PART):
        some = points[k : k + _PART]
        inverse = 1.0 / np.maximum(_distances(some, leaves), least)
        inverse -= 1.0 / np.maximum(_distances(some, image), least)
        out[k : k + _PART] = green.psi(some) @ modes - inverse @ spread
    return out


def _distances(p: Array, q: Array) -> Array:
    square = (p**2).sum(1)[:, None] + (q**2).sum(1) - 2 * p @ q.T
    return np.sqrt(np.maximum(square, 0.0))
