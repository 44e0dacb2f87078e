"""Where the time of a step goes: ``python benchmarks/step_profile.py [-o out/step_profile.json]``.

Every compiled kernel that the solver calls is timed from outside; what is left over is Python: the
scene's packing, numpy, and the calls themselves, of which each costs about a microsecond more here
than it does otherwise. Times are the processor's.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from machine import describe_machine, on_one_core
from numba.core.registry import CPUDispatcher

import capsense as cs
from capsense.bench import DESIGN, WORLDS, World
from capsense.solve import perturbation

STEPS, WARM_UP = 300, 20
Parts = dict[str, float]


def watch(spent: dict[str, float]) -> None:
    """Add the time [s] of every kernel that the solver calls by its module to ``spent``."""
    modules = [m for m in vars(perturbation).values() if isinstance(m, ModuleType)]
    for module in modules:
        for name, kernel in list(vars(module).items()):
            if isinstance(kernel, CPUDispatcher) and kernel.__module__ == module.__name__:
                setattr(module, name, _timed(kernel, f"{_last(module)}.{name}", spent))


def _last(module: ModuleType) -> str:
    return module.__name__.rpartition(".")[2]


def _timed(kernel: Any, name: str, spent: dict[str, float]) -> Any:
    def call(*args: Any) -> Any:
        start = time.process_time()
        out = kernel(*args)
        spent[name] += time.process_time() - start
        return out

    return call


def profile(sim: cs.Simulator, world: Callable[[int], World], spent: dict[str, float]) -> Parts:
    """Median time [ms] of each part of a step in a world, the largest first."""
    times: dict[str, list[float]] = defaultdict(list)
    for k in range(WARM_UP + STEPS):
        scene = world(145 + k)
        spent.clear()
        start = time.process_time()
        sim.step(scene)
        whole = time.process_time() - start
        if k >= WARM_UP:
            for name, seconds in spent.items():
                times[name].append(1e3 * seconds)
            times["Python"].append(1e3 * (whole - sum(spent.values())))
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
