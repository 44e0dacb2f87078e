"""Pairs of conductors against Love's exact discs and a star capacitor of a laboratory."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))

import two_plates


@pytest.mark.parametrize("ratio", [0.02, 0.2, 0.5, 2.0])
def test_discs_have_love_s_capacitances(ratio: float) -> None:
    """Analytic: C11, C12 and the capacitance between two discs within 0.15 %."""
    ((_, *exact),) = [row for row in two_plates.love_table() if row[0] == ratio]
    np.testing.assert_allclose(two_plates.discs(ratio), exact, rtol=1.5e-3)


def test_the_capacitance_between_two_is_known() -> None:
    """Analytic: of a capacitor with strays, C and the strays in series."""
    between, first, second = 3.0, 2.0, 6.0
    matrix = np.array([[between + first, -between], [-between, between + second]])
    found = two_plates.two_terminals(matrix)
    np.testing.assert_allclose(found, between + first * second / (first + second))


def test_stars_read_what_a_laboratory_read() -> None:
    """Hardware: three gaps of two series, with one stray each, within 1.2 % rms and 2 % at most."""
    gaps, read = two_plates.star_table()
    assert gaps.shape == (18,)
    chosen = [4, 10, 17]
    found = np.array([two_plates.stars(gap) for gap in gaps[chosen]])
    for series in read[chosen].T:
        stray, left = two_plates.stray(found, series)
        assert 0.2e-12 < stray < 1.5e-12
        assert np.sqrt(np.mean(left**2)) < 0.012
        assert np.abs(left).max() < 0.02


def test_the_stray_is_that_of_least_relative_squares() -> None:
    """Differential: against a search."""
    rng = np.random.default_rng(5)
    read = rng.uniform(1.0, 20.0, 9)
    found = read - 0.7 + rng.normal(0.0, 0.1, 9)
    tried = np.linspace(0.0, 1.5, 15001)
    squares = (((found + tried[:, None]) / read - 1.0) ** 2).sum(axis=1)
    np.testing.assert_allclose(two_plates.stray(found, read)[0], tried[squares.argmin()], atol=1e-4)
