"""Compiled line intersections of layered depth images, called from the solver's kernels.

A slot of a layered image holds three numbers at every pixel centre: front and back [m] along z, and
the margin, which is the distance to the silhouette in pixels, positive where hit. The solid
is where the margin is not negative and z lies between front and back. Numbers are interpolated
linearly from pixel to pixel; where front or back jumps by more than the limit, the ramp between the
two pixels narrows around their middle, so that a step stays a step, and does so continuously. The
readable twin is :mod:`capsense.scene.layer_reference`; ``docs/depth.md`` gives the rules in words.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

HEADER = 2
"""Numbers in front of the table: reciprocal of the pixel's height [1/m], limit of a step [m]."""
TABLE = 6
"""Numbers a slot: first and last column, first and last row, nearest front, farthest back [m]."""
BLOCK = 8
"""Pixels along the side of a block; it shares its outer ones with its neighbours. Of each block
are kept the nearest front, the farthest front, the nearest back and the farthest back [m]."""
_TINY = 1e-12
"""Slope to the view axis below which a line counts as parallel to it."""


@njit(cache=True, error_model="numpy")
def blend(a: float, b: float, s: float, limit: float) -> float:
    """Value at fraction ``s`` between two pixels; a ramp above ``limit`` narrows about 1/2."""
    jump = abs(b - a)
    if jump > limit:
        s = min(max((s - 0.5) * jump / limit + 0.5, 0.0), 1.0)
    return a + (b - a) * s


@njit(cache=True, error_model="numpy")
def _at(
    values: Array32, base: int, nx: int, u: float, v: float, limit: float
) -> tuple[float, float, float]:
    """Front, back and margin of a slot at (u, v) in pixels, which lies in the grid.

    Rows are interpolated first, then across; on a grid line only the two pixels of a link count.
    """
    i = int(u)
    j = int(v)
    u -= i
    v -= j
    a = base + 3 * (j * nx + i)
    f, b, m = float(values[a]), float(values[a + 1]), float(values[a + 2])
    if u > 0.0:
        f = blend(f, values[a + 3], u, limit)
        b = blend(b, values[a + 4], u, limit)
        m += (values[a + 5] - m) * u
    if v > 0.0:
        a += 3 * nx
        f1, b1, m1 = float(values[a]), float(values[a + 1]), float(values[a + 2])
        if u > 0.0:
            f1 = blend(f1, values[a + 3], u, limit)
            b1 = blend(b1, values[a + 4], u, limit)
            m1 += (values[a + 5] - m1) * u
        f = blend(f, f1, v, limit)
        b = blend(b, b1, v, limit)
        m += (m1 - m) * v
    return f, b, m


@njit(cache=True, error_model="numpy")
def add_stretch(a: float, b: float, out: Array, n: int) -> int:
    """Unite [a, b] with the first ``n`` ascending, disjoint rows of ``out``; return their number.

    Where there is no room for a further row, the last two are joined, gap included.
    """
    low = 0
    while low < n and out[low, 1] < a:
        low += 1
    high = low
    while high < n and out[high, 0] <= b:
        a = min(a, out[high, 0])
        b = max(b, out[high, 1])
        high += 1
    if high == low:
        if n == out.shape[0]:
            if low == n:
                out[n - 1, 1] = b
                return n
            out[n - 2, 1] = out[n - 1, 1]
            n -= 1
            if low > n - 1:
                out[n - 1, 0] = min(a, out[n - 1, 0])
                return n
        for k in range(n, low, -1):
            out[k, 0], out[k, 1] = out[k - 1, 0], out[k - 1, 1]
        n += 1
    else:
        shift = high - low - 1
        if shift > 0:
            for k in range(high, n):
                out[k - shift, 0], out[k - shift, 1] = out[k, 0], out[k, 1]
            n -= shift
    out[low, 0], out[low, 1] = a, b
    return n


@njit(cache=True, error_model="numpy")
def _positive(c0: float, c1: float, low: float, high: float) -> tuple[float, float]:
    """Part of [low, high] in which the line from (0, c0) to (1, c1) is not negative."""
    if c0 >= 0.0:
        if c1 < 0.0:
            high = min(high, c0 / (c0 - c1))
    elif c1 >= 0.0:
        low = max(low, c0 / (c0 - c1))
    else:
        high = -1.0
    return low, high


