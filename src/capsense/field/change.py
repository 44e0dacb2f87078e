"""What a solver tells of a scene, and from all terminals of a design to its electrodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design, Role

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Change:
    """What a scene changes in the Maxwell matrix of all terminals."""

    matrix: Array
    """Change of the matrix [F], shape (terminals, terminals)."""
    error: float
    """Estimated error of its largest entry [F]; infinite where an electrode lies inside a body."""
    iterations: int = 0
    """Iterations of the linear solver; 0 for a direct one."""
    unknowns: int = 0
    """Unknowns that were solved for, for each terminal."""
    loss: Array | None = None
    """Part of the change in quadrature [F], the same shape, where matter has losses: the complex
    capacitance is ``matrix - 1j * loss``."""
    jacobian: Array | None = None
    """How the matrix changes with the poses of the scene's bodies, where it was asked for, shape
    (bodies, terminals, terminals, 6)."""


@dataclass(frozen=True, eq=False)
class Charges:
    """Charges that the terminals draw onto the bodies."""

    points: Array
    """Where they sit [m], shape (n, 3)."""
    density: Array
    """Size of the surface density for each terminal at 1 V [C/m²], shape (n, terminals)."""
    pitch: float
    """Usual distance of neighbours [m]."""


class Terminals:
    """The terminals of a design: t in all, of which k are driven: n electrodes, then shields.

    Matrices are given for all terminals, floating conductors of the design last.

    Args:
        design: The design.
        rest: Maxwell matrix of all terminals in the empty domain [F], shape (t, t).
    """

    def __init__(self, design: Design, rest: Array) -> None:
        self.electrodes = len(design.electrodes)
        self.driven = len(rest) - sum(c.role == Role.FLOATING for c in design.conductors)
        """How many electrodes there are, n, and how many terminals are driven, k."""
        self.rest = rest
        self.empty: Array = self._without_floating(rest)
        """Maxwell matrix of the driven terminals in the empty domain [F], shape (k, k)."""
        self.bound: Array = np.maximum(-rest, 0.0)  # coarse meshes may have them the other way
        """Most that each entry changes by [F], shape (t, t): terminals that are screened from each
        other do not couple."""
        np.fill_diagonal(self.bound, np.inf)

    def screened(self, change: Array) -> Array:
        """Bound a change, shape (..., t, t)."""
        return np.minimum(change, self.bound)

    def change(self, change: NDArray[Any]) -> NDArray[Any]:
        """Change of the driven terminals' matrix by that of all, (..., t, t) -> (..., k, k)."""
        if self.driven == len(self.rest):
            return change
        return self._without_floating(self.rest + change) - self.empty

    def slope(self, change: NDArray[Any], slope: Array) -> Array:
        """Derivative of the electrodes' matrix by that of all terminals.

        Args:
            change: As :meth:`change` takes it, shape (..., t, t).
            slope: Shape (..., b, t, t, 6).

        Returns:
            Shape (..., b, n, n, 6).
        """
        n = self.electrodes
        if self.driven == len(self.rest):
            return slope[..., :n, :n, :]
        own, cross = self._floating(self.rest + change)
        follow = np.zeros((*change.shape[:-2], len(self.rest), n), change.dtype)
        follow[..., :n, :] = np.eye(n)
        follow[..., self.driven :, :] = -np.linalg.solve(own, cross[..., :n])
        return np.einsum("...ai,...bacm,...cj->...bijm", follow, slope, follow)

    def _floating(self, matrix: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Blocks of floating conductors: with themselves, and with the driven terminals."""
        k = self.driven
        return matrix[..., k:, k:], matrix[..., k:, :k]

    def _without_floating(self, matrix: NDArray[Any]) -> NDArray[Any]:
        k = self.driven
        if k == len(self.rest):
            return matrix
        own, cross = self._floating(matrix)
        return matrix[..., :k, :k] - cross.swapaxes(-1, -2) @ np.linalg.solve(own, cross)
