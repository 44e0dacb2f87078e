"""Dielectrics in the first millimetres: limits, bounds, and the small algebra behind them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import capsense as cs
from capsense.solver.gap.series_kernels import eigen, in_series, in_series_lossy

BOX = cs.Box((0.06, 0.05, 0.02))


def definite(m: int, seed: int, rank: int | None = None) -> np.ndarray:
    half = np.random.default_rng(seed).normal(size=(m, rank or m))
    return half @ half.T


@pytest.mark.parametrize("m", [1, 2, 7, 24])
def test_eigenvalues(m):
    """Differential: numpy's."""
    matrix = definite(m, m)
    value, vector = eigen(matrix)
    np.testing.assert_allclose(np.sort(value), np.linalg.eigvalsh(matrix), rtol=1e-10)
    np.testing.assert_allclose(vector.T @ vector, np.eye(m), atol=1e-12)
    np.testing.assert_allclose(vector * value @ vector.T, matrix, atol=1e-10 * value.max())


def test_in_series():
    """Analytic: the inverse of what is to be found, and the same with complex D."""
    lifted, inside, added = definite(5, 1), definite(5, 2), definite(5, 3)
    dielectric = np.linalg.inv(np.linalg.inv(lifted) + inside)
    wanted = np.linalg.inv(np.linalg.inv(lifted + added) + inside)
    found = in_series(dielectric, lifted, lifted + added)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * wanted.max())
    lossy = in_series_lossy(dielectric.astype(complex), lifted, lifted + added)
    np.testing.assert_allclose(lossy, found, rtol=1e-4, atol=1e-4 * wanted.max())


def test_in_series_of_little():
    """Limits: nothing is added to what is not lifted, nor where nothing is charged."""
    flat, dielectric = definite(5, 1, rank=2), 0.5 * definite(5, 1, rank=2)
    np.testing.assert_allclose(in_series(dielectric, flat, flat), dielectric, atol=1e-12)
    np.testing.assert_array_equal(in_series(dielectric, 0 * flat, flat), dielectric)
    more = in_series(2.0 * flat, flat, 3.0 * flat)  # more than a conductor: taken for one
    np.testing.assert_allclose(more, 4.0 * flat, atol=1e-4)


@pytest.fixture(scope="module")
def read(simulators):
    sim = simulators("six_patch")

    def delta(gap: float, material: cs.Material | str, *others: cs.Body) -> np.ndarray:
        pose = cs.Pose((0.01, 0.005, 0.01 + gap))
        body = cs.Body(BOX, pose, material, grounding="floating")
        return np.asarray(sim.step(cs.Scene([body, *others])).delta)

    return delta


def of(eps: float, sigma: float = 0.0) -> cs.Material:
    return cs.Material("m", eps_r=eps, sigma=sigma)


@pytest.mark.parametrize("gap", [0.0, 0.3e-3, 2e-3])
def test_permittivities_near_the_design(read, gap):
    """Limits and bounds: rises with the permittivity, up to the floating conductor."""
    readings = [read(gap, of(eps)) for eps in (2.0, 4.0, 20.0, 80.0, 500.0, 1e7)]
    steel = read(gap, "steel")
    for less, more in pairwise(readings):
        most = np.abs(more).max()  # the law itself errs, by less than what follows
        assert np.linalg.eigvalsh(more - less).min() > -0.01 * most  # a pole made -0.2
        assert (np.diag(more) >= np.diag(less) - 3e-3 * most).all()
    assert (np.diag(readings[-2]) < np.diag(steel) + 3e-3 * steel.max()).all()  # as the law errs
    np.testing.assert_allclose(readings[-1], steel, atol=0.01 * steel.max())


def test_dielectrics_that_come_near(read):
    """Invariant: self capacitances rise down to contact, and then stay."""
    gaps = [8e-3, 5e-3, 4.1e-3, 3.9e-3, 3e-3, 2e-3, 1e-3, 0.5e-3, 0.1e-3, 0.0, -0.2e-3, -1e-3]
    own = np.array([np.diag(read(gap, of(20.0))) for gap in gaps])
    assert (np.diff(own, axis=0) > -1e-3 * own.max()).all()
    assert np.abs(own[-3:] - own[-1]).max() < 5e-3 * own.max()
    assert own[-1].max() > 1.5 * own[5].max()


def test_losses_near_the_design(read):
    """Limits: hardly conducting as a dielectric, well conducting as a conductor."""
    plain, lossy = read(0.3e-3, of(4.0)), read(0.3e-3, of(4.0, 1e-9))
    np.testing.assert_allclose(lossy, plain, atol=1e-3 * plain.max())
    steel = read(0.3e-3, "steel")
    np.testing.assert_allclose(read(0.3e-3, of(4.0, 0.5)), steel, atol=0.02 * steel.max())


@pytest.mark.parametrize("gap", [0.3e-3, 2e-3])
def test_a_dielectric_of_two_parts(simulators, gap):
    """Invariant: a box reads nearly as its two halves, which are dielectrics of their own."""
    sim, half = simulators("six_patch"), cs.Box((0.04, 0.04, 0.02))
    halves = [cs.Body(half, cs.Pose((x, 0.0, 0.01 + gap)), of(4.0)) for x in (-0.02, 0.02)]
    whole = cs.Body(cs.Box((0.08, 0.04, 0.02)), cs.Pose((0.0, 0.0, 0.01 + gap)), of(4.0))
    one = sim.step(cs.Scene([whole])).delta
    two = sim.step(cs.Scene(halves)).delta
    np.testing.assert_allclose(two, one, atol=0.1 * one.max())


def test_other_bodies(read):
    """Invariant: what a body far away changes hardly depends on the dielectric's lift."""
    ball = cs.Body(cs.Sphere(0.03), cs.Pose((0.0, 0.0, 0.12)))
    alone, both = read(0.3e-3, of(4.0)), read(0.3e-3, of(4.0), ball)
    lossy = read(0.3e-3, of(4.0, 1e-9), ball)
    np.testing.assert_allclose(lossy, both, atol=2e-3 * both.max())
    assert np.abs(both - alone).max() < 0.1 * alone.max()


def test_a_glass_box_that_comes_near(simulators):
    """Regression: one electrode is far away and one near.

    Where the law's error exceeds what the far one gains, inverses had poles: 5 fF for 150 at 1 mm.
    """
    sim, box = simulators("six_patch"), cs.Box((0.03, 0.02, 0.01))
    found = []
    for gap in np.linspace(4.5e-3, 0.5e-3, 33):
        body = cs.Body(box, cs.Pose((0.01, 0.005, 0.005 + gap)), "glass")
        found.append(np.diag(sim.step(cs.Scene([body])).delta))
    near = np.array(found)[:, [1, 4, 5]]
    assert (np.diff(near, axis=0) > 0.0).all()
    assert (near[1:] < 1.1 * near[:-1]).all()