@njit(cache=True, error_model="numpy")
def _width(jump: float, limit: float) -> float:
    """Half the width of a ramp, in parts of a link."""
    return 0.5 if jump <= limit else 0.5 * limit / jump


@njit(cache=True, error_model="numpy")
def _steps(
    t0: float, z0: float, f0: float, b0: float, m0: float,
    t1: float, z1: float, f1: float, b1: float, m1: float,
    limit: float, out: Array, n: int,
) -> int:  # fmt: skip
    """Stretches between two samples one of whose surfaces jumps: up to five linear pieces."""
    wf, wb = _width(abs(f1 - f0), limit), _width(abs(b1 - b0), limit)
    narrow, wide = min(wf, wb), max(wf, wb)
    last = 0.0
    for piece in range(5):
        if piece == 0:
            end = 0.5 - wide
        elif piece == 1:
            end = 0.5 - narrow
        elif piece == 2:
            end = 0.5 + narrow
        elif piece == 3:
            end = 0.5 + wide
        else:
            end = 1.0
        if end <= last:
            continue
        za, zb = z0 + (z1 - z0) * last, z0 + (z1 - z0) * end
        low, high = _positive(m0 + (m1 - m0) * last, m0 + (m1 - m0) * end, 0.0, 1.0)
        low, high = _positive(
            za - blend(f0, f1, last, limit), zb - blend(f0, f1, end, limit), low, high
        )
        low, high = _positive(
            blend(b0, b1, last, limit) - za, blend(b0, b1, end, limit) - zb, low, high
        )
        if low < high:
            a, b = last + low * (end - last), last + high * (end - last)
            n = add_stretch(t0 + a * (t1 - t0), t0 + b * (t1 - t0), out, n)
        last = end
    return n


@njit(cache=True, error_model="numpy")
def _clip(o: float, d: float, low: float, high: float, t0: float, t1: float) -> tuple[float, float]:
    """Part of [t0, t1] in which low <= o + t d <= high."""
    if d == 0.0:
        if o < low or o > high:
            return math.inf, -math.inf
        return t0, t1
    a, b = (low - o) / d, (high - o) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@njit(cache=True, error_model="numpy")
def _ahead(p: float, u: float, t: float, cell: float) -> tuple[float, float, float]:
    """Next grid line of spacing ``cell`` at or ahead of parameter t: place, time, and spacing."""
    if u == 0.0:
        return 0.0, math.inf, 0.0
    if u > 0.0:
        place = (math.floor((p + t * u) / cell) + 1.0) * cell
        return place, (place - p) / u, cell
    place = (math.ceil((p + t * u) / cell) - 1.0) * cell
    return place, (place - p) / u, -cell


@njit(cache=True, error_model="numpy")
def _walk(
    values: Array32, base: int, nx: int, limit: float, i0: float, i1: float, j0: float, j1: float,
    px: float, py: float, oz: float, ux: float, uy: float, dz: float, t0: float, t1: float,
    start: float, end: float, out: Array, n: int,
) -> tuple[float, float, int]:  # fmt: skip
    """Follow a line from pixel to pixel over [t0, t1].

    [start, end] is the stretch found last, which may go on; none if end <= start. Returns the new
    one and how many are written.
    """
    grid_u, next_u, step_u = _ahead(px, ux, t0, 1.0)
    grid_v, next_v, step_v = _ahead(py, uy, t0, 1.0)
    u, v = min(max(px + t0 * ux, i0), i1), min(max(py + t0 * uy, j0), j1)
    f0, b0, m0 = _at(values, base, nx, u, v, limit)
    z0 = oz + t0 * dz
    while t0 < t1:
        if next_u <= next_v:
            t = next_u
            u, v = grid_u, py + t * uy
            grid_u += step_u
            next_u = (grid_u - px) / ux
        else:
            t = next_v
            u, v = px + t * ux, grid_v
            grid_v += step_v
            next_v = (grid_v - py) / uy
        if t >= t1:
            t = t1
            u, v = px + t * ux, py + t * uy
        t = max(t, t0)
        f, b, m = _at(values, base, nx, min(max(u, i0), i1), min(max(v, j0), j1), limit)
        z = oz + t * dz
        if m0 >= 0.0 or m >= 0.0:
            if abs(f - f0) > limit or abs(b - b0) > limit:
                if end > start:
                    n = add_stretch(start, end, out, n)
                n = _steps(t0, z0, f0, b0, m0, t, z, f, b, m, limit, out, n)
                start, end = t, -math.inf
            else:
                low, high = _positive(m0, m, 0.0, 1.0)
                low, high = _positive(z0 - f0, z - f, low, high)
                low, high = _positive(b0 - z0, b - z, low, high)
                if low < high:
                    if low > 0.0 or end < t0:
                        if end > start:
                            n = add_stretch(start, end, out, n)
                        start = t0 + low * (t - t0)
                    end = t if high == 1.0 else t0 + high * (t - t0)
        t0, z0, f0, b0, m0 = t, z, f, b, m
    return start, end, n


