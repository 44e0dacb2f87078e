"""Boards of KiCad: areas and islands against analytic values, and designs made of them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from approximate import approx
from shapely.affinity import affine_transform
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

import capsense as cs
from capsense.__main__ import main
from capsense.layout.convert import BoardDesign
from capsense.layout.sexpr import parse

SLIDER = Path(__file__).parents[3] / "examples/layout/touch_slider.kicad_pcb"
HEAD = """(kicad_pcb (version 20221018) (general (thickness 1.0))
  (layers (0 "F.Cu" signal) (31 "B.Cu" signal) (44 "Edge.Cuts" user))
  (net 0 "") (net 1 "GND") (net 2 "T1") (net 3 "T2")
"""


def board(tmp_path: Path, *items: str) -> Path:
    path = tmp_path / "board.kicad_pcb"
    path.write_text(HEAD + "\n".join(items) + ")", encoding="utf-8")
    return path


def areas(path: Path, tolerance: float = 1e-6) -> dict[str, float]:
    """Area [mm²] of each net."""
    layout = cs.load_layout(path, tolerance=tolerance)
    return {n: 1e6 * sum(s.area for s in v.values()) for n, v in layout.nets.items()}


def pad(shape: str, more: str = "", at: str = "0 0") -> str:
    return (
        f'(footprint "p" (layer "F.Cu") (at 50 50 30) (pad "1" smd {shape} (at {at}) (size 4 2) '
        f'(layers "F.Cu") {more} (net 2 "T1")))'
    )


@pytest.mark.parametrize(
    ("shape", "more", "area"),
    [
        ("rect", "", 8.0),
        ("oval", "", 2 * 2 + math.pi),
        ("circle", "", 4 * math.pi),
        ("roundrect", "(roundrect_rratio 0.25)", 8.0 - (4 - math.pi) * 0.25),
        ("roundrect", "(roundrect_rratio 0) (chamfer_ratio 0.25) (chamfer top_left)", 7.875),
        ("trapezoid", "(rect_delta 0 1)", 8.0),
        (
            "custom",
            "(options (anchor rect)) (primitives (gr_poly (pts (xy 2 -1) (xy 5 -1) (xy 5 1) "
            "(xy 2 1)) (width 0) (fill yes)))",
            14.0,
        ),
    ],
)
def test_pads(tmp_path: Path, shape: str, more: str, area: float) -> None:
    assert areas(board(tmp_path, pad(shape, more)))["T1"] == approx(area, rel=2e-3)


def test_places_of_pads_turn_with_the_footprint(tmp_path: Path) -> None:
    """A pad at (10, 0) of a footprint that is turned by 30° lies 5 mm higher on the board."""
    layout = cs.load_layout(board(tmp_path, pad("rect", at="10 0 30")))
    center = layout.nets["T1"]["F.Cu"].centroid
    assert center.x * 1e3 == approx(50 + 10 * math.cos(math.radians(30)), rel=1e-6)
    assert center.y * 1e3 == approx(-50 + 5.0, rel=1e-6)


def test_tracks_arcs_vias_and_zones(tmp_path: Path) -> None:
    path = board(
        tmp_path,
        '(segment (start 0 0) (end 10 0) (width 1) (layer "F.Cu") (net 2))',
        '(arc (start 20 0) (mid 25 5) (end 30 0) (width 0.5) (layer "F.Cu") (net 3))',
        '(via (at 50 50) (size 2) (drill 1) (layers "F.Cu" "B.Cu") (net 1))',
        '(zone (net 1) (net_name "GND") (layer "B.Cu") (filled_areas_thickness no) '
        '(filled_polygon (layer "B.Cu") (pts (xy 60 0) (xy 70 0) (xy 70 10) (xy 60 10))))',
    )
    found = areas(path)
    assert found["T1"] == approx(10 + math.pi / 4, rel=1e-3)
    assert found["T2"] == approx(0.5 * 5 * math.pi + math.pi / 16, rel=1e-3)
    assert found["GND"] == approx(2 * math.pi + 100, rel=1e-3)
    layers = cs.load_layout(path).nets["GND"]
    assert {name: len(shape.geoms) for name, shape in layers.items()} == {"F.Cu": 1, "B.Cu": 2}


def test_zone_of_old_files_has_a_pen(tmp_path: Path) -> None:
    """Before version 6, a fill is widened by half the smallest width."""
    fill = "(filled_polygon (pts (xy 60 0) (xy 70 0) (xy 70 10) (xy 60 10)))"
    path = board(tmp_path, f'(zone (net 1) (net_name "GND") (layer F.Cu) (min_thickness 1) {fill})')
    assert areas(path)["GND"] == approx(100 + 20 + math.pi / 4, rel=1e-3)


def test_drawn_copper_joins_the_net_that_it_touches(tmp_path: Path) -> None:
    path = board(
        tmp_path,
        pad("rect"),
        "(gr_poly (pts (xy 50 50) (xy 60 50) (xy 60 60) (xy 50 60)) (width 0) (fill yes) "
        '(layer "F.Cu"))',
    )
    assert set(areas(path)) == {"T1"}


def test_outline_with_a_cutout_and_missing_parts_are_noted(tmp_path: Path) -> None:
    path = board(
        tmp_path,
        pad("rect"),
        '(gr_rect (start 40 40) (end 80 60) (layer "Edge.Cuts") (width 0.1))',
        '(gr_circle (center 70 50) (end 75 50) (layer "Edge.Cuts") (width 0.1))',
        '(zone (net 1) (net_name "GND") (layer "F.Cu"))',
    )
    layout = cs.load_layout(path, tolerance=1e-6)
    assert layout.outline.area * 1e6 == approx(800 - 25 * math.pi, rel=1e-3)
    assert any("GND" in note and "not filled" in note for note in layout.notes)
    assert any("no stack-up" in note for note in layout.notes)


def test_slider_round_trip(tmp_path: Path) -> None:
    """The written file loads as the design that it was written from."""
    made = cs.load_layout(SLIDER).assign(["touch*"], ground=["GND"], cover=("acrylic", 0.002))
    made.save(tmp_path / "slider.toml")
    read = cs.load_design(tmp_path / "slider.toml")
    assert read.content_hash() == made.design.content_hash()
    assert read.electrode_names == ("TOUCH1", "TOUCH2", "TOUCH3")
    first, middle, _ = read.electrodes
    assert first.surface.area * 1e6 == approx(102.5, rel=1e-4)
    assert sorted({float(f.origin[2]) for f in middle.surface.facets}) == [-0.00153, 0.0]
    assert [(k.name, k.eps_r) for k in read.layers] == [("dielectric 1", 4.5), ("cover", 3.0)]
    text = (tmp_path / "slider.toml").read_text(encoding="utf-8")
    assert "touch_slider.kicad_pcb" in text
    assert "0.02 mm" in text


def on_board(made: BoardDesign) -> dict[tuple[str, float], BaseGeometry]:
    """Copper of a design by net and height, in mm, turned back into the axes of the board."""
    turn = -1.0 if made.side == "bottom" else 1.0
    out: dict[tuple[str, float], BaseGeometry] = {}
    for sheet in made.design.sheets:
        for facet in sheet.surface.facets:
            height = round(1e3 * turn * float(facet.origin[2]), 4) + 0.0
            matrix = (turn, 0, 0, 1, made.origin[0], made.origin[1])
            shape = affine_transform(
                affine_transform(facet.footprint, matrix), (1e3, 0, 0, 1e3, 0, 0)
            )
            key = (sheet.name, height)
            out[key] = out.get(key, Polygon()).union(shape)
    return out


def test_flipped_board_is_the_same_board(tmp_path: Path) -> None:
    """From both sides the copper is the same, at the same places and heights of the file.

    From below it is turned by half a turn about y, which is what happens to a real board; a mere
    mirror image would exchange left and right.
    """
    layout = cs.load_layout(SLIDER)
    top, bottom = (
        layout.assign(["TOUCH1", "TOUCH3"], ground=["GND", "TOUCH2"], side=side, tolerance=1e-5)
        for side in ("top", "bottom")
    )
    one, other = on_board(top), on_board(bottom)  # z = 0 is the front, where the electrodes are
    assert set(one) == set(other)
    for key, shape in one.items():
        assert shape.symmetric_difference(other[key]).area < 1e-3, key
    # seen from below, the electrode at the left of the front lies at the right
    left = [d.design.electrodes[0].surface.bounds[:, 0].mean() for d in (top, bottom)]
    assert left[0] < -0.01
    assert left[1] > 0.01


def masked(tmp_path: Path, openings: str) -> Path:
    """The slider with solder mask that is open over the pads on these layers."""
    text = SLIDER.read_text(encoding="utf-8")
    path = tmp_path / "masked.kicad_pcb"
    path.write_text(text.replace('(layers "F.Cu") (net 3', f"(layers {openings}) (net 3"))
    return path


def test_mask_is_open_over_bare_copper(tmp_path: Path) -> None:
    layout = cs.load_layout(masked(tmp_path, '"F.Cu" "F.Mask"'))
    pad = layout.nets["TOUCH2"]["F.Cu"]
    opening = layout.masks["F.Cu"].area
    assert pad.area < opening < pad.buffer(1.01e-4).area
    made = layout.assign(["TOUCH*"], ground=["GND"], mask=True)
    assert any("open over TOUCH2 (99%)" in note for note in made.notes)
    layers = {row["name"]: row for row in made.content["layer"]}
    hole = Polygon(layers["mask"]["holes"][0])
    assert hole.area == approx(opening, rel=5e-3)
    assert layers["mask"]["z"] == [0.0, 2e-5]
    assert "size" in layers["mask below"]
    closed = layout.assign(["TOUCH1"], ground=["GND"], mask=True)
    assert any("1 openings of the mask are closed" in note for note in closed.notes)
    left = layout.assign(["TOUCH*"], ground=["GND"])
    assert any("mask is left out" in note for note in left.notes)


@pytest.mark.parametrize(
    ("electrodes", "ground", "words"),
    [
        (["TUCH1"], [], "matches no net of touch_slider.kicad_pcb; valid are GND, TOUCH1"),
        (["*"], ["GND"], "'GND' of touch_slider.kicad_pcb is both electrode and ground"),
        ([], [], "no electrode is named; the nets are GND, TOUCH1"),
    ],
)
def test_wrong_nets(electrodes: list[str], ground: list[str], words: str) -> None:
    with pytest.raises(cs.LayoutError) as caught:
        cs.load_layout(SLIDER).assign(electrodes, ground=ground)
    assert words in str(caught.value)


def test_nets_that_touch(tmp_path: Path) -> None:
    crossing = (
        f'(segment (start {a}) (end {b}) (width 1) (layer "F.Cu") (net {n}))'
        for a, b, n in (("0 0", "10 0", 2), ("5 -5", "5 5", 3))
    )
    with pytest.raises(cs.LayoutError, match=r"'T1' and 'T2' touch at x = 5, y = .* mm"):
        cs.load_layout(board(tmp_path, *crossing)).assign(["T*"])


def test_damaged_files(tmp_path: Path) -> None:
    for text in (
        "(kicad_pcb (version 1)",
        "(module x)",
        "",
        "(kicad_pcb (segment (start 1) (net 1)))",
    ):
        path = tmp_path / "bad.kicad_pcb"
        path.write_text(text)
        with pytest.raises(cs.LayoutError, match="bad"):
            cs.load_layout(path)
    assert parse('(a "b \\" (c" (d 1))') == ["a", 'b " (c', ["d", "1"]]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["layout", str(SLIDER)]) == 0
    listed = capsys.readouterr().out
    assert "TOUCH3  F.Cu" in listed
    assert "--ground GND" in listed
    out = tmp_path / "slider.toml"
    words = ["--electrode", "TOUCH*", "--ground", "GND", "--tolerance", "0.05"]
    assert main(["layout", str(SLIDER), *words, "-o", str(out), "-q"]) == 0
    assert len(cs.load_design(out).electrodes) == 3
    assert main(["layout", str(SLIDER), "-o", str(out)]) == 2
