"""Blocks of bodies alone in space against closed forms and the slow reference."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
from approximate import approx
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from capsense.errors import SceneError
from capsense.field.polygon_kernels import polygon_potential, solid_angle
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere
from capsense.solver.bodies import panel_kernels as kernels
from capsense.solver.bodies import reference
from capsense.solver.bodies.blocks import (
    _packed,
    edges_of,
    flux_block,
    free_block,
    impedance,
)
from capsense.solver.bodies.panels import Mirrors, SurfacePanels, panels_of, polygon_panels

SQUARE = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)


def ball(subdivisions: int) -> np.ndarray:
    return np.array(trimesh.creation.icosphere(subdivisions).triangles)


def disc(rings: int, sectors: int) -> np.ndarray:
    r = np.sin(np.linspace(0, np.pi / 2, rings + 1))[:, None]
    t = 2 * np.pi * np.arange(sectors + 1) / sectors
    p = np.stack([r * np.cos(t), r * np.sin(t), 0 * r * t], axis=2)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    return np.concatenate([np.stack(x, axis=2).reshape(-1, 3, 3) for x in ((a, b, c), (a, c, d))])


def capacitance(panels: SurfacePanels, free: np.ndarray | None = None) -> float:
    """Over 4π eps0 [m]."""
    free = free_block(panels) if free is None else free
    return float(np.linalg.solve(free, np.ones(len(panels))).sum())


def ellipsoid_capacitance(radii: tuple[float, float, float]) -> float:
    """2 / ∫ ds / √((a² + s)(b² + s)(c² + s)), in units of the longest half axis."""
    a = np.array(radii) / max(radii)
    total = quad(lambda u: math.exp(u) / math.sqrt(np.prod(a**2 + math.expm1(u))), 0, 60, limit=500)
    return 2 * max(radii) / total[0]


def depolarisation(radii: tuple[float, float, float], axis: int) -> float:
    """abc/2 ∫ ds / ((a_i² + s) √(...)), one third for a ball."""
    a = np.array(radii) / max(radii)

    def integrand(u: float) -> float:
        s = a**2 + math.expm1(u)
        return math.exp(u) / (s[axis] * math.sqrt(np.prod(s)))

    return a.prod() / 2 * quad(integrand, 0, 60, limit=500)[0]


def answer(matrix: np.ndarray, potential: np.ndarray) -> np.ndarray:
    """φᵀ A⁻¹ φ over charges that add up to nothing, for each column of φ, (n, k) -> (k,)."""
    x = np.linalg.solve(matrix, np.column_stack([potential, np.ones(len(potential))]))
    charges = x[:, :-1] - x[:, -1:] * x[:, :-1].sum(axis=0) / x[:, -1].sum()
    return (potential * charges).sum(axis=0)


def polarisability(panels, free, z, eps: float, volume: float) -> np.ndarray:
    """Over eps0 times the volume, along the three axes."""
    return 4 * math.pi / volume * answer(free + z / (eps - 1), panels.centers)


@cache
def blocks(shape: Shape) -> tuple[SurfacePanels, np.ndarray, np.ndarray]:
    """Panels of a shape, the block of their potentials in free space, and the impedance."""
    panels = panels_of(shape)
    free = free_block(panels)
    return panels, free, impedance(panels, free)


# ---- closed forms and kernels against the reference ----


@pytest.mark.parametrize("shape", [Sphere(1.0), Box((1.0, 0.7, 0.3))], ids=repr)
def test_potential_and_solid_angle_of_a_panel(shape):
    panels = panels_of(shape, 200)
    edges = edges_of(panels)
    rng = np.random.default_rng(3)
    for k in rng.choice(len(panels), 6, replace=False):
        size = math.sqrt(panels.areas[k])
        points = panels.centers[k] + size * rng.normal(size=(8, 3))
        corners = panels.corners[k]
        potential, field = reference.polygon_integrals(corners, points)
        for p, v, e in zip(points, potential, field, strict=True):
            assert polygon_potential(edges[k], panels.normals[k], *p) == approx(v, rel=1e-10)
            angle = solid_angle(edges[k], panels.normals[k], *p)
            assert angle == approx(e @ panels.normals[k], abs=1e-10)
        inside = 0.4 * corners[0] + 0.35 * corners[1] + 0.25 * corners[2]
        on = [inside, corners[0], 0.5 * (corners[0] + corners[1])]
        near = np.array(on) + 1e-7 * size * panels.normals[k] + 1e-7 * (inside - np.array(on))
        for p, v in zip(on, reference.polygon_integrals(corners, near)[0], strict=True):
            assert polygon_potential(edges[k], panels.normals[k], *p) == approx(v, rel=1e-5)


def test_self_terms():
    """Rectangle and triangle in closed form, trapezoid against quadrature.

    Rectangle a × b of diagonal d, mean of 1/r:
    2 [a² b asinh(b/a) + a b² asinh(a/b) + (a³ + b³ − d³) / 3] / (a b)². Triangle of sides a, b, c
    and half perimeter s: 4/3 Σ ln(s / (s − a)) / a (Eibert and Hansen, IEEE Trans. Antennas
    Propag. 43, 1995).
    """
    panels = panels_of(Box((1.0, 0.3, 0.01)), 300)
    got = np.diag(free_block(panels))
    edge = np.linalg.norm(np.diff(panels.corners[:, :3], axis=1), axis=2)
    a, b = edge.T
    cubes = (a**3 + b**3 - np.hypot(a, b) ** 3) / 3
    total = a * a * b * np.arcsinh(b / a) + a * b * b * np.arcsinh(a / b) + cubes
    ratio = np.maximum(a / b, b / a)
    np.testing.assert_allclose(got, 2 * total / (a * b) ** 2, rtol=5e-4)
    np.testing.assert_allclose(got[ratio < 8], (2 * total / (a * b) ** 2)[ratio < 8], rtol=5e-5)
    panels = panels_of(ball(2), 300)
    got = np.diag(free_block(panels))
    sides = np.linalg.norm(
        np.roll(panels.corners[:, :3], -1, axis=1) - panels.corners[:, :3], axis=2
    )
    half = sides.sum(axis=1, keepdims=True) / 2
    np.testing.assert_allclose(
        got, 4 / 3 * (np.log(half / (half - sides)) / sides).sum(axis=1), rtol=5e-5
    )
    panels = panels_of(Sphere(1.0), 200)
    got = np.diag(free_block(panels))
    for k in range(0, len(panels), 29):
        exact = reference.free_entry(panels.corners[k], panels.corners[k], 6, 6)
        assert got[k] == approx(exact, rel=5e-5)


@pytest.mark.parametrize(
    ("shape", "touching", "far"),
    [
        (Sphere(1.0), 1.2e-3, 3.5e-3),
        (Cylinder(0.04, 0.25), 1.2e-3, 3.5e-3),
        (Box((1.0, 1.0, 1.0)), 1.2e-3, 3.5e-3),
        (Box((0.15, 0.15, 0.0005)), 3e-3, 4e-3),
    ],
    ids=repr,
)
def test_entries_against_reference(shape, touching, far):
    """Random pairs of each range; each panel's nearest neighbours touch it."""
    panels = panels_of(shape, 300)
    free, flux = free_block(panels), flux_block(panels)
    np.testing.assert_array_equal(free, free.T)
    distance = np.linalg.norm(panels.centers[:, None] - panels.centers, axis=2)
    rng = np.random.default_rng(5)
    for k in rng.choice(len(panels), 10, replace=False):
        order = np.argsort(distance[k])
        for other in [*order[1:4], *rng.choice(order[4:], 3)]:
            a, b = panels.corners[k], panels.corners[other]
            exact = 0.5 * (reference.free_entry(a, b) + reference.free_entry(b, a))
            bound = touching if other in order[1:4] else far
            assert free[k, other] == approx(exact, rel=bound)
            through = reference.flux_entry(a, b, 6)
            assert flux[k, other] == approx(through, rel=0.03, abs=4e-3)


