"""A touch slider from its KiCad board to counts of a chip: ``python slider_counts.py``."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import numpy as np

import capsense as cs

BOARD = Path(__file__).parent / "touch_slider.kicad_pcb"


def main() -> None:
    """Print the counts of three electrodes while a finger slides over an acrylic cover of 2 mm."""
    layout = cs.load_layout(BOARD)
    board = layout.assign(["TOUCH*"], ground=["GND"], cover=("acrylic", 0.002))
    start = process_time()
    sim = cs.Simulator(board.design)
    print(f"field: {process_time() - start:.0f} s of processor time (less from the cache)")
    sim.use_readout("fdc1004", seed=1)
    finger = cs.Capsule(radius=0.004, length=0.05)
    upright = (0.0, 0.0, 0.0, 1.0)
    print("x [mm]", *sim.electrode_names)
    for number, x in enumerate(np.linspace(-0.015, 0.015, 7)):
        # the tip of the capsule is 0.5 mm above the cover
        pose = cs.Pose((x, 0.0017, 0.0025 + 0.004 + 0.025), upright)
        scene = cs.Scene([cs.Body(finger, pose, "human", 100e-12)])
        for k in range(20):  # the chip converts one channel after another
            reading = sim.step(scene, time=number + 0.05 * k)
        print(f"{x * 1e3:6.1f}", *reading.counts.held().code.tolist())


if __name__ == "__main__":
    main()
