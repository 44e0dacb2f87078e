"""Dielectric parts that are no upright boxes: cylinders, turned boxes, closed STL surfaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense import codec
from capsense.cli.design import describe
from capsense.design import parse_design
from capsense.design.solid import (
    crossing,
    cut_lines,
    depths,
    inside,
    overlap,
    self_crossing,
    thickness,
)
from capsense.design.stl import weld
from capsense.errors import MeshError
from capsense.mesh.gmsh_mesher import mesh_design
from capsense.plotting.designs import draw_design

PAD = {"name": "E", "shape": "rectangle", "size": [0.02, 0.02]}
TURN = [0.1, -0.2, 0.3, 0.9273618495495704]
BALL = {"shape": "stl", "file": "ball.stl", "unit": "mm"}
BOX = {"shape": "box", "size": [0.04, 0.03, 0.002]}
DISC = {"shape": "cylinder", "radius": 0.015, "length": 0.003}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """STL files in millimetres: a ball, a hollow ball, half of a ball's surface."""
    out = tmp_path_factory.mktemp("stl")
    ball = trimesh.creation.icosphere(2, 10.0)
    ball.export(out / "ball.stl")
    half = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > 0.0])
    half.export(out / "half.stl")
    cavity = trimesh.creation.icosphere(2, 8.0)  # its triangles face into the matter on purpose
    trimesh.util.concatenate([ball, cavity]).export(out / "shell.stl")
    other = ball.copy().apply_translation([12.0, 1.0, 0.0])
    trimesh.util.concatenate([ball, other]).export(out / "two.stl")
    folded = ball.copy()  # one surface; its top is pushed out through its bottom
    folded.vertices[folded.vertices[:, 2] > 9.0, 2] -= 25.0
    folded.export(out / "folded.stl")
    bars = [trimesh.creation.box(size) for size in ((20.0, 1.0, 0.9), (0.8, 20.0, 0.7))]
    trimesh.util.concatenate(bars).export(out / "cross.stl")  # no corner of one is in the other
    trimesh.util.concatenate([trimesh.creation.box([9.0] * 3), trimesh.creation.box(
        [5.0] * 3).apply_translation([0.3, 0.2, 7.0])]).export(out / "tower.stl")  # fmt: skip
    return out


def design(folder: Path | None, *layers: dict[str, Any], **changes: Any) -> cs.Design:
    named = [{"name": f"part {k}", "eps_r": 3.0, **layer} for k, layer in enumerate(layers)]
    data: dict[str, Any] = {
        "name": "parts",
        "domain": {"size": [0.3, 0.3, 0.3], "backplane": 0.05},
        "electrode": [{**PAD, **changes.pop("pad", {})}],
        "layer": named,
        **changes,
    }
    return parse_design(data, folder=folder)


def test_inside_and_depth(folder):
    """Against the closed form of balls, at random points; the polyhedron is 0.2 mm off."""
    points = np.random.default_rng(0).uniform(-0.012, 0.012, (400, 3))
    distance = np.linalg.norm(points, axis=1)
    for name, room in (("ball", 0.010 - distance), ("shell", 0.001 - abs(distance - 0.009))):
        part = design(folder, {**BALL, "file": f"{name}.stl"}, pad={"z": 0.03}).layers[0]
        sure = abs(room) > 2e-4
        assert (inside(points, part.surface.triangles) == (room > 0))[sure].all()
        assert (part.contains(points) == (room > 0))[sure].all()
        assert abs(depths(points, part.surface.triangles) - room).max() < 2.5e-4


def test_faces_look_outwards_whatever_the_file_says(folder):
    """The divergence theorem: ∮ r·n dS is three volumes, of the shell that without the cavity."""
    for name, volume in (("ball", 1.0), ("shell", 1.0 - 0.8**3)):
        part = design(folder, {**BALL, "file": f"{name}.stl"}, pad={"z": 0.03}).layers[0]
        flux = sum(f.polygon.area * (f.axes[2] @ f.origin) for f in part.facets)
        assert flux == approx(4 * np.pi * 1e-6 * volume, rel=0.05)


def test_thickness(folder):
    parts = design(
        folder, {**BOX, "center": [0, 0, 0.05], "quaternion": TURN},
        {**DISC, "center": [0, 0, 0.1]}, {**BALL, "file": "shell.stl", "center": [0, 0, 0.15]},
    ).layers  # fmt: skip
    assert thickness(parts[0].facets) == approx(0.002, rel=1e-9)
    assert thickness(parts[1].facets) == approx(0.003, rel=1e-9)
    assert thickness(parts[2].facets) == approx(0.002, rel=0.1)


