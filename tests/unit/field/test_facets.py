"""Gaps and distances of sheets, which panels are fitted to: values by hand, in any order."""

from __future__ import annotations

import math
from itertools import permutations

import numpy as np
import pytest
from field_cases import rectangle

from capsense.design.geometry import Facet, box_facets
from capsense.design.model import Design, Domain, Layer
from capsense.field.panels import FAR_PLANE, interfaces, plane_spacings, smallest_gaps

MM = 1e-3
TURNS = {
    "flat": np.eye(3),
    "over": np.diag([1.0, -1.0, -1.0]),
    "upright": np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]),
    "slanted": np.array([[1.0, 0, 0], [0, 0.8, 0.6], [0, -0.6, 0.8]]),
}


def pad(x: float, width: float, z: float = 0.0, turn: str = "flat") -> Facet:
    """A rectangle of a width [mm] and a length of 10 mm whose middle is at (x, 0, z) [mm]."""
    flat = rectangle((0.0, 0.0), (width * MM, 10 * MM))
    return Facet(flat, np.array([x, 0.0, z]) * MM, TURNS[turn])


ROW = [(pad(0, 4), 0), (pad(5, 4), 1), (pad(13, 4), 2), (pad(5, 4, 3.0), 3)]
"""Gaps of 1 and 4 mm in a plane, and a sheet 3 mm above the second."""
GAPS, SPACINGS = [1.0, 1.0, 4.0, math.inf], [10.0, 3.0, 10.0, 3.0]


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_gaps_and_spacings_of_a_row(order: tuple[int, ...]) -> None:
    """Analytic: each has its own nearest neighbour, whatever comes first."""
    sheets = [ROW[k] for k in order]
    np.testing.assert_allclose(smallest_gaps(sheets), [GAPS[k] * MM for k in order])
    np.testing.assert_allclose(plane_spacings(sheets), [SPACINGS[k] * MM for k in order])


@pytest.mark.parametrize("turn", ["flat", "over"])
@pytest.mark.parametrize("height", [0.5, 2.0, 9.9, 10.1, 60.0])
def test_a_sheet_above_counts_up_to_a_centimetre(turn: str, height: float) -> None:
    """Analytic: whichever way either of them faces."""
    sheets = [(pad(0, 4), 0), (pad(1, 4, height, turn), 1)]
    wanted = min(height * MM, FAR_PLANE)
    np.testing.assert_allclose(plane_spacings(sheets), [wanted, wanted])
    assert smallest_gaps(sheets) == [math.inf, math.inf]


@pytest.mark.parametrize("turn", ["upright", "slanted"])
def test_sheets_at_an_angle_do_not_face_each_other(turn: str) -> None:
    """Analytic: nor do they lie in one plane."""
    sheets = [(pad(0, 4), 0), (pad(0, 4, 7.0, turn), 1)]
    assert plane_spacings(sheets) == [FAR_PLANE, FAR_PLANE]
    assert smallest_gaps(sheets) == [math.inf, math.inf]


def test_sheets_beside_each_other_at_two_heights_do_not_face_each_other() -> None:
    assert plane_spacings([(pad(0, 4), 0), (pad(6, 4, 2.0), 1)]) == [FAR_PLANE, FAR_PLANE]


def test_facets_of_one_terminal_have_no_gap() -> None:
    """Analytic: those of grounded conductors, which have no number of their own, have."""
    for owner, gap in ((0, math.inf), (5, math.inf), (-1, 1 * MM)):
        sheets = [(pad(0, 4), owner), (pad(5, 4), owner)]
        np.testing.assert_allclose(smallest_gaps(sheets), [gap, gap])
    hole = Facet(
        rectangle((0, 0), (20 * MM, 20 * MM)).difference(rectangle((0, 0), (9 * MM, 14 * MM))),
        np.zeros(3), np.eye(3),
    )  # fmt: skip
    np.testing.assert_allclose(smallest_gaps([(hole, -1), (pad(0, 8), 0)]), 0.5 * MM)
    np.testing.assert_allclose(smallest_gaps([(pad(0, 4), 0), (pad(4, 4), 1)]), 1e-5)


@pytest.mark.parametrize("turn", TURNS)
def test_a_face_where_two_parts_touch_is_there_once(turn: str) -> None:
    """Analytic: areas of two boxes of which one stands on the other, under a pad, by hand."""

    def part(lower: tuple[int, ...], upper: tuple[int, ...]) -> Layer:
        low, high = np.array(lower) * MM, np.array(upper) * MM
        turned = (
            Facet(f.polygon, f.origin @ TURNS[turn], f.axes @ TURNS[turn])
            for f in box_facets(low, high)
        )
        return Layer("part", "matter", 3.0, low, high, tuple(turned))

    parts = part((-15, -10, -4), (15, 10, 0)), part((-5, -10, 0), (5, 10, 6))
    design = Design("two", Domain((0.5, 0.5, 0.5), 0.25, open=True), (), layers=parts)
    lid = Facet(pad(0, 8).polygon, np.array([0.0, 0.0, 6.0]) * MM @ TURNS[turn], TURNS[turn])
    found = sorted(face.polygon.area / MM**2 for face, _ in interfaces(design, [lid]))
    # of the wide part: below, sides, top on either side of the other and under it
    wide = [600, 120, 120, 80, 80, 200, 200, 200]
    # of the other: sides, and what the pad leaves of its top
    high = [60, 60, 120, 120, 120]
    np.testing.assert_allclose(found, sorted(wide + high), rtol=1e-9)