def test_flux_of_a_closed_surface():
    """Half of all field lines of a charge on a closed surface go inside: columns add up to 2π."""
    for shape in (Sphere(1.0), Box((0.15, 0.15, 0.0005)), Capsule(0.01, 0.3), ball(3)):
        total = flux_block(panels_of(shape, 400)).sum(axis=0)
        np.testing.assert_allclose(total, 2 * math.pi, rtol=4e-3)


# ---- capacitances ----


@pytest.mark.parametrize(
    ("shape", "expected", "low", "high"),
    [
        (Sphere(1.0), 1.0, -2e-4, 4e-4),
        (Ellipsoid((0.05, 0.02, 0.2)), None, -2e-4, 6e-4),
        (Ellipsoid((0.01, 0.01, 0.1)), None, 0, 1e-3),
        (Ellipsoid((0.01, 0.01, 0.2)), None, 0, 1.5e-3),
        (Ellipsoid((0.1, 0.1, 0.005)), None, 0, 8e-4),
        (Box((1.0, 1.0, 1.0)), 0.660678, -7e-4, 0),
        (Box((0.15, 0.15, 0.0005)), 0.05549, -2e-3, 0),
        (Box((0.01, 0.01, 0.5)), 0.06177, -1.5e-3, 0),
        (Capsule(0.04, 0.25), 0.0852013, -1e-4, 3e-4),
        (Capsule(0.004, 0.5), 0.056753, -3e-4, 4e-4),
        (Cylinder(0.04, 0.25), 0.07791, -3e-4, 1e-4),
    ],
    ids=repr,
)
def test_capacitance(shape, expected, low, high):
    """600 panels against closed forms, or 2,400 to 2,800 where there is none.

    The unit cube is that of Hwang and Mascagni, J. Appl. Phys. 95 (2004).
    """
    if expected is None:
        expected = ellipsoid_capacitance(shape.radii)
    error = capacitance(panels_of(shape)) / expected - 1
    assert low <= error <= high


