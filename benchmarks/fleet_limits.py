"""Where fleets on Warp are least certain: ``python benchmarks/fleet_limits.py``, each budget.

- gradients: Jacobians along z beside central differences of the readings, over the reference map,
  over each scene's largest derivative.
- steps: a grounded finger and a forearm come down from 38 to 8 mm over ``six_patch_bare`` by
  0.05 mm each. The largest second difference of log ΔC_ii, of entries above 10 % of the largest.
- long: three bodies of more than a metre that cross the walls, at three places, beside
  ``Simulator.step``, over each scene's largest entry.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "fleet"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from reference_scenes import DESIGN, fleet_of, reference_scenes
from smoothness import BODIES
from test_fleet import LONG, long_poses, scene

import capsense as cs
from fleet import PRIMITIVES

DEVICE = "warp:cpu"
BUDGETS = (32, 64, 128)
MOVED, STEPS = 1e-4, 600
"""Differences are taken over twice this [m]; readings of an approach."""


def gradients(budget: int) -> NDArray[np.float64]:
    """Largest misses, shape (scenes,)."""
    scenes = [
        s for s in reference_scenes() if all(isinstance(b.shape, PRIMITIVES) for b in s.scene)
    ]
    fleet, where = fleet_of(scenes, device=DEVICE, budget=budget)
    slope = fleet.step(where, jacobian=True).jacobian.numpy()[:, 0, ..., 2].sum(axis=1)
    ends = []
    for sign in (1, -1):
        moved = where.copy()
        moved[..., 2] += sign * MOVED
        ends.append(fleet.step(moved).delta.numpy()[:, 0].astype(float))
    truth = (ends[0] - ends[1]) / (2 * MOVED)
    return np.abs(slope - truth).max(axis=(1, 2)) / np.abs(truth).max(axis=(1, 2))


def largest_step(budget: int, name: str) -> float:
    """Largest second difference of an approach."""
    (part,), angles = BODIES[name]
    turn = Rotation.from_euler("ZYX", angles)
    where = np.zeros((STEPS, 1, 7))
    low = -(part.shape.to_trimesh().vertices @ turn.as_matrix().T)[:, 2].min()
    where[:, 0, :2], where[:, 0, 3:] = (0.012, 0.007), turn.as_quat()
    where[:, 0, 2] = low + np.linspace(0.038, 0.008, STEPS)
    fleet = cs.Fleet(
        DESIGN, [cs.Body(part.shape, material="steel")], STEPS, device=DEVICE, budget=budget
    )
    delta = fleet.step(where).delta.numpy()[:, 0].astype(float)
    own = np.abs(np.diagonal(delta, axis1=1, axis2=2))
    seen = own > 0.1 * own.max(axis=1, keepdims=True)
    return float(np.abs(np.diff(np.log(own), 2, axis=0))[seen[1:-1]].max())


def long_bodies(budget: int) -> list[float]:
    """Differences at each place."""
    where, sensors = long_poses()
    found = cs.Fleet("six_patch", LONG, 3, device=DEVICE, budget=budget).step(where, sensors)
    simulator, out = cs.Simulator("six_patch"), []
    for e in range(3):
        truth = simulator.step(scene(LONG, where[e], sensors[e, 0])).delta
        out.append(float(np.abs(found.delta.numpy()[e, 0] - truth).max() / np.abs(truth).max()))
    return out


def main() -> int:
    for budget in BUDGETS:
        miss = 100 * gradients(budget)
        steps = ", ".join(
            f"{name} {100 * largest_step(budget, name):.2f} %" for name in ("finger", "forearm")
        )
        far = ", ".join(f"{100 * x:.1f} %" for x in long_bodies(budget))
        print(
            f"{budget}: gradients median {np.median(miss):.2f} %, 90 % {np.quantile(miss, 0.9):.1f}"
            f" %, worst {miss.max():.0f} %; steps {steps}; long {far}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
