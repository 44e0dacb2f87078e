"""Compiled line intersections, called from the solver's kernels. Numba is imported here only.

All functions are free of allocations and never return NaN for finite lines of non-zero
direction. Misses are ``(inf, -inf)``, so ``t0 <= t1`` tells a hit. The readable references are
the ``line_intervals`` methods of :mod:`capsense.scene.shapes`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from capsense.scene.shape import ShapeKind
from capsense.scene.shapes import PARALLEL

Array = NDArray[np.float64]

_BOX = int(ShapeKind.BOX)
_SPHERE = int(ShapeKind.SPHERE)
_CAPSULE = int(ShapeKind.CAPSULE)
_CYLINDER = int(ShapeKind.CYLINDER)
_ELLIPSOID = int(ShapeKind.ELLIPSOID)
_PARALLEL = float(PARALLEL)
_INF = math.inf


@njit(cache=True, error_model="numpy")
def slab(o: float, d: float, half: float) -> tuple[float, float]:
    """Line against −half <= x <= half, one coordinate."""
    if d == 0.0:
        if abs(o) <= half:
            return -_INF, _INF
        return _INF, -_INF
    t0 = (-half - o) / d
    t1 = (half - o) / d
    if t0 <= t1:
        return t0, t1
    return t1, t0


@njit(cache=True, error_model="numpy")
def ball(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, radius: float
) -> tuple[float, float]:
    """Line against a ball; the discriminant is taken at the foot of the perpendicular."""
    a = dx * dx + dy * dy + dz * dz
    middle = -(ox * dx + oy * dy + oz * dz) / a
    fx = ox + middle * dx
    fy = oy + middle * dy
    fz = oz + middle * dz
    square = radius * radius - (fx * fx + fy * fy + fz * fz)
    if square < 0.0:
        return _INF, -_INF
    half = math.sqrt(square / a)
    return middle - half, middle + half


@njit(cache=True, error_model="numpy")
def cylinder(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    radius: float,
    half: float,
) -> tuple[float, float]:
    """Line against a cylinder along z of half length ``half``."""
    s0, s1 = slab(oz, dz, half)
    if s0 > s1:
        return _INF, -_INF
    d2 = dx * dx + dy * dy
    if d2 <= _PARALLEL * (d2 + dz * dz):
        if ox * ox + oy * oy <= radius * radius:
            return s0, s1
        return _INF, -_INF
    t0, t1 = ball(ox, oy, 0.0, dx, dy, 0.0, radius)
    t0 = max(t0, s0)
    t1 = min(t1, s1)
    if t0 > t1:
        return _INF, -_INF
    return t0, t1


@njit(cache=True, error_model="numpy")
def line_interval(
    kind: int,
    params: Array,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, float]:
    """Stretch of the line o + t d inside a convex primitive, all in the body's frame.

    Args:
        kind: A :class:`~capsense.scene.shape.ShapeKind`; meshes always miss here, see
            :func:`mesh_line_intervals`.
        params: Sizes [m] of the shape, shape (3,).
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.

    Returns:
        Entry and exit parameter; ``(inf, -inf)`` for a miss.
    """
    if kind == _BOX:
        t0, t1 = slab(ox, dx, params[0])
        u0, u1 = slab(oy, dy, params[1])
        v0, v1 = slab(oz, dz, params[2])
        t0 = max(t0, max(u0, v0))
        t1 = min(t1, min(u1, v1))
        if t0 > t1:
            return _INF, -_INF
        return t0, t1
    if kind == _SPHERE:
        return ball(ox, oy, oz, dx, dy, dz, params[0])
    if kind == _CAPSULE:
        r = params[0]
        h = params[1]
        t0, t1 = cylinder(ox, oy, oz, dx, dy, dz, r, h)
        u0, u1 = ball(ox, oy, oz - h, dx, dy, dz, r)
        v0, v1 = ball(ox, oy, oz + h, dx, dy, dz, r)
        return min(t0, min(u0, v0)), max(t1, max(u1, v1))
    if kind == _CYLINDER:
        return cylinder(ox, oy, oz, dx, dy, dz, params[0], params[1])
    if kind == _ELLIPSOID:
        a = 1.0 / params[0]
        b = 1.0 / params[1]
        c = 1.0 / params[2]
        return ball(ox * a, oy * b, oz * c, dx * a, dy * b, dz * c, 1.0)
    return _INF, -_INF


@njit(cache=True, error_model="numpy")
def body_line_interval(
    kind: int,
    params: Array,
    rotation: Array,
    position: Array,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, float]:
    """As :func:`line_interval`, for a line in the sensor frame and a body standing in it.

    Args:
        kind: A :class:`~capsense.scene.shape.ShapeKind`.
        params: Sizes [m] of the shape, shape (3,).
        rotation: Body's frame to sensor frame, shape (3, 3).
        position: Origin of the body's frame [m] in the sensor frame, shape (3,).
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.

    Returns:
        Entry and exit parameter; ``(inf, -inf)`` for a miss.
    """
    px = ox - position[0]
    py = oy - position[1]
    pz = oz - position[2]
    r = rotation
    return line_interval(
        kind,
        params,
        r[0, 0] * px + r[1, 0] * py + r[2, 0] * pz,
        r[0, 1] * px + r[1, 1] * py + r[2, 1] * pz,
        r[0, 2] * px + r[1, 2] * py + r[2, 2] * pz,
        r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz,
        r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz,
        r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz,
    )


@njit(cache=True, error_model="numpy")
def place_bodies(
    kinds: NDArray[np.int64],
    params: Array,
    centre: Array,
    quaternion: Array,
    position: Array,
    rotation: Array,
    bounds: Array,
) -> None:
    """Fill rotation matrices and sensor-frame bounding boxes of all bodies.

    Args:
        kinds: Shape kinds, shape (n,).
        params: Sizes [m], shape (n, 3).
        centre: Centres of the local bounding boxes [m], shape (n, 3).
        quaternion: Unit quaternions (x, y, z, w), shape (n, 4).
        position: Origins of the bodies' frames [m], shape (n, 3).
        rotation: Receives the rotation matrices, shape (n, 3, 3).
        bounds: Receives lower and upper corners [m], shape (n, 2, 3).
    """
    for i in range(kinds.shape[0]):
        x, y, z, w = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
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
        a, b, c = params[i, 0], params[i, 1], params[i, 2]
        kind = kinds[i]
        for k in range(3):
            if kind == _SPHERE:
                half = a
            elif kind == _CAPSULE:
                half = a + b * abs(r[k, 2])
            elif kind == _CYLINDER:
                half = b * abs(r[k, 2]) + a * math.sqrt(max(0.0, 1.0 - r[k, 2] * r[k, 2]))
            elif kind == _ELLIPSOID:
                half = math.sqrt((a * r[k, 0]) ** 2 + (b * r[k, 1]) ** 2 + (c * r[k, 2]) ** 2)
            else:
                half = a * abs(r[k, 0]) + b * abs(r[k, 1]) + c * abs(r[k, 2])
            middle = (
                position[i, k]
                + r[k, 0] * centre[i, 0]
                + r[k, 1] * centre[i, 1]
                + r[k, 2] * centre[i, 2]
            )
            bounds[i, 0, k] = middle - half
            bounds[i, 1, k] = middle + half
