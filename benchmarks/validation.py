"""Everything CapSense was measured against, on one page: ``python benchmarks/validation.py``.

Writes ``docs/validation.md`` from ``validation_page.md``. Analytic cases and references are
computed here, in a minute or two; the paper's and the hardware's part come from ``capsense
reproduce all``, which is run first and only computes what it has not yet. Smoothness comes from
what its benchmark has left in ``out/``; ``--all`` runs it.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import shapely

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

import accuracy_map
import limits
import reference_designs
from curved_cases import curved_body, curved_figures, curved_reference
from field_cases import (
    body_of,
    capsule,
    capsule_reference,
    delta_reference,
    empty_reference,
    figures,
    patches,
    rectangle,
)
from fit_scenario1 import held_out, level_boards, likeness, simulators, tables_of
from machine import describe_machine
from reference_scenes import MAP, MORE, ReferenceScene, reference_scenes
from scenario1_fit import tabulate
from validation_results import (
    SMOOTHNESS,
    Cells,
    smoothness,
    studies,
    table,
)

import capsense as cs
from capsense.constants import EPS0
from capsense.reproduce.scenario1_setup import load_setup

ROOT = Path(__file__).parents[1]
COMMAND = "python benchmarks/validation.py"
TEMPLATE = Path(__file__).with_name("validation_page.md")
MADELUNG = 1.7475646
"""Of rock salt: what the images of a charge in the middle of a grounded cube amount to."""
PRESETS = ("fast", "standard", "fine")
GAPS = ("5 mm", "10 mm", "20 mm", "50 mm")


def per_cent(value: float) -> str:
    """A signed fraction as text."""
    return f"{100 * value:+.2f} %"


# -- analytic cases --------------------------------------------------------------------------------


def analytic() -> str:
    """Cases whose answer is a formula."""
    lines = [square_plate(), disc_over_floor(), half_filled(), *disc_between_planes()]
    return table(("case", "formula, pF", "CapSense, pF", "apart"), lines)


def _line(case: str, expected: float, got: float) -> Cells:
    return case, f"{1e12 * expected:.4f}", f"{1e12 * got:.4f}", per_cent(got / expected - 1)


def square_plate() -> Cells:
    """A square in the middle of a grounded cube: its free capacitance in series with images."""
    a, cube = 0.05, 0.5
    free = figures()["unit_square_plate"]["C_over_4pi_eps0_a"] * 4 * math.pi * EPS0 * a
    expected = 1 / (1 / free - MADELUNG / (4 * math.pi * EPS0 * cube))
    got = cs.Simulator(patches(rectangle((0, 0), (a, a)))).baseline[0, 0]
    return _line("square of 50 mm in the middle of a grounded cube of 0.5 m", expected, got)


def disc(radius: float, height: float) -> cs.Simulator:
    """A disc at a height above the floor."""
    outline = shapely.Point(0, 0).buffer(radius, quad_segs=48)
    return cs.Simulator(patches(outline, backplane=height))


def disc_over_floor() -> Cells:
    """Kirchhoff's disc capacitor, halved by symmetry."""
    r, h = 0.02, 0.001
    edge = EPS0 * r * (math.log(16 * math.pi * r / (2 * h)) - 1)
    expected = 2 * (EPS0 * math.pi * r**2 / (2 * h) + edge)
    got = disc(r, h).baseline[0, 0]
    return _line("disc of 20 mm radius, 1 mm above the floor (Kirchhoff)", expected, got)


def half_filled() -> Cells:
    """Electrodes in the interface of two media in the middle of the box see their mean."""
    from capsense.design.model import Layer

    square = rectangle((0, 0), (0.03, 0.03))
    oil = Layer("oil", "eps 5", 5.0, np.array([-0.1, -0.1, -0.1]), np.array([0.1, 0.1, 0.0]))
    bare = cs.Simulator(patches(square, size=0.2, backplane=0.1)).baseline[0, 0]
    half = cs.Simulator(patches(square, size=0.2, backplane=0.1, layers=(oil,))).baseline[0, 0]
    return _line(
        "square of 30 mm on a medium of eps_r 5 that fills half of the box", 3 * bare, half
    )


def disc_between_planes(gaps: Sequence[float] = (0.002, 0.005)) -> list[Cells]:
    """A disc midway between the floor and a wide grounded plate, which is an object of the scene.

    The field at its rim is that of a half plane midway between two planes, which acts as if it
    reached out further by 2 ln 2 / π of the gap.
    """
    lines = []
    r = 0.03
    for h in gaps:
        reach = r + 2 * math.log(2) / math.pi * h
        expected = 2 * EPS0 * math.pi * reach**2 / h
        plate = cs.Body(cs.Box((0.2, 0.2, 0.02)), cs.Pose((0, 0, h + 0.01)), "steel")
        got = disc(r, h).step(cs.Scene([plate])).capacitance[0, 0]
        label = f"disc of 30 mm radius between floor and a grounded body, {1e3 * h:.0f} mm each"
        lines.append(_line(label, expected, got))
    return lines


