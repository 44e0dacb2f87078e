"""Potentials around the bodies, from their charges: for drawing, not for readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.field.green import GreenFunction
from capsense.surface.step import Solution

Array = NDArray[np.float64]

_PART = 2000
"""Points at a time."""


def potential_change(green: GreenFunction, solution: Solution, points: Array) -> Array:
    """What bodies change in the terminals' potentials at points [V], (n, 3) -> (n, terminals).

    A terminal is at 1 V in its own column; bodies that float take the potential they get.
    """
    charge = solution.charge[:, : green.near_phi.shape[1]]
    leaves = solution.points.reshape(-1, 3)
    spread = np.repeat(0.25 * charge, 4, axis=0)
    modes = green.psi(leaves).T @ spread
    image = leaves * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * green.floor]
    least = np.repeat(0.3 * solution.extent, 4)  # no point of the surface is nearer than that
    out = np.empty((len(points), charge.shape[1]))
    for k in range(0, len(points), _PART):
        some = points[k : k + _PART]
        inverse = 1.0 / np.maximum(_distances(some, leaves), least)
        inverse -= 1.0 / np.maximum(_distances(some, image), least)
        out[k : k + _PART] = green.psi(some) @ modes - inverse @ spread
    return out


def _distances(p: Array, q: Array) -> Array:
    square = (p**2).sum(1)[:, None] + (q**2).sum(1) - 2 * p @ q.T
    return np.sqrt(np.maximum(square, 0.0))
