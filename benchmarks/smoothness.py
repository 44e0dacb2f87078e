"""How smoothly readings follow a grounded body that moves: ``python benchmarks/smoothness.py``.

    python benchmarks/smoothness.py --method surface --bodies finger ball

Over ``six_patch_bare``, in steps of 0.05 mm (0.05° where the body turns), for a finger, a
fingertip, a forearm, a ball, a tilted box, wide bodies (a trunk and a table), and for bodies that
overlap: a bent arm and a hand:

- approach: lowest point from 60 to 8 mm above the electrodes. "2nd diff": the largest second
  difference of log ΔC_ii, of entries that are above 3 % of the scene's largest at all three
  places; smooth physics gives some 1e-5 to 1e-4. "jump": the largest relative change in a step, of
  entries above 10 %. "fall": how many of the six entries ever fall while they are above 10 %, and
  in how many steps. An entry may truly fall while a body approaches, where another part of it
  screens the electrode, but hardly ever, and by little.
- slide along x at 12 mm; "wall": on along x at 20 mm, through the wall of the domain, until the
  largest entry is a hundredth of what it was; turn about the sensor's z, and about its y, in a
  height that leaves 8 mm free.
- contact: from 8 mm down to 0.05 mm; as C goes like one over the gap, a step from 0.10 to 0.05 mm
  may double it. Then through the electrode plane to -1 mm. Not finite, not symmetric, or not
  positive semidefinite are counted ("wrong").
- memory: readings at 20 places of the approach, in order, in another order, and each from rest.
  "memory" is the largest difference over the reading's largest entry.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy_map import parse_settings
from machine import on_one_core
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import capsense as cs

Array = NDArray[np.float64]
DESIGN = "six_patch_bare"
STEP, TURN = 0.05e-3, 0.05
"""Between readings: metres; degrees."""
PLACE = (0.012, 0.007)
"""Where bodies stand over the sensor [m]."""
SLIDE_GAP, SLIDE_TO, TURN_GAP, TURN_TO = 0.012, 0.02, 0.008, 30.0
"""Height and half length of the slide [m]; least height of the turns [m] and their angle [°]."""
WALL_GAP, WALL_TO, WALL_LEFT = 0.02, 0.45, 0.01
"""Height and end of the slide through the wall [m], and what is left of the largest entry."""
SHOWN, FALLING = 0.03, 0.10
"""Entries above these fractions of the scene's largest are judged."""
WRONG_BY = 1e-3
"""Of the largest entry: what an eigenvalue may lack to zero, and symmetry to exactness."""
Shape = cs.Box | cs.Sphere | cs.Capsule
Angles = tuple[float, float, float]
"""Turns about z, then the new y, then the new x [rad]."""