# -- converged references --------------------------------------------------------------------------


Apart = tuple[float, float]
"""Largest error of the diagonal, and of the rest as a part of the largest change."""


def errors_of_references() -> dict[tuple[str, str], dict[str, Apart]]:
    """Design and body → case → errors of ΔC, for each packaged case with a reference."""
    out: dict[tuple[str, str], dict[str, Apart]] = {}
    for name in ("six_patch_bare", "six_patch"):
        sim = cs.Simulator(name)
        off = np.abs(sim.baseline / empty_reference(name) - 1)
        largest = max(np.diag(off).max(), off[0, 1], off[0, 3])
        out[name, "empty, nearest neighbours"] = {"–": (float(largest), math.nan)}
        for case in figures()[name]:
            if case != "none":
                delta = sim.step(cs.Scene([body_of(case)])).delta
                words = case.replace("_", " ").replace("diel", "eps")
                kind, _, rest = words.removesuffix(" 1.0").partition(" ")
                out.setdefault((name, kind), {})[rest] = _apart(delta, delta_reference(name, case))
    sim = cs.Simulator("six_patch_bare")
    for gap in (5, 10, 20, 50, 100):
        delta = sim.step(cs.Scene([capsule(gap / 1e3)])).delta
        cases = out.setdefault(("six_patch_bare", "tilted limb"), {})
        cases[str(gap)] = _apart(delta, capsule_reference(gap))
    sim = cs.Simulator("arm_segment")
    for case in curved_figures()["cases"]:
        delta = sim.step(cs.Scene([curved_body(case)])).delta
        kind, _, gap = case.partition(" ")
        out.setdefault(("arm_segment", kind), {})[gap] = _apart(delta, curved_reference(case))
    return out


def references() -> str:
    """The largest of them as a table, a line a body."""
    lines = []
    for (design, body), cases in errors_of_references().items():
        diagonal = f"{100 * max(errors[0] for errors in cases.values()):.1f}"
        others = [100 * e for _, e in cases.values() if not math.isnan(e)]
        worst = f"{max(others):.1f}" if others else "–"
        lines.append((design, body, len(cases), diagonal, worst))
    return table(("design", "body", "cases", "diagonal, %", "others, worst"), lines)


def _apart(delta: np.ndarray, expected: np.ndarray) -> Apart:
    """Largest error of the diagonal; of the rest, as a part of the largest change."""
    wrong = np.abs(delta - expected)
    diagonal = (np.diag(wrong) / np.abs(np.diag(expected))).max()
    np.fill_diagonal(wrong, 0.0)
    return float(diagonal), float(wrong.max() / np.abs(expected).max())


# -- maps of scenes --------------------------------------------------------------------------------


def map_rows(preset: str, cases: Sequence[ReferenceScene]) -> list[dict[str, Any]]:
    """Errors of every scene, as ``accuracy_map.py`` takes them."""
    return accuracy_map.run((preset, {"preset": preset}), list(cases))


def figures_of(rows: list[dict[str, Any]]) -> tuple[str, ...]:
    """Errors of the diagonal (rms, 95 %, worst) and of the other entries (rms, worst), %."""
    s = accuracy_map.summary(rows)
    keys = ("rms", "p95", "worst", "others_rms", "others_worst")
    return tuple(f"{s[k]:.2f}" for k in keys)


HEAD = ("rms", "95 % below", "worst", "others: rms", "worst")


def presets(names: Sequence[str] = PRESETS) -> str:
    """Errors of each preset over the two maps, those of the presets beside each other."""
    far = [c for c in reference_scenes(MORE) if c.gap > limits.NEAR]
    near = [c for c in reference_scenes(MORE) if c.gap <= limits.NEAR]
    groups = (("map, 5 to 150 mm", reference_scenes(MAP)), ("more, from 5 mm on", far),
              ("more, 0.5 to 2 mm", near))  # fmt: skip
    lines = []
    for title, cases in groups:
        found = [figures_of(map_rows(name, cases)) for name in names]
        lines.append((title, len(cases), *map("/".join, zip(*found, strict=True))))
    return table(("scenes", "number", *HEAD), lines)


