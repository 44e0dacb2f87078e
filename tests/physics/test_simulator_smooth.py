"""Sub-millimetre motion: readings follow it without steps."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import bar, capsule

import capsense as cs

Array = np.ndarray

STEP = 1e-4
COUNT = 201


def sweep(sim: cs.Simulator, bodies: list[cs.Body]) -> Array:
    """ΔC_11 [F] of one body after the other, one step after the other."""
    return np.array([sim.step(cs.Scene([b])).delta[0, 0] for b in bodies])


def assert_no_jump(values: Array, window: int = 21) -> None:
    """No step is larger than three times the mean step of its neighbourhood (2 mm)."""
    steps = np.abs(np.diff(values))
    kernel = np.ones(window) / window
    padded = np.pad(steps, window // 2, mode="reflect")
    local = np.convolve(padded, kernel, mode="valid")
    ratio = steps / local
    assert ratio.max() <= 3.0, f"step {ratio.argmax()} is {ratio.max():.2f} times its surroundings"


@pytest.fixture(scope="module")
def rising(simulators) -> Array:
    """The bar rising from 5 mm to 25 mm over bare patches."""
    sim = simulators("six_patch_bare")
    return sweep(sim, [bar(0.005 + STEP * k) for k in range(COUNT)])


def test_bar_rising(rising):
    """Measured: no jump over 20 mm in z."""
    assert_no_jump(rising)


def test_bar_rising_is_monotonic(rising):
    """Measured: as in the reference, a bar that leaves is seen less and less."""
    assert (np.diff(rising) < 0).all()


@pytest.mark.parametrize(("gap", "start"), [(0.005, 0.0), (0.01, 0.0), (0.03, 0.0), (0.01, 0.055)])
def test_bar_passing(simulators, gap, start):
    """Measured: no jump over 20 mm in x, over the middle and where the bar's edge passes E1."""
    sim = simulators("six_patch_bare")
    values = sweep(sim, [bar(gap, x=start + STEP * k) for k in range(COUNT)])
    assert np.abs(np.diff(values, 2)).max() < (3e-3 if gap == 0.005 else 5e-4) * values.max()


def test_bar_leaving_is_monotonic(simulators):
    """Measured: an edge that draws back over E1 uncovers it monotonically."""
    sim = simulators("six_patch_bare")
    values = sweep(sim, [bar(0.01, x=0.03 + 1e-3 * k) for k in range(30)])
    assert (np.diff(values) < 0).all()


@pytest.mark.parametrize(
    "body",
    [
        lambda z: capsule(z),
        lambda z: cs.Body(cs.Sphere(0.03), cs.Pose((-0.02, 0.0, z + 0.03))),
        lambda z: cs.Body(
            cs.Sphere(0.03), cs.Pose((-0.02, 0.0, z + 0.03)), cs.Material("wax", eps_r=3.0)
        ),
        lambda z: cs.Body(
            cs.Cylinder(0.02, 0.1), cs.Pose((0, 0, z + 0.06), (0.2, 0.5, 0.1, 0.8)),
            grounding="floating",
        ),
    ],
    ids=["capsule", "sphere", "dielectric", "floating"],
)  # fmt: skip
def test_other_bodies_rising(simulators, body):
    """Measured: round, dielectric, oblique and floating bodies leave as smoothly."""
    sim = simulators("six_patch_bare")
    values = sweep(sim, [body(0.008 + 2 * STEP * k) for k in range(60)])
    assert_no_jump(values)
    assert (np.diff(values) < 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["six_patch", "stripe", "patch", "meander", "three_stripes"])
def test_bar_over_other_designs(simulators, name):
    """Measured: no jump, and monotonic, over all packaged designs."""
    values = sweep(simulators(name), [bar(0.005 + STEP * k) for k in range(COUNT)])
    assert_no_jump(values)
    assert (np.diff(values) < 0).all()


def test_a_wall_lets_a_body_in_smoothly(simulators):
    """Invariant: the face of a box comes into sight over 5 mm, not at once."""
    sim = simulators("six_patch")
    box = cs.Body(cs.Box((0.06, 0.06, 0.06)))
    values = sweep(sim, [box.moved(cs.Pose((0.271 - STEP * k, 0.0, 0.05))) for k in range(80)])
    assert values[0] == 0.0
    assert np.abs(np.diff(values)).max() < 0.1 * values.max()
