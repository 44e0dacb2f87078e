"""Point clouds before a sensor read as the shapes they were taken from."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs

RADIUS = 0.04


def scan(centre: tuple[float, float, float], n: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    """Points on a ball, spread evenly, and their normals."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    out = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
    return RADIUS * out + centre, out


@pytest.mark.parametrize(
    ("grounding", "gap"), [("grounded", 0.01), ("floating", 0.02), (1e-12, 0.02)]
)
@pytest.mark.parametrize("known", [True, False])
def test_a_scan_of_a_ball(simulators, grounding, gap, known):
    """Measured: 5 mm between points, 3 % of the largest entry; without normals as with them."""
    sim = simulators("six_patch")
    centre = (0.01, -0.02, RADIUS + gap)
    points, normals = scan(centre)
    plain = sim.step(
        cs.Scene([cs.Body(cs.Sphere(RADIUS), cs.Pose(centre), grounding=grounding)])
    ).delta
    cloud = cs.point_surface(points, normals if known else None, spacing=0.005)
    delta = sim.step(cs.Scene([cs.Body(cloud, grounding=grounding)])).delta
    np.testing.assert_allclose(delta, plain, rtol=0, atol=0.03 * np.abs(plain).max())


def test_a_camera_behind_the_sensor(simulators):
    """Measured: its image of 64 × 64 pixels, 2 % of the largest entry for a grounded ball."""
    sim = simulators("six_patch")
    centre = np.array([0.01, -0.02, RADIUS + 0.01])
    camera = cs.PerspectiveCamera(32, 32, 31.5, 31.5, cs.Pose((0, 0, -0.15)), far=0.65)
    row, column = np.indices((64, 64))
    ray = np.stack([(column - 31.5) / 32, (row - 31.5) / 32, np.ones((64, 64))], axis=-1)
    to_centre = centre - camera.pose.position
    a, b = (ray * ray).sum(axis=-1), ray @ to_centre
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(b * b - a * (to_centre @ to_centre - RADIUS**2))) / a
    points = camera.points(depth)
    np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), RADIUS)
    plain = sim.step(cs.Scene([cs.Body(cs.Sphere(RADIUS), cs.Pose(centre))])).delta
    delta = sim.step(cs.Scene([cs.Body(cs.point_surface(points))])).delta
    np.testing.assert_allclose(delta, plain, rtol=0, atol=0.02 * np.abs(plain).max())
