"""Steps, batches and first readings, for asv."""

from __future__ import annotations

import subprocess
import sys

import capsense as cs

DESIGN = "six_patch"
PRESETS = "learning", "standard", "fine"
LEVEL = (0.0, 0.5**0.5, 0.0, 0.5**0.5)
"""A capsule's axis along x."""
BODIES = {
    "finger at 15 mm": cs.Body(
        cs.Capsule(0.008, 0.060), cs.Pose((0, 0, 0.023), LEVEL), "human", name="finger"
    ),
    "forearm at 20 mm": cs.Body(
        cs.Capsule(0.040, 0.250), cs.Pose((0, 0, 0.060), LEVEL), "human", name="forearm"
    ),
    "bar at 20 mm": cs.Body(
        cs.Box((0.15, 0.15, 0.02)), cs.Pose((0, 0, 0.030)), "steel", name="bar"
    ),
}
BATCH = 64
FIRST = f"""
import time
import capsense as cs
cs.Simulator("{DESIGN}").step(cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.06)))]))
print(time.process_time())
"""


def moved(body: cs.Body, x: float) -> cs.Body:
    """The body at another place along x [m]."""
    (_, y, z), turn = body.pose.position, body.pose.quaternion
    return body.moved(cs.Pose((x, y, z), turn))


class Steps:
    """One step of a body that moves, so that nothing of the step before can be taken again."""

    params = PRESETS, tuple(BODIES)
    param_names = "preset", "body"

    def setup(self, preset: str, body: str) -> None:
        self.simulator = cs.Simulator(DESIGN, preset=preset)
        self.body, self.count = BODIES[body], 0
        self.time_step(preset, body)  # compiles, and cuts the shape into panels

    def time_step(self, preset: str, body: str) -> None:
        self.count += 1
        self.simulator.step(cs.Scene([moved(self.body, 1e-4 * (self.count % 100))]))


class Batch:
    """Many scenes in one call."""

    params = PRESETS
    param_names = ("preset",)

    def setup(self, preset: str) -> None:
        self.simulator = cs.Simulator(DESIGN, preset=preset)
        ball = cs.Sphere(0.03)
        self.scenes = [
            cs.Scene([cs.Body(ball, cs.Pose((1e-3 * k, 0, 0.06)), "steel")]) for k in range(BATCH)
        ]
        self.time_step_batch(preset)

    def time_step_batch(self, preset: str) -> None:
        self.simulator.step_batch(self.scenes, threads=1)


class Fresh:
    """What is done once."""

    def setup(self) -> None:
        self.time_simulator()

    def time_simulator(self) -> None:
        cs.Simulator(DESIGN)

    def track_first_reading(self) -> float:
        """Processor time of a new process, kernels being compiled already [s]."""
        command = [sys.executable, "-c", FIRST]
        for _ in range(2):  # the first may compile
            done = subprocess.run(command, capture_output=True, text=True, check=True)
        return float(done.stdout)

    track_first_reading.unit = "s"  # type: ignore[attr-defined]
    track_first_reading.timeout = 300  # type: ignore[attr-defined]