def test_capacitance_of_sheets():
    """Disc 2 R / π; unit square 0.366789 (Read, J. Comput. Phys. 133, 1997)."""
    for sheet, expected, low, high in (
        (disc(12, 48), 2 / math.pi, -4.5e-3, -1e-3),
        (SQUARE, 0.366789, -4.5e-3, -1.5e-3),
    ):
        assert low < capacitance(panels_of(sheet)) / expected - 1 < high


def test_two_balls_at_one_potential():
    """Radius 1, centres 3 apart: images, 2 sinh β Σ (−1)^(n+1) / sinh nβ with cosh β = 3/2."""
    beta = math.acosh(1.5)
    n = np.arange(1, 200)
    expected = 2 * math.sinh(beta) * float(((-1.0) ** (n + 1) / np.sinh(n * beta)).sum())
    one = panels_of(Sphere(1.0)).corners
    both = np.concatenate([one, one + np.array([3.0, 0.0, 0.0])])
    triangles = np.concatenate([both[:, [0, 1, 2]], both[:, [0, 2, 3]]])
    panels = panels_of(triangles, 2400)
    assert panels.parts.max() == 1
    assert -3e-3 < capacitance(panels) / expected - 1 < 3e-4


# ---- invariants ----


def test_scaling_and_rotation():
    triangles = ball(2) @ np.array([[1.0, 0.3, 0.1], [0.0, 0.8, 0.2], [0.0, 0.0, 1.1]])
    panels = panels_of(triangles, 320)
    assert len(panels.mirrors.image) == 1
    free = free_block(panels)
    scaled = panels.scaled(0.01)
    np.testing.assert_allclose(free_block(scaled), 100 * free, rtol=1e-9)
    z = impedance(panels, free)
    np.testing.assert_allclose(impedance(scaled, 100 * free), 100 * z, atol=1e-7 * z.max() * 100)
    turn = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()
    turned = panels_of(triangles @ turn.T + [0.1, 0.2, -0.3], 320)
    np.testing.assert_allclose(
        turned.centers, panels.centers @ turn.T + [0.1, 0.2, -0.3], atol=1e-9
    )
    np.testing.assert_allclose(free_block(turned), free, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "maps"),
    [
        (Box((0.1, 0.08, 0.02)), 8), (Sphere(0.03), 4), (Capsule(0.008, 0.05), 8),
        (Cylinder(0.05, 0.01), 8), (Ellipsoid((0.03, 0.02, 0.05)), 4), (None, 1),
    ],
)  # fmt: skip
def test_mirror_images(shape: Shape | None, maps: int) -> None:
    """Differential: the block of mirrored panels against one that does not know of mirrors."""
    some = np.random.default_rng(1).normal(size=(40, 3, 3))
    panels = panels_of(some if shape is None else shape, 300)
    image, first, by = panels.mirrors
    n = np.arange(len(panels))
    assert len(image) == maps
    for row in image:
        np.testing.assert_array_equal(row[row], n)
        sign = np.sign((panels.centers * panels.centers[row]).sum(axis=0))
        np.testing.assert_allclose(panels.centers[row], sign * panels.centers, atol=1e-9)
    np.testing.assert_array_equal(image[by, first], n)
    free = free_block(panels)
    np.testing.assert_array_equal(free, free.T)
    for row in image:
        np.testing.assert_array_equal(free[row][:, row], free)
    alone, bare = np.empty_like(free), Mirrors(n[None], n, np.zeros_like(n))
    kernels.fill_free(_packed(panels), bare, alone)
    np.testing.assert_allclose(free, alone, rtol=2e-3)
    if maps == 1:
        np.testing.assert_array_equal(free, alone)


