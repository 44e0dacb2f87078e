"""What a step of some environments of a fleet costs, over one of all.

python benchmarks/fleet_due.py [--device cpu] [--count 1024]
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import capsense as cs


def main() -> None:
    """Print the shares."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu", help="as of a fleet")
    parser.add_argument("--count", type=int, default=1024, help="environments")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    bodies = [cs.Body(cs.Capsule(0.01, 0.05), material="human"), cs.Body(cs.Box((0.1, 0.1, 0.02)))]
    fleet = cs.Fleet(
        "six_patch", bodies, given.count, device=given.device, preset="fast", budget=32
    )
    poses = np.zeros((given.count, 2, 7))
    poses[..., 6] = 1.0
    poses[:, 0, :3] = rng.uniform([-0.05, -0.05, 0.03], [0.05, 0.05, 0.1], (given.count, 3))
    poses[:, 1, 2] = 0.2

    def seconds(share: float) -> float:
        due = np.arange(given.count) < round(share * given.count)
        taken = []
        for _ in range(5):
            begun = time.perf_counter()
            fleet.step(poses, environments=due).delta  # noqa: B018 - the device may be asynchronous
            taken.append(time.perf_counter() - begun)
        return min(taken)

    whole = seconds(1.0)
    for share in (0.0, 0.01, 0.1, 0.5, 1.0):
        own = seconds(share)
        print(f"{share:5.0%} of {given.count} environments: {1e3 * own:8.2f} ms, {own / whole:.1%}")


if __name__ == "__main__":
    main()
