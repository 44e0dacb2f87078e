"""Covers on Warp: contact mechanics as of a fleet on the CPU."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import tiny_field
from covered_discs import covered_discs
from near_scenes import fleet_of, near_scenes
from test_warp_gap import differences, misses

import capsense as cs
from capsense.errors import SceneError
from capsense.field.cache import load_or_build
from capsense.fleet import Fleet, FleetTouch

wp = pytest.importorskip("warp")
KINDS = cs.Sphere(0.008), cs.Box((0.01, 0.014, 0.008)), cs.Capsule(0.005, 0.012)


def touch_misses(found: FleetTouch, truth: FleetTouch) -> float:
    """Largest difference of any part of two touches, over the largest entry of each view."""
    out = 0.0
    for name in ("force", "compression", "total"):
        one, two = getattr(found, name).numpy(), getattr(truth, name)
        assert one.shape == two.shape
        axes = tuple(range(2, two.ndim))
        scale = np.maximum(np.abs(two).max(axis=axes, keepdims=True, initial=0.0), 1e-9)
        out = max(out, (np.abs(one - two) / scale).max())
    return float(out)


def test_overlaps_are_felt(foam_field: cs.Design) -> None:
    """Differential: all kinds of bodies up to past full compression; measured 2e-4."""
    some = Fleet(foam_field, [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 24, (-3e-3, 1e-3), "grounded", seed=3)
    truth = fleet_of(foam_field, scenes).step(scenes.poses).touch
    found = fleet_of(foam_field, scenes, device="warp:cpu", budget=32).step(scenes.poses).touch
    assert truth is not None
    assert (truth.total > 0.0).sum() > 12
    assert touch_misses(found, truth) < 1e-3


def pressed_scenes(count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of the bodies of ``KINDS`` side by side over the cover, sensors, and forces [N].

    Shapes (e, 3, 7), (e, 2, 7) and (e, 3). The first sensors are the worlds' frames, the others
    are turned about z; a quarter of the bodies has no force, and some have a force of zero.
    """
    rng = np.random.default_rng(seed)
    poses, sensors = np.zeros((count, 3, 7)), np.zeros((count, 2, 7))
    poses[..., 6] = sensors[..., 6] = 1.0
    poses[..., 0] = [-0.015, 0.002, 0.017]
    poses[..., :2] += rng.uniform(-0.001, 0.001, (count, 3, 2))
    poses[..., 2] = [0.010, 0.006, 0.007]
    poses[..., 2] += rng.uniform(-0.0015, 0.002, (count, 3))
    poses[..., 3:6] = 0.1 * rng.normal(size=(count, 3, 3))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    angle = rng.uniform(0.0, 3.0, count)
    sensors[:, 1, 5], sensors[:, 1, 6] = np.sin(angle), np.cos(angle)
    forces = np.exp(rng.uniform(*np.log([0.02, 3.0]), (count, 3)))
    forces[rng.random((count, 3)) < 0.25] = np.nan
    forces[rng.random((count, 3)) < 0.1] = 0.0
    single = (x.astype(np.float32).astype(float) for x in (poses, sensors))
    return *single, forces


def test_forces_press_bodies_in(foam_field: cs.Design) -> None:
    """Differential: forces and overlaps of three bodies, two sensors; measured 5e-5."""
    poses, sensors, forces = pressed_scenes(12, 5)
    bodies = [cs.Body(KINDS[0], material="wood"), *map(cs.Body, KINDS[1:])]
    one = Fleet(foam_field, bodies, 12, sensors=2)
    two = Fleet(foam_field, bodies, 12, sensors=2, device="warp:cpu", budget=32)
    truth = one.step(poses, sensors, forces=forces).touch
    found = two.step(poses, sensors, forces=forces).touch
    assert touch_misses(found, truth) < 1e-3
    held = ~np.isnan(forces).any(axis=1)
    assert held.any()
    np.testing.assert_allclose(
        found.total.numpy()[held], np.tile(forces[held].sum(axis=1)[:, None], 2), rtol=1e-5
    )
    each = found.force.numpy().copy()
    given = wp.array(forces, dtype=wp.float32, device="cpu")
    np.testing.assert_array_equal(two.step(poses, sensors, forces=given).touch.force, each)
    torch = pytest.importorskip("torch")
    given = torch.tensor(forces, dtype=torch.float32)
    np.testing.assert_array_equal(two.step(poses, sensors, forces=given).touch.force, each)


def held_fleet(
    design: cs.Design, forces: np.ndarray, materials: Sequence[str], device: str = "warp:cpu"
) -> Fleet:
    """A fleet of the bodies of ``KINDS`` with forces of their own, and two sensors."""
    fleet = Fleet(design, list(map(cs.Body, KINDS)), len(forces), sensors=2, device=device)
    groundings = "grounded", "floating", 20e-12
    for place, each in enumerate(zip(KINDS, materials, groundings, strict=True)):
        body = cs.Body(each[0], material=each[1], grounding=each[2])
        own = [None if np.isnan(f) else float(f) for f in forces[:, place]]
        fleet.change(place, [body.pressed(f) for f in own])
    return fleet


