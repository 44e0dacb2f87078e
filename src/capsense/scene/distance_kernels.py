"""Compiled signed distances from triangle surfaces, exact."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Bins(NamedTuple):
    """Triangles of a surface, sorted into the square cells of a grid in x and y."""

    triangles: Array
    """Corners [m], shape (m, 3, 3)."""
    origin: Array
    """Lower corner of the grid (x, y) [m], shape (2,)."""
    width: float
    """Width of a cell [m]."""
    first: Ints
    """Where the triangles of each cell begin in ``items``, shape (columns, rows)."""
    last: Ints
    """Where they end."""
    items: Ints
    """Numbers of the triangles whose bounding box meets each cell."""
    heights: Array
    """Least and largest z of the triangles of each cell [m], shape (columns, rows, 2)."""


def sort_into_bins(triangles: Array) -> Bins:
    """Sort triangles, corners [m] of shape (m, 3, 3), into about as many cells."""
    low, high = triangles.min(axis=(0, 1))[:2], triangles.max(axis=(0, 1))[:2]
    extent = high - low
    width = max(math.sqrt(float(extent.prod()) / len(triangles)), float(extent.max()) / 256, 1e-12)
    shape = (extent / width).astype(np.int64) + 1
    first, last = np.zeros((2, *shape), np.int64)
    heights = np.empty((*shape, 2))
    heights[..., 0], heights[..., 1] = np.inf, -np.inf
    items = np.empty(_count(triangles, low, width, last), np.int64)
    bins = Bins(triangles, low, width, first, last, items, heights)
    _fill(bins)
    return bins


@njit(cache=True, nogil=True, error_model="numpy")
def _cell(x: float, origin: float, width: float, count: int) -> int:
    """Cell that a coordinate lies in, or the nearest one; never falls as ``x`` grows."""
    return int(min(max((x - origin) / width, 0.0), count - 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _reach(tri: Array, axis: int, origin: float, width: float, count: int) -> tuple[int, int]:
    """First and last cell along an axis that the bounding box of a triangle meets."""
    low = min(tri[0, axis], min(tri[1, axis], tri[2, axis]))
    high = max(tri[0, axis], max(tri[1, axis], tri[2, axis]))
    return _cell(low, origin, width, count), _cell(high, origin, width, count)


@njit(cache=True, nogil=True, error_model="numpy")
def _count(triangles: Array, origin: Array, width: float, count: Ints) -> int:
    """Count the triangles of every cell; returns the sum."""
    for m in range(triangles.shape[0]):
        i0, i1 = _reach(triangles[m], 0, origin[0], width, count.shape[0])
        j0, j1 = _reach(triangles[m], 1, origin[1], width, count.shape[1])
        count[i0 : i1 + 1, j0 : j1 + 1] += 1
    return count.sum()


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(bins: Bins) -> None:
    """Enter the triangles; ``bins.last`` holds their numbers in every cell."""
    columns, rows = bins.first.shape
    at = 0
    for i in range(columns):
        for j in range(rows):
            count = bins.last[i, j]
            bins.first[i, j] = bins.last[i, j] = at
            at += count
    for m in range(bins.triangles.shape[0]):
        tri = bins.triangles[m]
        i0, i1 = _reach(tri, 0, bins.origin[0], bins.width, columns)
        j0, j1 = _reach(tri, 1, bins.origin[1], bins.width, rows)
        low = min(tri[0, 2], min(tri[1, 2], tri[2, 2]))
        high = max(tri[0, 2], max(tri[1, 2], tri[2, 2]))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                bins.items[bins.last[i, j]] = m
                bins.last[i, j] += 1
                bins.heights[i, j, 0] = min(bins.heights[i, j, 0], low)
                bins.heights[i, j, 1] = max(bins.heights[i, j, 1], high)


@njit(cache=True, nogil=True, error_model="numpy")
def segment_distance2(px: float, py: float, pz: float, ex: float, ey: float, ez: float) -> float:
    """Squared distance from p to the segment from the origin to e."""
    length2 = ex * ex + ey * ey + ez * ez
    t = 0.0
    if length2 > 0.0:
        t = min(1.0, max(0.0, (px * ex + py * ey + pz * ez) / length2))
    qx, qy, qz = px - t * ex, py - t * ey, pz - t * ez
    return qx * qx + qy * qy + qz * qz


@njit(cache=True, nogil=True, error_model="numpy")
def triangle_distance2(tri: Array, x: float, y: float, z: float) -> float:
    """Squared distance from a point to a triangle, shape (3, 3); slivers are fine."""
    px, py, pz = x - tri[0, 0], y - tri[0, 1], z - tri[0, 2]
    qx, qy, qz = x - tri[1, 0], y - tri[1, 1], z - tri[1, 2]
    rx, ry, rz = x - tri[2, 0], y - tri[2, 1], z - tri[2, 2]
    ux, uy, uz = px - qx, py - qy, pz - qz
    vx, vy, vz = qx - rx, qy - ry, qz - rz
    wx, wy, wz = rx - px, ry - py, rz - pz
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    # Sides of the three planes through the edges, along the normal.
    a = (uy * nz - uz * ny) * px + (uz * nx - ux * nz) * py + (ux * ny - uy * nx) * pz
    b = (vy * nz - vz * ny) * qx + (vz * nx - vx * nz) * qy + (vx * ny - vy * nx) * qz
    c = (wy * nz - wz * ny) * rx + (wz * nx - wx * nz) * ry + (wx * ny - wy * nx) * rz
    if a < 0.0 and b < 0.0 and c < 0.0:
        d = nx * px + ny * py + nz * pz
        return d * d / (nx * nx + ny * ny + nz * nz)
    return min(
        segment_distance2(px, py, pz, ux, uy, uz),
        min(
            segment_distance2(qx, qy, qz, vx, vy, vz),
            segment_distance2(rx, ry, rz, wx, wy, wz),
        ),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def signed_distances(bins: Bins, points: Array, out: Array) -> None:
    """Distances [m] to a closed surface, negative inside, at points of shape (n, 3)."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        distance = math.sqrt(_distance2(bins, x, y, z))
        out[n] = -distance if _winding(bins, x, y, z) != 0 else distance


