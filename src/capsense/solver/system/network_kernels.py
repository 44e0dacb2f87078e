"""The step, compiled: conductors near the design as nodes of a network; 4π eps0 = 1.

With conductors at ground or at 1 V, terminals and nodes have one Maxwell matrix. A node that
carries no charge, or is coupled to ground by a capacitance, is eliminated from it.
"""

from __future__ import annotations

import numpy as np

from capsense._dense import WIDTH, padded
from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.face_kernels import off_walls, smooth
from capsense.solver.system.system_kernels import System
from capsense.solver.tree.matter import FLOATING_PENALTY

COARSE = 31
"""So many clusters, the coarsest ones, tell how far a body is out of reach."""


@kernel
def outside_capacitance(body, space):
    """Capacitance in free space of what is out of reach of a conductor that is not at ground [m].

    Coarse clusters count by their shares of the charge, as far as they are out of reach.
    """
    if body.free == 0:
        return 0.0
    children, charge, center = (
        integers(body.children), doubles(body.charge), doubles(body.center),
    )  # fmt: skip
    outside, r, p, s = 0.0, body.rotation, body.position, body.scale
    for k in range(min(COARSE, 2 * body.n - 1)):
        if 0 <= children[2 * k] < COARSE - 1:  # its parts stand for it
            continue
        x, y, z = center[3 * k], center[3 * k + 1], center[3 * k + 2]
        off, _ = off_walls(
            p[0] + s * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z),
            p[1] + s * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z),
            p[2] + s * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z),
            body.free, space,
        )  # fmt: skip
        outside += charge[k] * smooth(off)
    return s * body.capacitance * outside / charge[0]


@compiled
def tie_what_is_outside(bodies, space):
    """Tie conductors that are not at ground by at least what their parts out of reach have in free
    space, in place.

    A trunk grounds an arm that floats with it by its own capacitance to everything around, whether
    the domain reaches as far or not.
    """
    count = bodies.shape[0]
    found = np.zeros(count)
    for b in range(count):
        capacitance = outside_capacitance(bodies[b], space)
        for c in range(count):
            if bodies[c].group == bodies[b].group:
                found[c] += capacitance
    for b in range(count):
        if found[b] * FLOATING_PENALTY > 1.0:
            body = bodies[b]
            if body.neutral != 0 or body.ground_elastance * found[b] > 1.0:
                body.neutral, body.ground_elastance = 0, 1.0 / found[b]


@kernel
def is_tied_by_what_is_outside(bodies, b, space):
    """Whether the conductor of a body has the tie that :func:`tie_what_is_outside` gives it."""
    total = 0.0
    for c in range(bodies.shape[0]):
        if bodies[c].group == bodies[b].group:
            total += outside_capacitance(bodies[c], space)
    return total > 0.0 and abs(bodies[b].ground_elastance * total - 1.0) < 1e-9


@compiled
def any_tied(bodies):
    """Whether a body is tied to the local ground."""
    tied = False
    for b in range(bodies.shape[0]):
        tied = tied or bodies[b].local_tie > 0.0
    return tied


@compiled
def as_nodes(bodies, near, green):
    """Make conductors nodes that are not at ground and near, or tied to the local ground.

    Their records change to such at ground. Of conductors that touch, all become one node if one of
    them is one.

    Returns:
        How many terminals and nodes there are; the row of each body that is a node, else -1, (b,);
        and the capacitance of each node to ground [m].
    """
    count, nodes = bodies.shape[0], 0
    node, group = np.full(count, -1), np.full(count, -1)
    capacitance = np.zeros(count)
    for b in range(count):
        body = bodies[b]
        free = body.neutral != 0 or body.ground_elastance > 0.0
        if free and (near[b] or body.local_tie > 0.0) and group[body.group] < 0:
            group[body.group] = green.terminals + nodes
            if body.neutral == 0 and body.ground_elastance < 0.5 * FLOATING_PENALTY:
                capacitance[nodes] = 1.0 / body.ground_elastance
            nodes += 1
    if nodes > 0:
        for b in range(count):
            node[b] = group[bodies[b].group]
            if node[b] >= 0:
                bodies[b].neutral, bodies[b].ground_elastance = 0, 0.0
    return green.terminals, nodes, node, capacitance[:nodes]


