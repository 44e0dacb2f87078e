"""CapSense, the paper's scheme and off-the-shelf solvers at one task: time and error of each.

    python benchmarks/peers.py                        # all of it: half an hour, out/peers/
    python benchmarks/peers.py --quick                # 30,000 tetrahedra only, few steps
    python benchmarks/peers.py --plot docs/images/frontier.png

The task: ``six_patch_bare``, a grounded bar of 150 × 150 × 20 mm that moves at 0.116 m/s, 100 times
a second; the bar's nodes found, the operator brought up to date, six right-hand sides solved, the
6 × 6 matrix returned. One core; times are the processor's (``capsense.bench.Times``). Methods of a
group take turns, so that whatever else the machine does meets all of them; a turn's first step is
not counted. Errors are those of the diagonal of ΔC against boundary elements good to 0.1 %. Ratios
are taken within a group. The peers:

    pip install ".[peers]" "scikit-sparse<0.5"

scikit-sparse is built from source and needs a compiler and Debian's libsuitesparse-dev. A peer that
is not installed is left out, and the table says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine, on_one_core
from peers_capsense import CapSense, PaperOnLattice, PaperScheme
from peers_direct import Cholmod, Pardiso
from peers_iterative import AmgCg, AmgRebuiltCg, JacobiCg, PlainCg, ScikitFem
from peers_ngsolve import NgSolve, NgSolveRemeshed
from peers_report import plot, report
from peers_task import (
    GAPS,
    SAMPLES,
    Array,
    baseline,
    conforming_mesh,
    diagonal_error,
    p1_system,
    p2_system,
    timed_place,
)

PACKAGES = ("capsense", "numpy", "scipy", "numba", "gmsh", "pypardiso", "mkl", "scikit-sparse",
            "pyamg", "scikit-fem", "ngsolve")  # fmt: skip
TURNS = 6
BUDGET = 12.0
"""Time [s] spent on the steps of one method."""
AWAY = (9.0, 9.0)
"""A place of the bar, outside the domain."""
SCALES = {"30k": 1.55, "100k": 1.0}
HEADINGS = "tetrahedra, median, mean, p95, p99 [ms], median by the clock; errors [%] at"
Makers = dict[str, Callable[[], Any]]


def on_mesh(scale: float, folder: Path, names: tuple[str, ...]) -> Makers:
    """P1 methods on one conforming mesh, by label."""
    mesh = conforming_mesh(scale, folder)
    system = p1_system(mesh)
    known: Makers = {
        "paper": lambda: PaperScheme(mesh, warm_start=False),
        "paper, warm": lambda: PaperScheme(mesh, warm_start=True),
        "pardiso": lambda: Pardiso(system),
        "cholmod": lambda: Cholmod(system),
        "jacobi": lambda: JacobiCg(system),
        "plain cg": lambda: PlainCg(system),
        "amg": lambda: AmgCg(system),
        "amg rebuilt": lambda: AmgRebuiltCg(system),
        "skfem": lambda: ScikitFem(system),
        "ngsolve": lambda: NgSolve(mesh),
    }
    return {name: known[name] for name in names}


def groups(folder: Path) -> dict[str, Callable[[], Makers]]:
    """What is measured together, by name; meshes are made when a group's turn comes."""
    everyone = (
        "paper", "paper, warm", "pardiso", "cholmod", "jacobi", "plain cg", "amg", "amg rebuilt",
        "skfem", "ngsolve",
    )  # fmt: skip
    return {
        "30k": lambda: {
            "capsense": CapSense, **on_mesh(SCALES["30k"], folder, everyone)
        },
        "100k": lambda: {"capsense": CapSense, **on_mesh(SCALES["100k"], folder, everyone)},
        "same planes": lambda: {
            "capsense": CapSense,
            "paper": lambda: PaperOnLattice(warm_start=False),
            "paper, warm": lambda: PaperOnLattice(warm_start=True),
        },
        "P2, 10k": lambda: {
            "pardiso": lambda: Pardiso(p2_system(conforming_mesh(2.4, folder))),
        },
        "P2, 30k": lambda: {
            "pardiso": lambda: Pardiso(p2_system(conforming_mesh(1.55, folder))),
        },
        "P2, 100k": lambda: {
            "pardiso": lambda: Pardiso(p2_system(conforming_mesh(1.0, folder))),
        },
        "300k": lambda: on_mesh(0.7, folder, ("pardiso", "jacobi", "ngsolve")),
        "1M": lambda: on_mesh(0.48, folder, ("pardiso", "jacobi", "ngsolve")),
        "2M": lambda: on_mesh(0.38, folder, ("jacobi", "ngsolve")),
        "remeshed": lambda: {"capsense": CapSense, "ngsolve": NgSolveRemeshed},
        "fast": lambda: {"capsense": lambda: CapSense("fast")},
        "fine": lambda: {"capsense": lambda: CapSense("fine")},
    }  # fmt: skip