@pytest.mark.parametrize("apart", [0.0, 0.15], ids=["one box", "two boxes that are mirrored"])
def test_impedance_by_kinds_of_patterns(apart: float) -> None:
    """Differential: the whole matrix at once. Parts that are each other's images stay apart."""
    corners = panels_of(Box((0.1, 0.08, 0.02)), 150).corners
    shift = np.array([apart, 0.0, 0.0])
    both = np.concatenate([corners - shift, corners + shift])
    panels = polygon_panels(corners)
    if apart:
        panels = polygon_panels(both, np.repeat([0, 1], len(corners)))
    n = np.arange(len(panels))
    plain = replace(panels)
    plain.__dict__["mirrors"] = Mirrors(n[None], n, np.zeros_like(n))
    free = free_block(panels)
    assert len(panels.mirrors.image) == 8
    z, whole = impedance(panels, free), impedance(plain, free)
    np.testing.assert_allclose(z, whole, rtol=0.0, atol=1e-9 * np.abs(whole).max())
    np.testing.assert_allclose(z, z.T, rtol=0.0, atol=1e-12 * np.abs(z).max())


def test_nearly_mirrored_panels_are_none() -> None:
    """Limits: a panel that lies, or is turned, a little otherwise."""
    corners = panels_of(Box((0.1, 0.08, 0.02)), 100).corners
    moved, turned = corners.copy(), corners.copy()
    moved[3, :, 1] += 1e-6
    turned[3] = turned[3].mean(axis=0) + 1.01 * (turned[3] - turned[3].mean(axis=0))
    assert len(polygon_panels(corners + np.array([0.0, 0.0, 0.01])).mirrors.image) == 4
    for other in (moved, turned):
        assert len(polygon_panels(other).mirrors.image) < 8


@pytest.mark.parametrize(
    ("name", "triangles"),
    [
        ("touching", np.concatenate([ball(3), ball(3) + np.array([2.0, 0, 0])])),
        ("crossing", np.concatenate([ball(3), ball(3) + np.array([1.0, 0, 0])])),
        ("open", ball(3)[ball(3)[:, 0, 2] > -0.3]),
        ("copies", np.concatenate([ball(3), ball(3)[:, ::-1]])),
        ("thin", np.array(trimesh.creation.box(extents=(0.15, 0.15, 2e-4)).triangles)),
    ],
)
def test_definite(name, triangles):
    eigenvalues = np.linalg.eigvalsh(free_block(panels_of(triangles, 400)))
    assert eigenvalues[0] > 1e-5 * eigenvalues[-1]


# ---- dielectrics ----

SHAPES = [Sphere(1.0), Ellipsoid((0.05, 0.02, 0.2)), Ellipsoid((0.1, 0.1, 0.01))]


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_polarisability_of_ellipsoids(shape):
    """α / V = (eps − 1) / (1 + L (eps − 1)), L the depolarisation factor of the axis."""
    radii = shape.radii if isinstance(shape, Ellipsoid) else (1.0, 1.0, 1.0)
    factors = np.array([depolarisation(radii, axis) for axis in range(3)])
    for eps in (1.01, 2.0, 5.0, 80.0, 1e6):
        exact = (eps - 1) / (1 + factors * (eps - 1))
        got = polarisability(*blocks(shape), eps, shape.volume)
        np.testing.assert_allclose(got, exact, rtol=1.2e-3)


