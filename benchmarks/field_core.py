"""Accuracy and step time of the field core: ``python benchmarks/field_core.py``.

Errors are against the boundary-element figures in ``tests/data/reference_capacitances.json``; times
are of this machine, one process, as found.
"""

from __future__ import annotations

import json
import platform
import time
from pathlib import Path

import numpy as np

import capsense as cs

REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "reference_capacitances.json"
GAPS = (1, 2, 5, 10, 20, 50, 100, 200)
SPHERES = {
    "grounded 1.0": ("steel", "grounded"),
    "floating 1.0": ("steel", "floating"),
    "diel 80.0": (cs.Material("eps 80", 80.0), "grounded"),
    "diel 3.0": (cs.Material("eps 3", 3.0), "grounded"),
}


def errors(delta: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Largest relative error of the diagonal, and of the rest against its bound.

    The bound of an off-diagonal is 5 % of itself or 1 % of the largest change, if that is larger.
    """
    wrong = np.abs(delta - reference)
    bound = np.maximum(0.05 * np.abs(reference), 0.01 * np.abs(reference).max())
    diagonal = np.diag(wrong / np.abs(reference)).max()
    np.fill_diagonal(wrong, 0.0)
    return float(diagonal), float((wrong / bound).max())


def main() -> None:
    """Print the tables."""
    figures = json.loads(REFERENCE.read_text())
    print(f"{platform.platform()}, Python {platform.python_version()}, numpy {np.__version__}")
    for name in ("six_patch_bare", "six_patch"):
        cases = figures[name]
        start = time.perf_counter()
        sim = cs.Simulator(name)
        loaded = time.perf_counter() - start
        print(f"\n{name}: {sim.describe()['nodes']} nodes, start {loaded:.2f} s")
        empty = np.array(cases["none"])
        off = np.abs(sim.baseline * 1e12 / empty - 1)
        print(
            f"  baseline: diagonal {100 * np.diag(off).max():.2f} %, "
            f"nearest neighbours {100 * max(off[0, 1], off[0, 3]):.2f} %"
        )
        bar, ball = cs.Box((0.15, 0.15, 0.02)), cs.Sphere(0.04)
        scenes = {
            f"bar at {g} mm": (f"bar {g}", cs.Body(bar, cs.Pose((0, 0, 1e-3 * g + 0.01)), "steel"))
            for g in GAPS
        }
        for label, (material, grounding) in SPHERES.items():
            body = cs.Body(ball, cs.Pose((0, 0, 0.08)), material, grounding=grounding)
            scenes[f"sphere {label}"] = (f"sphere {label}", body)
        for label, (key, body) in scenes.items():
            target = cases.get(key, cases.get(key.replace(" ", "_")))
            if target is not None:
                delta = sim.step(cs.Scene([body])).delta * 1e12
                diagonal, rest = errors(delta, np.array(target) - empty)
                print(f"  {label:22s} diagonal {100 * diagonal:5.2f} %   rest {rest:4.2f} of bound")
        times, iterations = [], []
        for k in range(300):
            x = -0.174 + 0.00116 * k  # 0.116 m/s at 100 Hz
            scene = cs.Scene([cs.Body(bar, cs.Pose((x, 0, 0.04)), "steel")])
            start = time.perf_counter()
            reading = sim.step(scene)
            times.append(time.perf_counter() - start)
            iterations.append(reading.stats.iterations)
        ms = 1e3 * np.array(times[10:])
        print(
            f"  step, bar at 0.116 m/s sampled at 100 Hz: median {np.median(ms):.2f} ms, "
            f"p95 {np.percentile(ms, 95):.2f} ms, p99 {np.percentile(ms, 99):.2f} ms, "
            f"{np.median(iterations):.0f} iterations"
        )


if __name__ == "__main__":
    main()
