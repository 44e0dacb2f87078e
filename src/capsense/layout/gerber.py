"""Gerber sets: a folder or archive of copper layers, drills, solder masks and outline."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np
import shapely
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from shapely.geometry import box
from shapely.geometry.base import BaseGeometry

from capsense.errors import LayoutError, require_package
from capsense.layout.board import BoardLayout
from capsense.layout.curves import outline_of
from capsense.layout.gerber_files import drills, edges, islands, opened
from capsense.layout.model import FR4, Slab, gather, in_metres, polygons_of, united

HEAD = 65536
"""Bytes of a file that tell what it is: P-CAD writes its list of apertures before the format."""
TOP, BOTTOM = 0, 10_000
"""Places of the outer layers in the order of copper; inner ones have their number."""


class GerberPart(NamedTuple):
    """What a file of a set is."""

    kind: str
    """``"copper"``, ``"mask"``, ``"outline"`` or ``"drill"``."""
    place: int = TOP
    """Place in the order of copper layers, from the top down; of outlines, how likely it is."""
    span: tuple[int, int] | None = None
    """First and last copper layer that drills join, counted from 1; None for all."""


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a set; nets are islands of copper that plated holes join, named as the files do.

    Raises:
        LayoutError: The set has no copper, two files for one layer, or a file is damaged.
        MissingDependencyError: gerbonara is not installed.
    """
    require_package("gerbonara", "gerbonara", "layout")
    where = path if path.is_dir() or path.suffix.lower() == ".zip" else path.parent
    try:
        with TemporaryDirectory() as spare, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if where.is_file():
                with ZipFile(where) as archive:
                    archive.extractall(spare)
                where = Path(spare)
            return _SetReader(path.name, where, error, thickness).layout()
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


def is_set(path: Path) -> bool:
    """Whether a folder holds a file in Gerber format, in it or below."""
    return any(b"%FS" in f.read_bytes()[:HEAD] for f in path.rglob("*") if f.is_file())


