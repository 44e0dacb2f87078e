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

from capsense.solve.column_kernels import MAX_STRETCHES, MESH_STRETCHES, covered_stretches, pierce

_SNAP = 1e-6
"""Fraction of a link within which a surface counts as lying on a node."""
_LEAST = 1e-3
"""Smallest fraction of a link between a free node and a conductor."""
FULL, CROWDED, SHORT = 0, 1, 2
"""Outcomes of a scan: whole; more stretches on a line than fit; more findings than fit."""


STOREY = np.dtype(
    [
        ("first", np.int64),
        ("shape", np.int64, (3,)),
        ("begin", np.int64, (3,)),
        ("lowest", np.int64, (3,)),
        ("highest", np.int64, (3,)),
    ]
)
"""First node and shape of a storey, where its coordinates begin along each axis, and the first and
last node on a line whose values may be used together (the floor's and ceiling's may not)."""
LINK = np.dtype([("weight", np.float32), ("eps_r", np.float32), ("cut", np.int64)])
"""Weight and permittivity in the empty domain, and the number of the link's cut; −1: none."""
NODE = np.dtype([("owner", np.int64), ("kink", np.bool_), ("plain", np.bool_)])
"""What holds a node, whether the background field has a kink there, and whether its links along x,
y and z to the next nodes are all whole."""
CUT = np.dtype(
    [
        ("half", np.float64, (2,)),
        ("length", np.float64, (2,)),
        ("owner", np.int64, (2,)),
    ]
)
"""Weights of both half-links, their lengths as fractions of the link, what holds their ends."""
TIE = np.dtype(
    [
        ("node", np.int64),
        ("weight", np.float64),
        ("conductor", np.int64),
        ("point", np.int64, (4,)),
        ("coef", np.float64, (4,)),
        ("end", np.int64),
        ("end_coef", np.float64),
    ]
)
"""A conductance from a node (−1: a held end) to a conductor, at a place where the background
potential is ``Σ_k coef[k] φ[point[k]] + end_coef φ_end``."""
ENERGY = np.dtype(
    [
        ("a", np.int64),
        ("b", np.int64),
        ("end", np.int64),
        ("weight", np.float64),
        ("drives", np.bool_),
    ]
)
"""Adds ``weight · Δφ_i Δφ_j`` over a link from a to b (−1: the held ``end``). Where it drives, it
loads both ends too (a dielectric)."""
COUPLE = np.dtype([("a", np.int64), ("b", np.int64), ("weight", np.float64)])
"""Two conductors that face each other on one link."""


@njit(cache=True, nogil=True, error_model="numpy")
def _resolve(n, t0, t1, who, bodies, r0, r1, rwho, cuts, joined):
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
                this = bodies[who[k]].conductor
                if best < 0:
                    best = who[k]
                elif this >= 0 and bodies[best].conductor >= 0:
                    _join(joined, this, bodies[best].conductor)
                elif this >= 0 or (bodies[best].conductor < 0 and who[k] > best):
                    best = who[k]
        if best < 0:
            continue
        if out > 0 and a - r1[out - 1] <= 1e-12:
            last = rwho[out - 1]
            if last == best:
                r1[out - 1] = b
                continue
            if bodies[last].conductor >= 0 and bodies[best].conductor >= 0:
                _join(joined, bodies[last].conductor, bodies[best].conductor)
        r0[out], r1[out], rwho[out] = a, b, best
        out += 1
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _join(joined, a, b):
    while joined[a] != a:
        a = joined[a]
    while joined[b] != b:
        b = joined[b]
    if a < b:
        joined[b] = a
    elif b < a:
        joined[a] = b


