"""What each choice of the step is worth: ``python benchmarks/ablations.py [--steps N]``.

``six_patch_bare`` and a bar at 0.116 m/s sampled at 100 Hz; each line changes one setting of the
defaults. Errors are the largest of ΔC's diagonal at gaps from 5 to 100 mm, against boundary
elements.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine, on_one_core
from peers_task import DESIGN, GAPS, diagonal_error

import capsense as cs
from capsense.bench import WARM_UP, moving_bar, reference_bar
from capsense.field.background import BuildSettings
from capsense.masked.planes import LatticeSettings


def variants() -> Iterator[tuple[str, dict[str, Any], bool]]:
    """Title, what is passed to the simulator, and whether every step starts afresh."""
    plain = LatticeSettings()
    yield "as it comes", {}, False
    yield "every step from zero", {}, True
    for factor in (10.0, 0.1, 0.01):
        goals = {"tolerance": 1e-18 * factor, "relative_tolerance": 1e-5 * factor}
        yield f"tolerances times {factor:g}", goals, False
    whole = BuildSettings(lattice=replace(plain, thinning=0.0))
    yield "planes carried up to the ceiling", {"settings": whole}, False
    yield "weights not calibrated", {"settings": BuildSettings(calibration=math.inf)}, False
    yield "weights calibrated strongly", {"settings": BuildSettings(calibration=0.02)}, False
    for factor in (0.65, 0.8, 1.25):
        lattice = BuildSettings(lattice=plain.refined(factor))
        yield f"{factor:g} times the nodes an axis", {"settings": lattice}, False


class Afresh(cs.Simulator):
    """Forgets the last step before each one."""

    def step(self, scene: cs.Scene | cs.DepthFrame) -> cs.Reading:
        """As :meth:`capsense.Simulator.step`."""
        self.reset()
        return super().step(scene)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/ablations.json"))
    parser.add_argument("--steps", type=int, default=150)
    args = parser.parse_args()
    on_one_core()
    machine = describe_machine(("capsense", "numpy", "numba"))
    print(f"{machine['processor']}, one core, load {machine['load']:.1f}")
    print(f"{'':36s} {'nodes':>7s} {'iterations':>10s} {'median ms':>9s} {'error %':>8s}")
    rows = []
    for title, options, afresh in variants():
        sim = (Afresh if afresh else cs.Simulator)(DESIGN, **options)
        times, iterations = Times(), []
        for k in range(WARM_UP + args.steps):
            reading = times.take(partial(sim.step, moving_bar(145 + k)), keep=k >= WARM_UP)
            iterations.append(reading.stats.iterations)
        worst = max(
            abs(diagonal_error(sim.step(reference_bar(gap=1e-3 * g)).delta, g)) for g in GAPS
        )
        rows.append({"title": title, "nodes": sim.describe()["nodes"], "worst": worst,
                     "iterations": float(np.median(iterations[WARM_UP:])),
                     **times.summary()})  # fmt: skip
        print("{title:36s} {nodes:7d} {iterations:10.0f} {median_ms:9.2f}".format(**rows[-1]),
              f"{100 * worst:8.2f}", flush=True)  # fmt: skip
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps({**machine, "results": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
