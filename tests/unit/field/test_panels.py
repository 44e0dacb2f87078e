"""Panels: pieces that fill a sheet exactly, finer towards its rims."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from approximate import approx
from field_cases import sheet

from capsense.design.geometry import Facet
from capsense.field.panels import Grading, Panels, concatenate, cut_facet, make_panels

SHAPES = {
    "square": shapely.box(0.0, 0.0, 0.03, 0.03),
    "sliver": shapely.box(0.0, 0.0, 0.1, 0.0004),
    "triangle": shapely.Polygon([(0.0, 0.0), (0.03, 0.002), (0.01, 0.02)]),
    "L": shapely.Polygon(
        [(0.0, 0.0), (0.03, 0.0), (0.03, 0.01), (0.01, 0.01), (0.01, 0.02), (0.0, 0.02)]
    ),
    "holes": shapely.box(0.0, 0.0, 0.04, 0.03)
    .difference(shapely.box(0.005, 0.005, 0.015, 0.02))
    .difference(shapely.Point(0.03, 0.015).buffer(0.006)),
    "disc": shapely.Point(0.0, 0.0).buffer(0.02, quad_segs=16),
}
TILTED = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


def cut(polygon: shapely.Polygon, grading: Grading) -> tuple[list[shapely.Polygon], Panels]:
    """Cut a tilted facet of this outline, graded to all its rims."""
    facet = Facet(polygon, np.array([0.1, -0.2, 0.05]), TILTED)
    rims = facet.to_sensor(sheet(polygon).rims[..., :2])
    pieces = cut_facet(facet, rims, grading)
    return pieces, make_panels(facet, pieces)


@pytest.mark.parametrize("name", SHAPES)
def test_pieces_tile_the_facet(name):
    """Invariant: no gap, no overlap, every panel in the facet's plane."""
    polygon = shapely.geometry.polygon.orient(SHAPES[name])
    pieces, panels = cut(polygon, Grading(1e-4, largest=0.004))
    assert len(pieces) == panels.size
    assert sum(p.area for p in pieces) == approx(polygon.area, rel=1e-6)
    assert shapely.union_all(pieces).symmetric_difference(polygon).area < 1e-6 * polygon.area
    np.testing.assert_allclose(panels.areas, [p.area for p in pieces], rtol=1e-9)
    assert (panels.areas > 0).all()
    np.testing.assert_allclose(panels.normals, np.tile(TILTED[2], (panels.size, 1)))
    for points in (panels.centers, panels.edges.reshape(-1, 3), panels.quad[panels.weights > 0]):
        np.testing.assert_allclose((points - [0.1, -0.2, 0.05]) @ TILTED[2], 0.0, atol=1e-15)


@pytest.mark.parametrize("name", SHAPES)
def test_centroids_and_diameters(name):
    """Definition: centre of the area; twice the distance from it to the farthest corner."""
    facet = Facet(SHAPES[name], np.array([0.1, -0.2, 0.05]), TILTED)
    pieces, panels = cut(SHAPES[name], Grading(2e-4, largest=0.006))
    for piece, center, diameter in zip(pieces, panels.centers, panels.diameters, strict=True):
        middle = np.array(piece.centroid.coords[0])
        np.testing.assert_allclose(center, facet.to_sensor(middle), atol=1e-9)
        corners = np.asarray(piece.exterior.coords)
        assert diameter == approx(2 * np.linalg.norm(corners - middle, axis=1).max(), 1e-6)


def test_rims_at_a_micrometre_or_less_lie_in_the_facet():
    """Documented: without reach, those within a micrometre are graded to, others are not."""
    facet = Facet(SHAPES["square"], np.zeros(3), np.eye(3))
    for height, finer in ((0.9e-6, True), (1e-6, True), (1.1e-6, False)):
        rim = np.array([[[0.01, -0.1, height], [0.01, 0.1, height]]])
        pieces = cut_facet(facet, rim, Grading(1e-4, largest=0.004))
        assert (min(p.area for p in pieces) < 1e-6) == finer


@pytest.mark.parametrize("name", SHAPES)
def test_quadrature_is_exact_for_quadratics(name):
    """Analytic: ∫ (c + b·x + x·A x) dS by the mid-edge rule on another triangulation."""
    polygon = SHAPES[name]
    _, panels = cut(polygon, Grading(2e-4, largest=0.006))
    local = (panels.quad - [0.1, -0.2, 0.05]) @ TILTED.T

    def f(u, v):
        return 1.0 + 30.0 * u - 20.0 * v + 1e3 * u * u - 700.0 * u * v + 300.0 * v * v

    got = float((panels.weights * f(local[..., 0], local[..., 1])).sum())
    expected = 0.0
    for triangle in shapely.constrained_delaunay_triangles(polygon).geoms:
        corners = np.asarray(triangle.exterior.coords)[:3]
        middles = (corners + np.roll(corners, 1, axis=0)) / 2
        expected += triangle.area * f(*middles.T).mean()
    assert got == approx(expected, rel=1e-6)


