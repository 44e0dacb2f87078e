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
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense.scene.layer_parts import add_stretch, blend, positive, steps_between
from capsense.scene.layers import BLOCK, HEADER, TABLE

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_TINY = 1e-12
"""Slope to the view axis below which a line counts as parallel to it."""
_ALIGNED = 1e-9
"""Slope to rows or columns below which a line counts as parallel to them."""


@kernel
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


@kernel
def _clip(o: float, d: float, low: float, high: float, t0: float, t1: float) -> tuple[float, float]:
    """Part of [t0, t1] in which low <= o + t d <= high."""
    if d == 0.0:
        if o < low or o > high:
            return math.inf, -math.inf
        return t0, t1
    a, b = (low - o) / d, (high - o) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@kernel
def _ahead(p: float, u: float, t: float, cell: float) -> tuple[float, float, float]:
    """Next grid line of spacing ``cell`` at or ahead of parameter t: place, time, and spacing."""
    if u == 0.0:
        return 0.0, math.inf, 0.0
    if u > 0.0:
        place = (math.floor((p + t * u) / cell) + 1.0) * cell
        return place, (place - p) / u, cell
    place = (math.ceil((p + t * u) / cell) - 1.0) * cell
    return place, (place - p) / u, -cell


@kernel
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
                n = steps_between(t0, z0, f0, b0, m0, t, z, f, b, m, limit, out, n)
                start, end = t, -math.inf
            else:
                low, high = positive(m0, m, 0.0, 1.0)
                low, high = positive(z0 - f0, z - f, low, high)
                low, high = positive(b0 - z0, b - z, low, high)
                if low < high:
                    if low > 0.0 or end < t0:
                        if end > start:
                            n = add_stretch(start, end, out, n)
                        start = t0 + low * (t - t0)
                    end = t if high == 1.0 else t0 + high * (t - t0)
        t0, z0, f0, b0, m0 = t, z, f, b, m
    return start, end, n


@kernel
def _cross_slot(
    values: Array32, table: int, base: int, blocks: int, nx: int, limit: float,
    px: float, py: float, oz: float, ux: float, uy: float, dz: float, begin: float, stop: float,
    out: Array, n: int,
) -> int:  # fmt: skip
    """Add the stretches of a line that runs across the view inside one slot.

    The line is sampled where it crosses the lines that join pixel centres; in between, front,
    back and margin go linearly from sample to sample, steps excepted. Blocks of pixels that it
    passes in front of, behind, or well inside are passed in one go.
    """
    i0, i1 = values[table], values[table + 1]
    j0, j1 = values[table + 2], values[table + 3]
    t0, last = _clip(px, ux, i0, i1, begin, stop)
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


@kernel
def _mix(values: Array32, a: int, across: int, s: float, limit: float) -> tuple[float, float]:
    """Front and back at fraction ``s`` of the link from the pixel at ``a`` to its neighbour."""
    f = blend(values[a], values[a + across], s, limit)
    return f, blend(values[a + 1], values[a + across + 1], s, limit)


@kernel
def _along_row(
    values: Array32, a: int, step: int, across: int, s: float, limit: float, first: int, last: int,
    z: float, p: float, u: float, start: float, end: float, out: Array, n: int,
) -> tuple[float, float, int]:  # fmt: skip
    """As :func:`_walk`, for a line at one depth along a row or column, from pixel to pixel.

    ``a`` is where the numbers of pixel ``first`` stand; [start, end] is in pixels.
    """
    f0, b0, known = 0.0, 0.0, False
    m0 = values[a + 2] + (values[a + across + 2] - values[a + 2]) * s
    for i in range(first, last):
        a += step
        m = values[a + 2] + (values[a + across + 2] - values[a + 2]) * s
        if m0 < 0.0 and m < 0.0:
            known = False
        else:
            if not known:
                f0, b0 = _mix(values, a - step, across, s, limit)
            f, b = _mix(values, a, across, s, limit)
            known = True
            if abs(f - f0) > limit or abs(b - b0) > limit:
                if end > start:
                    n = _add_pixels(start, end, p, u, out, n)
                t0, t1 = (i - p) / u, (i + 1 - p) / u
                if u > 0.0:
                    n = steps_between(t0, z, f0, b0, m0, t1, z, f, b, m, limit, out, n)
                else:
                    n = steps_between(t1, z, f, b, m, t0, z, f0, b0, m0, limit, out, n)
                start, end = float(i + 1), -math.inf
            else:
                low, high = positive(m0, m, 0.0, 1.0)
                low, high = positive(z - f0, z - f, low, high)
                low, high = positive(b0 - z, b - z, low, high)
                if low < high:
                    if low > 0.0 or end < i:
                        if end > start:
                            n = _add_pixels(start, end, p, u, out, n)
                        start = i + low
                    end = i + high
            f0, b0 = f, b
        m0 = m
    return start, end, n


@kernel
def _add_pixels(start: float, end: float, p: float, u: float, out: Array, n: int) -> int:
    """Add a stretch given in pixels of a line at pixel p, of u pixels for each unit of t."""
    a, b = (start - p) / u, (end - p) / u
    return add_stretch(min(a, b), max(a, b), out, n)


