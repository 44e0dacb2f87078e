"""What ties bodies to ground by what they are made of: closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.constants import UNIT
from capsense.solver.tree.matter import Matter

INF = math.inf


def matter(eps: complex, ground: float) -> Matter:
    return Matter(np.array([eps], complex), np.array([ground]), np.zeros(1, np.int64))


def tie(eps: complex, ground: float, size: float = 0.02) -> complex:
    return complex(matter(eps, ground).ties(np.array([size]))[0])


def test_conductors_have_the_energy_of_their_capacitance_to_ground() -> None:
    """Analytic: 4π eps0 / C; none at ground, no net charge where there is no capacitance.

    A ball of one metre has 111.265 pF.
    """
    assert tie(INF, 111.265e-12) == approx(1.0, rel=1e-6)
    assert tie(INF, 3e-12) == approx(UNIT / 3e-12, rel=1e-12)
    assert tie(INF, INF) == 0.0
    assert tie(INF, 0.0) == INF


@pytest.mark.parametrize(
    ("eps", "share"),
    [(300.001, 0.0), (300 * 10**0.25, 0.15625), (300 * 10**0.5, 0.5), (300 * 10**0.75, 0.84375),
     (3000.0, 1.0), (1e5, 1.0)],
)  # fmt: skip
def test_displacement_current_comes_in_between_300_and_3000(eps: float, share: float) -> None:
    """Analytic: with 3x² − 2x³ of the logarithm, through a contact of a sixth of the size."""
    for ground, own in ((INF, 0.0), (2e-12, UNIT / 2e-12)):
        found = tie(eps, ground)
        if share == 0:
            assert abs(found) > 1e5
        else:
            assert found == approx(own + 5.0 / (share * eps * 0.02), rel=1e-9)
    assert tie(300.0, INF) == tie(5.0, INF) == tie(eps, 0.0) == INF


@pytest.mark.parametrize("eps", [5.0 - 200.0j, 80.0 - 1e-3j, 2000.0 - 300.0j])
def test_current_of_losses_always_counts(eps: complex) -> None:
    """Analytic: all of it, beside the part of the displacement current that counts."""
    x = min(max(math.log10(eps.real / 300.0), 0.0), 1.0)
    current = eps.real * x * x * (3 - 2 * x) + 1j * eps.imag
    found = tie(eps, 4e-12, 0.05)
    assert found == approx(UNIT / 4e-12 + 5.0 / (current * 0.05), rel=1e-12)
    assert matter(eps, INF).lossy


def test_softness_and_kinds() -> None:
    """Analytic: 1 / (eps − 1), zero for conductors, bounded where matter is like air."""
    eps = np.array([3.0, 1.0, 80.0 - 2.0j, INF, INF])
    them = Matter(eps, np.array([INF, 0.0, INF, 0.0, INF]), np.arange(5))
    np.testing.assert_allclose(them.inverse_susceptibility, [0.5, 1e9, 1 / (79 - 2j), 0.0, 0.0])
    assert them.conducting.tolist() == [False, False, False, True, True]
    assert them.free.tolist() == [False, False, False, True, False]
    assert them.lossy
    assert not Matter(eps[[0, 1, 3]], np.zeros(3), np.arange(3)).lossy


def test_parts_of_bodies_keep_what_they_are() -> None:
    """Analytic: a group is named by the first part of its first body."""
    them = Matter(np.array([INF, 4.0, INF, INF], complex), np.array([1.0, 2.0, 1.0, 7.0]) * 1e-12,
                  np.array([0, 1, 0, 3]))  # fmt: skip
    found = them.repeated([0, 0, 1, 2, 3, 3])
    np.testing.assert_array_equal(found.eps, them.eps[[0, 0, 1, 2, 3, 3]])
    np.testing.assert_array_equal(found.ground, np.array([1, 1, 2, 1, 7, 7]) * 1e-12)
    assert found.group.tolist() == [0, 0, 2, 0, 4, 4]
    assert them.repeated([1, 2, 3]).group.tolist() == [0, 1, 2]
    assert them.repeated([0, 1, 2, 3]) is them