@pytest.mark.parametrize("angle", range(2, 30))
def test_thickness_of_tilted_boxes(folder, angle):
    """Regression: rays from the middle of a face met the edge between two triangles, and missed."""
    tilted = {"shape": "box", "size": [0.03, 0.02, 0.004], "tilt": [angle, 0, 0]}
    (part,) = design(folder, {**tilted, "center": [0, 0, 0.1]}).layers
    assert thickness(part.facets) == approx(0.004, rel=1e-9)


def test_turned_box_has_its_corners_there():
    box = design(None, {**BOX, "center": [0.01, 0.02, 0.05], "tilt": [90, 0, 0]}).layers[0]
    assert box.lower == approx([-0.01, 0.019, 0.035])
    assert box.upper == approx([0.03, 0.021, 0.065])


@pytest.mark.parametrize(
    ("layers", "pad"),
    [
        ([{**DISC, "z": 0.0015}], {}),  # on its face, beyond its rim
        ([{**DISC, "radius": 0.03}], {}),  # inside
        ([{**BALL, "center": [0, 0, 0.0103]}], {}),  # above
        ([{**BALL, "file": "shell.stl"}], {"size": [0.008, 0.008]}),  # in the cavity
        ([{**DISC, "z": 0.0015}, {"size": [0.1, 0.1], "z": [-0.002, 0.0]}], {}),  # shared faces
        ([{**DISC, "z": 0.0015}, {**BOX, "z": -0.001, "rotation": 30}], {}),
        (
            [
                {**DISC, "z": 0.03},  # beside its rim, within its bounding box
                {"size": [0.004, 0.004], "z": [0.029, 0.031], "center": [0.0135, 0.0135]},
            ],
            {},
        ),
    ],
)
def test_what_may_touch(folder, layers, pad):
    assert len(design(folder, *layers, pad=pad).layers) == len(layers)


@pytest.mark.parametrize(
    ("layers", "pad", "words"),
    [
        ([BALL], {}, r'electrode "E": is partly inside of layer "part 0", at .* leave a gap'),
        ([BALL], {"size": [0.1, 0.1]}, "is partly inside"),  # no edge of the pad meets the ball
        ([{**DISC, "radius": 0.004}], {}, "is partly inside"),
        ([{**BALL, "file": "shell.stl"}], {"size": [0.013, 0.012]}, "is partly inside"),
        ([BALL, {**DISC, "radius": 0.003}], {"z": 0.03}, 'layer "part 1": overlaps layer "part 0"'),
        ([DISC, DISC], {"z": 0.03}, "overlaps"),
        ([BOX, {**BOX, "rotation": 90}], {"z": 0.03}, "overlaps"),  # a cross, no corner in either
        ([BOX, {"size": [0.01, 0.1], "z": [-0.0005, 0.0005]}], {"z": 0.03}, "overlaps"),
        ([{"size": [0.01, 0.01], "z": [0.01, 0.02]}, {"size": [0.01, 0.01], "z": [0.015, 0.03],
           "center": [0.004, 0]}], {}, r"overlaps .* at .*0\.002, 0, 0\.0175"),
        ([{**BALL, "file": "half.stl"}], {}, r"it has \d+ boundary edges.*dielectric part"),
        ([{**BALL, "file": "two.stl"}], {"z": 0.03}, r"itself, near \(.*part of its own"),
        ([{**BALL, "file": "tower.stl", "tilt": [20, 30, 0]}], {"z": 0.03}, "or touches itself"),
        ([{**BALL, "file": "folded.stl"}], {"z": 0.03}, "crosses or touches itself"),
        ([{**BALL, "file": "cross.stl"}], {"z": 0.03}, "crosses or touches itself"),  # parity holds
        ([{**BALL, "unit": "m"}], {}, r'20 m across with unit = "m".*did you mean unit = "mm"'),
        ([{**BALL, "scale": 0.001}], {}, r'0.02 mm across with unit = "mm".*"m"'),
        ([{**DISC, "center": [0.14, 0, 0]}], {}, "leaves the domain"),
        ([{**DISC, "size": [1, 1]}], {}, "size"),
        ([{**DISC, "shape": "ball"}], {}, "box, cylinder"),
        ([{**DISC, "z": [0.0, 0.003]}], {}, "z"),
    ],
)  # fmt: skip
def test_what_is_refused(folder, layers, pad, words):
    with pytest.raises(cs.DesignError, match=words):
        design(folder, *layers, pad=pad)


