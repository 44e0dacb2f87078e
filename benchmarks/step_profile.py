"""Where the time of a step goes: ``python benchmarks/step_profile.py``.

Every compiled kernel that the solver calls is timed from outside; what is left over is Python: the
scene's packing, numpy, and the calls themselves, of which each costs about a microsecond more here
than it does otherwise.
"""

from __future__ import annotations

import time
from collections import defaultdict
from types import ModuleType
from typing import Any

import numpy as np
from machine import describe_machine, on_one_core
from numba.core.registry import CPUDispatcher

import capsense as cs
from capsense.bench import WORLDS
from capsense.solve import perturbation

STEPS, WARM_UP = 300, 20


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
        start = time.perf_counter()
        out = kernel(*args)
        spent[name] += time.perf_counter() - start
        return out

    return call


def main() -> None:
    """Entry point."""
    on_one_core()
    spent: dict[str, float] = defaultdict(float)
    watch(spent)
    machine = describe_machine(("capsense", "numpy", "numba"))
    print(f"{machine['processor']}, one core, load {machine['load']:.1f}")
    for title, world in WORLDS.items():
        sim = cs.Simulator("six_patch")
        parts: dict[str, list[float]] = defaultdict(list)
        for k in range(WARM_UP + STEPS):
            scene = world(145 + k)
            spent.clear()
            start = time.perf_counter()
            sim.step(scene)
            whole = time.perf_counter() - start
            if k >= WARM_UP:
                for name, seconds in spent.items():
                    parts[name].append(1e3 * seconds)
                parts["Python"].append(1e3 * (whole - sum(spent.values())))
                parts["whole step"].append(1e3 * whole)
        print(f"{title}: median [ms]")
        for name, values in sorted(parts.items(), key=lambda item: -float(np.median(item[1]))):
            if np.median(values) > 0.002:
                print(f"  {name:32s} {np.median(values):7.3f}")


if __name__ == "__main__":
    main()
