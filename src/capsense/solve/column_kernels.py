"""Compiled columns of the scan: what share of a lattice line's surroundings a body fills.

A line stands for the column that reaches half-way to its neighbours. Everything here looks at one
line and the bodies near it; ``solve/trace_kernels.py`` lays the outcome over the line's links.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from capsense.scene.kernels import body_line_interval, mesh_line_intervals
from capsense.scene.shape import ShapeKind

_MESH = int(ShapeKind.MESH)
MAX_STRETCHES = 64
"""Stretches of one line inside bodies, over all bodies."""
MESH_STRETCHES = 4
"""Stretches of one line inside one mesh body."""
RAMP = 4.0
"""Steepness with which a body's share of a line's column turns into its weight.

At 1 the weight is the covered share itself, at infinity a line is met all or nothing. Smooth
motion asks for a small value; measured errors are smallest from 4 on (see docs/theory.md).
"""
WHOLE = 0.999
"""Weight above which a body is taken to fill the column."""


@njit(cache=True)
def _pierce(axis, p, q, op, oq, body, kinds, params, rotation, position, grids, grid_shape,
            grid_first, grid_origin, grid_inv, out):  # fmt: skip
    """Stretches of a line along ``axis`` inside one body, at (op, oq) across; return how many."""
    ox, oy, oz, dx, dy, dz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if axis == 0:
        oy, oz, dx = op, oq, 1.0
    elif axis == 1:
        ox, oz, dy = op, oq, 1.0
    else:
        ox, oy, dz = op, oq, 1.0
    if kinds[body] == _MESH:
        r, c = rotation[body], position[body]
        ax, ay, az = ox - c[0], oy - c[1], oz - c[2]
        s = grid_shape[body]
        first = grid_first[body]
        values = grids[first : first + s[0] * s[1] * s[2]].reshape((s[0], s[1], s[2]))
        return mesh_line_intervals(
            values, grid_origin[body], grid_inv[body],
            r[0, 0] * ax + r[1, 0] * ay + r[2, 0] * az,
            r[0, 1] * ax + r[1, 1] * ay + r[2, 1] * az,
            r[0, 2] * ax + r[1, 2] * ay + r[2, 2] * az,
            r[axis, 0], r[axis, 1], r[axis, 2], out,
        )  # fmt: skip
    out[0, 0], out[0, 1] = body_line_interval(
        kinds[body], params[body], rotation[body], position[body], ox, oy, oz, dx, dy, dz
    )
    return 1 if out[0, 1] > out[0, 0] else 0


@njit(cache=True)
def _chord(axis, at_p, at_q, through, low, high, body, kinds, params, rotation, position, grids,
           grid_shape, grid_first, grid_origin, grid_inv, out):  # fmt: skip
    """Part of [low, high] that a body covers around ``through`` on a line along ``axis``."""
    p = 1 if axis == 0 else 0
    q = 1 if axis == 2 else 2
    n = _pierce(axis, p, q, at_p, at_q, body, kinds, params, rotation, position, grids,
                grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip
    for k in range(n):
        if out[k, 0] - 1e-12 <= through and through <= out[k, 1] + 1e-12:
            return max(low, out[k, 0]), min(high, out[k, 1])
    return through, through


@njit(cache=True)
def _across(axis, along, t, u, v, low, high, body, kinds, params, rotation, position, grids,
            grid_shape, grid_first, grid_origin, grid_inv, out):  # fmt: skip
    """Chord along ``along`` through the point (t on ``axis``, u on ``along``, v on the third)."""
    third = 3 - axis - along
    if axis < third:
        return _chord(along, t, v, u, low, high, body, kinds, params, rotation, position, grids,
                      grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip
    return _chord(along, v, t, u, low, high, body, kinds, params, rotation, position, grids,
                  grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip


@njit(cache=True)
def covered_stretches(axis, p, q, op, oq, pl, ph, ql, qh, kinds, params, rotation, position,
                       bounds, conductor, bodies, n_bodies, grids, grid_shape, grid_first,
                       grid_origin, grid_inv, t0, t1, who, cover, out):  # fmt: skip
    """Stretches of a lattice line's column inside bodies, and the weight of each.

    The column of a line reaches half-way to its neighbours, [pl, ph] x [ql, qh]. A conductor's
    stretch is taken at the middle of what it covers of the column, and weighted by the share it
    covers, so that an edge that moves across a line makes it enter gradually. Dielectrics are met
    on the line itself. Returns the number of stretches, or −1 if they do not fit.
    """
    n = 0
    for m in range(n_bodies):
        body = bodies[m]
        if (
            ph < bounds[body, 0, p] or pl > bounds[body, 1, p]
            or qh < bounds[body, 0, q] or ql > bounds[body, 1, q]
        ):  # fmt: skip
            continue
        sp, sq = op, oq
        count = _pierce(axis, p, q, sp, sq, body, kinds, params, rotation, position, grids,
                        grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip
        if conductor[body] < 0:
            for k in range(count):
                if n == MAX_STRETCHES:
                    return -1
                t0[n], t1[n], who[n], cover[n] = out[k, 0], out[k, 1], body, 1.0
                n += 1
            continue
        trial = 0
        while count == 0 and trial < 8:
            # no hit in the middle: look at the column's edges and corners
            sp = pl if trial in (0, 4, 5) else (ph if trial in (1, 6, 7) else op)
            sq = ql if trial in (2, 4, 6) else (qh if trial in (3, 5, 7) else oq)
            trial += 1
            count = _pierce(axis, p, q, sp, sq, body, kinds, params, rotation, position, grids,
                            grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip
        if count == 0:
            continue
        middle = 0.5 * (out[0, 0] + out[0, 1])
        for k in range(1, count):
            if out[k, 1] - out[k, 0] > 2.0 * abs(out[0, 1] - middle):
                middle = 0.5 * (out[k, 0] + out[k, 1])
        if trial in (3, 4):
            ca, cb = _across(axis, q, middle, sq, sp, ql, qh, body, kinds, params, rotation,
                             position, grids, grid_shape, grid_first, grid_origin, grid_inv,
                             out)  # fmt: skip
            sq = 0.5 * (ca + cb)
            share = (cb - ca) / (qh - ql)
            ca, cb = _across(axis, p, middle, sp, sq, pl, ph, body, kinds, params, rotation,
                             position, grids, grid_shape, grid_first, grid_origin, grid_inv,
                             out)  # fmt: skip
            sp = 0.5 * (ca + cb)
            share *= (cb - ca) / (ph - pl)
        else:
            ca, cb = _across(axis, p, middle, sp, sq, pl, ph, body, kinds, params, rotation,
                             position, grids, grid_shape, grid_first, grid_origin, grid_inv,
                             out)  # fmt: skip
            sp = 0.5 * (ca + cb)
            share = (cb - ca) / (ph - pl)
            ca, cb = _across(axis, q, middle, sq, sp, ql, qh, body, kinds, params, rotation,
                             position, grids, grid_shape, grid_first, grid_origin, grid_inv,
                             out)  # fmt: skip
            sq = 0.5 * (ca + cb)
            share *= (cb - ca) / (qh - ql)
        share = 0.5 + RAMP * (share - 0.5)
        if share > WHOLE:
            share, sp, sq = 1.0, op, oq
        elif share <= 0.0:
            continue
        count = _pierce(axis, p, q, sp, sq, body, kinds, params, rotation, position, grids,
                        grid_shape, grid_first, grid_origin, grid_inv, out)  # fmt: skip
        for k in range(count):
            if out[k, 1] > out[k, 0]:
                if n == MAX_STRETCHES:
                    return -1
                t0[n], t1[n], who[n], cover[n] = out[k, 0], out[k, 1], body, share
                n += 1
    return n


@njit(cache=True)
def mark_inside(x, y, z, owner, kinds, params, rotation, position, bounds, conductor, n_bodies,
                grids, grid_shape, grid_first, grid_origin, grid_inv, inside, nodes):  # fmt: skip
    """Mark free nodes inside conductors with the conductor's index; return how many there are."""
    ny, nz = y.shape[0], z.shape[0]
    out = np.empty((MESH_STRETCHES, 2))
    found = 0
    for body in range(n_bodies):
        if conductor[body] < 0:
            continue
        for i in range(1, x.shape[0] - 1):
            if x[i] < bounds[body, 0, 0] or x[i] > bounds[body, 1, 0]:
                continue
            for j in range(1, ny - 1):
                if y[j] < bounds[body, 0, 1] or y[j] > bounds[body, 1, 1]:
                    continue
                count = _pierce(2, 0, 1, x[i], y[j], body, kinds, params, rotation, position,
                                grids, grid_shape, grid_first, grid_origin, grid_inv,
                                out)  # fmt: skip
                for k in range(count):
                    m = max(1, np.searchsorted(z, out[k, 0]))
                    while m < nz - 1 and z[m] <= out[k, 1]:
                        a = (i * ny + j) * nz + m
                        if owner[a] == -1 and inside[a] < 0:
                            inside[a] = conductor[body]
                            nodes[found] = a
                            found += 1
                        m += 1
    return found
