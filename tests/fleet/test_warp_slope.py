"""Gradients on Warp, against simulators with the same functions and central differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from cluster_twin import same_functions, twin_of
from reference_scenes import fleet_of, reference_scenes
from scipy.spatial.transform import Rotation
from test_fleet import BODIES, frames, poses, scene

import capsense as cs
from capsense.design import Role, load_design
from capsense.design.model import Conductor
from capsense.errors import SceneError
from capsense.field.cache import default_settings, load_or_build
from capsense.fleet import Fleet

pytest.importorskip("warp")
COUNT = 3
PRIMITIVES = cs.Box, cs.Sphere, cs.Capsule, cs.Cylinder, cs.Ellipsoid


def against_twin(fleet, where, sensors):
    """Largest difference of a Jacobian to ``Simulator.step``, over each one's largest entry."""
    found = fleet.step(where, sensors, jacobian=True).jacobian.numpy()
    assert found.shape == (*sensors.shape[:2], 3, *fleet.baseline.shape, 6)
    worst, twin = 0.0, twin_of(fleet)
    with same_functions(64):
        for e, s in np.ndindex(sensors.shape[:2]):
            truth = twin.step(scene(BODIES, where[e], sensors[e, s]), jacobian=True).jacobian
            for half in (slice(3), slice(3, 6)):
                miss = np.abs(found[e, s] - truth)[..., half].max()
                worst = max(worst, miss / np.abs(truth[..., half]).max())
    return worst


def some_poses(seed):
    rng = np.random.default_rng(seed)
    where = poses(rng, COUNT, 3)
    where[..., :3] = [[-0.09, 0.0, 0.06], [0.0, 0.0, 0.055], [0.08, 0.0, 0.06]]
    where[..., :3] += rng.uniform(-0.01, 0.01, (COUNT, 3, 3))
    return where, frames(rng, COUNT, 2)


def test_jacobians():
    """Differential: conductors, dielectrics, floating bodies and ties, all of them near."""
    fleet = Fleet("six_patch", BODIES, COUNT, sensors=2, device="warp:cpu", budget=64)
    assert against_twin(fleet, *some_poses(1)) < 1e-4


def test_jacobian_with_floating_conductors_of_the_design(monkeypatch):
    """Differential: two electrodes of the design are cut off and float."""
    whole = load_design("six_patch")
    field = load_or_build(whole, default_settings(whole))
    for module in ("capsense.fleet.fleet", "capsense.simulator"):
        monkeypatch.setattr(f"{module}.load_or_build", lambda *a, **b: field)
    loose = [Conductor(x.name, Role.FLOATING, x.surface) for x in whole.electrodes[4:]]
    design = replace(whole, electrodes=whole.electrodes[:4], conductors=(*whole.conductors, *loose))
    fleet = Fleet(design, BODIES, COUNT, sensors=2, device="warp:cpu", budget=64)
    assert against_twin(fleet, *some_poses(2)) < 1e-4


@pytest.mark.parametrize(
    ("budget", "bound", "middle"),
    [
        (32, 0.015, 5e-4),
        pytest.param(64, 3e-3, 4e-4, marks=pytest.mark.e2e),
        pytest.param(128, 3e-3, 3e-4, marks=pytest.mark.e2e),
    ],
)
def test_jacobians_are_those_of_the_readings(budget, bound, middle):
    """Differential: central differences over the reference map, every body moving and turning at
    random. The bound is of scenes from 8 mm whose bodies are cut alike at both ends; the median of
    all scenes."""
    every = reference_scenes()
    scenes = [s for s in every if all(isinstance(b.shape, PRIMITIVES) for b in s.scene)]
    fleet, where = fleet_of(scenes, device="warp:cpu", budget=budget)
    rng = np.random.default_rng(5)
    way = rng.normal(size=(*where.shape[:2], 6)) * ([1e-4] * 3 + [5e-4] * 3)
    slope = fleet.step(where, jacobian=True).jacobian.numpy()[:, 0].astype(float)
    slope = np.einsum("ebijr,ebr->eij", slope, way)
    ends, nodes = [], []
    for sign in (1, -1):
        moved = where.copy()
        moved[..., :3] += sign * way[..., :3]
        turn = Rotation.from_rotvec(sign * way[..., 3:].reshape(-1, 3))
        turned = turn * Rotation.from_quat(where[..., 3:].reshape(-1, 4))
        moved[..., 3:] = turned.as_quat().reshape(*where.shape[:2], 4)
        ends.append(fleet.step(moved).delta.numpy()[:, 0].astype(float))
        nodes.append(np.sort(fleet._warp.cut.number.numpy().reshape(-1, budget, len(scenes)), 1))
    truth = 0.5 * (ends[0] - ends[1])
    miss = np.abs(slope - truth).max(axis=(1, 2)) / np.abs(truth).max(axis=(1, 2))
    alike = (nodes[0] == nodes[1]).all(axis=(0, 1)) & (np.array([s.gap for s in scenes]) > 0.0079)
    assert alike.sum() > 45
    assert miss[alike].max() < bound
    assert np.median(miss) < middle


def test_jacobian_of_joined_conductors():
    """Measured: central differences, of two conductors that are one."""
    bodies = [BODIES[0], BODIES[2]]
    fleet = Fleet("six_patch", bodies, 1, device="warp:cpu", budget=32)
    fleet.join([0, 1])
    where = some_poses(3)[0][:1, [0, 2]]
    found = fleet.step(where, jacobian=True).jacobian.numpy()[0, 0]
    scale = np.abs(found[..., :3]).max()
    for b, k in np.ndindex(2, 3):
        ends = []
        for sign in (1, -1):
            moved = where.copy()
            moved[0, b, k] += sign * 2e-4
            ends.append(fleet.step(moved).delta.numpy()[0, 0].astype(float))
        difference = (ends[0] - ends[1]) / 4e-4
        np.testing.assert_allclose(found[b, ..., k], difference, rtol=0, atol=4e-3 * scale)


def test_refused():
    """Errors name the thing and the fix."""
    fleet = Fleet("six_patch", BODIES, 1, device="warp:cpu", budget=32)
    fleet.change(0, replace(BODIES[0], material="water"))
    with pytest.raises(SceneError, match="lossy matter, which have none yet"):
        fleet.step(poses(np.random.default_rng(4), 1, 3), jacobian=True)