def test_panels_are_finer_towards_rims():
    """Invariant: width grows no faster than the distance to the rims, from ``edge`` on."""
    grading = Grading(1e-4, largest=0.004)
    pieces, _ = cut(SHAPES["square"], grading)
    boundary = SHAPES["square"].exterior
    for piece in pieces:
        thickness = 2 * shapely.maximum_inscribed_circle(piece).length
        distance = boundary.distance(piece)
        assert thickness <= max(1.2 * grading.edge, grading.aspect * distance)
        assert max(np.ptp(np.array(piece.bounds).reshape(2, 2), axis=0)) <= 1.5 * grading.largest
    assert min(p.area for p in pieces) < 1e-7


def test_rims_of_another_sheet_refine_from_an_eighth_of_their_height_on():
    """Invariant: a rim 1 mm above the facet makes panels finer below it, but none of edge size."""
    polygon = SHAPES["square"]
    facet = Facet(polygon, np.zeros(3), np.eye(3))
    rim = np.array([[[0.01, -0.1, 0.001], [0.01, 0.1, 0.001]]])
    plain = cut_facet(facet, rim, Grading(1e-4, largest=0.004), reach=0.0)
    near = cut_facet(facet, rim, Grading(1e-4, largest=0.004), reach=0.003)
    assert len(near) > len(plain)
    widths = [np.ptp(np.array(p.bounds).reshape(2, 2), axis=0).min() for p in near]
    assert min(widths) == approx(2e-4, rel=1e-6)  # the first band of at least 0.125 mm
    assert sum(p.area for p in near) == approx(polygon.area, rel=1e-6)


def test_a_rim_that_stands_upright_is_not_graded_to():
    """Invariant: it is no line in the facet's plane."""
    facet = Facet(SHAPES["square"], np.zeros(3), np.eye(3))
    rim = np.array([[[0.01, 0.012, 0.0], [0.01, 0.012, 0.001]]])
    plain, near = (
        cut_facet(facet, r, Grading(1e-4, largest=0.004), reach=0.003) for r in (rim[:0], rim)
    )
    assert near == plain


def test_concatenation_keeps_panels_apart():
    """Invariant: edges, quadrature and areas stay with their panel."""
    parts = [cut(SHAPES[n], Grading(5e-4, largest=0.01))[1] for n in ("holes", "square", "L")]
    joined = concatenate(parts)
    assert joined.size == sum(p.size for p in parts)
    np.testing.assert_allclose(joined.areas, np.concatenate([p.areas for p in parts]))
    offset = 0
    for part in parts:
        for k in range(part.size):
            mine = part.edges[part.first[k] : part.first[k + 1]]
            j = offset + k
            np.testing.assert_array_equal(joined.edges[joined.first[j] : joined.first[j + 1]], mine)
        offset += part.size


@pytest.mark.parametrize("width", [0.002, 0.02])
def test_few_points_for_many_corners(monkeypatch, width):
    """Differential: a ring and a disc of 128 corners have the moments of all their triangles."""
    hole = shapely.Point(0.0, 0.0).buffer(0.02 - width, quad_segs=32)
    ring = shapely.Point(0.0, 0.0).buffer(0.02, quad_segs=32).difference(hole)
    facet = Facet(ring, np.array([0.1, -0.2, 0.05]), TILTED)
    few = make_panels(facet, [ring])
    monkeypatch.setattr("capsense.field.panels._MANY", 10**6)
    many = make_panels(facet, [ring])
    assert few.quad.shape[1] <= 15 < 300 < many.quad.shape[1]
    assert few.weights.min() > 0.0
    powers = [(i, j) for i in range(5) for j in range(5 - i)]
    found, wanted = (
        [p.weights[0] @ (x**i * y**j) for i, j in powers]
        for p in (few, many)
        for x, y, _ in [((p.quad[0] - facet.origin) @ TILTED.T / 0.02).T]
    )
    np.testing.assert_allclose(found, wanted, atol=1e-9 * ring.area)


def test_spikes_are_left_out_of_outlines_of_many_corners():
    """Regression: where a quadrature of few points is taken, their slivers went unseen."""
    corners = np.array(SHAPES["disc"].exterior.coords)[:-1]
    spike = corners[5] * (1.0 + 1e-7), corners[5] + 1e-7 * (corners[6] - corners[5])
    spiked = shapely.Polygon(np.insert(corners, 6, spike, axis=0))
    facet = Facet(spiked, np.zeros(3), np.eye(3))
    assert len(make_panels(facet, [spiked]).edges) == len(corners)
