"""The blocks of :mod:`capsense.solver.bodies.blocks` again: slow, readable, by quadrature on fine
grids.

Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def polygon_points(corners: Array, cells: int = 4, order: int = 6) -> tuple[Array, Array]:
    """Points and weights on a polygon, denser towards its edges.

    Args:
        corners: Corners [m], shape (4, 3); a triangle repeats its last corner.
        cells: Cells along either side, shrinking towards both ends.
        order: Gauss points along a cell.

    Returns:
        Points [m], shape (q, 3), and weights that sum to one, shape (q,).
    """
    gauss, weight = np.polynomial.legendre.leggauss(order)
    ends = np.sort(
        np.concatenate([0.5 ** np.arange(1, cells), 1 - 0.5 ** np.arange(2, cells), [0, 1]])
    )
    width = np.diff(ends)
    line = (ends[:-1, None] + 0.5 * width[:, None] * (1 + gauss)).ravel()
    along = (0.5 * width[:, None] * weight).ravel()
    s, t = (x.ravel() for x in np.meshgrid(line, line))
    a, b, c, d = corners
    s3, t3 = s[:, None], t[:, None]
    points = (1 - s3) * (1 - t3) * a + s3 * (1 - t3) * b + s3 * t3 * c + (1 - s3) * t3 * d
    jacobian = np.cross((1 - t3) * (b - a) + t3 * (c - d), (1 - s3) * (d - a) + s3 * (c - b))
    weights = np.outer(along, along).ravel() * np.linalg.norm(jacobian, axis=1)
    return points, weights / weights.sum()


def polygon_integrals(corners: Array, points: Array) -> tuple[Array, Array]:
    """∫ dS' / r [m] and its negative gradient, by the sum over edges of Wilton et al. (1984).

    Args:
        corners: Corners [m], counter-clockwise about the normal, shape (4, 3).
        points: Where to evaluate [m], shape (q, 3).

    Returns:
        Potentials, shape (q,), and fields, shape (q, 3); in the panel's plane the field's
        part along the normal is zero, its principal value.
    """
    distinct = [c for k, c in enumerate(corners) if np.any(c != corners[k - 1])]
    normal = np.cross(distinct[1] - distinct[0], distinct[2] - distinct[0])
    normal /= np.linalg.norm(normal)
    height = (points - distinct[0]) @ normal
    depth = np.abs(height)
    potential, field, angle = np.zeros(len(points)), np.zeros((len(points), 3)), 0.0
    for start, end in zip(distinct, [*distinct[1:], distinct[0]], strict=True):
        length = math.dist(start, end)
        along = (end - start) / length
        outward = np.cross(along, normal)
        distance = (start - points) @ outward
        first = (start - points) @ along
        last = first + length
        across = distance**2 + height**2
        near, far = np.sqrt(across + first**2), np.sqrt(across + last**2)
        log = np.arcsinh(last / np.sqrt(across)) - np.arcsinh(first / np.sqrt(across))
        potential += distance * log
        field += outward * log[:, None]
        angle = angle + (
            np.arctan(distance * last / (across + depth * far))
            - np.arctan(distance * first / (across + depth * near))
        )
    potential -= depth * angle
    field += normal * (np.sign(height) * angle)[:, None]
    return potential, field


def free_entry(first: Array, second: Array, cells: int = 4, order: int = 6) -> float:
    """Mean over one polygon of the potential of unit charge spread evenly on another [1/m].

    Args:
        first: Corners [m], shape (4, 3).
        second: Corners [m], shape (4, 3); may be the same polygon.
        cells: See :func:`polygon_points`.
        order: See :func:`polygon_points`.
    """
    points, weights = polygon_points(first, cells, order)
    return float(weights @ polygon_integrals(second, points)[0] / _area(second))


def flux_entry(first: Array, second: Array, cells: int = 4, order: int = 6) -> float:
    """Flux through one polygon from unit charge spread evenly on another, principal value."""
    points, weights = polygon_points(first, cells, order)
    a, b, c, d = first
    normal = np.cross(c - a, d - b)
    normal /= np.linalg.norm(normal)
    field = polygon_integrals(second, points)[1] @ normal
    return float(_area(first) * (weights @ field) / _area(second))


def free_block(corners: Array, cells: int = 4, order: int = 6) -> Array:
    """The free-space block F [1/m] of polygons with corners [m] of shape (n, 4, 3).

    F_kl is the mean over k and l of 1 / r, made symmetric; shape (n, n).
    """
    out = np.array(
        [[free_entry(first, second, cells, order) for second in corners] for first in corners]
    )
    return 0.5 * (out + out.T)


def _area(corners: Array) -> float:
    a, b, c, d = corners
    return 0.5 * float(np.linalg.norm(np.cross(c - a, d - b)))
