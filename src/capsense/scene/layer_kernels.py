"""Compiled sorting of the intervals of layered depth images."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@compiled
def sort_slots(front: Array, back: Array, f: Array32, b: Array32, reach: Array) -> int:
    """Sort the intervals of every pixel, drop what is none, unite what overlaps.

    Args:
        front, back: Shape (layers, rows, columns) [m]; no interval where not front < back.
        f, b: Receive the intervals in order of depth, then NaN, shape (layers, rows, columns).
        reach: Receives first and one behind the last column and row that are hit, and the nearest
            and farthest depth [m], as rows (column, row, depth), shape (2, 3).

    Returns:
        The largest number of intervals at a pixel.
    """
    layers, rows, columns = front.shape
    most = 0
    reach[0], reach[1] = math.inf, -math.inf
    for j in range(rows):
        for i in range(columns):
            n = 0
            for k in range(layers):
                low, high = np.float32(front[k, j, i]), np.float32(back[k, j, i])
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
                most = max(most, n)
                reach[0, 0], reach[1, 0] = min(reach[0, 0], i), max(reach[1, 0], i + 1)
                reach[0, 1], reach[1, 1] = min(reach[0, 1], j), max(reach[1, 1], j + 1)
                reach[0, 2] = min(reach[0, 2], f[0, j, i])
                reach[1, 2] = max(reach[1, 2], b[n - 1, j, i])
            f[n:, j, i] = math.nan
            b[n:, j, i] = math.nan
    return most
