"""Compiled preconditioned conjugate gradients on the lattice, eight right-hand sides at a time.

Vectors have shape (n, 8): the lanes of one node lie together, so that a pass over the links
serves all right-hand sides. The preconditioner is a modified incomplete Cholesky factorisation
without fill-in (Gustafsson 1978).

Every pass goes storey by storey, column by column; ``storeys`` holds a row (first node, nx, ny, nz)
for each. The floor node of a column stands for the columns that it goes on from, as their mean
weighted by the links that lead to it; a ceiling node for the one above that its column leads into.
With these two kept up to date, by :func:`lift` and :func:`lower`, a pass needs to know nothing of
storeys.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from capsense.solve.simd import LANES, load, madd, splat, store, vmadd

_RELAX = np.float32(0.97)
"""Share of the dropped fill-in that is moved to the diagonal."""


@njit(cache=True, nogil=True, fastmath=True)
def factorise(weight, extra, owner, storeys, ceiling, parent, share, diagonal, active, inverse,
              woken):  # fmt: skip
    """Set up the operator and its incomplete factors, storey by storey.

    Sums the links and ties at each unknown; nodes inside a conductor are off: ``active`` 0. Writes
    the inverse pivots, zero at nodes that are off. Ties of ceiling nodes go to the nodes they stand
    for. A floor node's link upward is what leads to it from below, ``share`` holds each column's
    part in it, and its "pivot" is what the elimination of these columns takes from the node above.
    Lists the nodes that come on in ``woken`` and returns how many there are.
    """
    wx, wy, wz = weight[0], weight[1], weight[2]
    for j in range(ceiling.shape[0]):
        extra[parent[j]] += extra[ceiling[j]]
        wz[parent[j] - 1] = 0.0
    for j in range(ceiling.shape[0]):
        wz[parent[j] - 1] += wz[ceiling[j] - 1]
    for j in range(ceiling.shape[0]):
        total = wz[parent[j] - 1]
        share[j] = wz[ceiling[j] - 1] / total if total > 0.0 else 0.0
    n_woken = 0
    done = 0
    for s in range(storeys.shape[0]):
        first, nx, ny, nz = storeys[s]
        sx, sy = ny * nz, nz
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                start = first + i * sx + j * sy
                for a in range(start + 1, start + nz - 1):
                    full = wx[a] + wx[a - sx] + wy[a] + wy[a - sy] + wz[a] + wz[a - 1] + extra[a]
                    if owner[a] != -1 or full <= 0.0:
                        active[a], diagonal[a], inverse[a] = 0.0, 1.0, 0.0
                        continue
                    if active[a] == 0.0:
                        woken[n_woken] = a
                        n_woken += 1
                    active[a], diagonal[a] = 1.0, full
                    b, c, d = a - sx, a - sy, a - 1
                    gx, gy, gz = wx[b] * inverse[b], wy[c] * inverse[c], wz[d] * inverse[d]
                    # fill-in towards nodes that are off is lost on ties, which are in the diagonal
                    taken = gx * (wx[b] + _RELAX * (wy[b] + wz[b]))
                    taken += gy * (wy[c] + _RELAX * (wx[c] + wz[c]))
                    taken += gz * (wz[d] + _RELAX * (wx[d] + wy[d]))
                    inverse[a] = np.float32(1.0) / max(full - taken, np.float32(0.02) * full)
        stop = first + nx * sx
        begin = done
        while done < ceiling.shape[0] and ceiling[done] < stop:
            inverse[parent[done] - 1] = 0.0
            done += 1
        for j in range(begin, done):
            b, floor = ceiling[j] - 1, parent[j] - 1
            total = wz[floor]
            if total > 0.0:
                g = wz[b] * inverse[b]
                inverse[floor] += g * (wz[b] + _RELAX * (wx[b] + wy[b])) / (total * total)
    for j in range(ceiling.shape[0]):
        active[ceiling[j]] = active[parent[j]]
    return n_woken


@njit(cache=True, nogil=True)
def lift(ceiling, parent, share, begin, end, v):
    """Set floor nodes to the weighted mean of the columns below, for joints [begin, end)."""
    zero = splat(np.float32(0.0))
    for j in range(begin, end):
        store(v, parent[j] - 1, zero)
    for j in range(begin, end):
        floor = parent[j] - 1
        store(v, floor, madd(share[j], load(v, ceiling[j] - 1), load(v, floor)))


@njit(cache=True, nogil=True)
def lower(ceiling, parent, begin, end, v):
    """Set ceiling nodes to the nodes they stand for, for joints [begin, end)."""
    for j in range(begin, end):
        store(v, ceiling[j], load(v, parent[j]))


@njit(cache=True, nogil=True)
def joints_of(storeys, ceiling):
    """First joint of each storey, and the number of joints behind; shape (storeys + 1,)."""
    out = np.zeros(storeys.shape[0] + 1, np.int64)
    done = 0
    for s in range(storeys.shape[0]):
        stop = storeys[s, 0] + storeys[s, 1] * storeys[s, 2] * storeys[s, 3]
        while done < ceiling.shape[0] and ceiling[done] < stop:
            done += 1
        out[s + 1] = done
    return out


@njit(cache=True, nogil=True)
def _flush(part, row, total):
    """Add a row of single-precision partial sums to double-precision totals, and clear it."""
    for k in range(LANES):
        total[k] += part[row, k]
        part[row, k] = 0.0


@njit(cache=True, nogil=True)
def _advance(u, r, p, ap, alpha):
    """u ← u + alpha p and r ← r − alpha A p, with ``alpha`` of shape (2, 8): alpha and −alpha."""
    on, back = load(alpha, 0), load(alpha, 1)
    for a in range(u.shape[0]):
        store(u, a, vmadd(on, load(p, a), load(u, a)))
        store(r, a, vmadd(back, load(ap, a), load(r, a)))


@njit(cache=True, nogil=True)
def forward(weight, inverse, storeys, ceiling, parent, share, u, r, p, ap, alpha, y, rz):
    """Advance as :func:`_advance` does, then solve the lower incomplete factor for y.

    Writes r · M⁻¹ r per lane to ``rz``, M being the product of the incomplete factors.
    """
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    part = np.zeros((1, LANES), np.float32)
    rz[:] = 0.0
    on, back = load(alpha, 0), load(alpha, 1)
    joints = joints_of(storeys, ceiling)
    for s in range(storeys.shape[0]):
        first, nx, ny, nz = storeys[s]
        sx, sy = ny * nz, nz
        if s > 0:
            lift(ceiling, parent, share, joints[s - 1], joints[s], y)
        for i in range(1, nx - 1):
            total = zero
            for j in range(1, ny - 1):
                start = first + i * sx + j * sy
                last = load(y, start)
                for a in range(start + 1, start + nz - 1):
                    store(u, a, vmadd(on, load(p, a), load(u, a)))
                    v = vmadd(back, load(ap, a), load(r, a))
                    store(r, a, v)
                    v = madd(wz[a - 1], last, v)
                    v = madd(wy[a - sy], load(y, a - sy), v)
                    v = madd(wx[a - sx], load(y, a - sx), v)
                    last = madd(inverse[a], v, zero)
                    store(y, a, last)
                    total = vmadd(last, v, total)
            store(part, 0, total)
            _flush(part, 0, rz)


@njit(cache=True, nogil=True)
def backward(weight, inverse, storeys, ceiling, parent, share, y, p, beta):
    """Solve the upper factor in place, y → z, and set p ← z + beta p, with beta of shape (1, 8)."""
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    b = load(beta, 0)
    joints = joints_of(storeys, ceiling)
    for s in range(storeys.shape[0] - 1, -1, -1):
        first, nx, ny, nz = storeys[s]
        sx, sy = ny * nz, nz
        lower(ceiling, parent, joints[s], joints[s + 1], y)
        for i in range(nx - 2, 0, -1):
            for j in range(ny - 2, 0, -1):
                start = first + i * sx + j * sy
                last = load(y, start + nz - 1)
                for a in range(start + nz - 2, start, -1):
                    v = madd(wz[a], last, zero)
                    v = madd(wy[a], load(y, a + sy), v)
                    v = madd(wx[a], load(y, a + sx), v)
                    last = madd(inverse[a], v, load(y, a))
                    store(y, a, last)
                    store(p, a, vmadd(b, load(p, a), last))
    lift(ceiling, parent, share, 0, ceiling.shape[0], p)
    lower(ceiling, parent, 0, ceiling.shape[0], p)


@njit(cache=True, nogil=True)
def _flow_in(wx, wy, wz, diagonal, sx, sy, p, a, below, here, above):
    """Minus the operator times p at node a, given p below, at and above it."""
    v = madd(wx[a - sx], load(p, a - sx), splat(np.float32(0.0)))
    v = madd(wx[a], load(p, a + sx), v)
    v = madd(wy[a - sy], load(p, a - sy), v)
    v = madd(wy[a], load(p, a + sy), v)
    v = madd(wz[a - 1], below, v)
    v = madd(wz[a], above, v)
    return madd(-diagonal[a], here, v)


@njit(cache=True, nogil=True)
def apply_operator(weight, diagonal, active, storeys, p, ap, pap):
    """Write the operator times p, zero at nodes that are off, and p · A p per lane.

    Floor and ceiling nodes of p must be up to date.
    """
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    part = np.zeros((1, LANES), np.float32)
    pap[:] = 0.0
    for s in range(storeys.shape[0]):
        first, nx, ny, nz = storeys[s]
        sx, sy = ny * nz, nz
        for i in range(1, nx - 1):
            total = zero
            for j in range(1, ny - 1):
                start = first + i * sx + j * sy
                below, here = load(p, start), load(p, start + 1)
                for a in range(start + 1, start + nz - 1):
                    above = load(p, a + 1)
                    v = _flow_in(wx, wy, wz, diagonal, sx, sy, p, a, below, here, above)
                    v = madd(-active[a], v, zero)
                    store(ap, a, v)
                    total = vmadd(here, v, total)
                    below, here = here, above
            store(part, 0, total)
            _flush(part, 0, pap)


@njit(cache=True, nogil=True)
def start(weight, diagonal, active, storeys, ceiling, parent, share, rhs, u, r):
    """Clear the solution where nodes are off, and set r ← rhs − A u."""
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    for a in range(u.shape[0]):
        if active[a] == 0.0:
            store(u, a, zero)
    lift(ceiling, parent, share, 0, ceiling.shape[0], u)
    lower(ceiling, parent, 0, ceiling.shape[0], u)
    for s in range(storeys.shape[0]):
        first, nx, ny, nz = storeys[s]
        sx, sy = ny * nz, nz
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                start = first + i * sx + j * sy
                below, here = load(u, start), load(u, start + 1)
                for a in range(start + 1, start + nz - 1):
                    above = load(u, a + 1)
                    v = _flow_in(wx, wy, wz, diagonal, sx, sy, u, a, below, here, above)
                    v = madd(active[a], load(rhs, a), madd(active[a], v, zero))
                    store(r, a, v)
                    below, here = here, above
    for j in range(ceiling.shape[0]):
        store(r, ceiling[j], zero)


@njit(cache=True, nogil=True)
def solve(
    weight,
    diagonal,
    active,
    inverse,
    storeys,
    ceiling,
    parent,
    share,
    rhs,
    u,
    r,
    z,
    p,
    ap,
    tolerance,
    max_iterations,
    left,
):
    """Iterate until the energy still missing is below ``tolerance`` in every lane.

    Each iteration lowers the energy of a lane by α (r · z) exactly (Hestenes and Stiefel 1952).
    What is still missing is estimated from the last decrements and their ratio. ``tolerance`` and
    ``left`` (output) are per lane, in the units of the energy. Returns the iterations done.
    """
    beta, alpha = np.zeros((1, LANES), np.float32), np.zeros((2, LANES), np.float32)
    rz, pap, old = np.empty(LANES), np.empty(LANES), np.ones(LANES)
    previous = np.full(LANES, np.inf)
    start(weight, diagonal, active, storeys, ceiling, parent, share, rhs, u, r)
    iteration = 0
    while iteration < max_iterations:
        forward(weight, inverse, storeys, ceiling, parent, share, u, r, p, ap, alpha, z, rz)
        for k in range(LANES):
            beta[0, k] = 0.0 if iteration == 0 or old[k] <= 0.0 else rz[k] / old[k]
        backward(weight, inverse, storeys, ceiling, parent, share, z, p, beta)
        apply_operator(weight, diagonal, active, storeys, p, ap, pap)
        done = True
        for k in range(LANES):
            step = rz[k] / pap[k] if pap[k] > 0.0 else 0.0
            alpha[0, k], alpha[1, k] = step, -step
            decrement = step * rz[k]
            if decrement <= 0.0:
                left[k] = 0.0
            else:
                ratio = decrement / previous[k] if 0.0 < previous[k] < np.inf else 0.5
                ratio = min(max(ratio, 0.1), 0.9)
                left[k] = decrement * ratio / (1.0 - ratio)
            previous[k] = decrement
            old[k] = rz[k]
            if left[k] > tolerance[k] or (iteration == 0 and decrement > tolerance[k]):
                done = False
        iteration += 1
        if done:
            break
    _advance(u, r, p, ap, alpha)
    return iteration


@njit(cache=True, nogil=True)
def load_scene(phi, floating_lane, held, ties, energies, rhs, value, drop):
    """Fill one block's right-hand sides, and each tie's and energy term's value per lane.

    ``floating_lane[c]`` is the lane of conductor c in this block, or −1. ``held[l]`` is the
    terminal of lane l or −1.
    """
    for i in range(ties.shape[0]):
        tie = ties[i]
        point, coef = tie.point, tie.coef
        for k in range(LANES):
            v = 0.0
            for t in range(4):
                v += coef[t] * phi[point[t], k]
            if tie.end >= 0 and held[k] == tie.end:
                v += tie.end_coef
            value[i, k] = v
        lane = floating_lane[tie.conductor]
        if lane >= 0:
            value[i, lane] = -1.0
        if tie.node >= 0:
            for k in range(LANES):
                rhs[tie.node, k] -= tie.weight * value[i, k]
    for i in range(energies.shape[0]):
        term = energies[i]
        for k in range(LANES):
            end = 1.0 if term.end >= 0 and held[k] == term.end else 0.0
            at_a = phi[term.a, k] if term.a >= 0 else end
            drop[i, k] = at_a - (phi[term.b, k] if term.b >= 0 else end)
        if term.drives:
            for k in range(LANES):
                if term.a >= 0:
                    rhs[term.a, k] -= term.weight * drop[i, k]
                if term.b >= 0:
                    rhs[term.b, k] += term.weight * drop[i, k]


@njit(cache=True, nogil=True)
def gram(terms, left, right, out):
    """Add Σ_i weight_i left_i right_iᵀ over ties or energy terms to ``out`` (8, 8)."""
    for i in range(terms.shape[0]):
        w = terms[i].weight
        for k in range(LANES):
            v = w * left[i, k]
            for m in range(LANES):
                out[k, m] += v * right[i, m]


@njit(cache=True, nogil=True)
def inner(left, right, out):
    """Add leftᵀ right over the nodes to ``out`` (8, 8)."""
    zero = splat(np.float32(0.0))
    part = np.zeros((LANES, LANES), np.float32)
    for start in range(0, left.shape[0], 256):
        s0, s1, s2, s3, s4, s5, s6, s7 = zero, zero, zero, zero, zero, zero, zero, zero
        for a in range(start, min(start + 256, left.shape[0])):
            v = load(right, a)
            s0 = madd(left[a, 0], v, s0)
            s1 = madd(left[a, 1], v, s1)
            s2 = madd(left[a, 2], v, s2)
            s3 = madd(left[a, 3], v, s3)
            s4 = madd(left[a, 4], v, s4)
            s5 = madd(left[a, 5], v, s5)
            s6 = madd(left[a, 6], v, s6)
            s7 = madd(left[a, 7], v, s7)
        store(part, 0, s0)
        store(part, 1, s1)
        store(part, 2, s2)
        store(part, 3, s3)
        store(part, 4, s4)
        store(part, 5, s5)
        store(part, 6, s6)
        store(part, 7, s7)
        for k in range(LANES):
            _flush(part, k, out[k])


@njit(cache=True, nogil=True)
def _add_outer(a, left, right, out):
    for k in range(LANES):
        v = np.float64(left[a, k])
        for m in range(LANES):
            out[k, m] += v * right[a, m]


@njit(cache=True, nogil=True)
def sparse_inner(ties, energies, stamp, mark, active, left, right, out):
    """Add leftᵀ right over the nodes that carry a load, each once, to ``out`` (8, 8)."""
    for i in range(ties.shape[0]):
        a = ties[i].node
        if a >= 0 and active[a] != 0.0 and stamp[a] != mark:
            stamp[a] = mark
            _add_outer(a, left, right, out)
    for i in range(energies.shape[0]):
        if energies[i].drives:
            for k in range(2):
                a = energies[i].a if k == 0 else energies[i].b
                if a >= 0 and active[a] != 0.0 and stamp[a] != mark:
                    stamp[a] = mark
                    _add_outer(a, left, right, out)
