"""Points in front of a design, compiled: coordinates of its face, walls, and the lift.

Bodies are solved for no nearer to the face than the Green's function is valid. Lengths in metres.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._by_reference import by_reference
from capsense._jit import kernel

WALL_EDGE = 0.01
"""Bodies are out of the room so far beyond its bounds, over the domain's shortest side. They fade
out from the bounds on."""
WALL_FADE_LENGTH = 0.08
"""Conductors that are not at ground, whose potential the walls would else hold as they come in,
fade out over this distance up to there, over that side; but not next to the design."""
WALL_PENALTY = 1e5
"""Energy of charge that is out of reach [1/m]."""
FADED = 1e4
"""Energy that keeps charge off conductors that fade out, over that of a leaf by itself, at most."""
DEEP, STEEP = (2.3, 3.8), 4.0
"""What is deeper behind the face of a flat design than the first of these, over the validity
distance, comes to be screened by it, over the second; depth from the sides counts so many times."""


@by_reference
class Space(NamedTuple):
    """The surroundings of a design, as kernels take them that are called for single points."""

    has_face: bool
    """Whether the design has a face; shells that are no bent films have none."""
    face: NDArray[Any]
    """Corners of the design in coordinates of its face [m], shape (2, 3)."""
    curvature: float
    """Curvature of the face about the y axis [1/m]: 0 of a flat one, 1 / R of a bent film."""
    active_bounds: NDArray[Any]
    """Corners of the part of the domain where bodies count [m], shape (2, 3)."""
    extent: float
    """Shortest side of the domain [m]."""
    inner: NDArray[Any]
    """Corners of the box in which bodies are whole [m], of conductors that are not at ground the
    second, shape (2, 2, 3)."""
    fade: NDArray[Any]
    """Over how much they fade out beyond each of its sides [m], shape (2, 2, 3)."""
    validity: float
    """Distance from the face down to which the Green's function is valid [m]."""
    limit: float
    """Largest compression of the cover [m]."""


@kernel
def on_face(x, y, z, curvature):
    """Coordinates of the face of a point of the sensor frame [m]."""
    if curvature == 0.0:
        return x, y, z
    up = z + 1.0 / curvature
    return math.atan2(x, up) / curvature, y, math.sqrt(x * x + up * up) - 1.0 / curvature


@kernel
def off_face(x, y, z, curvature):
    """Point of the sensor frame of coordinates of the face [m]."""
    if curvature == 0.0:
        return x, y, z
    far, angle = z + 1.0 / curvature, x * curvature
    return far * math.sin(angle), y, far * math.cos(angle) - 1.0 / curvature


@kernel
def smooth(x):
    """Smoothstep: 0 up to 0, 1 from 1 on."""
    x = min(1.0, max(0.0, x))
    return x * x * (3.0 - 2.0 * x)


def fading(room, box, extent):
    """Corners of the box in which bodies are whole, and over how much they fade out beyond it [m].

    Args:
        room: Corners of the part of the domain where bodies count [m], shape (2, 3).
        box: Corners of the design [m], shape (2, 3).
        extent: Shortest side of the domain [m].

    Returns:
        As :attr:`Space.inner` and :attr:`Space.fade`.
    """
    length = extent * np.reshape((WALL_EDGE, WALL_FADE_LENGTH), (2, 1, 1))
    inwards = np.array([[1.0], [-1.0]])
    inner = room + inwards * (length - length[0])
    close = inwards * (box - inner) < length
    return np.where(close, room, inner), np.where(close, length[0], length)


@kernel
def off_walls(x, y, z, free, space):
    """How far a point is in what bodies fade out in, from 0 where they are whole to 1 [-].

    ``free`` is 1 of conductors that are not at ground, else 0.

    Returns:
        That; and the same at sides where all bodies fade out over one distance.
    """
    square = edge = 0.0
    for i in range(3):
        c = x if i == 0 else (y if i == 1 else z)
        low = (space.inner[free, 0, i] - c) / space.fade[free, 0, i]
        high = (c - space.inner[free, 1, i]) / space.fade[free, 1, i]
        off = max(low, high, 0.0) ** 2
        square += off
        side = 0 if low > high else 1
        edge += off if space.fade[free, side, i] == space.fade[0, side, i] else 0.0
    return math.sqrt(square), math.sqrt(edge)


