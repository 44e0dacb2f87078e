"""Drawings, Gerber sets and folders of STL: areas and islands against analytic values."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense.layout.gerber import BOTTOM, TOP, GerberPart, layer_names, part_of


def found(layout: cs.BoardLayout) -> dict[str, tuple[float, int]]:
    """Area [mm²] and islands of each net."""
    return {
        net: (1e6 * sum(s.area for s in v.values()), sum(len(s.geoms) for s in v.values()))
        for net, v in layout.nets.items()
    }


def test_stl_folder(tmp_path: Path) -> None:
    """Of a thin body the upper face counts; nets lie at the heights of their files."""
    pad, ground = (trimesh.creation.box((*size, 0.035)) for size in ((10, 5), (20, 15)))
    ground.apply_translation((0, 0, -1.6))
    pad.export(tmp_path / "A.stl")
    ground.export(tmp_path / "GND.stl")
    layout = cs.load_layout(tmp_path)
    assert found(layout) == {"A": (approx(50.0), 1), "GND": (approx(300.0), 1)}
    assert sorted(layout.heights.values()) == [approx(-1.6e-3), 0.0]
    design = layout.assign(["A"], ground=["GND"]).design
    assert design.electrodes[0].surface.area == approx(50e-6, rel=1e-6)


def test_dxf(tmp_path: Path) -> None:
    ezdxf = pytest.importorskip("ezdxf")
    drawing = ezdxf.new()
    drawing.header["$INSUNITS"] = 4
    space = drawing.modelspace()
    for radius in (5, 2):
        space.add_circle((0, 0), radius, dxfattribs={"layer": "T1"})
    corners = [(10, 0), (20, 0), (20, 5), (10, 5)]
    space.add_lwpolyline(corners, close=True, dxfattribs={"layer": "T2"})
    space.add_lwpolyline([(20, 2), (30, 2)], dxfattribs={"layer": "T2", "const_width": 0.5})
    frame = [(-10, -10), (40, -10), (40, 20), (-10, 20)]
    for start, end in zip(frame, frame[1:] + frame[:1], strict=True):
        space.add_line(start, end, dxfattribs={"layer": "outline"})
    drawing.saveas(tmp_path / "a.dxf")
    layout = cs.load_layout(tmp_path / "a.dxf", tolerance=1e-6)
    assert found(layout) == {"T1": (approx(21 * math.pi, rel=1e-3), 1), "T2": (approx(55.0), 1)}
    assert layout.outline.area == approx(1500e-6, rel=1e-6)


def test_svg(tmp_path: Path) -> None:
    pytest.importorskip("svgelements")
    (tmp_path / "a.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg" width="40mm" height="20mm" viewBox="0 0 40 20">'
        '<g id="T1"><rect x="1" y="1" width="10" height="5"/><circle cx="20" cy="10" r="4"/></g>'
        '<path id="T2" d="M30 1 h5 v5 h-5 z M31 2 h2 v2 h-2 z"/>'
        '<path id="T3" d="M32 10 v8" fill="none" stroke="black" stroke-width="0.5"/></svg>'
    )
    areas = found(cs.load_layout(tmp_path / "a.svg", tolerance=1e-6))
    assert areas["T1"] == (approx(50 + 16 * math.pi, rel=2e-3), 2)
    assert areas["T2"] == (approx(21.0, rel=1e-4), 1)
    assert areas["T3"] == (approx(4.0, rel=1e-4), 1)


def test_step(tmp_path: Path) -> None:
    from capsense.mesh.gmsh_mesher import import_gmsh

    try:
        gmsh = import_gmsh()
    except cs.MissingDependencyError as error:
        pytest.skip(str(error))
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addBox(0, 0, 0, 10, 5, 0.035)
        gmsh.model.occ.addCylinder(20, 0, 0, 0, 0, 0.035, 3)
        gmsh.model.occ.synchronize()
        gmsh.write(str(tmp_path / "a.step"))
    finally:
        gmsh.finalize()
    areas = sorted(found(cs.load_layout(tmp_path / "a.step")).values())
    assert areas == [(approx(9 * math.pi, rel=3e-3), 1), (approx(50.0, rel=1e-6), 1)]


def test_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(cs.LayoutError, match="there is no layout"):
        cs.load_layout(tmp_path / "none.dxf")
    (tmp_path / "a.txt").write_text("")
    for path in (tmp_path / "a.txt", tmp_path):
        with pytest.raises(cs.LayoutError, match="of no kind that is read"):
            cs.load_layout(path)


_HEAD = "%FSLAX46Y46*%\n%MOMM*%\n"
_FILES = {
    "b-F_Cu.gbr": _HEAD
    + "%ADD10R,10X5*%\n%ADD11C,0.5*%\n%ADD12C,1*%\nD10*\nX20000000Y20000000D03*\n"
    "D11*\nX25000000Y20000000D02*\nX35000000Y20000000D01*\nD12*\nX35000000Y20000000D03*\n"
    "G36*\nX40000000Y10000000D02*\nX50000000Y10000000D01*\nX50000000Y20000000D01*\n"
    "X40000000Y20000000D01*\nX40000000Y10000000D01*\nG37*\n%LPC*%\n%ADD13R,2X2*%\nD13*\n"
    "X45000000Y15000000D03*\nM02*\n",
    "b-B_Cu.gbr": _HEAD + "%ADD12C,2*%\nD12*\nX35000000Y20000000D03*\nM02*\n",
    "b-Edge_Cuts.gbr": _HEAD + "%ADD10C,0.1*%\nD10*\nX0Y0D02*\nX60000000Y0D01*\n"
    "X60000000Y30000000D01*\nX0Y30000000D01*\nX0Y0D01*\nM02*\n",
    "b.drl": "M48\nMETRIC,TZ\nT1C0.400\n%\nG90\nG05\nT1\nX35.0Y20.0\nT0\nM30\n",
    "b.gbrjob": '{"GeneralSpecs": {"BoardThickness": 0.8}}',
}


def test_gerber(tmp_path: Path) -> None:
    """Islands that a drill joins are one net; what is drawn clear is no copper."""
    pytest.importorskip("gerbonara")
    for name, text in _FILES.items():
        (tmp_path / name).write_text(text)
    layout = cs.load_layout(tmp_path, tolerance=1e-6)
    areas = found(layout)
    assert areas["island1"] == (approx(96.0, rel=1e-6), 1)
    assert areas["island2"][0] == approx(50 + 5 + math.pi / 4 + math.pi, rel=1e-2)
    assert areas["island2"][1] == 2
    assert layout.heights == {"F.Cu": 0.0, "B.Cu": -0.8e-3}
    assert layout.outline.area == approx(1800e-6, rel=1e-6)


_PADS = {
    "p.gtl": _HEAD + "%AMTURNED*21,1,$1,$2,0,0,$3*%\n%ADD10TURNED,4X1X30*%\n%ADD11C,4X2*%\nD10*\n"
    "X10000000Y10000000D03*\nD11*\nX20000000Y10000000D03*\n%ADD12C,1*%\nD12*\n"
    "X30000000Y10000000D03*\n%TO.N,N/C*%\nX40000000Y10000000D03*\nX45000000Y10000000D03*\n"
    "%TO.N,SENSE*%\nX50000000Y10000000D03*\nM02*\n",
    "p.gbl": _HEAD + "%ADD12C,3*%\nD12*\nX30000000Y10000000D03*\nX50000000Y10000000D03*\nM02*\n",
    "p.gts": _HEAD + "%ADD10C,2*%\nD10*\nX50000000Y10000000D03*\nM02*\n",
    "p-job.gbrjob": '{"MaterialStackup": [{"Type": "SolderMask", "Thickness": 0.015},'
    '{"Type": "Copper", "Thickness": 0.035},'
    '{"Type": "Dielectric", "Thickness": 0.4, "DielectricConstant": "3.4"},'
    '{"Type": "Copper", "Thickness": 0.035}]}',
    "p.drl": "M48\nMETRIC\nT1C0.400\n%\nT1\nX29.8Y10.0G85X30.2Y10.0\nM30\n",
    "p-NPTH.drl": "M48\nMETRIC\nT1C0.400\n%\nT1\nX50.0Y10.0\nM30\n",
}


def write(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def test_gerber_pads_nets_and_stack(tmp_path: Path) -> None:
    """Turned and holed apertures, slots that join, bare holes that do not, and the job's stack."""
    pytest.importorskip("gerbonara")
    layout = cs.load_layout(write(tmp_path, _PADS), tolerance=1e-6)
    turned = next(s["F.Cu"] for s in layout.nets.values() if "F.Cu" in s
                  and abs(s["F.Cu"].centroid.x - 0.01) < 1e-6)  # fmt: skip
    assert turned.area * 1e6 == approx(4.0, rel=1e-6)
    x0, y0, x1, y1 = (1e3 * v for v in turned.bounds)
    cos, sin = math.cos(math.radians(30)), math.sin(math.radians(30))
    assert x1 - x0 == approx(4 * cos + sin, rel=1e-6)
    assert y1 - y0 == approx(4 * sin + cos, rel=1e-6)
    ring = next(s["F.Cu"] for s in layout.nets.values() if "F.Cu" in s
                and abs(s["F.Cu"].centroid.x - 0.02) < 1e-6)  # fmt: skip
    assert ring.area * 1e6 == approx(math.pi * (4 - 1), rel=1e-3)
    assert set(layout.nets["SENSE"]) == {"F.Cu"}
    assert "N/C" not in layout.nets
    joined = [net for net, layers in layout.nets.items() if len(layers) == 2]
    assert len(joined) == 1
    assert len(layout.nets) == 7
    assert layout.heights == {"F.Cu": 0.0, "B.Cu": -0.4e-3}
    assert [(s.eps_r, s.z) for s in layout.slabs] == [(3.4, (-0.4e-3, 0.0))]
    assert layout.mask == (1.5e-5, 3.3)
    assert layout.masks["F.Cu"].area * 1e6 == approx(math.pi, rel=2e-3)


