"""How readings change as parts of one conductor come in through a wall and touch.

    python benchmarks/continuity.py --scenes 24

Random bodies (boxes, balls, capsules, cylinders and ellipsoids of 4 to 35 cm, two to four of them,
one over the sensor) are one conductor that is grounded, floats, or is on 100 pF. All but the first
come in through a wall of the domain along a random line of 0.8 m, and some touch the first or each
other on the way. Designs and presets take turns.

- "jump": the largest change of a self-capacitance, over the largest, within 1e-12 of the way: the
  four steps of 16 mm that change most are halved until they are as short;
- "a mm": the largest change within a millimetre of the way, over the largest, where bodies are
  behind the first one: nothing of the others is nearer to the sensor's middle than 0.2 m.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import capsense as cs

Array = NDArray[np.float64]
DESIGNS = "six_patch_bare", "patch", "icub_triangle", "stripe"
PRESETS = "fast", "standard", "fine"
TIES: tuple[str | float, ...] = ("grounded", "floating", 100e-12)
WAY, STEPS = 0.8, 50


def random_shape(rng: np.random.Generator) -> cs.Shape:
    """One of five kinds."""
    size = rng.uniform(0.02, 0.12)
    kind = rng.integers(5)
    if kind == 0:
        return cs.Capsule(size / 2, rng.uniform(0.05, 0.3))
    if kind == 1:
        return cs.Box(tuple(rng.uniform(0.04, 0.35, 3)))
    if kind == 2:
        return cs.Sphere(size)
    if kind == 3:
        return cs.Ellipsoid(tuple(rng.uniform(0.02, 0.15, 3)))
    return cs.Cylinder(0.6 * size, rng.uniform(0.05, 0.3))


class Group:
    """Bodies of one conductor; all but the first come in."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        count = int(rng.integers(2, 5))
        self.shapes = [random_shape(rng) for _ in range(count)]
        self.turns = [tuple(Rotation.random(random_state=rng).as_quat()) for _ in range(count)]
        self.base = np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.16, 0.25)])
        way = rng.normal(size=3)
        way[2] = abs(way[2])
        self.way = way / np.linalg.norm(way)
        self.sides = 0.1 * rng.normal(size=(count, 3))

    def scene(self, to_go: float, tie: str | float) -> cs.Scene:
        """The bodies, with so much of the way to go [m]."""
        places = self.base + self.sides + to_go * self.way
        places += 0.05 * np.arange(len(places))[:, None] * self.way
        places[0] = self.base
        return cs.Scene([
            cs.Body(shape, cs.Pose(place, turn), "human", tie, conductor="all")
            for shape, place, turn in zip(self.shapes, places, self.turns, strict=True)
        ])  # fmt: skip

    def clear(self, to_go: float) -> bool:
        """Whether what comes in stays 0.2 m off the middle of the sensor."""
        bodies = self.scene(to_go, "grounded").bodies[1:]
        return all(
            b.shape.signed_distance(b.pose.inverse().apply(np.zeros((1, 3))))[0] > 0.2
            for b in bodies
        )


def largest_jump(read: Callable[[float], Array], at: Array, count: int = 4) -> float:
    """Largest change of a reading, over the largest of it, within 1e-12 of a parameter.

    The ``count`` steps that change most are halved, on the side that changes more.

    Args:
        read: Gives a reading, shape (n,).
        at: Values of the parameter, in order.
        count: So many steps are looked into.
    """
    found = np.array([read(x) for x in at])
    changes = np.abs(np.diff(found, axis=0)).max(axis=1) / found[1:].max(axis=1)
    out = 0.0
    for k in np.argsort(changes)[-count:]:
        (a, b), (start, end) = at[k : k + 2], found[k : k + 2]
        while abs(b - a) > 1e-12:
            middle = 0.5 * (a + b)
            here = read(middle)
            if np.abs(here - start).max() > np.abs(end - here).max():
                b, end = middle, here
            else:
                a, start = middle, here
        out = max(out, float(np.abs(end - start).max() / start.max()))
    return out


def judge(sim: cs.Simulator, group: Group, tie: str | float) -> tuple[float, float]:
    """The two figures."""

    def read(to_go: float) -> Array:
        return np.diag(sim.step(group.scene(to_go, tie)).delta)

    at = np.linspace(WAY, 0.0, STEPS + 1)
    found = np.array([read(x) for x in at])
    changes = np.abs(np.diff(found, axis=0)).max(axis=1) / found[1:].max(axis=1)
    jump, slope = largest_jump(read, at), 0.0
    behind = [k for k in np.argsort(changes)[::-1].tolist() if group.clear(at[k + 1])]
    for k in behind[:1]:
        fine = np.array([read(x) for x in np.arange(at[k], at[k + 1], -1e-3)])
        step = np.abs(np.diff(fine, axis=0)).max(axis=1) / fine[1:].max(axis=1)
        slope = float(step.max())
    return jump, slope


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    sims: dict[tuple[str, str], cs.Simulator] = {}
    worst: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for seed in range(args.seed, args.seed + args.scenes):
        design = DESIGNS[seed % len(DESIGNS)]
        preset = PRESETS[seed // len(DESIGNS) % len(PRESETS)]
        sim = sims.setdefault((design, preset), cs.Simulator(design, preset=preset))
        group = Group(seed)
        for tie in TIES:
            name = tie if isinstance(tie, str) else f"{1e12 * tie:g} pF"
            jump, slope = judge(sim, group, tie)
            worst[preset, name].append((jump, slope))
            print(f"{seed:4d} {design:14s} {preset:8s} {name:8s} jump {jump:.1e}  "
                  f"a mm {100 * slope:.3f} %", flush=True)  # fmt: skip
    print(f"\n{'preset':8s} {'tie':8s} {'scenes':>6s} {'jump':>8s} {'a mm':>12s} {'worst':>8s}")
    for (preset, name), values in worst.items():
        jumps, slopes = np.array(values).T
        print(f"{preset:8s} {name:8s} {len(values):6d} {jumps.max():8.1e} "
              f"{100 * np.median(slopes):10.3f} % {100 * slopes.max():6.3f} %")  # fmt: skip


if __name__ == "__main__":
    main()
