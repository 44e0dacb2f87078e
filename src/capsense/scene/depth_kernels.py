"""Compiled sorting of a depth frame's pixels into materials."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled

Array = NDArray[np.float64]

MAX_GROUPS = 64
"""Different permittivities that one frame may hold."""


@compiled
def sort_pixels(depth: Array, eps_r: Array, near: float, far: float, conductor: float,
                group: NDArray[np.int8], known: Array) -> int:  # fmt: skip
    """Number the materials of a frame in order of appearance.

    Args:
        depth: Depths [m], shape (layers, rows, columns).
        eps_r: Relative permittivities, every axis of that length or of length one.
        near, far: Depths up to and from which nothing is seen [m].
        conductor: Permittivity from which matter conducts; all of it counts as infinite.
        group: Receives the number of every pixel's material, −1 for air.
        known: Receives the permittivities, shape (MAX_GROUPS,).

    Returns:
        The number of materials; −1 if there are too many, −2 − p if that of flat pixel p is
        neither zero (air) nor at least one.
    """
    layers, rows, columns = depth.shape
    sk = 1 if eps_r.shape[0] > 1 else 0
    sj = 1 if eps_r.shape[1] > 1 else 0
    si = 1 if eps_r.shape[2] > 1 else 0
    n, last = 0, -1
    for k in range(layers):
        for j in range(rows):
            for i in range(columns):
                group[k, j, i] = -1
                d = depth[k, j, i]
                if not (d > 0.0 and d > near and d < far):
                    continue
                e = eps_r[k * sk, j * sj, i * si]
                if e == 0.0 or e == 1.0:
                    continue
                if not e > 1.0:
                    return -2 - ((k * rows + j) * columns + i)
                if e >= conductor:
                    e = math.inf
                if last < 0 or known[last] != e:
                    last = 0
                    while last < n and known[last] != e:
                        last += 1
                    if last == n:
                        if n == known.shape[0]:
                            return -1
                        known[n] = e
                        n += 1
                group[k, j, i] = last
    return n


@compiled
def pick(front: Array, back: Array, group: NDArray[np.int8], which: int, flip_rows: bool,
         flip_columns: bool, f: Array, b: Array) -> bool:  # fmt: skip
    """Copy the intervals of one material, the others as NaN, and turn the image upright.

    Returns:
        Whether there is any.
    """
    layers, rows, columns = front.shape
    found = False
    for k in range(layers):
        for j in range(rows):
            row = rows - 1 - j if flip_rows else j
            for i in range(columns):
                column = columns - 1 - i if flip_columns else i
                if group[k, j, i] == which and front[k, j, i] < back[k, j, i]:
                    found = True
                    f[k, row, column], b[k, row, column] = front[k, j, i], back[k, j, i]
                else:
                    f[k, row, column] = b[k, row, column] = math.nan
    return found
