"""Compiled geometry: distances to triangles, and the poses and bounds of a scene's bodies."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.scene.ellipsoid_kernels import ellipsoid_distance
from capsense.scene.shapes import ShapeKind

Array = NDArray[np.float64]

_LEAF = 4
"""Triangles in a box without parts, at most."""
_ROUNDED = 1 + 1e-9
"""Makes room for the rounding of an upper bound."""


class Boxes(NamedTuple):
    """Triangles in a balanced tree of boxes, each of which has two parts."""

    triangles: Array
    """Corners [m], in the order of the tree, shape (m, 3, 3)."""
    levels: int
    """Box q of level l holds triangles q m / 2^l to (q + 1) m / 2^l; so many levels."""
    corners: Array
    """Lower and upper corners of the boxes, level by level [m], shape (2^levels - 1, 2, 3)."""


def boxed(triangles: Array) -> Boxes:
    """Put triangles, corners [m] of shape (m, 3, 3), into a tree of boxes."""
    order = np.arange(len(triangles))
    _sort(triangles.mean(axis=1), _levels(len(triangles)), order)
    return enclosed(np.ascontiguousarray(triangles[order]))


def enclosed(triangles: Array) -> Boxes:
    """The tree of triangles, (m, 3, 3), that are already in its order."""
    levels = _levels(len(triangles))
    boxes = Boxes(triangles, levels, np.empty((2**levels - 1, 2, 3)))
    _enclose(boxes)
    return boxes


def _levels(count: int) -> int:
    return 1 + max(0, math.ceil(math.log2(count / _LEAF)))


@compiled
def _sort(centers: Array, levels: int, order: NDArray[np.int64]) -> None:
    """Order triangles so that every box is split across its longest side."""
    count = len(order)
    for level in range(levels - 1):
        for q in range(1 << level):
            part = order[(q * count) >> level : ((q + 1) * count) >> level]
            wide, longest = 0, -1.0
            for axis in range(3):
                along = centers[part, axis]
                if along.max() - along.min() > longest:
                    wide, longest = axis, along.max() - along.min()
            part[:] = part[np.argsort(centers[part, wide])]


@compiled
def _enclose(boxes: Boxes) -> None:
    """Fill in the corners of the boxes."""
    count, levels = len(boxes.triangles), boxes.levels
    leaves = 1 << (levels - 1)
    for k in range(2 * leaves - 2, -1, -1):
        low, high = boxes.corners[k, 0], boxes.corners[k, 1]
        low[:], high[:] = math.inf, -math.inf
        if k < leaves - 1:
            for part in range(2 * k + 1, 2 * k + 3):
                for axis in range(3):
                    low[axis] = min(low[axis], boxes.corners[part, 0, axis])
                    high[axis] = max(high[axis], boxes.corners[part, 1, axis])
            continue
        q = k - leaves + 1
        for m in range((q * count) >> (levels - 1), ((q + 1) * count) >> (levels - 1)):
            for corner in range(3):
                for axis in range(3):
                    low[axis] = min(low[axis], boxes.triangles[m, corner, axis])
                    high[axis] = max(high[axis], boxes.triangles[m, corner, axis])


@kernel
def segment_distance2(px: float, py: float, pz: float, ex: float, ey: float, ez: float) -> float:
    """Squared distance from p to the segment from the origin to e."""
    length2 = ex * ex + ey * ey + ez * ez
    t = 0.0
    if length2 > 0.0:
        t = min(1.0, max(0.0, (px * ex + py * ey + pz * ez) / length2))
    qx, qy, qz = px - t * ex, py - t * ey, pz - t * ez
    return qx * qx + qy * qy + qz * qz


@kernel
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


@compiled
def signed_distances(boxes: Boxes, points: Array, out: Array) -> None:
    """Distances [m] to a closed surface, negative inside, at points of shape (n, 3)."""
    stack, least = np.empty(2 * boxes.levels, np.int64), np.empty(2 * boxes.levels)
    distance = math.inf
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if n > 0:  # no farther than the last, and the way from there
            dx, dy, dz = x - points[n - 1, 0], y - points[n - 1, 1], z - points[n - 1, 2]
            distance = (distance + math.sqrt(dx * dx + dy * dy + dz * dz)) * _ROUNDED
        distance = math.sqrt(_distance2(boxes, x, y, z, stack, least, distance * distance))
        out[n] = -distance if _winding(boxes, x, y, z, stack) != 0 else distance


@kernel
def _box_distance2(box: Array, x: float, y: float, z: float) -> float:
    """Squared distance to a box, zero inside."""
    dx = max(0.0, max(box[0, 0] - x, x - box[1, 0]))
    dy = max(0.0, max(box[0, 1] - y, y - box[1, 1]))
    dz = max(0.0, max(box[0, 2] - z, z - box[1, 2]))
    return dx * dx + dy * dy + dz * dz


@kernel
def _distance2(boxes: Boxes, x: float, y: float, z: float, stack: NDArray[np.int64],
               least: Array, best: float) -> float:  # fmt: skip
    """Squared distance to the nearest triangle, known to be at most ``best``.

    ``stack`` and ``least`` are room to work in.
    """
    count, levels = len(boxes.triangles), boxes.levels
    leaves = 1 << (levels - 1)
    top = 1
    stack[0], least[0] = 0, 0.0
    while top > 0:
        top -= 1
        k = stack[top]
        if least[top] >= best:
            continue
        if k >= leaves - 1:
            q = k - leaves + 1
            for m in range((q * count) >> (levels - 1), ((q + 1) * count) >> (levels - 1)):
                best = min(best, triangle_distance2(boxes.triangles[m], x, y, z))
            continue
        near, far = 2 * k + 1, 2 * k + 2
        to_near = _box_distance2(boxes.corners[near], x, y, z)
        to_far = _box_distance2(boxes.corners[far], x, y, z)
        if to_far < to_near:
            near, far, to_near, to_far = far, near, to_far, to_near
        stack[top], least[top] = far, to_far
        stack[top + 1], least[top + 1] = near, to_near
        top += 2
    return best


@kernel
def _winding(boxes: Boxes, x: float, y: float, z: float, stack: NDArray[np.int64]) -> int:
    """How often the surface winds around a point, from its crossings of a ray along z."""
    count, levels = len(boxes.triangles), boxes.levels
    leaves = 1 << (levels - 1)
    total, top = 0, 1
    stack[0] = 0
    while top > 0:
        top -= 1
        k = stack[top]
        low, high = boxes.corners[k, 0], boxes.corners[k, 1]
        if z > high[2] or x < low[0] or x > high[0] or y < low[1] or y > high[1]:
            continue
        if k < leaves - 1:
            stack[top], stack[top + 1] = 2 * k + 1, 2 * k + 2
            top += 2
            continue
        q = k - leaves + 1
        for m in range((q * count) >> (levels - 1), ((q + 1) * count) >> (levels - 1)):
            tri = boxes.triangles[m]
            around = _around(tri, x, y)
            if around != 0 and _height(tri, x, y) > z:
                total += around
    return total


@kernel
def _around(tri: Array, x: float, y: float) -> int:
    """Whether a triangle, seen along z, lies around a point: 1, -1 from behind, else 0.

    Every edge is cut in one and the same order of its ends and with half-open comparisons, so
    a ray through an edge or a vertex meets a closed surface exactly once.
    """
    out = 0
    for e in range(3):
        f = (e + 1) % 3
        upward = tri[e, 1] <= y
        if upward == (tri[f, 1] <= y):
            continue
        a, b = (e, f) if upward else (f, e)
        s = (y - tri[a, 1]) / (tri[b, 1] - tri[a, 1])
        if tri[a, 0] + s * (tri[b, 0] - tri[a, 0]) > x:
            out += 1 if upward else -1
    return out


@kernel
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


_SPHERE = int(ShapeKind.SPHERE)
_CAPSULE = int(ShapeKind.CAPSULE)
_CYLINDER = int(ShapeKind.CYLINDER)
_ELLIPSOID = int(ShapeKind.ELLIPSOID)


@kernel
def _half_width(kind: float, size: Array, r: Array, nx: float, ny: float, nz: float) -> float:
    """Half the width of a turned shape [m] along a unit vector; of a mesh, that of its box."""
    x = r[0, 0] * nx + r[1, 0] * ny + r[2, 0] * nz
    y = r[0, 1] * nx + r[1, 1] * ny + r[2, 1] * nz
    z = r[0, 2] * nx + r[1, 2] * ny + r[2, 2] * nz
    if kind == _SPHERE:
        return size[0]
    if kind == _CAPSULE:
        return size[0] + size[1] * abs(z)
    if kind == _CYLINDER:
        return size[1] * abs(z) + size[0] * math.sqrt(max(0.0, 1.0 - z * z))
    if kind == _ELLIPSOID:
        return math.sqrt((size[0] * x) ** 2 + (size[1] * y) ** 2 + (size[2] * z) ** 2)
    return size[0] * abs(x) + size[1] * abs(y) + size[2] * abs(z)


@njit(cache=True, error_model="numpy")  # too short to let other threads in
def place_bodies(table: Array, rotation: Array, bounds: Array) -> None:
    """Fill rotation matrices and sensor-frame bounding boxes of all bodies.

    Args:
        table: A row for each body, shape (n, 14): shape kind, three sizes [m], centre of the local
            bounding box [m], unit quaternion (x, y, z, w), origin of the body's frame [m].
        rotation: Receives the rotation matrices, shape (n, 3, 3).
        bounds: Receives lower and upper corners [m], shape (n, 2, 3).
    """
    axes = np.eye(3)
    for i in range(table.shape[0]):
        kind, centre, position = table[i, 0], table[i, 4:7], table[i, 11:14]
        x, y, z, w = table[i, 7], table[i, 8], table[i, 9], table[i, 10]
        r = rotation[i]
        r[0, 0] = 1 - 2 * (y * y + z * z)
        r[0, 1] = 2 * (x * y - z * w)
        r[0, 2] = 2 * (x * z + y * w)
        r[1, 0] = 2 * (x * y + z * w)
        r[1, 1] = 1 - 2 * (x * x + z * z)
        r[1, 2] = 2 * (y * z - x * w)
        r[2, 0] = 2 * (x * z - y * w)
        r[2, 1] = 2 * (y * z + x * w)
        r[2, 2] = 1 - 2 * (x * x + y * y)
        for k in range(3):
            half = _half_width(kind, table[i, 1:4], r, axes[k, 0], axes[k, 1], axes[k, 2])
            middle = position[k] + r[k, 0] * centre[0] + r[k, 1] * centre[1] + r[k, 2] * centre[2]
            bounds[i, 0, k] = middle - half
            bounds[i, 1, k] = middle + half


@kernel
def primitive_distance(kind: int, size: Array, x: float, y: float, z: float) -> float:
    """Distance of a point from a round primitive or a cylinder [m], negative inside.

    Args:
        kind: ``ShapeKind`` of the shape; no box.
        size: Its ``params`` [m], shape (3,).
        x, y, z: The point in the shape's frame [m].
    """
    if kind == _SPHERE:
        return math.sqrt(x * x + y * y + z * z) - size[0]
    if kind == _CAPSULE:
        z -= min(max(z, -size[1]), size[1])
        return math.sqrt(x * x + y * y + z * z) - size[0]
    if kind == _CYLINDER:
        side, end = math.sqrt(x * x + y * y) - size[0], abs(z) - size[1]
        over, beyond = max(side, 0.0), max(end, 0.0)
        return math.sqrt(over * over + beyond * beyond) + min(max(side, end), 0.0)
    return ellipsoid_distance(size, x, y, z)


@compiled
def parted(
    pairs: NDArray[np.int64],
    kinds: NDArray[np.int64],
    sizes: Array,
    rotation: Array,
    position: Array,
    gap: float,
) -> NDArray[np.bool_]:
    """Which pairs of bodies lie more than a gap [m] apart along an axis of one of them, shape (p,).

    Others may lie apart too.

    Args:
        pairs: Indices of bodies without meshes, which have other origins, shape (p, 2).
        kinds, sizes, rotation, position: See :class:`~capsense.scene.scene.PackedScene`.
        gap: The gap.
    """
    out = np.zeros(pairs.shape[0], np.bool_)
    for p in range(pairs.shape[0]):
        for side in range(2):
            i, j = pairs[p, side], pairs[p, 1 - side]
            r, s, arm = rotation[i], rotation[j], position[j] - position[i]
            for k in range(3):
                x, y, z = r[0, k], r[1, k], r[2, k]
                reach = _half_width(float(kinds[i]), sizes[i], r, x, y, z)
                reach += _half_width(float(kinds[j]), sizes[j], s, x, y, z)
                out[p] = out[p] or abs(arm[0] * x + arm[1] * y + arm[2] * z) > reach + gap
    return out


@njit(cache=True, error_model="numpy")
def overlapping(bounds: Array, low: Array, high: Array) -> NDArray[np.int64]:
    """Which boxes overlap one with corners ``low`` and ``high`` [m], each of shape (3,), ascending.

    Args:
        bounds: Lower and upper corners [m], shape (n, 2, 3).
    """
    out, count = np.empty(bounds.shape[0], np.int64), 0
    for i in range(bounds.shape[0]):
        apart = False
        for k in range(3):
            apart = apart or not (bounds[i, 1, k] > low[k] and bounds[i, 0, k] < high[k])
        if not apart:
            out[count] = i
            count += 1
    return out[:count]
