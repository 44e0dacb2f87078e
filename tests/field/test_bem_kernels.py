"""Potentials and gradients of uniformly charged polygons, in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from field_cases import sheet
from scipy.integrate import dblquad

from capsense.design.geometry import Facet
from capsense.field import bem_kernels as kernels
from capsense.field.panels import Grading, cut_facet, make_panels

UP = np.array([0.0, 0.0, 1.0])


def loop(points: list[tuple[float, float]], z: float = 0.0) -> np.ndarray:
    """Edges of a closed outline in the plane z, shape (k, 2, 3)."""
    p = np.array([(x, y, z) for x, y in points])
    return np.stack([p, np.roll(p, -1, axis=0)], axis=1)


def square(a: float) -> np.ndarray:
    return loop([(-a / 2, -a / 2), (a / 2, -a / 2), (a / 2, a / 2), (-a / 2, a / 2)])


def gradient(edges: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    out = np.empty(3)
    kernels.polygon_gradient(edges, UP, x, y, z, out)
    return out


@pytest.mark.parametrize("z", [0.0, 1e-6, 0.003, 0.02, 0.5, -0.02])
def test_square_on_its_axis(z):
    """Analytic: 8 [s asinh(s / √(s² + z²)) − |z|/2 · atan(s² / (|z| √(2s² + z²)))], s = a/2."""
    a = 0.04
    s, h = a / 2, abs(z)
    angle = math.atan2(s * s, h * math.sqrt(2 * s * s + h * h))
    expected = 4 * (2 * s * math.asinh(s / math.sqrt(s * s + h * h)) - h * angle)
    got = kernels.polygon_potential(square(a), UP, 0.0, 0.0, z)
    assert got == pytest.approx(expected, rel=1e-9)
    if z:
        slope = -4 * math.copysign(angle, z)
        np.testing.assert_allclose(gradient(square(a), 0.0, 0.0, z), [0, 0, slope], atol=1e-9)


def test_disc_on_its_axis():
    """Analytic: 2π (√(R² + z²) − |z|); a polygon of n sides of equal area is off by O(1/n²)."""
    n, radius = 400, 0.02
    outer = radius * math.sqrt(2 * math.pi / n / math.sin(2 * math.pi / n))
    angles = 2 * math.pi * np.arange(n) / n
    edges = loop([(outer * math.cos(t), outer * math.sin(t)) for t in angles])
    for z in (0.0, 0.001, 0.02, 0.1):
        expected = 2 * math.pi * (math.hypot(radius, z) - z)
        got = kernels.polygon_potential(edges, UP, 0.0, 0.0, z)
        assert got == pytest.approx(expected, rel=2e-5)
        if z:
            slope = 2 * math.pi * (z / math.hypot(radius, z) - 1)
            assert gradient(edges, 0.0, 0.0, z)[2] == pytest.approx(slope, rel=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_triangle_by_numerical_quadrature(seed):
    """Differential: potential and gradient of a random triangle at a point off its plane."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.02, 0.02, (3, 2))
    if np.linalg.det(corners[1:] - corners[0]) < 0:
        corners = corners[::-1]
    x, y = rng.uniform(-0.03, 0.03, 2)
    z = rng.uniform(0.005, 0.03) * rng.choice([-1.0, 1.0])
    u, v = corners[1] - corners[0], corners[2] - corners[0]
    area2 = abs(np.linalg.det([u, v]))

    def integrand(power: int, weight):
        def f(t: float, s: float) -> float:
            p = corners[0] + s * u + t * (1 - s) * v
            d = np.array([x - p[0], y - p[1], z])
            return area2 * (1 - s) * weight(d) / np.linalg.norm(d) ** power

        return dblquad(f, 0, 1, 0, 1, epsabs=1e-12, epsrel=1e-9)[0]

    edges = loop([tuple(c) for c in corners])
    expected = integrand(1, lambda d: 1.0)
    assert kernels.polygon_potential(edges, UP, x, y, z) == pytest.approx(expected, rel=1e-7)
    slopes = [integrand(3, lambda d, k=k: -d[k]) for k in range(3)]
    np.testing.assert_allclose(gradient(edges, x, y, z), slopes, rtol=1e-6, atol=1e-9)


