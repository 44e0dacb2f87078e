"""Bent sheets and closed cylinders: areas, places, rims, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely
from approximate import approx

from capsense.design import Design, Surface, load_design, parse_design
from capsense.design.geometry import find_contact, ring_vertices
from capsense.design.shapes import STRIP_ERROR
from capsense.errors import DesignError

Array = np.ndarray
RADIUS = 0.05


def design(*electrodes: dict[str, Any], radius: float | None = RADIUS, **rest: Any) -> Design:
    """A design of electrodes E1…, bent unless ``radius`` is None."""
    named = [{"name": f"E{k}", **e} for k, e in enumerate(electrodes, start=1)]
    domain = {"size": [0.5, 0.5, 0.5], "backplane": 0.2}
    bend = {} if radius is None else {"bend": {"radius": radius}}
    return parse_design({"name": "t", "domain": domain, "electrode": named, **bend, **rest})


def bent(**keys: Any) -> Surface:
    """The surface of one bent electrode."""
    return design(keys).electrodes[0].surface


def vertices(surface: Surface) -> Array:
    """All corners of a surface's facets [m], shape (n, 3)."""
    return np.concatenate([r for f in surface.facets for r in ring_vertices(f)])


def distance(points: Array, radius: float = RADIUS) -> Array:
    """Distance from the axis of the cylinder [m]."""
    return np.hypot(points[..., 0], points[..., 2] + radius)


SHAPES = [
    {"shape": "rectangle", "size": [0.06, 0.03]},
    {"shape": "rectangle", "size": [0.02, 0.03], "center": [0.05, 0.01]},
    {"shape": "ring", "inner_radius": 0.01, "outer_radius": 0.02},
    {"shape": "comb", "fingers": 4, "finger_size": [0.002, 0.02], "pitch": 0.005,
     "spine_width": 0.003, "side": "left"},
]  # fmt: skip


@pytest.mark.parametrize("keys", SHAPES)
def test_bending_keeps_area_and_outline(keys: dict[str, Any]) -> None:
    """Analytic: a film that is bent keeps its area and the length of its rims."""
    flat = design(keys, radius=None).electrodes[0].surface
    curved = bent(**keys)
    assert curved.area == approx(flat.area, rel=1e-9)
    length = [np.linalg.norm(s.rims[:, 1] - s.rims[:, 0], axis=1).sum() for s in (flat, curved)]
    assert length[1] == approx(length[0], rel=1e-9)


@pytest.mark.parametrize("z", [0.0, -0.01, 0.004])
def test_a_bent_rectangle_lies_on_its_cylinder(z: float) -> None:
    """Analytic: corners, middles of strips and rims are within the chord error of the radius."""
    surface = bent(shape="rectangle", size=[0.06, 0.03], center=[0.01, 0.02], z=z)
    middles = np.array([f.origin for f in surface.facets])
    for points in (vertices(surface), middles, surface.rims.reshape(-1, 3)):
        assert np.abs(distance(points) - (RADIUS + z)).max() < 1.1 * STRIP_ERROR
    angle = np.arctan2(vertices(surface)[:, 0], vertices(surface)[:, 2] + RADIUS)
    assert angle.min() == approx(-0.02 / RADIUS, abs=1e-9)
    assert angle.max() == approx(0.04 / RADIUS, abs=1e-9)
    assert surface.bounds[:, 1] == approx([0.005, 0.035])


def test_strips_meet_and_their_normals_point_outward() -> None:
    """Invariant: neighbouring strips share their corners; axes are right-handed."""
    surface = bent(shape="rectangle", size=[0.06, 0.03])
    assert len(surface.facets) > 5
    corners = np.round(vertices(surface), 9)
    assert len(np.unique(corners, axis=0)) == 2 * (len(surface.facets) + 1)
    for facet in surface.facets:
        assert np.cross(facet.axes[0], facet.axes[1]) == approx(facet.axes[2])
        assert facet.axes[2] @ (facet.origin - [0, 0, -RADIUS]) > 0
        assert facet.polygon.exterior.is_ccw


def test_clearance_is_cut_before_bending() -> None:
    """Differential: the gap of a bent pour is that of the flat one."""
    pour = {"name": "pour", "role": "ground", "shape": "rectangle", "size": [0.08, 0.05],
            "clearance": 0.002}  # fmt: skip
    keys = {"shape": "rectangle", "size": [0.02, 0.02]}
    flat = design(keys, radius=None, conductor=[pour])
    curved = design(keys, conductor=[pour])
    assert curved.conductors[0].surface.area == approx(flat.conductors[0].surface.area)
    assert find_contact(curved.electrodes[0].surface, curved.conductors[0].surface) is None


