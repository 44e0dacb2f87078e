"""Compiled columns of the scan: what share of a lattice line's surroundings a body fills.

A line stands for the column that reaches half-way to its neighbours. Everything here looks at one
line and the bodies near it; ``solve/trace_kernels.py`` lays the outcome over the line's links.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import kernel
from capsense.scene.approach_kernels import approach, slenderness
from capsense.scene.kernels import body_line_interval, contains, mesh_line_intervals
from capsense.scene.layer_kernels import layer_line_intervals
from capsense.scene.shape import ShapeKind

_MESH = int(ShapeKind.MESH)
_LAYERS = int(ShapeKind.LAYERS)
MAX_STRETCHES = 64
"""Stretches of one line inside bodies, over all bodies."""
MESH_STRETCHES = 4
"""Stretches of one line inside one body given by a grid."""

RAMP = 4.0
"""Steepness with which a body's share of a line's column turns into its weight.

At 1 the weight is the covered share itself, at infinity a line is met all or nothing. Smooth
motion asks for a small value; measured errors are smallest from 4 on (see docs/theory.md).
"""
WHOLE = 0.999
"""Weight above which a body is taken to fill the column."""


BODY = np.dtype(
    [
        ("kind", np.int64),
        ("params", np.float64, (3,)),
        ("rotation", np.float64, (3, 3)),
        ("position", np.float64, (3,)),
        ("bounds", np.float64, (2, 3)),
        ("conductor", np.int64),
        ("eps_r", np.float64),
        ("breadth", np.float64),
        ("grid_first", np.int64),
        ("grid_shape", np.int64, (3,)),
        ("grid_origin", np.float64, (3,)),
        ("grid_inv", np.float64),
    ]
)
"""A body of a scene as the scan sees it: shape and pose, the index of a conductor (−1: dielectric),
a dielectric's breadth, and where the grid of a mesh or of layers begins among those of all."""

PART = np.dtype(
    [
        ("begin", np.float64),
        ("weight", np.float64),
        ("aside", np.float64),
        ("low", np.float64, (2,)),
        ("high", np.float64, (2,)),
    ]
)
"""What a body takes of a column: the part ``[begin, begin + weight]`` of its cross-section, how far
from the column's line it lies [m], and from where to where along both axes across [m]."""


@kernel
def pierce(axis, op, oq, low, high, body, grids, out):
    """Stretches of a line along ``axis`` inside one body, at (op, oq) across; return how many.

    All that lie in [low, high]; a stretch that goes on beyond may end there.
    """
    ox, oy, oz, dx, dy, dz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if axis == 0:
        oy, oz, dx = op, oq, 1.0
    elif axis == 1:
        ox, oz, dy = op, oq, 1.0
    else:
        ox, oy, dz = op, oq, 1.0
    r, c = body.rotation, body.position
    if body.kind == _MESH or body.kind == _LAYERS:
        ax, ay, az = ox - c[0], oy - c[1], oz - c[2]
        lx = r[0, 0] * ax + r[1, 0] * ay + r[2, 0] * az
        ly = r[0, 1] * ax + r[1, 1] * ay + r[2, 1] * az
        lz = r[0, 2] * ax + r[1, 2] * ay + r[2, 2] * az
        dx, dy, dz = r[axis, 0], r[axis, 1], r[axis, 2]
        s, first = body.grid_shape, body.grid_first
        if body.kind == _LAYERS:
            return layer_line_intervals(
                grids[first:], s, body.grid_origin, body.grid_inv, lx, ly, lz, dx, dy, dz,
                low, high, out,
            )  # fmt: skip
        values = grids[first : first + s[0] * s[1] * s[2]].reshape((s[0], s[1], s[2]))
        return mesh_line_intervals(
            values, body.grid_origin, body.grid_inv, lx, ly, lz, dx, dy, dz, low, high, out
        )
    out[0, 0], out[0, 1] = body_line_interval(body.kind, body.params, r, c, ox, oy, oz, dx, dy, dz)
    return 1 if out[0, 1] > out[0, 0] else 0


@kernel
def _chord(axis, along, t, u, v, low, high, body, grids, out):
    """Part of [low, high] that a body covers around a point on a line along ``along``.

    The point lies at t on ``axis``, u on ``along`` and v on the third axis. Returns both ends of
    the part, and the length of the whole stretch inside the body.
    """
    # far enough to tell how long a stretch is that is shorter than the part
    first, last = 2.0 * low - high, 2.0 * high - low
    if axis < 3 - axis - along:
        n = pierce(along, t, v, first, last, body, grids, out)
    else:
        n = pierce(along, v, t, first, last, body, grids, out)
    for k in range(n):
        if out[k, 0] - 1e-12 <= u and u <= out[k, 1] + 1e-12:
            return max(low, out[k, 0]), min(high, out[k, 1]), out[k, 1] - out[k, 0]
    return u, u, 0.0