def test_holes_subtract():
    """Invariant: a frame is the square less its hole."""
    hole = square(0.01)[::-1, ::-1]
    frame = np.concatenate([square(0.04), hole])
    for point in ((0.0, 0.0, 0.0), (0.012, 0.003, 0.002), (0.05, -0.01, 0.01)):
        whole = kernels.polygon_potential(square(0.04), UP, *point)
        inner = kernels.polygon_potential(square(0.01), UP, *point)
        got = kernels.polygon_potential(frame, UP, *point)
        assert got == pytest.approx(whole - inner, rel=1e-10)


def test_potential_is_continuous_and_its_normal_slope_jumps_by_4_pi():
    """Analytic: ∂φ/∂n falls by 4π across a sheet of density 1; the principal value is zero."""
    edges = loop([(0.0, 0.0), (0.03, 0.0), (0.025, 0.02), (0.0, 0.01)])
    x, y = 0.012, 0.006
    above, on, below = (kernels.polygon_potential(edges, UP, x, y, z) for z in (1e-9, 0.0, -1e-9))
    assert above == pytest.approx(on, rel=1e-6)
    assert below == pytest.approx(on, rel=1e-6)
    jump = gradient(edges, x, y, 1e-7)[2] - gradient(edges, x, y, -1e-7)[2]
    assert jump == pytest.approx(-4 * math.pi, rel=1e-4)
    assert gradient(edges, x, y, 0.0)[2] == 0.0
    outside = gradient(edges, 0.1, 0.1, 1e-9)
    assert abs(outside[2]) < 1e-6


@pytest.mark.parametrize("point", [(0.0, 0.0), (0.02, 0.02), (0.02, 0.005), (0.06, 0.02)])
def test_points_on_edges_and_corners_are_finite(point):
    """Invariant: corners, edges and lines through them give the limit, not NaN."""
    edges = square(0.04)
    got = kernels.polygon_potential(edges, UP, *point, 0.0)
    near = kernels.polygon_potential(edges, UP, point[0] - 1e-9, point[1] - 2e-9, 0.0)
    assert np.isfinite(got)
    assert got == pytest.approx(near, rel=1e-5)
    assert np.isfinite(gradient(edges, *point, 0.0)).all()


def test_quadrature_of_far_panels_matches_the_closed_form():
    """Measured: beyond two diameters the three-point rule is right to 3e-4 of the potential."""
    polygon = shapely.box(0.0, 0.0, 0.004, 0.004)
    facet = Facet(polygon, np.zeros(3), np.eye(3))
    panels = make_panels(facet, cut_facet(facet, sheet(polygon).rims[:0], Grading(1e-3)))
    assert len(panels) == 1
    reach = kernels._NEAR * panels.diameters[0]
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = panels.centers[0] + 1.001 * reach * directions
    got = kernels.potential_matrix(points, -1e3, panels.polygons)[:, 0]
    exact = [kernels.polygon_potential(panels.edges, UP, *p) for p in points]
    np.testing.assert_allclose(got, exact, rtol=3e-4)


def test_images_hold_the_floor_at_zero():
    """Analytic: with its image a panel leaves no potential on the floor."""
    polygon = shapely.box(-0.01, -0.01, 0.01, 0.01)
    facet = Facet(polygon, np.array([0.0, 0.0, 0.01]), np.eye(3))
    panels = make_panels(facet, cut_facet(facet, sheet(polygon).rims[:0], Grading(1e-3)))
    points = np.array([[0.0, 0.0, -0.02], [0.03, 0.01, -0.02], [0.0, 0.0, 0.02]])
    got = kernels.potential_matrix(points, -0.02, panels.polygons).sum(axis=1)
    np.testing.assert_allclose(got[:2], 0.0, atol=1e-15)
    assert got[2] > 0.005
