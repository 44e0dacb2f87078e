"""Layers of dipoles, which stand for the polarisation of a thin sheet across it; 4π eps0 = 1.

A leaf of a layer has a charge q on its front and -q on its back, a thickness t apart. What it meets
of the design and of other bodies is the difference of both faces. The dipoles of one sheet do not
meet each other beyond what each has in itself: an even layer makes no field outside. Its charge
takes 4π t / S of energy on an area S, and 1 / (eps - 1) times that for what polarises it. Charge
functions of different clusters thus have no energy between them, and each that is left out lacks
what it takes from the field alone: :func:`fine_layers` adds that of all of them.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import compiled, kernel
from capsense._simd import doubles
from capsense.field.face_kernels import keep_off, off_walls, smooth
from capsense.solver.placement.placement_kernels import ActiveClusters
from capsense.solver.selection.evaluation_kernels import far_potentials

GAIN = 1.3
"""Weight of the functions directly below the cut, see ``system_kernels.GAIN``."""
_ARM = 0.2
"""Fields across a piece are differences over so much of its width, or its thickness."""


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
    barrier = np.empty(count)
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
            barrier[i] = leaves.barrier[j]
    faces = ActiveClusters(
        points, true, extent, soft, beyond, owner, within, known, size, offset, barrier
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


@compiled
def fine_layers(bodies, functions, phi, green):
    """What functions of layers outside of the system add, in the field of the design alone.

    It is the integral of t (1 - 1/eps) E_i E_j / (4π) over each sheet, E_i the field across it with
    terminal i at 1 V, less what the functions have of that which the system and its estimate hold.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        functions: The charge functions.
        phi: φ⁰ of these, shape (f, lead).
        green: Green's function of the design.

    Returns:
        The change of the Maxwell matrix times eps / (eps - 1) [m], shape (b, m, m).
    """
    m = green.terminals
    out = np.zeros((bodies.shape[0], m, m))
    for b in range(bodies.shape[0]):
        body = bodies[b]
        if body.layer == 0.0:
            continue
        own = doubles(body.own)
        for f in range(functions.body.shape[0]):
            if functions.body[f] != b:
                continue
            fade, above = functions.fade[f], functions.parent_fade[f]
            weight = fade + GAIN * (1.0 - fade) * (1.0 - (1.0 - above) ** 4)
            weight *= body.scale / own[functions.number[f]]
            for i in range(m):
                for j in range(i + 1):
                    out[b, i, j] -= weight * phi[f, i] * phi[f, j]
        _add_pieces(body, green, out[b])
        for i in range(m):
            for j in range(i):
                out[b, j, i] = out[b, i, j]
    return out


@compiled
def _add_pieces(body, green, out):
    """Add the integral over a sheet, from three points of each piece; the lower half, (m, m)."""
    count, space, pieces = 3 * body.n, green.space, doubles(body.pieces)
    front, back = np.empty((count, 3), np.float32), np.empty((count, 3), np.float32)
    weight, inner, rows = np.zeros(count), np.empty(count), np.empty(count, np.int64)
    point, normal, found = np.empty((1, 3)), np.empty(3), 0
    for c in range(count):
        o, q = 13 * (c // 3), 3 * (c % 3)
        area = pieces[o + 12] * body.scale * body.scale
        arm = max(body.layer * body.scale, _ARM * math.sqrt(area))
        for i in range(3):
            point[0, i], normal[i] = body.position[i], 0.0
            for k in range(3):
                turn = body.rotation[i, k]
                point[0, i] += body.scale * turn * pieces[o + q + k]
                normal[i] += turn * pieces[o + 9 + k]
        off, _ = off_walls(point[0, 0], point[0, 1], point[0, 2], body.free, space)
        share = 1.0 - smooth(off)
        if share == 0.0:
            continue
        if space.has_face:
            keep_off(point, space)
        for i in range(3):
            front[found, i] = point[0, i] + 0.5 * arm * normal[i]
            back[found, i] = point[0, i] - 0.5 * arm * normal[i]
        weight[found] = body.layer * body.scale * area / (12.0 * math.pi * arm * arm)
        inner[found], rows[found] = share, found
        found += 1
    one = np.zeros((found, green.phi_columns), np.float32)
    two = np.zeros((found, green.phi_columns), np.float32)
    far_potentials(front[:found], rows[:found], inner[:found], green, one)
    far_potentials(back[:found], rows[:found], inner[:found], green, two)
    for c in range(found):
        for i in range(out.shape[0]):
            field = weight[c] * float(one[c, i] - two[c, i])
            for j in range(i + 1):
                out[i, j] += field * float(one[c, j] - two[c, j])
