"""Fleets: solves a second, and errors against boundary elements beside them.

    python benchmarks/fleet.py                        # the compiled core, on all processors
    python benchmarks/fleet.py --device cuda:0 --counts 1024 4096 16384 65536
    python benchmarks/fleet.py --device warp:cpu --counts 64

A solve is one sensor in one environment: ``six_patch_bare`` before one finger (radius 8 mm, length
60 mm, ends included 76 mm) whose lowest point is 15 to 100 mm in front, in any direction, a new
pose in every environment and at every step. Errors are of the diagonal of ΔC (over the reference,
or over 1 % of the scene's largest entry where that is more) in the scenes of
``tests/data/reference_map.json`` that hold one primitive from 15 mm on, and in all scenes of
primitives. On Warp, differences of all entries to ``Simulator.step`` with both its presets, over
each scene's largest entry, are beside them. Times are of steps with the poses on the device; a host
array costs its copy. Times of the processor are those of all threads of this program, which other
programs disturb less.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from machine import describe_machine
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from reference_scenes import (
    DESIGN,
    ReferenceScene,
    diagonal_errors,
    fleet_of,
    reference_scenes,
)

import capsense as cs

Array = NDArray[np.float64]
PRIMITIVES = cs.Box, cs.Sphere, cs.Capsule, cs.Cylinder, cs.Ellipsoid
FINGER = cs.Body(cs.Capsule(0.008, 0.06), material="human", name="finger")
AROUND = [
    cs.Body(cs.Capsule(0.04, 0.25), material="human", name="forearm"),
    cs.Body(cs.Ellipsoid((0.1, 0.15, 0.07)), material="human", name="chest"),
    cs.Body(cs.Box((0.4, 0.15, 0.02)), material="steel", name="shelf"),
]
"""What else stands in a place of its own in the rows of four bodies, 0.1 to 0.15 m in front."""
STEPS = 9
PRESETS = "standard", "fine"
"""Presets of ``Simulator`` that Warp is compared with."""


def fingers(count: int, rng: np.random.Generator) -> Array:
    """Poses of the finger, shape (count, 1, 7)."""
    turn = rng.normal(size=(count, 4))
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    low = 0.008 + 0.03 * np.abs(1 - 2 * (turn[:, :2] ** 2).sum(axis=1))  # under the middle
    place = rng.uniform([-0.08, -0.05, 0.015], [0.08, 0.05, 0.1], (count, 3))
    place[:, 2] += low
    return np.concatenate([place, turn], axis=1)[:, None]


def crowds(count: int, rng: np.random.Generator) -> Array:
    """Poses of the finger and of what stands around it, shape (count, 4, 7)."""
    others = np.zeros((count, len(AROUND), 7))
    others[..., 6] = 1.0
    others[:, 0, 3:] = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
    others[..., :3] = [[0.0, 0.1, 0.14], [0.0, 0.0, 0.22], [0.0, -0.18, 0.13]]
    others[..., :3] += rng.uniform(-0.01, 0.01, (count, 1, 3))
    return np.concatenate([fingers(count, rng), others], axis=1)


def errors(options: dict[str, Any], scenes: list[ReferenceScene]) -> tuple[Array, Array, Array]:
    """Errors of single bodies from 15 mm on, of all scenes, and differences to ``Simulator`` [%].

    The last are of shape (presets, scenes, 6, 6).
    """
    fleet, poses = fleet_of(scenes, **options)
    simulators = [cs.Simulator(DESIGN, preset=p) for p in PRESETS]
    truth = np.array([[s.step(one.scene).delta for one in scenes] for s in simulators])
    delta = fleet.step(poses).delta
    delta = (delta if isinstance(delta, np.ndarray) else delta.numpy())[:, 0].astype(float)
    found = np.array(
        [100 * diagonal_errors(d, s.delta) for d, s in zip(delta, scenes, strict=True)]
    )
    single = [len(s.scene) == 1 and s.gap > 0.0149 for s in scenes]
    apart = 100 * (delta - truth) / np.abs(truth).max(axis=(2, 3), keepdims=True)
    return found[single].ravel(), found.ravel(), apart


def rate(options: dict[str, Any], count: int, crowd: bool) -> tuple[float, float]:
    """Medians of solves a second by the clock, and of the processor's time for one [s]."""
    fleet = cs.Fleet(DESIGN, [FINGER, *AROUND] if crowd else [FINGER], count, **options)
    rng = np.random.default_rng(count)
    drawn = crowds if crowd else fingers
    poses: list[Any] = [drawn(count, rng) for _ in range(STEPS)]
    wait = lambda: None  # noqa: E731
    if options["device"] != "cpu":
        import warp as wp

        device = wp.get_device(options["device"].removeprefix("warp:"))
        poses = [wp.array(p.astype(np.float32), dtype=wp.float32, device=device) for p in poses]
        wait = lambda: wp.synchronize_device(device)  # noqa: E731
    times = []
    for pose in poses:
        wait()
        start, busy = perf_counter(), process_time()
        fleet.step(pose)
        wait()
        times.append((perf_counter() - start, process_time() - busy))
    clock, busy = np.median(times[1:], axis=0) / count
    return 1.0 / float(clock), float(busy)