def designs(only: str = "") -> str:
    """Errors over guarded pads and a pair of pads, of cases with ``only`` in their names.

    A line a design, with the cases beside each other.
    """
    found: dict[str, list[Cells]] = {}
    for case in reference_designs.compared("surface", only):
        design, _, body = case["name"].partition(", ")
        if body.startswith("3 mm cover"):
            design, body = f"{design}, 3 mm cover", body.partition(", ")[2]
        cells = ["–" if np.isnan(t) else f"{100 * (g / t - 1):+.2f}" for t, g in case["pairs"]]
        place = body.partition(" at ")[2].removesuffix(" mm")
        found.setdefault(design, []).append((place, *cells, f"{100 * case['error']:.2f}"))
    lines = []
    for design, cases in found.items():
        columns = (
            list(dict.fromkeys(c)) if set(c) == {"–"} else c for c in zip(*cases, strict=True)
        )
        lines.append((design, *(", ".join(map(str, c)) for c in columns)))
    head = (
        "design",
        "gap, mm",
        "pad, shields at ground",
        "mutual",
        "self, shields driven",
        "reference",
    )
    return table(head, lines)


def limited(part: str, *columns: str, lines: int | None = None) -> str:
    """A table of ``limits.py``, in per cent; its first lines only where a number is given."""
    found = islice(getattr(limits, part)(cs.Simulator(limits.DESIGN)), lines)
    cells = [(name, *(f"{100 * e:.1f}" for e in errors)) for name, errors in found]
    return table(("", *columns), cells)


def wide(lines: int | None = None) -> str:
    """Wide boxes: median, worst and told errors of each preset, in per cent."""
    found = islice(limits.wide(cs.Simulator(limits.DESIGN)), lines)
    cells = [
        (name, *(", ".join(f"{100 * e:.1f}" for e in errors[3 * k : 3 * k + 3]) for k in range(3)))
        for name, errors in found
    ]
    return table(("", *PRESETS), cells)


def inside() -> str:
    """What ``solver_error`` tells of bodies in the sensor, in a sentence."""
    told = {name: errors for name, errors in limits.inside(cs.Simulator(limits.DESIGN))}
    least = 100 * min(errors[-1] for errors in told.values())
    unnoticed = [name for name, errors in told.items() if errors[-2] < 0.1]
    return (
        f"5 mm below the face `solver_error` is {least:.0f} % of the largest entry or more. "
        f"1 mm below, it does not cover: {', '.join(unnoticed) or 'none'}."
    )


def machine() -> str:
    """What the page was made on, in a line."""
    found = describe_machine(("capsense", "numpy", "scipy", "numba", "mujoco", "pybullet"))
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    return f"{found['processor']}, {found['cores']} cores, load {found['load']:.1f}; {versions}"


# -- what others computed or measured --------------------------------------------------------------


def foretold() -> str:
    """Scenario 1's panels, each with the shared figures of a fit to the others."""
    setup = load_setup()
    grids = {name: tabulate(sim, setup) for name, sim in simulators(setup).items()}
    tables = tables_of(setup, grids)
    lines = []
    for height, begin in (("fitted", setup), ("the same", level_boards(setup))):
        for name, found in held_out(begin, tables).items():
            correlation, error = likeness(found, tables, name)
            lines.append((name, height, f"{correlation:.4f}", f"{error:.4f}"))
    header = ("panel held out", "boards' heights", "zero-mean correlation", "rms error")
    return table(header, lines)


def run(*command: str) -> int:
    """Run a Python command; return its exit code."""
    return subprocess.run([sys.executable, *command], cwd=ROOT, check=False).returncode


def measure_the_rest() -> None:
    """Measure what the page only shows."""
    if run(*SMOOTHNESS.split()[1:]):
        raise SystemExit(f"{SMOOTHNESS} failed")


def main() -> None:
    """Run, measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "validation.md")
    parser.add_argument("--as-is", action="store_true", help="run no study, take what is there")
    parser.add_argument("--all", action="store_true", help="smoothness, too: an hour")
    args = parser.parse_args()
    out = ROOT / "out"
    if args.all:
        measure_the_rest()
    reproduced = out / "reproduced"
    code = 0 if args.as_is else run("-m", "capsense", "reproduce", "all", "-o", str(reproduced))
    if code not in (0, 3):  # 3: a figure missed its target, which the page tells
        raise SystemExit(f"capsense reproduce all failed with {code}")
    page = TEMPLATE.read_text(encoding="utf-8").format(
        command=COMMAND, machine=machine(), analytic=analytic(), presets=presets(),
        references=references(), designs=designs(),
        smoothness=smoothness(out / "smoothness.json"),
        wide=wide(),
        images=limited("images", *GAPS),
        inside=inside(),
        studies=studies(reproduced), foretold=foretold(),
    )  # fmt: skip
    args.output.write_text(page, encoding="utf-8")
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()