@pytest.mark.parametrize("drill", [
    "M48\nINCH,TZ\nT1C0.0157\n%\nT1\nX13780Y7874\nM30\n",
    "M48\nINCH,LZ\nT1C0.0157\n%\nT1\nX013780Y007874\nM30\n",
    "M48\nMETRIC\nT1C0.400\n%\nT1\nX35000Y20000\nM30\n",
    "M48\nMETRIC,TZ,000.000\nT1C0.400\n%\nT1\nX35000Y20000\nM30\n",
    "M48\nMETRIC,TZ\nT1C0.400\n%\nT1\nX3500Y2000\nM30\n",
])  # fmt: skip
def test_gerber_drills_without_a_point(tmp_path: Path, drill: str) -> None:
    """Of the ways to read a number, that one holds which puts holes on copper."""
    pytest.importorskip("gerbonara")
    layout = cs.load_layout(write(tmp_path, _FILES | {"b.drl": drill}), tolerance=1e-6)
    assert set(layout.nets["island2"]) == {"F.Cu", "B.Cu"}


def test_gerber_negative_plane_and_unknown_files(tmp_path: Path) -> None:
    pytest.importorskip("gerbonara")
    files = {k: v for k, v in _FILES.items() if k != "b.drl"}
    files["b.gp1"] = files["b-B_Cu.gbr"]
    files["b-what.gbr"] = files["b-B_Cu.gbr"]
    layout = cs.load_layout(write(tmp_path, files), tolerance=1e-6)
    assert sum(v["In1.Cu"].area for v in layout.nets.values() if "In1.Cu" in v) * 1e6 == approx(
        1800 - math.pi, rel=1e-4
    )
    for words in ("b-what.gbr", "negative image", "no drill file"):
        assert any(words in note for note in layout.notes)


