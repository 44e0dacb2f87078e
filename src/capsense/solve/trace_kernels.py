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

from capsense._jit import inlined, kernel
from capsense.solve.column_kernels import (
    MAX_STRETCHES,
    MESH_STRETCHES,
    covered_stretches,
)
from capsense.solve.finding_kernels import (
    add_energy,
    add_tie,
    room,
    value_beside_sheet,
    value_on_link,
)
from capsense.solve.inside_kernels import close_inside, mark_inside, place
from capsense.solve.matter_kernels import (
    MATTER,
    add_matter,
    clear_matter,
    clear_record,
    mix_matter,
    note_matter,
    note_shared,
    thinness,
)

_SNAP = 1e-6
"""Fraction of a link within which a surface counts as lying on a node."""
_LEAST = 1e-3
"""Smallest fraction of a link between a free node and a conductor."""
_THIN = 1e-9
"""Layers of a column thinner than this part of it are none."""
FULL, CROWDED, SHORT = 0, 1, 2
"""Outcomes of a scan: whole; more stretches on a line than fit; more findings than fit."""
ROOM = np.dtype(
    [
        ("ends", np.float64, (7, 2 * MAX_STRETCHES)),
        ("bodies", np.int64, (3, 2 * MAX_STRETCHES)),
        ("stretches", np.float64, (MESH_STRETCHES, 2)),
        ("own", MATTER),
        ("dielectrics", np.bool_),
    ]
)
"""Room for the stretches of a line, for what matter does to a link, and whether there is matter."""


@kernel
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
    _sort(cuts, m)
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


@kernel
def _sort(values, n):
    """Put the first n values in order."""
    for k in range(1, n):
        value, at = values[k], k
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


@kernel
def _join(joined, a, b):
    while joined[a] != a:
        a = joined[a]
    while joined[b] != b:
        b = joined[b]
    if a < b:
        joined[b] = a
    elif b < a:
        joined[a] = b


@kernel
def trace(storeys, axes, faces, nodes, links, cuts, ceiling, parent, home, stored, bodies, grids,
          contact, joined, weight, extra, inside, inside_nodes, ties, energies, couples, within,
          counts, space, near, parts, matter, touched):  # fmt: skip
    """Scan a scene: change ``weight`` (3, n) and ``extra`` (n,), list ties, energies and couples.

    ``stored`` (n, pairs) holds the energies of the links to the next nodes, for each pair of
    terminals; those that lie inside conductors are summed in ``within`` (pairs,) where whole.
    ``joined[c]`` leads from a conductor to one it touches. ``counts`` holds the numbers of ties,
    energies, couples, nodes inside conductors, and links in matter. ``space`` (a ``ROOM``),
    ``near`` and ``parts`` (bodies,), ``matter`` (3, n) and ``touched`` (3 n,) are room to work in.
    Returns ``FULL``, ``CROWDED`` or ``SHORT``.
    """
    counts[:3] = 0
    space.dielectrics = False
    for m in range(bodies.shape[0]):
        space.dielectrics = space.dielectrics or bodies[m].conductor < 0
    counts[3] = mark_inside(storeys, axes, nodes, ceiling, parent, bodies, grids, inside,
                            inside_nodes, counts[3], space.stretches)  # fmt: skip
    for s in range(storeys.shape[0]):
        for axis in range(3):
            status = _trace_axis(
                storeys[s], axis, axes, faces, nodes, links, cuts, bodies, grids, contact, joined,
                weight, extra, inside, ties, energies, couples, counts, space, near, parts,
                matter, touched,
            )  # fmt: skip
            if status != FULL:
                clear_matter(matter, touched, counts)
                return status
    if not mix_matter(storeys, axes, nodes, links, inside, matter, touched, weight, ties, energies,
                      couples, counts):  # fmt: skip
        return SHORT
    if not close_inside(storeys, nodes, links, cuts, stored, weight, extra, inside, inside_nodes,
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


@kernel
def _trace_axis(storey, axis, axes, faces, nodes, links, cuts, bodies, grids, contact, joined,
                weight, extra, inside, ties, energies, couples, counts, space, near,
                parts, matter, touched):  # fmt: skip
    """Scan the lines of a storey along one axis; lines on the walls carry no unknowns."""
    p, q = 1 if axis == 0 else 0, 1 if axis == 2 else 2
    shape, begin = storey.shape, storey.begin
    strides = (shape[1] * shape[2], shape[2], 1)
    stride, sp, sq = strides[axis], strides[p], strides[q]
    c = axes[begin[axis] : begin[axis] + shape[axis]]
    cp, fp = axes[begin[p] : begin[p] + shape[p]], faces[begin[p] : begin[p] + shape[p]]
    cq, fq = axes[begin[q] : begin[q] + shape[q]], faces[begin[q] : begin[q] + shape[q]]
    lowest, highest = storey.lowest[axis], storey.highest[axis]
    t0, t1, u0, u1 = space.ends[0], space.ends[1], space.ends[2], space.ends[3]
    r0, r1, ends = space.ends[4], space.ends[5], space.ends[6]
    who, uwho, rwho = space.bodies[0], space.bodies[1], space.bodies[2]
    scratch = space.stretches
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
                n_near, grids, t0, t1, who, parts, scratch,
            )  # fmt: skip
            if total == 0:
                continue
            if total < 0:
                return CROWDED
            # where bodies fill different parts of the column, it is met layer by layer
            lower = 0.0
            while True:
                upper = _next_edge(lower, total, who, parts)
                if upper == math.inf:
                    break
                n = 0
                for k in range(total):
                    part = parts[who[k]]
                    if part.begin <= lower + _THIN and part.begin + part.weight >= upper - _THIN:
                        u0[n], u1[n], uwho[n] = t0[k], t1[k], who[k]
                        n += 1
                n = _resolve(n, u0, u1, uwho, bodies, r0, r1, rwho, ends, joined)
                line = storey.first + ip * sp + iq * sq
                if n > 0 and not _lay_line(
                    axis, line, stride, c, lowest, highest, upper - lower, n, r0, r1, rwho, parts,
                    nodes, links, cuts, bodies, contact, weight, extra, inside, ties, energies,
                    couples, counts, space, matter, touched,
                ):  # fmt: skip
                    return SHORT
                lower = upper
    return FULL


