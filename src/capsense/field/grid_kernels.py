"""Potentials of the terminals from a table over the domain: roughly, and in a fraction of the time
that their point charges take. What charge functions are worth is judged by them.

The table is a quadratic spline in coordinates that are even within the design's box, and wider and
wider outside, so that it is as smooth as the choice of functions has to be.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._by_reference import by_reference
from capsense._jit import kernel
from capsense._simd import (
    SIMD_WIDTH,
    WIDE,
    at,
    madd,
    put_span,
    span,
    splat,
    vadd,
    vlog,
    vmul,
    vsub,
    where_above,
    wide_span,
    wide_splat,
)

Array = NDArray[np.float64]

ALONG = 20
"""Cells along the design's longest side."""
GROWTH = 0.2
"""Side of a cell over its distance from the design, far away."""
_BEYOND = 0.02
"""How far the table reaches beyond the walls [m]."""


@by_reference
class Grid(NamedTuple):
    """Values on the nodes of a grid; single precision."""

    box: NDArray[Any]
    """Corners of the box within which it is even [m], shape (2, 3)."""
    size: NDArray[Any]
    """Nodes along each axis, the number of the first one, and side of a cell [m] there: (3, 3)."""
    values: NDArray[Any]
    """Coefficients of the spline, shape (n, c), c a multiple of 8; z is fastest."""


def grid_over(box: Array, walls: Array, function: Callable[[Array], NDArray[np.float32]]) -> Grid:
    """Tabulate a function of points, (n, 3) -> (n, c), around a design within its walls.

    Args:
        box: Corners of the design [m], shape (2, 3).
        walls: Corners of the domain [m], shape (2, 3).
        function: What is tabulated; c is a multiple of 8.
    """
    side = np.full(3, np.ptp(box, axis=0).max() / ALONG)
    low, high = walls + _BEYOND * np.array([[-1.0], [1.0]])
    first = np.floor(-np.log1p(GROWTH * np.maximum(box[0] - low, 0.0) / side) / GROWTH) - 1.0
    even = np.ptp(box, axis=0) / side
    last = np.ceil(even + np.log1p(GROWTH * np.maximum(high - box[1], 0.0) / side) / GROWTH) + 1.0
    size = np.array([last - first + 1.0, first, side])
    grid = Grid(box.astype(np.float32), size.astype(np.float32), np.empty((0, 0), np.float32))
    found = function(nodes_of(grid))
    values = found.astype(float).reshape(*size[0].astype(int), -1)
    for axis in range(3):  # so that the spline meets polynomials of second degree
        ends = [(1, 1) if k == axis else (0, 0) for k in range(4)]
        values = values - np.diff(np.pad(values, ends, "edge"), n=2, axis=axis) / 8
    return grid._replace(values=np.ascontiguousarray(values.reshape(found.shape), np.float32))


def nodes_of(grid: Grid) -> Array:
    """Where its nodes are [m], shape (n, 3)."""
    box, (count, first, side) = grid.box.astype(float), grid.size.astype(float)
    axes = []
    for i in range(3):
        u, even = first[i] + np.arange(int(count[i])), (box[1, i] - box[0, i]) / side[i]
        off = np.maximum(np.maximum(u - even, -u), 0.0)
        away = side[i] * np.expm1(GROWTH * off) / GROWTH
        axes.append(box[0, i] + side[i] * np.clip(u, 0.0, even) + np.where(u > even, away, -away))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@kernel
def to_grid(points, grid):
    """Replace points (3, p) [m] by their coordinates in a grid, counted in cells from its first
    node; p a multiple of 16."""
    count, zero, one = points.shape[1], wide_splat(np.float32(0.0)), wide_splat(np.float32(1.0))
    growth = np.float32(GROWTH)
    for i in range(3):
        inverse = np.float32(1.0) / grid.size[2, i]
        low, high = wide_splat(grid.box[0, i]), wide_splat(grid.box[1, i])
        for k in range(0, count, WIDE):
            x = wide_span(points, i * count + k)
            above, below = vsub(x, high), vsub(low, x)
            inside = where_above(above, zero, high, where_above(below, zero, low, x))
            off = where_above(above, zero, above, where_above(below, zero, below, zero))
            off = vlog(vadd(one, vmul(wide_splat(growth * inverse), off)))
            off = vmul(wide_splat(np.float32(1.0) / growth), off)
            off = where_above(above, zero, off, vsub(zero, off))
            u = madd(inverse, vsub(inside, low), vsub(off, wide_splat(grid.size[1, i])))
            least, most = wide_splat(np.float32(1.0)), wide_splat(grid.size[0, i] - np.float32(2.0))
            u = where_above(u, least, where_above(most, u, u, most), least)
            put_span(points, i * count + k, u)


@kernel
def grid_values(points, grid, share, rows, out):
    """Fill rows of ``out`` (n, c) with the values at points, times a share of each.

    Args:
        points: As of :func:`to_grid`, shape (3, p).
        grid: The grid.
        share: Of the first k of the points, shape (k,).
        rows: Where these are wanted, shape (k,).
        out: Filled in these rows.
    """
    count, columns, half = points.shape[1], out.shape[1], np.float32(0.5)
    line = int(grid.size[0, 2])
    plane = line * int(grid.size[0, 1])
    for k in range(rows.shape[0]):
        x, y, z = at(points, k), at(points, count + k), at(points, 2 * count + k)
        a, b, c = int(x + half), int(y + half), int(z + half)
        u, v, w = x - np.float32(a), y - np.float32(b), z - np.float32(c)
        whole = np.float32(share[k])
        z0, z1, z2 = whole * _weight(w, 0), whole * _weight(w, 1), whole * _weight(w, 2)
        for j in range(0, columns, SIMD_WIDTH):
            s0 = s1 = s2 = splat(np.float32(0.0))
            for p in range(3):
                for q in range(3):
                    part = _weight(u, p) * _weight(v, q)
                    node = (a + p - 1) * plane + (b + q - 1) * line + c - 1
                    o = node * columns + j
                    s0 = madd(part * z0, span(grid.values, o), s0)
                    s1 = madd(part * z1, span(grid.values, o + columns), s1)
                    s2 = madd(part * z2, span(grid.values, o + 2 * columns), s2)
            put_span(out, rows[k] * columns + j, vadd(s0, vadd(s1, s2)))


@kernel
def _weight(d, k):
    """Weight of the node before, at or behind a point that is d cells past the middle one."""
    half = np.float32(0.5)
    if k == 0:
        return half * (half - d) * (half - d)
    if k == 1:
        return np.float32(0.75) - d * d
    return half * (half + d) * (half + d)
