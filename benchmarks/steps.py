"""What a step costs on one core, by world and preset; batches, set-up, the first reading.

    python benchmarks/steps.py [--presets standard fast fine] [--steps 200] [-o out/steps.json]
    python benchmarks/steps.py --only finger --no-set-up

The worlds are those of ``step_scenes.py``, in front of ``six_patch``. Times are the processor's,
medians and 95 % (``capsense.bench.Times``); "clock" is the median by the clock. "off" is the
largest difference of ΔC at sample 0 from the bodies as plain shapes with the fine preset, over ΔC's
largest entry: what presets differ by, and what depth images and meshes lack besides. The paper's
scheme (``method="fem_masked"``, its default mesh) takes turns with the presets at single bodies.
"target" is what the standard preset is meant to take.

Batches are of 256 random bodies on two threads, by the clock. Set-up: the first reading of a shape
of new proportions, less a later one; a mesh of 20,000 triangles in a fresh cache folder
(``CAPSENSE_CACHE_DIR``), then again in a new process; the first reading of a process with an empty
numba cache (``NUMBA_CACHE_DIR``), then with the filled one.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine, on_one_core
from step_scenes import DESIGN, FINGER, World, low, random_scenes, worlds

import capsense as cs

PRESETS = ("standard", "fast", "fine")
TURNS, WARM_UP = 5, 3
MASKED_STEPS = 20
BATCH, ROUNDS, THREADS = 256, 5, 2
ONE_BODY = {"fast": 0.12}
"""Median that one body is meant to take [ms], where it is not the standard preset's."""
BATCH_TARGETS = {"standard": 4000, "fast": 15000}
"""Scenes a second."""
SHAPES: dict[str, Callable[[float], cs.Shape]] = {
    "sphere of a new size": lambda v: cs.Sphere(0.03 * v),
    "capsule of new proportions": lambda v: cs.Capsule(0.008, 0.05 * v),
    "box of new proportions": lambda v: cs.Box((0.1, 0.08 * v, 0.02)),
}
FIRST = f"""
import json, time
import capsense as cs
sim = cs.Simulator("{DESIGN}")
sim.step(cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.06)))]))
print(json.dumps({{"processor_s": time.process_time()}}))
"""
MESH = f"""
import json, sys, time
sys.path.insert(0, {str(Path(__file__).parent)!r})
from step_scenes import cs, person
sim = cs.Simulator("{DESIGN}")
sim.step(cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.06)))]))
body, t = person(), []
for _ in range(2):
    start = time.process_time()
    sim.step(cs.Scene([body]))
    t.append(time.process_time() - start)
print(json.dumps({{"first_s": t[0], "next_s": t[1], "triangles": len(body.shape.faces)}}))
"""


def reader(sim: cs.Simulator, world: World, k: int) -> Callable[[], cs.Reading]:
    """A step of sample k; what need not be timed is done before."""
    view = world.sample(k)
    return lambda: sim.step(view() if callable(view) else view)


def off_by(sim: cs.Simulator, fine: cs.Simulator, world: World) -> float | None:
    """Largest difference from the plain bodies with the fine preset, over the largest entry."""
    if not world.judged:
        return None
    exact = world.exact() if world.exact else world.sample(0)
    truth = fine.step(exact).delta  # type: ignore[arg-type]
    return float(np.abs(reader(sim, world, 0)().delta - truth).max() / np.abs(truth).max())


