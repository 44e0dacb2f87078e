"""The limb approach's picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsense._style import COLOURS, DASHES, INK, LEGEND, dress
from capsense.reproduce.limb_curves import (
    BOXES,
    FITS,
    GROUNDINGS,
    MAIN,
    SIZES,
    LimbCurves,
    LimbSetup,
    counts,
)


def plot_approach(
    cases: Mapping[LimbSetup, LimbCurves], boxes: Mapping[LimbSetup, LimbCurves]
) -> Figure:
    """Curves against distance: by electrode, as counts and as capacitance; by grounding; by box."""
    figure = Figure(figsize=(9.6, 8.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for setup, found in cases.items():
        style = {"ls": _line(setup), "color": COLOURS[SIZES.index(setup.size)]}
        label = f"{setup.size * 1e3:.0f} mm, {setup.backing}"
        code = counts(*found.readings())
        axes[0].plot(1e2 * found.distance, np.where(code > 0, code, np.nan), label=label, **style)
        axes[1].plot(1e2 * found.distance, 1e15 * found.change(), label=label, **style)
    _groundings(axes[2], next(iter(cases.values())))
    for setup, found in boxes.items():
        axes[3].plot(
            1e2 * found.distance, 1e15 * found.change(tared=False), ls=_line(setup),
            color=COLOURS[BOXES.index(setup.box)], label=f"{setup.box:g} m, {setup.backing}",
        )  # fmt: skip
    titles = (
        "counts of an AD7147; limb grounded, 40 mm", "electrode; limb grounded, 40 mm",
        "path to ground; 30 mm free", "box; 30 mm, limb away as tare",
    )  # fmt: skip
    for k, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        axis.set(xscale="log", yscale="log", xlim=(0.1, 15))
        upwards = "change of capacitance [fF]" if k else "tared counts"
        dress(axis, "distance [cm]" if k > 1 else "", upwards, title)
        axis.set_xticks([0.1, 0.3, 1, 3, 6, 15], labels=["0.1", "0.3", "1", "3", "6", "15"])
        axis.minorticks_off()
        axis.legend(loc="lower left", **LEGEND)
    return figure


def _groundings(axis: Axes, found: LimbCurves) -> None:
    """Limbs tied to ground in several ways; the hardware's fits, laid on the grounded one."""
    z, change = found.distance, found.change()
    for name, colour in zip(GROUNDINGS, COLOURS, strict=False):
        axis.plot(1e2 * z, 1e15 * found.change(MAIN, name), color=colour, label=name)
    meet = 0.03  # where the hardware's curves are laid on ours
    scale = float(np.interp(meet, z, change))
    for (name, (k, b)), line in zip(FITS.items(), (":", "--", "-."), strict=True):
        fit = k / z - b
        seen = np.where((fit > 0) & (z > 0.009), fit * scale / (k / meet - b), np.nan)
        axis.plot(1e2 * z, 1e15 * seen, color=INK, lw=1, ls=line, label=f"hardware, {name}")


def _line(setup: LimbSetup) -> Any:
    return DASHES[setup.backing != "free"]
