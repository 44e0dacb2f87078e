"""Compiled set-up of the operator of a scene and of its incomplete factors.

The preconditioner is a modified incomplete Cholesky factorisation without fill-in (Gustafsson
1978). Every pass goes storey by storey, column by column; ``storeys`` holds a row (first node, nx,
ny, nz) for each.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import kernel
from capsense._simd import LANES, at, madd, put, put_span, span, splat, vadd, vmadd

_RELAX = np.float32(0.97)
"""Share of the dropped fill-in that is moved to the diagonal."""
_LOWEST = np.float32(0.02)
"""Smallest pivot, as a part of the diagonal."""
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_ROWS = 4
"""Columns that are factorised together."""


@kernel
def factorise(weight, extra, unknown, storeys, ceiling, parent, share, diagonal, active, inverse,
              taken, changed):  # fmt: skip
    """Set up the operator and its incomplete factors, storey by storey.

    Sums the links and ties at each unknown; nodes inside a conductor are off: ``active`` 0. Writes
    the inverse pivots, zero at nodes that are off. Ties of ceiling nodes go to the nodes they stand
    for. A floor node's link upward is what leads to it from below, ``share`` holds each column's
    part in it, and its "pivot" is what the elimination of these columns takes from the node above.
    Lists the nodes that went on or off from ``changed[1]`` on, and their number in ``changed[0]``.
    ``taken`` (3, n) is room to work in.
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
                          taken, changed)  # fmt: skip
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
                      taken, changed):  # fmt: skip
    """Pivots of a storey, four columns at a time.

    A pivot waits for that of the node below, for a division each time. Four columns, each one back
    along y from the one before it along x, need nothing of each other, and wait together.
    """
    sx, sy = ny * nz, nz
    aside = sx - sy
    tx, ty, tz = taken[0], taken[1], taken[2]
    _prepare(wx, wy, wz, extra, sx, sy, first + sx + sy, first + (nx - 1) * sx - sy, diagonal, tx,
             ty, tz)  # fmt: skip
    for i in range(1, nx - 1, _ROWS):
        for j in range(1, ny - 1 + _ROWS - 1):
            start = first + i * sx + j * sy
            if i + _ROWS < nx and j >= _ROWS and j < ny - 1:
                p, q = at(inverse, start), at(inverse, start + aside)
                r, s = at(inverse, start + 2 * aside), at(inverse, start + 3 * aside)
                for a in range(start + 1, start + nz - 1):
                    p = _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed,
                               a, p)  # fmt: skip
                    q = _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed,
                               a + aside, q)  # fmt: skip
                    r = _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed,
                               a + 2 * aside, r)  # fmt: skip
                    s = _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed,
                               a + 3 * aside, s)  # fmt: skip
                continue
            for k in range(_ROWS):
                if i + k < nx - 1 and j - k >= 1 and j - k < ny - 1:
                    begin = start + k * aside
                    p = at(inverse, begin)
                    for a in range(begin + 1, begin + nz - 1):
                        p = _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed,
                                   a, p)  # fmt: skip


@kernel
def _prepare(wx, wy, wz, extra, sx, sy, begin, end, diagonal, tx, ty, tz):
    """Diagonal at nodes [begin, end), eight at a time, and what its neighbours will take from it.

    These are factors of the inverse pivots of the nodes before along x, y and z. Nodes on the walls
    get numbers too, which mean nothing.
    """
    zero = splat(_ZERO)
    a = begin
    while a < end:
        k = max(min(a, end - LANES), begin - sy)  # in the smallest storeys, from a wall on
        x, y, z = span(wx, k - sx), span(wy, k - sy), span(wz, k - 1)
        full = vadd(span(wx, k), x)
        full = vadd(span(wy, k), vadd(y, full))
        full = vadd(span(wz, k), vadd(z, full))
        put_span(diagonal, k, vadd(span(extra, k), full))
        # fill-in towards nodes that are off is lost on ties, which are in the diagonal
        side = vadd(span(wy, k - sx), span(wz, k - sx))
        put_span(tx, k, vmadd(x, madd(_RELAX, side, x), zero))
        side = vadd(span(wx, k - sy), span(wz, k - sy))
        put_span(ty, k, vmadd(y, madd(_RELAX, side, y), zero))
        side = vadd(span(wx, k - 1), span(wy, k - 1))
        put_span(tz, k, vmadd(z, madd(_RELAX, side, z), zero))
        a += LANES


@kernel
def _pivot(unknown, sx, sy, diagonal, active, inverse, tx, ty, tz, changed, a, below):
    """Inverse pivot of node a, given that of the node below; notes if the node goes on or off."""
    full = at(diagonal, a)
    rest = full - at(tx, a) * at(inverse, a - sx) - at(ty, a) * at(inverse, a - sy)
    rest -= at(tz, a) * below
    on = at(unknown, a) != 0 and full > _ZERO
    out = _ONE / max(rest, _LOWEST * full)
    if not on:
        out = _ZERO
    put(inverse, a, out)
    now = np.uint8(on)
    if now != at(active, a):
        put(active, a, now)
        changed[0] += 1
        changed[changed[0]] = a
    return out
