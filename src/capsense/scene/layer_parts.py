"""Compiled parts of the line intersections of layered depth images: ramps, unions, pieces of lines.

They serve :mod:`capsense.scene.layer_kernels`, which gives the rules.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def blend(a: float, b: float, s: float, limit: float) -> float:
    """Value at fraction ``s`` between two pixels; a ramp above ``limit`` narrows about 1/2."""
    jump = abs(b - a)
    if jump > limit:
        s = min(max((s - 0.5) * jump / limit + 0.5, 0.0), 1.0)
    return a + (b - a) * s


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def positive(c0: float, c1: float, low: float, high: float) -> tuple[float, float]:
    """Part of [low, high] in which the line from (0, c0) to (1, c1) is not negative."""
    if c0 >= 0.0:
        if c1 < 0.0:
            high = min(high, c0 / (c0 - c1))
    elif c1 >= 0.0:
        low = max(low, c0 / (c0 - c1))
    else:
        high = -1.0
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")
def _width(jump: float, limit: float) -> float:
    """Half the width of a ramp, in parts of a link."""
    return 0.5 if jump <= limit else 0.5 * limit / jump


@njit(cache=True, nogil=True, error_model="numpy")
def steps_between(
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
        low, high = positive(m0 + (m1 - m0) * last, m0 + (m1 - m0) * end, 0.0, 1.0)
        low, high = positive(
            za - blend(f0, f1, last, limit), zb - blend(f0, f1, end, limit), low, high
        )
        low, high = positive(
            blend(b0, b1, last, limit) - za, blend(b0, b1, end, limit) - zb, low, high
        )
        if low < high:
            a, b = last + low * (end - last), last + high * (end - last)
            n = add_stretch(t0 + a * (t1 - t0), t0 + b * (t1 - t0), out, n)
        last = end
    return n