def test_gerber_sets_that_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("gerbonara")
    write(tmp_path, _FILES | {"c-F_Cu.gbr": _FILES["b-F_Cu.gbr"]})
    with pytest.raises(cs.LayoutError, match="two files for one copper layer, b-F_Cu"):
        cs.load_layout(tmp_path)
    (tmp_path / "c-F_Cu.gbr").unlink()
    repeated = _FILES["b-B_Cu.gbr"].replace("D12*", "%SRX2Y1I5.0J0*%\nD12*", 1)
    (tmp_path / "b-B_Cu.gbr").write_text(repeated)
    with pytest.raises(cs.LayoutError, match="repeats blocks"):
        cs.load_layout(tmp_path)


@pytest.mark.parametrize(("name", "kind", "place"), [
    ("x-F_Cu.gbr", "copper", TOP), ("x-B.Cu.gbr", "copper", BOTTOM), ("x-In2_Cu.gbr", "copper", 2),
    ("x.GTL", "copper", TOP), ("x.GP2", "copper", 2), ("x.G2L", "copper", 2),
    ("x.sol", "copper", BOTTOM), ("copper_inner_l3.gbr", "copper", 3), ("TOP.art", "copper", TOP),
    ("l4_secondary.art", "copper", BOTTOM), ("l2_gnd.art", "copper", 2),
    ("F200_L05.gdo", "copper", 5), ("F200_L12_Bottom.gdo", "copper", BOTTOM),
    ("board_TopMask.gbr", "mask", TOP), ("mask_sec.art", "mask", BOTTOM),
    ("x-Edge_Cuts.gbr", "outline", 0), ("x.gko", "outline", 1),
    ("x_BoardOutline.gbr", "outline", 0),
    ("x-F_SilkS.gbr", None, 0), ("x-F_Paste.gbr", None, 0), ("Top_Assembly.art", None, 0),
    ("x.gto", None, 0), ("readme.gbr", None, 0),
])  # fmt: skip
def test_names_of_gerber_files(name: str, kind: str | None, place: int) -> None:
    """Names of KiCad, Protel, Eagle, OrCAD, Allegro, Siemens and DipTrace."""
    part = part_of(name, "%FSLAX46Y46*%")
    assert (part.kind if part else None, part.place if part else 0) == (kind, place)


