"""Compiled loops over pixels: layers, groups of pixels, triangles drawn into images.

The rasteriser keeps every surface that a pixel's ray meets. Rays run along z through pixel centres,
which lie at whole numbers of (u, v). A pixel belongs to a triangle by half-open spans whose ends
are computed per edge, so that triangles that share an edge leave neither gaps nor overlaps: a
closed surface is met an even number of times everywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]


@kernel
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


MAX_GROUPS = 64
"""Different permittivities that one frame may hold."""


@kernel
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


@kernel
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


Ints = NDArray[np.int64]

LEAST_COSINE = 0.2
"""A sheet more inclined to the image than this cosine tells is not thickened any further."""


@kernel
def _order(
    x0: float, y0: float, x1: float, y1: float, x2: float, y2: float
) -> tuple[float, float, float, float, float, float]:
    """Three points by their y."""
    if y0 > y1:
        x0, y0, x1, y1 = x1, y1, x0, y0
    if y1 > y2:
        x1, y1, x2, y2 = x2, y2, x1, y1
    if y0 > y1:
        x0, y0, x1, y1 = x1, y1, x0, y0
    return x0, y0, x1, y1, x2, y2


@kernel
def _edge_at(x0: float, y0: float, x1: float, y1: float, y: float) -> float:
    """Where an edge, lower end first, crosses the line at y; between its ends to the last bit."""
    x = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
    return min(max(x, min(x0, x1)), max(x0, x1))


@kernel
def _span(
    x0: float, y0: float, x1: float, y1: float, x2: float, y2: float, y: float
) -> tuple[float, float]:
    """Ends of a triangle, points by their y, on the line at y; lower end first."""
    a = _edge_at(x0, y0, x2, y2, y)
    b = _edge_at(x0, y0, x1, y1, y) if y < y1 else _edge_at(x1, y1, x2, y2, y)
    return min(a, b), max(a, b)


@compiled
def _whole(x: float, last: int) -> int:
    """First whole number not below x, from 0 to ``last``."""
    return int(math.ceil(min(max(x, 0.0), float(last))))


@kernel
def scan(p: Array, faces: Ints, dx: float, dy: float, thickness: float, met: Array32,
         count: Ints) -> int:  # fmt: skip
    """Meet every pixel's ray with every triangle.

    Args:
        p: Vertices: u, v in pixels, z [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).
        dx, dy: Size of a pixel [m].
        thickness: Thickness of a sheet along its normal [m], 0 for a closed surface.
        met: Receives for every triangle met, in no order, its depth [m], and half its thickness
            along z [m] or the side it was met from, ±1; shape (rows, columns, room, 2).
        count: Receives how many there are, shape (rows, columns); must be zero.

    Returns:
        The largest number met by a pixel; if above the room, some were dropped.
    """
    ny, nx, room, _ = met.shape
    most = 0
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        xa, ya, za = p[a, 0], p[a, 1], p[a, 2]
        xb, yb, zb = p[b, 0], p[b, 1], p[b, 2]
        xc, yc, zc = p[c, 0], p[c, 1], p[c, 2]
        normal = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
        if normal == 0.0:
            continue
        x0, y0, x1, y1, x2, y2 = _order(xa, ya, xb, yb, xc, yc)
        first, last = _whole(y0, ny), _whole(y2, ny)
        if first == last:
            continue
        gx = ((zb - za) * (yc - ya) - (yb - ya) * (zc - za)) / normal
        gy = ((xb - xa) * (zc - za) - (zb - za) * (xc - xa)) / normal
        near, deep = min(za, zb, zc), max(za, zb, zc)
        value = 1.0 if normal > 0.0 else -1.0
        if thickness > 0.0:
            slope = math.sqrt(1.0 + (gx / dx) ** 2 + (gy / dy) ** 2)
            value = 0.5 * thickness * min(slope, 1.0 / LEAST_COSINE)
        for j in range(first, last):
            low, high = _span(x0, y0, x1, y1, x2, y2, float(j))
            for i in range(_whole(low, nx), _whole(high, nx)):
                n = count[j, i]
                count[j, i] = n + 1
                most = max(most, n + 1)
                if n < room:
                    depth = za + gx * (i - xa) + gy * (j - ya)
                    met[j, i, n, 0] = min(max(depth, near), deep)
                    met[j, i, n, 1] = value
    return most


@kernel
def pair(met: Array32, count: Ints, sheet: bool, front: Array, back: Array) -> None:
    """Turn the depths that rays met into intervals.

    A closed surface is inside where its winding number is not zero; where the numbers do not add
    up to zero (faces of mixed orientation), every second stretch is inside.

    Args:
        met, count: As :func:`scan` leaves them; ``met`` is sorted in place.
        sheet: Whether every depth is a sheet of its own.
        front, back: Receive the intervals [m], shape (layers, rows, columns); NaN where none.
    """
    ny, nx = count.shape
    front[:] = math.nan
    back[:] = math.nan
    for j in range(ny):
        for i in range(nx):
            n = count[j, i]
            total = 0.0
            for k in range(n):
                depth, value = met[j, i, k, 0], met[j, i, k, 1]
                at = k
                while at > 0 and met[j, i, at - 1, 0] > depth:
                    met[j, i, at, 0] = met[j, i, at - 1, 0]
                    met[j, i, at, 1] = met[j, i, at - 1, 1]
                    at -= 1
                met[j, i, at, 0], met[j, i, at, 1] = depth, value
                total += value
            winding, layer = 0, 0
            for k in range(n):
                depth, value = met[j, i, k, 0], met[j, i, k, 1]
                if sheet:
                    front[k, j, i], back[k, j, i] = depth - value, depth + value
                    continue
                before = winding
                winding = winding + int(value) if total == 0.0 else 1 - winding
                if before == 0:
                    front[layer, j, i] = depth
                elif winding == 0:
                    back[layer, j, i] = depth
                    layer += 1
