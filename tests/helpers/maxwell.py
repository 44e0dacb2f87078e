"""Random Maxwell capacitance matrices that physics allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def random_maxwell(rng: np.random.Generator, count: int) -> Array:
    """Symmetric, off-diagonals negative, row sums positive; some picofarads."""
    mutual = np.triu(rng.uniform(0.05, 1.0, (count, count)), 1) * 1e-12
    mutual = mutual + mutual.T
    ground = rng.uniform(0.2, 3.0, count) * 1e-12
    return np.diag(mutual.sum(axis=1) + ground) - mutual