@pytest.mark.parametrize(("function", "part"), [
    ("Copper,L1,Top", GerberPart("copper", TOP)), ("Copper,L3,Inr", GerberPart("copper", 2)),
    ("Copper,L4,Bot,Signal", GerberPart("copper", BOTTOM)),
    ("Soldermask,Bot", GerberPart("mask", BOTTOM)),
    ("Profile,NP", GerberPart("outline")), ("Plated,1,2,Blind", GerberPart("drill", span=(1, 2))),
    ("MixedPlating,1,4", GerberPart("drill", span=(1, 4))), ("NonPlated,1,2,NPTH", None),
    ("Legend,Top", None),
])  # fmt: skip
def test_functions_of_gerber_files(function: str, part: GerberPart | None) -> None:
    """What a file says of itself counts more than its name."""
    assert part_of("x-F_Cu.gbr", f"%FSLAX46Y46*%\n%TF.FileFunction,{function}*%") == part
    assert part_of("x-F_Cu.gbr", "%FSLAX46Y46*%", function) == part


def test_names_of_copper_layers() -> None:
    assert layer_names([TOP, 2, 5, BOTTOM]) == ["F.Cu", "In1.Cu", "In2.Cu", "B.Cu"]
    assert layer_names([1, 2, 3]) == ["F.Cu", "In1.Cu", "B.Cu"]
    assert layer_names([BOTTOM]) == ["B.Cu"]
