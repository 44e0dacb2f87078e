"""Where the time of a step goes: ``python benchmarks/step_profile.py [-o out/step_profile.json]``.

Every compiled kernel that the solver calls is timed from outside; what is left over is Python: the
scene's packing, numpy, and the calls themselves, of which each costs about a microsecond more here
than it does otherwise. Parts of the one that solves are timed by doing them once more; the rest of
it is the iteration. (These worlds need one block of right-hand sides; with more, the next one would
miss its residual.) Times are the processor's.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from capsense.solve.factor_kernels import factorise
from machine import describe_machine, on_one_core

import capsense as cs
from capsense.bench import DESIGN, WORLDS, World
from capsense.solve import load_kernels as loading
from capsense.solve import trace_kernels as tracing

STEPS, WARM_UP = 300, 20
SOLVE = "solve"
Parts = dict[str, float]


def watch(spent: dict[str, float]) -> None:
    """Add the time [s] of the kernels that the solver calls, and of their parts, to ``spent``."""
    trace, solve = tracing.trace, loading.solve_block

    def timed_trace(*args: Any) -> Any:
        return _timed("scan", spent, trace, *args)

    def timed_solve(*args: Any) -> Any:
        (op, setup, unknown, active, vectors, _, phi, lanes, first, held, ties, energies, value,
         drop) = args[:14]  # fmt: skip
        own, room = args[-2].copy(), np.zeros_like(args[-1])
        out = _timed(SOLVE, spent, solve, *args)
        if first == 0:
            _timed("diagonal and incomplete factors", spent, factorise, op.weight, setup.extra,
                   unknown, op.storeys, op.ceiling, op.parent, op.share, op.diagonal, active,
                   op.inverse, setup.taken, setup.changed)  # fmt: skip
        _timed("right-hand sides, energies", spent, loading.load_scene, phi, lanes, first, held,
               ties, energies, vectors.r, value, drop, own)  # fmt: skip
        _timed("right-hand sides, energies", spent, loading.add_energies, ties, energies, value,
               drop, value, drop, vectors.u, room)  # fmt: skip
        return out

    tracing.trace, loading.solve_block = timed_trace, timed_solve


def _timed(name: str, spent: dict[str, float], kernel: Any, *args: Any) -> Any:
    start = time.process_time()
    out = kernel(*args)
    spent[name] += time.process_time() - start
    return out


def profile(sim: cs.Simulator, world: Callable[[int], World], spent: dict[str, float]) -> Parts:
    """Median time [ms] of each part of a step in a world, the largest first."""
    times: dict[str, list[float]] = defaultdict(list)
    for k in range(WARM_UP + STEPS):
        scene = world(145 + k)
        spent.clear()
        start = time.process_time()
        sim.step(scene)
        passed = time.process_time() - start
        solved = spent.pop(SOLVE)
        again = sum(spent.values()) - spent["scan"]
        whole = passed - again
        if k >= WARM_UP:
            for name, seconds in spent.items():
                times[name].append(1e3 * seconds)
            times["conjugate gradients"].append(1e3 * (solved - again))
            times["Python and NumPy"].append(1e3 * (whole - spent["scan"] - solved))
            times["whole step"].append(1e3 * whole)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return dict(sorted(medians.items(), key=lambda item: -item[1]))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split(":")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/step_profile.json"))
    args = parser.parse_args()
    on_one_core()
    for world in WORLDS.values():  # compiled before kernels that call each other are wrapped
        cs.Simulator(DESIGN).step(world(145))
    spent: dict[str, float] = defaultdict(float)
    watch(spent)
    machine = describe_machine(("capsense", "numpy", "numba"))
    print(f"{machine['processor']}, one core, load {machine['load']:.1f}")
    found: dict[str, Parts] = {}
    for title, world in WORLDS.items():
        found[title] = profile(cs.Simulator(DESIGN), world, spent)
        print(f"{title}: median [ms]")
        for name, value in found[title].items():
            if value > 0.002:
                print(f"  {name:32s} {value:7.3f}")
    args.output.parent.mkdir(parents=True, exist_ok=True)
    args.output.write_text(json.dumps({**machine, "worlds": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
