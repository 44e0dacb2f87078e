"""Panels of primitives and meshes: areas, closed surfaces, parts, numbers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx

from capsense.errors import SceneError
from capsense.scene.mesh_shape import TriMesh
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Sphere
from capsense.solver.bodies.grids import panel_count, revolve, ring_counts
from capsense.solver.bodies.panels import SurfacePanels, panels_of
from capsense.solver.bodies.reference import polygon_points

PRIMITIVES = [
    Box((0.1, 0.08, 0.05)),
    Box((0.15, 0.15, 0.0005)),
    Box((0.01, 0.01, 0.5)),
    Sphere(0.05),
    Ellipsoid((0.05, 0.02, 0.2)),
    Ellipsoid((0.01, 0.01, 0.2)),
    Ellipsoid((0.1, 0.1, 0.005)),
    Capsule(0.04, 0.25),
    Capsule(0.001, 1.0),
    Cylinder(0.04, 0.25),
    Cylinder(0.1, 0.001),
    Cylinder(0.002, 0.4),
]
SQUARE = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]], float)


def ball(subdivisions: int) -> np.ndarray:
    return np.array(trimesh.creation.icosphere(subdivisions).triangles)


def check(panels: SurfacePanels) -> None:
    """What holds for all panels: plane, convex, turned one way, closed where so called."""
    n = len(panels)
    assert panels.corners.shape == (n, 4, 3)
    assert panels.moments.shape == (n, 3, 3)
    assert (panels.areas > 0).all()
    size = np.sqrt(panels.areas)
    height = np.einsum("nkd,nd->nk", panels.corners - panels.centers[:, None], panels.normals)
    assert np.abs(height).max() < 1e-9 * np.ptp(panels.corners.reshape(-1, 3), axis=0).max()
    edge = np.roll(panels.corners, -1, axis=1) - panels.corners
    turn = np.einsum("nkd,nd->nk", np.cross(edge, np.roll(edge, -1, axis=1)), panels.normals)
    assert (turn > -1e-9 * (size**2)[:, None]).all()
    np.testing.assert_allclose(np.linalg.norm(panels.normals, axis=1), 1.0, rtol=1e-12)
    assert sorted(set(panels.parts.tolist())) == list(range(panels.parts.max() + 1))
    for values in (panels.corners, panels.centers, panels.areas, panels.moments, panels.parts):
        assert not values.flags.writeable


@pytest.mark.parametrize("shape", PRIMITIVES, ids=repr)
@pytest.mark.parametrize("count", [300, 600])
def test_primitives(shape, count):
    panels = panels_of(shape, count)
    check(panels)
    assert panels.closed
    assert panels.parts.max() == 0
    assert 0.85 * count < len(panels) < 1.2 * count
    vector = panels.areas[:, None] * panels.normals
    assert np.abs(vector.sum(axis=0)).max() < 1e-12 * panels.areas.sum()
    volume = np.einsum("ij,ij->", panels.centers, vector) / 3
    assert volume == approx(shape.volume, rel=1e-9 if isinstance(shape, Box) else 6e-3)
    again = panels_of(shape, count)
    np.testing.assert_array_equal(again.corners, panels.corners)


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        (Sphere(0.05), 4 * np.pi * 0.05**2),
        (Capsule(0.04, 0.25), 2 * np.pi * 0.04 * 0.25 + 4 * np.pi * 0.04**2),
        (Cylinder(0.04, 0.25), 2 * np.pi * 0.04 * 0.25 + 2 * np.pi * 0.04**2),
        (Box((0.1, 0.08, 0.05)), 2 * (0.1 * 0.08 + 0.08 * 0.05 + 0.05 * 0.1)),
    ],
    ids=repr,
)
def test_areas(shape, area):
    """Flat panels at the right mean distance have slightly more than the curved area."""
    assert panels_of(shape).areas.sum() == approx(area, rel=6e-3)


@pytest.mark.parametrize(
    ("shape", "thickness", "limit"),
    [(Box((0.1, 0.06, 0.03)), 1 / (1 / 0.1 + 1 / 0.06 + 1 / 0.03), 1e-12),
     (Sphere(0.05), 2 * 0.05 / 3, 6e-3)],
)  # fmt: skip
def test_thickness(shape, thickness, limit):
    """Analytic: twice the volume over the area, also of a shape twice as large; none if open."""
    panels = panels_of(shape)
    assert panels.thickness == approx(thickness, rel=limit)
    assert panels.scaled(2.0).thickness == approx(2 * thickness, rel=limit)
    assert panels_of(SQUARE, 20).thickness == np.inf


def test_no_slivers_at_the_poles():
    """No panel of a ball is longer than four times its width."""
    panels = panels_of(Sphere(1.0), 600)
    low, high = np.linalg.eigvalsh(panels.moments)[:, 1:].T
    assert np.sqrt(high / low).max() < 4.0
    assert panels.areas.max() < 6 * panels.areas.min()


@pytest.mark.parametrize(
    ("shape", "longest"),
    [
        (Capsule(0.04, 0.25), 1.8),
        (Capsule(0.008, 0.06), 1.8),
        (Ellipsoid((0.05, 0.02, 0.2)), 3.3),
        (Ellipsoid((0.1, 0.1, 0.005)), 6.8),
        (Cylinder(0.04, 0.25), 6.6),
    ],
    ids=repr,
)
def test_panels_of_round_shapes_are_no_longer_than(shape, longest):
    """Measured: length over width; the longest are at rims and round edges."""
    low, high = np.linalg.eigvalsh(panels_of(shape, 600).moments)[:, 1:].T
    assert np.sqrt(high / low).max() < longest


@pytest.mark.parametrize(("size", "cells"), [((0.15, 0.15, 0.0005), 2), ((0.01, 0.01, 0.5), 3)])
def test_cells_across_the_thinnest_side(size, cells):
    """Two across a plate, three across a rod, whose field depends on both of its widths."""
    panels = panels_of(Box(size), 600)
    axis = int(np.argmin(size))
    assert len(np.unique(np.round(panels.corners[..., axis], 9))) == cells + 1


@pytest.mark.parametrize("widest", [3.0, 24.0, 40.0, 97.0])
@pytest.mark.parametrize("cap", [4, 9, 20])
@pytest.mark.parametrize("step", [0.1, 1.0])
def test_rings_and_the_number_of_their_panels(widest, cap, step):
    """Invariant: poles of one node, neighbours equal or twice; panels as many as predicted."""
    angle = np.linspace(0.0, 0.5 * np.pi, cap)
    rho = np.concatenate([np.sin(angle), np.ones(3), np.sin(angle)[::-1]])
    nodes = ring_counts(rho, np.full(len(rho), step), widest)
    assert nodes[0] == nodes[-1] == 1
    inner = nodes[1:-1]
    assert inner.max() == max(12, 4 * round(widest / 4))
    assert inner.min() >= 5
    assert set(np.maximum(inner[1:], inner[:-1]) / np.minimum(inner[1:], inner[:-1])) <= {1.0, 2.0}
    assert panel_count(nodes) == len(revolve(rho, np.arange(float(len(rho))), nodes))


def test_centroids_and_moments_against_quadrature():
    for shape in (Sphere(1.0), Cylinder(0.5, 1.0)):
        panels = panels_of(shape, 300)
        for k in range(0, len(panels), 41):
            points, weights = polygon_points(panels.corners[k], 2, 4)
            center = weights @ points
            np.testing.assert_allclose(panels.centers[k], center, atol=1e-12)
            moments = np.einsum("q,qi,qj->ij", weights, points - center, points - center)
            np.testing.assert_allclose(panels.moments[k], moments, atol=1e-12)


def test_scaled():
    panels = panels_of(Capsule(0.01, 0.05))
    large, thrice = panels_of(Capsule(0.03, 0.15)), panels.scaled(3.0)
    for name in ("corners", "centers", "normals", "areas", "moments"):
        np.testing.assert_allclose(getattr(thrice, name), getattr(large, name), atol=1e-12)


def test_a_box_of_twelve_triangles_is_halved_and_a_fine_ball_reduced():
    panels = panels_of(np.array(trimesh.creation.box().triangles))
    check(panels)
    assert panels.closed
    assert len(panels) == 600
    assert panels.areas.sum() == approx(6.0, rel=1e-12)
    panels = panels_of(ball(4), 500)
    check(panels)
    assert panels.closed
    assert 500 <= len(panels) <= 625
    assert panels.areas.sum() == approx(4 * np.pi, rel=4e-3)
    np.testing.assert_array_equal(panels_of(ball(4), 500).corners, panels.corners)


def test_any_winding_copies_and_degenerate_triangles():
    triangles = ball(3)
    rng = np.random.default_rng(0)
    turned = triangles.copy()
    some = rng.random(len(turned)) < 0.5
    turned[some] = turned[some, ::-1]
    flat = np.repeat(triangles[:5, :1], 3, axis=1)
    messy = rng.permutation(np.concatenate([turned, triangles[:40, [1, 0, 2]], flat]))
    panels = panels_of(messy, 2000)
    check(panels)
    assert panels.closed
    assert np.einsum("ij,ij->i", panels.normals, panels.centers).min() > 0.9
    assert panels.areas.sum() == approx(
        np.linalg.norm(
            np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
        ).sum()
        / 2,
        rel=1e-9,
    )


def test_open_and_doubled_sheets():
    """A sheet is open; its other side, given too, is the same sheet."""
    once = panels_of(SQUARE)
    check(once)
    assert not once.closed
    assert once.areas.sum() == approx(1.0, rel=1e-12)
    both = panels_of(np.concatenate([SQUARE, SQUARE[:, ::-1]]))
    assert not both.closed
    assert both.areas.sum() == approx(1.0, rel=1e-12)


def test_panels_that_nearly_coincide_count_once():
    """Two copies of a sheet, a hundred-thousandth of its size apart."""
    copy = SQUARE + np.array([0.0, 0.0, 1e-5])
    assert panels_of(np.concatenate([SQUARE, copy])).areas.sum() == approx(1.0, rel=1e-9)


def test_parts_keep_their_share():
    """A small ball far from a large one keeps at least 40 triangles; a cavity stays a cavity."""
    small = 0.05 * ball(2) + [3.0, 0.0, 0.0]
    panels = panels_of(np.concatenate([ball(4), small, 0.5 * ball(2)[:, ::-1]]), 600)
    check(panels)
    assert panels.closed
    number = np.bincount(panels.parts)
    assert len(number) == 3
    assert number.min() >= 40
    side = np.einsum("ij,ij->i", panels.centers, panels.normals)
    radius = np.linalg.norm(panels.centers, axis=1)
    assert (side[radius < 0.6] < 0).all()
    assert (side[(radius > 0.6) & (radius < 2)] > 0).all()


def test_loose_triangles_stay_manageable():
    rng = np.random.default_rng(1)
    loose = rng.normal(size=(5000, 1, 3)) + 0.01 * rng.normal(size=(5000, 3, 3))
    panels = panels_of(loose, 300)
    check(panels)
    assert len(panels) < 900


def test_closed_mesh_shape():
    mesh = trimesh.creation.icosphere(4)
    panels = panels_of(TriMesh(mesh.vertices, mesh.faces), 600)
    check(panels)
    assert panels.closed


def test_wrong_input():
    with pytest.raises(SceneError, match="shape"):
        panels_of(np.zeros((3, 3)))
    with pytest.raises(SceneError, match="not finite"):
        panels_of(np.full((1, 3, 3), np.nan))
    with pytest.raises(SceneError, match="area above zero"):
        panels_of(np.zeros((2, 3, 3)))
    with pytest.raises(SceneError, match="area above zero"):
        panels_of(np.zeros((0, 3, 3)))