def test_solids_that_touch_by_a_face():
    """No edge runs through a triangle, as the numbers are exact: the insides alone tell."""
    low, high = trimesh.creation.box([8.0] * 3), trimesh.creation.box([2.0] * 3)
    for height, refused in ((5.0, True), (6.0, False)):
        tower = trimesh.util.concatenate([low, high.copy().apply_translation([2.5, 0.25, height])])
        place = self_crossing(weld(np.array(tower.triangles) / 1024.0))
        assert (place is not None) == refused


def test_a_rod_through_a_sheet_away_from_its_edges():
    """A point of the sheet inside of the rod, which no edge of the sheet meets."""
    low, high = np.array([0.275, -0.125, -0.025]), np.array([0.325, -0.075, 0.025])
    rod = trimesh.creation.box(bounds=[low, high]).triangles
    corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    place = crossing(corners[[[0, 1, 2], [0, 2, 3]]], np.array(rod))
    assert place is not None
    assert (low[:2] < place[:2]).all()
    assert (place[:2] < high[:2]).all()
    assert place[2] == approx(0.0, abs=1e-9)


def test_a_sheet_that_touches_an_edge_is_on_one_side():
    """A sheet that stands on a face, or ends at an edge, does not cross the surface."""
    box = design(None, {**BOX, "z": 0.1}).layers[0].surface
    standing = np.array([[[0.0, -0.01, 0.101], [0.0, 0.01, 0.101], [0.0, 0.0, 0.11]]])
    assert crossing(standing, box.triangles) is None
    assert crossing(standing - [0.0, 0.0, 2e-5], box.triangles) is not None
    far = design(None, {**BOX, "center": [0.04, 0, 0.1]}).layers[0].surface
    assert overlap(box, far) is None
    assert (
        overlap(box, design(None, {**BOX, "center": [0.0399, 0, 0.1]}).layers[0].surface)
        is not None
    )


def test_hash_knows_the_shape_and_recordings_keep_it(folder):
    upright = design(None, {**BOX, "z": 0.05})
    turned = design(None, {**BOX, "z": 0.05, "rotation": 10})
    assert upright.content_hash() != turned.content_hash()
    square = {**BOX, "size": [0.03, 0.03, 0.003], "z": 0.05}
    across = [design(None, {**square, "rotation": a}) for a in (30, 60)]  # in one bounding box
    np.testing.assert_allclose(*(d.layers[0].upper for d in across))
    assert len({d.content_hash() for d in across}) == 2
    ball = design(folder, {**BALL, "center": [0, 0, 0.05]})
    back = codec.design_from_json(codec.design_to_json(ball))
    assert back.content_hash() == ball.content_hash()
    assert back.layers[0].facets[3].polygon.equals(ball.layers[0].facets[3].polygon)


def test_it_is_printed_and_drawn(folder):
    ball = design(folder, {**BALL, "center": [0, 0, 0.0103], "eps_r": 2.5})
    assert "0.3 to 20.3" in describe(ball)
    axes = draw_design(ball)
    assert any("part 0" in text.get_text() for text in axes.get_legend().get_texts())


def test_bend_keeps_parts_in_place():
    bent = design(None, {**DISC, "radius": 0.02, "z": -0.026}, bend={"radius": 0.048})
    assert bent.layers[0].upper[2] == approx(-0.0245)
    with pytest.raises(cs.DesignError, match="flat layers cannot be bent"):
        design(None, {"size": [0.1, 0.1], "z": [-0.002, -0.001]}, bend={"radius": 0.048})


def test_gmsh_names_what_it_does_not_know():
    with pytest.raises(MeshError, match=r"'part 0' has a shape of its own"):
        mesh_design(design(None, {**DISC, "z": 0.05}))


def test_lines_are_cut_where_they_meet_a_surface():
    """A line through a box 2 mm thick, from 5 mm before to 13 mm behind, and one beside."""
    box = design(None, {**BOX, "z": 0.1}).layers[0].surface.triangles
    line = np.array([[0.001, 0.002, 0.094], [0.001, 0.002, 0.114]])
    beside = line + np.array([0.1, 0.0, 0.0])
    found = cut_lines(line[None], box)[:, 2]
    for height in (0.094, 0.0965, 0.1, 0.1075, 0.114):
        assert np.abs(found - height).min() < 1e-9
    assert np.sort(cut_lines(beside[None], box)[:, 2]) == approx([0.094, 0.104, 0.114])
