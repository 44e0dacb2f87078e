"""Potentials and gradients of uniformly charged polygons, in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from approximate import approx
from field_cases import sheet
from scipy.integrate import dblquad
from scipy.spatial.transform import Rotation

from capsense.design.geometry import Facet
from capsense.field import bem_kernels as kernels
from capsense.field.panels import Grading, Panels, concatenate, cut_facet, make_panels
from capsense.field.polygon_kernels import polygon_gradient, polygon_potential, solid_angle

UP = np.array([0.0, 0.0, 1.0])


def loop(points: list[tuple[float, float]], z: float = 0.0) -> np.ndarray:
    """Edges of a closed outline in the plane z, shape (k, 2, 3)."""
    p = np.array([(x, y, z) for x, y in points])
    return np.stack([p, np.roll(p, -1, axis=0)], axis=1)


def square(a: float) -> np.ndarray:
    return loop([(-a / 2, -a / 2), (a / 2, -a / 2), (a / 2, a / 2), (-a / 2, a / 2)])


def gradient(edges: np.ndarray, x: float, y: float, z: float) -> np.ndarray:
    out = np.empty(3)
    polygon_gradient(edges, UP, x, y, z, out)
    return out


@pytest.mark.parametrize("z", [0.0, 1e-6, 0.003, 0.02, 0.5, -0.02])
def test_square_on_its_axis(z):
    """Analytic: 8 [s asinh(s / √(s² + z²)) − |z|/2 · atan(s² / (|z| √(2s² + z²)))], s = a/2."""
    a = 0.04
    s, h = a / 2, abs(z)
    angle = math.atan2(s * s, h * math.sqrt(2 * s * s + h * h))
    expected = 4 * (2 * s * math.asinh(s / math.sqrt(s * s + h * h)) - h * angle)
    got = polygon_potential(square(a), UP, 0.0, 0.0, z)
    assert got == approx(expected, rel=1e-9)
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
        got = polygon_potential(edges, UP, 0.0, 0.0, z)
        assert got == approx(expected, rel=2e-5)
        if z:
            slope = 2 * math.pi * (z / math.hypot(radius, z) - 1)
            assert gradient(edges, 0.0, 0.0, z)[2] == approx(slope, rel=1e-4)


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
    assert polygon_potential(edges, UP, x, y, z) == approx(expected, rel=1e-7)
    slopes = [integrand(3, lambda d, k=k: -d[k]) for k in range(3)]
    np.testing.assert_allclose(gradient(edges, x, y, z), slopes, rtol=1e-6, atol=1e-9)


QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
TURNS = [
    QUARTER,
    np.eye(3)[[2, 0, 1]],
    *Rotation.random(4, random_state=np.random.default_rng(3)).as_matrix(),
]


@pytest.mark.parametrize("turn", TURNS, ids=["upright", "aside", *"abcd"])
def test_polygons_turned_and_moved_with_their_points(turn):
    """Invariant: same potential and solid angle, and the gradient turns with them."""
    flat = loop([(0.0, 0.0), (0.03, 0.0), (0.025, 0.02), (0.0, 0.01)])
    shift, normal = np.array([0.05, -0.02, 0.07]), turn @ UP
    edges = flat @ turn.T + shift
    for point in ((0.012, 0.006, 0.004), (0.05, -0.01, -0.02), (-0.01, 0.03, 0.0)):
        moved, out = turn @ point + shift, np.empty(3)
        expected = polygon_potential(flat, UP, *point)
        assert polygon_potential(edges, normal, *moved) == approx(expected, rel=1e-9)
        polygon_gradient(edges, normal, *moved, out)
        np.testing.assert_allclose(out, turn @ gradient(flat, *point), rtol=0, atol=1e-9)
        angles = solid_angle(edges, normal, *moved), solid_angle(flat, UP, *point)
        assert angles[0] == approx(angles[1], abs=1e-9)


def test_holes_subtract():
    """Invariant: a frame is the square less its hole."""
    hole = square(0.01)[::-1, ::-1]
    frame = np.concatenate([square(0.04), hole])
    for point in ((0.0, 0.0, 0.0), (0.012, 0.003, 0.002), (0.05, -0.01, 0.01)):
        whole = polygon_potential(square(0.04), UP, *point)
        inner = polygon_potential(square(0.01), UP, *point)
        got = polygon_potential(frame, UP, *point)
        assert got == approx(whole - inner, rel=1e-10)


def test_potential_is_continuous_and_its_normal_slope_jumps_by_4_pi():
    """Analytic: ∂φ/∂n falls by 4π across a sheet of density 1; the principal value is zero."""
    edges = loop([(0.0, 0.0), (0.03, 0.0), (0.025, 0.02), (0.0, 0.01)])
    x, y = 0.012, 0.006
    above, on, below = (polygon_potential(edges, UP, x, y, z) for z in (1e-9, 0.0, -1e-9))
    assert above == approx(on, rel=1e-6)
    assert below == approx(on, rel=1e-6)
    jump = gradient(edges, x, y, 1e-7)[2] - gradient(edges, x, y, -1e-7)[2]
    assert jump == approx(-4 * math.pi, rel=1e-4)
    assert gradient(edges, x, y, 0.0)[2] == 0.0
    outside = gradient(edges, 0.1, 0.1, 1e-9)
    assert abs(outside[2]) < 1e-6


@pytest.mark.parametrize("point", [(0.0, 0.0), (0.02, 0.02), (0.02, 0.005), (0.06, 0.02)])
def test_points_on_edges_and_corners_are_finite(point):
    """Invariant: corners, edges and lines through them give the limit, not NaN."""
    edges = square(0.04)
    got = polygon_potential(edges, UP, *point, 0.0)
    near = polygon_potential(edges, UP, point[0] - 1e-9, point[1] - 2e-9, 0.0)
    assert np.isfinite(got)
    assert got == approx(near, rel=1e-5)
    assert np.isfinite(gradient(edges, *point, 0.0)).all()


@pytest.mark.parametrize("gap", [1e-5, 1e-7, 1e-9])
def test_potential_close_to_an_edge(gap):
    """Analytic: of a square by the corner sums of its four parts, in forms without cancellation.

    A rectangle from its corner, at height z above it: a asinh(b / √(a² + z²)) + b asinh(a /
    √(b² + z²)) − z atan(a b / (z √(a² + b² + z²))).
    """
    side, z = 0.004, 0.7 * gap

    def corner(a: float, b: float) -> float:
        out = a * math.asinh(b / math.hypot(a, z)) + b * math.asinh(a / math.hypot(b, z))
        return out - z * math.atan(a * b / (z * math.sqrt(a * a + b * b + z * z)))

    x, y = 0.5 * side + gap, 0.3 * side
    left, low, high = gap, 0.5 * side - y, 0.5 * side + y
    expected = sum(corner(side + left, t) - corner(left, t) for t in (low, high))
    assert polygon_potential(square(side), UP, x, y, z) == approx(expected, rel=1e-13)


def test_quadrature_of_far_panels_matches_the_closed_form():
    """Measured: beyond two diameters the three-point rule is right to 3e-4 of the potential."""
    polygon = shapely.box(0.0, 0.0, 0.004, 0.004)
    facet = Facet(polygon, np.zeros(3), np.eye(3))
    panels = make_panels(facet, cut_facet(facet, sheet(polygon).rims[:0], Grading(1e-3)))
    assert panels.size == 1
    reach = kernels._NEAR * panels.diameters[0]
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = panels.centers[0] + 1.001 * reach * directions
    got = kernels.potential_matrix(points, -1e3, panels)[:, 0]
    exact = [polygon_potential(panels.edges, UP, *p) for p in points]
    np.testing.assert_allclose(got, exact, rtol=3e-4)


def test_images_hold_the_floor_at_zero():
    """Analytic: with its image a panel leaves no potential on the floor."""
    polygon = shapely.box(-0.01, -0.01, 0.01, 0.01)
    facet = Facet(polygon, np.array([0.0, 0.0, 0.01]), np.eye(3))
    panels = make_panels(facet, cut_facet(facet, sheet(polygon).rims[:0], Grading(1e-3)))
    points = np.array([[0.0, 0.0, -0.02], [0.03, 0.01, -0.02], [0.0, 0.0, 0.02]])
    got = kernels.potential_matrix(points, -0.02, panels).sum(axis=1)
    np.testing.assert_allclose(got[:2], 0.0, atol=1e-15)
    assert got[2] > 0.005


FLOOR = -0.011
MIRROR = np.array([1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def panels() -> Panels:
    """Some thirty panels that touch, face and cross each other's planes, one right on the floor."""
    turned = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    skew = np.array([[2.0, 1.0, 2.0], [-2.0, 2.0, 1.0], [-1.0, -2.0, 2.0]]) / 3
    corner = shapely.Polygon([(0.0, 0.0), (0.03, 0.0), (0.03, 0.01), (0.01, 0.02), (0.0, 0.02)])
    facets = [
        Facet(shapely.box(-0.01, -0.01, 0.01, 0.01), np.array([0.002, 0.001, 0.003]), np.eye(3)),
        Facet(shapely.box(0.0, 0.0, 0.02, 0.01), np.array([0.0, 0.0, FLOOR + 1e-4]), np.eye(3)),
        Facet(corner, np.array([0.015, -0.02, 0.004]), turned),
        Facet(corner, np.array([0.07, 0.05, 0.02]), skew),
    ]
    return concatenate(
        [make_panels(f, cut_facet(f, np.empty((0, 2, 3)), Grading(1e-3))) for f in facets]
    )