@njit(cache=True, nogil=True, error_model="numpy")
def _place(c, t):
    """How many of the increasing numbers ``c`` lie below t."""
    low, high = 0, c.shape[0]
    while low < high:
        middle = (low + high) >> 1
        if c[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def mark_inside(storeys, axes, nodes, ceiling, parent, bodies, grids, inside, inside_nodes, before):
    """Mark free nodes inside conductors with the conductor's index, as seen along z.

    Clears the first ``before`` marks in ``inside_nodes``; returns how many nodes lie inside now.
    """
    for i in range(before):
        inside[inside_nodes[i]] = -1
    out = np.empty((MESH_STRETCHES, 2))
    n = 0
    for s in range(storeys.shape[0]):
        storey = storeys[s]
        first, begin = storey.first, storey.begin
        nx, ny, nz = storey.shape[0], storey.shape[1], storey.shape[2]
        x, y = axes[begin[0] : begin[0] + nx], axes[begin[1] : begin[1] + ny]
        z = axes[begin[2] : begin[2] + nz]
        for m in range(bodies.shape[0]):
            body = bodies[m]
            bounds = body.bounds
            if body.conductor < 0 or bounds[1, 2] < z[1] or bounds[0, 2] > z[nz - 2]:
                continue
            for i in range(1, nx - 1):
                if x[i] < bounds[0, 0] or x[i] > bounds[1, 0]:
                    continue
                for j in range(1, ny - 1):
                    if y[j] < bounds[0, 1] or y[j] > bounds[1, 1]:
                        continue
                    count = pierce(2, x[i], y[j], -math.inf, math.inf, body, grids, out)
                    for c in range(count):
                        k = max(1, _place(z, out[c, 0]))
                        while k < nz - 1 and z[k] <= out[c, 1]:
                            a = first + (i * ny + j) * nz + k
                            if nodes[a].owner == -1 and inside[a] < 0:
                                inside[a] = body.conductor
                                inside_nodes[n] = a
                                n += 1
                            k += 1
    for j in range(ceiling.shape[0]):
        if inside[parent[j]] >= 0:
            inside[ceiling[j]] = inside[parent[j]]
            inside_nodes[n] = ceiling[j]
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def trace(storeys, axes, faces, nodes, links, cuts, ceiling, parent, home, stored, bodies, grids,
          contact, joined, weight, extra, inside, inside_nodes, ties, energies, couples, within,
          counts):  # fmt: skip
    """Scan a scene: change ``weight`` (3, n) and ``extra`` (n,), list ties, energies and couples.

    ``stored`` (n, pairs) holds the energies of the links to the next nodes, for each pair of
    terminals; those that lie inside conductors are summed in ``within`` (pairs,) where whole.
    ``joined[c]`` leads from a conductor to one it touches. ``counts`` holds the numbers of ties,
    energies, couples and nodes inside conductors. Returns ``FULL``, ``CROWDED`` or ``SHORT``.
    """
    counts[:3] = 0
    counts[3] = mark_inside(storeys, axes, nodes, ceiling, parent, bodies, grids, inside,
                            inside_nodes, counts[3])  # fmt: skip
    for s in range(storeys.shape[0]):
        for axis in range(3):
            status = _trace_axis(
                storeys[s], axis, axes, faces, nodes, links, cuts, bodies, grids, contact, joined,
                weight, extra, inside, ties, energies, couples, counts,
            )  # fmt: skip
            if status != FULL:
                return status
    if not _close_inside(storeys, nodes, links, cuts, stored, weight, extra, inside, inside_nodes,
                         ties, energies, couples, within, counts):  # fmt: skip
        return SHORT
    for i in range(counts[0]):
        if ties[i].node >= 0:
            ties[i].node = home[ties[i].node]
    for i in range(counts[1]):
        if energies[i].a >= 0:
            energies[i].a = home[energies[i].a]
        if energies[i].b >= 0:
            energies[i].b = home[energies[i].b]
    return FULL


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_axis(storey, axis, axes, faces, nodes, links, cuts, bodies, grids, contact, joined,
                weight, extra, inside, ties, energies, couples, counts):  # fmt: skip
    """Scan the lines of a storey along one axis; lines on the walls carry no unknowns."""
    p, q = 1 if axis == 0 else 0, 1 if axis == 2 else 2
    shape, begin = storey.shape, storey.begin
    strides = (shape[1] * shape[2], shape[2], 1)
    stride, sp, sq = strides[axis], strides[p], strides[q]
    c = axes[begin[axis] : begin[axis] + shape[axis]]
    cp, fp = axes[begin[p] : begin[p] + shape[p]], faces[begin[p] : begin[p] + shape[p]]
    cq, fq = axes[begin[q] : begin[q] + shape[q]], faces[begin[q] : begin[q] + shape[q]]
    lowest, highest = storey.lowest[axis], storey.highest[axis]
    t0, t1 = np.empty(MAX_STRETCHES), np.empty(MAX_STRETCHES)
    who = np.empty(MAX_STRETCHES, np.int64)
    cover = np.empty(MAX_STRETCHES)
    u0, u1 = np.empty(MAX_STRETCHES), np.empty(MAX_STRETCHES)
    uwho = np.empty(MAX_STRETCHES, np.int64)
    r0, r1 = np.empty(2 * MAX_STRETCHES), np.empty(2 * MAX_STRETCHES)
    rwho = np.empty(2 * MAX_STRETCHES, np.int64)
    ends = np.empty(2 * MAX_STRETCHES)
    scratch = np.empty((MESH_STRETCHES, 2))
    near, aside = np.empty(bodies.shape[0], np.int64), np.empty(bodies.shape[0])
    for ip in range(1, cp.shape[0] - 1):
        n_near = 0
        for m in range(bodies.shape[0]):
            bounds = bodies[m].bounds
            if (
                bounds[0, p] <= fp[ip] and fp[ip - 1] <= bounds[1, p]
                and bounds[0, axis] <= c[c.shape[0] - 1] and c[0] <= bounds[1, axis]
            ):  # fmt: skip
                near[n_near] = m
                n_near += 1
        if n_near == 0:
            continue
        for iq in range(1, cq.shape[0] - 1):
            total = covered_stretches(
                axis, p, q, cp[ip], cq[iq], fp[ip - 1], fp[ip], fq[iq - 1], fq[iq], bodies, near,
                n_near, grids, t0, t1, who, cover, aside, scratch,
            )  # fmt: skip
            if total == 0:
                continue
            if total < 0:
                return CROWDED
            # bodies that fill different shares of the column are met layer by layer
            level = 0.0
            for k in range(total):
                level = max(level, cover[k])
            while level > 0.0:
                below = 0.0
                n = 0
                for k in range(total):
                    if cover[k] >= level:
                        u0[n], u1[n], uwho[n] = t0[k], t1[k], who[k]
                        n += 1
                    else:
                        below = max(below, cover[k])
                n = _resolve(n, u0, u1, uwho, bodies, r0, r1, rwho, ends, joined)
                line = storey.first + ip * sp + iq * sq
                if not _lay_line(axis, line, stride, c, lowest, highest, level - below, n, r0, r1,
                                 rwho, aside, nodes, links, cuts, bodies, contact, weight, extra,
                                 inside, ties, energies, couples, counts):  # fmt: skip
                    return SHORT
                level = below
    return FULL


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lay_line(axis, line, stride, c, lowest, highest, share, n, r0, r1, rwho, aside, nodes, links,
              cuts, bodies, contact, weight, extra, inside, ties, energies, couples,
              counts):  # fmt: skip
    """Lay ``n`` disjoint stretches over the links of a line; False: the findings do not fit."""
    last = c.shape[0] - 1
    m = max(0, _place(c, r0[0]) - 1)
    seg = 0
    while m < last:
        while seg < n and r1[seg] <= c[m]:
            seg += 1
        if seg == n:
            break
        if r0[seg] >= c[m + 1]:
            m = max(m + 1, _place(c, r0[seg]) - 1)
            continue
        a = line + m * stride
        b = a + stride
        link = links[axis, a]
        whole_inside = link.cut < 0 and inside[a] >= 0 and inside[b] >= 0
        one_sheet = nodes[a].owner != -1 and nodes[a].owner == nodes[b].owner
        if not whole_inside and not one_sheet and (link.cut >= 0 or link.weight > 0.0):
            if not _room(ties, energies, couples, counts):
                return False
            for part in range(1 if link.cut < 0 else 2):
                _lay_link(axis, a, b, link, part, c, m, lowest, highest, share, seg, n, r0, r1,
                          rwho, aside, nodes, cuts, bodies, contact, weight, extra, inside, ties,
                          energies, couples, counts)  # fmt: skip
        m += 1
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _room(ties, energies, couples, counts):
    """Whether the buffers hold what one link may add."""
    return (
        counts[0] + 8 <= ties.shape[0]
        and counts[1] + 4 <= energies.shape[0]
        and counts[2] + 8 <= couples.shape[0]
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _add_energy(energies, counts, a, b, end, weight, drives):
    term = energies[counts[1]]
    term.a, term.b, term.end, term.weight, term.drives = a, b, end, weight, drives
    counts[1] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _add_tie(ties, counts, extra, node, conductor, point, end, weight):
    """Tie a node (−1: a held end) to a conductor, where the background has a node's potential.

    That of the node ``point``; of the held ``end`` if this is −1.
    """
    tie = ties[counts[0]]
    tie.node, tie.conductor, tie.weight = node, conductor, weight
    for k in range(4):
        tie.point[k], tie.coef[k] = max(point, 0), 0.0
    tie.coef[0] = 1.0 if point >= 0 else 0.0
    tie.end, tie.end_coef = end, 1.0 if point < 0 else 0.0
    if node >= 0:
        extra[node] += weight
    counts[0] += 1


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _lay_link(axis, a, b, link, part, c, m, lowest, highest, share, seg, n, r0, r1, rwho, aside,
              nodes, cuts, bodies, contact, weight, extra, inside, ties, energies, couples,
              counts):  # fmt: skip
    """Change a link, or one part of a cut link, by the stretches on it from number ``seg`` on."""
    ta, tb = c[m], c[m + 1]
    pa, pb = ta, tb
    na, nb = a, b
    end = -3
    w = share * np.float64(link.weight)
    if link.cut >= 0:
        # a held sheet between the nodes splits the link in two
        cut = cuts[link.cut]
        w = share * cut.half[part]
        end = cut.owner[part]
        if part == 0:
            pb = ta + cut.length[0] * (tb - ta)
            nb = -1
        else:
            pa = tb - cut.length[1] * (tb - ta)
            na = -1
    length = pb - pa
    # series resistance up to the first conductor, and back from the last
    resist, pos, k = 0.0, pa, seg
    first_r, first_t, first_c, first_deep = -1.0, pa, -1, False
    last_t, last_c, last_deep = pa, -1, False
    off_line = 0.0
    touched, parted = False, False
    while k < n and r0[k] < pb:
        s0, s1 = max(r0[k], pa), min(r1[k], pb)
        if s1 > s0:
            who = bodies[rwho[k]].conductor
            touched = True
            if s0 > pos:
                resist += (s0 - pos) / length
            if who >= 0:
                off_line = max(off_line, aside[rwho[k]])
                if first_c < 0:
                    first_r, first_t, first_c = resist, s0, who
                    first_deep = r0[k] < pa - _SNAP * length
                elif last_c != who and resist > 0.0:
                    parted = True
                    pair = couples[counts[2]]
                    pair.a, pair.b, pair.weight = last_c, who, w / max(resist, _LEAST)
                    counts[2] += 1
                last_c, last_t = who, s1
                last_deep = r1[k] > pb + _SNAP * length
                resist = 0.0
            else:
                resist += (s1 - s0) / length * link.eps_r / bodies[rwho[k]].eps_r
            pos = s1
        k += 1
    if not touched:
        return
    if pos < pb:
        resist += (pb - pos) / length
    inside_a = na >= 0 and inside[na] >= 0
    inside_b = nb >= 0 and inside[nb] >= 0
    free_a = na >= 0 and nodes[na].owner == -1
    free_b = nb >= 0 and nodes[nb].owner == -1
    if first_c < 0:
        # dielectric only
        if abs(resist - 1.0) <= 1e-9:
            return
        change = w / resist - w
        if inside_a or inside_b:
            # one end is at the potential of a conductor that fills less of the column
            near, far = (na, nb) if inside_a else (nb, na)
            free = free_b if inside_a else free_a
            _add_tie(ties, counts, extra, far if free else -1, inside[near], far, end, change)
            return
        if link.cut < 0:
            weight[axis, a] += change
        else:
            extra[na if na >= 0 else nb] += change
        _add_energy(energies, counts, na, nb, end, change, True)
        return
    if (
        link.cut < 0 and not parted
        and first_deep and last_deep and first_r <= 0.0 and resist <= 0.0
        and free_a and free_b and not inside_a and not inside_b
    ):  # fmt: skip
        return  # the body runs beside the link, not across it
    hidden_a = inside_a or (first_r <= 0.0 and first_deep)
    hidden_b = inside_b or (resist <= 0.0 and last_deep)
    if off_line > 0.0:
        # a surface that ends beside the line draws less and less on a node that it comes abreast of
        ahead = math.inf
        if free_a and not hidden_a:
            ahead = first_t - pa
        if free_b and not hidden_b:
            ahead = min(ahead, pb - last_t)
        if ahead < math.inf:
            w *= ahead * ahead / (ahead * ahead + off_line * off_line)
    if link.cut < 0:
        weight[axis, a] -= w
    else:
        extra[na if na >= 0 else nb] -= w
    inner = w
    for side in range(2):
        if side == 0:
            r, t, tied, who = first_r, first_t, na, first_c
            free, hidden = free_a, hidden_a
        else:
            r, t, tied, who = resist, last_t, nb, last_c
            free, hidden = free_b, hidden_b
        if free and hidden:
            continue  # no field on this side
        r = max(r, _LEAST if free else min(contact / length, 1.0))
        inner -= w * r
        tie = ties[counts[0]]
        tie.node = tied if free else -1
        tie.weight = w / r
        tie.conductor = who
        if free:
            extra[tied] += w / r
        away = (t - pa) / length if side == 0 else (pb - t) / length
        shift = (away - r) * (1.0 if side == 0 else -1.0)
        if link.cut >= 0:
            _value_beside_sheet(tie, na, nb, end, (t - pa) / length, shift)
        else:
            _value_on_link(tie, a, b, nodes, c, m, lowest, highest, t, shift)
        counts[0] += 1
    _add_energy(energies, counts, na, nb, end, inner, False)


@njit(cache=True, nogil=True, error_model="numpy")
def _value_beside_sheet(tie, na, nb, end, s, shift):
    """Background potential at fraction s of a half-link from na or to nb: linear along it."""
    point, coef = tie.point, tie.coef
    for k in range(4):
        point[k], coef[k] = na if na >= 0 else nb, 0.0
    at_b = s - shift
    coef[0] = 1.0 - at_b if na >= 0 else at_b
    tie.end = end
    tie.end_coef = at_b if na >= 0 else 1.0 - at_b


@njit(cache=True, nogil=True, error_model="numpy")
def _value_on_link(tie, a, b, nodes, c, m, lowest, highest, t, shift):
    """Coefficients of the background potential at t on the link from a to b.

    Cubic where both neighbours beyond the link are smooth, of lower order beside an electrode or
    a layer's face, and at the ends of the line at ``lowest`` and ``highest``. The drop over a
    dielectric in front of the conductor is added linearly: ``phi(t) + shift (phi_a − phi_b)``.
    """
    stride = b - a
    before = m > lowest and m < highest and not nodes[a].kink
    after = m + 1 < highest and not nodes[b].kink
    x1, x2 = c[m], c[m + 1]
    l0, l1, l2, l3 = 0.0, (t - x2) / (x1 - x2), (t - x1) / (x2 - x1), 0.0
    if before:
        x0 = c[m - 1]
        l0 = (t - x1) * (t - x2) / ((x0 - x1) * (x0 - x2))
        l1 *= (t - x0) / (x1 - x0)
        l2 *= (t - x0) / (x2 - x0)
    if after:
        x3 = c[m + 2]
        l3 = (t - x1) * (t - x2) / ((x3 - x1) * (x3 - x2))
        l1 *= (t - x3) / (x1 - x3)
        l2 *= (t - x3) / (x2 - x3)
        if before:
            l0 *= (t - x3) / (c[m - 1] - x3)
            l3 *= (t - c[m - 1]) / (x3 - c[m - 1])
    point, coef = tie.point, tie.coef
    point[0], point[1] = a - stride if before else a, a
    point[2], point[3] = b, b + stride if after else b
    coef[0], coef[1], coef[2], coef[3] = l0, l1 + shift, l2 - shift, l3
    tie.end, tie.end_coef = -3, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _close_inside(storeys, nodes, links, cuts, stored, weight, extra, inside, inside_nodes, ties,
                  energies, couples, within, counts):  # fmt: skip
    """Turn what conductors leave of the links from nodes inside them into ties.

    Returns False if the findings do not fit.
    """
    within[:] = 0.0
    s = 0
    for i in range(counts[3]):
        a = inside_nodes[i]
        while a < storeys[s].first:
            s -= 1
        while s + 1 < storeys.shape[0] and a >= storeys[s + 1].first:
            s += 1
        strides = (storeys[s].shape[1] * storeys[s].shape[2], storeys[s].shape[2], 1)
        deep = nodes[a].plain
        for axis in range(3):
            deep = deep and inside[a + strides[axis]] >= 0
        if deep:
            for axis in range(3):
                weight[axis, a] = 0.0
            for k in range(within.shape[0]):
                within[k] += stored[a, k]
        half = 0.0
        for axis in range(3):
            for way in range(1 if deep else 0, 2):
                lower = a if way == 0 else a - strides[axis]
                b = a + strides[axis] if way == 0 else lower
                link = links[axis, lower]
                if link.cut >= 0:
                    half += cuts[link.cut].half[way]
                    continue
                if link.weight == 0.0 or (way == 1 and inside[b] >= 0):
                    continue
                if not _room(ties, energies, couples, counts):
                    return False
                if inside[b] >= 0:
                    weight[axis, lower] = 0.0
                    _add_energy(energies, counts, a, b, -3, link.weight, False)
                    continue
                w = weight[axis, lower]
                weight[axis, lower] = 0.0
                if w <= 1e-5 * link.weight:
                    continue
                free = nodes[b].owner == -1
                _add_tie(ties, counts, extra, b if free else -1, inside[a], a, -3, w)
        # what conductors leave of half-links to sheets
        rest = extra[a]
        extra[a] = 0.0
        if rest > 1e-5 * half:
            if not _room(ties, energies, couples, counts):
                return False
            _add_tie(ties, counts, extra, -1, inside[a], a, -3, rest)
    return True