@njit(cache=True, nogil=True, error_model="numpy")
def _distance2(bins: Bins, x: float, y: float, z: float) -> float:
    """Squared distance to the nearest triangle: cells are searched in growing squares."""
    columns, rows = bins.first.shape
    ci = _cell(x, bins.origin[0], bins.width, columns)
    cj = _cell(y, bins.origin[1], bins.width, rows)
    best = math.inf
    for ring in range(max(columns, rows)):
        least = max(0.0, (ring - 1) * bins.width)
        if least * least >= best:
            break
        for i in range(max(0, ci - ring), min(columns, ci + ring + 1)):
            step = 1 if abs(i - ci) == ring else max(1, 2 * ring)
            for j in range(cj - ring, cj + ring + 1, step):
                if 0 <= j < rows:
                    best = _nearest_in_cell(bins, i, j, x, y, z, best)
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_in_cell(bins: Bins, i: int, j: int, x: float, y: float, z: float,
                     best: float) -> float:  # fmt: skip
    """``best``, or the squared distance to a triangle of a cell if that is less."""
    left, low = bins.origin[0] + i * bins.width, bins.origin[1] + j * bins.width
    dx = max(0.0, max(left - x, x - left - bins.width))
    dy = max(0.0, max(low - y, y - low - bins.width))
    dz = max(0.0, max(bins.heights[i, j, 0] - z, z - bins.heights[i, j, 1]))
    # what lies in the cell is no nearer; a triangle's other parts count in their own cells
    if (dx * dx + dy * dy + dz * dz) * (1.0 - 1e-9) >= best:
        return best
    for k in range(bins.first[i, j], bins.last[i, j]):
        tri = bins.triangles[bins.items[k]]
        away = 0.0
        for axis, at in enumerate((x, y, z)):
            a, b, c = tri[0, axis], tri[1, axis], tri[2, axis]
            off = max(0.0, max(min(a, min(b, c)) - at, at - max(a, max(b, c))))
            away += off * off
        if away < best:
            best = min(best, triangle_distance2(tri, x, y, z))
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _winding(bins: Bins, x: float, y: float, z: float) -> int:
    """How often the surface winds around a point, from its crossings of a ray along z.

    Every edge is cut in one and the same order of its ends and with half-open comparisons, so
    a ray through an edge or a vertex counts each crossing of a closed surface exactly once.
    """
    i = _cell(x, bins.origin[0], bins.width, bins.first.shape[0])
    j = _cell(y, bins.origin[1], bins.width, bins.first.shape[1])
    total = 0
    for k in range(bins.first[i, j], bins.last[i, j]):
        tri = bins.triangles[bins.items[k]]
        around = 0
        for e in range(3):
            f = (e + 1) % 3
            upward = tri[e, 1] <= y
            if upward == (tri[f, 1] <= y):
                continue
            a, b = (e, f) if upward else (f, e)
            s = (y - tri[a, 1]) / (tri[b, 1] - tri[a, 1])
            if tri[a, 0] + s * (tri[b, 0] - tri[a, 0]) > x:
                around += 1 if upward else -1
        if around != 0 and _height(tri, x, y) > z:
            total += around
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _height(tri: Array, x: float, y: float) -> float:
    """Height of a triangle's plane at (x, y), within its own [m]."""
    ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
    vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    z = tri[0, 2]
    if nz != 0.0:
        z -= (nx * (x - tri[0, 0]) + ny * (y - tri[0, 1])) / nz
    low = min(tri[0, 2], min(tri[1, 2], tri[2, 2]))
    return min(max(z, low), max(tri[0, 2], max(tri[1, 2], tri[2, 2])))
