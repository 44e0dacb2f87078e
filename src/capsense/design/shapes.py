"""Parametric shapes of electrodes and other conductors, flat and round.

Each planar shape is a function from a design table to polygons [m] in the shape's own plane,
centred on its own origin; :data:`SHAPES` lists them with the keys that they read.

Closed cylinders are made of flat strips, as bent films are (:mod:`capsense.design.film`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
import shapely.affinity
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon, box
from shapely.geometry.polygon import orient

from capsense.design.geometry import (
    DesignTable,
    Facet,
    Placement,
    Surface,
    boundary_segments,
    place_polygons,
)

Array = NDArray[np.float64]

CHORD_ERROR = 1 / 3000
"""Arcs are replaced by chords that leave them by at most this, over the longer side of what they
are part of ..."""
MAX_SEGMENTS = 64
"""... or by this many chords to the circle, whichever is coarser."""


STRIP_ERROR = 1 / 450
"""Flat strips of a round surface leave it by about this part of its radius."""


def circle_segments(radius: float, error: float) -> int:
    """Chords to the full circle of a radius [m]: a multiple of 4 from 8 to 64.

    ``error`` is how far they may leave the circle [m].
    """
    if radius <= 2 * error:
        return 8
    exact = math.pi / math.acos(1.0 - error / radius)
    return max(8, min(MAX_SEGMENTS, 4 * math.ceil(exact / 4)))


def _circle(radius: float) -> Polygon:
    """A regular polygon with the area of the circle, which is what capacitance feels most."""
    n = circle_segments(radius, 2 * CHORD_ERROR * radius)
    angle = 2 * math.pi * np.arange(n) / n
    r = radius * math.sqrt((2 * math.pi / n) / math.sin(2 * math.pi / n))
    return Polygon(np.column_stack([r * np.cos(angle), r * np.sin(angle)]))


def _rounded(outline: Polygon, radius: float) -> Polygon:
    """Round the convex corners of an outline."""
    x0, y0, x1, y1 = outline.bounds
    segments = circle_segments(radius, CHORD_ERROR * max(x1 - x0, y1 - y0)) // 4
    return outline.buffer(-radius, join_style="mitre").buffer(radius, quad_segs=segments)


def _bar(width: float, height: float, x: float = 0.0, y: float = 0.0) -> Polygon:
    return box(x - width / 2, y - height / 2, x + width / 2, y + height / 2)


def rectangle(table: DesignTable) -> list[Polygon]:
    """``size`` = [x, y] [m]; optional ``corner_radius`` [m]."""
    sx, sy = table.sizes("size", 2, "[x, y] in metres")
    radius = table.length("corner_radius", 0.0, zero=True)
    if radius == 0.0:
        return [_bar(sx, sy)]
    if radius > min(sx, sy) / 2:
        raise table.error(
            f"corner_radius = {radius:g} does not fit size = [{sx:g}, {sy:g}]; "
            f"give at most {min(sx, sy) / 2:g}"
        )
    if radius == min(sx, sy) / 2:
        return [_slot(sx, sy)]
    return [_rounded(_bar(sx, sy), radius)]


def polygon(table: DesignTable) -> list[Polygon]:
    """``points`` = [[x, y], …] [m]; optional ``holes``, a list of such lists."""
    points = table.points("points", 3)
    raw_holes = table.data.get("holes", [])
    if not isinstance(raw_holes, list):
        raise table.error(f"holes = {raw_holes!r} must be a list of lists of [x, y] points")
    holes = [table.point_list(f"holes[{i}]", h, 3) for i, h in enumerate(raw_holes)]
    shape = Polygon(points, holes)
    if not shape.is_valid:
        reason = shapely.is_valid_reason(shape)
        raise table.error(
            f"points describe no simple outline: {reason} m; list the corners once, in order, "
            "without crossing, and keep holes inside"
        )
    if shape.area < 1e-9 * shape.length**2:
        raise table.error(
            f"points enclose an area of {shape.area:g} m²; give corners that enclose an area"
        )
    return [orient(shape)]


def polygons_surface(table: DesignTable, placement: Placement) -> Surface:
    """``polygons``: a list of outlines, each with ``points``, optional ``holes`` and ``z`` [m].

    They are one conductor, on one level or on several.

    Raises:
        DesignError: There is none, or one of them is wrong, or two on one level overlap.
    """
    rows = table.tables("polygons")
    if not rows:
        raise table.error("polygons is empty; give a list of { points = [[x, y], …] }")
    levels: dict[float, list[Polygon]] = {}
    for number, raw in enumerate(rows):
        item = DesignTable(raw, table.source, f"{table.item}: polygons[{number}]", table.limit)
        item.only(("points", "holes", "z"))
        levels.setdefault(item.coordinate("z", 0.0), []).extend(polygon(item))
    facets: list[Facet] = []
    rims = []
    for z, outlines in levels.items():
        tree = shapely.STRtree(outlines)
        for one, other in tree.query(outlines, predicate="intersects").T:
            if one < other and outlines[one].intersection(outlines[other]).area > 0.0:
                raise table.error(
                    f"polygons {one} and {other} at z = {z:g} overlap (numbers count those of one "
                    "z, from 0); unite them"
                )
        level = Placement(placement.apply(np.array([0.0, 0.0, z])), placement.rotation)
        sheet = place_polygons(outlines, level)
        facets += sheet.facets
        rims.append(sheet.rims)
    return Surface(tuple(facets), np.concatenate(rims))


def prism_facets(outline: Polygon, low: float, high: float) -> tuple[Facet, ...]:
    """Faces of an upright prism between two heights [m], normals outwards."""
    outline = orient(outline)
    down = np.diag([1.0, -1.0, -1.0])
    mirrored = orient(shapely.affinity.scale(outline, 1.0, -1.0, origin=(0, 0)))
    facets = [
        Facet(outline, np.array([0.0, 0.0, high]), np.eye(3)),
        Facet(mirrored, np.array([0.0, 0.0, low]), down),
    ]
    for ring in (outline.exterior, *outline.interiors):
        corners = np.asarray(ring.coords)
        for start, end in pairwise(corners):
            along = (end - start) / (width := float(np.hypot(*(end - start))))
            axes = np.array([[*along, 0.0], [0.0, 0.0, 1.0], [along[1], -along[0], 0.0]])
            facets.append(Facet(box(0.0, 0.0, width, high - low), np.array([*start, low]), axes))
    return tuple(facets)


def disc(table: DesignTable) -> list[Polygon]:
    """``radius`` [m]."""
    return [_circle(table.length("radius"))]


def ring(table: DesignTable) -> list[Polygon]:
    """``inner_radius`` < ``outer_radius`` [m]."""
    inner, outer = table.length("inner_radius"), table.length("outer_radius")
    if inner >= outer:
        raise table.error(
            f"inner_radius = {inner:g} must be smaller than outer_radius = {outer:g}; swap them?"
        )
    return [_circle(outer).difference(_circle(inner))]


def _slot(sx: float, sy: float) -> Polygon:
    """A bar with round ends, of full size sx × sy."""
    radius, half = min(sx, sy) / 2, abs(sx - sy) / 2
    if half == 0.0:
        return _circle(radius)
    end = (half, 0.0) if sx > sy else (0.0, half)
    line = LineString([(-end[0], -end[1]), end])
    return line.buffer(radius, quad_segs=circle_segments(radius, 2 * CHORD_ERROR * radius) // 4)


def stripes(table: DesignTable) -> list[Polygon]:
    """``count`` stripes of ``size`` = [x, y] [m] at ``pitch`` along x; optional ``rounded``."""
    count = table.integer("count", 1, 1000)
    sx, sy = table.sizes("size", 2, "[x, y] in metres, of one stripe")
    rounded = table.boolean("rounded", False)
    pitch = table.length("pitch") if count > 1 else table.length("pitch", 1.0)
    if count > 1 and pitch <= sx:
        raise table.error(
            f"pitch = {pitch:g} must exceed the stripe's size in x, {sx:g}, or the stripes merge; "
            "use a rectangle, or rotation to array the stripes along y"
        )
    one = _slot(sx, sy) if rounded else _bar(sx, sy)
    offsets = (np.arange(count) - (count - 1) / 2) * pitch
    return [shapely.affinity.translate(one, float(dx)) for dx in offsets]


def comb(table: DesignTable) -> list[Polygon]:
    """``fingers`` of ``finger_size`` = [width, length] at ``pitch`` on a spine of ``spine_width``.

    The origin is the centre of the bounding box. ``side`` says where the spine is: "bottom" (−y,
    the default), "top", "left" or "right".
    """
    fingers = table.integer("fingers", 1, 1000)
    width, length = table.sizes("finger_size", 2, "[width, length] in metres")
    spine = table.length("spine_width")
    side = table.choice("side", ("bottom", "top", "left", "right"), "bottom")
    pitch = table.length("pitch") if fingers > 1 else table.length("pitch", 1.0)
    if fingers > 1 and pitch <= width:
        raise table.error(
            f"pitch = {pitch:g} must exceed the finger's width, {width:g}, or the fingers merge"
        )
    step = pitch if fingers > 1 else 0.0
    half = ((fingers - 1) * step + width) / 2
    bottom, joint, top = -(spine + length) / 2, (spine - length) / 2, (spine + length) / 2
    points = [(half, bottom), (half, top)]
    for k in reversed(range(fingers)):
        x = (k - (fingers - 1) / 2) * step
        if k < fingers - 1:
            points += [(x + width / 2, joint), (x + width / 2, top)]
        points += [(x - width / 2, top)]
        if k > 0:
            points += [(x - width / 2, joint)]
    points.append((-half, bottom))
    turn = {"bottom": 0, "right": 90, "top": 180, "left": 270}[side]
    return [shapely.affinity.rotate(Polygon(points), turn, origin=(0, 0))]


def meander(table: DesignTable) -> list[Polygon]:
    """A serpentine track of ``width``: ``turns`` U-turns, ``length`` in y, ``pitch`` in x.

    ``length`` is the full extent in y [m].
    """
    turns = table.integer("turns", 1, 1000)
    width, pitch, length = table.length("width"), table.length("pitch"), table.length("length")
    if pitch <= width:
        raise table.error(f"pitch = {pitch:g} must exceed width = {width:g}, or the runs merge")
    if length <= 2 * width:
        raise table.error(f"length = {length:g} must exceed twice the width, {2 * width:g}")
    parts = []
    for k in range(turns + 1):
        x = (k - turns / 2) * pitch
        parts.append(_bar(width, length, x))
        if k < turns:
            y = (length - width) / 2 * (1 if k % 2 == 0 else -1)
            parts.append(_bar(pitch, width, x + pitch / 2, y))
    return [shapely.union_all(parts).simplify(0.0)]


def box_surface(table: DesignTable, placement: Placement) -> Surface:
    """The closed surface of a box: ``size`` = [x, y, z] [m] about ``center``."""
    half = np.array(table.sizes("size", 3, "[x, y, z] in metres")) / 2
    facets, corners = [], np.eye(3)
    for axis in range(3):
        u, v = corners[(axis + 1) % 3], corners[(axis + 2) % 3]
        outline = _bar(2 * half[(axis + 1) % 3], 2 * half[(axis + 2) % 3])
        for sign in (1.0, -1.0):
            local = np.array([sign * u, v, sign * corners[axis]])
            origin = placement.apply(sign * half[axis] * corners[axis])
            facets.append(Facet(outline, origin, local @ placement.rotation.T))
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    rims = []
    for a in range(8):
        for b in range(a + 1, 8):
            if np.count_nonzero(signs[a] != signs[b]) == 1:
                rims.append(placement.apply(signs[[a, b]] * half))
    return Surface(tuple(facets), np.array(rims))


@dataclass(frozen=True)
class PlanarShape:
    """A planar shape: the keys it reads and the function that makes its polygons."""

    keys: tuple[str, ...]
    build: Callable[[DesignTable], list[Polygon]]


SHAPES: dict[str, PlanarShape] = {
    "rectangle": PlanarShape(("size", "corner_radius"), rectangle),
    "polygon": PlanarShape(("points", "holes"), polygon),
    "disc": PlanarShape(("radius",), disc),
    "ring": PlanarShape(("inner_radius", "outer_radius"), ring),
    "stripes": PlanarShape(("count", "size", "pitch", "rounded"), stripes),
    "comb": PlanarShape(("fingers", "finger_size", "pitch", "spine_width", "side"), comb),
    "meander": PlanarShape(("turns", "width", "pitch", "length"), meander),
}
"""Planar shapes by name."""


def add_leads(table: DesignTable, polygons: list[Polygon]) -> list[Polygon]:
    """Unite polygons with the tracks in ``leads`` = [{points = [[x, y], …], width = …}, …].

    Lead points are in the shape's own plane and frame, and each lead must touch the shape.
    """
    out = shapely.union_all(polygons)
    for number, raw in enumerate(table.tables("leads")):
        lead = DesignTable(raw, table.source, f"{table.item}: leads[{number}]", table.limit)
        lead.only(("points", "width"))
        path = LineString(lead.points("points", 2))
        track = path.buffer(lead.length("width") / 2, cap_style="flat", join_style="mitre")
        if not track.intersects(out):
            raise lead.error(
                f"points = {lead.data['points']} do not reach the electrode; start the lead on it "
                "(points are relative to the electrode's center)"
            )
        out = out.union(track)
    return [out] if isinstance(out, Polygon) else list(out.geoms)


def planar_surface(table: DesignTable, shape: str, placement: Placement) -> Surface:
    """Build one of :data:`SHAPES`, with its leads, and place it."""
    polygons = SHAPES[shape].build(table)
    if "leads" in table:
        polygons = add_leads(table, polygons)
    return place_polygons(polygons, placement)


def cylinder_surface(table: DesignTable, placement: Placement) -> Surface:
    """The closed surface of a cylinder: ``radius`` and ``length`` [m], about its own z axis."""
    radius, length = table.length("radius"), table.length("length")
    count = circle_segments(radius, STRIP_ERROR * radius)
    half = math.pi / count
    width, distance = 2 * radius * half, radius * half / math.tan(half)
    facets: list[Facet] = []
    outline = box(-width / 2, -length / 2, width / 2, length / 2)
    for k in range(count):
        c, s = math.cos(2 * half * k), math.sin(2 * half * k)
        local = np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]])
        facets.append(
            Facet(outline, placement.apply(distance * local[2]), local @ placement.rotation.T)
        )
    angle = 2 * half * (np.arange(count) + 0.5)
    ring = distance / math.cos(half) * np.column_stack([np.cos(angle), np.sin(angle)])
    rims = []
    for sign in (1.0, -1.0):
        local = np.diag([1.0, sign, sign])
        cap = Facet(
            orient(Polygon(ring * [1.0, sign])),
            placement.apply(np.array([0.0, 0.0, sign * length / 2])),
            local @ placement.rotation.T,
        )
        facets.append(cap)
        rims.append(boundary_segments(cap))
    return Surface(tuple(facets), np.concatenate(rims))
