"""From a layout to a design: nets get roles, outlines are simplified, the stack becomes layers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import shapely.affinity
from shapely.geometry import MultiPolygon, Polygon, box
from shapely.geometry.base import BaseGeometry

from capsense._validate import as_number, suggest
from capsense.design import LAYER_EPS_R, parse_design
from capsense.design.model import Design
from capsense.errors import LayoutError
from capsense.field.boundary import build_model
from capsense.layout.model import BoardData, polygons_of
from capsense.layout.writing import design_text

GRID = 1e-6
"""Coordinates are whole multiples of this [m]."""
BOARD_TOLERANCE = 2e-4
"""Largest deviation of the simplified outline of the board [m]: its rim matters little."""
SMALL_CUTOUT = 0.01
"""Cutouts of the board smaller than this, over its area, are filled: holes of screws."""
NEARLY = 0.02
"""A board that fills its bounding rectangle but for this becomes that rectangle."""


class Plate(NamedTuple):
    """A rigid plate in front of the board."""

    material: str
    thickness: float
    """[m]"""


class NetFigures(NamedTuple):
    """What the design holds of a net."""

    net: str
    role: str
    layers: tuple[str, ...]
    islands: int
    area: float
    """[m²], of all layers"""
    panels: int


@dataclass(frozen=True, eq=False)
class BoardDesign:
    """A design made of a layout, and how it was made."""

    layout: BoardData
    design: Design
    content: Mapping[str, Any]
    """What the design's file holds."""
    tolerance: float
    """Largest deviation of the copper's outlines [m]."""
    origin: tuple[float, float]
    """Point of the board's file that is the origin of the design [m]."""
    side: str
    """Side of the board that faces the world."""
    notes: tuple[str, ...]
    """What was assumed, left out or changed: one sentence each."""

    def toml(self) -> str:
        """The design as a file, with where it comes from in comments."""
        x, y = (1e3 * v for v in self.origin)
        head = [
            f"Made by `capsense layout` from {self.layout.source}.",
            f"Outlines of copper are simplified to {self.tolerance * 1e3:.3g} mm; lengths are "
            "metres.",
            f"The origin is at x = {x:.4f}, y = {y:.4f} mm of the file (y up); "
            f"the {self.side} side faces the world.",
            *self.notes,
        ]
        return design_text(head, self.content, self.layout.nets)

    def save(self, path: str | Path) -> None:
        """Write the design to a ``.toml`` file."""
        Path(path).write_text(self.toml(), encoding="utf-8")

    def figures(self) -> tuple[list[NetFigures], int]:
        """Figures of each net, and the number of all panels of the design.

        Cutting the panels takes seconds; nothing is solved.
        """
        model = build_model(self.design.in_units)
        centers = model.panels.centers[: model.sheet_panels] * self.design.unit
        out = []
        for sheet, row in zip(self.design.sheets, _sheet_rows(self.content), strict=True):
            count = 0
            for facet in sheet.surface.facets:
                level = np.abs(centers[:, 2] - facet.origin[2]) < GRID / 2
                spots = shapely.points(centers[level, :2])
                count += int(shapely.dwithin(facet.polygon, spots, 1e-9).sum())
            layers = tuple(self.layout.nets[sheet.name])
            role = row.get("role", "electrode")
            area, islands = sheet.surface.area, len(sheet.surface.facets)
            out.append(NetFigures(sheet.name, role, layers, islands, area, count))
        return out, model.panels.size