def mirrored(r: np.ndarray) -> np.ndarray:
    return r * MIRROR + [0.0, 0.0, 2 * FLOOR]


def near(p: Panels, j: int, r: np.ndarray) -> bool:
    return bool(np.linalg.norm(r - p.centers[j]) < kernels._NEAR * p.diameters[j])


def shape_of(p: Panels, j: int) -> tuple[np.ndarray, np.ndarray]:
    return p.edges[p.first[j] : p.first[j + 1]], p.normals[j]


def by_moments(p: Panels, j: int, r: np.ndarray) -> tuple[float, np.ndarray]:
    """Potential and gradient of a panel by its area and second moments."""
    w, off, arm = p.weights[j], p.quad[j] - p.centers[j], r - p.centers[j]
    second = (w[:, None, None] * off[:, :, None] * off[:, None, :]).sum(axis=0)
    form, trace, size = arm @ second @ arm, np.trace(second), float(np.linalg.norm(arm))
    potential = w.sum() / size + (3 * form - trace * size**2) / (2 * size**5)
    slope = -w.sum() * arm / size**3 + (3 * second @ arm - trace * arm) / size**5
    return potential, slope - 2.5 * (3 * form - trace * size**2) * arm / size**7


def is_far(p: Panels, j: int, i: int) -> bool:
    """Whether the middles of two panels are so far apart that moments do."""
    far = kernels._FAR * p.diameters[j], kernels._OUTER * (p.diameters[i] + p.diameters[j])
    return bool(np.linalg.norm(p.centers[i] - p.centers[j]) >= max(far))


