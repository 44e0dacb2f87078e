"""Time and error of a step of ``six_patch`` in three worlds; batches, starts, cold builds.

    python benchmarks/steps.py [-o out/steps.json] [--steps 300] [--no-build]

The worlds are those of ``capsense bench``: a bar at 0.116 m/s sampled at 100 Hz, twelve capsules
that all move, a 64 × 64 depth frame. Step times are the processor's; "clock" is the same by the
clock (``capsense.bench.Times``). Errors are those of ΔC's diagonal at some samples, each entry as a
part of itself, against the same samples on a lattice of a million tetrahedra. That lattice's own
error shows in the bar at the gaps of the boundary-element figures, and in how the lattices before
it come near it. Its field takes some minutes to build, once.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from machine import THREADS, describe_machine, on_one_core
from numpy.typing import NDArray

import capsense as cs
from capsense.bench import (
    CHECKS,
    DESIGN,
    WORLDS,
    reference_bar,
    start_times,
    time_batch,
    time_steps,
)
from capsense.design.loader import available_designs
from capsense.field.background import BuildSettings
from capsense.masked.planes import LatticeSettings

Array = NDArray[np.float64]
REFINEMENTS = (0.6, 1.0, 1.5)
"""Lattices, as multiples of the default's nodes along an axis …"""
REFERENCE = 2.25
"""… and the one that their errors are taken against."""
SAMPLES = (0, 40, 80, 120, 160)
FIGURES = Path(__file__).parents[1] / "tests" / "data" / "reference_capacitances.json"
"""Boundary-element figures, good to about 0.1 %."""
BUILD = """
import sys, time
import capsense as cs
from capsense.field.cache import load_or_build
start = time.perf_counter()
load_or_build(cs.load_design(sys.argv[1]), cache_dir=sys.argv[2], shipped=False)
print(time.perf_counter() - start, time.process_time())
"""


def simulator(refinement: float) -> cs.Simulator:
    """The design on a refined lattice."""
    lattice = LatticeSettings()
    chosen = BuildSettings(lattice if refinement == 1.0 else lattice.refined(refinement))
    return cs.Simulator(DESIGN, settings=chosen)


def samples(sim: cs.Simulator, name: str) -> Array:
    """Diagonal of ΔC [pF] at some samples of a world, and in the one of CHECKS, (n, 6)."""
    scenes = [*map(WORLDS[name], SAMPLES), CHECKS[name][0]()]
    return np.array([1e12 * np.diag(sim.step(scene).delta) for scene in scenes])


def against_elements(sim: cs.Simulator) -> dict[str, float]:
    """Error with the bar at the gaps [mm] of the boundary-element figures."""
    table = json.loads(FIGURES.read_text())[DESIGN]
    out = {}
    for case in table:
        if case.startswith("bar"):
            gap = case.replace("_", " ").split()[1]
            truth = np.diag(np.array(table[case]) - np.array(table["none"]))
            delta = sim.step(reference_bar(gap=1e-3 * float(gap))).delta
            out[gap] = float(np.abs(1e12 * np.diag(delta) / truth - 1).max())
    return out


def cold_builds() -> dict[str, list[float]]:
    """Time [s] to build each packaged design's field from nothing, by the clock and the
    processors', in a process of its own with all cores.
    """
    environment = {k: v for k, v in os.environ.items() if k not in THREADS}
    out = {}
    for name in available_designs():
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-c", BUILD, name, folder]
            printed = subprocess.check_output(command, text=True, env=environment)
            out[name] = [float(v) for v in printed.split()]
    return out


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/steps.json"))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--no-build", action="store_true", help="leave cold builds out")
    args = parser.parse_args()
    on_one_core()
    machine = describe_machine(("capsense", "numpy", "scipy", "numba"))
    print(f"{machine['processor']}, one core, load {machine['load']:.1f}")
    started = start_times()
    print("start, fresh process: " + ", ".join(f"{k} {v:.2f}" for k, v in started.items()))
    finest = simulator(REFERENCE)
    truth = {name: samples(finest, name) for name in WORLDS}
    for name, rows in truth.items():
        print(f"reference, {name}: {np.round(rows[-1], 6).tolist()} pF")
    elements = against_elements(finest)
    print(f"{finest.describe()['tetrahedra']:,d} tetrahedra, bar against boundary elements: "
          + ", ".join(f"{g} mm {100 * e:.2f} %" for g, e in elements.items()))  # fmt: skip
    del finest
    print(f"{'tetrahedra':>10s} {'':18s} {'median':>7s} {'p95':>7s} {'p99':>7s} {'clock':>7s} "
          f"{'p99':>7s} ms {'iter.':>5s} error % rms, max")  # fmt: skip
    rows: list[dict[str, Any]] = []
    batches: list[dict[str, Any]] = []
    for refinement in REFINEMENTS:
        sim = simulator(refinement)
        for name, world in WORLDS.items():
            row = {"tetrahedra": sim.describe()["tetrahedra"], "world": name,
                   **time_steps(sim, world, args.steps)}  # fmt: skip
            off = samples(sim, name) / truth[name] - 1
            row["error_rms"] = float(np.sqrt(np.mean(off**2)))
            row["error_largest"] = float(np.abs(off).max())
            rows.append(row)
            times = " ".join(f"{row[k]:7.2f}" for k in (
                "median_ms", "p95_ms", "p99_ms", "clock_median_ms", "clock_p99_ms"))  # fmt: skip
            print(f"{row['tetrahedra']:10,d} {name:18s} {times}    {row['iterations']:5.0f} "
                  f"{100 * row['error_rms']:6.2f} {100 * row['error_largest']:6.2f}",
                  flush=True)  # fmt: skip
        if refinement <= 1:
            cells = sim.describe()["tetrahedra"]
            for warm in (False, True):
                batches.append({"tetrahedra": cells, "warm_start": warm,
                                **time_batch(sim, 2, warm)})  # fmt: skip
                print("{tetrahedra:10,d} batch, two threads, {start}: {clock_per_s:.0f} scenes a "
                      "second by the clock, {per_s:.0f} by the processor".format(
                          start="each after one before" if warm else "each from rest",
                          **batches[-1]), flush=True)  # fmt: skip
            sim.reset()
    found = {
        **machine,
        **started,
        "reference_errors": elements,
        "results": rows,
        "batches": batches,
    }
    if not args.no_build:
        found["cold_build_s"] = cold_builds()
        print("cold build, by the clock and the processors' [s]: " + ", ".join(
            f"{k} {c:.0f} {p:.0f}" for k, (c, p) in found["cold_build_s"].items()))  # fmt: skip
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
