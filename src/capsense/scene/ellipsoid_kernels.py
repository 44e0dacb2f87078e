"""Distances from an ellipsoid, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel

Array = NDArray[np.float64]

_NEWTON = 50
"""Newton steps towards the nearest point at most."""


@kernel
def ellipsoid_distance(radii: Array, x: float, y: float, z: float) -> float:
    """As of ``Ellipsoid.signed_distance``."""
    a, b, c = radii[0], radii[1], radii[2]
    least = min(a, min(b, c))
    x, y, z = (max(abs(x), 1e-9 * least), max(abs(y), 1e-9 * least), max(abs(z), 1e-9 * least))
    p, q, r = a * a - least * least, b * b - least * least, c * c - least * least
    s = max(a * x - p, max(b * y - q, c * z - r))
    for _ in range(_NEWTON):
        u, v, w = a * x / (s + p), b * y / (s + q), c * z / (s + r)
        u, v, w = u * u, v * v, w * w
        step = 0.5 * (u + v + w - 1.0) / (u / (s + p) + v / (s + q) + w / (s + r))
        s += max(step, 0.0)
        if step <= 1e-14 * s:
            break
    u, v, w = x - a * a * x / (s + p), y - b * b * y / (s + q), z - c * c * z / (s + r)
    distance = math.sqrt(u * u + v * v + w * w)
    return -distance if (x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2 < 1.0 else distance


@compiled
def ellipsoid_distances(points: Array, radii: Array) -> Array:
    """Distances of points (n, 3) from an ellipsoid of half axes (3,) [m], negative inside."""
    out = np.empty(points.shape[0])
    for k in range(points.shape[0]):
        out[k] = ellipsoid_distance(radii, points[k, 0], points[k, 1], points[k, 2])
    return out