@compiled
def add_ties(bodies, node, local, matrix):
    """Add the capacitances of conductors to the local ground to the matrix of terminals and nodes.

    That of a conductor at earth ties the local ground to earth.
    """
    for b in range(bodies.shape[0]):
        tie = bodies[b].local_tie
        for a in range(b):  # conductors that touch have one tie
            if bodies[a].group == bodies[b].group:
                tie = 0.0
        if tie > 0.0:
            matrix[local, local] += tie
            row = node[b]
            if row >= 0:
                matrix[row, row] += tie
                matrix[row, local] -= tie
                matrix[local, row] -= tie


@compiled
def with_nodes(system, functions, node, terminals, nodes):
    """Give a system a right-hand side for each node at 1 V, behind those of the terminals."""
    total = system.phi.shape[0]
    phi = np.zeros((total, padded(terminals + nodes, WIDTH)))
    for f in range(total):
        for i in range(terminals):
            phi[f, i] = system.phi[f, i]
        if functions.net[f] and node[functions.body[f]] >= 0:
            phi[f, node[functions.body[f]]] = -1.0
    return System(phi, system.matrix, system.rest, system.diagonal)


@compiled
def potentials_of(matrix, terminals, nodes, capacitance):
    """Potentials of terminals and nodes for each terminal at 1 V, from their Maxwell matrix [m].

    Shape (terminals + nodes, terminals): those of the terminals are 0 and 1.
    """
    out = np.zeros((terminals + nodes, terminals))
    own, side = np.empty((nodes, nodes)), np.empty((nodes, terminals))
    for i in range(terminals):
        out[i, i] = 1.0
    for a in range(nodes):
        for b in range(nodes):
            own[a, b] = matrix[terminals + a, terminals + b]
        own[a, a] += capacitance[a]
        for i in range(terminals):
            side[a, i] = -matrix[terminals + a, i]
    for k in range(nodes):  # few and definite: elimination without pivots
        for a in range(k + 1, nodes):
            share = own[a, k] / own[k, k] if own[k, k] > 0.0 else 0.0
            for b in range(k, nodes):
                own[a, b] -= share * own[k, b]
            for i in range(terminals):
                side[a, i] -= share * side[k, i]
    for k in range(nodes - 1, -1, -1):
        for i in range(terminals):
            value = side[k, i]
            for b in range(k + 1, nodes):
                value -= own[k, b] * out[terminals + b, i]
            # nothing of a node may be within reach
            out[terminals + k, i] = value / own[k, k] if own[k, k] > 0.0 else 0.0
    return out


@compiled
def congruent(weights, matrix, capacitance):
    """Reduce a matrix of terminals and nodes to the terminals by their potentials W: W' (M + C) W.

    ``capacitance`` of the nodes to ground [m] adds to the diagonal; give none for an estimate.
    """
    size, m = weights.shape
    half, out = np.zeros((size, m)), np.zeros((m, m))
    for a in range(size):
        for i in range(m):
            value = 0.0
            for b in range(size):
                value += matrix[a, b] * weights[b, i]
            k = a - m
            if 0 <= k < capacitance.shape[0]:
                value += capacitance[k] * weights[a, i]
            half[a, i] = value
    for i in range(m):
        for j in range(i + 1):
            value = 0.0
            for a in range(size):
                value += weights[a, i] * half[a, j]
            out[i, j] = out[j, i] = value
    return out


@compiled
def mixed(charge, weights, phi_columns):
    """Charges (l, k) with terminals and nodes at 1 V, reduced to the terminals, (l, lead)."""
    size, m = weights.shape
    out = np.zeros((charge.shape[0], phi_columns))
    for f in range(charge.shape[0]):
        for i in range(m):
            value = charge[f, i]
            for a in range(m, size):
                value += charge[f, a] * weights[a, i]
            out[f, i] = value
    return out


@compiled
def coarse_of(coarse, weights):
    """Squares of amplitudes (k,) of terminals and nodes, reduced to a bound of the terminals'."""
    size, m = weights.shape
    out = np.zeros(m)
    for i in range(m):
        value = 0.0
        for a in range(size):
            value += np.sqrt(coarse[a]) * abs(weights[a, i])
        out[i] = value * value
    return out
