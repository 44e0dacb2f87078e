"""Bodies, poses and scenes of the tests of fleets."""

from __future__ import annotations

import numpy as np

import capsense as cs

GLASS = cs.Material("glass like", 5.0)
BODIES = [
    cs.Body(cs.Capsule(0.01, 0.05), material="human", grounding=100e-12),
    cs.Body(cs.Box((0.05, 0.03, 0.02)), material=GLASS),
    cs.Body(cs.Sphere(0.02), material="steel", grounding="floating"),
]


def poses(rng, *shape, low=(-0.1, -0.06, 0.04), high=(0.1, 0.06, 0.12)):
    turn = rng.normal(size=(*shape, 4))
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([rng.uniform(low, high, (*shape, 3)), turn], axis=-1)


def frames(rng, *shape):
    """Sensors near the world's origin that look about along its z."""
    turn = np.concatenate([0.1 * rng.normal(size=(*shape, 3)), np.ones((*shape, 1))], axis=-1)
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.concatenate([rng.uniform(-0.01, 0.01, (*shape, 3)), turn], axis=-1)


LONG = [
    cs.Body(cs.Box((2.0, 1.5, 0.05)), material="wood"),
    cs.Body(cs.Capsule(0.03, 3.0), material="human", grounding=100e-12),
    cs.Body(cs.Cylinder(0.04, 1.2), material="steel", grounding="floating"),
]


def long_poses():
    """Poses of bodies that reach far out of a sensor's box, more so from one to the next."""
    where = np.zeros((3, 3, 7))
    where[:, 1:, 3:] = [0, 0.5**0.5, 0, 0.5**0.5]
    where[:, 0, 6] = 1.0
    for k in range(3):
        where[k, :, :3] = [0.3 * k, 0.1 * k, 0.15], [0.4 * k, -0.06, 0.05], [0.2 * k, 0.06, 0.07]
    return where, frames(np.random.default_rng(8), 3, 1)


def scene(bodies, where, frame):
    seen = cs.Pose(frame[:3], frame[3:]).inverse()
    return cs.Scene(
        b.moved(seen @ cs.Pose(p[:3], p[3:])) for b, p in zip(bodies, where, strict=True) if b
    )
