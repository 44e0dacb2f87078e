"""From how far packaged designs and chips tell a hand and a steel ball from noise.

``python benchmarks/range_table.py --write docs/choosing.md`` computes the table of that page. A
body is told where the change of at least one channel exceeds the threshold of that channel: three
times the noise of one value, at least one code. There are ten values a second: each is the mean of
the conversions that a channel has in 0.1 s, or one conversion where its chip takes longer. The
noise is the Allan deviation of a simulated minute at rest, with all that the preset of the chip
has: white noise, flicker and rounding.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pages import write_between

import capsense as cs
from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.config import choose_readout
from capsense.readout.noise import allan_deviation
from capsense.readout.presets import CHIPS

Array = NDArray[np.float64]
MARKERS = ("<!-- range -->", "<!-- end of range -->")
DESIGNS = (
    "three_stripes", "six_patch", "six_patch_bare", "arm_segment", "dual_pad", "stripe", "patch",
    "meander", "gripper_pad", "icub_triangle", "fingertip12",
)  # fmt: skip
"""The largest electrodes first."""
GAPS = np.geomspace(1e-3, 0.3, 49)
"""From the face of the sensor to the body [m]."""
VALUE = 0.1
"""Time of one value [s]."""
REST = 60.0
"""How long the chip is at rest for its noise [s]."""
SIGMAS = 3.0


def hand(height: float) -> cs.Body:
    """A flat hand whose lowest point is at a height [m], of a person on 100 pF."""
    at = cs.Pose((0.0, 0.0, height + 0.015))
    return cs.Body(cs.Ellipsoid((0.05, 0.09, 0.015)), at, "human", grounding=100e-12)


def ball(height: float) -> cs.Body:
    """A grounded steel ball of 40 mm diameter whose lowest point is at a height [m]."""
    return cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, height + 0.02)), "steel")


BODIES: dict[str, Callable[[float], cs.Body]] = {"hand": hand, "ball": ball}


def face(design: cs.Design) -> float:
    """Height of the highest electrode, layer or cover [m]."""
    tops = [e.surface.bounds[1, 2] for e in design.electrodes]
    tops += [layer.upper[2] for layer in design.layers]
    if design.cover is not None:
        tops.append(design.cover.upper[2])
    return float(max(tops))


def changes(sim: cs.Simulator, body: Callable[[float], cs.Body]) -> list[cs.Reading]:
    """Readings with a body at all of :data:`GAPS`."""
    top = face(sim.design)
    return sim.step_batch([cs.Scene([body(top + gap)]) for gap in GAPS])


def threshold(readout: Readout, empty: Array) -> Array:
    """Least change that each channel tells [F], of its values with no body [F]; shape (K,).

    It is infinite where the empty sensor is out of the chip's range.
    """
    counts = readout(np.array([0.0, REST]), np.stack([empty, empty]))
    told = counts.table()[1]
    outside = counts.table("flags")[1].astype(bool).mean(axis=0) > 0.5
    each = max(1, round(VALUE / readout.schedule.period))
    noise = [allan_deviation(column, np.array([each]))[0] for column in told.T]
    law = readout.law
    centre = np.median(told, axis=0)
    if readout.dac is not None:
        centre = centre - readout.dac.step * readout.dac.nearest(centre)
    code = np.rint(law.level(centre)).astype(np.int64)
    step = np.abs(law.capacitance(code + 1) - law.capacitance(code))
    return np.where(outside, np.inf, np.maximum(SIGMAS * np.array(noise), step))


def reach(found: Array, least: Array) -> tuple[float, bool]:
    """Largest distance at which a body is told [m], and whether it is told from there on inwards.

    The distance is 0 where it is told at none, and infinite beyond all.

    Args:
        found: Changes of channels at all of :data:`GAPS` [F], shape (G, K).
        least: Thresholds [F], shape (K,).
    """
    ratio = np.log(np.maximum((np.abs(found) / least).max(axis=1), 1e-12))
    heard = np.flatnonzero(ratio >= 0.0)
    if not len(heard):
        return 0.0, True
    k, whole = heard[-1], len(heard) == heard[-1] + 1
    if k == len(GAPS) - 1:
        return np.inf, whole
    share = ratio[k] / (ratio[k] - ratio[k + 1])
    return float(GAPS[k] * (GAPS[k + 1] / GAPS[k]) ** share), whole


def shown(distance: float, whole: bool = True) -> str:
    """A distance [m] in mm, two digits; starred where the body is not told all the way inwards."""
    star = "" if whole else "*"
    if distance == 0.0:
        return "–"
    if np.isinf(distance):
        return f"> {1e3 * GAPS[-1]:.0f}{star}"
    return f"{float(f'{1e3 * distance:.2g}'):g}{star}"


def row(name: str, chips: Sequence[str]) -> list[str]:
    """Cells of a design: hand/ball for each chip, one dash where neither is told."""
    sim = cs.Simulator(name)
    readings = {body: changes(sim, make) for body, make in BODIES.items()}
    cells = []
    for chip in chips:
        try:
            readout = choose_readout(chip, sim.electrode_names, sim.empty)
        except ReadoutError:  # one electrode has no mutual capacitance
            cells.append("")
            continue
        empty = readout.channel_values(sim.empty)
        least = threshold(readout, empty)
        if np.isinf(least).all():
            cells.append("out of range")
            continue
        far = [
            reach(np.array([readout.channel_values(r) - empty for r in some]), least)
            for some in readings.values()
        ]
        told = [shown(*f) for f in far]
        cells.append("–" if set(told) == {"–"} else "/".join(told))
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("designs", nargs="*", default=DESIGNS, help="default: all packaged ones")
    parser.add_argument("--chips", nargs="+", default=tuple(CHIPS), choices=CHIPS)
    parser.add_argument("--write", type=Path, metavar="PAGE", help="a page with marks of the table")
    options = parser.parse_args()
    lines = [f"| {' | '.join(['hand/ball [mm]', *(f'`{c}`' for c in options.chips)])} |"]
    lines.append("|---" * (1 + len(options.chips)) + "|")
    print("\n".join(lines), flush=True)
    for name in options.designs:
        lines.append(f"| {' | '.join([f'`{name}`', *row(name, options.chips)])} |")
        print(lines[-1], flush=True)
    if options.write is not None:
        write_between(options.write, MARKERS, "\n".join(lines))


if __name__ == "__main__":
    main()