def slow_potential(p: Panels, j: int, r: np.ndarray, far: bool = False) -> float:
    """Of unit charge density on a panel, and of its image; both by moments if it is far away."""

    def alone(r: np.ndarray) -> float:
        if far:
            return by_moments(p, j, r)[0]
        if near(p, j, r):
            return polygon_potential(*shape_of(p, j), *r)
        used = p.weights[j] > 0
        return (p.weights[j][used] / np.linalg.norm(r - p.quad[j][used], axis=1)).sum()

    return alone(r) - alone(mirrored(r))


def slow_gradient(p: Panels, j: int, r: np.ndarray, far: bool = False) -> np.ndarray:
    """Of a panel alone."""
    if far:
        return by_moments(p, j, r)[1]
    if near(p, j, r):
        out = np.empty(3)
        polygon_gradient(*shape_of(p, j), *r, out)
        return out
    used = p.weights[j] > 0
    arm = r - p.quad[j][used]
    return -(p.weights[j][used, None] * arm / np.linalg.norm(arm, axis=1)[:, None] ** 3).sum(axis=0)


def slow_slope(p: Panels, i: int, j: int, image: bool) -> float:
    """Mean over panel i of the normal gradient of panel j, or of its image."""
    middle = mirrored(p.centers[i]) if image else p.centers[i]
    close = np.linalg.norm(middle - p.centers[j]) < kernels._OUTER * (
        p.diameters[i] + p.diameters[j]
    )
    points, weights = (p.quad[i], p.weights[i]) if close else (p.centers[[i]], np.ones(1))
    far = is_far(p, j, i)
    slopes = [
        -p.normals[i] @ (MIRROR * slow_gradient(p, j, mirrored(r), far)) if image
        else p.normals[i] @ slow_gradient(p, j, r, far)
        for r in points
    ]  # fmt: skip
    return float(np.average(slopes, weights=weights))


