"""Where bodies come closest to a line, and how slender they are."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.scene.approach_kernels import approach, slenderness

SHAPES = {
    "box": (cs.Box((0.03, 0.002, 0.05)), 0.03),
    "cube": (cs.Box((0.04, 0.04, 0.04)), 0.04),
    "sphere": (cs.Sphere(0.02), 0.04),
    "capsule": (cs.Capsule(0.004, 0.08), 0.008),
    "rod": (cs.Cylinder(0.001, 0.1), 0.002),
    "disc": (cs.Cylinder(0.05, 0.002), 0.1),
    "ellipsoid": (cs.Ellipsoid((0.03, 0.02, 0.04)), 0.06),
}
FARTHER = {"ellipsoid": 0.004, "disc": 0.002}
"""How much farther off than the closest point the one found may be [m]."""


def random_pose(rng: np.random.Generator) -> cs.Pose:
    return cs.Pose(rng.uniform(-0.05, 0.05, 3), rng.normal(size=4))


def points_inside(rng: np.random.Generator, body: cs.Body, count: int = 40_000) -> np.ndarray:
    """Random points of a body, in the sensor frame."""
    local = rng.uniform(-0.06, 0.06, (count, 3))
    size = np.array([0.0015, 0.0015, 1.0]) if "0.001" in repr(body.shape) else np.ones(3)
    local *= size
    return body.pose.apply(local[body.shape.signed_distance(local) <= 0])


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("seed", range(12))
def test_the_point_lies_inside_and_nothing_is_closer(name, seed):
    rng = np.random.default_rng(seed)
    body = cs.Body(SHAPES[name][0], random_pose(rng))
    packed = cs.Scene([body]).pack()
    axis = seed % 3
    line = rng.uniform(-0.08, 0.08, 3)
    found = np.array(
        approach(packed.kinds[0], packed.params[0], packed.rotation[0], packed.position[0],
                 *line.tolist(), axis)
    )  # fmt: skip
    local = body.pose.inverse().apply(found[None])
    assert body.shape.signed_distance(local)[0] <= 1e-9
    across = [a for a in range(3) if a != axis]
    distance = float(np.linalg.norm((found - line)[across]))
    others = np.linalg.norm((points_inside(rng, body) - line)[:, across], axis=1)
    slack = FARTHER.get(name, 2e-4) + 0.002 * 0.05
    assert distance <= others.min() + slack


@pytest.mark.parametrize("name", SHAPES)
def test_slenderness_is_the_middle_extent(name):
    shape, expected = SHAPES[name]
    packed = cs.Scene([cs.Body(shape)]).pack()
    assert slenderness(packed.kinds[0], packed.params[0]) == pytest.approx(expected)


def test_a_mesh_is_never_slender():
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]) * 0.01
    mesh = cs.TriMesh(corners, [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
    packed = cs.Scene([cs.Body(mesh)]).pack()
    assert slenderness(packed.kinds[0], packed.params[0]) == np.inf
