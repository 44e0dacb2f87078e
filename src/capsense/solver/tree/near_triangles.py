"""Outlines of surfaces that change, such as depth images and cloth, near the face of a design.

They are made at each step from the pieces near the face alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled
from capsense.design.film import Film
from capsense.scene.geometry_kernels import Boxes, enclosed
from capsense.solver.tree.dynamic_surface import STEP_SLOPE, DynamicBody, MeshBody, PieceArrays

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


class Face(NamedTuple):
    """The face of a design."""

    corners: Array
    """Corners of the design in coordinates of its face [m], shape (2, 3) …"""
    box: Array
    """… and in the sensor frame [m], shape (2, 3)."""
    film: Film | None
    """The film that it is the face of, if that is bent."""
    top: float
    """Its height [m]."""
    floor: float
    """Height down to which a cover that gives way can be compressed [m]; else that of the face."""


def near_triangles(
    body: DynamicBody, record: np.void, face: Face, near: float, reach: float
) -> Boxes | None:
    """Triangles of a surface within ``reach`` [m] of a face; None if all are farther than ``near``.

    Physics engines let bodies overlap. What is less than ``reach`` below the face counts as on it,
    or in its cover as far as that can be compressed; what is deeper is behind the design.

    Args:
        body: The surface.
        record: Where it stands in the frame of the face, and how many times as large it is.
        face: The face.
        near: Height [m] below which the surface is near.
        reach: What is farther from the face is left out.

    Returns:
        The triangles in the frame of the body.
    """
    scale = float(record["scale"])
    turn, position = scale * record["rotation"], record["position"]
    walls = face.box[:, :2] + [[-reach], [reach]]
    if isinstance(body, MeshBody):
        low = math.inf if face.film is not None else face.top + near
        found = body.corners_within(turn, position, walls, low, face.top + reach)
        corners = np.empty((0, 3, 3)) if found is None else found
    elif body.pieces is None:
        return None
    else:
        chosen = _within(body.pieces.centers, body.pieces.moments, body.order, turn, scale,
                         position, walls, face.top + reach)  # fmt: skip
        corners = _triangles_of(body.pieces, body.order, chosen)
    if not len(corners):
        return None
    placed = corners @ turn.T + position
    if face.film is not None:
        placed = face.film.coordinates(placed)
    heights = placed[..., 2]
    lowest = heights.min(axis=1)
    if lowest.min() >= face.top + near or heights.max() < face.top - reach:
        return None
    below = (lowest < face.floor) & (lowest > face.top - reach)
    if below.any():
        below &= (placed[..., :2].min(axis=1) < face.corners[1, :2]).all(axis=1)
        below &= (placed[..., :2].max(axis=1) > face.corners[0, :2]).all(axis=1)
        placed = placed[below]
        placed[..., 2] = np.maximum(placed[..., 2], face.floor)
        if face.film is not None:
            placed = face.film.placed(placed)
        corners[below] = (placed - position) @ turn / scale**2
    return enclosed(corners)


def _triangles_of(pieces: PieceArrays, order: Ints, chosen: Ints) -> Array:
    """Triangles of some pieces [m], shape (k, 3, 3)."""
    if pieces.corners is not None:
        return pieces.corners[chosen]
    there = np.zeros(len(pieces.areas), np.bool_)
    there[order] = True
    return _fans(pieces.centers, pieces.moments, there, pieces.grid, chosen)


@compiled
def _fans(
    centers: Array, moments: Array, there: NDArray[np.bool_], grid: tuple[int, int, int],
    chosen: Ints,
) -> Array:  # fmt: skip
    """Four triangles for each of some pieces of images, see :func:`_triangles_of`.

    A corner of a pixel is at one part the mean depth of the four pixels that meet there, at three
    parts the mean of what their planes say. The mean depth of a pixel's triangles is then that of
    a curved surface, to the second order. At the rim of a surface it is what the planes say.
    """
    out, corner = np.empty((chosen.shape[0], 4, 3, 3)), np.empty((4, 3))
    views, rows, columns = grid
    size = rows * columns
    for c in range(chosen.shape[0]):
        i = chosen[c]
        z, m = centers[i, 2], moments[i]
        pixel = i < views * size
        first, second = (0, 1) if pixel else ((1, 2) if m[0, 0] == 0.0 else (0, 2))
        one, two = np.sqrt(3.0 * m[first, first]), np.sqrt(3.0 * m[second, second])
        row, column = i % size // columns, i % columns
        for q in range(4):
            a, b = (1 if q in (1, 2) else -1), (1 if q > 1 else -1)
            for k in range(3):
                arms = a * m[k, first] / one + b * m[k, second] / two
                corner[q, k] = centers[i, k] + 3.0 * arms
            if not pixel:
                continue
            count, mean, planes = 0, 0.0, 0.0
            for p in range(4):
                u, v = a * (p % 2), b * (p // 2)
                j = i + u + v * columns
                if not (0 <= column + u < columns and 0 <= row + v < rows and there[j]):
                    continue
                if abs(centers[j, 2] - z) > 2.0 * STEP_SLOPE * (abs(u) * one + abs(v) * two):
                    continue
                n = moments[j]
                planes += centers[j, 2] + (a - 2 * u) * one * n[0, 2] / n[0, 0]
                planes += (b - 2 * v) * two * n[1, 2] / n[1, 1]
                mean += centers[j, 2]
                count += 1
            corner[q, 2] = planes / count
            if count == 4:
                corner[q, 2] = 0.0625 * (mean + 3.0 * planes)
        for q in range(4):
            for k in range(3):
                out[c, q, 0, k] = centers[i, k]
                out[c, q, 1, k], out[c, q, 2, k] = corner[q, k], corner[(q + 1) % 4, k]
    return out.reshape(-1, 3, 3)


@compiled
def _within(
    centers: Array, moments: Array, order: Ints, turn: Array, scale: float, position: Array,
    walls: Array, highest: float,
) -> Ints:  # fmt: skip
    """Pieces that reach between two walls, (2, 2), and below a height [m], in the given order."""
    out, found = np.empty(order.shape[0], np.int64), 0
    r = turn
    for i in order:
        m, x, y, z = moments[i], centers[i, 0], centers[i, 1], centers[i, 2]
        arm = scale * np.sqrt(12.0 * (m[0, 0] + m[1, 1] + m[2, 2]))  # no corner is farther away
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
