"""Single files of a Gerber set: copper, outlines and drills as polygons [mm]."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shapely
import shapely.affinity
from shapely.geometry import LineString, MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from capsense.layout.curves import XY, quarter_segments
from capsense.layout.model import polygons_of

NO_NET = "N/C"
"""Name that X2 gives to the net of a pad that is connected to nothing."""


def opened(file: Path) -> Any:
    """An image in Gerber format.

    Raises:
        ValueError: The file has commands that would be lost.
    """
    from gerbonara import GerberFile

    text = file.read_bytes().decode("latin-1")
    lost = re.search(r"%(SRX(?!1Y1\D)[^*]*|AB[^*]+)\*", text)
    if lost:
        raise ValueError(
            f"{file.name} repeats blocks ({lost[1]}); export one board without a panel"
        )
    return GerberFile.open(file)


def islands(layer: Any, error: float) -> Iterator[tuple[BaseGeometry, str]]:
    """Connected areas of an image, with the net that the file gives it, if any."""
    area: BaseGeometry = MultiPolygon()
    batch: list[BaseGeometry] = []
    named: list[tuple[BaseGeometry, str]] = []
    dark = True
    for shape, adds, net in [*_shapes(layer, error), (MultiPolygon(), None, "")]:
        if adds is not dark:  # what comes later clears, or is drawn over, what was there
            patch = shapely.union_all(batch)
            area = area.union(patch) if dark else area.difference(patch)
            batch, dark = [], bool(adds)
        batch.append(shape)
        if net not in ("", NO_NET) and adds:
            named.append((shape.representative_point(), net))
    tree = shapely.STRtree([p for p, _ in named])
    for island in polygons_of(area):
        hits = tree.query(island, predicate="intersects") if named else ()
        yield island, next((named[k][1] for k in hits), "")


def edges(layer: Any, error: float) -> Iterator[BaseGeometry]:
    """Centre lines of a drawn outline."""
    from gerbonara.utils import MM

    for item in layer.objects:
        for primitive in item.to_primitives(unit=MM):
            if hasattr(primitive, "x1"):
                yield LineString(_line(primitive, error))
            else:
                yield _area(primitive, error).exterior


def _shapes(layer: Any, error: float) -> Iterator[tuple[BaseGeometry, bool, str]]:
    """Polygons of an image, whether they add copper, and their net."""
    from gerbonara.utils import MM

    for item in layer.objects:
        attributes = getattr(item, "attrs", None)
        attributes = attributes if isinstance(attributes, dict) else {}
        net = str(next(iter(attributes.get(".N", ()) or ()), ""))
        adds = bool(getattr(item, "polarity_dark", True))
        shape: BaseGeometry | None = None
        for primitive in item.to_primitives(unit=MM):
            part = _shape(primitive, error)
            if bool(getattr(primitive, "polarity_dark", True)) == adds:
                shape = part if shape is None else shape.union(part)
            elif shape is not None:  # holes of an aperture clear nothing but the aperture
                shape = shape.difference(part)
        if shape is not None and not shape.is_empty:
            yield shape, adds, net


def _shape(primitive: Any, error: float) -> BaseGeometry:
    if hasattr(primitive, "x1"):  # a stroke with round ends
        pen = float(primitive.width) / 2
        line = LineString(_line(primitive, error))
        return line.buffer(pen, quad_segs=quarter_segments(pen, error))
    shape = _area(primitive, error)
    return shape if shape.is_valid else shape.buffer(0)


def _area(primitive: Any, error: float) -> Polygon:
    if hasattr(primitive, "rotation"):  # gerbonara 1.5 does not turn the corners of rectangles
        w, h = primitive.w / 2, primitive.h / 2
        turned = shapely.affinity.rotate(
            box(-w, -h, w, h), primitive.rotation, origin=(0, 0), use_radians=True
        )
        return shapely.affinity.translate(turned, primitive.x, primitive.y)
    corners = _chords(primitive.to_arc_poly(), error)
    return Polygon(corners) if len(corners) > 2 else Polygon()


def _chords(poly: Any, error: float) -> list[XY]:
    """Corners of an outline of lines and arcs."""
    out: list[XY] = []
    for start, end, (clockwise, center) in poly.segments:
        out.append(start)
        if clockwise is None or center is None or math.dist(start, center) < 1e-9:
            continue
        radius = math.dist(start, center)
        first = math.atan2(start[1] - center[1], start[0] - center[0])
        turn = (math.atan2(end[1] - center[1], end[0] - center[0]) - first) % (2 * math.pi)
        turn = (turn or 2 * math.pi) - (2 * math.pi if clockwise else 0.0)
        count = math.ceil(abs(turn) / (math.pi / 2) * quarter_segments(radius, error))
        out += [(center[0] + radius * math.cos(first + turn * k / count),
                 center[1] + radius * math.sin(first + turn * k / count))
                for k in range(1, count)]  # fmt: skip
    return out


def _line(primitive: Any, error: float) -> list[XY]:
    """Points of a stroke's centre line, straight or an arc."""
    ends = [(primitive.x1, primitive.y1), (primitive.x2, primitive.y2)]
    if not hasattr(primitive, "cx"):
        return ends
    from gerbonara.graphic_primitives import ArcPoly

    center = (primitive.clockwise, (primitive.cx, primitive.cy))
    return [*_chords(ArcPoly(ends, [center, None]), error), ends[-1]]