def _sheet_rows(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [*content["electrode"], *content.get("conductor", [])]


def convert(
    layout: BoardData,
    electrodes: Sequence[str],
    roles: Mapping[str, Sequence[str]],
    *,
    name: str | None = None,
    side: str = "top",
    layers: Sequence[str] = (),
    tolerance: float = 2e-5,
    mask: bool = False,
    cover: tuple[str, float] | None = None,
) -> BoardDesign:
    """Make a design of some nets of a layout.

    Args:
        layout: The layout.
        electrodes: Names or patterns of the nets that are electrodes, in matrix order.
        roles: Names or patterns of other nets by role: ``"shield"``, ``"ground"``, ``"floating"``.
        name: Name of the design; by default that of the file.
        side: ``"top"`` or ``"bottom"``: the side of the board that faces the world.
        layers: Copper layers to take; by default all.
        tolerance: Largest deviation of the copper's outlines [m]. It is reduced to a fifth of the
            narrowest gap.
        mask: Whether solder mask becomes layers, open where it bares much copper of these nets.
        cover: Material and thickness [m] of a rigid plate in front.

    Raises:
        LayoutError: A pattern matches no net, a net has two roles, or two nets touch.
        DesignError: What comes out is no design that can be built.
    """
    if side not in ("top", "bottom"):
        raise LayoutError(f"side = {side!r}; give 'top' or 'bottom'")
    if not 1e-7 <= as_number(tolerance) <= 1e-2:
        raise LayoutError(f"tolerance = {tolerance!r}; give a length from 1e-7 to 0.01 m")
    if not electrodes:
        raise LayoutError(f"no electrode is named; the nets are {', '.join(layout.nets)}")
    assigned = _assigned(layout, electrodes, roles)
    for layer in layers:
        if layer not in layout.heights:
            raise LayoutError(
                f"layer {layer!r} is none of {layout.source}; {suggest(layer, layout.heights)}"
            )
    placed, place = _placed(layout, assigned, side, layers)
    board, notes = _board(layout, placed)
    copper, used, more = _simplified(placed, assigned, tolerance)
    origin = _center(copper, assigned)
    top = max(z for net, role in assigned.items() if role == "electrode" for z in copper[net])
    content: dict[str, Any] = {"name": name or Path(layout.source).stem, "description": ""}
    stack = _slabs(layout, board, place, origin, top)
    if mask:
        more += _add_masks(stack, layout, board, place, origin, top, copper, used)
    elif layout.masks:
        more.append("Solder mask is left out; --mask makes layers of it.")
    if cover is not None:
        stack.append(_cover(Plate(*cover), board, origin, stack))
    rows = {net: _sheet(net, copper[net], origin, top) for net in assigned}
    content["domain"] = _domain(board, origin, rows, stack)
    content["description"] = f"{len(placed)} nets of {layout.source}"
    content["electrode"] = [rows[n] for n, role in assigned.items() if role == "electrode"]
    content["layer"] = stack
    content["conductor"] = [
        {"name": n, "role": role, **{k: v for k, v in rows[n].items() if k != "name"}}
        for n, role in assigned.items()
        if role != "electrode"
    ]
    content = {k: v for k, v in content.items() if v != []}
    design = parse_design(content, source=layout.source)
    sign = 1.0 if side == "top" else -1.0
    return BoardDesign(
        layout, design, content, used, (sign * origin[0], origin[1]), side,
        (*layout.notes, *notes, *more),
    )  # fmt: skip


def _assigned(
    layout: BoardData, electrodes: Sequence[str], roles: Mapping[str, Sequence[str]]
) -> dict[str, str]:
    """Role of each net that is taken, electrodes first."""
    out: dict[str, str] = {}
    for role, patterns in {"electrode": electrodes, **roles}.items():
        for net in layout.matching(patterns, role):
            if net in out and out[net] != role:
                raise LayoutError(
                    f"net {net!r} of {layout.source} is both {out[net]} and {role}; give it one "
                    "role, or narrow the patterns"
                )
            out[net] = role
    return out


Copper = dict[str, dict[float, BaseGeometry]]
"""Polygons [m] by net and height [m]."""


class _Frame(NamedTuple):
    """How the board is turned so that the side of the sensor is up."""

    flip: bool
    depth: float
    """Height of the lowest copper [m]."""

    def shape(self, shape: BaseGeometry) -> BaseGeometry:
        return shapely.affinity.scale(shape, -1, 1, origin=(0, 0)) if self.flip else shape

    def height(self, z: float) -> float:
        return self.depth - z if self.flip else z


def _placed(
    layout: BoardData, assigned: Mapping[str, str], side: str, layers: Sequence[str]
) -> tuple[Copper, _Frame]:
    """The nets that are taken, the sensor's side up."""
    frame = _Frame(side == "bottom", min(layout.heights.values()))
    out: Copper = {}
    for net in assigned:
        taken = {k: v for k, v in layout.nets[net].items() if not layers or k in layers}
        if not taken:
            raise LayoutError(f"net {net!r} has no copper on {', '.join(layers)}; it is on "
                              f"{', '.join(layout.nets[net])}")  # fmt: skip
        out[net] = {frame.height(layout.heights[k]): frame.shape(v) for k, v in taken.items()}
    if layout.outline is None:
        return out, frame
    inside = frame.shape(layout.outline).buffer(-10 * GRID)
    for net, levels in out.items():
        out[net] = {z: c for z, v in levels.items() if not (c := v.intersection(inside)).is_empty}
        if not out[net]:
            raise LayoutError(f"net {net!r} of {layout.source} lies outside of the board's outline")
    return out, frame


def _board(layout: BoardData, placed: Copper) -> tuple[Polygon, list[str]]:
    """The outline of the board, simplified, in the axes of ``placed``."""
    everything = [v for levels in placed.values() for v in levels.values()]
    copper = shapely.union_all(everything)
    if layout.outline is None:
        return box(*copper.buffer(1e-3, join_style="mitre").bounds), []
    # the frame is that of the copper: a flipped board has its outline flipped already
    flipped = shapely.affinity.scale(layout.outline, -1, 1, origin=(0, 0))
    outline = layout.outline if layout.outline.intersects(copper) else flipped
    if not outline.covers(copper) and flipped.covers(copper):
        outline = flipped
    parts = [p for p in polygons_of(outline) if p.intersects(copper)]
    if len(parts) != 1:
        raise LayoutError(
            f"{layout.source} holds {len(parts)} boards with copper of these nets; keep one of "
            "them, or name nets of one board"
        )
    (whole,) = parts
    rectangle = box(*whole.bounds)
    if whole.area > (1 - NEARLY) * rectangle.area:
        return rectangle, []
    holes = [h for h in whole.interiors if Polygon(h).area > SMALL_CUTOUT * whole.area]
    plain = Polygon(whole.exterior, holes)
    plain = shapely.set_precision(plain.simplify(BOARD_TOLERANCE), GRID)
    plain = max(polygons_of(plain), key=lambda p: p.area)
    inner = plain.buffer(-2 * GRID)
    for levels in placed.values():
        for z in list(levels):
            levels[z] = levels[z].intersection(inner)
    filled = len(whole.interiors) - len(holes)
    return plain, [f"{filled} small cutouts of the board are filled."] if filled else []


def _simplified(
    placed: Copper, assigned: Mapping[str, str], tolerance: float
) -> tuple[Copper, float, list[str]]:
    """Copper with simplified outlines, the tolerance used, and notes."""
    notes = []
    gap = math.inf
    for z in sorted({z for levels in placed.values() for z in levels}):
        here = [net for net in placed if z in placed[net] and not placed[net][z].is_empty]
        for one, other in combinations(here, 2):
            distance = placed[one][z].distance(placed[other][z])
            if distance > 0.0:
                gap = min(gap, distance)
                continue
            if assigned[one] == assigned[other] != "electrode":
                placed[other][z] = placed[other][z].difference(placed[one][z].buffer(5 * GRID))
                notes.append(f"{one} and {other} touch; both are {assigned[one]}.")
                gap = min(gap, 5 * GRID)
                continue
            spot = placed[one][z].intersection(placed[other][z]).representative_point()
            raise LayoutError(
                f"nets {one!r} and {other!r} touch at x = {spot.x * 1e3:.4g}, y = "
                f"{spot.y * 1e3:.4g} mm; give both the same role but electrode, or correct the "
                "board"
            )
    used = min(tolerance, gap / 5)
    if used < tolerance:
        notes.append(
            f"The narrowest gap is {gap * 1e3:.3g} mm, so the tolerance is {used * 1e3:.3g} mm."
        )
    out: Copper = {}
    for net, levels in placed.items():
        plain = {z: simplify(shape, used) for z, shape in levels.items()}
        out[net] = {z: shape for z, shape in plain.items() if not shape.is_empty}
        if not out[net]:
            raise LayoutError(f"nothing of net {net!r} is left at this tolerance; reduce it")
    return out, used, notes


def simplify(shape: BaseGeometry, tolerance: float) -> BaseGeometry:
    """Polygons with fewer corners, each of which is off by at most about ``tolerance`` [m].

    Clefts and holes narrower than twice the tolerance are filled; slivers narrower than a
    micrometre are dropped.
    """
    closed = shape.buffer(tolerance, join_style="mitre").buffer(-tolerance, join_style="mitre")
    plain = closed.union(shape).simplify(tolerance)
    parts = polygons_of(shapely.set_precision(plain, GRID))
    return MultiPolygon([p for p in parts if not p.buffer(-GRID).is_empty])


def _center(copper: Copper, assigned: Mapping[str, str]) -> tuple[float, float]:
    """Middle of the electrodes [m], on the grid."""
    shapes = [v for n, role in assigned.items() if role == "electrode" for v in copper[n].values()]
    x0, y0, x1, y1 = shapely.union_all(shapes).bounds
    return round((x0 + x1) / 2, 6), round((y0 + y1) / 2, 6)


def _metres(value: float) -> float:
    return round(float(value), 7) + 0.0


def _points(ring: BaseGeometry, origin: tuple[float, float]) -> list[list[float]]:
    corners = shapely.get_coordinates(ring)[:-1] - origin
    return [[_metres(x), _metres(y)] for x, y in corners]


def _outline(polygon: Polygon, origin: tuple[float, float]) -> dict[str, Any]:
    row: dict[str, Any] = {"points": _points(polygon.exterior, origin)}
    if polygon.interiors:
        row["holes"] = [_points(h, origin) for h in polygon.interiors]
    return row


def _sheet(
    net: str, levels: Mapping[float, BaseGeometry], origin: tuple[float, float], top: float
) -> dict[str, Any]:
    """The table of a net."""
    rows = []
    for z in sorted(levels, reverse=True):
        for polygon in polygons_of(levels[z]):
            height = _metres(z - top)
            rows.append(({"z": height} if height else {}) | _outline(polygon, origin))
    return {"name": net, "shape": "polygons", "polygons": rows}


def _slabs(
    layout: BoardData, board: Polygon, frame: _Frame, origin: tuple[float, float], top: float
) -> list[dict[str, Any]]:
    """Tables of the dielectrics, from the bottom up; neighbours of one permittivity are one."""
    slabs = []
    for slab in layout.slabs:
        low, high = sorted(frame.height(z) - top for z in slab.z)
        slabs.append((slab.name, slab.eps_r, low, high))
    slabs.sort(key=lambda s: s[2])
    merged: list[tuple[str, float, float, float]] = []
    for row_ in slabs:
        if merged and merged[-1][1] == row_[1] and abs(merged[-1][3] - row_[2]) < GRID:
            merged[-1] = ("board", row_[1], merged[-1][2], row_[3])
        else:
            merged.append(row_)
    return [_layer(*slab, board, origin) for slab in merged]


def _add_masks(
    stack: list[dict[str, Any]], layout: BoardData, board: Polygon, frame: _Frame,
    origin: tuple[float, float], top: float, copper: Copper, tolerance: float,
) -> list[str]:  # fmt: skip
    """Put solder mask below and above the dielectrics; returns notes about its openings.

    An opening stays if it bares more than a hundredth of the copper of a net on its side.
    """
    if not stack:
        return ["There are no dielectrics, so there is no solder mask."]
    sides = [max(layout.heights, key=lambda k: sign * frame.height(layout.heights[k]))
             for sign in (-1, 1)]  # fmt: skip
    ends = float(stack[0]["z"][0]), float(stack[-1]["z"][1])
    notes, rows = [], []
    for name, side, z, sign in zip(("mask below", "mask"), sides, ends, (-1, 1), strict=True):
        level = frame.height(layout.heights[side])
        openings = polygons_of(frame.shape(layout.masks.get(side, MultiPolygon())))
        kept: dict[int, Polygon] = {}
        bared = []
        for net, levels in copper.items():
            sheet = levels.get(level, MultiPolygon())
            found = [(k, o.intersection(sheet).area) for k, o in enumerate(openings)
                     if o.intersects(sheet)]  # fmt: skip
            large = {k: openings[k] for k, area in found if area > SMALL_CUTOUT * sheet.area}
            kept |= large
            bare = sum(area for k, area in found if k in large)
            if large:
                bared.append(f"{net} ({bare / sheet.area:.0%})")
        if bared:
            notes.append(f"The {name} is open over {', '.join(bared)}.")
        closed = len(openings) - len(kept)
        if closed:
            notes.append(f"{closed} openings of the {name} are closed: they bare none of these "
                         "nets, or less than 1 % of one.")  # fmt: skip
        holes = simplify(shapely.union_all(list(kept.values())), tolerance)
        parts = polygons_of(shapely.set_precision(board.difference(holes), GRID))
        for number, part in enumerate(parts, start=1):
            label = name if len(parts) == 1 else f"{name} {number}"
            low, high = sorted((z, z + sign * layout.mask[0]))
            rows.append(_layer(label, layout.mask[1], low, high, part, origin))
    stack += rows
    stack.sort(key=lambda row: float(row["z"][0]))
    return notes


def _layer(
    name: str, eps_r: float, low: float, high: float, board: Polygon, origin: tuple[float, float]
) -> dict[str, Any]:
    row: dict[str, Any] = {"name": name, "eps_r": float(eps_r)}
    z = [_metres(low), _metres(high)]
    if board.equals(box(*board.bounds)):
        x0, y0, x1, y1 = board.bounds
        center = [(x0 + x1) / 2 - origin[0], (y0 + y1) / 2 - origin[1]]
        return row | {"size": [_metres(x1 - x0), _metres(y1 - y0)],
                      "center": [_metres(c) for c in center], "z": z}  # fmt: skip
    return row | {"shape": "polygon", "z": z} | _outline(board, origin)


def _cover(
    cover: Plate, board: Polygon, origin: tuple[float, float], stack: list[dict[str, Any]]
) -> dict[str, Any]:
    if cover.material.lower() not in LAYER_EPS_R:
        raise LayoutError(
            f"cover of {cover.material!r}: the material is not known; "
            f"{suggest(cover.material, LAYER_EPS_R)}"
        )
    z = max((row["z"][1] for row in stack), default=0.0)
    row = _layer("cover", 1.0, z, z + cover.thickness, board, origin)
    return {"name": "cover", "material": cover.material} | {
        k: v for k, v in row.items() if k not in ("name", "eps_r")
    }


def _domain(
    board: Polygon, origin: tuple[float, float], rows: Mapping[str, Any], stack: Sequence[Any]
) -> dict[str, Any]:
    """A box with room around the board, on whole centimetres."""
    x0, y0, x1, y1 = board.bounds
    reach = max(origin[0] - x0, x1 - origin[0], origin[1] - y0, y1 - origin[1])
    width = max(0.3, math.ceil(2 * (reach + max(0.1, reach)) * 100) / 100)
    low = min([row["z"][0] for row in stack], default=0.0)
    backplane = round(0.05 + math.ceil(-low * 100) / 100, 4)
    return {"size": [width, width, width], "backplane": backplane}
