"""Figures of this machine: how long a start and a step take, and how far off a step is."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

import numpy as np

import capsense as cs
from capsense._thread_pool import processors
from capsense.scene.depth import DepthFrame
from capsense.simulator import Simulator

DESIGN = "six_patch"
SPEED, RATE = 0.116, 100.0
"""Speed of the bar [m/s], and samples a second [Hz]."""
WARM_UP = 10
"""Steps left out of the statistics: they compile or load code and make room for results."""
REPEATS = 3
"""Starts in fresh processes, and batches, of which medians are taken."""
BATCH = 256
"""Scenes of a batch."""
World = cs.Scene | DepthFrame
_T = TypeVar("_T")


def reference_bar(x: float = 0.0, gap: float = 0.03) -> cs.Scene:
    """A grounded bar of 150 × 150 × 20 mm at x [m], its lower face ``gap`` [m] above the sensor."""
    return cs.Scene([cs.Body(cs.Box((0.15, 0.15, 0.02)), cs.Pose((x, 0, gap + 0.01)), "steel")])


def moving_bar(k: int) -> cs.Scene:
    """Sample k of the bar's way across the sensor."""
    return reference_bar(-0.174 + (k % 300) * SPEED / RATE)


def moving_limbs(k: int) -> cs.Scene:
    """Sample k of twelve grounded capsules, 40 to 160 mm above the sensor, all moving."""
    bodies = []
    for n in range(12):
        phase = 0.02 * k + n
        place = (-0.16 + 0.11 * (n % 4), -0.11 + 0.11 * (n // 4), 0.1 + 0.03 * np.sin(phase))
        turn = (np.sin(0.1 * phase), 0.0, 0.0, np.cos(0.1 * phase))
        bodies.append(cs.Body(cs.Capsule(0.02, 0.06), cs.Pose(place, turn), "steel"))
    return cs.Scene(bodies)


def moving_depth(k: int) -> DepthFrame:
    """Sample k of a 64 × 64 depth image of a dome that moves across the view."""
    u, v = np.meshgrid(np.linspace(-1, 1, 64), np.linspace(-1, 1, 64))
    squared = (u - 0.4 * np.sin(0.02 * k)) ** 2 + v**2
    return DepthFrame(np.where(squared < 0.25, 0.05 + 0.1 * squared, np.inf))


WORLDS: dict[str, Callable[[int], World]] = {
    "bar": moving_bar,
    "12 capsules": moving_limbs,
    "64x64 depth frame": moving_depth,
}
CHECKS: dict[str, tuple[Callable[[], World], tuple[float, ...]]] = {
    "bar": (
        partial(reference_bar, gap=0.02),
        (0.15444, 0.13807, 0.15444, 0.15444, 0.13807, 0.15444),
    ),
    "12 capsules": (
        partial(moving_limbs, 0),
        (0.009747, 0.004081, 0.00433, 0.024104, 0.006431, 0.006734),
    ),
    "64x64 depth frame": (
        partial(moving_depth, 0),
        (0.014932, 0.014065, 0.014932, 0.014932, 0.014064, 0.014931),
    ),
}
"""By world: a sample of it, and what it changes in the diagonal [pF].

The bar by boundary elements, good to 4.4e-4 pF; the others on a lattice of a million tetrahedra, of
the solver that came before."""


@dataclass
class Times:
    """Times of calls [ms], by the clock and by what the processor spent on the calling thread.

    On a machine that other programs use too, a long call is interrupted more often than a short
    one, and the clock makes it look longer than it is; the processor's time does not. Threads that
    a library keeps spinning beside the call do not count.
    """

    clock: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    def take(self, call: Callable[[], _T], keep: bool = True) -> _T:
        """Make a call, and keep its times if wanted."""
        clock, processor = time.perf_counter(), time.thread_time()
        out = call()
        spent, passed = time.thread_time() - processor, time.perf_counter() - clock
        if keep:
            self.clock.append(1e3 * passed)
            self.processor.append(1e3 * spent)
        return out

    def summary(self) -> dict[str, float]:
        """Median, mean, p95 and p99 of the processor's time [ms], and the same by the clock."""
        out: dict[str, float] = {"steps": len(self.clock)}
        for prefix, times in (("", self.processor), ("clock_", self.clock)):
            out[f"{prefix}median_ms"] = float(np.median(times))
            out[f"{prefix}mean_ms"] = float(np.mean(times))
            out[f"{prefix}p95_ms"], out[f"{prefix}p99_ms"] = np.percentile(times, (95, 99)).tolist()
        return out


def time_steps(sim: Simulator, world: Callable[[int], World], steps: int) -> dict[str, float]:
    """:meth:`Times.summary` and unknowns of ``steps`` samples; making the worlds is not timed."""
    times, unknowns = Times(), []
    for k in range(WARM_UP + steps):
        reading = times.take(partial(sim.step, world(k)), keep=k >= WARM_UP)
        unknowns.append(reading.stats.unknowns)
    return {**times.summary(), "unknowns": float(np.median(unknowns[WARM_UP:]))}


_START = f"""
import json, time
spent, t = time.process_time(), [time.perf_counter()]
import capsense as cs
t.append(time.perf_counter())
sim = cs.Simulator("{DESIGN}")
t.append(time.perf_counter())
sim.step(cs.Scene([cs.Body(cs.Sphere(0.05), cs.Pose((0, 0, 0.1)))]))
t.append(time.perf_counter())
spent = time.process_time() - spent
print(json.dumps([*(after - before for before, after in zip(t, t[1:])), spent]))
"""


def start_times() -> dict[str, float]:
    """Median times [s] of import, ``Simulator`` and first step in fresh interpreters, by the clock;
    and what the processor spent on the three together.
    """
    runs = [
        json.loads(subprocess.check_output([sys.executable, "-c", _START], text=True))
        for _ in range(REPEATS)
    ]
    names = ("import_s", "simulator_s", "first_step_s", "processor_s")
    return dict(zip(names, np.median(runs, axis=0).tolist(), strict=True))


def batch_scenes(count: int = BATCH, after: int = 0) -> list[cs.Scene]:
    """Scenes that have nothing in common: the bar at random places, 5 to 100 mm above.

    Each moves sideways, as fast and sampled as often as the bar of :func:`moving_bar`; the scenes
    are those ``after`` so many samples.
    """
    rng = np.random.default_rng(0)
    low, high = (-0.1, -0.1, 0.015), (0.1, 0.1, 0.11)
    bar = cs.Body(cs.Box((0.15, 0.15, 0.02)), material="steel")
    places, angles = rng.uniform(low, high, (count, 3)), rng.uniform(0, 2 * np.pi, count)
    ways = np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)
    return [cs.Scene([bar.moved(cs.Pose(place))]) for place in places + after * SPEED / RATE * ways]


def time_batch(sim: Simulator, threads: int | None = None) -> dict[str, float]:
    """Scenes a second of ``step_batch``, by the clock, and as many as the processor's time of one
    scene gives times the threads.
    """
    threads = threads or processors()
    rates = []
    for k in range(2 + REPEATS):  # the first two make room for results
        scenes = batch_scenes(after=k)
        clock, processor = time.perf_counter(), time.process_time()
        sim.step_batch(scenes, threads=threads)
        spent = time.process_time() - processor
        if k >= 2:
            rates.append((BATCH / (time.perf_counter() - clock), threads * BATCH / spent))
    by_clock, by_processor = np.median(rates, axis=0).tolist()
    return {"scenes": BATCH, "threads": threads, "clock_per_s": by_clock, "per_s": by_processor}


def check_error(sim: Simulator, name: str) -> float:
    """Largest error of ΔC's diagonal in a world's sample of CHECKS, as a part of the largest."""
    sample, picofarads = CHECKS[name]
    wrong = 1e12 * np.diag(sim.step(sample()).delta) - picofarads
    return float(np.abs(wrong).max() / max(picofarads))


def measure(steps: int = 300) -> dict[str, Any]:
    """Measure this machine.

    Args:
        steps: Timed steps of each world, 1 or more.

    Returns:
        The machine and its load, versions, the times of :func:`start_times` (cached field, compiled
        code), per world the times of :meth:`Times.summary`, the unknowns and ``error``, see
        :func:`check_error`, and ``batch`` of :func:`time_batch`.

    Raises:
        ValueError: ``steps`` is less than 1.
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; give 1 or more")
    load = os.getloadavg()[0]
    sim = Simulator(DESIGN)  # builds the field if it is not cached
    sim.step(moving_bar(0))  # compiles the kernels if they are not cached
    return {
        "machine": platform.platform(),
        "cpus": os.cpu_count(),
        "load": load,
        "versions": {n: version(n) for n in ("capsense", "numpy", "scipy", "numba")},
        "design": DESIGN,
        "preset": sim.preset,
        **start_times(),
        "worlds": {
            name: {**time_steps(sim, world, steps), "error": check_error(sim, name)}
            for name, world in WORLDS.items()
        },
        "batch": time_batch(sim),
    }
