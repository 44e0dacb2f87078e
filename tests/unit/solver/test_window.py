"""Long bodies cut to the part around the domain."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.solver.bodies.panels import windowed

LOW, HIGH = np.array([-0.25, -0.25, -0.01]), np.array([0.25, 0.25, 0.49])
REACH = float(np.linalg.norm(HIGH - LOW))


@pytest.mark.parametrize(
    "shape",
    [cs.Box((1.6, 0.8, 0.04)), cs.Box((200.0, 200.0, 10.0)), cs.Box((0.5, 0.5, 5.0)),
     cs.Cylinder(0.1, 5.0), cs.Capsule(0.1, 3.0)],
    ids=repr,
)  # fmt: skip
def test_the_part_is_the_whole_inside_the_domain(shape: cs.Shape) -> None:
    """Differential: the same points inside as of the whole, an end of it near or not."""
    rng = np.random.default_rng(3)
    half, met = np.ptp(shape.bounds(), axis=0) / 2, 0
    for _ in range(40):
        turn = cs.Pose((0, 0, 0), rng.normal(size=4))
        corner = rng.integers(-1, 2, 3) * half  # also of an edge, or of a face
        pose = cs.Pose(rng.uniform(LOW, HIGH)) @ turn @ cs.Pose(corner)
        part, at = windowed(shape, pose.inverse().apply([0.5 * (LOW + HIGH)])[0], REACH)
        assert np.ptp(part.bounds(), axis=0).max() <= REACH + 0.2 + 1e-9
        points = rng.uniform(LOW, HIGH, (500, 3))
        inside = shape.signed_distance(pose.inverse().apply(points)) < 0
        found = part.signed_distance(pose.inverse().apply(points) - at) < 0
        assert np.array_equal(found, inside)
        met += 0 < inside.sum() < 500
    assert met > 5


@pytest.mark.parametrize(
    "shape", [cs.Sphere(3.0), cs.Box((0.8, 0.5, 0.1)), cs.Capsule(1.0, 0.5)], ids=repr
)
def test_others_stay_whole(shape: cs.Shape) -> None:
    """Invariant: the very shape."""
    part, at = windowed(shape, np.array([0.3, 0.2, 0.1]), REACH)
    assert part is shape
    assert not at.any()
