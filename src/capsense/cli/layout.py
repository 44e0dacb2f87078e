"""``capsense layout``: a design from a board or drawing of CAD."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli import (
    OK,
    PICTURES,
    arg,
    check_picture,
    check_target,
    command,
    facts,
    grouped,
    table,
)
from capsense.errors import LayoutError

if TYPE_CHECKING:
    from capsense.layout.board import BoardLayout
    from capsense.layout.convert import BoardDesign
    from capsense.layout.model import BoardData


def _millimetres(text: str) -> float:
    value = float(text)
    if not 1e-4 <= value <= 100:
        raise argparse.ArgumentTypeError(f"{text}; give millimetres, from 0.0001 to 100")
    return value * 1e-3


def _plate(text: str) -> tuple[str, float]:
    material, colon, thickness = text.rpartition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text}; give MATERIAL:MM, such as acrylic:3")
    try:
        return material, _millimetres(thickness)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}; {thickness!r} is no number of mm") from None


def _nets(role: str, help: str) -> tuple[list[str], dict[str, object]]:
    return arg(f"--{role} NET", help, nargs="+", action="extend", default=[])


@command(
    "layout",
    "make a design of a board or drawing: KiCad, Gerber, DXF, SVG, STEP, STL",
    arg("layout BOARD", ".kicad_pcb, .dxf, .svg, .step; folder or .zip of Gerber or .stl files",
        type=Path),
    arg("-o --output DESIGN.toml", "the design; without it the nets are listed", type=Path),
    _nets("electrode", 'nets that are electrodes: names or patterns in quotes, such as "TOUCH*"'),
    _nets("shield", "nets that are driven with the transmitter"),
    _nets("ground", "nets at ground"),
    _nets("floating", "nets that are connected to nothing"),
    arg("--side SIDE", "the side that faces the world: top (default) or bottom", default="top",
        choices=("top", "bottom")),
    arg("--layers LAYER", "copper layers to take; default all", nargs="+", default=[]),
    arg("--tolerance MM", "largest deviation of copper outlines; default 0.02", type=_millimetres,
        default=2e-5),
    arg("--thickness MM", "thickness of the board, where the file has none; default 1.6",
        type=_millimetres, default=1.6e-3),
    arg("--mask", "make layers of the solder mask"),
    arg("--cover MATERIAL:MM", "a rigid plate in front of the board, such as acrylic:3",
        type=_plate),
    arg("--plot PICTURE", f"draw the design to this file ({', '.join(PICTURES)})", type=Path),
    arg("-q --quiet", "no table, no notes; errors only"),
)  # fmt: skip
def layout(args: argparse.Namespace) -> int:
    """Make a design of the copper of a board. Nets become electrodes, shields and ground by name;
    the others are left out. Without --electrode the nets are listed. Before the design is written
    each net's layers, area and panels are printed, and what building the field will take.

    examples:
      capsense layout board.kicad_pcb
      capsense layout board.kicad_pcb --electrode "TOUCH*" --ground GND -o board.toml
      capsense layout board.kicad_pcb --electrode "T?" --ground GND --cover acrylic:3 -o a.toml
    """
    if args.plot is not None:
        check_picture("--plot", args.plot, LayoutError)
    if args.output is not None:
        check_target("--output", args.output, ".toml", LayoutError)
    from capsense.layout import load_layout

    found = load_layout(args.layout, tolerance=args.tolerance, thickness=args.thickness)
    if not args.electrode:
        print(_listing(found))
        if args.output is not None or args.plot is not None:
            raise LayoutError("name the electrodes: --electrode NET …, see the nets above")
        print(f"\nnext: {_next(args.layout, found)}")
        return OK
    board = found.assign(
        args.electrode, shield=args.shield, ground=args.ground, floating=args.floating,
        side=args.side, layers=args.layers, tolerance=args.tolerance, mask=args.mask,
        cover=args.cover,
    )  # fmt: skip
    if args.output is not None:
        board.save(args.output)
    if args.plot is not None:
        from capsense.plotting.designs import draw_design

        drawn = draw_design(board.design).get_figure()
        drawn.savefig(args.plot, dpi=150)  # type: ignore[union-attr]
    if not args.quiet:
        print(_report(board))
        for what, path in (("design", args.output), ("picture", args.plot)):
            if path is not None:
                print(f"wrote the {what} to {path}")
    return OK


def _listing(found: BoardLayout) -> str:
    """The nets of a layout as text, the largest first."""
    from capsense.layout.model import polygons_of

    def area(net: str) -> float:
        return sum(float(shape.area) for shape in found.nets[net].values())

    rows = []
    for net in sorted(found.nets, key=lambda n: -area(n)):
        layers = found.nets[net]
        islands = sum(len(polygons_of(shape)) for shape in layers.values())
        rows.append((net, ", ".join(layers), str(islands), f"{area(net) * 1e6:.1f}"))
    return "\n".join([
        facts(_facts(found)), "", table(("net", "copper", "islands", "area [mm²]"), rows),
        *(f"note: {n}" for n in found.notes),
    ])  # fmt: skip


def _facts(found: BoardData) -> list[tuple[str, str]]:
    levels = ", ".join(f"{k} at {z * 1e3:.4g} mm" for k, z in found.heights.items())
    slabs = ", ".join(
        f"{s.name} (εr {s.eps_r:g}, {(s.z[1] - s.z[0]) * 1e3:.4g} mm)" for s in found.slabs
    )
    size = "none"
    if found.outline is not None:
        x0, y0, x1, y1 = (1e3 * v for v in found.outline.bounds)
        size = f"{x1 - x0:.4g} × {y1 - y0:.4g} mm"
    return [("layout", found.source), ("outline", size), ("copper", levels),
            ("dielectrics", slabs or "none")]  # fmt: skip


def _next(path: Path, found: BoardLayout) -> str:
    """A command that takes the likely electrodes of a layout."""
    import re

    from capsense.layout.model import UNCONNECTED, natural

    named = [n for n in found.nets if n != UNCONNECTED]
    ground = [n for n in named if re.search(r"gnd|ground|vss", n, re.IGNORECASE)]
    words = r"touch|cap|sens|pad|elec|slide|butt|key|^t\d|^cs|tx|rx"
    likely = [n for n in named if re.search(words, n, re.IGNORECASE) and n not in ground]
    likely = sorted(likely or [n for n in named if n not in ground], key=natural)[:4]
    parts = ["capsense layout", shlex.quote(str(path)), "--electrode", *map(shlex.quote, likely)]
    parts += ["--ground", *map(shlex.quote, ground[:2])] if ground else []
    return " ".join([*parts, "-o", shlex.quote(f"{path.stem}.toml")])


def _report(board: BoardDesign) -> str:
    """What the design holds of each net, and what building it takes."""
    from capsense.field.boundary import build_cost

    rows, panels = board.figures()
    time, memory = build_cost(panels)
    left = [n for n in board.layout.nets if n not in {r.net for r in rows}]
    cells = [
        (r.net, r.role, ", ".join(r.layers), str(r.islands), f"{r.area * 1e6:.1f}", str(r.panels))
        for r in rows
    ]
    ends = [
        ("tolerance", f"{board.tolerance * 1e3:.3g} mm"),
        ("panels", grouped(panels)),
        ("building", f"about {time:.0f} s of a processor's time, {memory / 1e9:.1f} GB"),
    ]
    if left:
        named = ", ".join(left[:8]) + (f" and {len(left) - 8} more" if len(left) > 8 else "")
        ends.append(("left out", named))
    return "\n".join([
        facts(_facts(board.layout)), "",
        table(("net", "role", "copper", "islands", "area [mm²]", "panels"), cells), "",
        facts(ends), *(f"note: {n}" for n in board.notes),
    ])  # fmt: skip
