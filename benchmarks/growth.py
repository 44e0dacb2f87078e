"""How a step grows with the mesh, and how far it is from what the memory could do.

    python benchmarks/growth.py [-o out/growth.json] [--quick]

``six_patch``, a bar at 0.116 m/s sampled at 100 Hz, lattices from 10,000 to a million tetrahedra,
each in a process of its own so that its peak memory is its own (fields are built before, in another
process, and cached). Times are the processor's (``capsense.bench.Times``); "clock" is the median by
the clock. The bound is the bytes that a step must move over the bandwidth of a triad
(a ← b + s c) on arrays of together the same size, on one core.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine
from numba import njit

import capsense as cs
from capsense.bench import WARM_UP, moving_bar
from capsense.field.background import BuildSettings
from capsense.masked.planes import LatticeSettings

DESIGN = "six_patch"
REFINEMENTS = (0.33, 0.6, 1.0, 1.5, 2.25)
"""Lattices, as multiples of the default's nodes along an axis; about 10,000 to 1,000,000."""
LANES, SINGLE = 8, 4
"""Right-hand sides that go together, and bytes of a number."""
ITERATION = (10, 9)
"""Vectors of right-hand sides and single numbers a node that an iteration moves: backward sweep and
image (reads and writes u, p, z; five coefficients), forward sweep (reads and writes r, z; four)."""
AROUND = (7, 23)
"""The same for what a step does besides: weights copied, factors, loads, start, and the end, which
moves u too, in place of the last forward sweep."""


def bytes_moved(nodes: int, iterations: float) -> float:
    """Bytes that a step reads and writes, were every pass to find nothing in a cache."""
    vectors, numbers = (iterations * i + a for i, a in zip(ITERATION, AROUND, strict=True))
    return nodes * SINGLE * (LANES * vectors + numbers)


def working_set(nodes: int) -> int:
    """Bytes of the four vectors and nine coefficients that a step goes through."""
    return nodes * SINGLE * (4 * LANES + 9)


@njit(fastmath=True)
def _triad(a, b, c, rounds):  # type: ignore[no-untyped-def]
    for _ in range(rounds):
        for i in range(a.size):
            a[i] = b[i] + np.float32(0.5) * c[i]


def bandwidth(size: int) -> float:
    """Bytes a second [B/s] of a triad on three arrays of ``size`` bytes together; best of nine."""
    n = max(1, size // (3 * SINGLE))
    a, b, c = (np.ones(n, np.float32) for _ in range(3))
    rounds = max(1, int(2e8 / (3 * SINGLE * n)))
    _triad(a, b, c, 1)
    best = np.inf
    for _ in range(9):
        start = time.perf_counter()
        _triad(a, b, c, rounds)
        best = min(best, time.perf_counter() - start)
    return 3 * SINGLE * n * rounds / best


def measure(refinement: float, steps: int) -> dict[str, Any]:
    """Figures of one lattice, of this process."""
    lattice = LatticeSettings()
    settings = BuildSettings(lattice if refinement == 1.0 else lattice.refined(refinement))
    sim = cs.Simulator(DESIGN, settings=settings)
    times, iterations = Times(), []
    for k in range(WARM_UP + steps):
        scene = moving_bar(145 + k)
        reading = times.take(partial(sim.step, scene), keep=k >= WARM_UP)
        iterations.append(reading.stats.iterations)
    found = {**times.summary(), "iterations": float(np.median(iterations[WARM_UP:]))}
    facts = sim.describe()
    nodes = int(facts["nodes"])
    moved, speed = bytes_moved(nodes, found["iterations"]), bandwidth(working_set(nodes))
    return {
        "refinement": refinement, "tetrahedra": facts["tetrahedra"], "nodes": nodes, **found,
        "peak_memory_MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "working_set_MB": working_set(nodes) / 1e6, "moved_MB": moved / 1e6,
        "triad_GB_s": speed / 1e9, "bound_ms": 1e3 * moved / speed,
    }  # fmt: skip


def one(refinement: float, steps: int) -> dict[str, Any]:
    """Figures of one lattice, of a fresh process; the first builds the field if it is not there."""
    command = [sys.executable, __file__, "--one", str(refinement), "--steps"]
    start = time.perf_counter()
    first = json.loads(subprocess.check_output([*command, "1"], text=True))
    built = time.perf_counter() - start
    found = json.loads(subprocess.check_output([*command, str(steps)], text=True))
    return {**found, "first_run_s": built, "first_run_peak_MB": first["peak_memory_MB"]}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/growth.json"))
    parser.add_argument("--quick", action="store_true", help="the three coarsest lattices only")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--one", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(json.dumps(measure(args.one, args.steps)))
        return
    print(f"{'tetrahedra':>10s} {'nodes':>8s} {'median':>7s} {'p95':>7s} {'clock':>7s} ms "
          f"{'iter.':>5s} {'moved':>7s} MB {'triad':>6s} GB/s {'bound':>6s} ms "
          f"{'peak':>6s} MB {'built at':>8s} MB")  # fmt: skip
    results = []
    for refinement in REFINEMENTS[:3] if args.quick else REFINEMENTS:
        row = one(refinement, args.steps)
        results.append(row)
        print(f"{row['tetrahedra']:10,d} {row['nodes']:8,d} {row['median_ms']:7.2f} "
              f"{row['p95_ms']:7.2f} {row['clock_median_ms']:7.2f}    {row['iterations']:5.0f} "
              f"{row['moved_MB']:7.1f}    {row['triad_GB_s']:6.1f}      {row['bound_ms']:6.2f}    "
              f"{row['peak_memory_MB']:6.0f}    {row['first_run_peak_MB']:8.0f}",
              flush=True)  # fmt: skip
    cells, times = (np.array([r[k] for r in results], float) for k in ("tetrahedra", "median_ms"))
    exponent = float(np.polyfit(np.log(cells), np.log(times), 1)[0])
    print(f"exponent of the median: {exponent:.2f}")
    machine = describe_machine(("capsense", "numpy", "numba"))
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load']:.1f}")
    args.output.parent.mkdir(parents=True, exist_ok=True)
    text = {**machine, "exponent": exponent, "results": results}
    args.output.write_text(json.dumps(text, indent=1) + "\n")


if __name__ == "__main__":
    main()