@kernel
def thin_factor(wide_p, wide_q, across_p, across_q):
    """How much less than a wall a thin conductor inside a column takes from the column's field.

    A wire across a column, or a speck in it, only draws in field lines from around. Taken as a
    resistance between the line and the conductor: that of a wire in a screen of wires a column
    apart, or that of a small ball (Smythe 1950), each zero from a third of the column on.
    """
    wide = 0.5 * (wide_p + wide_q)
    thin, thick = min(across_p, across_q), max(across_p, across_q)
    if math.pi * thin >= wide:
        return 1.0
    if math.pi * thick >= wide:
        return 1.0 / (1.0 + 4.0 * math.log(wide / (math.pi * thin)) / (2.0 * math.pi))
    return 1.0 / (1.0 + 2.0 * (wide / (math.pi * max(thin, 1e-9)) - 1.0))


@kernel
def part_covered(low, node, high, a, b, extent):
    """Part of a column's side [low, high] that [a, b] covers; an edge at the node covers half.

    Of a body that is narrower than the side, the part of its own ``extent``.
    """
    if extent < high - low:
        return (b - a) / extent
    at_a = 0.5 * (a - low) / (node - low) if a < node else 1.0 - 0.5 * (high - a) / (high - node)
    at_b = 0.5 * (b - low) / (node - low) if b < node else 1.0 - 0.5 * (high - b) / (high - node)
    return at_b - at_a


@kernel
def _holds_cross(axis, p, q, t, pl, ph, ql, qh, sq, body):
    """Whether a convex body holds [pl, ph] at sq and [ql, qh] at its middle: a short cut."""
    r, c = body.rotation, body.position
    at_p, at_q, at_t = 0.5 * (pl + ph) - c[p], sq - c[q], t - c[axis]
    half, down, up = 0.5 * (ph - pl), ql - sq, qh - sq
    x = r[p, 0] * at_p + r[q, 0] * at_q + r[axis, 0] * at_t
    y = r[p, 1] * at_p + r[q, 1] * at_q + r[axis, 1] * at_t
    z = r[p, 2] * at_p + r[q, 2] * at_q + r[axis, 2] * at_t
    ux, uy, uz = half * r[p, 0], half * r[p, 1], half * r[p, 2]
    vx, vy, vz = r[q, 0], r[q, 1], r[q, 2]
    return (
        contains(body.kind, body.params, x - ux, y - uy, z - uz)
        and contains(body.kind, body.params, x + ux, y + uy, z + uz)
        and contains(body.kind, body.params, x + down * vx, y + down * vy, z + down * vz)
        and contains(body.kind, body.params, x + up * vx, y + up * vy, z + up * vz)
    )


@kernel
def _cover(axis, p, q, t, op, oq, sp, sq, pl, ph, ql, qh, body, grids, out, part):
    """Fill in what a body takes of a column at t around (sp, sq), its place in it apart.

    Its weight is the share of the column's cross-section that it covers, steepened. Of a rod or a
    speck in the column it counts how much of its own width the column holds.
    """
    least = slenderness(body.kind, body.params)
    if (least >= ph - pl or least >= qh - ql) and _holds_cross(axis, p, q, t, pl, ph, ql, qh, sq,
                                                              body):  # fmt: skip
        part.low[0], part.high[0], part.low[1], part.high[1] = pl, ph, ql, qh
        part.weight, part.aside = 1.0, 0.0
        return
    a, b, across_p = _chord(axis, p, t, sp, sq, pl, ph, body, grids, out)
    part.low[0], part.high[0] = a, b
    share = part_covered(pl, op, ph, a, b, max(across_p, least))
    aside_p = max(a - op, max(op - b, 0.0))
    a, b, across_q = _chord(axis, q, t, sq, 0.5 * (a + b), ql, qh, body, grids, out)
    part.low[1], part.high[1] = a, b
    share *= part_covered(ql, oq, qh, a, b, max(across_q, least))
    aside_q = max(a - oq, max(oq - b, 0.0))
    share = 0.5 + RAMP * (share - 0.5)
    if share > WHOLE:
        share = 1.0
    if least < ph - pl and least < qh - ql:
        share *= thin_factor(ph - pl, qh - ql, max(across_p, least), max(across_q, least))
    part.weight, part.aside = share, math.hypot(aside_p, aside_q)


@kernel
def nested(part, other):
    """How much of the smaller of two parts lies within the other: 0 beside, 1 inside."""
    share = 1.0
    for k in range(2):
        narrow = min(part.high[k] - part.low[k], other.high[k] - other.low[k])
        common = min(part.high[k], other.high[k]) - max(part.low[k], other.low[k])
        share *= min(max(common, 0.0) / narrow, 1.0) if narrow > 0.0 else 1.0
    return share


