"""Colours of materials, and what stands in the way of a look."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.scene import Material
from capsense.scene.materials import MATERIALS
from capsense.viewer.appearance import (
    COLOURS_OF,
    CONDUCTIVE,
    DEPTH,
    DIELECTRIC,
    blocks,
    colour_of,
    faces_of_hull,
    matter_legend,
)

FACES = faces_of_hull(cs.Box((0.1, 0.1, 0.1)))


def test_every_material_has_a_colour() -> None:
    """Those of the table exist; of others the class counts."""
    assert set(COLOURS_OF) <= set(MATERIALS)
    found = {name: colour_of(material) for name, material in MATERIALS.items()}
    assert len({found[n] for n in ("steel", "copper", "human", "wood", "water", "PLA")}) == 6
    assert colour_of(Material("brass", 1.0, 1e7)) == CONDUCTIVE
    assert colour_of(Material("foam", 1.2)) == DIELECTRIC
    assert colour_of(Material("water at 30 °C", 76.6, 0.05)) == COLOURS_OF["water"]


def test_the_legend_names_each_material_once_as_text() -> None:
    steel, odd = MATERIALS["steel"], Material("<b>", 2.0)
    page = matter_legend([steel, odd, steel])
    assert page.count("steel") == 1
    assert "&lt;b&gt;" in page
    assert matter_legend([]) == ""


@pytest.mark.parametrize(
    ("eye", "point", "blocked"),
    [
        ((0.0, 0.0, 1.0), (0.0, 0.0, -0.2), True),
        ((0.0, 0.0, 1.0), (0.0, 0.0, 0.06), False),  # in front of it
        ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0503), True),  # drawn in its face
        ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), True),  # in it
        ((0.0, 0.0, 1.0), (0.2, 0.0, -0.2), False),  # past it
        ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), True),  # out of it
        ((1.0, 0.0, 0.2), (-1.0, 0.0, 0.2), False),  # above it, along a face
        ((-0.2, 0.0, 0.0501 + 0.25 * DEPTH), (0.2, 0.0, 0.0501 - 0.25 * DEPTH), True),
        ((0.04, 0.0, 0.064), (0.064, 0.0, 0.04), False),  # grazes an edge
    ],
)
def test_blocks(eye: tuple[float, ...], point: tuple[float, ...], blocked: bool) -> None:
    assert blocks(FACES, np.array(eye), np.array([(0.0, 0.0, 0.9), point])) is blocked


def test_a_flat_thing_hides_nothing() -> None:
    sheet = cs.TriMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]])
    faces = faces_of_hull(sheet)
    assert not blocks(faces, np.array([0.2, 0.2, 1.0]), np.array([[0.2, 0.2, -1.0]]))