class Part(NamedTuple):
    """A body of a group that moves as one."""

    shape: Shape
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of its centre in the frame of the group [m]."""
    angles: Angles = (0.0, 0.0, 0.0)


_FINGER = cs.Capsule(0.008, 0.060)
_ACROSS = (0.0, math.pi / 2, 0.0)
BODIES: dict[str, tuple[list[Part], Angles]] = {
    "finger": ([Part(_FINGER)], (0.3, 0.5, 0.0)),
    "fingertip": ([Part(cs.Capsule(0.008, 0.008))], (0.3, 0.5, 0.0)),
    "forearm": ([Part(cs.Capsule(0.040, 0.250))], (0.4, 1.5, 0.0)),
    "ball": ([Part(cs.Sphere(0.030))], (0.0, 0.0, 0.0)),
    "tilted box": ([Part(cs.Box((0.1, 0.08, 0.05)))], (0.3, 0.25, 0.15)),
    "trunk": ([Part(cs.Capsule(0.12, 0.30))], (0.4, 1.5, 0.0)),
    "table": ([Part(cs.Box((0.6, 0.5, 0.04)))], (0.3, 0.1, 0.05)),
    "bent arm": (
        [
            Part(cs.Capsule(0.040, 0.250), (-0.120, 0.0, 0.0), _ACROSS),
            Part(cs.Sphere(0.045)),
            Part(cs.Capsule(0.035, 0.250), (0.060, 0.100, 0.020), (1.0, math.pi / 2, 0.0)),
        ],
        (0.2, 0.1, 0.0),
    ),
    "hand": (
        [Part(cs.Box((0.09, 0.08, 0.03)), (-0.06, 0.0, 0.0))]
        + [Part(_FINGER, (0.02, y, -0.005), _ACROSS) for y in (-0.03, -0.01, 0.01, 0.03)],
        (0.3, 0.1, 0.1),
    ),
}
"""Bodies, and how they are turned."""


def reach_down(shape: Shape, turn: Rotation) -> float:
    """How far below its centre a turned body reaches [m]."""
    down = np.abs(turn.as_matrix()[2])
    if isinstance(shape, cs.Box):
        return float(down @ np.array(shape.size) / 2)
    if isinstance(shape, cs.Capsule):
        return shape.radius + down[2] * shape.length / 2
    return shape.radius


class Mover:
    """Places bodies over the sensor, as one, and reads them."""

    def __init__(self, sim: cs.Simulator, name: str) -> None:
        self.sim = sim
        self.parts, angles = BODIES[name]
        self.turn = Rotation.from_euler("ZYX", angles)
        self.bodies = [cs.Body(part.shape) for part in self.parts]

    def deepest(self, turn: Rotation) -> float:
        """How far they reach below their origin [m]."""
        return max(
            reach_down(p.shape, turn * Rotation.from_euler("ZYX", p.angles)) - turn.apply(p.at)[2]
            for p in self.parts
        )

    def posed(self, position: tuple[float, float, float], turn: Rotation) -> cs.Scene:
        """The bodies there, turned."""
        placed = []
        for body, part in zip(self.bodies, self.parts, strict=True):
            own = turn * Rotation.from_euler("ZYX", part.angles)
            at = np.array(position) + turn.apply(part.at)
            placed.append(body.moved(cs.Pose(tuple(at), tuple(own.as_quat()))))
        return cs.Scene(placed)

    def scene(self, gap: float, x: float = 0.0) -> cs.Scene:
        """Lowest point at ``gap`` [m], shifted along x [m]."""
        return self.posed((PLACE[0] + x, PLACE[1], gap + self.deepest(self.turn)), self.turn)

    def turned(self, axis: str, degrees: float) -> cs.Scene:
        """Turned about the origin, which stays where the worst angle leaves ``TURN_GAP`` free."""
        angles = np.linspace(-TURN_TO, TURN_TO, 61)
        turns = Rotation.from_euler(axis, angles[:, None], degrees=True)
        deepest = max(self.deepest(extra * self.turn) for extra in turns)
        turn = Rotation.from_euler(axis, degrees, degrees=True) * self.turn
        return self.posed((*PLACE, TURN_GAP + deepest), turn)

    def read(self, scenes: list[cs.Scene]) -> Array:
        """ΔC [F] of scenes in turn, each after the one before, (n, 6, 6)."""
        self.sim.reset()
        return np.array([self.sim.step(s).delta for s in scenes])


def diagonals(deltas: Array) -> Array:
    """(n, 6)."""
    return np.diagonal(deltas, axis1=1, axis2=2)


def second_difference(deltas: Array) -> float:
    """Largest second difference of log ΔC_ii of entries worth looking at."""
    c = diagonals(deltas)
    shown = c > SHOWN * c.max(axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        second = np.abs(np.diff(np.log(c), n=2, axis=0))
    judged = shown[2:] & shown[1:-1] & shown[:-2]
    return float(np.where(judged, second, 0.0).max())


def largest_jump(deltas: Array) -> float:
    """Largest change of an entry in a step, over the smaller of the two."""
    c = diagonals(deltas)
    large = c > FALLING * c.max(axis=1, keepdims=True)
    jump = np.abs(np.diff(c, axis=0)) / np.minimum(np.abs(c[1:]), np.abs(c[:-1]))
    return float(np.where(large[1:] & large[:-1], jump, 0.0).max())


def falls(deltas: Array) -> tuple[int, int, float]:
    """Entries that ever fall, steps in which one does, and by how much in all at most."""
    c = diagonals(deltas)
    large = c > FALLING * c.max(axis=1, keepdims=True)
    fell = (np.diff(c, axis=0) < 0) & large[1:] & large[:-1]
    depth = np.where(fell, -np.diff(c, axis=0) / c[:-1], 0.0).sum(axis=0)
    return int(fell.any(axis=0).sum()), int(fell.sum()), float(depth.max())


def wrong(deltas: Array) -> int:
    """Readings that are not finite, symmetric and positive semidefinite."""
    bad = ~np.isfinite(deltas).all(axis=(1, 2))
    fine = deltas[~bad]
    slack = WRONG_BY * np.abs(fine).max(axis=(1, 2))
    skew = np.abs(fine - fine.transpose(0, 2, 1)).max(axis=(1, 2))
    bad[~bad] = (skew > slack) | (np.linalg.eigvalsh(fine)[:, 0] < -slack)
    return int(bad.sum())


def memory(mover: Mover) -> float:
    """Largest difference of readings by what was read before, over the largest entry."""
    scenes = [mover.scene(g) for g in np.linspace(0.060, 0.008, 20)]
    order = np.random.default_rng(0).permutation(len(scenes))
    ahead, mixed = mover.read(scenes), mover.read([scenes[k] for k in order])
    rested = np.concatenate([mover.read([s]) for s in scenes])
    scale = np.abs(rested).max(axis=(1, 2), keepdims=True)
    off = np.abs(ahead - rested) / scale, np.abs(mixed - rested[order]) / scale[order]
    return float(max(o.max() for o in off))


def bands(deltas: Array, gaps: Array) -> list[float]:
    """Largest jump above 2, 1, 0.5 mm and below, by the gap that a step ends at."""
    edges = (np.inf, 2e-3, 1e-3, 0.5e-3, 0.0)
    out = []
    for upper, lower in pairwise(edges):
        last = np.flatnonzero((gaps <= upper + 1e-9) & (gaps >= lower - 1e-9))
        out.append(largest_jump(deltas[max(last[0] - 1, 0) : last[-1] + 1]))
    return out


def steps_from(start: float, stop: float, step: float = STEP) -> Array:
    """Both ends included."""
    return np.linspace(start, stop, round(abs(stop - start) / step) + 1)


def judge(mover: Mover) -> dict[str, object]:
    """All figures of one body."""
    approach = mover.read([mover.scene(g) for g in steps_from(0.060, 0.008)])
    out: dict[str, object] = {
        "approach": second_difference(approach), "jump": largest_jump(approach),
        "falls": falls(approach),
    }  # fmt: skip
    ways: dict[str, Callable[[float], cs.Scene]] = {
        "slide": lambda x: mover.scene(SLIDE_GAP, x),
        "turn z": partial(mover.turned, "z"),
        "turn y": partial(mover.turned, "y"),
    }
    for name, way in ways.items():
        at = steps_from(-SLIDE_TO, SLIDE_TO) if name == "slide" else steps_from(
            -TURN_TO, TURN_TO, TURN)  # fmt: skip
        out[name] = second_difference(mover.read([way(v) for v in at]))
    across = mover.read([mover.scene(WALL_GAP, x) for x in steps_from(0.0, WALL_TO)])
    largest = diagonals(across).max(axis=1)
    out["wall"] = second_difference(across[largest > WALL_LEFT * largest[0]])
    gaps = steps_from(0.008, 0.05e-3)
    near = mover.read([mover.scene(g) for g in gaps])
    out["contact"] = bands(near, gaps)
    through = mover.read([mover.scene(g) for g in steps_from(0.05e-3, -1e-3)])
    out["wrong"] = wrong(np.concatenate([approach, near])), wrong(through)
    out["memory"] = memory(mover)
    return out


def show(name: str, found: dict[str, object]) -> None:
    """One line of the table."""
    entries, steps, depth = found["falls"]  # type: ignore[misc]
    contact = " ".join(f"{100 * v:6.2f}" for v in found["contact"])  # type: ignore[attr-defined]
    print(f"{name:11s} {found['approach']:9.1e} {100 * found['jump']:7.2f} "
          f"{entries:3d} {steps:5d} {100 * depth:7.2f}  {found['slide']:9.1e} "
          f"{found['wall']:9.1e} {found['turn z']:9.1e} {found['turn y']:9.1e}  {contact}  "
          f"{found['wrong'][0]:4d} {found['wrong'][1]:4d}  {found['memory']:8.1e}",
          flush=True)  # fmt: skip


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", nargs="+", default=[""], help="methods of Simulator")
    parser.add_argument("--settings", default="", metavar="NAME=VALUE,…",
                        help="arguments of Simulator; see accuracy_map.py")  # fmt: skip
    parser.add_argument("--bodies", nargs="+", choices=BODIES, default=list(BODIES))
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="figures as JSON")
    args = parser.parse_args()
    on_one_core()
    results = {}
    for method in args.method:
        chosen = {"method": method} if method else {}
        sim = cs.Simulator(DESIGN, **chosen, **parse_settings(args.settings))
        print(f"\n{method or 'default'} {args.settings}\n"
              f"{'':11s} {'approach':^34s}  {'slide':>9s} {'wall':>9s} "
              f"{'turn z':>9s} {'turn y':>9s}  "
              f"{'contact: jump %, gap in mm':^27s}  {'wrong':^9s}  {'memory':>8s}\n"
              f"{'':11s} {'2nd diff':>9s} {'jump %':>7s} {'fall':>3s} {'steps':>4s} "
              f"{'by %':>7s}  {'2nd diff':>9s} {'2nd diff':>9s} {'2nd diff':>9s} {'2nd diff':>9s}  "
              f"{'8-2':>6s} {'2-1':>6s} {'1-0.5':>6s} {'-0.05':>6s}  {'open':>4s} {'in':>4s}",
              flush=True)  # fmt: skip
        results[method or "default"] = {}
        for name in args.bodies:
            found = judge(Mover(sim, name))
            results[method or "default"][name] = found
            show(name, found)
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
