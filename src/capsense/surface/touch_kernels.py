"""Undersides of bodies over the cover of a flat design, compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled
from capsense.elements.outline import middle_height, nearest, reach_down

STEPS = 60
"""Steps up to a surface at most."""


@compiled
def undersides(
    bodies: NDArray[np.void], points: NDArray[Any], highest: float, exact: float
) -> NDArray[Any]:
    """Heights of the lowest point of any of some bodies above points (k, 2) of a plane [m].

    Infinite where there is none below ``highest`` [m]. Found by stepping up by the distance to the
    nearest point (sphere tracing; J. C. Hart, *The Visual Computer* 12, 1996).

    Args:
        bodies: Records of :data:`~capsense.elements.rigid.BODY` with outlines, shape (b,).
        points: Where [m], shape (k, 2).
        highest: Where the search ends [m].
        exact: How exactly the surface is found [m].
    """
    out = np.empty(points.shape[0])
    point, room = np.empty(9), np.empty(140)
    low = math.inf
    for b in range(bodies.shape[0]):
        low = min(low, middle_height(bodies[b]) - reach_down(bodies[b]))
    for k in range(points.shape[0]):
        z, out[k] = low - exact, math.inf
        for _ in range(STEPS):
            off = math.inf
            for b in range(bodies.shape[0]):
                way, _ = nearest(bodies[b], points[k, 0], points[k, 1], z, point, room)
                off = min(off, way)
            if off < exact:
                out[k] = z
                break
            z += off
            if z > highest:
                break
    return out


@compiled
def extents(bodies: NDArray[np.void]) -> NDArray[Any]:
    """What outlines span: x and y from and to, the lowest point, and the middle [m], (b, 6).

    Rows of bodies without an outline are infinite.
    """
    out = np.full((bodies.shape[0], 6), np.inf)
    point, room = np.empty(9), np.empty(140)
    for b in range(bodies.shape[0]):
        body = bodies[b]
        if body.outline == 0:
            continue
        far = 1e4 * body.scale
        for axis in range(2):
            for side in range(2):
                x, y = body.position[0], body.position[1]
                if axis == 0:
                    x += far if side == 1 else -far
                else:
                    y += far if side == 1 else -far
                nearest(body, x, y, body.position[2], point, room)
                out[b, 2 * axis + side] = point[axis]
        out[b, 5] = middle_height(body)
        out[b, 4] = out[b, 5] - reach_down(body)
    return out
