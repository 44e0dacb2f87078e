"""Compiled placing of bodies."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from capsense.scene.shape import ShapeKind

Array = NDArray[np.float64]

_SPHERE = int(ShapeKind.SPHERE)
_CAPSULE = int(ShapeKind.CAPSULE)
_CYLINDER = int(ShapeKind.CYLINDER)
_ELLIPSOID = int(ShapeKind.ELLIPSOID)


@njit(cache=True, error_model="numpy")  # too short to let other threads in
def place_bodies(table: Array, rotation: Array, bounds: Array) -> None:
    """Fill rotation matrices and sensor-frame bounding boxes of all bodies.

    Args:
        table: A row for each body, shape (n, 14): shape kind, three sizes [m], centre of the local
            bounding box [m], unit quaternion (x, y, z, w), origin of the body's frame [m].
        rotation: Receives the rotation matrices, shape (n, 3, 3).
        bounds: Receives lower and upper corners [m], shape (n, 2, 3).
    """
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
        a, b, c = table[i, 1], table[i, 2], table[i, 3]
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
            middle = position[k] + r[k, 0] * centre[0] + r[k, 1] * centre[1] + r[k, 2] * centre[2]
            bounds[i, 0, k] = middle - half
            bounds[i, 1, k] = middle + half
