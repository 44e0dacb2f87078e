"""Gerber sets: a folder or archive of copper layers, drill files and outline."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import BadZipFile, ZipFile

import shapely
from shapely.geometry import LineString, MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from capsense.errors import LayoutError, require_package
from capsense.layout.board import BoardLayout
from capsense.layout.curves import outline_of, quarter_segments
from capsense.layout.kicad import FR4
from capsense.layout.model import Slab, gather, in_metres, polygons_of, united


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a set; nets are islands of copper that drills join, or those that the files name.

    Raises:
        LayoutError: The set has no copper, or a file is damaged.
        MissingDependencyError: gerbonara is not installed.
    """
    require_package("gerbonara", "gerbonara", "layout")
    where = path if path.is_dir() or path.suffix.lower() == ".zip" else path.parent
    copper: dict[str, list[tuple[BaseGeometry, str]]] = {}
    drills: list[BaseGeometry] = []
    edges: list[BaseGeometry] = []
    try:
        with TemporaryDirectory() as spare, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if where.is_file():
                with ZipFile(where) as archive:
                    archive.extractall(spare)
                where = Path(spare)
            whole, notes = _thickness(where, thickness)
            files = sorted((r, f) for f in where.rglob("*") if (r := _role(f)) is not None)
            for (_, role), file in files:
                layer = _opened(file, role)
                if role == "drill":
                    drills += [shape for shape, _, _ in _shapes(layer, error)]
                elif role == "outline":
                    edges += _edges(layer, error)
                else:
                    copper[role] = list(_islands(layer, error))
    except (
        OSError,
        ValueError,
        SyntaxError,
        LookupError,
        AttributeError,
        ArithmeticError,
        BadZipFile,
    ) as cause:
        raise LayoutError(f"{path} is no Gerber set that can be read: {cause}") from None
    outline, _ = outline_of(edges, 0.05)
    count = max(len(copper) - 1, 1)
    heights = {name: -whole * k / count + 0.0 for k, name in enumerate(copper)}
    pieces = _joined(copper, drills)
    return BoardLayout(
        path.name, gather(pieces, in_metres), {k: z * 1e-3 for k, z in heights.items()},
        (Slab("board", FR4, (-whole * 1e-3, 0.0)),),
        None if outline is None else in_metres(outline), notes=tuple(notes),
    )  # fmt: skip


_ROLES = (
    (r"FileFunction,Copper,L1,|[-_.]F[._]Cu\.|\.gtl$|copper_top", (0, "F.Cu")),
    (r"FileFunction,Copper,L\d+,Bot|[-_.]B[._]Cu\.|\.gbl$|copper_bottom", (99, "B.Cu")),
    (r"FileFunction,Copper,L(\d+),Inr|[-_.]In(\d+)[._]Cu\.|\.g(\d+)$", (1, "In")),
    (r"FileFunction,Profile|[-_.]Edge[._]Cuts\.|\.gm1$|\.gko$|profile", (100, "outline")),
    (r"\bM48\b", (101, "drill")),
)
"""What a file is by its head and name, and the order of layers from the top down."""


def _role(file: Path) -> tuple[int, str] | None:
    """Place in the order of layers, and what a file is; None of what is not read."""
    if not file.is_file() or file.suffix.lower() == ".gbrjob":
        return None
    head = file.read_bytes()[:4000].decode("latin-1")
    named = re.search(r"FileFunction,[^*\n]*", head)
    text = f"{named[0]}" if named and "M48" not in head else f"{head} {file.name}"
    if not named and "M48" not in head and "%FS" not in head:
        return None
    for pattern, (order, role) in _ROLES:
        if found := re.search(pattern, text, re.IGNORECASE):
            number = next((g for g in found.groups() if g), "")
            return order + (int(number) if number else 0), role + (f"{number}.Cu" if number else "")
    return None


def _opened(file: Path, role: str) -> Any:
    from gerbonara import ExcellonFile, GerberFile

    return (ExcellonFile if role == "drill" else GerberFile).open(file)


