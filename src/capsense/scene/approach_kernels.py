"""Compiled: where a convex primitive comes closest to a line, and how slender it is."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense.scene.shape import ShapeKind

Array = NDArray[np.float64]

_BOX = int(ShapeKind.BOX)
_SPHERE = int(ShapeKind.SPHERE)
_CAPSULE = int(ShapeKind.CAPSULE)
_CYLINDER = int(ShapeKind.CYLINDER)
_ELLIPSOID = int(ShapeKind.ELLIPSOID)
_INNER = 0.999
"""How far out from the middle the points found lie, so that they are safely inside."""
_ROUNDS = 4


@kernel
def slenderness(kind: int, params: Array) -> float:
    """Middle one of a primitive's three extents [m]: small for rods and specks, not for plates.

    Infinity for other shapes.
    """
    if kind in (_BOX, _ELLIPSOID):
        a, b, c = params[0], params[1], params[2]
        return 2.0 * max(min(a, b), min(max(a, b), c))
    if kind in (_SPHERE, _CAPSULE, _CYLINDER):
        return 2.0 * params[0]
    return math.inf


@kernel
def _pull_in(kind: int, params: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The point of a primitive nearest to (x, y, z), all in its frame (ellipsoid: radially)."""
    if kind == _BOX:
        a, b, c = _INNER * params[0], _INNER * params[1], _INNER * params[2]
        return min(max(x, -a), a), min(max(y, -b), b), min(max(z, -c), c)
    if kind == _ELLIPSOID:
        far = math.sqrt((x / params[0]) ** 2 + (y / params[1]) ** 2 + (z / params[2]) ** 2)
        s = min(1.0, _INNER / far) if far > 0.0 else 1.0
        return s * x, s * y, s * z
    middle = 0.0
    if kind == _CAPSULE:
        middle = min(max(z, -params[1]), params[1])
    elif kind == _CYLINDER:
        c = _INNER * params[1]
        middle = min(max(z, -c), c)
        z = middle
    far = math.sqrt(x * x + y * y + (z - middle) ** 2)
    s = min(1.0, _INNER * params[0] / far) if far > 0.0 else 1.0
    return s * x, s * y, middle + s * (z - middle)


@kernel
def approach(
    kind: int,
    params: Array,
    rotation: Array,
    position: Array,
    ox: float,
    oy: float,
    oz: float,
    axis: int,
) -> tuple[float, float, float]:
    """A point of a body about where it comes closest to a line along an axis.

    Alternating projections between the line and the convex body (Cheney and Goldstein 1959), a few
    rounds of them: for a line that passes an edge or an end the point is near the closest one.

    Args:
        kind: A :class:`~capsense.scene.shape.ShapeKind` of a primitive.
        params: Sizes [m] of the shape, shape (3,).
        rotation: Body's frame to sensor frame, shape (3, 3).
        position: Origin of the body's frame [m] in the sensor frame, shape (3,).
        ox, oy, oz: A point [m] on the line.
        axis: Direction of the line: 0, 1 or 2.

    Returns:
        The point's coordinates [m] in the sensor frame.
    """
    r = rotation
    px, py, pz = ox - position[0], oy - position[1], oz - position[2]
    lx = r[0, 0] * px + r[1, 0] * py + r[2, 0] * pz
    ly = r[0, 1] * px + r[1, 1] * py + r[2, 1] * pz
    lz = r[0, 2] * px + r[1, 2] * py + r[2, 2] * pz
    dx, dy, dz = r[axis, 0], r[axis, 1], r[axis, 2]
    x, y, z = 0.0, 0.0, 0.0
    for _ in range(_ROUNDS):
        t = (x - lx) * dx + (y - ly) * dy + (z - lz) * dz
        x, y, z = _pull_in(kind, params, lx + t * dx, ly + t * dy, lz + t * dz)
    return (
        position[0] + r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        position[1] + r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        position[2] + r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )
