"""The step, compiled: bodies that reach beyond the walls, or far behind the face of a flat design.

No charge is out of reach. Instead of solving for charges that come out as zero, the step leaves
clusters there out, and the charge of a whole is that of its parts within reach.

With u_A the equilibrium charge of a cluster A, in parts X and Y of shares p and q, and f_A = u_X -
u_Y its charge function, the charge within reach is r_A = w u_A + a r_X + b r_Y, w + a + b = 1, and
the function is r_X - r_Y. In terms of the shape's own functions, whose energies are known,
r_A = u_A + v_A with v_A = (a q - b p) f_A + a v_X + b v_Y.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import compiled, kernel
from capsense._simd import integers, singles
from capsense.solver.placement.placement_kernels import ActiveClusters
from capsense.solver.selection.selection_kernels import ActiveTree, is_there

_SAME = 1e-9
"""Shares that differ by less than this are the same."""


@compiled
def truncate_to_domain(cut, leaves):
    """Return a cut and its leaves without the clusters that are out of reach."""
    n, count = cut.active.shape[0], cut.node.shape[0]
    out = False
    for j in range(n):
        out = out or leaves.outside_fraction[j] > 0.0
    if not out:
        return cut, leaves
    inside, there = np.zeros(count), np.zeros(count)
    whole, parts, leaf = np.zeros(count), np.zeros((count, 2)), np.empty(count, np.int64)
    kept = 0
    for a in range(count - 1, -1, -1):
        leaf[a] = -1
        if cut.active_index[a] >= 0:
            whole[a] = cut.self_weight[a] * (1.0 - leaves.outside_fraction[cut.active_index[a]])
            if whole[a] > 0.0:
                there[a] = cut.self_weight[a]
                kept += 1
        for c in range(2):
            if cut.children[a, c] >= 0:
                parts[a, c] = cut.child_weights[a, c] * inside[cut.children[a, c]]
                below = (1.0 - cut.self_weight[a]) * there[cut.children[a, c]]
                there[a] = max(there[a], below)
        inside[a] = whole[a] + parts[a, 0] + parts[a, 1]
        if inside[a] > 0.0:
            whole[a] /= inside[a]
            parts[a, 0] /= inside[a]
            parts[a, 1] /= inside[a]
    points, true = np.empty((kept, 4, 3)), np.empty((kept, 4, 3))
    extent, soft, beyond, within = np.empty(kept), np.empty(kept), np.empty(kept), np.empty(kept)
    owner, at = np.empty(kept, np.int64), np.empty(kept, np.int64)
    known, size, offset = np.empty((kept, 2), np.int64), np.empty(kept), np.empty((kept, 3))
    barrier = np.empty(kept)
    i = 0
    for j in range(n):
        a = cut.active[j]
        if whole[a] > 0.0:
            leaf[a], at[i] = i, a
            for q in range(4):
                for k in range(3):  # copies of whole arrays would bring in code for texts of errors
                    points[i, q, k], true[i, q, k] = leaves.points[j, q, k], leaves.true[j, q, k]
            extent[i], soft[i], beyond[i] = (
                leaves.extent[j],
                leaves.softening_length[j],
                leaves.outside_fraction[j],
            )
            owner[i], within[i] = leaves.owner[j], leaves.self_interaction_weight[j]
            known[i, 0], known[i, 1] = leaves.table_rows[j, 0], leaves.table_rows[j, 1]
            size[i], barrier[i] = leaves.size[j], leaves.barrier[j]
            for k in range(3):
                offset[i, k] = leaves.offset[j, k]
            i += 1
    return (
        ActiveTree(
            cut.body,
            cut.node,
            cut.children,
            cut.charge_fraction,
            parts,
            leaf,
            whole,
            cut.fade,
            cut.parent_fade,
            there,
            at,
        ),
        ActiveClusters(
            points, true, extent, soft, beyond, owner, within, known, size, offset, barrier
        ),
    )


@kernel
def _moved(cut, a):
    """How much of f_A is in the charge of cluster A that is within reach."""
    return (
        cut.child_weights[a, 0] * (1.0 - cut.charge_fraction[a])
        - cut.child_weights[a, 1] * cut.charge_fraction[a]
    )


@compiled
def add_own(bodies, cut, functions, inside, matrix, rest, own):
    """Add the energies that the functions of each rigid body have by themselves.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        cut: The clusters.
        functions: Their charge functions.
        inside: Whether it is the impedance of the inside that is added, which net charge does not
            meet, or the energies in free space.
        matrix, rest, own: See :class:`~capsense.solver.system.system_kernels.System`; of the
            matrix, only what is not above the diagonal is added to.
    """
    total, solved = functions.cluster.shape[0], functions.solved
    of, first = np.empty(total, np.int64), np.int64(0)
    while first < cut.node.shape[0]:
        b, last, moved = cut.body[first], first, False
        while last < cut.node.shape[0] and cut.body[last] == b:
            moved = moved or (cut.children[last, 0] >= 0 and abs(_moved(cut, last)) > _SAME)
            last += 1
        body = bodies[b]
        address = body.neumann_to_dirichlet if inside else body.potential_coefficients
        if address != 0:
            count = 0
            for f in range(total):
                if functions.body[f] == b:
                    of[count] = f
                    count += 1
            factor = (body.inverse_susceptibility if inside else 1.0) / body.scale
            table = singles(address)
            block = np.empty((0, 0))
            if moved:
                block = _own_block(body, table, inside, cut, (first, last), functions, of[:count])
            for i in range(count):
                f, line = of[i], functions.number[of[i]] * body.n_tabulated
                for j in range(i + 1):
                    e = of[j]
                    if f != e and e >= solved:
                        continue
                    if moved:
                        value = block[i, j]
                    elif max(functions.number[f], functions.number[e]) >= body.n_tabulated or (
                        inside and functions.number[f] * functions.number[e] == 0
                    ):
                        value = 0.0
                    else:
                        value = float(table[line + functions.number[e]])
                    if e < solved:
                        if f < solved:
                            matrix[f, e] += factor * value
                        else:
                            rest[f - solved, e] += factor * value
                    else:
                        own[f] += factor * value
        first = last


@compiled
def _own_block(body, table, inside, cut, span, functions, of):
    """Energies of functions ``of`` one body on each other, shape (c, c).

    ``span`` are the first cluster of the body and the one behind its last.
    """
    first, last = span
    clusters = last - first
    number, index = np.zeros(clusters + 1, np.int64), np.zeros(clusters, np.int64)
    count = 1  # the net charge comes first
    for a in range(first, last):
        if cut.children[a, 0] >= 0 and is_there(cut, a):
            number[count], index[a - first] = integers(body.function)[cut.node[a]], count
            count += 1
    rows = np.zeros((count, count))
    for i in range(1 if inside else 0, count):
        for j in range(1 if inside else 0, i + 1):
            if number[i] < body.n_tabulated and number[j] < body.n_tabulated:
                rows[i, j] = rows[j, i] = table[number[i] * body.n_tabulated + number[j]]
    half = _within_reach(cut, span, index, functions, of, rows)
    return _within_reach(cut, span, index, functions, of, half.T.copy())


@compiled
def _within_reach(cut, span, index, functions, of, rows):
    """Change rows of a body's own functions to rows of those within reach, shape (c, w)."""
    first, last = span
    width = rows.shape[1]
    more, out = np.zeros((last - first, width)), np.empty((of.shape[0], width))
    changed = np.zeros(last - first, np.bool_)  # else a line of ``more`` is zero
    for a in range(last - 1, first - 1, -1):
        if cut.children[a, 0] < 0 or not is_there(cut, a):
            continue
        line, own, share = more[a - first], rows[index[a - first]], _moved(cut, a)
        if abs(share) > _SAME:
            changed[a - first] = True
            for i in range(width):
                line[i] = share * own[i]
        for c in range(2):
            part = cut.children[a, c] - first
            if changed[part]:
                changed[a - first] = True
                for i in range(width):
                    line[i] += cut.child_weights[a, c] * more[part, i]
    for f in range(of.shape[0]):
        a, net = functions.cluster[of[f]], functions.net[of[f]]
        own = rows[0 if net else index[a - first]]
        for i in range(width):
            out[f, i] = own[i]
        for c in range(1 if net else 2):
            part = (a if net else cut.children[a, c]) - first
            sign = 1.0 - 2.0 * c
            if changed[part]:
                for i in range(width):
                    out[f, i] += sign * more[part, i]
    return out
