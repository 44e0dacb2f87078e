"""Clouds of points as surfaces, and the points of a perspective camera."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError


def plane(n: int = 12, pitch: float = 0.005, z: float = 0.03) -> np.ndarray:
    """A square grid of points."""
    line = pitch * (np.arange(n) - (n - 1) / 2)
    x, y = np.meshgrid(line, line)
    return np.column_stack([x.ravel(), y.ravel(), np.full(n * n, z)])


def sphere(n: int = 600) -> np.ndarray:
    """Unit vectors, spread evenly (Fibonacci)."""
    z = 1 - (2 * np.arange(n) + 1) / n
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle), z])


def frames(surface: cs.Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, unit normals and side lengths of the pieces."""
    corners = surface.vertices[surface.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sides = np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2)
    return corners.mean(axis=1), cross / np.linalg.norm(cross, axis=1)[:, None], sides


def test_a_piece_at_every_point() -> None:
    """Analytic: centres, inclination; second moments side²/24 of a square of π d²/8."""
    points = plane()
    normals = np.tile([0.6, 0.0, -2.0], (len(points), 1))
    centres, found, sides = frames(cs.point_surface(points, normals))
    np.testing.assert_allclose(centres, points, atol=1e-15)
    np.testing.assert_allclose(found, normals / np.linalg.norm(normals[0]), atol=1e-12)
    inner = np.abs(points[:, :2]).max(axis=1) < 0.02
    d = 0.005 * np.sqrt(2)
    np.testing.assert_allclose(sides[inner] ** 2 / 24, np.pi * d**2 / 8 / 12, rtol=1e-9)


def test_normals_of_their_own() -> None:
    """Analytic: those of a plane and, to 3°, of a ball; towards the sensor's origin."""
    _, found, _ = frames(cs.point_surface(plane()))
    np.testing.assert_allclose(found, np.tile([0, 0, -1.0], (144, 1)), atol=1e-12)
    out = sphere()
    points = 0.04 * out + [0, 0, 0.1]
    _, found, _ = frames(cs.point_surface(points))
    assert np.abs((found * out).sum(axis=1)).min() > np.cos(np.radians(3))
    assert ((found * points).sum(axis=1) < 0).all()


@pytest.mark.parametrize("cells", [(12, 2, 3), (3, 12, 2), (2, 3, 12)])
def test_merging_cell_by_cell(cells: tuple[int, int, int]) -> None:
    """Differential: means over cells of a grid that are told apart one by one."""
    points = np.random.default_rng(1).uniform(-0.01, 0.01 * np.array(cells) - 0.01, (900, 3))
    wanted: dict[tuple[float, ...], list[np.ndarray]] = {}
    for point in points:
        wanted.setdefault(tuple(np.floor(point / 0.01)), []).append(point)
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    found = frames(cs.point_surface(points, normals, spacing=0.01))[0]
    expected = np.array([np.mean(group, axis=0) for group in wanted.values()])
    assert len(found) == len(expected) == np.prod(cells)
    found, expected = (x[np.lexsort(np.floor(x / 0.01).T)] for x in (found, expected))
    np.testing.assert_allclose(found, expected, atol=1e-14)


def test_merging() -> None:
    """Invariant: one point a cell, in the middle of its points, with the mean of their normals."""
    first = plane(z=0.031) + np.array([0.001, 0.001, 0])
    points = np.concatenate([first, first + np.array([0.001, 0, 0.001])])
    normals = np.repeat([[0, 0, 1.0], [3.0, 0, 0]], 144, axis=0)
    centres, found, _ = frames(cs.point_surface(points, normals, spacing=0.005))
    assert len(centres) == 144
    np.testing.assert_allclose(
        found, np.tile([np.sqrt(0.5), 0, np.sqrt(0.5)], (144, 1)), atol=1e-12
    )
    expected = first + np.array([0.0005, 0, 0.0005])
    np.testing.assert_allclose(np.sort(centres, axis=0), np.sort(expected, axis=0), atol=1e-12)


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (plane(3), {}, "there are 9 points; give 16 to 50,000"),
        (plane(224), {}, "spacing=0.005"),
        (plane()[:, :2], {}, "give \\(n, 3\\)"),
        (np.where(plane() == 0.03, np.nan, plane()), {}, r"points\[0\] is .*finite"),
        (plane(), {"normals": plane(4)}, r"normals have shape \(16, 3\), but points \(144, 3\)"),
        (plane(), {"normals": 0 * plane()}, "normal of point 0 has no length"),
        (plane(), {"spacing": 0}, "spacing is 0"),
    ],
)  # fmt: skip
def test_refusals(points: np.ndarray, options: dict, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        cs.point_surface(points, **options)


def test_points_of_a_pinhole_camera() -> None:
    """Analytic: OpenCV's model, in an asymmetric pose; air is left out."""
    pose = cs.Pose.from_euler((0.1, 0.2, 0.3), (10, 20, 30), degrees=True)
    camera = cs.PerspectiveCamera(50, 60, 3.5, 2.0, pose, near=0.05, far=0.4)
    depth = np.full((5, 8), np.nan)
    depth[1, 7], depth[4, 0] = 0.2, 0.3
    depth[0] = [0.05, 0.4, 0, -1, np.inf, -np.inf, np.nan, 9]
    local = [[3.5 / 50 * 0.2, -1 / 60 * 0.2, 0.2], [-3.5 / 50 * 0.3, 2 / 60 * 0.3, 0.3]]
    np.testing.assert_allclose(camera.points(depth), pose.apply(local), atol=1e-15)


def test_opengl_camera() -> None:
    """Analytic: at 90° the rim of the image is as far off as deep; the top row is up."""
    camera = cs.PerspectiveCamera.opengl(np.pi / 2, (4, 6), cs.Pose())
    depth = np.full((4, 6), np.nan)
    depth[0, 5] = 0.2
    (point,) = camera.points(depth)
    np.testing.assert_allclose(point, [0.2 * 2.5 / 2, 0.2 * 1.5 / 2, -0.2], atol=1e-15)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0, 1, 0, 0), "fx is 0; give a finite number above zero"),
        ((1, 1, np.nan, 0), "cx is nan"),
        ((1, 1, 0, "a"), "cy is 'a'"),
        ((1, 1, 0, 0, cs.Pose(), 0.5, 0.5), "must exceed near"),
        ((1, 1, 0, 0, None), "give a Pose"),
    ],
)
def test_wrong_cameras(values: tuple, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        cs.PerspectiveCamera(*values)
    with pytest.raises(SceneError, match="fovy"):
        cs.PerspectiveCamera.opengl(90, (4, 4), cs.Pose())
    with pytest.raises(SceneError, match=r"give \(rows, columns\)"):
        cs.PerspectiveCamera(1, 1, 0, 0).points(np.ones(4))
