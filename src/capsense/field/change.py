"""What a solver tells of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Change:
    """What a scene changes in the Maxwell matrix of all terminals."""

    matrix: Array
    """Change of the matrix [F], shape (terminals, terminals)."""
    error: float
    """Estimated error of its largest entry [F]."""
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
