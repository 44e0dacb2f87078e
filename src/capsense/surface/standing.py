"""Meshes brought to a frame of their own, so that panels do not depend on the frame given."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GRID = 1e-5
"""Vertices are rounded to about this part of the longest extent, so that single precision makes no
difference."""


class Standing(NamedTuple):
    """A mesh in its own frame; ``x @ axes.T + middle`` leads back to the frame given."""

    corners: Array
    """Corners of the triangles [m], in an order of their own, shape (m, 3, 3)."""
    axes: Array
    """Unit vectors of the own frame as columns, right-handed, shape (3, 3)."""
    middle: Array
    """Its origin, the centroid of the surface [m], shape (3,)."""


def standing(vertices: Array, faces: NDArray[np.int64]) -> Standing:
    """Bring a mesh to the principal axes of its surface, its triangles sorted.

    The frame and the order in which a mesh is given do not matter then, unless it is symmetric:
    axes that its form does not tell apart follow the numbers given.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).
    """
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    area /= area.sum()
    points = np.concatenate([corners.mean(axis=1), *corners.transpose(1, 0, 2)])
    weight = np.concatenate([0.75 * area, *[area / 12] * 3])  # exact to second moments
    middle = weight @ points
    arms = points - middle
    axes = np.linalg.eigh(np.einsum("k,ki,kj->ij", weight, arms, arms))[1]

    skew = weight @ (arms @ axes) ** 3
    axes = axes * np.where(skew < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:  # one axis may have ends that look alike
        axes[:, np.argmin(np.abs(skew))] *= -1

    own = (vertices - middle) @ axes
    grid = 2.0 ** math.floor(math.log2(_GRID * float(np.ptp(own, axis=0).max())))
    own = np.round(own / grid)
    order = np.lexsort(own.T)
    place = np.argsort(order)[faces]
    turn = (place.argmin(axis=1)[:, None] + np.arange(3)) % 3
    place = np.take_along_axis(place, turn, axis=1)
    return Standing(grid * own[order][place[np.lexsort(place.T[::-1])]], axes, middle)
