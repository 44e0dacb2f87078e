"""Compiled making of layered depth images: slots, silhouettes, margins.

From fronts and backs at pixel centres to the numbers that :mod:`capsense.scene.layer_kernels`
reads. The readable twin is :mod:`capsense.scene.layer_reference`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from capsense.scene.layers import BLOCK, HEADER, TABLE

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

FAR = 2.0
"""Margins are not followed farther than this, in pixels."""
_ROUNDING = 1e-4
"""Added to how far a silhouette reaches, in pixels, for the rounding of single precision."""
LEAST = 1e-3
"""A silhouette keeps this far from pixel centres, in parts of a link."""


@njit(cache=True, nogil=True, error_model="numpy")
def sort_slots(front: Array, back: Array, f: Array, b: Array, count: Ints) -> Ints:
    """Sort the intervals of every pixel, drop what is none, unite what overlaps.

    Args:
        front, back: Shape (layers, rows, columns) [m]; no interval where not front < back.
        f, b: Receive the intervals in order of depth, shape (layers, rows, columns).
        count: Receives how many there are, shape (rows, columns).

    Returns:
        The largest count, first and last row, first and last column that are hit.
    """
    layers, ny, nx = front.shape
    found = np.array([0, ny, -1, nx, -1])
    for j in range(ny):
        for i in range(nx):
            n = 0
            for k in range(layers):
                low, high = front[k, j, i], back[k, j, i]
                if not (low < high and high - low < math.inf):
                    continue
                at = n
                while at > 0 and f[at - 1, j, i] > low:
                    f[at, j, i], b[at, j, i] = f[at - 1, j, i], b[at - 1, j, i]
                    at -= 1
                f[at, j, i], b[at, j, i] = low, high
                n += 1
            last = 0
            for k in range(1, n):
                if f[k, j, i] <= b[last, j, i]:
                    b[last, j, i] = max(b[last, j, i], b[k, j, i])
                else:
                    last += 1
                    f[last, j, i], b[last, j, i] = f[k, j, i], b[k, j, i]
            if n > 0:
                n = last + 1
                found[0] = max(found[0], n)
                found[1], found[2] = min(found[1], j), max(found[2], j)
                found[3], found[4] = min(found[3], i), max(found[4], i)
            count[j, i] = n
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(known: float, edge: bool, t1: float, t2: float) -> float:
    """Where a silhouette lies between a pixel that is hit and one that is not, from the first.

    Args:
        known: The fraction if it was measured, else negative.
        edge: Whether the second pixel lies beyond the image.
        t1: Thickness at the pixel that is hit.
        t2: Thickness at the pixel behind it, or zero.

    The square of a convex body's thickness falls off linearly towards its silhouette; that gives
    the place where the body gets thin. Where it does not, the middle is taken.
    """
    if edge:
        return 0.5 if known < 0.0 else min(max(known, LEAST), 0.5)
    if known >= 0.0:
        return min(max(known, LEAST), 1.0 - LEAST)
    fall = t2 * t2 - t1 * t1
    if fall <= 0.5 * t1 * t1:
        return 0.5
    s = t1 * t1 / fall
    return max(s, LEAST) if s <= 0.9 else 0.9 - (s - 0.9) * 0.4 / 1.1


@njit(cache=True, nogil=True, error_model="numpy")
def _thick(f: Array, b: Array, count: Ints, k: int, j: int, i: int) -> float:
    """Thickness of an interval [m]; zero where there is none."""
    if j < 0 or i < 0 or j >= count.shape[0] or i >= count.shape[1] or count[j, i] <= k:
        return 0.0
    return b[k, j, i] - f[k, j, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _spread(margin: Array, state: NDArray[np.int8], j: int, i: int, dj: int, di: int,
            distance: float) -> None:  # fmt: skip
    """Lower the margins of like pixels from (j, i) on in one direction to their distances."""
    rows, columns = state.shape
    kind = state[j, i]
    while 0 <= j < rows and 0 <= i < columns and state[j, i] == kind and distance < FAR:
        margin[j, i] = min(margin[j, i], distance)
        distance += 1.0
        j += dj
        i += di


@njit(cache=True, nogil=True, error_model="numpy")
def _margins(f: Array, b: Array, count: Ints, k: int, j0: int, i0: int, cut_x: Array32,
             cut_y: Array32, state: NDArray[np.int8], margin: Array) -> None:  # fmt: skip
    """Distance to the silhouette along rows or columns, whichever is shorter.

    Args:
        state: 1 where hit, else 0, on the cropped grid, shape (rows, columns).
        margin: Receives the distances in pixels, no sign, at most ``FAR``, same shape.
    """
    ny, nx = count.shape
    rows, columns = state.shape
    margin[:] = FAR
    for way in range(2):
        dj, di = (0, 1) if way == 0 else (1, 0)
        cuts = cut_x if way == 0 else cut_y
        for row in range(rows - dj):
            for column in range(columns - di):
                if state[row, column] == state[row + dj, column + di]:
                    continue
                j, i = row + dj + j0 - 1, column + di + i0 - 1  # the second pixel of the link
                p, q = j - dj, i - di
                measured = cuts.shape[0] > 0
                if state[row, column] == 1:
                    known = float(cuts[j, i, 1]) if measured else -1.0
                    s = _edge(known, j == ny or i == nx, _thick(f, b, count, k, p, q),
                              _thick(f, b, count, k, p - dj, q - di))  # fmt: skip
                else:
                    known = 1.0 - cuts[j, i, 0] if measured else -1.0
                    s = 1.0 - _edge(known, p < 0 or q < 0, _thick(f, b, count, k, j, i),
                                    _thick(f, b, count, k, j + dj, i + di))  # fmt: skip
                _spread(margin, state, row, column, -dj, -di, s)
                _spread(margin, state, row + dj, column + di, dj, di, 1.0 - s)


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth(jump: float, limit: float) -> float:
    """How much of a surface's slope and curvature to believe: all up to half a step, then less."""
    return min(1.0, max(0.0, 2.0 - 2.0 * abs(jump) / limit))