def test_polarisability_of_a_cube_and_a_cylinder():
    """Cube at infinite eps 3.6442 (Sihvola et al., J. Electrostat. 61, 2004), else 2,200 panels."""
    cube = np.array([0.7602, 1.8300, 3.4609, 3.6442])
    across = np.array([0.7485, 1.7339, 3.0395, 3.1707])
    along = np.array([0.7727, 1.8985, 3.6629, 3.8612])
    for shape, expected in (
        (Box((1.0, 1.0, 1.0)), (cube, cube, cube)),
        (Cylinder(0.5, 1.0), (across, across, along)),
    ):
        for eps, values in zip((2, 5, 80, 1e9), np.transpose(expected), strict=True):
            got = polarisability(*blocks(shape), eps, shape.volume)
            np.testing.assert_allclose(got, values, rtol=1.6e-3)


def test_thin_plate_along_and_across():
    """Across a thin plate α / V = (eps − 1) / eps nearly, along it nearly eps − 1."""
    plate = Box((0.15, 0.15, 0.0005))
    found = polarisability(*blocks(plate), 2.0, plate.volume)
    np.testing.assert_allclose(found, [0.9939, 0.9939, 0.5046], rtol=3e-3)


LINEAR_AND_QUADRATIC = {
    "x": (lambda x, y, z: x, lambda x, y, z: (1, 0, 0)),
    "y": (lambda x, y, z: y, lambda x, y, z: (0, 1, 0)),
    "z": (lambda x, y, z: z, lambda x, y, z: (0, 0, 1)),
    "xy": (lambda x, y, z: x * y, lambda x, y, z: (y, x, 0)),
    "xz": (lambda x, y, z: x * z, lambda x, y, z: (z, 0, x)),
    "yz": (lambda x, y, z: y * z, lambda x, y, z: (0, z, y)),
    "xx - yy": (lambda x, y, z: x * x - y * y, lambda x, y, z: (2 * x, -2 * y, 0)),
    "zz - xx": (lambda x, y, z: z * z - x * x, lambda x, y, z: (-2 * x, 0, 2 * z)),
}


@pytest.mark.parametrize(
    ("shape", "bound"), [(Box((1.0, 0.7, 0.3)), 1e-6), (Ellipsoid((0.05, 0.03, 0.08)), 5e-3)]
)
def test_linear_and_quadratic_potentials_inside(shape, bound):
    """Analytic: Z takes the flux of each harmonic potential to 4π times it, but for a constant."""
    panels = panels_of(shape, 200)
    z = impedance(panels, free_block(panels))
    for name, (potential, gradient) in LINEAR_AND_QUADRATIC.items():
        u = np.empty(len(panels))
        for k, corners in enumerate(panels.corners):
            points, weights = reference.polygon_points(corners, 2, 3)
            u[k] = weights @ potential(*points.T)
        field = np.array([gradient(*center) for center in panels.centers])
        flux = panels.areas * np.einsum("ij,ij->i", panels.normals, field)
        left = z @ flux / (4 * math.pi) - u
        assert np.ptp(left) < bound * np.ptp(u), name


@pytest.mark.parametrize(("distance", "bound"), [(1.3, 8e-3), (2.0, 1e-3)])
def test_point_charge_outside_a_ball(distance, bound):
    """Σ l (eps − 1) / (l (eps + 1) + 1) d^(−2l−2): patterns that are not put in by hand."""
    panels, free, z = blocks(Sphere(1.0))
    source = distance * np.array([0.0, 0.6, 0.8])
    potential = np.empty(len(panels))
    for k, corners in enumerate(panels.corners):
        points, weights = reference.polygon_points(corners, 2, 3)
        potential[k] = weights @ (1 / np.linalg.norm(points - source, axis=1))
    degree = np.arange(1, 300)
    for eps in (1.1, 2.0, 5.0, 80.0):
        share = degree * (eps - 1) / (degree * (eps + 1) + 1)
        exact = float((share * distance ** (-2.0 * degree - 2)).sum())
        (found,) = answer(free + z / (eps - 1), potential[:, None])
        assert found == approx(exact, rel=bound)


