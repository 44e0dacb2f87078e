"""Makes the sample log of ``docs/tutorials/hardware.md``: a chip and a robot, both synthetic.

``python examples/logs/make_six_patch_ball.py`` writes two files beside itself:

- ``six_patch_ball.csv``: time [s], channel and code of every conversion of two FDC1004;
- ``six_patch_ball_poses.csv``: time [s] and centre of the ball [m], as a robot would log them.

A grounded steel ball of 60 mm diameter waits 150 mm over ``six_patch`` for ten seconds, then comes
down to 38 mm and goes up again, twice. No hardware was measured: codes are simulated, with gains,
offsets, drift and noise that the page pretends not to know.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import capsense as cs
from capsense.readout.calibration import LinearSensor
from capsense.readout.conversions import Counts

SECONDS, REST, PERIOD = 30.0, 10.0, 10.0
GAIN = (1.03, 0.98, 1.01, 1.05, 0.97, 1.00)
OFFSET = (210e-15, 180e-15, 250e-15, 190e-15, 205e-15, 230e-15)
DRIFT = 2e-17
"""[F/s]"""
WHITE, FLICKER = 0.9e-15, 0.25e-15
NOTE = "# synthetic, by examples/logs/make_six_patch_ball.py\n"


def centre(time: float) -> tuple[float, float, float]:
    """Where the ball is [m], in the sensor frame."""
    phase = 2 * np.pi * max(time - REST, 0.0) / PERIOD
    return 0.010, -0.005, 0.094 + 0.056 * np.cos(phase)


def make() -> tuple[np.ndarray, Counts]:
    """Poses, rows of time [s] and x, y, z [m]; and what the chips report."""
    sim = cs.Simulator("six_patch")
    times = np.arange(0.0, SECONDS + 0.025, 0.05)
    poses = np.array([(t, *centre(t)) for t in times])
    scenes = [cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose(p[1:]), "steel")]) for p in poses]
    lab = cs.Readout.preset(
        "fdc1004", sim.electrode_names, rate=100, capdac=0, white=WHITE, flicker=FLICKER,
        stages=[LinearSensor(np.array(GAIN), np.array(OFFSET), DRIFT, 0.0)], seed=3,
    )  # fmt: skip
    return poses, lab(times, sim.step_batch(scenes))


def main(folder: Path) -> None:
    poses, counts = make()
    log = "".join(
        f"{t:.4f},{k},{code}\n"
        for t, k, code in zip(counts.time, counts.channel, counts.code, strict=True)
    )
    (folder / "six_patch_ball.csv").write_text(f"{NOTE}time,channel,code\n{log}")
    told = "".join(f"{t:.2f},{x:.5f},{y:.5f},{z:.5f}\n" for t, x, y, z in poses)
    (folder / "six_patch_ball_poses.csv").write_text(f"{NOTE}time,x,y,z\n{told}")


if __name__ == "__main__":
    main(Path(__file__).parent)
