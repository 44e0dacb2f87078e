"""Drawings in SVG: each named group or element is a net on the top copper."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from capsense.errors import LayoutError, require_package
from capsense.layout.board import BoardLayout
from capsense.layout.curves import even_odd, quarter_segments
from capsense.layout.dxf import drawn_layout

_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a drawing; a net is named by the label or id of an element or of its group.

    Raises:
        LayoutError: The file is no drawing.
        MissingDependencyError: svgelements is not installed.
    """
    require_package("svgelements", "svgelements", "layout")
    import xml.etree.ElementTree

    import svgelements

    try:
        drawing = svgelements.SVG.parse(str(path), ppi=25.4)
    except (OSError, ValueError, xml.etree.ElementTree.ParseError) as cause:
        raise LayoutError(f"{path} is no SVG drawing: {cause}; export it anew") from None
    areas: dict[str, list[BaseGeometry]] = {}

    def visit(item: Any, net: str) -> None:
        values = getattr(item, "values", None) or {}
        own = values.get("attributes", {}).get(_LABEL) or values.get(_LABEL)
        if isinstance(item, svgelements.Group):
            net = net or str(own or item.id or "")
            for part in item:
                visit(part, net)
            return
        if not isinstance(item, svgelements.Shape):
            return
        net = net or str(own or item.id or "copper")
        rings = [_points(sub, error) for sub in svgelements.Path(item).as_subpaths()]
        filled = item.fill is None or item.fill.value is not None
        stroked = item.stroke is not None and item.stroke.value is not None
        pen = float(item.stroke_width or 0.0) if stroked else 0.0
        found: list[BaseGeometry] = []
        if filled:
            found.append(even_odd([Polygon(r) for r in rings if len(r) > 2]))
        if pen > 0 and not filled:
            segments = quarter_segments(pen / 2, error)
            found += [LineString(r).buffer(pen / 2, quad_segs=segments, cap_style="flat")
                      for r in rings if len(r) > 1]  # fmt: skip
        areas.setdefault(f"{net}\0", []).extend(a for a in found if not a.is_empty)

    for part in drawing:
        visit(part, "")
    return drawn_layout(path.name, areas, {}, thickness)


def _points(path: Any, error: float) -> list[tuple[float, float]]:
    """Corners of a path, y up, with curves as chords."""
    import svgelements

    out: list[tuple[float, float]] = []
    for segment in svgelements.Path(path):
        if isinstance(segment, svgelements.Move):
            continue
        count = 1
        if not isinstance(segment, svgelements.Line | svgelements.Close):
            length = float(segment.length(error=1e-3))
            count = max(4, min(64, math.ceil(math.pi * math.sqrt(length / (8 * error)) / 2)))
        for t in np.linspace(0.0, 1.0, count + 1):
            point = segment.point(float(t))
            if point is not None and (not out or math.dist(out[-1], (point.x, -point.y)) > 1e-9):
                out.append((float(point.x), -float(point.y)))
    return out