def _thickness(where: Path, thickness: float) -> tuple[float, list[str]]:
    """Thickness of the board [mm], and what was assumed."""
    for job in sorted(where.glob("*.gbrjob")) if where.is_dir() else ():
        try:
            found = json.loads(job.read_text())["GeneralSpecs"]["BoardThickness"]
            return float(found), [f"Permittivity {FR4} of FR4 is assumed."]
        except (ValueError, LookupError, TypeError):
            continue
    return thickness, [f"The set states no thickness: FR4 of permittivity {FR4}, {thickness:g} mm "
                       "thick, is assumed."]  # fmt: skip


def _chords(poly: Any, error: float) -> list[tuple[float, float]]:
    """Corners of an outline of lines and arcs."""
    out: list[tuple[float, float]] = []
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


def _shapes(layer: Any, error: float) -> Iterator[tuple[BaseGeometry, bool, str]]:
    """Polygons [mm] of a layer, whether they add copper, and their net."""
    from gerbonara.utils import MM

    for item in layer.objects:
        attributes = getattr(item, "attrs", None)
        attributes = attributes if isinstance(attributes, dict) else {}
        net = next(iter(attributes.get(".N", ()) or ()), "")
        for primitive in item.to_primitives(unit=MM):
            dark = bool(getattr(primitive, "polarity_dark", True))
            if hasattr(primitive, "x1"):  # a stroke with round ends
                pen = float(primitive.width) / 2
                stroke = LineString(_line(primitive, error))
                yield stroke.buffer(pen, quad_segs=quarter_segments(pen, error)), dark, str(net)
                continue
            outline = _chords(primitive.to_arc_poly(), error)
            if len(outline) > 2:
                shape = Polygon(outline)
                yield (shape if shape.is_valid else shape.buffer(0)), dark, str(net)


def _islands(layer: Any, error: float) -> Iterator[tuple[BaseGeometry, str]]:
    """Connected copper of a layer, with the net that the file gives it, if any."""
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
        if net and adds:
            named.append((shape.representative_point(), net))
    tree = shapely.STRtree([p for p, _ in named])
    for island in polygons_of(area):
        hits = tree.query(island, predicate="intersects") if named else ()
        yield island, next((named[k][1] for k in hits), "")


def _line(primitive: Any, error: float) -> list[tuple[float, float]]:
    """Points of a stroke's centre line, straight or an arc."""
    ends = [(primitive.x1, primitive.y1), (primitive.x2, primitive.y2)]
    if not hasattr(primitive, "cx"):
        return ends
    from gerbonara.graphic_primitives import ArcPoly

    center = (primitive.clockwise, (primitive.cx, primitive.cy))
    return [*_chords(ArcPoly(ends, [center, None]), error), ends[-1]]


def _edges(layer: Any, error: float) -> Iterator[BaseGeometry]:
    """Centre lines of a drawn outline [mm]."""
    from gerbonara.utils import MM

    for item in layer.objects:
        for primitive in item.to_primitives(unit=MM):
            if hasattr(primitive, "x1"):
                yield LineString(_line(primitive, error))
            else:
                yield Polygon(_chords(primitive.to_arc_poly(), error)).exterior


def _joined(
    copper: dict[str, list[tuple[BaseGeometry, str]]], drills: list[BaseGeometry]
) -> list[tuple[str, str, BaseGeometry]]:
    """Islands with the name of their net; those that a drill joins share it."""
    rows = [(layer, shape, net) for layer, found in copper.items() for shape, net in found]
    group = list(range(len(rows)))

    def root(k: int) -> int:
        while group[k] != k:
            k = group[k]
        return k

    tree = shapely.STRtree([shape for _, shape, _ in rows])
    for drill in drills:
        hits = [int(k) for k in tree.query(drill, predicate="intersects")]
        for k in hits[1:]:
            group[root(k)] = root(hits[0])
    members: dict[int, list[int]] = {}
    for k in range(len(rows)):
        members.setdefault(root(k), []).append(k)
    ordered = sorted(members.values(), key=lambda m: -sum(rows[k][1].area for k in m))
    out = []
    for number, ks in enumerate(ordered, start=1):
        net = next((rows[k][2] for k in ks if rows[k][2]), f"island{number}")
        out += [(net, rows[k][0], united([rows[k][1]])) for k in ks]
    return out