@njit(cache=True, nogil=True, error_model="numpy")
def _beyond(a: float, b: float, known: bool, limit: float) -> float:
    """Value one pixel beyond ``a``, straight on from ``b`` if that is known and no step away."""
    return a + (a - b) * _smooth(a - b, limit) if known else a


@njit(cache=True, nogil=True, error_model="numpy")
def _ghosts(field: Array32, state: NDArray[np.int8], limit: float) -> None:
    """Carry front and back on to pixels around those hit, along rows, then along columns.

    Args:
        field: Front, back and margin, shape (rows, columns, 3).
        state: 1 where hit; becomes 2 where carried on to, shape (rows, columns).
        limit: Jump that is a step [m].
    """
    rows, columns = state.shape
    for way in range(2):
        dj, di = (0, 1) if way == 0 else (1, 0)
        for j in range(rows):
            for i in range(columns):
                if state[j, i] != 0:
                    continue
                total_f, total_b, n = 0.0, 0.0, 0
                for sign in (-1, 1):
                    p, q = j + sign * dj, i + sign * di
                    if p < 0 or q < 0 or p >= rows or q >= columns:
                        continue
                    # what this pass has made itself does not count
                    if state[p, q] != 1 and (way == 0 or state[p, q] != 2):
                        continue
                    r, s = p + sign * dj, q + sign * di
                    inside = 0 <= r < rows and 0 <= s < columns
                    known = inside and (state[r, s] == 1 or (way == 1 and state[r, s] == 2))
                    if not known:
                        r, s = p, q
                    total_f += _beyond(field[p, q, 0], field[r, s, 0], known, limit)
                    total_b += _beyond(field[p, q, 1], field[r, s, 1], known, limit)
                    n += 1
                if n > 0:
                    f, b = total_f / n, total_b / n
                    if b < f:
                        f = b = 0.5 * (f + b)
                    field[j, i, 0], field[j, i, 1] = f, b
                    state[j, i] = 2 + way


@njit(cache=True, nogil=True, error_model="numpy")
def _blocks(field: Array32, state: NDArray[np.int8], out: Array32) -> None:
    """Bounds of fronts and backs over blocks of pixels; ``out`` is flat, four numbers a block."""
    rows, columns = state.shape
    at = 0
    for j0 in range(0, rows - 1, BLOCK):
        for i0 in range(0, columns - 1, BLOCK):
            f0, f1, b0, b1 = math.inf, -math.inf, math.inf, -math.inf
            whole = True
            for j in range(j0, min(j0 + BLOCK + 1, rows)):
                for i in range(i0, min(i0 + BLOCK + 1, columns)):
                    if state[j, i] == 0:
                        whole = False
                        continue
                    whole = whole and state[j, i] == 1
                    f, b = field[j, i, 0], field[j, i, 1]
                    f0, f1 = min(f0, f), max(f1, f)
                    b0, b1 = min(b0, b), max(b1, b)
            out[at], out[at + 1] = f0, f1 if whole else math.inf
            out[at + 2], out[at + 3] = b0 if whole else -math.inf, b1
            at += 4


@njit(cache=True, nogil=True, error_model="numpy")
def _second(a: float, middle: float, b: float, limit: float) -> float:
    """Second difference of a surface, zero at a step."""
    a -= middle
    b -= middle
    return (a + b) * _smooth(max(abs(a), abs(b)), limit)