SHARED = {
    "choice", "scale", "softness", "group", "radius", "pose", "slot", "columns", "lossy", "charge"
}  # fmt: skip
"""Arrays of structures of Warp that are another's."""


def arrays_of(struct: Any, kind: Any, shared: set[str] | None = None) -> list[Any]:
    """The arrays of a structure of Warp but for those that it shares."""
    return [getattr(struct, name) for name in kind.vars if name not in (shared or set())]


def memory(options: dict[str, Any], crowd: bool) -> tuple[int, int]:
    """Bytes that a sensor takes on Warp, without gradients and with them."""
    from capsense.fleet.warp_cut import WarpActiveTree
    from capsense.fleet.warp_near import NearBodies
    from capsense.fleet.warp_slope import Slopes
    from capsense.fleet.warp_solve import Left

    sizes = []
    for count in (8, 16):
        fleet = cs.Fleet(DESIGN, [FINGER, *AROUND] if crowd else [FINGER], count, **options)
        drawn = crowds if crowd else fingers
        fleet.step(drawn(count, np.random.default_rng(0)), jacobian=True)
        core = fleet._warp
        parts = [
            list(vars(core).values()),
            [
                *arrays_of(core.cut, WarpActiveTree), *arrays_of(core.left, Left),
                *arrays_of(core.near, NearBodies, SHARED),
            ],
            [*core._slopes[:-1], *arrays_of(core._slopes[-1], Slopes, SHARED)],
        ]  # fmt: skip
        sizes.append([sum(getattr(x, "capacity", 0) or 0 for x in part) for part in parts])
    core_size, cut, slopes = ((b - a) // 8 for a, b in zip(*sizes, strict=True))
    return core_size + cut, core_size + cut + slopes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cpu", help="cpu, warp:cpu or cuda:0 (default: cpu)")
    parser.add_argument("--counts", type=int, nargs="+", default=[256, 1024, 4096])
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="solves a second")
    options = parser.parse_args()
    rates: dict[str, float] = {}
    print(describe_machine(("capsense", "numpy", "numba", "warp-lang")))
    scenes = [
        s for s in reference_scenes() if all(isinstance(b.shape, PRIMITIVES) for b in s.scene)
    ]
    name, values = ("preset", ["fast", "standard"])
    if options.device != "cpu":
        name, values = ("budget", [32, 64, 128])
    told = "rms, worst error [%]: one body from 15 mm on, all scenes"
    print(f"{name:10} {'environments':>12} {'solves/s':>10} {'µs of CPU':>10}   {told}")
    for value in values:
        chosen = {"device": options.device, name: value}
        single, every, apart = errors(chosen, scenes)
        told = ", ".join(
            f"{np.sqrt((e**2).mean()):.2f} {np.abs(e).max():.2f}" for e in (single, every)
        )
        if options.device != "cpu":
            for crowd in (False, True):
                plain, whole = memory(chosen, crowd)
                bodies = 1 + crowd * len(AROUND)
                print(
                    f"{value!s:10} bodies: {bodies}, {plain:,} bytes a sensor, {whole:,} with "
                    "gradients"
                )
            for preset, entries in zip(PRESETS, apart, strict=True):
                worst = np.abs(entries).max(axis=(1, 2))
                print(
                    f"{'':10} to Simulator.step, {preset}: rms {np.sqrt((entries**2).mean()):.2f} %"
                    f", worst {worst.max():.2f} %, {(worst < 1).sum()} of {len(worst)} scenes "
                    "within 1 %"
                )
        for count in options.counts:
            solves, busy = rate(chosen, count, crowd=False)
            rates[f"{value}/{count}"] = solves
            print(
                f"{value!s:10} {count:12} {solves:10,.0f} {1e6 * busy:10,.0f}   {told}", flush=True
            )
        solves, busy = rate(chosen, options.counts[0], crowd=True)
        print(
            f"{value!s:10} {options.counts[0]:12} {solves:10,.0f} {1e6 * busy:10,.0f}   four bodies"
        )
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"rates": rates}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
