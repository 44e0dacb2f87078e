"""Planes in front of flat designs and bent films: where they are, and how large."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import shapely
from approximate import approx

from capsense.design import parse_design
from capsense.design.shapes import STRIP_ERROR
from capsense.field.boundary import Accuracy, BoundarySolution
from capsense.field.face import FacePlane, plane_panels, sheet_on_face
from capsense.field.gap_table import build_gap_table

REACH, RADIUS = 0.008, 0.03


def _design(radius: float | None):
    table = {
        "name": "pair",
        "domain": {"size": [3.0, 3.0, 3.0], "backplane": 0.09},
        "electrode": [
            {"name": "A", "shape": "rectangle", "size": [0.012, 0.01], "center": [-0.008, 0.0]},
            {"name": "B", "shape": "disc", "radius": 0.005, "center": [0.008, 0.0]},
        ],
    }
    return parse_design(table if radius is None else table | {"bend": {"radius": radius}})


def _plane(radius: float | None) -> tuple[FacePlane, BoundarySolution]:
    solution = BoundarySolution(_design(radius), Accuracy(6.0, fitted=False))
    return plane_panels(solution, REACH), solution


@pytest.fixture(scope="module")
def bent() -> tuple[FacePlane, BoundarySolution]:
    return _plane(RADIUS)


@pytest.mark.parametrize("height", [0.0, 5e-4, 4e-3])
def test_a_bent_plane_keeps_its_distance(bent, height):
    plane, solution = bent
    panels = plane.at(height)
    film = solution.design.film
    off = film.coordinates(panels.quad[panels.weights > 0.0])[:, 2] - height
    assert np.abs(off).max() < 1.1 * STRIP_ERROR * (RADIUS + height)
    up = np.array([0.0, 0.0, 1e-3])
    outwards = film.placed(film.coordinates(panels.centers) + up) - panels.centers
    assert ((outwards * panels.normals).sum(axis=1) > 0.99e-3).all()


@pytest.mark.parametrize("height", [0.0, 4e-3])
def test_areas_of_a_bent_plane_grow_with_its_radius(bent, height):
    plane, solution = bent
    ends = np.array([solution.design.film.sheets[name].bounds[:, :2] for name in "AB"])
    whole = np.prod(ends.max(axis=(0, 1)) - ends.min(axis=(0, 1)) + 2 * REACH)
    assert plane.panels.areas.sum() == approx(whole, rel=1e-6)
    grown = whole * (1 + height / RADIUS)
    assert plane.at(height).areas.sum() == approx(grown, rel=1e-6)


def test_a_flat_plane_is_moved_as_it_is():
    plane, _ = _plane(None)
    moved = plane.at(2e-3)
    np.testing.assert_array_equal(moved.weights, plane.panels.weights)
    up = np.array([0.0, 0.0, 2e-3])
    np.testing.assert_array_equal(moved.centers, plane.panels.centers + up)


@pytest.mark.parametrize("radius", [None, RADIUS])
def test_no_panel_lies_across_a_rim(radius):
    """Those within an electrode's outline have its area."""
    plane, solution = _plane(radius)
    panels = plane.panels
    for name in "AB":
        outline = sheet_on_face(solution.design, name).facets[0].footprint
        reach = outline.buffer(1e-9)
        inside = [
            shapely.contains_xy(reach, *panels.edges[a:b, 0, :2].T).all()
            for a, b in pairwise(panels.first)
        ]
        assert panels.areas[inside].sum() == approx(outline.area, rel=1e-6)


def test_the_table_of_a_hardly_bent_film_is_that_of_the_flat_design():
    tables = []
    for radius in (None, 3.0):
        solution = BoundarySolution(_design(radius), Accuracy(4.0, fitted=False))
        densities = solution.densities(np.eye(2))
        tables.append(build_gap_table(solution, densities, 1.5e-3))
    one, two = tables
    np.testing.assert_array_equal(one.columns, two.columns)
    charges = []
    for table in tables:
        change = table.change / (table.heights + table.series[:, None])[..., None]
        charges.append([
            np.einsum("c,ckj->kj", table.areas[table.terminal == i], change[table.terminal == i])
            for i in range(2)
        ])  # fmt: skip
    np.testing.assert_allclose(*charges, atol=5e-3 * np.abs(charges[0]).max())