@njit(cache=True, nogil=True, error_model="numpy")
def _surface(a: Array, state: NDArray[np.int8], j0: int, i0: int, limit: float, part: int,
             field: Array32) -> None:  # fmt: skip
    """Copy a front (part 0) or back (part 1), bent as its curvature asks for.

    Straight lines between the pixels of a curved surface are too large, on average, by a twelfth
    of its second differences along rows and columns; so much is taken off.
    """
    rows, columns = state.shape
    for row in range(1, rows - 1):
        j = row + j0 - 1
        middle = a[j]
        above, below = a[max(j - 1, 0)], a[min(j + 1, a.shape[0] - 1)]
        for column in range(1, columns - 1):
            if state[row, column] == 0:
                continue
            i = column + i0 - 1
            value, bend = middle[i], 0.0
            if state[row, column - 1] == 1 and state[row, column + 1] == 1:
                bend += _second(middle[i - 1], value, middle[i + 1], limit)
            if state[row - 1, column] == 1 and state[row + 1, column] == 1:
                bend += _second(above[i], value, below[i], limit)
            field[row, column, part] = value - bend / 12.0


@njit(cache=True, nogil=True, error_model="numpy")
def _reach(field: Array32, out: Array32) -> None:
    """How far the silhouette reaches: least and largest column, least and largest row."""
    rows, columns = field.shape[0], field.shape[1]
    out[0], out[1], out[2], out[3] = columns, -1.0, rows, -1.0
    for way in range(2):
        dj, di = (0, 1) if way == 0 else (1, 0)
        for j in range(rows - dj):
            for i in range(columns - di):
                a, b = field[j, i, 2], field[j + dj, i + di, 2]
                if (a > 0.0) != (b > 0.0):
                    place = (i if way == 0 else j) + a / (a - b)
                    if a > 0.0:
                        out[2 * way + 1] = max(out[2 * way + 1], place + _ROUNDING)
                    else:
                        out[2 * way] = min(out[2 * way], place - _ROUNDING)


@njit(cache=True, nogil=True, error_model="numpy")
def build_values(f: Array, b: Array, count: Ints, found: Ints, dy: float, limit: float,
                 cut_x: Array32, cut_y: Array32) -> Array32:  # fmt: skip
    """Values of a :class:`~capsense.scene.layers.LayerGrid`, cropped to what is hit and one more.

    Args:
        f, b, count, found: As :func:`sort_slots` leaves them.
        dy: Height of a pixel [m].
        limit: Jump from pixel to pixel above which a surface is a step [m].
        cut_x: First and last place where outlines cross the links of every row, shape
            (rows, columns + 1, 2), out of [0, 1] where none does; link i leads to pixel i. Shape
            (0, 0, 2) if outlines are not known.
        cut_y: The same for columns, shape (rows + 1, columns, 2).

    Returns:
        Header, table, fields and blocks, flat.
    """
    slots = found[0]
    j0, i0 = found[1], found[3]
    rows, columns = found[2] - j0 + 3, found[4] - i0 + 3
    start = HEADER + TABLE * slots
    size = 3 * slots * rows * columns
    per_slot = 4 * ((columns + BLOCK - 2) // BLOCK) * ((rows + BLOCK - 2) // BLOCK)
    values = np.zeros(start + size + slots * per_slot, np.float32)
    values[0], values[1] = 1.0 / dy, limit
    margin = np.empty((rows, columns))
    state = np.empty((rows, columns), np.int8)
    for k in range(slots):
        state[:] = 0
        state[1:-1, 1:-1] = count[j0 : found[2] + 1, i0 : found[4] + 1] > k
        _margins(f, b, count, k, j0, i0, cut_x, cut_y, state, margin)
        base = start + 3 * k * rows * columns
        field = values[base : base + 3 * rows * columns].reshape((rows, columns, 3))
        _surface(f[k], state, j0, i0, limit, 0, field)
        _surface(b[k], state, j0, i0, limit, 1, field)
        left, right, low, high = columns, -1, rows, -1
        for row in range(rows):
            for column in range(columns):
                if state[row, column] == 1:
                    field[row, column, 2] = margin[row, column]
                    left, right = min(left, column), max(right, column)
                    low, high = min(low, row), max(high, row)
                else:
                    field[row, column, 2] = -margin[row, column]
        _ghosts(field, state, limit)
        blocks = start + size + k * per_slot
        bounds = values[blocks : blocks + per_slot]
        _blocks(field, state, bounds)
        table = HEADER + TABLE * k
        values[table], values[table + 1] = left - 1, right + 1
        values[table + 2], values[table + 3] = low - 1, high + 1
        _reach(field, values[table + 6 : table + 10])
        values[table + 4], values[table + 5] = bounds[0::4].min(), bounds[3::4].max()
    return values
