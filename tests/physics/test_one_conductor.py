"""Bodies of one conductor, such as the limbs of a person, wherever they are."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import capsense as cs

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

from continuity import largest_jump

Array = np.ndarray
ALONG = (0.0, 2**-0.5, 0.0, 2**-0.5)
PRESETS = ("fast", "standard", pytest.param("fine", marks=pytest.mark.e2e))
TIES = ("floating", 100e-12, "grounded")


def person(x: float, grounding: object, *, conductor: str | None = "person") -> cs.Scene:
    """A forearm over the sensor, an upper arm on it, and a trunk whose middle is at x [m]."""
    parts = (
        (cs.Capsule(0.04, 0.25), cs.Pose((0.02, 0.01, 0.08), ALONG)),
        (cs.Capsule(0.05, 0.28), cs.Pose((0.185, 0.01, 0.08), ALONG)),
        (cs.Box((0.3, 0.25, 0.5)), cs.Pose((x, 0.01, 0.1))),
    )
    return cs.Scene(
        [cs.Body(shape, pose, "human", grounding, conductor=conductor) for shape, pose in parts]
    )


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("grounding", TIES)
def test_a_trunk_that_comes_in_and_touches_makes_no_jump(simulators, preset, grounding) -> None:
    """Regression: 3.2 % within 1e-12 m, as its share of the capacitance was taken from the arm.

    It touches the upper arm at 0.525 m, and its front passes the wall at 0.385 m.
    """
    sim = simulators("six_patch_bare", preset=preset)

    def read(x: float) -> Array:
        return np.diag(sim.step(person(x, grounding)).delta)

    assert largest_jump(read, np.linspace(0.3, 0.56, 66)) < 1e-6


@pytest.mark.parametrize("preset", PRESETS)
def test_a_person_on_100_pF_comes_in_gently(simulators, preset) -> None:
    """Measured: at most 0.07 % of the reading a millimetre, 1.1 % over the whole way."""
    sim = simulators("six_patch_bare", preset=preset)
    found = np.array([
        np.diag(sim.step(person(x, 100e-12)).delta) for x in np.arange(0.3, 0.56, 1e-3)
    ])  # fmt: skip
    assert np.abs(np.diff(found, axis=0) / found[1:]).max() < 1e-3
    assert (np.ptp(found, axis=0) / found[0]).max() < 0.02


def test_parts_that_touch_have_the_whole_capacitance(simulators) -> None:
    """Differential: by name with the whole, or since they touch, each with a third of it."""
    sim = simulators("six_patch_bare")
    named, thirds = (
        sim.step(person(0.5, tie, conductor=name)).delta
        for tie, name in ((100e-12, "p"), (100e-12 / 3, None))
    )
    np.testing.assert_allclose(named, thirds, rtol=1e-9)


def test_parts_apart_share_their_potential(simulators) -> None:
    """Differential: with places of a fleet that are joined, as by a wire."""
    parts = [
        cs.Body(cs.Sphere(0.02), cs.Pose((x, 0.01, z)), "steel", "floating", conductor="dumbbell")
        for x, z in ((-0.05, 0.03), (0.06, 0.08))
    ]
    sim = simulators("six_patch_bare")
    poses = np.array([[[*b.pose.position, *b.pose.quaternion] for b in parts]])
    by_name = cs.Fleet("six_patch_bare", parts, 1)
    wired = cs.Fleet("six_patch_bare", [cs.Body(b.shape, grounding="floating") for b in parts], 1)
    wired.join([0, 1])
    wanted = wired.step(poses).delta[0, 0]
    np.testing.assert_allclose(by_name.step(poses).delta[0, 0], wanted, rtol=1e-12)
    np.testing.assert_allclose(sim.step(cs.Scene(parts)).delta, wanted, rtol=1e-6, atol=1e-22)
    lone = sim.step(cs.Scene([cs.Body(b.shape, b.pose, grounding="floating") for b in parts]))
    assert np.abs(lone.delta - wanted).max() > 0.05 * np.abs(wanted).max()


def test_a_fleet_ties_a_conductor_once() -> None:
    """Differential: the whole capacitance, also where its first body is missing; names stay."""
    arm, hand = (
        cs.Body(cs.Capsule(0.03, length), material="human", grounding=2e-12, conductor="p")
        for length in (0.2, 0.08)
    )
    poses = np.array([[[-0.05, 0.0, 0.07, *ALONG], [0.12, 0.0, 0.07, *ALONG]]] * 2)
    fleet = cs.Fleet("six_patch_bare", [arm, hand], 2)
    fleet.change(0, None, [1])
    found = fleet.step(poses).delta[:, 0]
    sim = cs.Simulator("six_patch_bare")
    for row, parts in zip(found, ((0, 1), (1,)), strict=True):
        scene = cs.Scene(
            [
                (arm, hand)[k].moved(cs.Pose(p[:3], p[3:]))
                for k, p in enumerate(poses[0])
                if k in parts
            ]
        )
        np.testing.assert_allclose(row, sim.step(scene).delta, rtol=1e-6, atol=1e-22)
    with pytest.raises(cs.SceneError, match=r"place 1 belongs to conductor 'p'.*conductor None"):
        fleet.change(1, cs.Body(cs.Sphere(0.02)))


def test_names_do_not_matter_for_dielectrics_and_at_ground(simulators) -> None:
    """Invariant."""
    sim = simulators("six_patch_bare")
    for material, grounding in (("pla", "floating"), ("steel", "grounded")):
        named, plain = (
            sim.step(cs.Scene([
                cs.Body(cs.Sphere(0.02), cs.Pose((x, 0.0, 0.05)), material, grounding, conductor=n)
                for x in (-0.03, 0.03)
            ])).delta
            for n in ("a", None)
        )  # fmt: skip
        np.testing.assert_array_equal(named, plain)


def test_a_conductor_has_one_grounding() -> None:
    with pytest.raises(cs.SceneError, match="conductor 'p' have groundings 1e-10 and 'grounded'"):
        cs.Scene([
            cs.Body(cs.Sphere(0.02), grounding=tie, conductor="p") for tie in (1e-10, "grounded")
        ])  # fmt: skip
    with pytest.raises(cs.SceneError, match="conductor is ''; give a non-empty string"):
        cs.Body(cs.Sphere(0.02), conductor="")


@pytest.mark.parametrize("grounding", ["floating", 5e-12, 100e-12])
def test_jacobians_follow_parts_that_come_in(simulators, grounding) -> None:
    """Differential: central differences, of a trunk at the wall."""
    sim = simulators("six_patch_bare", preset="fine")
    for x in (0.345, 0.36, 0.37):

        def bodies(dx: float, x: float = x) -> cs.Scene:
            shapes = (cs.Capsule(0.04, 0.25), 0.02, 0.08), (cs.Box((0.3, 0.25, 0.3)), x + dx, 0.25)
            return cs.Scene([
                cs.Body(shape, cs.Pose((at, 0.01, z), ALONG), "human", grounding, conductor="p")
                for shape, at, z in shapes
            ])  # fmt: skip

        found = sim.step(bodies(0.0), jacobian=True).jacobian[1, ..., 0]
        low, high = (sim.step(bodies(s)).delta for s in (-2e-4, 2e-4))
        wanted = (high - low) / 4e-4
        whole = np.abs(sim.step(bodies(0.0)).delta).max()
        assert np.abs(found - wanted).max() < 0.03 * np.abs(wanted).max() + 0.05 * whole
