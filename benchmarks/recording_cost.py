"""What recording costs beside the solve, and how large recordings are.

``python benchmarks/recording_cost.py``; needs ``pip install "capsense[record]"``.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

import capsense as cs
from capsense.bench import DESIGN, RATE, WARM_UP, WORLDS

STEPS = 1000


def main() -> None:
    """Print a line for each kind of world."""
    sim = cs.Simulator(DESIGN)
    print(f"{STEPS} steps of {DESIGN}, sampled at {RATE:g} Hz; load {os.getloadavg()[0]:.1f}")
    print(f"{'':20}{'median':>10}{'longest':>11}{'a step':>13}{'replay':>10}")
    for name, world in WORLDS.items():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            beside = []
            with cs.record(path, sim) as run:
                for k in range(STEPS):
                    view = world(k)
                    start = time.perf_counter()
                    reading = run.step(view, k / RATE)
                    beside.append(time.perf_counter() - start - reading.stats.wall_time)
            start = time.perf_counter()
            same = "same" if cs.replay(path).same else "DIFFERS"
            seconds = time.perf_counter() - start
            ms = 1e3 * np.array(beside[WARM_UP:])
            size = path.stat().st_size / STEPS
            print(
                f"{name:20}{np.median(ms):7.2f} ms{ms.max():8.1f} ms{size:7.0f} bytes"
                f"{seconds:8.1f} s, {same}"
            )


if __name__ == "__main__":
    main()
