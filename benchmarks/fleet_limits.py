"""Where fleets on Warp are least certain: ``python benchmarks/fleet_limits.py``, each budget.

- gradients: Jacobians along z beside central differences of the readings, over the reference map,
  over each scene's largest derivative.
- steps: a grounded finger and a forearm come down from 38 to 8 mm over ``six_patch_bare`` by
  0.05 mm each. The largest second difference of log ΔC_ii, of entries above 10 % of the largest.
- long: three bodies of more than a metre that cross the walls, at three places, beside
  ``Simulator.step``, over each scene's largest entry.
- wide: grounded conductors that have panels of some millimetres on the CPU only, 10, 30 and 50 mm
  away, beside the fine preset, and what the fleet's own ``error`` says.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from fleet import PRIMITIVES
from fleet_scenes import LONG, long_poses, scene
from reference_scenes import DESIGN, fleet_of, reference_scenes
from smoothness import BODIES

import capsense as cs

DEVICE = "warp:cpu"
BUDGETS = (32, 64, 128)
WIDE = {
    "table of 1.2 x 0.8 m": cs.Box((1.2, 0.8, 0.04)),
    "torso, half axes 0.18, 0.30, 0.12 m": cs.Ellipsoid((0.18, 0.30, 0.12)),
    "plate of 0.5 m": cs.Box((0.5, 0.5, 0.02)),
}
GAPS = (0.010, 0.030, 0.050)
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


def wide_body(budget: int, shape: cs.Shape) -> list[tuple[float, float]]:
    """How far off a reading is at each gap, and what it says itself, over its largest entry."""
    low = 0.5 * np.ptp(shape.bounds(), axis=0)[2]
    fleet = cs.Fleet(DESIGN, [cs.Body(shape)], len(GAPS), device=DEVICE, budget=budget)
    where = np.zeros((len(GAPS), 1, 7))
    where[:, 0, 2], where[:, 0, 6] = low + np.array(GAPS), 1.0
    reading = fleet.step(where)
    found, said = reading.delta.numpy()[:, 0], reading.error.numpy()[:, 0]
    fine = cs.Simulator(DESIGN, preset="fine")
    out = []
    for e, gap in enumerate(GAPS):
        truth = fine.step(cs.Scene([cs.Body(shape, cs.Pose((0, 0, low + gap)))])).delta
        largest = float(np.abs(truth).max())
        out.append((float(np.abs(found[e] - truth).max()) / largest, float(said[e]) / largest))
    return out


def main() -> int:
    for name, shape in WIDE.items():
        for budget in BUDGETS[1:]:
            rows = (
                f"{100 * off:.0f} % ({100 * said:.0f} %)" for off, said in wide_body(budget, shape)
            )
            print(f"wide, {name}, {budget}: {', '.join(rows)}", flush=True)
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