class _SetReader:
    """A set of files in a folder; millimetres."""

    def __init__(self, name: str, where: Path, error: float, thickness: float) -> None:
        self.name = name
        self.error = error
        self.thickness = thickness
        self.notes: list[str] = []
        self.job = _job(where)
        functions = {
            str(row.get("Path", "")).rpartition("/")[2]: str(row.get("FileFunction", ""))
            for row in self.job.get("FilesAttributes", ())
        }
        self.parts: dict[Path, GerberPart] = {}
        unknown = []
        for file in sorted(f for f in where.rglob("*") if f.is_file()):
            head = file.read_bytes()[:HEAD].decode("latin-1")
            part = part_of(file.name, head, functions.get(file.name, ""))
            if part is not None:
                self.parts[file] = part
            elif "%FS" in head and not _OTHER.search(file.name) and "FileFunction" not in head:
                unknown.append(file.name)
        if unknown:
            named = ", ".join(unknown[:6]) + (" and more" if len(unknown) > 6 else "")
            self.notes.append(
                f"It is not known what {named} are: they are left out. Copper, masks and outline "
                "are known by names such as F_Cu, In1_Cu, B_Cu, F_Mask, Edge_Cuts."
            )

    def of_kind(self, kind: str) -> list[tuple[Path, GerberPart]]:
        """Files of a kind, in the order of their places."""
        found = [(file, part) for file, part in self.parts.items() if part.kind == kind]
        return sorted(found, key=lambda row: (row[1].place, row[0].name))

    def layout(self) -> BoardLayout:
        """The layout of the set."""
        files = self.of_kind("copper")
        for (one, a), (other, b) in pairwise(files):
            if a.place == b.place:
                raise LayoutError(
                    f"{self.name} has two files for one copper layer, {one.name} and {other.name}; "
                    "keep the files of one board"
                )
        names = layer_names([part.place for _, part in files])
        outline = self.outline()
        copper: dict[str, list[tuple[BaseGeometry, str]]] = {}
        for name, (file, _) in zip(names, files, strict=True):
            copper[name] = list(islands(opened(file), self.error))
            if _is_negative(file):
                copper[name] = self.inverse(file, copper[name], outline)
        rows = [(layer, shape, net) for layer, found in copper.items() for shape, net in found]
        pieces = self.joined(rows, names)
        masks: dict[str, list[BaseGeometry]] = {}
        for file, part in self.of_kind("mask"):
            side = "F.Cu" if part.place == TOP else "B.Cu"
            masks.setdefault(side, []).extend(s for s, _ in islands(opened(file), self.error))
        heights, slabs, mask = self.stack(names)
        return BoardLayout(
            self.name, gather(pieces, in_metres), {k: z * 1e-3 for k, z in heights.items()}, slabs,
            None if outline is None else in_metres(outline),
            {layer: in_metres(united(shapes)) for layer, shapes in masks.items()},
            (mask[0] * 1e-3, mask[1]), tuple(self.notes),
        )  # fmt: skip

    def outline(self) -> BaseGeometry | None:
        """The area of the first file that holds a closed outline."""
        for file, _ in self.of_kind("outline"):
            found, _ = outline_of(list(edges(opened(file), self.error)), 0.05)
            if found is not None:
                return found
        self.notes.append("The set has no closed outline; the board is taken as the rectangle "
                          "around the copper.")  # fmt: skip
        return None

    def inverse(
        self, file: Path, cleared: list[tuple[BaseGeometry, str]], outline: BaseGeometry | None
    ) -> list[tuple[BaseGeometry, str]]:
        """Copper of a plane whose file draws what is cleared."""
        shapes = united([shape for shape, _ in cleared])
        board = box(*shapes.bounds) if outline is None else outline
        self.notes.append(f"{file.name} is read as a negative image.")
        return [(p, "") for p in polygons_of(board.difference(shapes))]

    def joined(
        self, rows: Sequence[tuple[str, BaseGeometry, str]], names: Sequence[str]
    ) -> list[tuple[str, str, BaseGeometry]]:
        """Islands with the name of their net; those that plated holes join share it."""
        tree = shapely.STRtree([shape for _, shape, _ in rows])
        links: list[tuple[int, int]] = []
        files = self.of_kind("drill")
        if not files and len(names) > 1:
            self.notes.append("The set has no drill file: layers of one net are not joined.")
        for file, part in files:
            if _is_gerber(file):
                holes, met = [s for s, _ in islands(opened(file), self.error)], 1.0
            else:
                holes, met = drills(file, tree, self.error)
            if met < 0.5 and holes:
                self.notes.append(
                    f"Only {met:.0%} of the holes of {file.name} meet copper: islands may be split "
                    "that are one net. Export drills in decimal format."
                )
            first, last = part.span or (1, len(names))
            joins = set(names[first - 1 : last])
            for hole in holes:
                hits = [int(k) for k in tree.query(hole, predicate="intersects")]
                hits = [k for k in hits if rows[k][0] in joins]
                links += [(hits[0], k) for k in hits[1:]]
        row, column = np.array(links, dtype=int).reshape(-1, 2).T
        graph = coo_matrix((np.ones(len(links)), (row, column)), shape=(len(rows), len(rows)))
        members: dict[int, list[int]] = {}
        for k, label in enumerate(connected_components(graph, directed=False)[1].tolist()):
            members.setdefault(label, []).append(k)
        ordered = sorted(members.values(), key=lambda m: -sum(rows[k][1].area for k in m))
        out = []
        for number, ks in enumerate(ordered, start=1):
            nets = list(dict.fromkeys(rows[k][2] for k in ks if rows[k][2]))
            if len(nets) > 1:
                self.notes.append(f"Nets {', '.join(nets)} touch; they are taken as {nets[0]}.")
            net = nets[0] if nets else f"island{number}"
            out += [(net, rows[k][0], united([rows[k][1]])) for k in ks]
        return out

    def stack(
        self, names: Sequence[str]
    ) -> tuple[dict[str, float], tuple[Slab, ...], tuple[float, float]]:
        """Heights of copper [mm], slabs between them [m], and the mask [mm]."""
        rows = [r for r in self.job.get("MaterialStackup", ()) if isinstance(r, Mapping)]
        levels: list[float] = []
        slabs: list[Slab] = []
        mask = (0.02, 3.3)
        z = 0.0
        for row in rows:
            kind, depth = str(row.get("Type", "")).lower(), _number(row.get("Thickness"))
            if kind == "copper":
                levels.append(z)
            elif kind == "soldermask" and depth:
                mask = (depth, _number(row.get("DielectricConstant")) or 3.3)
            elif kind == "dielectric" and depth:
                eps = _number(row.get("DielectricConstant")) or FR4
                name = f"dielectric {len(slabs) + 1}"
                slabs.append(Slab(name, eps, ((z - depth) * 1e-3, z * 1e-3)))
                z -= depth
        if slabs and len(levels) == len(names):
            return dict(zip(names, levels, strict=True)), tuple(slabs), mask
        general = [self.job.get(key, {}) for key in ("GeneralSpecs", "Overall")]
        stated = [_number(specs.get("BoardThickness")) for specs in general]
        whole = next((s for s in stated if s), self.thickness)
        what = "stack-up" if any(stated) else "thickness"
        self.notes.append(
            f"The set states no {what}: FR4 of permittivity {FR4}, {whole:g} mm thick, is assumed"
            + (", inner copper at equal distances." if len(names) > 2 else ".")
        )
        count = max(len(names) - 1, 1)
        heights = {name: -whole * k / count + 0.0 for k, name in enumerate(names)}
        return heights, (Slab("board", FR4, (-whole * 1e-3, 0.0)),), mask


def _job(where: Path) -> dict[str, Any]:
    """The job file of a set; empty if it has none that can be read."""
    for file in sorted(where.rglob("*.gbrjob")):
        try:
            found = json.loads(file.read_text(encoding="utf-8"))
        except ValueError:
            continue
        if isinstance(found, dict):
            return found
    return {}


