"""Compiled construction of signed-distance grids from closed triangle surfaces."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
def fill_band(
    triangles: Array,
    origin: Array,
    h: float,
    band: float,
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
) -> None:
    """Set the exact distance at every grid node closer to the surface than ``band``.

    Args:
        triangles: Corners [m], shape (m, 3, 3).
        origin: First node [m], shape (3,).
        h: Node spacing [m].
        band: Half width of the band [m].
        distance: Distances [m], shape (nx, ny, nz); holds large numbers on entry.
        nearest: Receives the nearest triangle, -1 outside the band.
    """
    nearest[:] = -1
    shape = distance.shape
    low = np.zeros(3, dtype=np.int64)
    high = np.zeros(3, dtype=np.int64)
    for m in range(triangles.shape[0]):
        tri = triangles[m]
        for k in range(3):
            least = min(tri[0, k], min(tri[1, k], tri[2, k])) - band - origin[k]
            most = max(tri[0, k], max(tri[1, k], tri[2, k])) + band - origin[k]
            low[k] = max(0, int(math.ceil(least / h)))
            high[k] = min(shape[k] - 1, int(math.floor(most / h)))
        ux, uy, uz = tri[1, 0] - tri[0, 0], tri[1, 1] - tri[0, 1], tri[1, 2] - tri[0, 2]
        vx, vy, vz = tri[2, 0] - tri[0, 0], tri[2, 1] - tri[0, 1], tri[2, 2] - tri[0, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        if norm > 0.0:
            nx, ny, nz = nx / norm, ny / norm, nz / norm
        for i in range(low[0], high[0] + 1):
            x = origin[0] + h * i
            for j in range(low[1], high[1] + 1):
                y = origin[1] + h * j
                for k in range(low[2], high[2] + 1):
                    z = origin[2] + h * k
                    off = nx * (x - tri[0, 0]) + ny * (y - tri[0, 1]) + nz * (z - tri[0, 2])
                    if abs(off) > min(band, distance[i, j, k]):
                        continue
                    d = math.sqrt(triangle_distance2(tri, x, y, z))
                    if d <= band and d < distance[i, j, k]:
                        distance[i, j, k] = d
                        nearest[i, j, k] = m


@njit(cache=True, nogil=True, error_model="numpy")
def fill_far(
    triangles: Array,
    origin: Array,
    h: float,
    source: NDArray[np.int32],
    distance: NDArray[np.float32],
    nearest: NDArray[np.int32],
) -> None:
    """Set the distance beyond the band: to the triangle of the nearest node of the band.

    Args:
        triangles: Corners [m], shape (m, 3, 3).
        origin: First node [m], shape (3,).
        h: Node spacing [m].
        source: Indices of the nearest node of the band, shape (3, nx, ny, nz).
        distance: Distances [m], shape (nx, ny, nz), right within the band.
        nearest: Nearest triangles, -1 outside the band.
    """
    nx, ny, nz = distance.shape
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if nearest[i, j, k] < 0:
                    m = nearest[source[0, i, j, k], source[1, i, j, k], source[2, i, j, k]]
                    x, y, z = origin[0] + h * i, origin[1] + h * j, origin[2] + h * k
                    distance[i, j, k] = math.sqrt(triangle_distance2(triangles[m], x, y, z))


@njit(cache=True, nogil=True, error_model="numpy")
def set_signs(
    triangles: Array,
    origin: Array,
    h: float,
    winding: NDArray[np.int32],
    distance: NDArray[np.float32],
) -> None:
    """Negate the distance at nodes that the surface winds around, by rays along x.

    Every edge is cut in one and the same order of its ends and with half-open comparisons, so
    a ray through an edge or a vertex counts each crossing of a closed surface exactly once.
    Overlapping closed parts act as their union.

    Args:
        triangles: Corners [m] of a closed, consistently wound surface, shape (m, 3, 3).
        origin: First node [m], shape (3,).
        h: Node spacing [m].
        winding: Zeros on entry, shape (nx, ny, nz); receives winding numbers.
        distance: Distances [m], shape (nx, ny, nz).
    """
    nx, ny, nz = distance.shape
    for m in range(triangles.shape[0]):
        tri = triangles[m]
        z_low = min(tri[0, 2], min(tri[1, 2], tri[2, 2]))
        z_high = max(tri[0, 2], max(tri[1, 2], tri[2, 2]))
        y_low = min(tri[0, 1], min(tri[1, 1], tri[2, 1]))
        y_high = max(tri[0, 1], max(tri[1, 1], tri[2, 1]))
        x_low = min(tri[0, 0], min(tri[1, 0], tri[2, 0]))
        x_high = max(tri[0, 0], max(tri[1, 0], tri[2, 0]))
        # One node more on either side: the comparisons below decide, not this rounding.
        j0 = max(0, int(math.floor((y_low - origin[1]) / h)))
        j1 = min(ny - 1, int(math.ceil((y_high - origin[1]) / h)))
        k0 = max(0, int(math.floor((z_low - origin[2]) / h)))
        k1 = min(nz - 1, int(math.ceil((z_high - origin[2]) / h)))
        for k in range(k0, k1 + 1):
            z = origin[2] + h * k
            # The plane cuts no edge or two, one on its way up and one on its way down.
            up_x, up_y, down_x, down_y = 0.0, 0.0, 0.0, 0.0
            cut = False
            for e in range(3):
                f = (e + 1) % 3
                starts_below = tri[e, 2] <= z
                ends_below = tri[f, 2] <= z
                if starts_below == ends_below:
                    continue
                cut = True
                a, b = (e, f) if starts_below else (f, e)
                s = (z - tri[a, 2]) / (tri[b, 2] - tri[a, 2])
                ex = tri[a, 0] + s * (tri[b, 0] - tri[a, 0])
                ey = tri[a, 1] + s * (tri[b, 1] - tri[a, 1])
                if starts_below:
                    up_x, up_y = ex, ey
                else:
                    down_x, down_y = ex, ey
            if not cut:
                continue
            for j in range(j0, j1 + 1):
                y = origin[1] + h * j
                hit = int(up_y <= y) - int(down_y <= y)
                if hit == 0:
                    continue
                x = up_x + (y - up_y) / (down_y - up_y) * (down_x - up_x)
                x = min(x_high, max(x_low, x))
                i = max(0, int(math.ceil((x - origin[0]) / h)))
                if i < nx:
                    winding[i, j, k] += hit
    for j in range(ny):
        for k in range(nz):
            around = 0
            for i in range(nx):
                around += winding[i, j, k]
                winding[i, j, k] = around
                if around != 0:
                    distance[i, j, k] = -distance[i, j, k]
