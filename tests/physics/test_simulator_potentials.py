"""Potentials of a step: what they are held to, and what they must not pass."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError

BOX = cs.Box((0.15, 0.15, 0.03))
POSE = cs.Pose((0, 0, 0.05))


def bar(grounding: str | float = "grounded") -> cs.Body:
    return cs.Body(BOX, POSE, "steel", grounding)


def kept(simulator: cs.Simulator, *bodies: cs.Body) -> cs.Reading:
    """A reading that keeps its field."""
    return simulator.step(cs.Scene(bodies), keep_field=True)


@pytest.fixture(scope="module")
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch_bare")


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """In front of the sensor, from 3 mm on [m]."""
    return np.random.default_rng(1).uniform([-0.1, -0.1, 0.003], [0.1, 0.1, 0.15], (3000, 3))


def test_empty_scene(simulator: cs.Simulator, points: np.ndarray) -> None:
    """Invariant: φ⁰ of the background field, before any other step and after one."""
    phi = np.clip(simulator.background.green.phi0(points), 0.0, 1.0)
    for sim in (simulator.copy(), simulator):
        np.testing.assert_array_equal(kept(sim).potentials(points), phi)
        sim.step(cs.Scene([bar()]))
        np.testing.assert_array_equal(kept(sim).potentials(points), phi)


def test_the_potential_of_an_electrode_by_reciprocity(simulator: cs.Simulator) -> None:
    """Analytic: the charge that a small grounded ball draws off an electrode goes with φ⁰².

    A ball of radius R at a point of potential φ takes the charge −4π ε0 R φ, and ΔC = 4π ε0 R φ².
    """
    at = np.array([[0.0, 0.025, 0.03], [0.038, -0.02, 0.05], [0.05, 0.06, 0.08]])
    phi = kept(simulator).potentials(at)
    for place, expected in zip(at, phi, strict=True):
        ball = cs.Body(cs.Sphere(2e-4), cs.Pose(place))
        delta = simulator.step(cs.Scene([ball])).delta
        own = 4 * np.pi * 8.8541878128e-12 * 2e-4 * np.outer(expected, expected)
        np.testing.assert_allclose(delta, own, rtol=0, atol=0.015 * own.max())


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-12])
def test_in_a_conductor(
    simulator: cs.Simulator, points: np.ndarray, grounding: str | float
) -> None:
    """Invariant: zero in a grounded body, one value between zero and one in another."""
    potentials = kept(simulator, bar(grounding)).potentials(points)
    inside = BOX.signed_distance(POSE.inverse().apply(points)) < 0
    assert inside.sum() > 50
    held = potentials[inside]
    np.testing.assert_array_equal(held, np.tile(held[0], (len(held), 1)))
    if grounding == "grounded":
        assert (held[0] == 0.0).all()
    else:
        assert ((held[0] > 0.005) & (held[0] < 0.3)).all()


def test_at_the_surface_of_a_conductor(simulator: cs.Simulator) -> None:
    """Measured: within 0.04 V of zero all over a grounded ball, where φ⁰ is up to 0.3 V."""
    ball = cs.Sphere(0.03)
    place = cs.Pose((0.0, 0.01, 0.05))
    reading = kept(simulator, cs.Body(ball, place))
    way = np.random.default_rng(2).normal(size=(500, 3))
    at = place.apply(0.0305 * way / np.linalg.norm(way, axis=1)[:, None])
    before = simulator.background.green.phi0(at)
    assert before.max() > 0.2
    assert np.abs(reading.potentials(at)).max() < 0.05


def test_between_the_conductors(simulator: cs.Simulator, points: np.ndarray) -> None:
    """Invariant: nowhere above one or below zero; a grounded conductor lowers them everywhere."""
    potentials = kept(simulator, bar()).potentials(points)
    before = simulator.background.green.phi0(points)
    assert potentials.min() > -0.01
    assert potentials.max() < 1.01
    assert (potentials - before).max() < 0.01


def test_they_belong_to_the_reading(simulator: cs.Simulator, points: np.ndarray) -> None:
    """Invariant: other steps, resets and copies do not change what a reading kept."""
    one, other = kept(simulator, bar()), kept(simulator, bar("floating"))
    before, charges = one.potentials(points), one.charges()
    assert charges is not None
    assert not np.array_equal(before, other.potentials(points))
    for _ in range(2):
        simulator.step(cs.Scene([cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, 0.05)))]))
        np.testing.assert_array_equal(one.potentials(points), before)
        np.testing.assert_array_equal(one.charges().density, charges.density)
        simulator.reset()
    twin = pickle.loads(pickle.dumps(one))
    np.testing.assert_array_equal(twin.potentials(points), before)
    assert kept(simulator).charges() is None
    simulator.use_readout("fdc1004")
    with_chip = simulator.step(cs.Scene([bar()]), time=0.1, keep_field=True)
    simulator.use_readout(None)
    assert with_chip.counts is not None
    np.testing.assert_array_equal(with_chip.potentials(points), before)


def test_refusals(simulator: cs.Simulator) -> None:
    """The other method says which one does; points have three coordinates; none were kept."""
    with pytest.raises(ValueError, match='use "surface"'):
        cs.Simulator("six_patch", method="fem_masked").step(cs.Scene(), keep_field=True)
    with pytest.raises(SceneError, match="points have shape"):
        kept(simulator).potentials(np.zeros(3))
    for reading in (simulator.step(cs.Scene([bar()])), simulator.empty):
        with pytest.raises(ValueError, match=r"no potentials.*step\(scene, keep_field=True\)"):
            reading.potentials(np.zeros((1, 3)))
        with pytest.raises(ValueError, match=r"no charges.*step\(scene, keep_field=True\)"):
            reading.charges()