@kernel
def _place_beside(m, near, bodies, parts):
    """Where what conductor ``near[m]`` takes of a column begins: after what it lies beside of."""
    part = parts[near[m]]
    begin = 0.0
    if part.weight < 1.0:
        for k in range(m):
            other = parts[near[k]]
            if bodies[near[k]].conductor >= 0 and 0.0 < other.weight < 1.0:
                begin = max(begin, other.begin + (1.0 - nested(part, other)) * other.weight)
    part.begin = min(begin, 1.0 - part.weight)


@kernel
def _barely_covers(pl, op, ph, ql, oq, qh, p, q, body):
    """Whether a body's bounding box tells that its weight in a column is zero: a short cut."""
    least, bounds = slenderness(body.kind, body.params), body.bounds
    if least < ph - pl or least < qh - ql:
        return False
    a, b = max(pl, bounds[0, p]), min(ph, bounds[1, p])
    share = part_covered(pl, op, ph, a, b, math.inf)
    a, b = max(ql, bounds[0, q]), min(qh, bounds[1, q])
    share = min(share, part_covered(ql, oq, qh, a, b, math.inf))
    return 0.5 + RAMP * (share - 0.5) <= 0.0


@kernel
def _hit_column(axis, op, oq, pl, ph, ql, qh, body, grids, out):
    """Look for a body in a column whose line it misses: a place (sp, sq), and stretches there."""
    if body.kind == _MESH or body.kind == _LAYERS:
        for trial in range(8):
            sp = pl if trial in (0, 4, 5) else (ph if trial in (1, 6, 7) else op)
            sq = ql if trial in (2, 4, 6) else (qh if trial in (3, 5, 7) else oq)
            count = pierce(axis, sp, sq, -math.inf, math.inf, body, grids, out)
            if count > 0:
                return sp, sq, count
        return op, oq, 0
    if axis == 0:
        _, sp, sq = approach(body.kind, body.params, body.rotation, body.position, 0.0, op, oq, 0)
    elif axis == 1:
        sp, _, sq = approach(body.kind, body.params, body.rotation, body.position, op, 0.0, oq, 1)
    else:
        sp, sq, _ = approach(body.kind, body.params, body.rotation, body.position, op, oq, 0.0, 2)
    sp, sq = min(max(sp, pl), ph), min(max(sq, ql), qh)
    return sp, sq, pierce(axis, sp, sq, -math.inf, math.inf, body, grids, out)


@kernel
def covered_stretches(axis, p, q, op, oq, pl, ph, ql, qh, bodies, near, n_near, grids, t0, t1,
                      who, parts, out):  # fmt: skip
    """Stretches of a lattice line's column inside bodies, and what of the column they take.

    The column of a line reaches about half-way to its neighbours, [pl, ph] x [ql, qh]. A
    conductor's stretch is taken at the middle of what it covers of the column, and weighted by the
    share it covers, so that an edge that moves across a line makes it enter gradually. Dielectrics
    are met on the line itself. Fills in ``parts``, for each body. Returns the number of stretches,
    or −1 if they do not fit.
    """
    n = 0
    for m in range(n_near):
        body, part = bodies[near[m]], parts[near[m]]
        bounds = body.bounds
        part.begin, part.weight, part.aside = 0.0, 0.0, 0.0
        if ph < bounds[0, p] or pl > bounds[1, p] or qh < bounds[0, q] or ql > bounds[1, q]:
            continue
        sp, sq = op, oq
        count = pierce(axis, sp, sq, -math.inf, math.inf, body, grids, out)
        if body.conductor < 0:
            part.weight = 1.0
        else:
            centred = count > 0
            if not centred:
                if _barely_covers(pl, op, ph, ql, oq, qh, p, q, body):
                    continue
                sp, sq, count = _hit_column(axis, op, oq, pl, ph, ql, qh, body, grids, out)
                if count == 0:
                    continue
            a, b = out[0, 0], out[0, 1]
            for k in range(1, count):
                if out[k, 1] - out[k, 0] > b - a:
                    a, b = out[k, 0], out[k, 1]
            _cover(
                axis, p, q, 0.5 * (a + b), op, oq, sp, sq, pl, ph, ql, qh, body, grids, out, part
            )
            if part.weight <= 0.0:
                continue
            _place_beside(m, near, bodies, parts)
            if part.weight == 1.0 and centred and count == 1:
                out[0, 0], out[0, 1] = a, b
            else:
                if part.weight < 1.0 or not centred:
                    sp = 0.5 * (part.low[0] + part.high[0])
                    sq = 0.5 * (part.low[1] + part.high[1])
                count = pierce(axis, sp, sq, -math.inf, math.inf, body, grids, out)
                if count == 0:
                    part.weight = 0.0
        for k in range(count):
            if out[k, 1] > out[k, 0]:
                if n == MAX_STRETCHES:
                    return -1
                t0[n], t1[n], who[n] = out[k, 0], out[k, 1], near[m]
                n += 1
    return n