def test_readings_of_bodies_that_forces_hold(foam_field: cs.Design) -> None:
    """Differential: the bodies' own forces, with the same functions; measured 3e-4, median 1e-6."""
    poses, sensors, forces = pressed_scenes(6, 8)
    fleet = held_fleet(foam_field, forces, ("steel",) * 3)
    assert misses(fleet, poses, None, sensors)[0].max() < 1e-3


@pytest.fixture(params=["ground", "floating"])
def fabric_design(request, field_cache, monkeypatch) -> cs.Design:
    """A cover with a conducting fabric; the grounded one carries compression on."""
    top = request.param
    with tiny_field.few_sources():
        field = load_or_build(covered_discs(top=top), tiny_field.SETTINGS, cache_dir=field_cache)
    for module in ("capsense.fleet.fleet", "capsense.simulator"):
        monkeypatch.setattr(f"{module}.load_or_build", lambda *a, **b: field)
    return covered_discs(top=top, bending_length=3e-3 if top == "ground" else 0.0)


def test_readings_below_a_fabric(fabric_design: cs.Design) -> None:
    """Differential: forces and overlaps, with the same functions; measured 2e-5, median 1e-6."""
    poses, sensors, forces = pressed_scenes(6, 8)
    materials = "steel", "steel", "wood"
    fleet = held_fleet(fabric_design, forces, materials)
    assert misses(fleet, poses, None, sensors)[0].max() < 1e-3
    truth = held_fleet(fabric_design, forces, materials, "cpu").step(poses, sensors).touch
    assert touch_misses(fleet.step(poses, sensors).touch, truth) < 1e-3


def test_forces_that_are_wrong_are_refused(
    foam_field: cs.Design, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, 0.0115)))
    fleet = Fleet(foam_field, [body], 2, device="warp:cpu", budget=32)
    where = np.tile([0, 0, 0.0115, 0, 0, 0, 1.0], (2, 1, 1))
    for forces, fix in (
        ([0.5, 0.5], "shape"), ([[-1.0], [0.0]], "-1"), ([[np.inf], [0]], "inf"),
        (wp.zeros(2, dtype=wp.float32, device="cpu"), "shape"),
        (wp.zeros((2, 1), dtype=wp.float64, device="cpu"), "float32"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=fix):
            fleet.step(where, forces=forces)
    with pytest.raises(SceneError, match="Jacobian"):
        fleet.step(where, forces=[[0.5], [0.5]], jacobian=True)
    monkeypatch.undo()  # else it gets the field of the other design
    bare = Fleet("six_patch", [body], 2, device="warp:cpu", budget=32)
    for forces in ([[0.5], [0.5]], wp.zeros((2, 1), dtype=wp.float32, device="cpu")):
        with pytest.raises(SceneError, match="cover"):
            bare.step(where, forces=forces)
    assert bare.step(where, forces=[[np.nan], [np.nan]]).touch is None


def test_gradients_below_a_fabric(fabric_design: cs.Design) -> None:
    """Differential: central differences of readings, of bodies pressed in by their poses.

    Measured 1e-3 (median) below the grounded fabric and 5e-3 below the floating one.
    """
    some = Fleet(fabric_design, [cs.Body(KINDS[0])], 1)
    scenes = near_scenes(some, 18, (-2e-3, -1e-4), "grounded", seed=5)
    fleet = fleet_of(fabric_design, scenes, device="warp:cpu")
    slope = fleet.step(scenes.poses, jacobian=True).jacobian.numpy()[:, 0, 0].astype(float)
    truth, alike = differences(fleet, scenes.poses)
    turns = np.array([not name.startswith("sphere") for name in scenes.names])
    grounded = fabric_design.cover.top == "ground"  # else readings are differences of large numbers
    for half, chosen in ((slice(3), alike), (slice(3, 6), alike & turns)):
        miss = np.abs(slope - truth)[chosen][..., half].max(axis=(1, 2, 3))
        miss /= np.abs(truth)[chosen][..., half].max(axis=(1, 2, 3))
        assert len(miss) > 8
        assert np.median(miss) < 2e-2
        assert not grounded or miss.max() < 0.05


def test_touch_steps_can_be_captured(fabric_design: cs.Design) -> None:
    """Differential: a captured step with other poses and forces gives the bits of a step."""
    if not hasattr(wp, "capture_save"):
        pytest.skip("this version of Warp captures on GPUs only")
    body = cs.Body(cs.Sphere(0.01))
    where = wp.array(np.tile([0.01, 0, 0.0115, 0, 0, 0, 1.0], (2, 1, 1)), dtype=wp.float32)
    forces = wp.zeros((2, 1), dtype=wp.float32, device="cpu")
    fleet, other = (Fleet(fabric_design, [body], 2, device="warp:cpu", budget=32) for _ in range(2))
    fleet.step(where, forces=forces)
    with wp.ScopedCapture("cpu") as capture:
        found = fleet.step(where, forces=forces)
    forces.assign(np.array([[0.3], [np.nan]], np.float32))
    wp.capture_launch(capture.graph)
    truth = other.step(where, forces=forces)
    assert truth.touch.total.numpy().all()
    np.testing.assert_array_equal(found.delta, truth.delta)
    for name in ("force", "compression", "total"):
        np.testing.assert_array_equal(getattr(found.touch, name), getattr(truth.touch, name))
