"""The solver of scenes with losses."""

from __future__ import annotations

import numpy as np

from capsense._dense import eliminate


def test_elimination_without_pivots():
    """Differential: against LAPACK, for energies that are positive and losses of one sign."""
    rng = np.random.default_rng(9)
    for n, m in ((1, 1), (7, 3), (120, 6)):
        real, loss = (x @ x.T + 0.1 * np.eye(n) for x in rng.normal(size=(2, n, n)))
        matrix = real - 1j * 3.0 * loss
        sides = rng.normal(size=(n, m)) + 1j * rng.normal(size=(n, m))
        found = sides.copy()
        eliminate(matrix.copy(), found)
        np.testing.assert_allclose(matrix @ found, sides, rtol=0, atol=1e-8)