@kernel
def _next_edge(lower, total, who, parts):
    """Where the next layer of a column ends, above ``lower``; infinite above the last."""
    out = math.inf
    for k in range(total):
        part = parts[who[k]]
        for edge in (part.begin, part.begin + part.weight):
            if lower + _THIN < edge < out:
                out = edge
    return out


@inlined
def _lay_line(axis, line, stride, c, lowest, highest, share, n, r0, r1, rwho, parts, nodes, links,
              cuts, bodies, contact, weight, extra, inside, ties, energies, couples,
              counts, space, matter, touched):  # fmt: skip
    """Lay ``n`` disjoint stretches over the links of a line; False: the findings do not fit."""
    last = c.shape[0] - 1
    m = max(0, place(c, r0[0]) - 1)
    seg = 0
    while m < last:
        while seg < n and r1[seg] <= c[m]:
            seg += 1
        if seg == n:
            break
        if r0[seg] >= c[m + 1]:
            m = max(m + 1, place(c, r0[seg]) - 1)
            continue
        a = line + m * stride
        b = a + stride
        link = links[axis, a]
        whole_inside = link.cut < 0 and inside[a] >= 0 and inside[b] >= 0
        one_sheet = nodes[a].owner != -1 and nodes[a].owner == nodes[b].owner
        here = link.cut >= 0 or link.weight > 0.0 or space.dielectrics
        if here and not whole_inside and not one_sheet:
            if not room(ties, energies, couples, counts):
                return False
            for part in range(1 if link.cut < 0 else 2):
                _lay_link(axis, a, b, link, part, c, m, lowest, highest, share, seg, n, r0, r1,
                          rwho, parts, nodes, cuts, bodies, contact, weight, extra, inside, ties,
                          energies, couples, counts, space, matter, touched)  # fmt: skip
        m += 1
    return True


@inlined
def _lay_link(axis, a, b, link, part, c, m, lowest, highest, share, seg, n, r0, r1, rwho, parts,
              nodes, cuts, bodies, contact, weight, extra, inside, ties, energies, couples,
              counts, space, matter, touched):  # fmt: skip
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
    own = space.own
    clear_record(own)
    first_r, first_t, first_c, first_deep = -1.0, pa, -1, False
    last_t, last_c, last_deep = pa, -1, False
    off_line = 0.0
    met, parted = False, False
    while k < n and r0[k] < pb:
        s0, s1 = max(r0[k], pa), min(r1[k], pb)
        if s1 > s0:
            who = bodies[rwho[k]].conductor
            met = True
            if s0 > pos:
                resist += (s0 - pos) / length
            if who >= 0:
                off_line = max(off_line, parts[rwho[k]].aside)
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
                body = bodies[rwho[k]]
                kappa = body.eps_r / link.eps_r
                resist += (s1 - s0) / length / kappa
                filled = (s1 - s0) / length
                add_matter(own, filled, (0.5 * (s0 + s1) - pa) / length, kappa,
                           thinness(max(r1[k] - r0[k], body.breadth), length))  # fmt: skip
            pos = s1
        k += 1
    if not met:
        return
    if pos < pb:
        resist += (pb - pos) / length
    inside_a = na >= 0 and inside[na] >= 0
    inside_b = nb >= 0 and inside[nb] >= 0
    free_a = na >= 0 and nodes[na].owner == -1
    free_b = nb >= 0 and nodes[nb].owner == -1
    if link.cut < 0 and space.dielectrics:
        if first_c < 0 and share >= 1.0 - _THIN and not inside_a and not inside_b:
            note_matter(matter, touched, counts, axis, a, own, resist)
            return
        note_shared(matter, touched, counts, axis, a)
        if link.weight == 0.0:
            return  # another storey has this link
    if first_c < 0:
        # dielectric only
        if abs(resist - 1.0) <= 1e-9:
            return
        change = w / resist - w
        if inside_a or inside_b:
            # one end is at the potential of a conductor that fills less of the column
            near, far = (na, nb) if inside_a else (nb, na)
            free = free_b if inside_a else free_a
            add_tie(ties, counts, extra, far if free else -1, inside[near], far, end, change)
            return
        if link.cut < 0:
            weight[axis, a] += change
        else:
            extra[na if na >= 0 else nb] += change
        add_energy(energies, counts, na, nb, end, change, True)
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
            value_beside_sheet(tie, na, nb, end, (t - pa) / length, shift)
        else:
            value_on_link(tie, a, b, nodes, c, m, lowest, highest, t, shift)
        counts[0] += 1
    add_energy(energies, counts, na, nb, end, inner, False)
