"""Areas, extents and places of shapes, against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from approximate import approx
from hypothesis import given, settings
from hypothesis import strategies as st

from capsense.design import Design, Surface, parse_design
from capsense.design.geometry import find_contact, ring_vertices
from capsense.design.shapes import CHORD_ERROR, circle_segments
from capsense.errors import DesignError


def design(*electrodes: dict[str, Any], **rest: Any) -> Design:
    """A design of electrodes E1… in an empty box."""
    named = [{"name": f"E{k}", **e} for k, e in enumerate(electrodes, start=1)]
    domain = {"size": [0.5, 0.5, 0.5], "backplane": 0.1}
    return parse_design({"name": "t", "domain": domain, "electrode": named, **rest})


def surface(shape: str, **keys: Any) -> Surface:
    """The surface of one electrode."""
    return design({"shape": shape, **keys}).electrodes[0].surface


COMB = {"fingers": 4, "finger_size": [0.002, 0.02], "pitch": 0.005, "spine_width": 0.003}
STRIPES = {"count": 3, "size": [0.004, 0.03], "pitch": 0.01}
L_SHAPE = [[0, 0], [0.03, 0], [0.03, 0.01], [0.01, 0.01], [0.01, 0.02], [0, 0.02]]
SQUARE_HOLE = [[0.002, 0.002], [0.006, 0.002], [0.006, 0.006], [0.002, 0.006]]

# shape, keys, area [mm²], extent in x and y [mm], facets, rims; all analytic
CASES: list[tuple[str, dict[str, Any], float, tuple[float, float], int, int]] = [
    ("rectangle", {"size": [0.03, 0.02]}, 600, (30, 20), 1, 4),
    ("polygon", {"points": L_SHAPE}, 400, (30, 20), 1, 6),
    ("polygon", {"points": L_SHAPE, "holes": [SQUARE_HOLE]}, 384, (30, 20), 1, 10),
    ("stripes", STRIPES, 360, (24, 30), 3, 12),
    ("stripes", {"count": 1, "size": [0.004, 0.03]}, 120, (4, 30), 1, 4),
    ("comb", COMB, 4 * 40 + 17 * 3, (17, 23), 1, 16),
    ("comb", {**COMB, "side": "left"}, 211, (23, 17), 1, 16),
    ("comb", {**COMB, "fingers": 1}, 46, (2, 23), 1, 4),
    (
        "meander",
        {"turns": 3, "width": 0.001, "pitch": 0.004, "length": 0.02},
        4 * 20 + 3 * 3,
        (13, 20),
        1,
        16,
    ),
]


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("circle", "disc"), ("Disk", "disc"), ("square", "rectangle"), ("rectangel", "rectangle"),
        ("annulus", "ring"), ("zigzag", "meander"), ("strip", "stripes"), ("triangle", "polygon"),
    ],
)  # fmt: skip
def test_another_word_for_a_shape(typed: str, meant: str) -> None:
    """By meaning, not by letters alone: a circle is more like a rectangle to these."""
    with pytest.raises(DesignError, match=f"did you mean '{meant}'"):
        surface(typed)


@pytest.mark.parametrize(("shape", "keys", "area", "extent", "facets", "rims"), CASES)
def test_straight_shapes(
    shape: str, keys: dict[str, Any], area: float, extent: tuple[float, ...], facets: int, rims: int
) -> None:
    """Area, extent and number of rims of shapes with straight edges (analytic)."""
    got = surface(shape, **keys)
    assert got.area * 1e6 == approx(area, rel=1e-9)
    assert np.ptp(got.bounds, axis=0) * 1e3 == approx([*extent, 0.0], abs=1e-9)
    assert (len(got.facets), len(got.rims)) == (facets, rims)


def test_round_shapes() -> None:
    """Areas of discs and rings are exact, round ends and corners within their chords (analytic)."""
    assert surface("disc", radius=0.02).area == approx(math.pi * 4e-4, rel=1e-12)
    ring = surface("ring", inner_radius=0.01, outer_radius=0.02)
    assert ring.area == approx(math.pi * 3e-4, rel=1e-12)
    slot = surface("stripes", count=1, size=[0.0056, 0.0546], rounded=True)
    assert slot.area == approx(0.0056 * 0.049 + math.pi * 0.0028**2, rel=5e-4)
    assert np.ptp(slot.bounds, axis=0)[:2] == approx([0.0056, 0.0546], abs=1e-9)
    tile = surface("rectangle", size=[0.03, 0.02], corner_radius=0.005)
    assert tile.area == approx(6e-4 - (4 - math.pi) * 25e-6, rel=5e-4)
    coin = surface("rectangle", size=[0.02, 0.02], corner_radius=0.01)
    assert coin.area == approx(math.pi * 1e-4, rel=1e-9)
    pill = surface("rectangle", size=[0.03, 0.02], corner_radius=0.01)
    assert pill.area == approx(2e-4 + math.pi * 1e-4, rel=3e-3)


@pytest.mark.parametrize("radius", [1e-6, 1e-4, 2.8e-3, 0.02, 0.2])
def test_arcs_stay_within_the_chord_error_or_64_segments(radius: float) -> None:
    """Chords leave the arc by no more than they may, unless there are 64 to the circle."""
    for error in (1e-6, CHORD_ERROR * 0.03, 0.01 * radius):
        n = circle_segments(radius, error)
        assert n % 4 == 0
        assert n in (8, 64) or radius * (1 - math.cos(math.pi / n)) <= error
    assert circle_segments(radius, CHORD_ERROR * radius) == 64


def test_ring_encloses_a_disc_without_contact() -> None:
    """Rings keep their hole: a disc inside is no short circuit, a larger one is."""
    ring = {"shape": "ring", "inner_radius": 0.012, "outer_radius": 0.02}
    design(ring, {"shape": "disc", "radius": 0.0119})
    with pytest.raises(DesignError, match="short circuit"):
        design(ring, {"shape": "disc", "radius": 0.0121})


@pytest.mark.parametrize("outer", [0.012, 0.01199])
def test_ring_without_width_is_refused(outer: float) -> None:
    """Limits: the radii of a ring must differ."""
    with pytest.raises(DesignError, match=r"inner_radius = 0.012 must be smaller than outer_rad"):
        surface("ring", inner_radius=0.012, outer_radius=outer)


def test_comb_sides_put_the_spine_where_they_say() -> None:
    """The spine of a comb lies at −y, +y, −x or +x."""
    spots = {"bottom": (0, -1), "top": (0, 1), "left": (-1, 0), "right": (1, 0)}
    for side, way in spots.items():
        polygon = surface("comb", **COMB, side=side).facets[0].polygon
        assert np.sign(np.round(np.array(polygon.centroid.coords[0]), 9)).tolist() == list(way)


@pytest.mark.parametrize("fingers", [2, 3, 12])
@pytest.mark.parametrize("shape", ["comb", "meander"])
def test_fingers_and_runs_that_would_merge_are_refused(shape: str, fingers: int) -> None:
    """Limits: a pitch as large as the width is too small; a little more is not."""
    width, sizes = 0.001, {"fingers": fingers, "finger_size": [0.001, 0.02], "spine_width": 0.003}
    if shape == "meander":
        sizes = {"turns": fingers, "width": width, "length": 0.02}
    for pitch in (0.5 * width, width):
        with pytest.raises(DesignError, match=r"pitch = .* must exceed"):
            surface(shape, **sizes, pitch=pitch)
    assert len(surface(shape, **sizes, pitch=1.001 * width).facets) == 1


def test_combs_interleave() -> None:
    """Two combs facing each other and shifted by half a pitch keep their gap."""
    design(
        {"shape": "comb", **COMB, "center": [-0.00125, -0.00175]},
        {"shape": "comb", **COMB, "center": [0.00125, 0.00175], "side": "top"},
    )
    with pytest.raises(DesignError, match="short circuit"):
        design(
            {"shape": "comb", **COMB, "center": [-0.0009, -0.00175]},
            {"shape": "comb", **COMB, "center": [0.0009, 0.00175], "side": "top"},
        )


def test_box_is_closed() -> None:
    """A box has six facets, twelve rims, outward normals and its own volume (analytic)."""
    box = surface("box", size=[0.02, 0.03, 0.04], center=[0.01, 0.02, 0.05], rotation=90)
    assert box.area == approx(2 * (6e-4 + 8e-4 + 12e-4), rel=1e-12)
    ends = {tuple(np.round(p, 9)) for p in box.rims.reshape(-1, 3)}
    assert ends == {(x, y, z) for x in (-0.005, 0.025) for y in (0.01, 0.03) for z in (0.03, 0.07)}
    lengths = np.linalg.norm(box.rims[:, 0] - box.rims[:, 1], axis=1)
    assert sorted(lengths) == approx(4 * [0.02] + 4 * [0.03] + 4 * [0.04])
    assert box.bounds == approx(np.array([[-0.005, 0.01, 0.03], [0.025, 0.03, 0.07]]))
    volume = 0.0
    for facet in box.facets:
        assert np.linalg.det(facet.axes) == approx(1.0)
        volume += facet.polygon.area * float(facet.origin @ facet.axes[2]) / 3
    assert volume == approx(0.02 * 0.03 * 0.04, rel=1e-12)


@pytest.mark.parametrize("rotation", [90, -270])
def test_rotation_turns_counterclockwise(rotation: float) -> None:
    """+90° takes local +x to sensor +y, and so do whole turns more or less."""
    got = surface("polygon", points=[[0, 0], [0.02, 0], [0.02, 0.01]], rotation=rotation)
    want = {(0.0, 0.0), (0.0, 0.02), (-0.01, 0.02)}
    assert {(round(x, 9) + 0.0, round(y, 9)) for x, y, _ in ring_vertices(got.facets[0])[0]} == want


def test_tilt_and_quaternion_agree() -> None:
    """Tilts about x, then y, then z, are the product of those quaternions (asymmetric pose)."""
    keys = {"points": [[0, 0], [0.02, 0], [0.02, 0.01]], "center": [0.01, 0.02, 0.1]}
    tilted = surface("polygon", tilt=[30, 40, 50], **keys)
    half = np.radians([30, 40, 50]) / 2
    quaternion = np.array([0.0, 0.0, 0.0, 1.0])
    for axis, angle in enumerate(half):
        turn = np.zeros(4)
        turn[axis], turn[3] = math.sin(angle), math.cos(angle)
        quaternion = _times(turn, quaternion)
    turned = surface("polygon", quaternion=quaternion.tolist(), **keys)
    assert tilted.rims == approx(turned.rims, abs=1e-12)
    c, s = np.cos(np.radians([30, 40, 50])), np.sin(np.radians([30, 40, 50]))
    x_axis = np.array([c[1] * c[2], c[1] * s[2], -s[1]])
    corner = ring_vertices(tilted.facets[0])[0]
    ends = corner - np.array([0.01, 0.02, 0.1])
    assert np.abs(ends - 0.02 * x_axis).sum(axis=1).min() < 1e-12


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    xyz = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*xyz, a[3] * b[3] - a[:3] @ b[:3]])


def test_horizontal_sheets_hold_sensor_coordinates() -> None:
    """A horizontal facet has the sensor's axes, also when turned over."""
    for turn in ({}, {"rotation": 45}, {"tilt": [180, 0, 0]}):
        facet = surface("rectangle", size=[0.03, 0.02], center=[0.04, 0.05, 0.06], **turn).facets[0]
        assert facet.axes.tolist() == np.eye(3).tolist()
        assert facet.origin.tolist() == [0.0, 0.0, 0.06]
        assert facet.polygon.centroid.coords[0] == approx((0.04, 0.05))


