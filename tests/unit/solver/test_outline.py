"""Nearest points of outlines: against exact distances of shapes, and against many points."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense.scene.pose import Pose
from capsense.solver.bodies.outline import middle_height, nearest, reach_down, write_outline
from capsense.solver.tree.rigid import BODY

_BLOCK = trimesh.creation.box((0.03, 0.02, 0.01)).subdivide()
SHAPES = {
    "box": cs.Box((0.03, 0.02, 0.01)),
    "sphere": cs.Sphere(0.01),
    "capsule": cs.Capsule(0.005, 0.03),
    "cylinder": cs.Cylinder(0.01, 0.02),
    "ellipsoid": cs.Ellipsoid((0.012, 0.007, 0.004)),
    "mesh": cs.TriMesh(np.asarray(_BLOCK.vertices), np.asarray(_BLOCK.faces)),
}


def _placed(shape: cs.Shape, random: np.random.Generator) -> tuple[np.ndarray, Pose]:
    turn = random.normal(size=4)
    pose = Pose(tuple(random.normal(size=3) * 0.01), tuple(turn / np.linalg.norm(turn)))
    record = np.zeros(1, BODY)
    write_outline(record[0], shape)
    record["scale"], record["position"], record["rotation"] = 1.0, pose.position, pose.rotation
    return record, pose


@pytest.mark.parametrize("name", SHAPES)
def test_distances_are_those_of_the_shape(name):
    random, shape = np.random.default_rng(3), SHAPES[name]
    out, room = np.empty(9), np.empty(140)
    for _ in range(20):
        record, pose = _placed(shape, random)
        points = pose.apply(random.normal(size=(40, 3)) * 0.015)
        exact = shape.signed_distance(pose.inverse().apply(points))
        for point, distance in zip(points, exact, strict=True):
            found, faces = nearest(record[0], *point, out, room)
            assert found == approx(distance, abs=1e-8)
            assert np.linalg.norm(out[:3] - point) == approx(abs(distance), abs=1e-8)
            on = shape.signed_distance(pose.inverse().apply(out[None, :3]))[0]
            assert on == approx(0.0, abs=1e-8)
            if faces == 1 and distance > 1e-6:  # a face is met along its normal
                way = (point - out[:3]) / distance
                np.testing.assert_allclose(out[3:6], way, atol=1e-6)


@pytest.mark.parametrize("name", SHAPES)
def test_lowest_points_bound_the_shape(name):
    random, shape = np.random.default_rng(4), SHAPES[name]
    points = np.asarray(trimesh.sample.sample_surface(shape.to_trimesh(), 4000, seed=1)[0])
    for _ in range(20):
        record, pose = _placed(shape, random)
        low = middle_height(record[0]) - reach_down(record[0])
        lowest = pose.apply(points)[:, 2].min()
        assert low <= lowest + 2e-5
        if name not in ("mesh",):  # of meshes, a box around them counts
            assert low == approx(lowest, abs=6e-4)


def test_edges_and_faces_of_a_box():
    record = np.zeros(1, BODY)
    write_outline(record[0], cs.Box((0.02, 0.02, 0.02)))
    record["scale"], record["rotation"] = 1.0, np.eye(3)
    out, room = np.empty(9), np.empty(140)
    assert nearest(record[0], 0.0, 0.0, 0.03, out, room) == (approx(0.02), 1)
    np.testing.assert_allclose(out[:6], [0, 0, 0.01, 0, 0, 1])
    assert nearest(record[0], 0.0, 0.02, 0.02, out, room)[1] == 2
    np.testing.assert_allclose(out[3:], [0, 1, 0, 0, 0, 1])
    assert nearest(record[0], 0.02, 0.02, 0.02, out, room)[1] == 0
