"""Make the files of the laboratory experiment from board.toml: docs/experiment.md.

    python examples/experiment/make_files.py               # board.svg, positions.csv, measured.csv
    python examples/experiment/make_files.py --synthetic   # and synthetic.csv

``synthetic.csv`` is made by the simulator, with faults of a laboratory and a seed. It exercises
``compare.py``; it is no evidence, and nobody has measured anything yet.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import compare
import numpy as np
import shapely
import shapely.affinity
from compare import BODIES, CHANNELS, COLUMNS, KEYS, NO_BODY, Array, Position

from capsense.design import Design

HERE = Path(__file__).parent
HEIGHTS = (0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150)
"""[mm]: four to a factor of five near the board, where the open questions are; the first one is
twenty times the uncertainty of the stage's zero."""
COVER = 2.0
"""Thickness of the sheet [mm]."""
COVERED = (2.3, 2.5, 3, 4, 5, 7, 10, 15, 20, 30, 50, 100)
PLACES = {"plate": (0, 0), "disc": (-22, 10), "tube": (0, 10)}
"""[mm]: over the whole board; over L; along x over L and M."""
REPEATS = 2
LANDING = 0.4
"""Half a side of the landings of the cables [mm]."""
FAULTS = {
    "gain": (1.004, 0.995, 1.002, 0.998, 1.006),
    "stray": (6.1e-12, 5.2e-12, 4.9e-12, 5.6e-12, 0.02e-12),
}
"""What a laboratory might have: of the channels [F]."""
ZEROS = {"plate": 12e-6, "disc": -8e-6, "tube": 20e-6}
"""[m]"""


def drawing(design: Design) -> str:
    """The board as SVG in millimetres: one group per copper layer, and in it one path per net.

    Groups have a class and no name, as ``capsense layout`` takes names of groups for nets.
    """
    (slab,) = design.layers
    width, depth = (round(1e3 * float(v), 6) for v in (slab.upper - slab.lower)[:2])
    layers: dict[str, list[str]] = {"F_Cu": [], "B_Cu": []}
    (plane,) = (s for s in design.sheets if s.name == "PLANE")
    holes = [
        shapely.Polygon(ring) for facet in plane.surface.facets for ring in facet.polygon.interiors
    ]
    for sheet in design.sheets:
        if sheet.name == "TOOL":
            continue
        outlines = [facet.polygon for facet in sheet.surface.facets]
        back = sheet is plane
        layers["B_Cu" if back else "F_Cu"].append(_path(sheet.name, outlines))
        if not back:
            landings = [
                shapely.box(x - LANDING, y - LANDING, x + LANDING, y + LANDING)
                for x, y in (
                    (1e3 * h.centroid.x, 1e3 * h.centroid.y)
                    for h in holes
                    if any(o.covers(h.centroid) for o in outlines)
                )
            ]
            scaled = [shapely.affinity.scale(b, 1e-3, 1e-3, origin=(0, 0)) for b in landings]
            layers["B_Cu"].append(_path(sheet.name, scaled, f"{sheet.name}_landing"))
    body = "\n".join(
        f'  <g class="{name}" fill="{colour}" stroke="none">\n'
        + "\n".join(layers[name])
        + "\n  </g>"
        for name, colour in (("B_Cu", "#0072B2"), ("F_Cu", "#D55E00"))
    )
    left, top = -width / 2, -depth / 2
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg"\n'
        '     xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"\n'
        f'     width="{width:g}mm" height="{depth:g}mm"\n'
        f'     viewBox="{left:g} {top:g} {width:g} {depth:g}">\n'
        "  <!-- Made by make_files.py from board.toml; millimetres. Class F_Cu: front copper,\n"
        "       B_Cu: back copper, both seen from the front. Each landing has a plated hole of\n"
        "       0.4 mm, filled and capped. No solder mask on the front. -->\n"
        f'  <rect id="Edge_Cuts" x="{left:g}" y="{top:g}" width="{width:g}" height="{depth:g}" '
        'fill="#e9e5d3" stroke="none"/>\n'
        f"{body}\n</svg>\n"
    )