def measure(makers: Makers, budget: float) -> list[dict[str, Any]]:
    """Prepare, time and check the methods of a group, taking turns."""
    methods, rows = [], []
    for label, make in makers.items():
        start = time.perf_counter()
        try:
            method = make()
            prepared = time.perf_counter() - start
            method.step(*timed_place(0))
        except ImportError as error:
            rows.append({"label": label, "missing": str(error)})
            print(f"  {label}: left out, {error}", flush=True)
            continue
        start = time.perf_counter()
        method.step(*timed_place(1))
        steps = int(np.clip(budget / (time.perf_counter() - start), 1, SAMPLES) / TURNS)
        methods.append((label, method, prepared, max(2, steps), Times()))
    for turn in range(TURNS):
        for _, method, _, steps, times in methods:
            for k in range(steps):
                place = timed_place(turn * SAMPLES // TURNS + k)
                times.take(partial(method.step, *place), keep=k > 0)
    for label, method, prepared, _, times in methods:
        rows.append({"label": label, "name": method.name, "settings": method.settings,
                     "tetrahedra": method.n_tets, "unknowns": method.unknowns,
                     "prepare_s": prepared, **times.summary(), **errors(method)})  # fmt: skip
        print(line(rows[-1]), flush=True)
        if hasattr(method, "close"):
            method.close()
    return rows


def errors(method: Any) -> dict[str, Any]:
    """Largest error of ΔC's diagonal at each gap [mm], the worst of these, and that of C⁰."""
    empty: Array | None = None
    if not getattr(method, "returns_change", False):
        empty = method.step(*AWAY)
    found = {}
    for gap in GAPS:
        matrix = method.step(0.0, 1e-3 * gap)
        found[str(gap)] = diagonal_error(matrix if empty is None else matrix - empty, gap)
    own = getattr(method, "baseline", empty)
    off = None if own is None else float((np.diag(own) / np.diag(baseline()) - 1).max())
    return {"errors": found, "worst": max(map(abs, found.values())), "baseline_error": off}


def line(row: dict[str, Any]) -> str:
    """A result as a line of text."""
    per_gap = " ".join(f"{100 * e:+7.1f}" for e in row["errors"].values())
    keys = ("median_ms", "mean_ms", "p95_ms", "p99_ms", "clock_median_ms")
    times = " ".join(f"{row[key]:8.2f}" for key in keys)
    return f"  {row['name']:36s} {row['tetrahedra']:9,d} {times}   {per_gap}"


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/peers"), help="folder")
    parser.add_argument("--quick", action="store_true", help="the first group only, few steps")
    parser.add_argument("--only", metavar="GROUP", nargs="+", help="some groups only")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="draw what was measured last")
    args = parser.parse_args()
    path = args.output / "peers.json"
    if args.plot is None:
        on_one_core()
        args.output.mkdir(parents=True, exist_ok=True)
        known = groups(args.output / "meshes")
        wanted = ["30k"] if args.quick else args.only or list(known)
        for name in wanted:
            if name not in known:
                sys.exit(f"there is no group {name!r}; known: {', '.join(known)}")
        results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
        for name in wanted:
            print(f"{name}: {HEADINGS} {GAPS} mm", flush=True)
            load = os.getloadavg()[0]
            rows = measure(known[name](), 1.0 if args.quick else BUDGET)
            results[name] = {**describe_machine(PACKAGES), "load": load, "results": rows}
            ordered = {key: results[key] for key in known if key in results}
            path.write_text(json.dumps(ordered, indent=1) + "\n")
    else:
        plot(json.loads(path.read_text()), args.plot)
    print(report(json.loads(path.read_text())))


if __name__ == "__main__":
    main()