_DIGITS = ((2, 4), (3, 3), (2, 5), (3, 4), (4, 4), (2, 3), (3, 2), (3, 5), (4, 2))
"""Digits before and after the point that coordinates without a point may have."""


def drills(file: Path, copper: shapely.STRtree, error: float) -> tuple[list[BaseGeometry], float]:
    """Plated holes and slots of a drill file, and the part of them that meets copper.

    Files that do not say where the point of their numbers stands are read in the way that puts
    most holes on copper. Holes are plated unless the file says that they are not.

    Raises:
        SyntaxError: The file cannot be read in any way.
    """
    from gerbonara import ExcellonFile
    from gerbonara.cam import FileSettings
    from gerbonara.utils import MM, Inch

    text = file.read_bytes().decode("latin-1")
    slots = _SLOT.sub(r"G00\1\nM15\nG01\2\nM16\nG05", text)

    def tried(settings: Any) -> tuple[list[BaseGeometry], float]:
        if slots != text:
            found = ExcellonFile.from_string(slots, settings=settings, filename=file)
        else:
            found = ExcellonFile.open(file, settings=settings)
        holes = [_shape(p, error) for item in found.objects if item.plated is not False
                 for p in item.to_primitives(unit=MM)]  # fmt: skip
        hits = sum(len(copper.query(h, predicate="intersects")) > 0 for h in holes)
        return holes, hits / max(len(holes), 1)

    cause: Exception | None = None
    best: tuple[list[BaseGeometry], float] = ([], -1.0)
    try:
        best = tried(None)
    except (SyntaxError, ValueError, TypeError) as error_:
        cause = error_
    if (not best[0] and cause is None) or best[1] > 0.5:
        return best
    for unit in (MM, Inch):
        for zeros in ("leading", "trailing"):
            for digits in _DIGITS:
                settings = FileSettings(unit=unit, zeros=zeros, number_format=digits)
                try:
                    found = tried(settings)
                except (SyntaxError, ValueError, TypeError):
                    continue
                best = max(best, found, key=lambda f: f[1])
    if best[1] < 0:
        raise SyntaxError(f"{file.name}: {cause}")
    return best


_SLOT = re.compile(r"^((?:[XY][-+\d.]+)+)G85((?:[XY][-+\d.]+)+)[ \t\r]*$", re.MULTILINE)
"""A slot by its two ends, which gerbonara 1.5 does not read; routing says the same."""
