"""Figures of this machine: how long a start and a step take, and how far off a step is."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import numpy as np

import capsense as cs
from capsense.scene.depth import DepthFrame
from capsense.simulator import Simulator

DESIGN = "six_patch"
SPEED, RATE = 0.116, 100.0
"""Speed of the bar [m/s], and samples a second [Hz]."""
WARM_UP = 10
"""Steps left out of the statistics: they compile or load code and fill the warm start."""
World = cs.Scene | DepthFrame


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
REFERENCE_GAP = 0.02
REFERENCE_DIAGONAL = 1e-12 * np.array([0.15444, 0.13807, 0.15444, 0.15444, 0.13807, 0.15444])
"""Change [F] of the diagonal by the bar at that gap: boundary elements, good to 4.4e-4 pF."""


def time_steps(sim: Simulator, world: Callable[[int], World], steps: int) -> dict[str, float]:
    """Step times [ms] and iterations of ``steps`` samples; making the worlds is not timed."""
    times, iterations = [], []
    for k in range(WARM_UP + steps):
        scene = world(k)
        start = time.perf_counter()
        reading = sim.step(scene)
        times.append(1e3 * (time.perf_counter() - start))
        iterations.append(reading.stats.iterations)
    ms = np.array(times[WARM_UP:])
    return {
        "median_ms": float(np.median(ms)),
        "p95_ms": float(np.percentile(ms, 95)),
        "p99_ms": float(np.percentile(ms, 99)),
        "iterations": float(np.median(iterations[WARM_UP:])),
    }


def import_time() -> float:
    """Time [s] of ``import capsense`` in a fresh interpreter."""
    code = "import time; t = time.perf_counter(); import capsense; print(time.perf_counter() - t)"
    return float(subprocess.check_output([sys.executable, "-c", code], text=True))


def measure(steps: int = 300) -> dict[str, Any]:
    """Measure this machine.

    Args:
        steps: Timed steps of each world, 1 or more.

    Returns:
        The machine and its load, versions, ``import_s``, ``start_s`` (Simulator and first step
        in this process, cached field), and per world the step times [ms], the iterations and
        ``error``: the largest relative error of the diagonal, None without a reference.

    Raises:
        ValueError: ``steps`` is less than 1.
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; give 1 or more")
    load = os.getloadavg()[0]
    imported = import_time()
    Simulator(DESIGN)  # builds the field if it is not cached
    start = time.perf_counter()
    sim = Simulator(DESIGN)
    sim.step(moving_bar(0))
    started = time.perf_counter() - start
    rows: dict[str, dict[str, float | None]] = {}
    for name, world in WORLDS.items():
        rows[name] = {**time_steps(sim, world, steps), "error": None}
    change = np.diag(sim.step(reference_bar(gap=REFERENCE_GAP)).delta)
    rows["bar"]["error"] = float(np.abs(change / REFERENCE_DIAGONAL - 1).max())
    return {
        "machine": platform.platform(),
        "cpus": os.cpu_count(),
        "load": load,
        "versions": {n: version(n) for n in ("capsense", "numpy", "scipy", "numba")},
        "tetrahedra": sim.describe()["tetrahedra"],
        "steps": steps,
        "import_s": imported,
        "start_s": started,
        "worlds": rows,
    }