@kernel
def _straight_slot(
    values: Array32, table: int, base: int, blocks: int, nx: int, limit: float, axis: int,
    p: float, u: float, v: float, z: float, begin: float, stop: float, out: Array, n: int,
) -> int:  # fmt: skip
    """Add the stretches of a line at one depth along rows (axis 0) or columns (axis 1).

    The same as :func:`_cross_slot`, faster.
    """
    lines = table + 2 - 2 * axis
    if not (values[lines + 6] <= v <= values[lines + 7]):
        return n
    if z < values[table + 4] or z > values[table + 5]:
        return n
    j = min(int(v), int(values[lines + 1]) - 1)
    step, across = (3, 3 * nx) if axis == 0 else (3 * nx, 3)
    row = base + j * across
    per_row = (nx + BLOCK - 2) // BLOCK
    blocks += 4 * (j // BLOCK) * (per_row if axis == 0 else 1)
    stride = 4 * (1 if axis == 0 else per_row)
    i, last = int(values[table + 2 * axis]), int(values[table + 2 * axis + 1])
    if begin > -math.inf:
        low, high = min(p + begin * u, p + stop * u), max(p + begin * u, p + stop * u)
        i, last = max(i, int(max(low, 0.0))), min(last, int(max(high, 0.0)) + 1)
    start, end = 0.0, -math.inf
    while i < last:
        at = blocks + stride * (i // BLOCK)
        stop = min(i - i % BLOCK + BLOCK, last)
        if z > values[at + 1] and z < values[at + 2]:
            if end < i:
                if end > start:
                    n = _add_pixels(start, end, p, u, out, n)
                start = float(i)
            end = float(stop)
        elif z >= values[at] and z <= values[at + 3]:
            start, end, n = _along_row(
                values, row + i * step, step, across, v - j, limit, i, stop, z, p, u, start, end,
                out, n,
            )  # fmt: skip
        i = stop
    return _add_pixels(start, end, p, u, out, n) if end > start else n


@kernel
def layer_line_intervals(
    values: Array32, shape: Ints, origin: Array, inv_x: float,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, begin: float, stop: float,
    out: Array,
) -> int:  # fmt: skip
    """Stretches of the line o + t d inside a layered depth image, all in the body's frame.

    Only t about from ``begin`` to ``stop`` is looked at; a stretch may end there or go on.

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
    # the middle of the image, where lines along its axes are taken to run
    axis = -1
    if abs(uy) <= _ALIGNED * abs(ux) and abs(dz) * inv_x <= _ALIGNED * abs(ux):
        axis, t = 0, (0.5 * (nx - 1) - px) / ux
    elif abs(ux) <= _ALIGNED * abs(uy) and abs(dz) * inv_y <= _ALIGNED * abs(uy):
        axis, t = 1, (0.5 * (ny - 1) - py) / uy
    for k in range(shape[0]):
        base, table = fields + 3 * k * ny * nx, HEADER + TABLE * k
        if axis >= 0:
            p, u, v = (px, ux, py + t * uy) if axis == 0 else (py, uy, px + t * ux)
            n = _straight_slot(
                values, table, base, blocks + k * per_slot, nx, limit, axis, p, u, v,
                oz + t * dz, begin, stop, out, n,
            )  # fmt: skip
        elif along:
            if not (values[table + 6] <= px <= values[table + 7]
                    and values[table + 8] <= py <= values[table + 9]):  # fmt: skip
                continue
            f, b, m = _at(values, base, nx, px, py, limit)
            if m >= 0.0 and f < b:
                s, t = (f - oz) / dz, (b - oz) / dz
                n = add_stretch(min(s, t), max(s, t), out, n)
        else:
            n = _cross_slot(
                values, table, base, blocks + k * per_slot, nx, limit,
                px, py, oz, ux, uy, dz, begin, stop, out, n,
            )  # fmt: skip
    return n


@kernel
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


@kernel
def layer_inside(
    values: Array32, shape: Ints, origin: Array, inv_x: float, x: float, y: float, z: float
) -> bool:
    """Whether a point [m] in the body's frame lies inside a layered depth image."""
    return layer_level(values, shape, origin, inv_x, x, y, z) <= 0.0


@kernel
def layer_intervals_of_lines(
    values: Array32, shape: Ints, origin: Array, inv_x: float, o: Array, d: Array, out: Array
) -> None:
    """:func:`layer_line_intervals` of lines of shape (n, 3); ``out`` has shape (n, K, 2)."""
    for i in range(o.shape[0]):
        n = layer_line_intervals(
            values, shape, origin, inv_x, o[i, 0], o[i, 1], o[i, 2], d[i, 0], d[i, 1], d[i, 2],
            -math.inf, math.inf, out[i],
        )  # fmt: skip
        for row in range(n, out.shape[1]):
            out[i, row, 0] = math.inf
            out[i, row, 1] = -math.inf


@kernel
def layer_levels(
    values: Array32, shape: Ints, origin: Array, inv_x: float, points: Array, out: Array
) -> None:
    """:func:`layer_level` of points of shape (n, 3); ``out`` has shape (n,)."""
    for i in range(points.shape[0]):
        out[i] = layer_level(values, shape, origin, inv_x, points[i, 0], points[i, 1], points[i, 2])
