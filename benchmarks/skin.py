"""Sixteen curved sensors around a robot arm, near a person: ``python benchmarks/skin.py``.

The robot and the person are those of ``examples/skin_stops.py``: the arm turns to and fro beside a
hand that moves, so that every step is a new scene for every sensor. Times are of this machine as
found; the load says what else it did. Errors of the design are against boundary elements.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
import tracemalloc
from pathlib import Path

import mujoco
import numpy as np
from machine import describe_machine

import capsense as cs

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "examples"), str(ROOT / "tests" / "helpers")]

from curved_cases import curved_body, curved_figures, curved_reference  # noqa: E402
from skin_robot import GROUNDING, JOINTS, MATERIALS, PERSON, SITES, model_text  # noqa: E402
from skin_stops import POSTURE, SHOULDER  # noqa: E402

PERIOD = 50
"""Steps in which the person's arm goes up and down once."""


class World:
    """The robot beside the person."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(model_text(SHOULDER))
        self.data = mujoco.MjData(self.model)
        joints = [f"{j.name}" for j in PERSON.joints]
        self._flexion = len(JOINTS) + joints.index("shoulder_flexion")
        self._elbow = len(JOINTS) + joints.index("elbow_flexion")
        self.move(0)

    def move(self, k: int) -> None:
        """Take the k-th posture."""
        phase = 2 * math.pi * k / PERIOD
        self.data.qpos[: len(JOINTS)] = math.radians(28.0 + 3.0 * math.sin(0.37 * phase)), *POSTURE
        self.data.qpos[self._flexion] = math.radians(75.0)
        self.data.qpos[self._elbow] = math.radians(12.0 + 6.0 * math.sin(phase))
        mujoco.mj_forward(self.model, self.data)

    def skin(self, threads: int) -> object:
        """The sixteen sensors."""
        return cs.mujoco.attach_skin(
            self.model,
            self.data,
            SITES,
            "arm_segment",
            materials=MATERIALS,
            grounding=GROUNDING,
            threads=threads,
        )


def time_steps(world: World, threads: int, steps: int) -> float:
    """Print the time of a step of all sensors; its median [ms]."""
    skin = world.skin(threads)
    times, unknowns, largest = [], 0, 0.0
    busy = time.process_time()
    for k in range(-20, steps):
        world.move(k)
        if k == 0:
            busy = time.process_time()
        start = time.perf_counter()
        readings = skin.read()  # type: ignore[attr-defined]
        if k >= 0:
            times.append(time.perf_counter() - start)
            unknowns += sum(r.stats.unknowns for r in readings.values())
            largest = max(largest, *(r.delta.max() for r in readings.values()))
    busy = (time.process_time() - busy) / steps
    p50, p95, p99 = 1e3 * np.percentile(times, (50, 95, 99))
    print(
        f"  {threads} threads: median {p50:.1f} ms, 95 % below {p95:.1f}, 99 % below {p99:.1f}; "
        f"processor time {1e3 * busy:.1f} ms; {unknowns / steps / len(SITES):.0f} unknowns a "
        f"sensor; largest change {1e15 * largest:.1f} fF"
    )
    return float(p50)


def parts(world: World, steps: int) -> None:
    """Print where the time goes, sensor after sensor."""
    skin = world.skin(1)
    see, solve, bodies = [], [], 0
    for k in range(steps):
        world.move(k)
        for sensor in skin.sensors.values():  # type: ignore[attr-defined]
            start = time.perf_counter()
            view = sensor.scene()
            middle = time.perf_counter()
            sensor.simulator.step(view)
            see.append(middle - start)
            solve.append(time.perf_counter() - middle)
            bodies += len(view)
    print(
        f"  one sensor: sees {bodies / len(see):.1f} bodies in {1e3 * np.median(see):.2f} ms, "
        f"solves in {1e3 * np.median(solve):.2f} ms (medians)"
    )


def far_away(world: World) -> None:
    """Print what sensors cost that see nothing."""
    poses = {f"s{k}": cs.Pose((0.0, 0.0, 10.0 + k)) for k in range(16)}
    one = cs.Simulator("arm_segment")
    skin = cs.Skin({name: (one.copy(), pose) for name, pose in poses.items()}, threads=1)
    scene = cs.Scene([cs.Body(cs.Sphere(0.1), cs.Pose((k, 0.0, 0.0))) for k in range(30)])
    times = []
    for _ in range(100):
        start = time.perf_counter()
        skin.step(scene)
        times.append(time.perf_counter() - start)
    print(f"  16 sensors, 30 bodies, all far away: {1e3 * np.median(times):.2f} ms")


def whole_body(steps: int) -> None:
    """Print what a reading of 64 patches costs on one and on two threads, taken in turn.

    Four links with sixteen ``arm_segment`` each, 384 electrodes; a person of 12 capsules passes.
    """
    turn = 2 * math.pi / 4
    poses = {
        f"link{k}_{row}_{n}": cs.Pose((0.6 * k, 0.0, 0.1 * row))
        @ cs.Pose((0.0, 0.0, 0.0), (0.0, 0.0, math.sin(n * turn / 2), math.cos(n * turn / 2)))
        @ cs.Pose((0.048, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5))
        for k in range(4)
        for row in range(4)
        for n in range(4)
    }
    one = cs.Simulator("arm_segment")
    skins = [
        cs.Skin({name: (one.copy(), pose) for name, pose in poses.items()}, threads=n)
        for n in (1, 2)
    ]
    wall: list[list[float]] = [[], []]
    busy: list[list[float]] = [[], []]
    for k in range(-3, steps):
        at = 0.9 + 0.9 * math.sin(0.1 * k)
        person = [
            cs.Body(
                cs.Capsule(0.05, 0.25),
                cs.Pose((at + 0.12 * (n % 4) - 0.2, 0.16 + 0.02 * (n // 4), 0.2 * (n // 4))),
                material="human",
            )
            for n in range(12)
        ]
        for which, skin in enumerate(skins):
            scene = cs.Scene(person)
            start, used = time.perf_counter(), time.process_time()
            skin.step(scene)
            if k >= 0:
                wall[which].append(1e3 * (time.perf_counter() - start))
                busy[which].append(1e3 * (time.process_time() - used))
    first, second = (float(np.median(times)) for times in wall)
    processor = [float(np.median(times)) for times in busy]
    print(
        f"  64 sensors, 384 electrodes: median {first:.1f} ms on one thread, "
        f"{second:.1f} ms on two (ratio {first / second:.2f}); processor time "
        f"{processor[0]:.1f} and {processor[1]:.1f} ms"
    )


def memory() -> None:
    """Print the memory of one more sensor."""
    first = cs.Simulator("arm_segment")
    scene = cs.Scene([cs.Body(cs.Sphere(0.04), cs.Pose((0.0, 0.0, 0.06)))])
    first.step(scene)
    tracemalloc.start()
    second = first.copy()
    second.step(scene)
    taken = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    print(f"  one more sensor takes {taken / 1e6:.1f} MB")


def accuracy() -> None:
    """Print the design's errors."""
    sim, every = cs.Simulator("arm_segment"), []
    print("errors of the diagonal of arm_segment, %:")
    for case in curved_figures()["cases"]:
        sim.reset()
        got = np.diag(sim.step(cs.Scene([curved_body(case)])).delta)
        off = 100 * (got / np.diag(curved_reference(case)) - 1)
        every.append(off)
        print(f"  {case:>8} mm: {' '.join(f'{v:+5.1f}' for v in off)}   rms {_rms(off):.1f}")
    print(f"  all: rms {_rms(np.array(every)):.1f}")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--only", choices=["steps", "whole-body"], help="one part alone")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="median steps")
    options = parser.parse_args()
    machine = describe_machine(("numpy", "numba", "mujoco"))
    print(f"{machine['processor']}, {machine['cores']} cores, load {machine['load']:.1f}")
    if options.only == "whole-body":
        whole_body(options.steps)
        return
    if not options.only:
        accuracy()
    print("a step of 16 sensors, 96 electrodes:")
    world = World()
    medians = {
        threads: time_steps(world, threads, options.steps)
        for threads in range(1, (os.cpu_count() or 1) + 1)
    }
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"step_ms": medians}, indent=1) + "\n")
    if options.only:
        return
    parts(world, options.steps // 5)
    far_away(world)
    whole_body(options.steps)
    memory()


if __name__ == "__main__":
    main()