def _path(net: str, outlines: Sequence[shapely.Polygon], name: str = "") -> str:
    """One path of a net; y of SVG points down."""
    rings = [ring for o in outlines for ring in (o.exterior, *o.interiors)]
    steps = []
    for ring in rings:
        corners = [f"{1e3 * x:.4f},{-1e3 * y:.4f}" for x, y in ring.coords[:-1]]
        steps.append(f"M {' L '.join(corners)} Z")
    return (
        f'    <path id="{name or net}" inkscape:label="{net}" fill-rule="evenodd" '
        f'd="{" ".join(steps)}"/>'
    )


def positions() -> Iterator[Position]:
    """All rows of the day, in the order in which they are measured."""
    yield from _still("open", 5)
    yield from _still("empty", 10)
    for body in BODIES:
        for grounding in compare.GROUNDINGS:
            for _ in range(REPEATS):
                yield from approach(body, HEIGHTS, grounding)
            yield from _still("empty", 5)
    yield from _still("empty", 5, COVER)
    for _ in range(REPEATS):
        yield from approach("plate", COVERED, "grounded", COVER)
    yield from _still("empty", 5, COVER)


def approach(
    body: str, heights: Sequence[float], grounding: str, cover: float = 0.0
) -> Iterator[Position]:
    """A body goes down and up again, at heights [mm]."""
    x, y = PLACES[body]
    for direction, way in (("down", sorted(heights, reverse=True)), ("up", sorted(heights))):
        for height in way:
            yield Position(
                body, 1e-3 * x, 1e-3 * y, 1e-3 * height, grounding, 1e-3 * cover, direction
            )


def _still(body: str, count: int, cover: float = 0.0) -> Iterator[Position]:
    for _ in range(count):
        yield Position(body, 0.0, 0.0, 0.0, "none", 1e-3 * cover, "none")


def synthetic(
    rows: Sequence[Position], *, noise: float, seed: int, preset: str,
    permittivity: float = compare.FR4,
) -> Array:  # fmt: skip
    """What a laboratory with :data:`FAULTS` and :data:`ZEROS` would measure [F], shape (n, K).

    Args:
        rows: The positions.
        noise: Standard deviation of a value [F].
        seed: Of the noise.
        preset: Of the simulator that stands for nature.
        permittivity: Of the board.
    """
    true = compare.changes(rows, ZEROS, {}, preset, permittivity)
    for number, row in enumerate(rows):
        if row.body != "open":
            sim = compare.simulator(preset, permittivity, row.cover)
            true[number] += compare.values_of(sim.empty)
    scatter = noise * np.random.default_rng(seed).standard_normal(true.shape)
    return true * np.array(FAULTS["gain"]) + np.array(FAULTS["stray"]) + scatter


def table(rows: Sequence[Position], values: Array | None, head: Sequence[str]) -> str:
    """The text of a file: comments, the header and the rows, without values if there are none."""
    lines = [f"# {line}" for line in head]
    lines.append(",".join(KEYS if values is None else COLUMNS))
    for number, p in enumerate(rows):
        cells = [p.body, *(f"{1e3 * v:g}" for v in (p.x, p.y, p.height)), p.grounding,
                 f"{1e3 * p.cover:g}", p.direction]  # fmt: skip
        if values is not None:
            cells += [f"{1e12 * v:.6f}" for v in values[number]]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write the files beside this script."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--synthetic", action="store_true", help="make synthetic.csv too")
    options = parser.parse_args()
    rows = list(positions())
    (HERE / "board.svg").write_text(drawing(compare.board()), encoding="utf-8")
    (HERE / "positions.csv").write_text(
        table(rows, None, [f"{len(rows)} rows in the order of the day; docs/experiment.md"]),
        encoding="utf-8",
    )
    (HERE / "measured.csv").write_text(
        table([], np.zeros((0, len(CHANNELS))), [
            "Template: nobody has run the experiment yet. Put date, laboratory, meter, stage here,",
            "then one row for each of positions.csv, in the order in which they were taken.",
        ]),
        encoding="utf-8",
    )  # fmt: skip
    if options.synthetic:
        noise = compare.chip_noise()
        values = synthetic(rows, noise=noise, seed=1, preset="fine")
        (HERE / "synthetic.csv").write_text(
            table(rows, values, [
                "SYNTHETIC: made by make_files.py --synthetic, seed 1, simulated with preset fine.",
                "No measurement; it shows what compare.py does.",
            ]),
            encoding="utf-8",
        )  # fmt: skip
    print(f"{len(rows)} rows, {sum(p.body not in NO_BODY for p in rows)} of them with a body")


if __name__ == "__main__":
    main()