def test_what_is_not_level_is_not_bent() -> None:
    """Boxes, cylinders and tilted sheets keep their place."""
    other = [
        {"name": "box", "role": "ground", "shape": "box", "size": [0.02, 0.02, 0.02], "z": -0.1},
        {"name": "upright", "role": "ground", "shape": "rectangle", "size": [0.02, 0.02],
         "center": [0.1, 0.1, 0.05], "tilt": [90, 0, 0]},
    ]  # fmt: skip
    keys = {"shape": "rectangle", "size": [0.02, 0.02]}
    flat, curved = (design(keys, radius=r, conductor=other) for r in (None, RADIUS))
    for a, b in zip(flat.conductors, curved.conductors, strict=True):
        assert b.surface.bounds == approx(a.surface.bounds)
    assert flat.content_hash() != curved.content_hash()


def cylinder(**keys: Any) -> Surface:
    """A conducting cylinder, far from an electrode."""
    item = {"name": "c", "role": "ground", "shape": "cylinder", "radius": 0.04, "length": 0.1}
    keys = {"center": [0, 0, -0.1], **keys}
    electrode = {"shape": "rectangle", "size": [0.02, 0.02], "center": [0.15, 0.15]}
    return design(electrode, radius=None, conductor=[item | keys]).conductors[0].surface


def test_a_cylinder_is_closed_and_of_the_right_size() -> None:
    """Analytic: area of the mantle, radius; the solid's volume by the divergence theorem."""
    surface = cylinder()
    mantle = [f for f in surface.facets if abs(f.axes[2, 2]) < 0.5]
    caps = [f for f in surface.facets if abs(f.axes[2, 2]) > 0.5]
    assert sum(f.polygon.area for f in mantle) == approx(math.tau * 0.04 * 0.1, rel=1e-9)
    assert [f.polygon.area for f in caps] == approx([math.pi * 16e-4] * 2, rel=5e-3)
    out = np.hypot(*vertices(surface)[:, :2].T)
    assert np.abs(out - 0.04).max() < 1.1 * STRIP_ERROR
    triangles = surface.triangles
    volume = np.einsum("ni,ni->n", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2]))
    assert abs(volume.sum()) / 6 == approx(math.pi * 16e-4 * 0.1, rel=5e-3)


def test_a_cylinder_may_lie_along_y() -> None:
    """Differential: turned by 90° about x, as the packaged arm segment uses it."""
    upright, lying = cylinder(), cylinder(tilt=[90, 0, 0])
    assert np.ptp(lying.bounds, axis=0) == approx(np.ptp(upright.bounds, axis=0)[[0, 2, 1]])
    assert lying.bounds.mean(axis=0) == approx([0, 0, -0.1])


RECTANGLE = {"shape": "rectangle", "size": [0.02, 0.02]}


@pytest.mark.parametrize(
    ("keys", "rest", "words"),
    [
        ({"size": [0.32, 0.02]}, {}, ["E1", "more than the way round", "0.1571"]),
        ({"size": [0.02, 0.02], "center": [0.15, 0]}, {}, ["E1", "more than the way round"]),
        ({"z": -0.06}, {}, ["E1", "z = -0.06", "at or below the axis"]),
        ({}, {"bend": {"radius": -1.0}}, ["bend", "radius"]),
        ({}, {"bend": {"radius": 0.05, "axis": "y"}}, ["bend", "axis"]),
        ({}, {"layer": [{"name": "plate", "eps_r": 3.0, "size": [0.1, 0.1], "z": [-0.001, 0.0]}]},
         ["plate", "cannot be bent", "[bend]"]),
    ],
)  # fmt: skip
def test_refused(keys: dict[str, Any], rest: dict[str, Any], words: list[str]) -> None:
    """Refused by name, with the fix."""
    with pytest.raises(DesignError) as caught:
        design(RECTANGLE | keys, **rest)
    for word in words:
        assert word in str(caught.value)


def test_arm_segment() -> None:
    """Six equal electrodes on the shell, 3 mm above a driven housing, mirror images in pairs."""
    segment = load_design("arm_segment")
    assert segment.electrode_names == ("E1", "E2", "E3", "E4", "E5", "E6")
    (housing,) = segment.conductors
    assert housing.role == "shield"
    radius = 0.048
    for electrode in segment.electrodes:
        assert electrode.surface.area == approx(0.022 * 0.038, rel=1e-9)
        assert np.abs(distance(vertices(electrode.surface), radius) - radius).max() < 1.2e-4
        shadows = [shapely.Polygon(r[:, :2]).area for f in electrode.surface.facets
                   for r in ring_vertices(f)]  # fmt: skip
        assert min(shadows) > 0
    out = distance(vertices(housing.surface), radius)
    assert out.max() < 0.045 + 1.2e-4
    mirrored = [(0, 2), (3, 5), (0, 3)]
    for (i, j), axis in zip(mirrored, (0, 0, 1), strict=True):
        one, other = (segment.electrodes[k].surface.bounds.copy() for k in (i, j))
        one[:, axis] *= -1
        assert np.sort(one, axis=0) == approx(np.sort(other, axis=0), abs=1e-12)
