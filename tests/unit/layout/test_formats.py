"""Drawings, Gerber sets and folders of STL: areas and islands against analytic values."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import trimesh
from approximate import approx

import capsense as cs


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
