"""Outlines of surfaces that change, such as depth images and cloth, near the face of a design.

They are made at each step from the pieces near the face alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled
from capsense.elements.pieces import ChangingBody, PieceArrays
from capsense.scene.geometry_kernels import Boxes, enclosed

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Face(NamedTuple):
    """The face of a flat design."""

    low: Array
    """Its lower corner along x and y [m], shape (2,)."""
    high: Array
    """Its upper corner [m], shape (2,)."""
    top: float
    """Its height [m]."""


def near_triangles(
    body: ChangingBody, rotation: Array, position: Array, face: Face, near: float, reach: float
) -> Boxes | None:
    """Triangles of a surface within ``reach`` [m] of a face; None if all are farther than ``near``.

    Physics engines let bodies overlap. What is below the face counts as on it, by as much as
    ``reach`` below it; what is deeper is behind the design, and stays there.

    Args:
        body: The surface.
        rotation, position: From its frame to that of the face, shapes (3, 3) and (3,).
        face: The face.
        near: Height [m] below which the surface is near.
        reach: What is farther from the face is left out.

    Returns:
        The triangles in the frame of the body.
    """
    if body.pieces is None:
        return None
    centers, moments = body.pieces.centers, body.pieces.moments
    walls = np.array([face.low - reach, face.high + reach])
    chosen = _within(centers, moments, body.order, rotation, position, walls, face.top + reach)
    if not len(chosen):
        return None
    corners = _triangles_of(body.pieces, chosen)
    placed = corners @ rotation.T + position
    heights = placed[..., 2]
    lowest = heights.min(axis=1)
    if lowest.min() >= face.top + near or heights.max() < face.top - reach:
        return None
    below = (lowest < face.top) & (lowest > face.top - reach)
    if below.any():
        below &= (placed[..., :2].min(axis=1) < face.high).all(axis=1)
        below &= (placed[..., :2].max(axis=1) > face.low).all(axis=1)
        placed = placed[below]
        placed[..., 2] = np.maximum(placed[..., 2], face.top)
        corners[below] = (placed - position) @ rotation
    return enclosed(corners)


def _triangles_of(pieces: PieceArrays, chosen: Ints) -> Array:
    """Triangles of some pieces [m], two for each rectangle, shape (k, 3, 3)."""
    if pieces.corners is not None:
        return pieces.corners[chosen]
    center, moment = pieces.centers[chosen, None], 3.0 * pieces.moments[chosen]
    own = np.diagonal(moment, axis1=1, axis2=2)
    along = np.where(own[:, :1] > 0.0, 0, 1)  # sides stand along y and z, or x and z
    across = np.where((own[:, :1] > 0.0) & (own[:, 1:2] > 0.0), 1, 2)
    one, two = (
        np.take_along_axis(moment, k[..., None], axis=2)[..., 0]
        / np.sqrt(np.take_along_axis(own, k, axis=1))
        for k in (along, across)
    )  # of a piece that stands upright, and of an image's pixel, which is a parallelogram
    one, two = one[:, None], two[:, None]
    a, b, c, d = center - one - two, center + one - two, center + one + two, center - one + two
    return np.concatenate([a, b, c, a, c, d], axis=1).reshape(-1, 3, 3)


@compiled
def _within(centers, moments, order, rotation, position, walls, highest):
    """Pieces that reach between two walls, (2, 2), and below a height [m], in the given order."""
    out, found = np.empty(order.shape[0], np.int64), 0
    r = rotation
    for i in order:
        m, x, y, z = moments[i], centers[i, 0], centers[i, 1], centers[i, 2]
        arm = np.sqrt(12.0 * (m[0, 0] + m[1, 1] + m[2, 2]))  # no corner is farther away
        if r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + position[2] - arm > highest:
            continue
        apart = False
        for k in range(2):
            at = r[k, 0] * x + r[k, 1] * y + r[k, 2] * z + position[k]
            apart = apart or at + arm < walls[0, k] or at - arm > walls[1, k]
        if not apart:
            out[found] = i
            found += 1
    return out[:found]
