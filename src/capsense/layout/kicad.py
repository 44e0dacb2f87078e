"""Boards of KiCad, version 4 and later.

Only what makes copper, mask, stack-up and outline is read, so that files of later versions, whose
other parts change, are read as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
import shapely.affinity
from shapely.geometry import LineString, MultiPoint, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from capsense._validate import read_file
from capsense.errors import LayoutError
from capsense.layout.board import BoardLayout
from capsense.layout.curves import XY, arc_through, bezier, outline_of, quarter_segments
from capsense.layout.model import FR4, UNCONNECTED, Slab, gather, in_metres, united
from capsense.layout.sexpr import Node, child, children, number, numbers, parse, word, words

Place = Callable[[BaseGeometry], BaseGeometry]


@dataclass
class _BoardReader:
    """What is gathered from a board; millimetres, y up."""

    board: Node
    error: float
    pieces: list[tuple[str, str, BaseGeometry]] = field(default_factory=list)
    loose: list[tuple[str, BaseGeometry]] = field(default_factory=list)
    edges: list[BaseGeometry] = field(default_factory=list)
    openings: dict[str, list[BaseGeometry]] = field(default_factory=dict)
    unfilled: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        rows = [w for item in child(self.board, "layers")[1:] if isinstance(item, list)
                if len(w := [x for x in item if isinstance(x, str)]) > 2]  # fmt: skip
        self.copper = [w[1] for w in rows if w[1].endswith(".Cu") or w[2] in ("signal", "power")]
        self.copper.sort(key=lambda name: {"F.Cu": -1, "B.Cu": 99}.get(name, 0))
        self.names = {n[1]: n[2] for n in children(self.board, "net") if len(n) > 2}
        setup = child(self.board, "setup")
        self.mask_margin = number(setup, "pad_to_mask_clearance")

    def net(self, node: Node) -> str:
        """The net of an item: its number, its name, or both, as versions have it."""
        found = words(child(node, "net"))
        if not found or found[-1] in ("0", ""):
            return UNCONNECTED
        name = self.names.get(found[0], found[-1]) if len(found) == 1 else found[1]
        return str(name) or UNCONNECTED

    def on(self, node: Node) -> list[str]:
        """The layers of an item, wildcards spelt out."""
        named = words(child(node, "layers")) + words(child(node, "layer"))
        out: list[str] = []
        for name in named:
            if name == "*.Cu":
                out += self.copper
            elif name.startswith(("*.", "F&B.")):
                end = name.partition(".")[2]
                out += [f"F.{end}", f"B.{end}"]
            else:
                out.append(name)
        return list(dict.fromkeys(out))

    def read(self) -> None:
        board = self.board
        for item in children(board, "segment", "arc"):
            self.add(item, self.track(item), self.net(item))
        for item in children(board, "via"):
            x, y = numbers(child(item, "at"))[:2]
            dot = self.disc((x, -y), number(item, "size") / 2)
            for layer in self.span(words(child(item, "layers"))):
                self.pieces.append((self.net(item), layer, dot))
        for item in children(board, "zone"):
            self.zone(item, lambda p: p)
        for part in board:
            if isinstance(part, list) and str(part[0]).startswith("gr_"):
                self.graphic(part, lambda p: p, self.net(part))
        for item in children(board, "footprint", "module"):
            self.footprint(item)

    def span(self, ends: Sequence[str]) -> list[str]:
        """Copper layers from one to another; of a through via, all."""
        places = [self.copper.index(n) for n in ends if n in self.copper]
        return self.copper[min(places) : max(places) + 1] if places else self.copper

    def add(self, item: Node, shape: BaseGeometry | None, net: str) -> None:
        """Put a shape on the layers of its item."""
        if shape is None or shape.is_empty:
            return
        for layer in self.on(item):
            if layer in self.copper:
                self.pieces.append((net, layer, shape))
            elif layer.endswith(".Mask"):
                self.openings.setdefault(layer.replace(".Mask", ".Cu"), []).append(shape)

    def disc(self, at: XY, radius: float) -> Polygon:
        return Point(at).buffer(radius, quad_segs=quarter_segments(radius, self.error))

    def stroke(self, line: BaseGeometry, width: float) -> BaseGeometry:
        return line.buffer(width / 2, quad_segs=quarter_segments(width / 2, self.error))

    def points(self, node: Node) -> list[XY]:
        """A list of points, arcs among them resolved."""
        out: list[XY] = []
        for item in children(node, "xy", "arc"):
            if item[0] == "xy":
                x, y = numbers(item)[:2]
                out.append((x, -y))
            else:
                out += self.arc(item)
        return out

    def arc(self, item: Node) -> list[XY]:
        """Chords of an arc: by three points, or by centre, start and angle before version 6."""
        ends = {k: numbers(child(item, k))[:2] for k in ("start", "mid", "end")}
        start, end = ends["start"], ends["end"]
        if ends["mid"]:
            mid = ends["mid"]
        else:
            angle, center = math.radians(number(item, "angle")), np.array(start)
            x, y = np.array(end) - center
            start = end
            mid, end = (
                [center[0] + x * math.cos(turn) - y * math.sin(turn),
                 center[1] + x * math.sin(turn) + y * math.cos(turn)]
                for turn in (angle / 2, angle)
            )  # fmt: skip
        a, b, c = ((p[0], -p[1]) for p in (start, mid, end))
        return arc_through(a, b, c, self.error)

    def track(self, item: Node) -> BaseGeometry:
        if item[0] == "arc":
            line = LineString(self.arc(item))
        else:
            ends = [numbers(child(item, k))[:2] for k in ("start", "end")]
            line = LineString([(x, -y) for x, y in ends])
        return self.stroke(line, number(item, "width"))

    def zone(self, item: Node, place: Place) -> None:
        net = self.net(item)
        if net == UNCONNECTED and word(item, "net_name"):
            net = word(item, "net_name")
        fills = list(children(item, "filled_polygon"))
        layers = self.on(item)
        if not fills and not list(children(item, "keepout")) and net != UNCONNECTED:
            if any(layer in self.copper for layer in layers):
                self.unfilled.add(net)
            return
        pen = number(item, "min_thickness")
        if word(item, "filled_areas_thickness", "yes") == "no":
            pen = 0.0
        for fill in fills:
            shape: BaseGeometry = Polygon(self.points(child(fill, "pts"))).buffer(0)
            if pen:
                shape = self.stroke(shape, pen)
            for layer in [w for w in words(child(fill, "layer"))] or layers:
                if layer in self.copper:
                    self.pieces.append((net, layer, shape))

    def figure(self, item: Node) -> tuple[BaseGeometry | None, BaseGeometry | None]:
        """Line and filled area of a drawn item, in its own frame."""
        kind = str(item[0]).partition("_")[2]
        ends = {k: numbers(child(item, k))[:2] for k in ("start", "end", "center")}
        start, end = ((x[0], -x[1]) if len(x := ends[k]) == 2 else None for k in ("start", "end"))
        area: BaseGeometry | None = None
        if kind == "line" and start and end:
            return LineString([start, end]), None
        if kind == "arc":
            return LineString(self.arc(item)), None
        if kind == "curve":
            return LineString(bezier(self.points(child(item, "pts")), self.error)), None
        if kind == "circle" and end and ends["center"]:
            cx, cy = ends["center"]
            area = self.disc((cx, -cy), math.dist((cx, -cy), end))
        elif kind == "rect" and start and end:
            area = MultiPoint([start, end]).envelope
        elif kind == "poly":
            points = self.points(child(item, "pts"))
            area = Polygon(points).buffer(0) if len(points) > 2 else None
        return (None if area is None else area.boundary), area

    def graphic(self, item: Node, place: Place, net: str) -> None:
        """A drawn item on copper, on the mask or on the outline."""
        layers = self.on(item)
        if not any(la in self.copper or la.endswith(".Mask") or la == "Edge.Cuts" for la in layers):
            return
        line, area = self.figure(item)
        if line is None:
            return
        if "Edge.Cuts" in layers:
            self.edges.append(place(line))
            return
        width = number(child(item, "stroke"), "width", number(item, "width"))
        filled = word(item, "fill", "yes" if str(item[0]).endswith("_poly") else "no")
        parts = [self.stroke(line, width)] if width > 0 else []
        if area is not None and filled not in ("no", "none"):
            parts.append(area)
        shape = place(united(parts)) if parts else None
        if shape is None:
            return
        if net != UNCONNECTED:
            self.add(item, shape, net)
            return
        self.loose += [(layer, shape) for layer in layers if layer in self.copper]
        for layer in layers:
            if layer.endswith(".Mask"):
                self.openings.setdefault(layer.replace(".Mask", ".Cu"), []).append(shape)

    def footprint(self, item: Node) -> None:
        x, y, turn = (*numbers(child(item, "at")), 0.0, 0.0, 0.0)[:3]

        def place(shape: BaseGeometry) -> BaseGeometry:
            turned = shapely.affinity.rotate(shape, turn, origin=(0, 0))
            return shapely.affinity.translate(turned, x, -y)

        for part in item:
            if not isinstance(part, list) or not part:
                continue
            if str(part[0]).startswith("fp_"):
                self.graphic(part, place, self.net(part))
            elif part[0] == "zone":
                self.zone(part, place)
            elif part[0] == "pad":
                self.pad(part, place, turn, number(item, "solder_mask_margin", self.mask_margin))

    def pad(self, pad: Node, place: Place, turn: float, mask_margin: float) -> None:
        x, y, angle = (*numbers(child(pad, "at")), 0.0, 0.0, 0.0)[:3]
        shape = self.pad_shape(pad)
        if shape is None or shape.is_empty:
            return
        # a pad's angle is that on the board, its place that in the footprint
        shape = shapely.affinity.rotate(shape, angle - turn, origin=(0, 0))
        shape = place(shapely.affinity.translate(shape, x, -y))
        holes = numbers(child(pad, "drill"))
        bare = pad[2] == "np_thru_hole" and holes and max(numbers(child(pad, "size"))) <= holes[0]
        margin = number(pad, "solder_mask_margin", mask_margin)
        for layer in self.on(pad):
            if layer in self.copper and not bare:
                self.pieces.append((self.net(pad), layer, shape))
            elif layer.endswith(".Mask"):
                opening = shape.buffer(margin) if margin else shape
                self.openings.setdefault(layer.replace(".Mask", ".Cu"), []).append(opening)

    def pad_shape(self, pad: Node) -> BaseGeometry | None:
        """A pad about its own origin, not turned."""
        kind = pad[3] if len(pad) > 3 else "circle"
        size = numbers(child(pad, "size"))
        w, h = (size * 2)[:2] if size else (0.0, 0.0)
        if w <= 0 or h <= 0:
            return None
        dx, dy = (*numbers(child(child(pad, "drill"), "offset")), 0.0, 0.0)[:2]
        rect = box(-w / 2, -h / 2, w / 2, h / 2)
        if kind == "circle":
            shape: BaseGeometry = self.disc((0, 0), w / 2)
        elif kind == "oval":
            r, half = min(w, h) / 2, abs(w - h) / 2
            end = (half, 0.0) if w > h else (0.0, half)
            spine = LineString([(-end[0], -end[1]), end]) if half else Point(0, 0)
            shape = spine.buffer(r, quad_segs=quarter_segments(r, self.error))
        elif kind == "roundrect":
            shape = self.rounded(pad, rect, min(w, h))
        elif kind == "trapezoid":
            ey, ex = (*numbers(child(pad, "rect_delta")), 0.0, 0.0)[:2]
            shape = Polygon([
                (-w / 2 - ey / 2, -h / 2 - ex / 2), (w / 2 + ey / 2, -h / 2 + ex / 2),
                (w / 2 - ey / 2, h / 2 - ex / 2), (-w / 2 + ey / 2, h / 2 + ex / 2),
            ])  # fmt: skip
        elif kind == "custom":
            round_anchor = word(child(pad, "options"), "anchor", "rect") == "circle"
            shape = united([
                self.disc((0, 0), w / 2) if round_anchor else rect, *self.primitives(pad)
            ])  # fmt: skip
        else:
            shape = rect
        return shapely.affinity.translate(shape, dx, -dy)

    def rounded(self, pad: Node, rect: Polygon, short: float) -> BaseGeometry:
        """A rectangle with round corners, some of them cut off."""
        r = number(pad, "roundrect_rratio") * short
        shape: BaseGeometry = rect
        if r > 0:
            segments = quarter_segments(r, self.error)
            shape = rect.buffer(-r, join_style="mitre").buffer(r, quad_segs=segments)
        cut = number(pad, "chamfer_ratio") * short
        x, y = rect.bounds[2], rect.bounds[3]
        for corner in words(child(pad, "chamfer")) if cut else []:
            sx, sy = (1 if "right" in corner else -1), (1 if "top" in corner else -1)
            if r > 0:  # a corner is either round or cut off
                square = MultiPoint([(sx * x, sy * y), (sx * (x - r), sy * (y - r))]).envelope
                shape = shape.union(square)
            away = [(sx * x, sy * y), (sx * (x - cut), sy * y), (sx * x, sy * (y - cut))]
            shape = shape.difference(Polygon(away))
        return shape

    def primitives(self, pad: Node) -> Iterator[BaseGeometry]:
        for item in child(pad, "primitives")[1:]:
            if not isinstance(item, list):
                continue
            line, area = self.figure(item)
            width = number(item, "width", number(child(item, "stroke"), "width"))
            filled = word(item, "fill", "yes" if item[0] == "gr_poly" or not width else "no")
            if line is not None and width > 0:
                yield self.stroke(line, width)
            if area is not None and filled not in ("no", "none"):
                yield area

    def join_loose(self) -> None:
        """Give copper that is drawn without a net the net of the one that it touches."""
        by_layer: dict[str, list[tuple[str, BaseGeometry]]] = {}
        for net, layer, shape in self.pieces:
            by_layer.setdefault(layer, []).append((net, shape))
        trees = {la: shapely.STRtree([s for _, s in rows]) for la, rows in by_layer.items()}
        left = self.loose
        while left:  # a drawing may touch a net through another drawing
            rest, joined = [], []
            for layer, shape in left:
                rows = by_layer.get(layer, [])
                hits = trees[layer].query(shape, predicate="intersects") if rows else ()
                nets = {rows[k][0] for k in hits} - {UNCONNECTED}
                if len(nets) == 1:
                    joined.append((nets.pop(), layer, shape))
                else:
                    rest.append((layer, shape))
            self.pieces += joined
            for net, layer, shape in joined:
                by_layer[layer].append((net, shape))
                trees[layer] = shapely.STRtree([s for _, s in by_layer[layer]])
            if not joined:
                self.pieces += [(UNCONNECTED, layer, shape) for layer, shape in rest]
                return
            left = rest


def _stack(
    board: Node, copper: list[str], thickness: float
) -> tuple[dict[str, float], list[Slab], tuple[float, float], list[str]]:
    """Heights of copper, slabs between them [m], the mask, and what was assumed."""
    heights: dict[str, float] = {}
    slabs: list[Slab] = []
    mask = (0.02, 3.3)
    z = 0.0
    rows = list(children(child(child(board, "setup"), "stackup"), "layer"))
    for row in rows:
        kind, name = word(row, "type").lower(), str(row[1])
        if name in copper:
            heights[name] = z
        elif "mask" in kind:
            mask = (number(row, "thickness", 0.01), number(row, "epsilon_r", 3.3))
        elif kind in ("core", "prepreg") or "dielectric" in name.lower():
            depth = sum(numbers(t)[0] for t in children(row, "thickness"))  # of all its sublayers
            if depth > 0:
                eps = number(row, "epsilon_r", FR4)
                slabs.append(Slab(name, eps, ((z - depth) * 1e-3, z * 1e-3)))
                z -= depth
    if slabs and len(heights) == len(copper):
        return heights, slabs, mask, []
    whole = number(child(board, "general"), "thickness", thickness)
    count = max(len(copper) - 1, 1)
    heights = {name: -whole * k / count + 0.0 for k, name in enumerate(copper)}
    notes = [f"The file has no stack-up: FR4 of permittivity {FR4}, {whole:g} mm thick, is assumed"
             + (", inner copper at equal distances." if count > 1 else ".")]  # fmt: skip
    return heights, [Slab("board", FR4, (-whole * 1e-3, 0.0))], mask, notes


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a board; lengths in millimetres.

    Raises:
        LayoutError: The file is no board of KiCad, or is damaged.
    """
    try:
        board = parse(read_file(path).decode("utf-8", errors="replace"))
    except (OSError, ValueError) as cause:
        raise LayoutError(f"{path} cannot be read: {cause}; save it anew in KiCad") from None
    if board[:1] != ["kicad_pcb"]:
        raise LayoutError(f"{path} is no board of KiCad; it begins with {board[:1]}")
    reader = _BoardReader(board, error)
    try:
        reader.read()
    except (ValueError, IndexError, TypeError) as cause:
        raise LayoutError(f"{path} is damaged ({cause}); open and save it in KiCad") from None
    reader.join_loose()
    heights, slabs, mask, notes = _stack(board, reader.copper, thickness)
    if reader.unfilled:
        notes.append(
            f"Zones of {', '.join(sorted(reader.unfilled))} are not filled and left out: fill them "
            "in KiCad (key B) and save."
        )
    outline, open_ends = outline_of(reader.edges, 0.05)
    if outline is None:
        notes.append(
            "The file has no closed outline on Edge.Cuts"
            + (f" ({open_ends} loose ends)" if open_ends else "") + "; the board is taken as the "
            "rectangle around the copper."
        )  # fmt: skip
    return BoardLayout(
        path.name, gather(reader.pieces, in_metres),
        {name: z * 1e-3 for name, z in heights.items()}, tuple(slabs),
        None if outline is None else in_metres(outline),
        {layer: in_metres(united(shapes)) for layer, shapes in reader.openings.items()},
        (mask[0] * 1e-3, mask[1]), tuple(notes),
    )  # fmt: skip
