"""A hand over ``six_patch`` with each preset: ``python benchmarks/tracked_hand.py``.

Six instants of the reach of ``examples/hands/make_reach.py``, without the tracker's errors. For
each: the change of the strongest electrode, what it and the electrode that is off most are off
by from preset ``"fine"``, charge functions, and the median time of ten steps. Last, what is
estimated.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import numpy as np

import capsense as cs

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "hands"))

from make_reach import HAND, state

INSTANTS = {"hovering": 1.5, "coming down": 2.2, "pressing": 2.7, "rising": 3.2, "fist above": 4.1,
            "fist on": 5.1}  # fmt: skip
"""What the hand does, and when [s]."""
REPEATS = 10


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    simulators = {p: cs.Simulator("six_patch", preset=p) for p in ("fine", "standard", "fast")}
    print(f"{'':12s} {'preset':9s} {'strongest fF':>12s} {'off %':>7s} {'most off %':>10s} "
          f"{'est. fF':>8s} {'functions':>9s} {'step ms':>8s}")  # fmt: skip
    for what, instant in INSTANTS.items():
        joints = HAND.joints(*state(instant), degrees=True)
        scene = cs.Scene(HAND.bodies(HAND.landmarks(joints)))
        best = np.empty(0)
        for preset, simulator in simulators.items():
            times = []
            for _ in range(REPEATS):
                start = time.perf_counter()
                reading = simulator.step(scene)
                times.append(time.perf_counter() - start)
            own = np.diag(reading.delta)
            best = own if preset == "fine" else best
            off, k = 100 * (own / best - 1), int(np.argmax(best))
            print(
                f"{what:12s} {preset:9s} {1e15 * own[k]:12.2f} {off[k]:7.1f} "
                f"{off[np.argmax(np.abs(off))]:10.1f} {1e15 * reading.stats.solver_error:8.2f} "
                f"{reading.stats.unknowns:9d} {1e3 * np.median(times):8.1f}"
            )


if __name__ == "__main__":
    main()
