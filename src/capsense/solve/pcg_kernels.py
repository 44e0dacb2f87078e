"""Compiled preconditioned conjugate gradients on the lattice, eight right-hand sides at a time.

Vectors have shape (n, 8): the lanes of one node lie together, so that a pass over the links
serves all right-hand sides. The preconditioner is a modified incomplete Cholesky factorisation
without fill-in (Gustafsson 1978).
"""

from __future__ import annotations

import numpy as np
from numba import njit

LANES = 8
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


@njit(cache=True, fastmath=True)
def precondition(weight, inverse, strides, lo, hi, r, z, rz):
    """Solve the incomplete factors for z and accumulate r · z per lane."""
    sx, sy = strides[0], strides[1]
    wx, wy, wz = weight[0], weight[1], weight[2]
    for a in range(lo, hi):
        g = inverse[a]
        if g == 0.0:
            for k in range(LANES):
                z[a, k] = 0.0
            continue
        ux, uy, uz = wx[a - sx], wy[a - sy], wz[a - 1]
        for k in range(LANES):
            z[a, k] = g * (r[a, k] + ux * z[a - sx, k] + uy * z[a - sy, k] + uz * z[a - 1, k])
    total = np.zeros(LANES, np.float64)
    part = np.zeros(LANES, np.float32)
    count = 0
    for a in range(hi - 1, lo - 1, -1):
        g = inverse[a]
        if g == 0.0:
            continue
        ux, uy, uz = g * wx[a], g * wy[a], g * wz[a]
        for k in range(LANES):
            z[a, k] += ux * z[a + sx, k] + uy * z[a + sy, k] + uz * z[a + 1, k]
            part[k] += r[a, k] * z[a, k]
        count += 1
        if count == 256:
            count = 0
            for k in range(LANES):
                total[k] += part[k]
                part[k] = 0.0
    for k in range(LANES):
        rz[k] = total[k] + part[k]


@njit(cache=True, fastmath=True)
def apply_operator(weight, diagonal, active, strides, lo, hi, p, ap, pap):
    """Write the operator times p and accumulate p · A p per lane."""
    sx, sy = strides[0], strides[1]
    wx, wy, wz = weight[0], weight[1], weight[2]
    total = np.zeros(LANES, np.float64)
    part = np.zeros(LANES, np.float32)
    count = 0
    for a in range(lo, hi):
        if active[a] == 0.0:
            for k in range(LANES):
                ap[a, k] = 0.0
            continue
        d = diagonal[a]
        x0, x1 = wx[a - sx], wx[a]
        y0, y1 = wy[a - sy], wy[a]
        z0, z1 = wz[a - 1], wz[a]
        for k in range(LANES):
            v = (
                d * p[a, k]
                - x0 * p[a - sx, k]
                - x1 * p[a + sx, k]
                - y0 * p[a - sy, k]
                - y1 * p[a + sy, k]
                - z0 * p[a - 1, k]
                - z1 * p[a + 1, k]
            )
            ap[a, k] = v
            part[k] += p[a, k] * v
        count += 1
        if count == 256:
            count = 0
            for k in range(LANES):
                total[k] += part[k]
                part[k] = 0.0
    for k in range(LANES):
        pap[k] = total[k] + part[k]


@njit(cache=True, fastmath=True)
def _direction(lo, hi, p, z, beta):
    for a in range(lo, hi):
        for k in range(LANES):
            p[a, k] = z[a, k] + beta[k] * p[a, k]


@njit(cache=True, fastmath=True)
def _advance(lo, hi, u, r, p, ap, alpha):
    for a in range(lo, hi):
        for k in range(LANES):
            u[a, k] += alpha[k] * p[a, k]
            r[a, k] -= alpha[k] * ap[a, k]


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
    beta, alpha = np.zeros(LANES, np.float32), np.zeros(LANES, np.float32)
    rz, pap, old = np.empty(LANES), np.empty(LANES), np.ones(LANES)
    previous = np.full(LANES, np.inf)
    n = u.shape[0]
    for a in range(n):
        if active[a] == 0.0:
            for k in range(LANES):
                u[a, k] = 0.0
    apply_operator(weight, diagonal, active, strides, lo, hi, u, ap, pap)
    for a in range(lo, hi):
        for k in range(LANES):
            r[a, k] = (rhs[a, k] - ap[a, k]) * active[a]
    iteration = 0
    while iteration < max_iterations:
        precondition(weight, inverse, strides, lo, hi, r, z, rz)
        for k in range(LANES):
            beta[k] = 0.0 if iteration == 0 or old[k] <= 0.0 else rz[k] / old[k]
        _direction(lo, hi, p, z, beta)
        apply_operator(weight, diagonal, active, strides, lo, hi, p, ap, pap)
        done = True
        for k in range(LANES):
            step = rz[k] / pap[k] if pap[k] > 0.0 else 0.0
            alpha[k] = step
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
def load(
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


@njit(cache=True, fastmath=True)
def inner(lo, hi, active, left, right, out):
    """Add leftᵀ right over the active nodes to ``out`` (8, 8)."""
    part = np.zeros((LANES, LANES), np.float32)
    count = 0
    for a in range(lo, hi):
        if active[a] == 0.0:
            continue
        for k in range(LANES):
            v = left[a, k]
            for m in range(LANES):
                part[k, m] += v * right[a, m]
        count += 1
        if count == 256:
            count = 0
            for k in range(LANES):
                for m in range(LANES):
                    out[k, m] += part[k, m]
                    part[k, m] = 0.0
    for k in range(LANES):
        for m in range(LANES):
            out[k, m] += part[k, m]


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