@njit(cache=True, error_model="numpy")
def _cross_slot(
    values: Array32, table: int, base: int, blocks: int, nx: int, limit: float,
    px: float, py: float, oz: float, ux: float, uy: float, dz: float, out: Array, n: int,
) -> int:  # fmt: skip
    """Add the stretches of a line that runs across the view inside one slot.

    The line is sampled where it crosses the lines that join pixel centres; in between, front,
    back and margin go linearly from sample to sample, steps excepted. Blocks of pixels that it
    passes in front of, behind, or well inside are passed in one go.
    """
    i0, i1 = values[table], values[table + 1]
    j0, j1 = values[table + 2], values[table + 3]
    t0, last = _clip(px, ux, i0, i1, -math.inf, math.inf)
    t0, last = _clip(py, uy, j0, j1, t0, last)
    a, b = _clip(oz, dz, values[table + 4], values[table + 5], t0, last)
    if not a < b:
        return n
    # where the depths in question begin and end, out to the grid lines around
    t0 = max(t0, -_ahead(px, -ux, -a, 1.0)[1], -_ahead(py, -uy, -a, 1.0)[1])
    last = min(last, _ahead(px, ux, b, 1.0)[1], _ahead(py, uy, b, 1.0)[1])
    grid_u, next_u, step_u = _ahead(px, ux, t0, float(BLOCK))
    grid_v, next_v, step_v = _ahead(py, uy, t0, float(BLOCK))
    per_row = (nx + BLOCK - 2) // BLOCK
    start, end = t0, -math.inf
    while t0 < last:
        t1 = min(next_u, next_v, last)
        if t1 > t0:
            t = 0.5 * (t0 + t1)
            i = int(min(max(px + t * ux, i0), i1 - 0.5)) // BLOCK
            j = int(min(max(py + t * uy, j0), j1 - 0.5)) // BLOCK
            at = blocks + 4 * (j * per_row + i)
            z0, z1 = oz + t0 * dz, oz + t1 * dz
            near, deep = min(z0, z1), max(z0, z1)
            if near > values[at + 1] and deep < values[at + 2]:
                if end < t0:
                    if end > start:
                        n = add_stretch(start, end, out, n)
                    start = t0
                end = t1
            elif deep >= values[at] and near <= values[at + 3]:
                start, end, n = _walk(
                    values, base, nx, limit, i0, i1, j0, j1, px, py, oz, ux, uy, dz, t0, t1,
                    start, end, out, n,
                )  # fmt: skip
            t0 = t1
        if next_u <= t1:
            grid_u += step_u
            next_u = (grid_u - px) / ux
        if next_v <= t1:
            grid_v += step_v
            next_v = (grid_v - py) / uy
    if end > start:
        n = add_stretch(start, end, out, n)
    return n


