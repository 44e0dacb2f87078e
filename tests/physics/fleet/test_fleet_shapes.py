"""Meshes and limbs in fleets, on both cores, against simulators."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from cluster_twin import same_functions, twin_of
from fleet_scenes import GLASS, frames, poses, scene

import capsense as cs
from capsense.fleet import Fleet

COUNT = 3


def meshes():
    """A ring, an egg of glass and a bowl that is open."""
    ball, ring = trimesh.creation.icosphere(2, 0.03), trimesh.creation.torus(0.03, 0.01, 24, 12)
    bowl = ball.faces[ball.triangles_center[:, 2] < 0.01]
    return [
        cs.Body(cs.TriMesh(ring.vertices, ring.faces), material="steel"),
        cs.Body(cs.TriMesh(ball.vertices * [1, 1, 1.5], ball.faces), material=GLASS),
        cs.Body(cs.TriMesh(ball.vertices, bowl), material="steel", grounding="floating"),
    ]


def limb():
    """An arm along x that a sensor sees parts of, and where they are."""
    turn = cs.Pose((0.4, 0.02, 0.12), (0, 0.5**0.5, 0, 0.5**0.5))
    bodies = cs.humans.arm().bodies(turn)
    return bodies, np.array([[*b.pose.position, *b.pose.quaternion] for b in bodies])


def compared(fleet, bodies, where, sensors, simulator):
    """Largest difference to a simulator, over each environment's largest entry."""
    delta = fleet.step(where, sensors).delta
    delta = delta if fleet.device == "cpu" else delta.numpy().astype(float)
    worst = 0.0
    for e in range(fleet.count):
        truth = simulator.step(scene(bodies, where[e], sensors[e, 0])).delta
        worst = max(worst, np.abs(delta[e, 0] - truth).max() / np.abs(truth).max())
    return worst


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_meshes(device):
    """Differential: with the same functions, closed and open, conductors and a dielectric."""
    rng = np.random.default_rng(9)
    where, sensors = poses(rng, COUNT, 3), frames(rng, COUNT, 1)
    where[..., :3] = [[-0.09, 0.0, 0.06], [0.0, 0.0, 0.07], [0.08, 0.0, 0.06]]
    bodies = meshes()
    if device == "cpu":
        simulator = cs.Simulator("six_patch")
        fleet = Fleet("six_patch", bodies, COUNT)
        assert compared(fleet, bodies, where, sensors, simulator) < 1e-5
        return
    pytest.importorskip("warp")
    fleet = Fleet("six_patch", bodies, COUNT, device=device)
    with same_functions(64):
        assert compared(fleet, bodies, where, sensors, twin_of(fleet)) < 1e-4


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_limbs(device):
    """Differential: parts of an arm, which simulators join as they touch."""
    if device != "cpu":
        pytest.importorskip("warp")
    bodies, at = limb()
    where, sensors = np.array([at] * COUNT), frames(np.random.default_rng(10), COUNT, 1)
    where[:, :, 0] += np.linspace(-0.05, 0.05, COUNT)[:, None]
    fleet = Fleet("six_patch", bodies, COUNT, device=device, budget=128)
    fleet.join(range(len(bodies)))
    simulator = cs.Simulator("six_patch")
    bound = 1e-5 if device == "cpu" else 0.02
    assert compared(fleet, bodies, where, sensors, simulator) < bound
