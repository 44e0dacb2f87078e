"""The paper's own scheme through the simulator: usable, physical, and less accurate."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import ball, bar, delta_reference

import capsense as cs
from capsense.errors import SceneError

Array = np.ndarray


@pytest.fixture(scope="module")
def masked(simulators) -> cs.Simulator:
    return simulators("six_patch_bare", method="fem_masked")


@pytest.mark.parametrize("gap", [0.005, 0.01, 0.02, 0.05])
def test_grounded_bar(masked, gap):
    """Invariant: symmetric; a grounded bar raises every C_ii and shields every pair."""
    delta = masked.step(cs.Scene([bar(gap)])).delta
    largest = np.abs(delta).max()
    np.testing.assert_allclose(delta, delta.T, rtol=0, atol=1e-6 * largest)
    assert (np.diag(delta) > 0).all()
    assert (delta[~np.eye(6, dtype=bool)] > -1e-6 * largest).all()


def test_worse_than_surfaces(simulators, masked):
    """Measured: twice the error and more at 5 mm to 50 mm: its surfaces are staircases."""
    errors: dict[str, list[float]] = {"fem_masked": [], "surface": []}
    for gap in (5, 10, 20, 50):
        expected = np.diag(delta_reference("six_patch_bare", f"bar {gap}"))
        scene = cs.Scene([bar(gap / 1e3)])
        for name, sim in (("fem_masked", masked), ("surface", simulators("six_patch_bare"))):
            sim.reset()
            got = np.diag(sim.step(scene).delta)
            errors[name].append(float(np.abs(got / expected - 1).max()))
    worse = np.array(errors["fem_masked"]) / np.array(errors["surface"])
    assert (worse > 1.0).all(), errors
    assert np.mean(errors["fem_masked"]) > 2 * np.mean(errors["surface"]), errors


def test_blind_to_motion_within_an_element(simulators, masked):
    """Measured: a bar that moves 0.05 mm is the same staircase; surfaces see it."""
    here, there = cs.Scene([bar(0.05)]), cs.Scene([bar(0.05005)])
    still = masked.step(there).delta[0, 0] - masked.step(here).delta[0, 0]
    sim = simulators("six_patch_bare")
    seen = sim.step(there).delta[0, 0] - sim.step(here).delta[0, 0]
    assert abs(still) < 0.1 * abs(seen)


def test_dielectric_and_floating(masked):
    """Invariant: physical signs of what is not tied to ground."""
    for body in (ball(material="glass"), ball(grounding="floating")):
        delta = masked.step(cs.Scene([body])).delta
        assert np.linalg.eigvalsh(delta).min() > -1e-3 * np.abs(delta).max()


def test_a_step_equals_a_fresh_solve(masked):
    """Invariant: to its estimated error."""
    for gap in (0.02, 0.05, 0.03):
        warm = masked.step(cs.Scene([bar(gap)]))
    masked.reset()
    cold = masked.step(cs.Scene([bar(0.03)]))
    np.testing.assert_allclose(warm.delta, cold.delta, rtol=0, atol=2 * cold.stats.solver_error)


def test_impedances_are_refused(masked):
    """Invariant: what the scheme cannot represent is an error that says so."""
    for name, called in ({}, "body 1 "), ({"name": "arm"}, "body arm "):
        tied = bar(0.02, grounding=1e-12, **name)
        with pytest.raises(SceneError, match=f"{called}is tied.* 1e-12 F.*grounded and floating"):
            masked.step(cs.Scene([ball(), tied]))
    with pytest.raises(SceneError, match="body 0 is tied to ground through 'local'"):
        masked.step(cs.Scene([bar(0.02, grounding="local")]))


def test_open_surfaces_are_refused(masked):
    """Invariant: what has no inside masks nothing, and is an error that says so."""
    cloud = cs.point_surface(np.random.default_rng(0).uniform(0.02, 0.05, (50, 3)))
    with pytest.raises(SceneError, match=r"body 0 is an open surface.*give a DepthFrame"):
        masked.step(cs.Scene([cs.Body(cloud)]))


def test_outside_bodies_change_nothing(masked):
    """Invariant: nothing masked, nothing changed."""
    delta = masked.step(cs.Scene([cs.Body(cs.Sphere(0.05), cs.Pose((0.5, 0, 0.1)))])).delta
    np.testing.assert_allclose(delta, 0.0, atol=1e-18)


@pytest.mark.parametrize(
    ("gap", "material", "contact"),
    [(-0.001, "steel", True), (0.0, "steel", True), (0.001, "steel", False),
     (-0.001, "glass", True), (0.0, "glass", False)],
)  # fmt: skip
def test_contact_is_told(simulators, masked, gap, material, contact):
    """Invariant: as by the surface method: the error is as large as the largest capacitance."""
    scene = cs.Scene([bar(gap, material=material)])
    for sim in (masked, simulators("six_patch_bare")):
        reading = sim.step(scene)
        told = reading.stats.solver_error >= np.abs(reading.capacitance).max()
        assert told == contact