def _number(value: Any) -> float:
    """A positive number that a job file states; else 0."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def _is_gerber(file: Path) -> bool:
    return b"%FS" in file.read_bytes()[:HEAD]


def _is_negative(file: Path) -> bool:
    """Whether a file draws what is not copper, as planes of Altium and Allegro may."""
    head = file.read_bytes()[:HEAD].decode("latin-1")
    stated = re.search(r"FilePolarity,Negative|%IPNEG", head)
    return bool(stated or re.search(r"\.gp\d+$", file.name.lower()))


def layer_names(places: Sequence[int]) -> list[str]:
    """Names of copper layers in KiCad's manner, from their places in ascending order."""
    numbered = bool(places) and places[-1] < BOTTOM and len(places) > 1
    out = []
    for k, place in enumerate(places):
        if place == TOP or (k == 0 and numbered):
            out.append("F.Cu")
        elif place == BOTTOM or (k == len(places) - 1 and numbered):
            out.append("B.Cu")
        else:
            out.append(f"In{k if out and out[0] == 'F.Cu' else k + 1}.Cu")
    return out


_SUFFIXES = {
    "copper": {TOP: ".gtl .cmp .top", BOTTOM: ".gbl .sol .bot"},
    "mask": {TOP: ".gts .stc .smt .tsm", BOTTOM: ".gbs .sts .smb .bsm"},
    "outline": {1: ".gko .dim", 2: ".gml .gm1 .fab"},
}
"""Suffixes of Protel, Altium, Eagle and OrCAD."""
_INNER = re.compile(r"\.(?:gp?|in|ly)(\d+)$|\.g(\d+)l$")
_OTHER = re.compile(
    r"silk|legend|overlay|paste|cream|stencil|ass(em|y)|fab|courtyard|crtyd|adhes|glue|drawing|map"
    r"|comment|cmt|keep|place|user|eco\d|score|test|margin|symbol|metalmask|\.g(to|bo|tp|bp|pt|pb|d|g|[1-9]d?m\d)$",
    re.IGNORECASE,
)
"""Names of files that hold neither copper, mask nor outline."""
_SIDES = (
    (TOP, r"top|(^|[^a-z])(front|component|primary|prm|f[-_. ]?(cu|mask))"),
    (BOTTOM, r"bottom|(^|[^a-z])(bot|back|secondary|sec|b[-_. ]?(cu|mask))"),
)
_DRILL = re.compile(r"^M48\b|^T\d+C[\d.]+|^;(T\d+)? *Holesize ", re.MULTILINE)


def part_of(name: str, head: str, function: str = "") -> GerberPart | None:
    """What a file is, by its attributes or its name; None of what is not read.

    Args:
        name: Name of the file.
        head: Its beginning.
        function: Its function as the set's job file states it.
    """
    gerber = "%FS" in head
    drill = not gerber and bool(_DRILL.search(head))
    if not gerber and not drill:
        return None
    stated = re.search(r"FileFunction,([^*\n\r]*)", head)
    words = (stated[1] if stated else function).lower().strip().split(",")
    if words != [""] and words[0] != "other":
        return _stated(words)
    name = name.lower()
    if drill:
        return (
            None if re.search(r"n(on)?[-_. ]?p(th|lated)|unplated", name) else GerberPart("drill")
        )
    for kind, rows in _SUFFIXES.items():
        for place, suffixes in rows.items():
            if name.endswith(tuple(suffixes.split())):
                return GerberPart(kind, place)
    if inner := _INNER.search(name):
        return GerberPart("copper", int(inner[1] or inner[2]))
    return None if _OTHER.search(name) else _named(name)


def _stated(words: list[str]) -> GerberPart | None:
    """A part by the words of its X2 function."""
    kind, *rest = words
    side = BOTTOM if "bot" in rest else TOP
    if kind == "copper":
        inner = "inr" in rest and (number := re.fullmatch(r"l(\d+)", rest[0]))
        return GerberPart("copper", int(number[1]) - 1 if inner and number else side)
    if kind == "soldermask":
        return GerberPart("mask", side)
    if kind == "profile":
        return GerberPart("outline")
    if kind in ("plated", "mixedplating"):
        span = [int(w) for w in rest[:2] if w.isdigit()]
        return GerberPart("drill", span=(span[0], span[1]) if len(span) == 2 else None)
    return None


def _named(name: str) -> GerberPart | None:
    """A part by the words of its name, without suffix."""
    stem = name.rpartition(".")[0]
    side = next((place for place, marks in _SIDES if re.search(marks, stem)), None)
    if re.search(r"outline|profile|edge|dimension|contour", stem):
        return GerberPart("outline", 0)
    if re.search(r"mask|resist|stop|^sm[tb]$", stem):
        return None if side is None else GerberPart("mask", side)
    words = "l|lyr|layer|in|inner|mid|int|inner[-_. ]?l"
    number = re.search(rf"(?:^|[^a-z])(?:{words})[-_. ]?0*(\d+)", stem)
    if side is not None and not (number and re.search(r"inn?(er)?[-_. ]?l?\d", stem)):
        return GerberPart("copper", side)
    return GerberPart("copper", int(number[1])) if number else None