def test_triangles_cover_the_surface() -> None:
    """The triangulation has the area of the facets."""
    got = surface("comb", **COMB, tilt=[10, 20, 0])
    a, b, c = np.moveaxis(got.triangles, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == approx(got.area, rel=1e-9)


def test_leads_join_the_electrode() -> None:
    """A lead adds its area outside the patch and turns with it."""
    keys = {"size": [0.01, 0.01], "leads": [{"points": [[0, 0], [0, -0.02]], "width": 0.001}]}
    got = surface("rectangle", **keys, rotation=90)
    assert got.area == approx(1e-4 + 0.015 * 0.001, rel=1e-9)
    assert got.bounds[1, 0] == approx(0.02)


POUR = {"name": "pour", "role": "ground", "shape": "rectangle", "size": [0.1, 0.1]}


def test_clearance_is_cut_around_electrodes_and_leads() -> None:
    """The pour loses the electrode and its leads, offset by the clearance (analytic)."""
    patch = {
        "shape": "rectangle",
        "size": [0.01, 0.01],
        "leads": [{"points": [[0, 0], [0, -0.06]], "width": 0.001}],
    }
    got = design(patch, conductor=[{**POUR, "clearance": 0.0005}]).conductors[0].surface
    want = 0.1**2 - 0.011**2 - (0.05 - 0.0055) * 0.002
    assert got.area == approx(want, rel=1e-8)
    assert len(got.facets) == 1


def test_clearance_may_leave_several_pieces_and_holes() -> None:
    """A stripe across the pour halves it; a ring leaves an island."""
    stripe = {"shape": "rectangle", "size": [0.01, 0.2]}
    ring = {"shape": "ring", "inner_radius": 0.01, "outer_radius": 0.012, "center": [0.03, 0]}
    got = design(stripe, ring, conductor=[{**POUR, "clearance": 0.001}]).conductors[0].surface
    assert len(got.facets) == 3
    assert sorted(len(f.polygon.interiors) for f in got.facets) == [0, 0, 1]


@pytest.mark.parametrize(("width", "pieces"), [(8e-6, 1), (1.2e-5, 2)])
def test_slivers_that_a_clearance_leaves_are_dropped(width: float, pieces: int) -> None:
    """Limits: what is left beside the gap is narrower, or wider, than 1e-5 of the length unit."""
    width *= math.sqrt(0.01 * 0.2) / 0.03
    stripe = {"shape": "rectangle", "size": [0.01, 0.2], "center": [0.05 - 0.006 - width, 0]}
    got = design(stripe, conductor=[{**POUR, "clearance": 0.001}]).conductors[0].surface
    assert len(got.facets) == pieces


def test_clearance_keeps_its_distance_in_a_tilted_plane() -> None:
    """Also in a tilted plane the gap has the width asked for."""
    pose = {"center": [0.01, 0.02, 0.1], "tilt": [20, 30, 10]}
    patch = {"shape": "rectangle", "size": [0.02, 0.02], **pose}
    pour = {**POUR, **pose, "clearance": 0.002}
    got = design(patch, conductor=[pour]).conductors[0].surface
    assert got.area == approx(0.1**2 - 0.024**2, rel=1e-6)


def test_pour_in_another_plane_keeps_its_outline() -> None:
    """Clearance concerns one plane only."""
    patch = {"shape": "rectangle", "size": [0.01, 0.01]}
    got = design(patch, conductor=[{**POUR, "z": -0.001, "clearance": 0.001}]).conductors[0].surface
    assert got.area == approx(0.01, rel=1e-12)


def test_hash_sees_geometry_and_materials_only() -> None:
    """The content hash is the same for other names and formatting, another for other geometry."""
    base = {"shape": "rectangle", "size": [0.03, 0.02]}
    polygon = {
        "shape": "polygon",
        "points": [[0.015, 0.01], [0.015, -0.01], [-0.015, -0.01], [-0.015, 0.01]],
    }
    layer = {"name": "p", "size": [0.1, 0.1], "z": [-0.001, 0.0]}
    reference = design(base).content_hash()
    assert len(reference) == 64
    assert design(polygon).content_hash() == reference
    assert design({**base, "name": "other"}, description="x").content_hash() == reference
    assert design({**base, "center": [0, 0, -0.0], "rotation": 180}).content_hash() == reference
    named = design(base, layer=[{**layer, "material": "FR4"}]).content_hash()
    assert named == design(base, layer=[{**layer, "eps_r": 4.5}]).content_hash()
    others = [
        named,
        design(base, layer=[{**layer, "eps_r": 4.6}]).content_hash(),
        design({**base, "center": [1e-8, 0.0]}).content_hash(),
        design({**base, "z": 0.001}).content_hash(),
        design(base, conductor=[{**POUR, "z": -0.01}]).content_hash(),
        design(base, conductor=[{**POUR, "z": -0.01, "role": "shield"}]).content_hash(),
        reference,
    ]
    assert len(set(others)) == len(others)


millimetres = st.integers(-100, 100)
sizes = st.integers(1, 40)
rectangles = st.tuples(millimetres, millimetres, sizes, sizes)


@settings(max_examples=150, deadline=None)
@given(st.lists(rectangles, min_size=2, max_size=5), st.sampled_from([0, 30, 90]))
def test_rectangles_load_unless_they_touch(items: list[tuple[int, ...]], turn: int) -> None:
    """Rectangles on a half-millimetre grid load if, and only if, all pairs are apart.

    Turning all of them about the origin changes nothing (rigid motion).
    """
    clash = any(
        abs(a[0] - b[0]) * 2 <= a[2] + b[2] and abs(a[1] - b[1]) * 2 <= a[3] + b[3]
        for k, a in enumerate(items)
        for b in items[:k]
    )
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    electrodes = [
        {
            "shape": "rectangle",
            "size": [w / 1e3, h / 1e3],
            "center": [(c * x - s * y) / 1e3, (s * x + c * y) / 1e3],
            "rotation": turn,
        }
        for x, y, w, h in items
    ]
    if clash:
        with pytest.raises(DesignError, match="short circuit"):
            design(*electrodes)
    else:
        assert len(design(*electrodes).electrodes) == len(items)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-0.03, 0.03)] * 3),
    st.tuples(*[st.floats(-180, 180)] * 3),
    st.tuples(*[st.floats(-180, 180)] * 3),
)
def test_contact_agrees_with_a_dense_sampling(
    offset: tuple[float, ...], tilt: tuple[float, ...], other: tuple[float, ...]
) -> None:
    """Two tilted discs are in contact if, and only if, points of one's rim pass through the other.

    Differential: discs cross exactly where the line both planes share has overlapping chords.
    """
    radius = 0.02
    a = surface("disc", radius=radius, tilt=list(tilt), center=[0, 0, 0.2])
    b = surface(
        "disc", radius=radius, tilt=list(other), center=[offset[0], offset[1], 0.2 + offset[2]]
    )
    n1, n2 = a.facets[0].axes[2], b.facets[0].axes[2]
    c1, c2 = np.array([0, 0, 0.2]), np.array([offset[0], offset[1], 0.2 + offset[2]])
    way = np.cross(n1, n2)
    if np.linalg.norm(way) < 0.05:
        return
    way /= np.linalg.norm(way)
    point = np.linalg.solve(np.array([n1, n2, way]), [n1 @ c1, n2 @ c2, 0.0])
    spans = []
    for center in (c1, c2):
        middle = float((center - point) @ way)
        rest = radius**2 - float(np.sum((point + middle * way - center) ** 2))
        spans.append((middle, math.sqrt(rest) if rest > 0 else None, rest))
    if any(abs(rest) < 2e-6 for _, _, rest in spans):
        return
    (m1, h1, _), (m2, h2, _) = spans
    margin = None if h1 is None or h2 is None else h1 + h2 - abs(m1 - m2)
    if margin is not None and abs(margin) < 2e-4:
        return
    assert (find_contact(a, b) is not None) == (margin is not None and margin > 0)
