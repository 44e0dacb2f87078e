"""Compiled set-up of the operator of a scene and of its incomplete factors.

The preconditioner is a modified incomplete Cholesky factorisation without fill-in (Gustafsson
1978). Every pass goes storey by storey, column by column; ``storeys`` holds a row (first node, nx,
ny, nz) for each.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import kernel
from capsense.solve.simd import at, put

_RELAX = np.float32(0.97)
"""Share of the dropped fill-in that is moved to the diagonal."""
_LOWEST = np.float32(0.02)
"""Smallest pivot, as a part of the diagonal."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_ROWS = 4
"""Columns that are factorised together."""


@kernel
def factorise(weight, extra, unknown, storeys, ceiling, parent, share, diagonal, active, inverse,
              changed):  # fmt: skip
    """Set up the operator and its incomplete factors, storey by storey.

    Sums the links and ties at each unknown; nodes inside a conductor are off: ``active`` 0. Writes
    the inverse pivots, zero at nodes that are off. Ties of ceiling nodes go to the nodes they stand
    for. A floor node's link upward is what leads to it from below, ``share`` holds each column's
    part in it, and its "pivot" is what the elimination of these columns takes from the node above.
    Lists the nodes that went on or off from ``changed[1]`` on, and their number in ``changed[0]``.
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
    changed[0] = 0
    done = 0
    for s in range(storeys.shape[0]):
        first, nx, ny, nz = storeys[s]
        _factorise_storey(wx, wy, wz, extra, unknown, first, nx, ny, nz, diagonal, active, inverse,
                          changed)  # fmt: skip
        stop = first + nx * ny * nz
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


@kernel
def _factorise_storey(wx, wy, wz, extra, unknown, first, nx, ny, nz, diagonal, active, inverse,
                      changed):  # fmt: skip
    """Pivots of a storey, four columns at a time.

    A pivot waits for that of the node below, for a division each time. Four columns, each one back
    along y from the one before it along x, need nothing of each other, and wait together.
    """
    sx, sy = ny * nz, nz
    aside = sx - sy
    for i in range(1, nx - 1, _ROWS):
        for j in range(1, ny - 1 + _ROWS - 1):
            start = first + i * sx + j * sy
            if i + _ROWS < nx and j >= _ROWS and j < ny - 1:
                p, q = at(inverse, start), at(inverse, start + aside)
                r, s = at(inverse, start + 2 * aside), at(inverse, start + 3 * aside)
                for a in range(start + 1, start + nz - 1):
                    p = _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse,
                               changed, a, p)  # fmt: skip
                    q = _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse,
                               changed, a + aside, q)  # fmt: skip
                    r = _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse,
                               changed, a + 2 * aside, r)  # fmt: skip
                    s = _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse,
                               changed, a + 3 * aside, s)  # fmt: skip
                continue
            for k in range(_ROWS):
                if i + k < nx - 1 and j - k >= 1 and j - k < ny - 1:
                    begin = start + k * aside
                    p = at(inverse, begin)
                    for a in range(begin + 1, begin + nz - 1):
                        p = _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse,
                                   changed, a, p)  # fmt: skip


@kernel
def _pivot(wx, wy, wz, extra, unknown, sx, sy, diagonal, active, inverse, changed, a, below):
    """Set up node a, given the inverse pivot of the node below; returns its own."""
    b, c, d = a - sx, a - sy, a - 1
    x, y, z = at(wx, b), at(wy, c), at(wz, d)
    full = at(wx, a) + x + at(wy, a) + y + at(wz, a) + z + at(extra, a)
    # fill-in towards nodes that are off is lost on ties, which are in the diagonal
    taken = x * at(inverse, b) * (x + _RELAX * (at(wy, b) + at(wz, b)))
    taken += y * at(inverse, c) * (y + _RELAX * (at(wx, c) + at(wz, c)))
    rise = z * (z + _RELAX * (at(wx, d) + at(wy, d)))
    on = at(unknown, a) != 0 and full > _ZERO
    out = _ONE / max(full - taken - rise * below, _LOWEST * full)
    if not on:
        out = _ZERO
    put(diagonal, a, full)
    put(inverse, a, out)
    now = np.uint8(on)
    if now != at(active, a):
        put(active, a, now)
        changed[0] += 1
        changed[changed[0]] = a
    return out