def time_world(sims: dict[str, cs.Simulator], world: World, steps: int) -> dict[str, Any]:
    """Times of each simulator. They take turns, so that whatever else the machine does meets all;
    the first steps of a turn, which fill the caches, do not count.
    """
    times = {name: Times() for name in sims if name != "fem_masked" or world.single}
    unknowns: dict[str, list[int]] = {name: [] for name in times}
    for turn in range(TURNS):
        for name, taken in times.items():
            count = MASKED_STEPS if name == "fem_masked" else steps
            for k in range(-WARM_UP, count // TURNS):
                sample = turn * steps // TURNS + k
                reading = taken.take(reader(sims[name], world, sample), keep=k >= 0)
                unknowns[name].append(reading.stats.unknowns)
    return {
        name: {**taken.summary(), "unknowns": float(np.median(unknowns[name]))}
        for name, taken in times.items()
    }


def time_batch(sim: cs.Simulator) -> float:
    """Random one-body scenes a second by the clock, the median of some batches."""
    rates = []
    for k in range(1 + ROUNDS):
        scenes = random_scenes(BATCH, after=k)
        start = time.perf_counter()
        sim.step_batch(scenes, threads=THREADS)
        rates.append(BATCH / (time.perf_counter() - start))
    return float(np.median(rates[1:]))


def time_shapes(sim: cs.Simulator) -> dict[str, float]:
    """Median time [ms] that the first reading of a new shape takes longer than the second."""
    out = {}
    for name, make in SHAPES.items():
        spent = []
        for k in range(5):
            scene, times = cs.Scene([low(make(1.0173 + 0.1 * k), 0.03)]), Times()
            for _ in range(2):
                times.take(partial(sim.step, scene))
            spent.append(times.processor[0] - times.processor[1])
        out[name] = float(np.median(spent))
    return out


def fresh(code: str, **environment: str) -> dict[str, float]:
    """What code prints in a process of its own."""
    command = [sys.executable, "-c", code]
    printed = subprocess.check_output(command, text=True, env={**os.environ, **environment})
    return json.loads(printed)


def set_up(sim: cs.Simulator) -> dict[str, Any]:
    """Measure and print what is done once."""
    out: dict[str, Any] = {"shapes_ms": time_shapes(sim)}
    for name, ms in out["shapes_ms"].items():
        print(f"{name}: {ms:.1f} ms")
    with tempfile.TemporaryDirectory() as folder:
        found = [fresh(MESH, CAPSENSE_CACHE_DIR=folder) for _ in range(2)]
    out["mesh"] = found
    print(f"mesh of {found[0]['triangles']:,d} triangles, first reading: {found[0]['first_s']:.2f} "
          f"s; of the next process {1e3 * found[1]['first_s']:.0f} ms", flush=True)  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = (fresh(FIRST, NUMBA_CACHE_DIR=folder)["processor_s"] for _ in range(2))
    out["first_reading_s"] = {"cold": cold, "warm": warm}
    print(f"process to its first reading, processor seconds: {cold:.1f} with an empty numba cache, "
          f"{warm:.1f} with the filled one", flush=True)  # fmt: skip
    return out


def show(world: World, name: str, row: dict[str, Any]) -> None:
    """A line of the table."""
    target = world.target if name == "standard" else ONE_BODY.get(name) if world.single else None
    goal = f"{target:7.2f}" if target else f"{'':7s}"
    off = f"{100 * row['off']:6.2f}" if row.get("off") is not None else f"{'':6s}"
    print(f"{world.name:34s} {name:9s} {row['median_ms']:8.3f} {row['p95_ms']:8.3f} {goal} "
          f"{row['clock_median_ms']:8.3f} {row['unknowns']:8.0f} {off}", flush=True)  # fmt: skip


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS))
    parser.add_argument("--only", default="", help="worlds with this in their name")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--no-masked", action="store_true", help="without the paper's scheme")
    parser.add_argument("--no-set-up", action="store_true", help="worlds only")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/steps.json"))
    args = parser.parse_args()
    on_one_core()
    machine = describe_machine(("capsense", "numpy", "scipy", "numba"))
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load']:.1f}; "
          + ", ".join(f"{k} {v}" for k, v in machine["versions"].items()))  # fmt: skip
    sims = {p: cs.Simulator(DESIGN, preset=p) for p in args.presets}
    fine = cs.Simulator(DESIGN, preset="fine")
    if not args.no_masked:
        sims["fem_masked"] = cs.Simulator(DESIGN, method="fem_masked")
    print(f"{'':34s} {'':9s} {'median':>8s} {'95 %':>8s} {'target':>7s} {'clock':>8s} ms "
          f"{'unknowns':>5s} off, %")  # fmt: skip
    rows: dict[str, Any] = {}
    for world in worlds():
        if args.only in world.name:
            rows[world.name] = found = time_world(sims, world, args.steps)
            for name, row in found.items():
                row["off"] = off_by(sims[name], fine, world)
                show(world, name, row)
    out = {**machine, "steps": rows}
    if not args.no_set_up:
        out["batches"] = {}
        for name in args.presets:
            sims[name].step(cs.Scene([low(FINGER, 0.01)]))
            out["batches"][name] = rate = time_batch(sims[name])
            goal = f", target {BATCH_TARGETS[name]:,d}" if name in BATCH_TARGETS else ""
            print(f"batch of {BATCH} random bodies, {THREADS} threads, {name}: {rate:,.0f} scenes "
                  f"a second by the clock{goal}", flush=True)  # fmt: skip
        out.update(set_up(cs.Simulator(DESIGN)))
    machine["load_at_end"] = os.getloadavg()[0]
    print(f"load at the end {machine['load_at_end']:.1f}")
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps({**out, **machine}, indent=1) + "\n")


if __name__ == "__main__":
    main()
