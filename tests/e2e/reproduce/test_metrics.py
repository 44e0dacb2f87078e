"""Measures of likeness against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx

from capsense.readout.calibration import cross_correlation
from capsense.reproduce.harness import (
    correlation_of_change,
    raw_correlation,
    rmse,
)

A, B = [1.0, 2.0, 3.0], [2.0, 2.0, 5.0]


def test_by_hand() -> None:
    """Σab = 21, Σa² = 14, Σb² = 33; about the means 3, 2 and 6; differences 1, 0, 2."""
    assert raw_correlation(A, B) == approx(21 / np.sqrt(14 * 33), rel=1e-14)
    assert cross_correlation(A, B) == approx(3 / np.sqrt(2 * 6), rel=1e-14)
    assert rmse(A, B) == approx(np.sqrt(5 / 3), rel=1e-14)
    # from the levels 3 and 5: changes −2, −1, 0 and −3, −3, 0
    assert correlation_of_change(A, B) == approx(9 / np.sqrt(5 * 18), rel=1e-14)


def test_what_each_one_ignores() -> None:
    """A factor changes no correlation; a level changes the raw one only."""
    curve = 1 - 0.2 * np.exp(-(np.linspace(-3, 3, 50) ** 2))
    flat = np.linspace(1.0, 0.99, 50)
    assert raw_correlation(curve, flat) > 0.99
    assert abs(cross_correlation(curve, flat)) < 0.05
    for measure in (raw_correlation, cross_correlation, correlation_of_change):
        assert measure(curve, 3 * curve) == approx(1.0, abs=1e-14)
    for measure in (cross_correlation, correlation_of_change):
        assert measure(curve, curve - 0.5) == approx(1.0, abs=1e-14)
    assert raw_correlation(curve, curve - 0.7) < 0.999


@pytest.mark.parametrize("measure", [raw_correlation, correlation_of_change, rmse])
def test_shapes(measure: object) -> None:
    """Curves of different lengths have nothing to compare."""
    with pytest.raises(ValueError, match="shapes"):
        measure([1.0, 2.0], [1.0])  # type: ignore[operator]
    with pytest.raises(ValueError, match="zero throughout"):
        raw_correlation([0.0, 0.0], [1.0, 2.0])
