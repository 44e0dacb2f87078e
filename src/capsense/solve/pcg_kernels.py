"""Compiled preconditioned conjugate gradients on the lattice, eight right-hand sides at a time.

Vectors have shape (n, 8): the lanes of one node lie together, so that a pass over the links
serves all right-hand sides. The preconditioner is a modified incomplete Cholesky factorisation
without fill-in (Gustafsson 1978).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from capsense.solve.simd import LANES, load, madd, splat, store, vmadd

_RELAX = np.float32(0.97)
"""Share of the dropped fill-in that is moved to the diagonal."""


@njit(cache=True)
def operator_diagonal(weight, extra, owner, strides, diagonal, active):
    """Sum the links and ties at each node; nodes that are held or inside a conductor are off."""
    sx, sy = strides[0], strides[1]
    n = owner.shape[0]
    for a in range(n):
        if owner[a] != -1:
            active[a] = 0.0
            diagonal[a] = 1.0
            continue
        d = (
            weight[0, a]
            + weight[0, a - sx]
            + weight[1, a]
            + weight[1, a - sy]
            + weight[2, a]
            + weight[2, a - 1]
            + extra[a]
        )
        if d > 0.0:
            active[a] = 1.0
            diagonal[a] = d
        else:
            active[a] = 0.0
            diagonal[a] = 1.0


@njit(cache=True, fastmath=True)
def factorise(weight, diagonal, active, strides, inverse):
    """Write the inverse pivots of the incomplete factorisation; zero at nodes that are off."""
    sx, sy = strides[0], strides[1]
    n = diagonal.shape[0]
    wx, wy, wz = weight[0], weight[1], weight[2]
    for a in range(n):
        if active[a] == 0.0:
            inverse[a] = 0.0
            continue
        d = diagonal[a]
        b = a - sx
        g = wx[b] * inverse[b]
        d -= g * (wx[b] + _RELAX * (wy[b] * active[b + sy] + wz[b] * active[b + 1]))
        b = a - sy
        g = wy[b] * inverse[b]
        d -= g * (wy[b] + _RELAX * (wx[b] * active[b + sx] + wz[b] * active[b + 1]))
        b = a - 1
        g = wz[b] * inverse[b]
        d -= g * (wz[b] + _RELAX * (wx[b] * active[b + sx] + wy[b] * active[b + sy]))
        inverse[a] = np.float32(1.0) / max(d, np.float32(0.02) * diagonal[a])


@njit(cache=True)
def _flush(part, row, total):
    """Add a row of single-precision partial sums to double-precision totals, and clear it."""
    for k in range(LANES):
        total[k] += part[row, k]
        part[row, k] = 0.0


@njit(cache=True)
def precondition(weight, inverse, strides, lo, hi, r, z, rz):
    """Solve the incomplete factors for z and write r · z per lane. ``z`` off [lo, hi) is zero."""
    sx, sy = strides[0], strides[1]
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    last = zero
    for a in range(lo, hi):
        v = madd(wz[a - 1], last, load(r, a))
        v = madd(wy[a - sy], load(z, a - sy), v)
        v = madd(wx[a - sx], load(z, a - sx), v)
        last = madd(inverse[a], v, zero)
        store(z, a, last)
    part = np.zeros((1, LANES), np.float32)
    rz[:] = 0.0
    last = zero
    for start in range(hi, lo, -sy):
        total = zero
        for a in range(start - 1, start - sy - 1, -1):
            v = madd(wz[a], last, zero)
            v = madd(wy[a], load(z, a + sy), v)
            v = madd(wx[a], load(z, a + sx), v)
            last = madd(inverse[a], v, load(z, a))
            store(z, a, last)
            total = vmadd(last, load(r, a), total)
        store(part, 0, total)
        _flush(part, 0, rz)


@njit(cache=True)
def apply_operator(weight, diagonal, active, strides, lo, hi, p, ap, pap):
    """Write the operator times p, zero at nodes that are off, and p · A p per lane."""
    sx, sy = strides[0], strides[1]
    wx, wy, wz = weight[0], weight[1], weight[2]
    zero = splat(np.float32(0.0))
    part = np.zeros((1, LANES), np.float32)
    pap[:] = 0.0
    for start in range(lo, hi, sy):
        total = zero
        for a in range(start, start + sy):
            on = active[a]
            here = load(p, a)
            v = madd(diagonal[a] * on, here, zero)
            v = madd(-wx[a - sx] * on, load(p, a - sx), v)
            v = madd(-wx[a] * on, load(p, a + sx), v)
            v = madd(-wy[a - sy] * on, load(p, a - sy), v)
            v = madd(-wy[a] * on, load(p, a + sy), v)
            v = madd(-wz[a - 1] * on, load(p, a - 1), v)
            v = madd(-wz[a] * on, load(p, a + 1), v)
            store(ap, a, v)
            total = vmadd(here, v, total)
        store(part, 0, total)
        _flush(part, 0, pap)


@njit(cache=True)
def _direction(lo, hi, p, z, beta):
    """p ← z + beta p, with beta of shape (1, 8)."""
    b = load(beta, 0)
    for a in range(lo, hi):
        store(p, a, vmadd(b, load(p, a), load(z, a)))


@njit(cache=True)
def _advance(lo, hi, u, r, p, ap, alpha):
    """u ← u + alpha p and r ← r − alpha A p, with alpha of shape (2, 8): alpha and −alpha."""
    forward, back = load(alpha, 0), load(alpha, 1)
    for a in range(lo, hi):
        store(u, a, vmadd(forward, load(p, a), load(u, a)))
        store(r, a, vmadd(back, load(ap, a), load(r, a)))


@njit(cache=True)
def _residual(lo, hi, active, rhs, ap, r):
    """r ← rhs − A u where nodes are on."""
    for a in range(lo, hi):
        on = active[a]
        zero = splat(np.float32(0.0))
        store(r, a, madd(-on, load(ap, a), madd(on, load(rhs, a), zero)))


@njit(cache=True)
def clear_held(active, u):
    """Set the solution to zero at nodes that are off."""
    for a in range(u.shape[0]):
        if active[a] == 0.0:
            store(u, a, splat(np.float32(0.0)))


@njit(cache=True)
def solve(
    weight,
    diagonal,
    active,
    inverse,
    strides,
    lo,
    hi,
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
    clear_held(active, u)
    apply_operator(weight, diagonal, active, strides, lo, hi, u, ap, pap)
    _residual(lo, hi, active, rhs, ap, r)
    iteration = 0
    while iteration < max_iterations:
        precondition(weight, inverse, strides, lo, hi, r, z, rz)
        for k in range(LANES):
            beta[0, k] = 0.0 if iteration == 0 or old[k] <= 0.0 else rz[k] / old[k]
        _direction(lo, hi, p, z, beta)
        apply_operator(weight, diagonal, active, strides, lo, hi, p, ap, pap)
        done = True
        for k in range(LANES):
            step = rz[k] / pap[k] if pap[k] > 0.0 else 0.0
            alpha[0, k], alpha[1, k] = step, -step
            decrement = step * rz[k]
            if decrement <= 0.0:
                left[k] = 0.0
            else:
                ratio = decrement / previous[k] if previous[k] < np.inf else 0.5
                ratio = min(max(ratio, 0.1), 0.9)
                left[k] = decrement * ratio / (1.0 - ratio)
            previous[k] = decrement
            old[k] = rz[k]
            if left[k] > tolerance[k] or (iteration == 0 and decrement > tolerance[k]):
                done = False
        _advance(lo, hi, u, r, p, ap, alpha)
        iteration += 1
        if done:
            break
    return iteration


@njit(cache=True)
def load_scene(
    phi,
    first_lane,
    floating_lane,
    held,
    n_tie,
    tie_node,
    tie_weight,
    tie_conductor,
    tie_point,
    tie_coef,
    tie_end,
    tie_end_coef,
    n_energy,
    energy_link,
    energy_weight,
    energy_kind,
    energy_end,
    scale,
    rhs,
    value,
    drop,
):
    """Fill one block's right-hand sides, and each tie's and energy term's value per lane.

    ``floating_lane[c]`` is the lane of conductor c in this block, or −1. ``held[l]`` is the
    terminal of lane l or −1. ``scale`` turns farads into the units of the operator.
    """
    for i in range(n_tie):
        node = tie_node[i]
        for k in range(LANES):
            v = 0.0
            for t in range(4):
                v += tie_coef[i, t] * phi[tie_point[i, t], k]
            if tie_end[i] >= 0 and held[k] == tie_end[i]:
                v += tie_end_coef[i]
            value[i, k] = v
        lane = floating_lane[tie_conductor[i]]
        if lane >= 0:
            value[i, lane] = -1.0
        if node >= 0:
            w = tie_weight[i] * scale
            for k in range(LANES):
                rhs[node, k] -= w * value[i, k]
    for i in range(n_energy):
        a, b = energy_link[i, 0], energy_link[i, 1]
        for k in range(LANES):
            end = 1.0 if energy_end[i] >= 0 and held[k] == energy_end[i] else 0.0
            drop[i, k] = (phi[a, k] if a >= 0 else end) - (phi[b, k] if b >= 0 else end)
        if energy_kind[i] == 1:
            w = energy_weight[i] * scale
            for k in range(LANES):
                if a >= 0:
                    rhs[a, k] -= w * drop[i, k]
                if b >= 0:
                    rhs[b, k] += w * drop[i, k]


@njit(cache=True)
def gram(n, weight, left, right, out):
    """Add Σ_i weight_i left_i right_iᵀ to ``out`` (8, 8)."""
    for i in range(n):
        w = weight[i]
        for k in range(LANES):
            v = w * left[i, k]
            for m in range(LANES):
                out[k, m] += v * right[i, m]


@njit(cache=True)
def inner(lo, hi, strides, left, right, out):
    """Add leftᵀ right over the nodes to ``out`` (8, 8)."""
    zero = splat(np.float32(0.0))
    part = np.zeros((LANES, LANES), np.float32)
    for start in range(lo, hi, strides[1]):
        s0, s1, s2, s3, s4, s5, s6, s7 = zero, zero, zero, zero, zero, zero, zero, zero
        for a in range(start, start + strides[1]):
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


@njit(cache=True)
def sparse_inner(
    n_tie, tie_node, n_energy, energy_link, energy_kind, stamp, mark, active, left, right, out
):
    """Add leftᵀ right over the nodes that carry a load, each once, to ``out`` (8, 8)."""
    for i in range(n_tie + 2 * n_energy):
        if i < n_tie:
            a = tie_node[i]
        else:
            e = (i - n_tie) // 2
            a = energy_link[e, (i - n_tie) % 2] if energy_kind[e] == 1 else -1
        if a < 0 or active[a] == 0.0 or stamp[a] == mark:
            continue
        stamp[a] = mark
        for k in range(LANES):
            v = np.float64(left[a, k])
            for m in range(LANES):
                out[k, m] += v * right[a, m]
