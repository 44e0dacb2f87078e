"""Potentials around the bodies, from their charges: for drawing, not for readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.field.green import GreenFunction
from capsense.surface.solve_kernels import Solution

Array = NDArray[np.float64]

_PART = 2000
"""Points at a time."""


class PotentialMap:
    """Evaluates what bodies change at fixed points.

    Args:
        green: Green's function of the design.
        points: Where potentials are wanted [m], shape (n, 3).
    """

    def __init__(self, green: GreenFunction, points: Array) -> None:
        self._green, self._points = green, points
        self._psi: NDArray[np.float32] | None = None

    def change(self, solution: Solution) -> Array:
        """Change of the terminals' potentials [V], shape (n, terminals).

        A terminal is at 1 V in its own column; bodies that float take the potential they get.
        """
        if self._psi is None:
            parts = range(0, len(self._points), _PART)
            self._psi = np.concatenate(
                [self._green.psi(self._points[k : k + _PART]).astype(np.float32) for k in parts]
            )
        charge = solution.charge[:, : self._green.near_phi.shape[1]]
        leaves = solution.points.reshape(-1, 3)
        spread = np.repeat(0.25 * charge, 4, axis=0)
        modes = self._green.psi(leaves).T @ spread
        image = leaves * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * self._green.floor]
        least = np.repeat(0.3 * solution.extent, 4)  # no point of the surface is nearer than that
        out = self._psi.astype(float) @ modes
        for k in range(0, len(self._points), _PART):
            some = self._points[k : k + _PART]
            inverse = 1.0 / np.maximum(_distances(some, leaves), least)
            inverse -= 1.0 / np.maximum(_distances(some, image), least)
            out[k : k + _PART] -= inverse @ spread
        return out


def _distances(p: Array, q: Array) -> Array:
    square = (p**2).sum(1)[:, None] + (q**2).sum(1) - 2 * p @ q.T
    return np.sqrt(np.maximum(square, 0.0))
