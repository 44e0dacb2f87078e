"""A fist comes from 200 mm, presses a soft pad nearly flat, holds, lets go and leaves.

Run it: ``python examples/touch_approach.py [FOLDER]``. The pad, ``dual_pad``, has electrodes for
proximity and one for pressure below foam with a grounded fabric. Capacitances and the codes of an
FDC1004 are drawn over distance and force; the plot goes to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import capsense as cs
from capsense._style import COLOURS, LEGEND, dress

RATE = 50.0
"""Readings per second [Hz]."""
FAR, NEAR = 0.2, 1e-4
"""Distances [m] at which the approach begins, and from which on it counts as touch."""
FORCE = 11.0
"""Largest force [N]: held by it, the foam is compressed by over nine tenths of its thickness."""
CUES = np.cumsum([2.0, 1.0, 2.0, 1.0, 2.0])
"""Times [s] at which the fist touches, presses, lets go, is off and is away."""
FOAM = 0.002
"""Thickness of the foam [m]."""
RADIUS = 0.04
"""Of the fist [m]."""


@dataclass
class Record:
    """What happened; each array has a row for each of n readings."""

    time: np.ndarray
    """Times [s], (n,)."""
    distance: np.ndarray
    """From the face of the pad [m], 0 in touch, (n,)."""
    force: np.ndarray
    """Force that presses the fist onto the pad [N], (n,)."""
    delta: np.ndarray
    """Changes of the self-capacitances [F], (n, 3)."""
    felt: np.ndarray
    """Force above the pressure electrode [N], (n,)."""
    compression: np.ndarray
    """Largest compression above it [m], (n,)."""
    codes: cs.Counts
    """What the chip reported."""


def distance(t: float) -> float:
    """Distance of the fist from the face at a time [m]."""
    touch, off, away = CUES[0], CUES[3], CUES[4]
    share = np.interp(t, [0.0, touch, off, away], [0.0, 1.0, 1.0, 0.0])
    return 0.0 if share >= 1.0 else FAR * (NEAR / FAR) ** share


def force(t: float) -> float:
    """Force that presses it at a time [N]."""
    return float(np.interp(t, CUES[:4], [0.0, FORCE, FORCE, 0.0]))


def play(sim: cs.Simulator) -> Record:
    """Take a reading at each instant."""
    fist = cs.Body(cs.Sphere(RADIUS), material="human", grounding=100e-12, name="fist")
    assert sim.design.cover is not None
    face = sim.design.cover.upper[2]
    chip = cs.Readout.preset("fdc1004", sim.electrode_names, seed=1)
    times = np.arange(0.0, CUES[-1], 1.0 / RATE)
    gaps, forces = np.array([distance(t) for t in times]), np.array([force(t) for t in times])
    readings = []
    for t, gap, newtons in zip(times, gaps, forces, strict=True):
        body = fist.moved(cs.Pose((0.0, 0.0, face + RADIUS + gap)))
        scene = cs.Scene([body.pressed(newtons) if gap == 0.0 else body])
        readings.append(sim.step(scene, time=float(t)))
    touches = [reading.touch for reading in readings]
    return Record(
        times, gaps, forces, np.array([np.diag(r.delta) for r in readings]),
        np.array([touch.force[1] for touch in touches if touch is not None]),
        np.array([touch.compression[1] for touch in touches if touch is not None]),
        chip(times, readings),
    )  # fmt: skip


def check(record: Record) -> None:
    """Proximity rises up to touch and pressure from there on; the foam relaxes and lags."""
    touch, pressed, release, off, _ = CUES
    time, near, key = record.time, record.delta[:, 0], record.delta[:, 1]
    coming, down = time < touch, (time >= touch) & (time <= pressed)
    assert np.all(np.diff(near[coming]) > 0.0), "it comes nearer"
    assert record.compression.max() > 0.9 * FOAM, "it is pressed nearly flat"
    assert near[coming][-1] > 100.0 * key[coming].max(), "the fabric screens the pressure electrode"
    assert np.all(np.diff(key[down]) > 0.0), "it is pressed harder"
    held = (time > pressed) & (time < release)
    assert np.all(np.diff(record.compression[held]) > -1e-9), "the foam gives way in time"
    up = (time >= release) & (time <= off)
    there, back = (np.interp(0.3 * FORCE, *curve) for curve in (
        (record.force[down], key[down]), (record.force[up][::-1], key[up][::-1])
    ))  # fmt: skip
    assert back > 1.05 * there, "let go, it is more compressed than at the same force before"


def draw(record: Record, folder: Path) -> None:
    """Write ``touch_approach.png``."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9, 6), layout="constrained")
    axes = figure.subplots(2, 2, sharey="row", sharex="col")
    for number, (name, colour) in enumerate(zip(("left", "press"), COLOURS, strict=False)):
        codes = record.codes.of(name)
        at_chip = [np.interp(codes.time, record.time, x) for x in (record.distance, record.force)]
        drawn = (
            (record.time, record.distance, record.force, record.delta[:, number] * 1e15, "-"),
            (codes.time, *at_chip, codes.code - np.median(codes.code[:5]), "."),
        )
        for row, (time, gap, newtons, value, style) in enumerate(drawn):
            middle = 0.5 * (CUES[1] + CUES[2])
            for way, on in (("going", time < middle), ("coming back", time >= middle)):
                look = {
                    "color": colour, "linestyle": "-" if way == "going" else "--",
                    "linewidth": 1.4, "label": f"{name}, {way}",
                } if style == "-" else {
                    "color": colour, "linestyle": "none", "marker": "." if way == "going" else "x",
                    "markersize": 4, "label": f"{name}, {way}",
                }  # fmt: skip
                far, touch = on & (gap > NEAR), on & (newtons > 0.0)
                axes[row, 0].plot(gap[far] * 1e3, value[far], **look)
                axes[row, 1].plot(newtons[touch], value[touch], **look)
    axes[0, 0].set_xscale("log")
    axes[0, 0].invert_xaxis()
    axes[0, 0].set_xticks([100.0, 10.0, 1.0, 0.1], ["100", "10", "1", "0.1"])
    axes[0, 0].set_yscale("symlog", linthresh=1.0)
    axes[0, 0].set_ylim(-0.5, 4e4)
    axes[1, 0].set_yscale("symlog", linthresh=1e3)
    axes[1, 0].set_ylim(-1e3, 2e7)
    axes[1, 0].set_yticks([0.0, *10.0 ** np.arange(3, 8)])
    dress(axes[0, 0], "", "change of capacitance [fF]", "It comes nearer, and leaves")
    dress(axes[0, 1], "", "", "It presses, holds, and lets go")
    dress(axes[1, 0], "distance from the pad [mm]", "change of code [counts of the FDC1004]")
    dress(axes[1, 1], "force [N]")
    axes[0, 0].legend(loc="upper left", ncols=2, **LEGEND)
    axes[1, 0].legend(loc="upper left", ncols=2, **LEGEND)
    figure.savefig(folder / "touch_approach.png", dpi=110)


def main(folder: Path, sim: cs.Simulator | None = None) -> Record:
    """Play it, draw it, and check it."""
    record = play(sim or cs.Simulator("dual_pad"))
    draw(record, folder)
    print("force [N]   felt by 'press' [N]   compression [mm]   left [fF]   press [fF]")
    for k in np.searchsorted(record.time, np.linspace(0.0, CUES[-1] - 0.1, 17)):
        print(
            f"{record.force[k]:9.2f} {record.felt[k]:21.2f} {record.compression[k] * 1e3:18.3f}"
            f" {record.delta[k, 0] * 1e15:11.2f} {record.delta[k, 1] * 1e15:12.2f}"
        )
    check(record)
    return record


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the plot")
    main(parser.parse_args().folder)
