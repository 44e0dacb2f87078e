"""The step, compiled: conductors near the design as nodes of a network; 4π eps0 = 1.

With conductors at ground or at 1 V, terminals and nodes have one Maxwell matrix. A node that
carries no charge, or is coupled to ground by a capacitance, is eliminated from it.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._dense import padded
from capsense._jit import compiled, kernel
from capsense._simd import SIMD_WIDTH, doubles, integers
from capsense.field.face_kernels import looseness, off_walls, smooth
from capsense.solver.system.system_kernels import System
from capsense.solver.tree.matter import FLOATING_PENALTY

COARSE = 31
"""So many clusters, the coarsest ones, tell how far a body is out of reach."""


@kernel
def _outside(body, space, out):
    """Find how much of a conductor that is not at ground is out of reach.

    Coarse clusters count by their shares of the charge, as far as they are out of reach.

    Args:
        body: The body.
        space: Surroundings of the design.
        out: Filled with the capacitance of that part in free space, and its middle [m], (4,).
    """
    children, charge, center = (
        integers(body.children), doubles(body.charge), doubles(body.center),
    )  # fmt: skip
    for i in range(4):
        out[i] = 0.0
    r, p, s = body.rotation, body.position, body.scale
    for k in range(min(COARSE, 2 * body.n - 1)):
        if 0 <= children[2 * k] < COARSE - 1:  # its parts stand for it
            continue
        x, y, z = center[3 * k], center[3 * k + 1], center[3 * k + 2]
        u = p[0] + s * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z)
        v = p[1] + s * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z)
        w = p[2] + s * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z)
        off, _ = off_walls(u, v, w, body.free, space)
        share = charge[k] * smooth(off)
        out[0] += share
        out[1] += share * u
        out[2] += share * v
        out[3] += share * w
    if out[0] > 0.0:
        for i in range(1, 4):
            out[i] /= out[0]
        out[0] *= s * body.capacitance / charge[0]


@compiled
def outside_capacitance(bodies, group, space):
    """Capacitance in free space of what is out of reach of a conductor not at ground [m].

    Charges on its bodies in proportion to their own capacitances have at least the energy of the
    true ones (Thomson's theorem), so that this is not too large.
    """
    count, charge, energy = bodies.shape[0], 0.0, 0.0
    parts, known = np.empty((count, 4)), 0
    for b in range(count):
        if bodies[b].group == group and bodies[b].free > 0.0:
            part = parts[known]
            _outside(bodies[b], space, part)
            charge += part[0]
            energy += part[0]
            for c in range(known):
                square = least = 0.0
                for i in range(1, 4):
                    square += (part[i] - parts[c, i]) ** 2
                least = max(part[0], parts[c, 0])
                if least > 0.0:
                    energy += 2.0 * part[0] * parts[c, 0] / max(math.sqrt(square), least)
            known += 1
    return charge * charge / energy if energy > 0.0 else 0.0


@compiled
def tie_what_is_outside(bodies, space):
    """Tie conductors that are not at ground by at least what their parts out of reach have in free
    space, and find their looseness, in place.

    A trunk grounds an arm that floats with it by its own capacitance to everything around, whether
    the domain reaches as far or not.
    """
    for b in range(bodies.shape[0]):
        if bodies[b].free > 0.0 and bodies[b].neutral == 0:
            bodies[b].free = looseness(bodies[b].ground_elastance, space)
    for b in range(bodies.shape[0]):
        if bodies[b].free == 0.0:
            continue
        group, first = bodies[b].group, True
        for c in range(b):
            first = first and bodies[c].group != group
        found = outside_capacitance(bodies, group, space) if first else 0.0
        if found * FLOATING_PENALTY > 1.0:
            for c in range(b, bodies.shape[0]):
                body = bodies[c]
                loose = body.neutral != 0 or body.ground_elastance * found > 1.0
                if body.group == group and loose:
                    body.neutral, body.ground_elastance = 0, 1.0 / found


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
    phi = np.zeros((total, padded(terminals + nodes, SIMD_WIDTH)))
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