@kernel
def out_of_reach(points, free, space, middle):
    """How far a leaf is out of reach: 0 in the room, 1 beyond the walls or far behind the face.

    ``free`` is as of :func:`off_walls`; ``middle`` is workspace for a point, shape (3,).

    Returns:
        By all; and by the face, and sides where all bodies fade out over one distance.
    """
    depth = math.inf
    for i in range(3):
        middle[i] = 0.5 * (points[0, i] + points[3, i])
    out, edge = off_walls(middle[0], middle[1], middle[2], free, space)
    _put(middle, on_face(middle[0], middle[1], middle[2], space.curvature))
    for i in range(3):
        c = middle[i]
        if i < 2:
            depth = min(depth, STEEP * (c - space.face[0, i]), STEEP * (space.face[1, i] - c))
        else:
            depth = min(depth, space.face[1, 2] - space.limit - c)
    deep = (depth / space.validity - DEEP[0]) / DEEP[1] if space.has_face else 0.0
    return smooth(max(out, deep)), smooth(max(edge, deep))


@kernel
def barrier(x, held, extent):
    """Energy that keeps charge off a leaf that is out of reach [1/m].

    Args:
        x, held: What :func:`out_of_reach` returns.
        extent: Extent of the leaf [m].
    """
    soft = min(x * x / max(1.0 - x, 1e-9), FADED) / extent if held < x else 0.0
    return WALL_PENALTY * held**3 + soft


@kernel
def barrier_slope(x, held, extent):
    """Derivative of :func:`barrier` by x, and by ``held`` where these are the same."""
    if held < x:
        y = 1.0 - x
        return x * (2.0 - x) / (y * y * extent) if x * x < FADED * y else 0.0
    return 3.0 * WALL_PENALTY * x * x


@kernel
def held_off(distance, length):
    """A distance that becomes ``length`` in contact, and stays from twice that on, C¹ [m]."""
    if distance >= 2.0 * length:
        return distance
    return length + distance * distance / (4.0 * length)


@kernel
def settle(points, space):
    """Move points (k, 3) in the cover up to its face: what is pressed into it is in contact."""
    for q in range(points.shape[0]):
        depth = space.face[1, 2] - points[q, 2]
        if 0.0 < depth <= space.limit:
            inside = True
            for i in range(2):
                x = points[q, i]
                inside = inside and space.face[0, i] < x < space.face[1, i]
            if inside:
                points[q, 2] = space.face[1, 2]


@kernel
def _put(out, point):
    out[0], out[1], out[2] = point


@kernel
def keep_off(points, space):
    """Settle and lift points (k, 3) of the sensor frame, in front of a design with a face."""
    bent = space.curvature != 0.0
    if bent:
        for q in range(points.shape[0]):
            p = points[q]
            _put(p, on_face(p[0], p[1], p[2], space.curvature))
    settle(points, space)
    lift(points, space.validity, space.face)
    if bent:
        for q in range(points.shape[0]):
            p = points[q]
            _put(p, off_face(p[0], p[1], p[2], space.curvature))


@kernel
def lift(points, gap, box):
    """Keep points (k, 3) off a design: a distance d < 2 gap becomes gap + d² / (4 gap).

    Points and ``box`` are in coordinates of the face. The space behind the design counts as within
    it.
    """
    for q in range(points.shape[0]):
        square, depth, axis, side = 0.0, 1.0, 2, 1
        for i in range(3):
            for k in range(2):
                if i == 2 and k == 0:
                    continue
                off = points[q, i] - box[1, i] if k == 1 else box[0, i] - points[q, i]
                square += max(off, 0.0) ** 2
                if -off < depth:
                    depth, axis, side = -off, i, k
        way = math.sqrt(square)
        if way >= 2.0 * gap:
            continue
        if way == 0.0:
            points[q, axis] = box[1, axis] + gap if side == 1 else box[0, axis] - gap
            continue
        ratio = held_off(way, gap) / way
        for i in range(3):
            edge = min(points[q, i], box[1, i])
            if i < 2:
                edge = max(edge, box[0, i])
            points[q, i] = edge + ratio * (points[q, i] - edge)
