"""Drawings in DXF: each layer of the drawing is a net on the top copper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from capsense.errors import LayoutError, require_package
from capsense.layout.board import BoardLayout
from capsense.layout.curves import even_odd, outline_of, quarter_segments
from capsense.layout.stl import OUTLINES, level_layout

_UNITS = {1: 25.4, 2: 304.8, 4: 1.0, 5: 10.0, 6: 1000.0, 13: 1e-3}
"""Millimetres to the drawing's unit, by $INSUNITS."""
_KINDS = ("LINE", "ARC", "CIRCLE", "ELLIPSE", "LWPOLYLINE", "POLYLINE", "SPLINE", "HATCH", "SOLID")


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a drawing; closed outlines are areas, those within others holes.

    Raises:
        LayoutError: The file is no drawing.
        MissingDependencyError: ezdxf is not installed.
    """
    require_package("ezdxf", "ezdxf", "layout")
    import ezdxf
    from ezdxf import path as paths
    from ezdxf.disassemble import recursive_decompose

    try:
        drawing = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError) as cause:
        raise LayoutError(f"{path} is no DXF drawing: {cause}; export it anew") from None
    scale = _UNITS.get(int(drawing.header.get("$INSUNITS", 4)), 1.0)
    areas: dict[str, list[BaseGeometry]] = {}
    lines: dict[str, list[BaseGeometry]] = {}
    item: Any
    for item in recursive_decompose(drawing.modelspace()):
        if item.dxftype() not in _KINDS:
            continue
        net, width = str(item.dxf.layer), _width(item) * scale
        found = paths.from_hatch(item) if item.dxftype() == "HATCH" else [paths.make_path(item)]
        for one in found:
            points = [(p.x * scale, p.y * scale) for p in one.flattening(error / scale)]
            if len(set(points)) < 2:
                continue
            if width > 0:
                pen = quarter_segments(width / 2, error)
                stroke = LineString(points).buffer(width / 2, quad_segs=pen, cap_style="flat")
                areas.setdefault(f"{net}\0", []).append(stroke)
            elif len(points) > 3 and (one.is_closed or item.dxftype() == "HATCH"):
                areas.setdefault(net, []).append(Polygon(points))
            else:
                lines.setdefault(net, []).append(LineString(points))
    return drawn_layout(path.name, areas, lines, thickness)


def _width(item: Any) -> float:
    """Width of a polyline that is a track; 0 of all else."""
    return float(item.dxf.const_width) if item.dxf.hasattr("const_width") else 0.0


def drawn_layout(
    name: str, areas: dict[str, list[BaseGeometry]], lines: dict[str, list[BaseGeometry]],
    thickness: float,
) -> BoardLayout:  # fmt: skip
    """A layout of closed areas [mm] by net, and of loose lines that close areas together.

    A name that ends in a zero byte holds strokes, which are united; others follow even and odd.
    """
    pieces: list[tuple[str, float, BaseGeometry]] = []
    outline: list[BaseGeometry] = []
    for net in {**areas, **lines}:
        shapes = areas.get(net, [])
        closed, _ = outline_of(lines.get(net, []), 0.01)
        parts = list(shapes) if net.endswith("\0") else [even_odd(shapes)]
        parts += [] if closed is None else [closed]
        plain = net.rstrip("\0")
        for part in parts:
            if plain.lower() in OUTLINES:
                outline.append(part)
            elif not part.is_empty:
                pieces.append((plain, 0.0, part))
    return level_layout(name, pieces, outline, thickness)
