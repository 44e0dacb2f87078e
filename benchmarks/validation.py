"""Everything CapSense was measured against, on one page: ``python benchmarks/validation.py``.

Writes ``docs/validation.md``. Analytic cases and converged references are computed here; the
paper's and the hardware's part come from ``capsense reproduce all``, which is run first and only
computes what it has not yet; the peers' and the boards' from what ``--all`` or their benchmarks
left in ``out/``, for these take an hour.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

from curved_cases import curved_body, curved_figures, curved_reference  # noqa: E402
from field_cases import (  # noqa: E402
    body_of,
    capsule,
    capsule_reference,
    delta_reference,
    empty_reference,
    figures,
    patches,
    rectangle,
)
from fit_scenario1 import held_out, likeness, simulators, tables_of  # noqa: E402
from machine import describe_machine  # noqa: E402
from peers_report import rows as peer_rows  # noqa: E402

import capsense as cs  # noqa: E402
from capsense.constants import EPS0  # noqa: E402
from capsense.reproduce.registry import STUDIES  # noqa: E402
from capsense.reproduce.scenario1_fit import tabulate  # noqa: E402
from capsense.reproduce.scenario1_setup import load_setup  # noqa: E402

COMMAND = "python benchmarks/validation.py"
BOARDS = "python benchmarks/boards.py stripe patch"
MADELUNG = 1.7475646
"""Of rock salt: what the images of a charge in the middle of a grounded cube amount to."""
Cells = Sequence[object]


def table(header: Cells, lines: Sequence[Cells]) -> str:
    """A table in Markdown."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join(f"| {' | '.join(str(c) for c in row)} |" for row in rows)


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


def references() -> str:
    """Errors of ΔC on each packaged case for which there is a reference."""
    lines = []
    for name in ("six_patch_bare", "six_patch"):
        sim = cs.Simulator(name)
        off = np.abs(sim.baseline / empty_reference(name) - 1)
        largest = max(np.diag(off).max(), off[0, 1], off[0, 3])
        lines.append((name, "empty: diagonal and nearest neighbours", f"{100 * largest:.2f} %", ""))
        for case in figures()[name]:
            if case != "none":
                delta = sim.step(cs.Scene([body_of(case)])).delta
                label = case.replace("_", " ").replace(" 1.0", "")
                lines.append((name, label, *_apart(delta, delta_reference(name, case))))
    sim = cs.Simulator("six_patch_bare")
    for gap in (5, 10, 20, 50, 100):
        delta = sim.step(cs.Scene([capsule(gap / 1e3)])).delta
        case = f"tilted limb (capsule), {gap} mm"
        lines.append(("six_patch_bare", case, *_apart(delta, capsule_reference(gap))))
    sim = cs.Simulator("arm_segment")
    for case in curved_figures()["cases"]:
        delta = sim.step(cs.Scene([curved_body(case)])).delta
        lines.append(("arm_segment", case, *_apart(delta, curved_reference(case))))
    return table(("design", "case", "diagonal of ΔC", "other entries"), lines)


def _apart(delta: np.ndarray, expected: np.ndarray) -> tuple[str, str]:
    """Largest error of the diagonal; of the rest, as a part of the largest change."""
    wrong = np.abs(delta - expected)
    diagonal = (np.diag(wrong) / np.abs(np.diag(expected))).max()
    np.fill_diagonal(wrong, 0.0)
    return f"{100 * diagonal:.2f} %", f"{100 * wrong.max() / np.abs(expected).max():.2f} %"


def random_scenes() -> str:
    """The summary that ``benchmarks/random_scenes.py`` prints last."""
    run = [sys.executable, str(ROOT / "benchmarks" / "random_scenes.py")]
    printed = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    return printed.strip().splitlines()[-1].removeprefix("  all: ")


def boards(path: Path) -> str:
    """What ``benchmarks/boards.py`` printed."""
    if not path.exists():
        return f"Not measured in this edition: `{BOARDS}`; half an hour."
    return f"`{BOARDS}`:\n\n```\n{path.read_text(encoding='utf-8').strip()}\n```"


def machine() -> str:
    """What the page was made on, in a line."""
    found = describe_machine(("capsense", "numpy", "scipy", "numba", "mujoco", "pybullet"))
    versions = ", ".join(f"{name} {number}" for name, number in found["versions"].items())
    return f"{found['processor']}, {found['cores']} cores, load {found['load']:.1f}; {versions}"


# -- what others computed or measured --------------------------------------------------------------


def peers(path: Path) -> str:
    """Time and error of each solver, from the results that the benchmark left."""
    if not path.exists():
        return (
            "not measured in this edition; it needs the peers installed and a quarter of an hour."
        )
    results = json.loads(path.read_text(encoding="utf-8"))
    lines = []
    for group in results:
        for row in sorted(peer_rows(results, group).values(), key=lambda r: r["median_ms"]):
            lines.append((group, row["name"], f"{row['tetrahedra']:,d}",
                          f"{row['median_ms']:.2f}", f"{100 * row['worst']:.1f} %"))  # fmt: skip
    head = ("mesh", "method", "tetrahedra", "step, ms (median)", "largest error of ΔC's diagonal")
    return table(head, lines)


def foretold() -> str:
    """Scenario 1's panels, each with the shared figures of a fit to the other one."""
    setup = load_setup()
    grids = {name: tabulate(sim, setup) for name, sim in simulators(setup).items()}
    tables = tables_of(setup, grids)
    lines = []
    for name, found in held_out(setup, tables).items():
        correlation, error = likeness(found, name, tables[name])
        lines.append((name, f"{correlation:.4f}", f"{error:.4f}"))
    return table(("panel that is held out", "zero-mean correlation", "rms error"), lines)


