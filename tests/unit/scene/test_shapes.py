"""Convex primitives: analytic values, invariants, refusals."""

import numpy as np
import pytest
from approximate import approx

from capsense.errors import SceneError
from capsense.scene import Box, Capsule, Cylinder, Ellipsoid, Sphere, TriMesh

SHAPES = [
    Box((0.10, 0.04, 0.02)),
    Sphere(0.05),
    Capsule(0.03, 0.12),
    Cylinder(0.04, 0.06),
    Ellipsoid((0.06, 0.03, 0.045)),
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)


def test_analytic_distances():
    """Analytic: values by hand, off faces, edges and corners, and inside."""
    cases = [
        (Box((2, 4, 6)), [(2, 0, 0), (4, 6, 3), (3, 4, 3), (0, 0, 0)], [1, 5, 8**0.5, -1]),
        (Sphere(1), [(0, 3, 4), (0, 0, 0)], [4, -1]),
        (Capsule(1, 2), [(3, 0, 0), (0, 3, 5), (0, 0, 2.5), (0, 0, 0)], [2, 4, 0.5, -1]),
        (Cylinder(1, 2), [(3, 0, 0), (4, 0, 5), (0, 0, 1.5), (0, 0, 0)], [2, 5, 0.5, -1]),
        (Ellipsoid((1, 2, 3)), [(3, 0, 0), (0, 0, 5), (0, 0, 0), (0, -3, 0)], [2, 2, -1, 1]),
        (Ellipsoid((2, 2, 2)), [(3, 4, 0), (0, 0, 0), (0.5, 0, 0)], [3, -2, -1.5]),
    ]
    for shape, points, expected in cases:
        np.testing.assert_allclose(shape.signed_distance(points), expected, atol=1e-8)


@pytest.mark.parametrize("radii", [(0.06, 0.03, 0.045), (0.2, 0.01, 0.01), (0.05, 0.05, 0.002)])
def test_ellipsoid_distance_is_exact(radii):
    """Differential: points set off a surface point along its normal, outside and inside."""
    shape = Ellipsoid(radii)
    rng = np.random.default_rng(3)
    r = np.array(radii)
    on = rng.normal(size=(5000, 3))
    on = r * on / np.linalg.norm(on, axis=1, keepdims=True)
    normal = on / r**2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The foot is unique up to the smallest radius of curvature inside, and everywhere outside.
    d = rng.uniform(-0.9 * r.min() ** 2 / r.max(), 0.2, 5000)
    found = shape.signed_distance(on + d[:, None] * normal)
    np.testing.assert_allclose(found, d, atol=3e-9 * r.min(), rtol=1e-9)


@shapes
def test_bounds_volume_and_surface_mesh(shape):
    """Differential: the drawn mesh has the shape's box and volume, and lies on its surface."""
    mesh = shape.to_trimesh()
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, shape.bounds(), atol=2e-4)
    assert mesh.volume == approx(shape.volume, rel=6e-3)
    assert np.abs(shape.signed_distance(mesh.vertices)).max() < 1e-9


@pytest.mark.parametrize("scale", [1e-3, 0.1, 1.5])
def test_surface_meshes_of_any_size_are_closed(scale):
    """Small ones too: every kind, as a solid of triangles of the same volume."""
    kinds = (
        Box((scale, 2 * scale, scale)), Sphere(scale), Capsule(scale, 4 * scale),
        Cylinder(scale, 2 * scale), Ellipsoid((scale, 2 * scale, 3 * scale)),
    )  # fmt: skip
    for shape in kinds:
        mesh = shape.to_trimesh()
        assert TriMesh(mesh.vertices, mesh.faces).volume == approx(shape.volume, rel=6e-3)


@shapes
def test_distance_is_one_lipschitz(shape):
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-0.15, 0.15, (2, 5000, 3))
    change = np.abs(shape.signed_distance(a) - shape.signed_distance(b))
    assert np.all(change <= np.linalg.norm(a - b, axis=1) + 1e-12)


def test_shapes_are_values():
    assert Box((1, 2, 3)) == Box(np.array([1.0, 2.0, 3.0]))
    assert len({Sphere(1), Sphere(1.0), Sphere(2)}) == 2
    with pytest.raises(AttributeError):
        Sphere(1).radius = 2
    with pytest.raises(ValueError, match="read-only"):
        Sphere(1).params[0] = 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Box((1, 2)), "Box: size has 2 entries"),
        (lambda: Box(0.1), "three lengths"),
        (lambda: Box((1, 2, 0)), "above zero"),
        (lambda: Box((1, 2, np.nan)), "not finite"),
        (lambda: Sphere(-1), "radius is -1 m"),
        (lambda: Sphere("x"), "one length"),
        (lambda: Sphere(np.inf), "not finite"),
        (lambda: Capsule(0.1, 0), "Capsule: length is 0 m"),
        (lambda: Cylinder(0, 1), "Cylinder: radius is 0 m"),
        (lambda: Ellipsoid((1, -2, 3)), "above zero"),
        (lambda: Sphere(1).signed_distance((0, 0, 0)), "give \\(n, 3\\)"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(SceneError, match=words):
        make()
