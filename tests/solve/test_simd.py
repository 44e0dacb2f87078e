"""Vector instructions inside compiled code, against numpy."""

from __future__ import annotations

import numpy as np
from numba import njit

from capsense.solve.simd import LANES, load, madd, splat, store, vmadd


@njit
def _combine(x, y, scalar, out):
    for a in range(x.shape[0]):
        left, right = load(x, a), load(y, a)
        store(out, a, vmadd(left, right, madd(scalar, left, splat(np.float32(2.0)))))


def test_every_lane_and_row_is_treated_alike():
    """Differential: s x + 2 + x y, row by row and lane by lane."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 37, LANES)).astype(np.float32)
    out = np.full_like(x, np.nan)
    _combine(x, y, np.float32(-1.5), out)
    np.testing.assert_allclose(out, x * y - 1.5 * x + 2.0, rtol=0, atol=2e-6)