def test_impedance_is_positive_and_free_on_the_equilibrium_charge():
    panels = panels_of(Capsule(0.01, 0.05), 300)
    free = free_block(panels)
    z = impedance(panels, free)
    np.testing.assert_allclose(z, z.T, atol=1e-9 * z.max())
    scale = np.linalg.eigvalsh(z)
    assert scale[0] > -1e-9 * scale[-1]
    rest = np.linalg.solve(free, np.ones(len(panels)))
    assert np.abs(z @ rest).max() < 1e-8 * np.abs(z).max() * np.abs(rest).sum()


def test_impedance_where_rounding_makes_the_inside_give_charge(monkeypatch):
    """Invariant: Z stays positive; where no rate of a pattern is negative, nothing changes.

    Coarse panels of a thin ring have two negative rates.
    """
    panels, free, z = blocks(Sphere(1.0))
    ring = trimesh.creation.annulus(0.9, 1.0, 0.01)
    coarse = panels_of(ring.vertices[ring.faces], 100)
    scale = np.linalg.eigvalsh(impedance(coarse, free_block(coarse)))
    assert scale[0] > -1e-9 * scale[-1]

    def fail(_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(np.linalg, "cholesky", fail)
    np.testing.assert_allclose(impedance(panels, free), z, atol=1e-8 * z.max())


def test_a_hollow_ball():
    """Shell of radii 1 and 1/2 (Bohren and Huffman, eq. 5.36, core of vacuum)."""
    panels = panels_of(np.concatenate([ball(4), 0.5 * ball(4)[:, ::-1]]), 1200)
    free = free_block(panels)
    z = impedance(panels, free)
    volume = 4 / 3 * math.pi
    for eps in (2.0, 5.0, 80.0):
        f = 0.125
        top = (eps - 1) * (1 + 2 * eps) + f * (2 * eps + 1) * (1 - eps)
        exact = 3 * top / ((eps + 2) * (1 + 2 * eps) + f * (2 * eps - 2) * (1 - eps))
        got = polarisability(panels, free, z, eps, volume)
        np.testing.assert_allclose(got, exact, rtol=0.02)


def test_two_loose_balls_exchange_no_charge():
    """Field along the line of two balls of eps 80, 20 radii apart: each answers for itself.

    Charge that both were given together stays free to come, in equilibrium.
    """
    panels = panels_of(np.concatenate([ball(3), ball(3) + np.array([20.0, 0, 0])]), 640)
    free = free_block(panels)
    z = impedance(panels, free)
    rest = np.linalg.solve(free, np.ones(len(panels)))
    assert np.abs(z @ rest).max() < 1e-8 * np.abs(z).max() * np.abs(rest).sum()
    volume = 2 * 4 / 3 * math.pi
    got = polarisability(panels, free, z, 80.0, volume)
    np.testing.assert_allclose(got, 3 * 79 / 82, rtol=0.04)


def test_an_open_surface_has_no_inside():
    panels = panels_of(SQUARE, 50)
    with pytest.raises(SceneError, match="closed surface"):
        impedance(panels, free_block(panels))


def test_two_kites_apart():
    """Differential: the mean of 1/r over two polygons of unequal sides, by many small pieces."""
    kites = np.array([
        [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [2.0, 1.0, 0.0], [0.0, 2.5, 0.0]],
        [[3.2, 0.5, 1.0], [6.0, 1.0, 1.0], [5.5, 4.0, 1.0], [4.0, 1.8, 1.0]],
    ])  # fmt: skip
    line = (np.arange(40) + 0.5) / 40
    s, t = (x.ravel()[:, None] for x in np.meshgrid(line, line))
    points, shares = [], []
    for a, b, c, d in kites:
        points.append((1 - s) * (1 - t) * a + s * (1 - t) * b + s * t * c + (1 - s) * t * d)
        sides = (1 - t) * (b - a) + t * (c - d), (1 - s) * (d - a) + s * (c - b)
        area = np.linalg.norm(np.cross(*sides), axis=1)
        shares.append(area / area.sum())
    inverse = 1.0 / np.linalg.norm(points[0][:, None] - points[1], axis=2)
    found = free_block(polygon_panels(kites, closed=False))[0, 1]
    assert found == approx(shares[0] @ inverse @ shares[1], rel=1e-3)