def studies(folder: Path) -> str:
    """The rows of every study of ``capsense reproduce``."""
    blocks = []
    for name in STUDIES:
        path = folder / name / "rows.json"
        if not path.exists():
            blocks.append(f"### {name}\n\nNot run in this edition: `capsense reproduce {name}`.")
            continue
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["reduced"]:
            raise SystemExit(f"{path} is of the reduced form; run: capsense reproduce {name}")
        lines = [
            (r["what"], f"{r['value']:.4g} {r['unit']}".strip(), r["target"], r["verdict"])
            for r in found["rows"]
        ]
        grid = table(("what", "value", "target", "verdict"), lines)
        blocks.append(f"### {found['title']}\n\n`capsense reproduce {name}`\n\n{grid}")
    return "\n\n".join(blocks)


PAGE = """\
# Validation

What CapSense was measured against, and what it was not. The page is written by

```console
$ {command}
```

which runs what is named beside each figure; the peers and the boards only with `--all`, for they
take an hour. This edition: {machine}.

## Analytic cases

{analytic}

The first three are of the empty domain, solved by boundary elements when a design is built. The
last two are of the online solver with an object almost in touch, the hardest place for it. Formulas
of discs leave out terms of second order in the ratio of gap and radius. More such cases run as
tests: `python -m pytest tests/field tests/solve tests/test_simulator_*.py`.

## Converged references

Largest errors, against boundary elements good to about 0.1 % (bar and ball:
`tests/data/reference_capacitances.json`; limb, and the curved
`arm_segment`, to 1 %: `python benchmarks/references.py`). Other entries are taken as a part of the
case's largest change. Numbers in the names are gaps in millimetres.

{references}

Over 40 random scenes of limbs, balls and tilted boxes 5 to 80 mm away, against a lattice of seven
times as many nodes (`python benchmarks/random_scenes.py`): {random}.

### Boards with copper pours

A grounded bar over two boards of scenario 1, against boundary elements of board and bar together:
the largest error of ΔC's diagonal, and of any of its mutual capacitances as a part of itself,
however small. {boards}

## Peers

A bar that moves over `six_patch_bare`, one core, `python benchmarks/peers.py`:

{peers}

## The paper, and hardware

{studies}

### Scenario 1, foretold

What both boards share is fitted to one panel of hardware and foretells the other; only the latter's
depth of the triangle and sample rate, and the stripe panel's level, are fitted to it.
`python benchmarks/fit_scenario1.py --held-out`

{foretold}

## What is not validated

- **Self-capacitance along limbs.** No measurements are public: [scenario 2](scenario2.md) compares
  simulations with each other, and the [limb approach](limb_approach.md) compares shapes of curves
  with fits that were published, of a sensor whose size is not.
- **Scenario 1 beyond two panels.** Its eleven free figures were fitted to the same two panels that
  it is held against. With one panel held out, only the stripes foretell the other; the patches
  alone leave distance and stray capacitance open. Hardware curves of the other trajectories and of
  the meander board are not public.
- **Absolute capacitances of the paper's boards.** Their dimensions are read from photographs, good
  to ±5 %; published curves are normalised.
- **Materials with loss.** A material conducts or it does not. Wet cloth and thin skin, whose
  conductivity matters in between, are not modelled.
- **The path to ground of people** beyond one capacitance, and its drift.
- **Read-out chips** against recordings: figures are those of data sheets, each with its status, see
  [read-out](readout.md). Flicker floors are assumptions.
- **Wires, connectors, and robots' bodies behind a sensor,** unless the design describes them. What
  is behind an electrode changes its range more than anything else, see
  [limb approach](limb_approach.md).
- **Deforming skin and cloth** against anything but other geometry, see [depth](depth.md).
- **CoppeliaSim and Unity** themselves: only their protocols are tested, against stand-ins.
"""


def run(*command: str) -> int:
    """Run a Python command; return its exit code."""
    return subprocess.run([sys.executable, *command], check=False).returncode


def measure_peers_and_boards(out: Path) -> None:
    """Fill the folder with what the page only shows."""
    if run(str(ROOT / "benchmarks" / "peers.py"), "-o", str(out / "peers")):
        raise SystemExit("benchmarks/peers.py failed")
    command = [sys.executable, str(ROOT / "benchmarks" / "boards.py"), *BOARDS.split()[2:]]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (out / "boards.txt").write_text(printed, encoding="utf-8")


def main() -> None:
    """Run, measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "validation.md")
    parser.add_argument("--out", type=Path, default=ROOT / "out", help="folder for results")
    parser.add_argument("--as-is", action="store_true", help="run no study, take what is there")
    parser.add_argument("--all", action="store_true", help="peers and boards, too: an hour")
    args = parser.parse_args()
    reproduced = args.out / "reproduced"
    if args.all:
        measure_peers_and_boards(args.out)
    code = 0 if args.as_is else run("-m", "capsense", "reproduce", "all", "-o", str(reproduced))
    if code not in (0, 3):  # 3: a figure missed its target, which the page tells
        raise SystemExit(f"capsense reproduce all failed with {code}")
    page = PAGE.format(
        command=COMMAND, machine=machine(), analytic=analytic(), references=references(),
        random=random_scenes(), boards=boards(args.out / "boards.txt"),
        peers=peers(args.out / "peers" / "peers.json"), studies=studies(reproduced),
        foretold=foretold(),
    )  # fmt: skip
    args.output.write_text(page, encoding="utf-8")
    print(f"wrote {args.output}")


if __name__ == "__main__":
    main()
