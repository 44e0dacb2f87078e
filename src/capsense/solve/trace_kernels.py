"""Compiled scan of a scene: where bodies cross the links of the online lattice.

Every lattice line that may meet a body is intersected with all bodies; the stretches inside them
are resolved (conductors before dielectrics, later bodies before earlier ones) and laid over the
line's links. The outcome is a set of changed links and of *ties*: conductances from a node to a
conductor's surface. See ``docs/theory.md`` for the formulas and ``solve/reference.py`` for the
slow, readable twin.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from capsense.solve.column_kernels import MAX_STRETCHES, MESH_STRETCHES, covered_stretches

_SNAP = 1e-6
"""Fraction of a link within which a surface counts as lying on a node."""
_LEAST = 1e-3
"""Smallest fraction of a link between a free node and a conductor."""


@njit(cache=True)
def _resolve(n, t0, t1, who, conductor, r0, r1, rwho, cuts, parent):
    """Turn overlapping stretches into disjoint ones, in order; join conductors that touch."""
    if n == 1:
        r0[0], r1[0], rwho[0] = t0[0], t1[0], who[0]
        return 1
    m = 0
    for k in range(n):
        cuts[m] = t0[k]
        cuts[m + 1] = t1[k]
        m += 2
    cuts[:m].sort()
    out = 0
    for c in range(m - 1):
        a, b = cuts[c], cuts[c + 1]
        if b - a <= 1e-12:
            continue
        middle = 0.5 * (a + b)
        best = -1
        for k in range(n):
            if t0[k] <= middle and middle <= t1[k]:
                if best < 0:
                    best = who[k]
                elif conductor[who[k]] >= 0 and conductor[best] >= 0:
                    _join(parent, conductor[who[k]], conductor[best])
                elif conductor[who[k]] >= 0 or (conductor[best] < 0 and who[k] > best):
                    best = who[k]
        if best < 0:
            continue
        if out > 0 and a - r1[out - 1] <= 1e-12:
            last = rwho[out - 1]
            if last == best:
                r1[out - 1] = b
                continue
            if conductor[last] >= 0 and conductor[best] >= 0:
                _join(parent, conductor[last], conductor[best])
        r0[out], r1[out], rwho[out] = a, b, best
        out += 1
    return out


@njit(cache=True)
def _join(parent, a, b):
    while parent[a] != a:
        a = parent[a]
    while parent[b] != b:
        b = parent[b]
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@njit(cache=True)
def trace(
    x,
    y,
    z,
    strides,
    base_weight,
    base_extra,
    eps_r,
    owner,
    kink,
    cut_index,
    cut_lower,
    cut_lower_owner,
    cut_upper,
    cut_upper_owner,
    half_weight,
    kinds,
    params,
    rotation,
    position,
    bounds,
    conductor,
    body_eps,
    n_bodies,
    grids,
    grid_shape,
    grid_first,
    grid_origin,
    grid_inv,
    contact,
    inside,
    inside_nodes,
    n_inside,
    weight,
    extra,
    tie_node,
    tie_weight,
    tie_conductor,
    tie_point,
    tie_coef,
    tie_end,
    tie_end_coef,
    energy_link,
    energy_weight,
    energy_kind,
    energy_end,
    couple,
    couple_weight,
    parent,
    counts,
):
    """Scan a scene; fill link weights, ties, energy terms and couplings. Return 0, or an error.

    Outputs: ``weight`` (3, n) and ``extra`` (n,) hold the changed operator. A tie i connects node
    ``tie_node[i]`` (−1: a held end) to conductor ``tie_conductor[i]``; the background potential
    there is ``Σ_k tie_coef[i, k] φ[tie_point[i, k]] + tie_end_coef[i] φ_end``. An energy term adds
    ``energy_weight · Δφ_i Δφ_j`` over a link; of kind 1 it also drives its ends (dielectric).
    ``counts``: numbers of ties, energy terms and couplings.
    """
    n_tie, n_energy, n_couple = 0, 0, 0
    t0, t1 = np.empty(MAX_STRETCHES), np.empty(MAX_STRETCHES)
    who = np.empty(MAX_STRETCHES, np.int64)
    cover = np.empty(MAX_STRETCHES)
    u0, u1 = np.empty(MAX_STRETCHES), np.empty(MAX_STRETCHES)
    uwho = np.empty(MAX_STRETCHES, np.int64)
    r0, r1 = np.empty(2 * MAX_STRETCHES), np.empty(2 * MAX_STRETCHES)
    rwho = np.empty(2 * MAX_STRETCHES, np.int64)
    sorted_cuts = np.empty(2 * MAX_STRETCHES)
    scratch = np.empty((MESH_STRETCHES, 2))
    near = np.empty(n_bodies, np.int64)
    for axis in range(3):
        if axis == 0:
            c, cp, cq, p, q = x, y, z, 1, 2
        elif axis == 1:
            c, cp, cq, p, q = y, x, z, 0, 2
        else:
            c, cp, cq, p, q = z, x, y, 0, 1
        stride, sp, sq = strides[axis], strides[p], strides[q]
        last = c.shape[0] - 1
        low, high = math.inf, -math.inf
        for body in range(n_bodies):
            low = min(low, bounds[body, 0, p])
            high = max(high, bounds[body, 1, p])
        # lines on the walls carry no unknowns
        for ip in range(1, cp.shape[0] - 1):
            op = cp[ip]
            pl, ph = 0.5 * (cp[ip - 1] + op), 0.5 * (op + cp[ip + 1])
            if ph < low or pl > high:
                continue
            n_near = 0
            for body in range(n_bodies):
                if bounds[body, 0, p] <= ph and pl <= bounds[body, 1, p]:
                    near[n_near] = body
                    n_near += 1
            if n_near == 0:
                continue
            for iq in range(1, cq.shape[0] - 1):
                oq = cq[iq]
                ql, qh = 0.5 * (cq[iq - 1] + oq), 0.5 * (oq + cq[iq + 1])
                total = covered_stretches(
                    axis, p, q, op, oq, pl, ph, ql, qh, kinds, params, rotation, position, bounds,
                    conductor, near, n_near, grids, grid_shape, grid_first, grid_origin, grid_inv,
                    t0, t1, who, cover, scratch,
                )  # fmt: skip
                if total == 0:
                    continue
                if total < 0:
                    return 1
                # bodies that fill different shares of the column are met layer by layer
                level = 1.0
                upper = 0.0
                for k in range(total):
                    upper = max(upper, cover[k])
                level = upper
                while level > 0.0:
                    below = 0.0
                    n = 0
                    for k in range(total):
                        if cover[k] >= level:
                            u0[n], u1[n], uwho[n] = t0[k], t1[k], who[k]
                            n += 1
                        else:
                            below = max(below, cover[k])
                    share = level - below
                    level = below
                    n = _resolve(n, u0, u1, uwho, conductor, r0, r1, rwho, sorted_cuts, parent)
                    line = ip * sp + iq * sq
                    m = max(0, np.searchsorted(c, r0[0]) - 1)
                    seg = 0
                    while m < last:
                        ta, tb = c[m], c[m + 1]
                        while seg < n and r1[seg] <= ta:
                            seg += 1
                        if seg == n:
                            break
                        if r0[seg] >= tb:
                            m = max(m + 1, np.searchsorted(c, r0[seg]) - 1)
                            continue
                        node = line + m * stride
                        # a held sheet between the nodes splits the link in two
                        cut = cut_index[axis, node]
                        if cut < 0 and inside[node] >= 0 and inside[node + stride] >= 0:
                            m += 1
                            continue  # the whole link lies inside
                        if owner[node] != -1 and owner[node] == owner[node + stride]:
                            m += 1
                            continue  # both ends on one held sheet: no field between them
                        parts = 1 if cut < 0 else 2
                        for part in range(parts):
                            if (
                                n_tie + 8 > tie_node.shape[0]
                                or n_energy + 4 > energy_weight.shape[0]
                                or n_couple + 8 > couple_weight.shape[0]
                            ):
                                return 2
                            pa, pb = ta, tb
                            na, nb = node, node + stride
                            ea, eb = -3, -3
                            w = share * base_weight[axis, node]
                            if cut >= 0:
                                w = share * half_weight[cut, part]
                                if part == 0:
                                    pb = ta + cut_lower[cut] * (tb - ta)
                                    nb, eb = -1, cut_lower_owner[cut]
                                else:
                                    pa = tb - cut_upper[cut] * (tb - ta)
                                    na, ea = -1, cut_upper_owner[cut]
                            length = pb - pa
                            # series resistance up to the first conductor, and back from the last
                            resist, pos, k = 0.0, pa, seg
                            first_r, first_s, first_k, first_deep = -1.0, 0.0, -1, False
                            last_t, last_k, last_deep = pa, -1, False
                            touched = False
                            while k < n and r0[k] < pb:
                                s0, s1 = max(r0[k], pa), min(r1[k], pb)
                                body = rwho[k]
                                kappa = 1.0
                                if s1 > s0:
                                    touched = True
                                    if s0 > pos:
                                        resist += (s0 - pos) / length
                                    if conductor[body] >= 0:
                                        if first_k < 0:
                                            first_r, first_k = resist, conductor[body]
                                            first_s = (s0 - pa) / length
                                            first_deep = r0[k] < pa - _SNAP * length
                                        elif last_k != conductor[body] and resist > 0.0:
                                            couple[n_couple, 0] = last_k
                                            couple[n_couple, 1] = conductor[body]
                                            couple_weight[n_couple] = w / max(resist, _LEAST)
                                            n_couple += 1
                                        last_k, last_t = conductor[body], s1
                                        last_deep = r1[k] > pb + _SNAP * length
                                        resist = 0.0
                                    else:
                                        kappa = body_eps[body] / eps_r[axis, node]
                                        resist += (s1 - s0) / length / kappa
                                    pos = s1
                                k += 1
                            if not touched:
                                continue
                            if pos < pb:
                                resist += (pb - pos) / length
                            if first_k < 0:
                                # dielectric only
                                if abs(resist - 1.0) > 1e-9:
                                    change = w / resist - w
                                    if cut < 0:
                                        weight[axis, node] += change
                                    else:
                                        extra[na if na >= 0 else nb] += change
                                    energy_link[n_energy, 0], energy_link[n_energy, 1] = na, nb
                                    energy_end[n_energy] = ea if na < 0 else eb
                                    energy_weight[n_energy], energy_kind[n_energy] = change, 1
                                    n_energy += 1
                                continue
                            if (
                                first_deep
                                and last_deep
                                and first_r <= 0.0
                                and resist <= 0.0
                                and (na < 0 or (owner[na] == -1 and inside[na] < 0))
                                and (nb < 0 or (owner[nb] == -1 and inside[nb] < 0))
                                and cut < 0
                            ):
                                continue  # the body runs beside the link, not across it
                            if cut < 0:
                                weight[axis, node] -= w
                            else:
                                extra[na if na >= 0 else nb] -= w
                            inner = w
                            for side in range(2):
                                r, s = (
                                    (first_r, first_s)
                                    if side == 0
                                    else (resist, (pb - last_t) / length)
                                )
                                tied = na if side == 0 else nb
                                deep = first_deep if side == 0 else last_deep
                                free = tied >= 0 and owner[tied] == -1
                                if free and (inside[tied] >= 0 or (r <= 0.0 and deep)):
                                    continue  # no field on this side
                                least = _LEAST if free else min(contact / length, 1.0)
                                r = max(r, least)
                                inner -= w * r
                                tie_node[n_tie] = tied if free else -1
                                tie_weight[n_tie] = w / r
                                tie_conductor[n_tie] = first_k if side == 0 else last_k
                                if free:
                                    extra[tied] += w / r
                                _tie_value(
                                    n_tie,
                                    side,
                                    s,
                                    r,
                                    na,
                                    nb,
                                    ea,
                                    eb,
                                    stride,
                                    m,
                                    last,
                                    part,
                                    cut,
                                    pa,
                                    pb,
                                    c,
                                    kink,
                                    tie_point,
                                    tie_coef,
                                    tie_end,
                                    tie_end_coef,
                                )
                                n_tie += 1
                            energy_link[n_energy, 0], energy_link[n_energy, 1] = na, nb
                            energy_end[n_energy] = ea if na < 0 else eb
                            energy_weight[n_energy], energy_kind[n_energy] = inner, 0
                            n_energy += 1
                        m += 1
    # links that are left between a node inside a conductor and one outside
    for i in range(n_inside):
        a = inside_nodes[i]
        for axis in range(3):
            stride = strides[axis]
            for way in range(2):
                lower = a if way == 0 else a - stride
                b = a + stride if way == 0 else a - stride
                if cut_index[axis, lower] >= 0:
                    continue
                if n_tie + 8 > tie_node.shape[0] or n_energy + 4 > energy_weight.shape[0]:
                    return 2
                if inside[b] >= 0:
                    if way == 0:
                        weight[axis, lower] = 0.0
                        energy_link[n_energy, 0], energy_link[n_energy, 1] = a, b
                        energy_end[n_energy] = -3
                        energy_weight[n_energy] = base_weight[axis, lower]
                        energy_kind[n_energy] = 0
                        n_energy += 1
                    continue
                w = weight[axis, lower]
                weight[axis, lower] = 0.0
                if w <= 1e-5 * base_weight[axis, lower]:
                    continue
                free = owner[b] == -1
                tie_node[n_tie] = b if free else -1
                tie_weight[n_tie] = w
                tie_conductor[n_tie] = inside[a]
                for k in range(4):
                    tie_point[n_tie, k], tie_coef[n_tie, k] = a, 0.0
                tie_coef[n_tie, 0] = 1.0
                tie_end[n_tie], tie_end_coef[n_tie] = -3, 0.0
                if free:
                    extra[b] += w
                n_tie += 1
    counts[0], counts[1], counts[2] = n_tie, n_energy, n_couple
    return 0


@njit(cache=True)
def _tie_value(
    i,
    side,
    s,
    r,
    na,
    nb,
    ea,
    eb,
    stride,
    m,
    last,
    part,
    cut,
    pa,
    pb,
    c,
    kink,
    tie_point,
    tie_coef,
    tie_end,
    tie_end_coef,
):
    """Coefficients of the background potential at a crossing, from nodes along the line.

    Cubic where both neighbours beyond the link are smooth, of lower order beside an electrode or
    a layer's face. The drop over a dielectric in front of the conductor is added linearly.
    """
    for k in range(4):
        tie_point[i, k], tie_coef[i, k] = 0, 0.0
    tie_end[i], tie_end_coef[i] = -3, 0.0
    f = s if side == 0 else 1.0 - s
    if cut >= 0:
        node, end = (na, eb) if na >= 0 else (nb, ea)
        g = f if na >= 0 else 1.0 - f
        shift = s - r if side == 0 else r - s
        sign = 1.0 if na >= 0 else -1.0
        tie_point[i, 0], tie_coef[i, 0] = node, 1.0 - g + shift * sign
        tie_end[i], tie_end_coef[i] = end, g - shift * sign
        return
    before = m > 0 and not kink[na]
    after = m + 1 < last and not kink[nb]
    t = pa + f * (pb - pa)
    tie_point[i, 1], tie_point[i, 2] = na, nb
    tie_point[i, 0] = na - stride if before else na
    tie_point[i, 3] = nb + stride if after else nb
    x1, x2 = pa, pb
    x0 = c[m - 1] if before else 0.0
    x3 = c[m + 2] if after else 0.0
    l1, l2 = (t - x2) / (x1 - x2), (t - x1) / (x2 - x1)
    if before:
        l1 *= (t - x0) / (x1 - x0)
        l2 *= (t - x0) / (x2 - x0)
    if after:
        l1 *= (t - x3) / (x1 - x3)
        l2 *= (t - x3) / (x2 - x3)
    if before:
        l0 = (t - x1) * (t - x2) / ((x0 - x1) * (x0 - x2))
        if after:
            l0 *= (t - x3) / (x0 - x3)
        tie_coef[i, 0] = l0
    if after:
        l3 = (t - x1) * (t - x2) / ((x3 - x1) * (x3 - x2))
        if before:
            l3 *= (t - x0) / (x3 - x0)
        tie_coef[i, 3] = l3
    # phi_eff = phi_c + (s - r)(phi_near - phi_far): zero unless a dielectric lies in between
    shift = s - r if side == 0 else r - s
    tie_coef[i, 1] = l1 + shift
    tie_coef[i, 2] = l2 - shift
