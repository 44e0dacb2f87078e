"""What a pad over its own ground plane reads as that ground floats, on a robot or on a battery.

Run it: ``python examples/floating_ground.py [FOLDER]``. A hand, a box of 0.1 x 0.1 x 0.02 m, is
20 mm above the pad of ``examples/designs/pad_over_ground.toml``. Its readings are drawn over the
capacitance C_g from the local ground to earth; the plot goes to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import capsense as cs
from capsense._style import COLOURS, LEGEND, dress
from capsense.design.geometry import Surface, box_facets
from capsense.design.model import Conductor, Role
from capsense.scene import Ties

DESIGN = Path(__file__).with_name("designs") / "pad_over_ground.toml"
TIES = np.logspace(-13, -9, 25)
"""Capacitances from the local ground to earth [F]."""
SHOWN = (0.0, 1e-12, 10e-12, 100e-12, 1e-9, None)
"""Those of the table; None is an earthed ground."""
REFERENCE = (0.2864, 0.4851, 1.6071, 2.8022, None, 3.0620)
"""What boundary elements of pad, plane and earthed hand together give [pF]; see
``tests/e2e/solver/test_floating_ground.py``."""
HANDS = {
    "hand on earth": "grounded",
    "person on 100 pF": 100e-12,
    "hand that floats": "floating",
    "person on 100 pF holds the robot": Ties(earth=100e-12, local=1e-9),
}
"""Groundings of the hand."""
ARM = np.array([[-0.04, -0.04, -0.45], [0.04, 0.04, -0.01]])
"""Corners of the arm that carries the sensor, 7 mm below its plane [m]."""


def hand(grounding: object) -> cs.Body:
    """The hand, 20 mm above the pad."""
    return cs.Body(cs.Box((0.1, 0.1, 0.02)), cs.Pose((0.0, 0.0, 0.03)), grounding=grounding)


def on(design: cs.Design, tie: float | None) -> cs.Simulator:
    """A sensor whose local ground is on a capacitance to earth [F]; None: on earth."""
    grounding = "grounded" if tie is None else "floating" if tie == 0.0 else tie
    return cs.Simulator(design.with_grounding(grounding), preset="fine")


def change(sim: cs.Simulator, grounding: object) -> float:
    """What the hand changes in the self capacitance, the guard driven along [F]."""
    there = sim.step(cs.Scene([hand(grounding)])).self_capacitance[0]
    return float(there - sim.empty.self_capacitance[0])


def readings(design: cs.Design) -> dict[str, np.ndarray]:
    """Changes at the capacitances of the table [F], by what is in the scene."""
    arm = Conductor("arm", Role.GROUND, Surface(box_facets(*ARM), np.empty((0, 2, 3))))
    carried = replace(design, conductors=(*design.conductors, arm))
    guarded = replace(design, conductors=tuple(
        replace(conductor, role=Role.SHIELD) for conductor in design.conductors
    ))  # fmt: skip
    names = (*HANDS, "hand on earth, sensor on an arm", "hand on earth, plane as guard")
    rows: dict[str, list[float]] = {name: [] for name in names}
    for tie in SHOWN:
        sim = on(design, tie)
        for name, grounding in HANDS.items():
            rows[name].append(change(sim, grounding))
        for name, other in zip(names[len(HANDS) :], (carried, guarded), strict=True):
            rows[name].append(change(on(other, tie), "grounded"))
    return {name: np.array(row) for name, row in rows.items()}


def curves(design: cs.Design) -> dict[str, np.ndarray]:
    """Changes over :data:`TIES` [F], by the hand's grounding."""
    sims = [on(design, float(tie)) for tie in TIES]
    return {n: np.array([change(sim, g) for sim in sims]) for n, g in HANDS.items()}


def share_left(design: cs.Design, share: float) -> float:
    """Capacitance to earth at which a share of the signal of an earthed ground is left [F]."""
    full = change(on(design, 1e-3), "grounded")
    low, high = 1e-14, 1e-8
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (
            (low, middle)
            if change(on(design, middle), "grounded") > share * full
            else (middle, high)
        )
    return middle


def check(found: dict[str, np.ndarray]) -> None:
    """It falls by ten where both float; a person who holds the robot is on its ground."""
    grounded = found["hand on earth"]
    assert np.all(np.diff(grounded[:-1]) > 0.0), "the more capacitance to earth, the more"
    assert grounded[-1] > 9.0 * grounded[0], "ten times less on a battery"
    for value, reference in zip(grounded, REFERENCE, strict=True):
        assert reference is None or abs(1e12 * value / reference - 1.0) < 0.03
    held = found["person on 100 pF holds the robot"]
    assert held.min() > 0.95 * held[-1], "who holds the robot is on its ground"
    arm, guard = list(found.values())[len(HANDS) :]
    assert arm[0] > 2.0 * grounded[0], "an arm has a capacitance to earth"
    assert guard[0] < 1e-3 * grounded[0], "a guard alone has nothing to drive against"


def draw(found: dict[str, np.ndarray], folder: Path) -> None:
    """Write ``floating_ground.png``."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for (name, values), colour in zip(found.items(), COLOURS, strict=False):
        axes.plot(1e12 * TIES, 1e12 * values, color=colour, lw=1.6, label=name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.1, 6.0)
    axes.set_yticks([0.1, 0.2, 0.5, 1.0, 2.0, 5.0], ["0.1", "0.2", "0.5", "1", "2", "5"])
    axes.set_yticks([], minor=True)
    axes.set_xticks([0.1, 1.0, 10.0, 100.0, 1000.0], ["0.1", "1", "10", "100", "1000"])
    dress(axes, "C_g, from the local ground to earth [pF]", "change by the hand [pF]")
    axes.legend(loc="lower right", **LEGEND)
    figure.savefig(folder / "floating_ground.png", dpi=110)


def main(folder: Path, design: cs.Design | None = None) -> dict[str, np.ndarray]:
    """Read, print, draw and check."""
    design = design or cs.load_design(DESIGN)
    found = readings(design)
    head = ["floating" if t == 0.0 else "earthed" if t is None else f"{1e12 * t:g} pF"
            for t in SHOWN]  # fmt: skip
    print(f"{'change by the hand [pF], C_g:':36}" + "".join(f"{text:>10}" for text in head))
    for name, values in found.items():
        print(f"{name:36}" + "".join(f"{1e12 * value:10.3f}" for value in values))
    print(f"{'boundary elements, hand on earth':36}" + "".join(
        f"{'' if value is None else f'{value:.3f}':>10}" for value in REFERENCE
    ))  # fmt: skip
    board = on(design, 0.0).background.capacitance.sum()
    print(f"pad and plane together have {1e12 * board:.2g} pF to earth")
    for share in (0.5, 0.9):
        print(
            f"{share:.0%} of the signal is left at C_g = {1e12 * share_left(design, share):.2g} pF"
        )
    draw(curves(design), folder)
    check(found)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the plot")
    main(parser.parse_args().folder)