def test_rows_of_conductors_against_slow_means(panels):
    """Differential: averaged over close panels, and over those closer to the floor than wide."""
    n = panels.size
    matrix = kernels.system_matrix(np.zeros(n, np.int64), np.zeros(n), FLOOR, panels)
    far = moments = 0
    for i in range(n):
        for j in range(n):
            apart = panels.centers[i] - panels.centers[j]
            reach = kernels._OUTER * (panels.diameters[i] + panels.diameters[j])
            low = panels.diameters[i] > panels.centers[i, 2] - FLOOR
            points, weights = panels.quad[i], panels.weights[i]
            by = False
            if np.linalg.norm(apart) >= reach and not (low and np.hypot(*apart[:2]) < reach):
                points, weights, far = panels.centers[[i]], np.ones(1), far + 1
                by = is_far(panels, j, i)
                moments += by
            found = [slow_potential(panels, j, r, by) for r in points]
            expected = np.average(found, weights=weights)
            assert matrix[i, j] == approx(expected, rel=1e-9, abs=1e-16)
    assert 0.05 < moments / n**2 < far / n**2 < 0.9


def test_moments_against_closed_forms(panels):
    """Analytic: potentials and gradients from four diameters on, of panels of all shapes here."""
    rng = np.random.default_rng(5)
    for j in range(panels.size):
        for away in (kernels._FAR, 8.0):
            arm = rng.normal(size=3)
            arm *= away * panels.diameters[j] / np.linalg.norm(arm)
            edges, normal = shape_of(panels, j)
            potential, slope = by_moments(panels, j, panels.centers[j] + arm)
            exact = np.empty(3)
            polygon_gradient(edges, normal, *(panels.centers[j] + arm), exact)
            truth = polygon_potential(edges, normal, *(panels.centers[j] + arm))
            bound = 2e-4 * (kernels._FAR / away) ** 3
            assert abs(potential - truth) < bound * truth
            assert np.linalg.norm(slope - exact) < 4 * bound * np.linalg.norm(exact)


def test_rows_of_interfaces_against_slow_means(panels):
    """Differential: fields of panels and images; 2π for a panel's own."""
    n = panels.size
    contrast = np.linspace(-0.9, 0.9, n)
    matrix = kernels.system_matrix(np.ones(n, np.int64), contrast, FLOOR, panels)
    slopes = kernels.normal_gradient_matrix(np.arange(n), FLOOR, panels)
    for i in range(n):
        for j in range(n):
            expected = slow_slope(panels, i, j, True)
            if i != j:
                expected += slow_slope(panels, i, j, False)
            assert slopes[i, j] == approx(expected, rel=1e-8, abs=1e-12)
    np.testing.assert_allclose(matrix, 2 * np.pi * np.eye(n) - contrast[:, None] * slopes)


def test_solid_angles_and_rows_of_parts(panels):
    """Differential: the normal part of the gradient; means over the panel that has the charge."""
    n = panels.size
    contrast = np.linspace(-0.9, 0.9, n)
    matrix = kernels.system_matrix(np.full(n, 2), contrast, FLOOR, panels)

    def angle(i: int, r: np.ndarray) -> float:
        edges, normal = shape_of(panels, i)
        out = np.empty(3)
        polygon_gradient(edges, normal, *r, out)
        off = abs(normal @ (r - edges[0, 0]))
        found = solid_angle(edges, normal, *r)
        assert found == approx(-normal @ out if off > 1e-12 else 0.0, abs=1e-9)
        return found

    for i in range(n):
        for j in range(n):
            used = panels.weights[j] > 0
            total = 0.0
            for w, r in zip(panels.weights[j][used], panels.quad[j][used], strict=True):
                total += w * ((angle(i, r) if i != j else 0.0) - angle(i, mirrored(r)))
            expected = 2 * np.pi * (i == j) - contrast[i] * total / panels.areas[i]
            assert matrix[i, j] == approx(expected, rel=1e-9, abs=1e-9)


def test_fluxes_of_point_charges(panels):
    """Differential: a point's field through a panel is the panel's at the point, turned round."""
    points = np.array([[0.0, 0.0, 0.01], [0.03, 0.01, 0.002], [0.2, -0.1, 0.3]])
    rows = np.array([0, 7, panels.size - 1])
    found = kernels.flux_matrix(points, rows, FLOOR, panels)
    for k, r in enumerate(points):
        for m, j in enumerate(rows):
            ways = slow_gradient(panels, j, r) - slow_gradient(panels, j, mirrored(r))
            assert found[k, m] == approx(-panels.normals[j] @ ways, rel=1e-9, abs=1e-13)
