"""A walk does not drift: a step equals a fresh solve of the same scene."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import bar
from random_scenes import random_body, random_scene

import capsense as cs
from capsense.errors import SolveError
from capsense.solve.packed import Workspace

FACTOR = 10.0
"""Each of the two solutions is within ``stats.tolerance`` of the exact one by an *estimate*; the
bound allows it to be out by this much."""


def walk(sim: cs.Simulator, rng: np.random.Generator, steps: int) -> cs.Scene:
    """Jitter a scene; now and then change one of its bodies, or all of it."""
    scene = random_scene(rng)
    sim.step(scene)
    for _ in range(steps):
        roll = rng.random()
        if roll < 0.02:
            scene = random_scene(rng)
        elif roll < 0.08:
            bodies = list(scene)
            bodies[rng.integers(len(bodies))] = random_body(rng)
            scene = cs.Scene(bodies)
        else:
            scene = cs.Scene(
                b.moved(
                    cs.Pose(
                        np.array(b.pose.position) + rng.normal(scale=1e-3, size=3),
                        np.array(b.pose.quaternion) + rng.normal(scale=0.01, size=4),
                    )
                )
                for b in scene
            )
        sim.step(scene)
    return scene


def assert_step_is_fresh(sim: cs.Simulator, scene: cs.Scene) -> None:
    warm = sim.step(scene)
    sim.reset()
    cold = sim.step(scene)
    allowed = FACTOR * max(warm.stats.tolerance, cold.stats.tolerance)
    # single precision in the kernels
    allowed += 1e-6 * np.abs(cold.delta).max()
    np.testing.assert_allclose(warm.delta, cold.delta, rtol=0, atol=allowed)


@pytest.mark.parametrize("seed", range(3))
def test_after_hundreds_of_random_steps(simulators, seed):
    """Invariant: 100 steps a seed, compared at the end and at ten scenes on the way."""
    rng, sim = np.random.default_rng(seed), simulators("six_patch_bare")
    for _ in range(10):
        assert_step_is_fresh(sim, walk(sim, rng, 10))


@pytest.mark.slow
def test_after_a_hundred_thousand_random_steps(simulators):
    """Invariant: 10⁵ steps without a reset."""
    rng, sim = np.random.default_rng(9), simulators("six_patch_bare")
    scene = random_scene(rng)
    for _ in range(1000):
        scene = walk(sim, rng, 99)
    assert_step_is_fresh(sim, scene)


def test_error_estimate_is_below_the_tolerance(simulators):
    """Invariant: ``stats`` say what was asked for and what was reached."""
    sim = simulators("six_patch_bare")
    for gap in (0.005, 0.02, 0.1):
        stats = sim.step(cs.Scene([bar(gap)])).stats
        assert 0 <= stats.error_estimate <= stats.tolerance
        assert stats.iterations > 0
        assert stats.wall_time > 0


@pytest.mark.parametrize("gap", [0.005, 0.02, 0.1])
def test_tolerance_bounds_the_error_of_a_cold_start(simulators, gap):
    """Differential: against a solve a thousand times tighter."""
    scene = cs.Scene([bar(gap)])
    tight = simulators("six_patch_bare", relative_tolerance=1e-8, tolerance=1e-21).step(scene)
    usual = simulators("six_patch_bare").step(scene)
    allowed = FACTOR * usual.stats.tolerance + 1e-6 * np.abs(tight.delta).max()
    np.testing.assert_allclose(usual.delta, tight.delta, rtol=0, atol=allowed)
    assert usual.stats.iterations < tight.stats.iterations


def test_warm_start_saves_iterations(simulators):
    """Measured: a body that moves 1 mm needs less than half of a cold start's iterations."""
    sim = simulators("six_patch_bare")
    cold = sim.step(cs.Scene([bar(0.03)])).stats.iterations
    warm = [sim.step(cs.Scene([bar(0.03 + 1e-3 * k)])).stats.iterations for k in range(1, 10)]
    assert np.mean(warm) <= 0.6 * cold
    assert sim.step(cs.Scene([bar(0.039)])).stats.iterations <= 1


def test_readings_are_reproducible(simulators):
    """Invariant: the same walk after a reset gives the same readings to the last bit."""
    sim = simulators("six_patch_bare")
    scenes = [random_scene(np.random.default_rng(s)) for s in range(10)]

    def run() -> list[np.ndarray]:
        sim.reset()
        return [sim.step(s).delta for s in scenes]

    for one, two in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(one, two)


def test_readings_are_independent_of_each_other(simulators):
    """Invariant: a reading handed out is not changed by later steps."""
    sim = simulators("six_patch_bare")
    reading = sim.step(cs.Scene([bar(0.01)]))
    kept = reading.delta.copy(), reading.capacitance.copy()
    sim.step(cs.Scene([bar(0.05)]))
    np.testing.assert_array_equal(reading.delta, kept[0])
    np.testing.assert_array_equal(reading.capacitance, kept[1])


def test_what_is_not_finite_does_not_reach_the_next_step(simulators, monkeypatch):
    """A step that goes wrong is refused, and the one after it starts from rest."""
    sim = simulators("six_patch_bare")
    scene = cs.Scene([bar(0.01)])
    expected = sim.step(scene).delta
    solver = sim._solver

    def spoil(work: Workspace, *rest: object) -> object:
        work.setup.extra[:] = np.nan
        return solve(work, *rest)

    solve = solver._solve_blocks
    monkeypatch.setattr(solver, "_solve_blocks", spoil)
    with pytest.raises(SolveError, match="not finite"):
        sim.step(cs.Scene([bar(0.02)]))
    monkeypatch.undo()
    np.testing.assert_array_equal(sim.step(scene).delta, expected)
