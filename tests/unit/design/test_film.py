"""Coordinates of a bent film: inverses, lengths that bending keeps, and what a design keeps."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from approximate import approx

from capsense.design import load_design, parse_design
from capsense.design.film import Film, strip_plane, strips
from capsense.field.face import cover_of, face_box, has_even_face, top_of

FILM = Film(0.05, {})
TABLE = {
    "name": "bent",
    "domain": {"size": [0.4, 0.4, 0.4], "backplane": 0.2},
    "bend": {"radius": 0.05},
    "electrode": [{"name": "A", "shape": "rectangle", "size": [0.02, 0.03], "center": [0.02, 0.0]}],
}
BACK = {"name": "back", "role": "shield", "shape": "cylinder", "length": 0.05,
        "center": [0.0, 0.0, -0.05], "tilt": [90, 0, 0]}  # fmt: skip


def _random_points(count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform([-0.15, -0.1, -0.04], [0.15, 0.1, 0.1], (count, 3))


def test_coordinates_are_the_inverse_of_places():
    points = _random_points()
    np.testing.assert_allclose(FILM.coordinates(FILM.placed(points)), points, atol=1e-15)


def test_heights_are_distances_from_the_cylinder_and_lengths_along_it_are_arcs():
    points = FILM.placed(_random_points())
    height = FILM.coordinates(points)[:, 2]
    distance = np.hypot(points[:, 0], points[:, 2] + FILM.radius) - FILM.radius
    np.testing.assert_allclose(height, distance, atol=1e-15)
    quarter = FILM.coordinates(np.array([FILM.radius, 0.0, -FILM.radius]))
    np.testing.assert_allclose(quarter, [math.pi / 2 * FILM.radius, 0.0, 0.0], atol=1e-15)


def test_a_large_radius_is_flat():
    points = _random_points()
    np.testing.assert_allclose(Film(1e5, {}).placed(points), points, atol=1e-6)


@pytest.mark.parametrize("height", [0.0, 0.004])
def test_strips_cover_the_arc_and_are_as_wide(height):
    whole = list(strips(-0.03, 0.05, 0.05))
    assert whole[0].start == -0.03
    assert whole[-1].end == 0.05
    assert all(a.end == b.start for a, b in pairwise(whole))
    for strip in whole:
        origin, axes = strip_plane(strip, 0.05, height)
        half = 0.5 * (strip.end - strip.start) * (0.05 + height) / 0.05
        ends = origin + np.array([[-half], [half]]) * axes[0]
        at = FILM.coordinates(ends)
        np.testing.assert_allclose(at[:, 0], [strip.start, strip.end], atol=1e-15)
        assert np.linalg.det(axes) == approx(1.0)


def test_a_design_keeps_its_film():
    design = parse_design(TABLE | {"conductor": [BACK | {"radius": 0.048}]})
    assert design.film is not None
    assert list(design.film.sheets) == ["A"]  # the cylinder was never flat
    np.testing.assert_allclose(
        design.film.sheets["A"].bounds, [[0.01, -0.015, 0.0], [0.03, 0.015, 0.0]]
    )
    small = design.in_units
    assert small.film is not None
    assert small.film.radius == approx(0.05 / design.unit)


def test_the_bend_counts_for_the_hash():
    bent = parse_design(TABLE)
    assert bent.content_hash() != parse_design(TABLE | {"bend": {"radius": 0.06}}).content_hash()
    assert bent.content_hash() == parse_design(TABLE).content_hash()


@pytest.mark.parametrize(
    ("radius", "even"), [(0.045, True), (0.0498, True), (0.056, False)], ids=str
)
def test_the_film_is_the_face_where_nothing_rises_above_it(radius, even):
    design = parse_design(TABLE | {"conductor": [BACK | {"radius": radius}]})
    assert has_even_face(design) is even
    assert cover_of(design) == (0.0 if even else math.inf)


def test_the_box_of_the_face_is_told_in_its_coordinates():
    design = load_design("arm_segment")
    box = face_box(design)
    assert top_of(design) == box[1, 2] == 0.0
    np.testing.assert_allclose(box[:, 1], [-0.045, 0.045])
    np.testing.assert_allclose(box[:, 0], np.array([-1, 1]) * math.pi * 0.048, rtol=0.03)