@njit(cache=True, error_model="numpy")
def layer_line_intervals(
    values: Array32, shape: Ints, origin: Array, inv_x: float,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, out: Array,
) -> int:  # fmt: skip
    """Stretches of the line o + t d inside a layered depth image, all in the body's frame.

    Args:
        values: A :class:`~capsense.scene.layers.LayerGrid`'s values, flat; numbers behind its end
            are not looked at.
        shape: Slots, rows and columns, shape (3,).
        origin: Centre of the first pixel [m]; the third number is not used, shape (3,).
        inv_x: Reciprocal of the pixel's width [1/m].
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.
        out: Receives entry and exit of each stretch in ascending order, shape (K, 2), K >= 2. Rows
            that are not used hold anything. If there are more than K stretches, some are joined.

    Returns:
        The number of rows written.
    """
    ny, nx = shape[1], shape[2]
    inv_y, limit = float(values[0]), float(values[1])
    px, py = (ox - origin[0]) * inv_x, (oy - origin[1]) * inv_y
    ux, uy = dx * inv_x, dy * inv_y
    fields = HEADER + TABLE * shape[0]
    blocks = fields + 3 * shape[0] * ny * nx
    per_slot = 4 * ((nx + BLOCK - 2) // BLOCK) * ((ny + BLOCK - 2) // BLOCK)
    n = 0
    along = abs(ux) + abs(uy) <= _TINY * abs(dz) * inv_x
    if along and not (0.0 <= px <= nx - 1.0 and 0.0 <= py <= ny - 1.0):
        return 0
    for k in range(shape[0]):
        base = fields + 3 * k * ny * nx
        if along:
            f, b, m = _at(values, base, nx, px, py, limit)
            if m >= 0.0 and f < b:
                s, t = (f - oz) / dz, (b - oz) / dz
                n = add_stretch(min(s, t), max(s, t), out, n)
        else:
            n = _cross_slot(
                values, HEADER + TABLE * k, base, blocks + k * per_slot, nx, limit,
                px, py, oz, ux, uy, dz, out, n,
            )  # fmt: skip
    return n


@njit(cache=True, error_model="numpy")
def layer_level(
    values: Array32, shape: Ints, origin: Array, inv_x: float, x: float, y: float, z: float
) -> float:
    """How far a point is outside a layered depth image [m], negative inside; in the body's frame.

    The largest of front − z, z − back and −margin, of the slot where that is smallest. The sign
    is exact; the size is measured along the axes.
    """
    ny, nx = shape[1], shape[2]
    inv_y, limit = float(values[0]), float(values[1])
    u, v = (x - origin[0]) * inv_x, (y - origin[1]) * inv_y
    out_u, out_v = max(-u, u - (nx - 1.0), 0.0), max(-v, v - (ny - 1.0), 0.0)
    beside = math.hypot(out_u / inv_x, out_v / inv_y)
    u, v = min(max(u, 0.0), nx - 1.0), min(max(v, 0.0), ny - 1.0)
    best, pixel = math.inf, 1.0 / max(inv_x, inv_y)
    for k in range(shape[0]):
        base = HEADER + TABLE * shape[0] + 3 * k * ny * nx
        f, b, m = _at(values, base, nx, u, v, limit)
        best = min(best, max(f - z, z - b, -m * pixel) + beside)
    return best


@njit(cache=True, error_model="numpy")
def layer_inside(
    values: Array32, shape: Ints, origin: Array, inv_x: float, x: float, y: float, z: float
) -> bool:
    """Whether a point [m] in the body's frame lies inside a layered depth image."""
    return layer_level(values, shape, origin, inv_x, x, y, z) <= 0.0


@njit(cache=True, error_model="numpy")
def layer_intervals_of_lines(
    values: Array32, shape: Ints, origin: Array, inv_x: float, o: Array, d: Array, out: Array
) -> None:
    """:func:`layer_line_intervals` of lines of shape (n, 3); ``out`` has shape (n, K, 2)."""
    for i in range(o.shape[0]):
        n = layer_line_intervals(
            values, shape, origin, inv_x, o[i, 0], o[i, 1], o[i, 2], d[i, 0], d[i, 1], d[i, 2],
            out[i],
        )  # fmt: skip
        for row in range(n, out.shape[1]):
            out[i, row, 0] = math.inf
            out[i, row, 1] = -math.inf


@njit(cache=True, error_model="numpy")
def layer_levels(
    values: Array32, shape: Ints, origin: Array, inv_x: float, points: Array, out: Array
) -> None:
    """:func:`layer_level` of points of shape (n, 3); ``out`` has shape (n,)."""
    for i in range(points.shape[0]):
        out[i] = layer_level(values, shape, origin, inv_x, points[i, 0], points[i, 1], points[i, 2])
