"""What a readout and an image cost beside the field: ``python benchmarks/readout_cost.py``.

Six electrodes, a simulator that steps at 100 Hz; images of 2240 voxels from 21 pairs. Times are of
this machine, one process, as found.
"""

from __future__ import annotations

import platform
import time

import numpy as np

from capsense.readout import Readout
from capsense.readout.imaging import back_projection, landweber, tikhonov
from capsense.readout.presets import CHIPS

NAMES = tuple(f"E{k}" for k in range(6))
STEPS, RATE = 3000, 100.0


def matrices(count: int) -> np.ndarray:
    """Maxwell matrices [F] that change slowly, shape (count, 6, 6)."""
    mutual = np.full((6, 6), 0.05e-12)
    np.fill_diagonal(mutual, 0.0)
    ground = 2e-12 * (1 + 0.1 * np.sin(np.arange(count) / 200))
    return ground[:, None, None] * np.eye(6) + np.diag(mutual.sum(axis=1)) - mutual


def images() -> None:
    """Print what a frame of each reconstruction costs."""
    rng = np.random.default_rng(0)
    j, change = rng.random((21, 2240)), rng.random(21)
    methods = {
        "back-projection": back_projection(j).dot,
        "Tikhonov": tikhonov(j).dot,
        "Landweber, 50 iterations": landweber(j, 50),
    }
    print(f"\n{'image':24}  {'median':>8}")
    for name, method in methods.items():
        taken = np.empty(300)
        for k in range(len(taken)):
            start = time.perf_counter()
            method(change)
            taken[k] = time.perf_counter() - start
        print(f"{name:24}  {1e6 * np.median(taken):8.0f}")


def main() -> None:
    """Print one row for each chip, and one for each kind of image."""
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")
    print(f"{'chip':8}  {'conversions':>11}  {'median':>8}  {'p95':>8}  {'recording':>10}")
    print(f"{'':8}  {'a step':>11}  {'[us]':>8}  {'[us]':>8}  {'[us/step]':>10}")
    scenes = matrices(STEPS)
    times = np.arange(STEPS) / RATE
    for name in CHIPS:
        readout = Readout.preset(name, NAMES, expected=2e-12)
        taken, total = np.empty(STEPS), 0
        for k in range(STEPS):
            start = time.perf_counter()
            total += len(readout.sample(times[k], scenes[k]))
            taken[k] = time.perf_counter() - start
        start = time.perf_counter()
        readout(times, scenes)
        whole = (time.perf_counter() - start) / STEPS
        middle, high = 1e6 * np.percentile(taken, [50, 95])
        print(f"{name:8}  {total / STEPS:11.2f}  {middle:8.0f}  {high:8.0f}  {1e6 * whole:10.1f}")
    images()


if __name__ == "__main__":
    main()
