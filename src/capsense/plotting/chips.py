"""One channel as it is, and as each chip reports it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from capsense._style import COLOURS, FAINT, INK, LABELS, LEGEND, TITLES, bare
from capsense.errors import ReadoutError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from capsense.readout.readout import Readout
    from capsense.readout.recording import CapacitanceRecord

Array = NDArray[np.float64]
SELF_COLOUR, MUTUAL_COLOUR, OUTSIDE = COLOURS[0], COLOURS[2], COLOURS[3]
LINEAR_BELOW = 1.0
"""Changes below this are drawn on a linear scale, those above on a logarithmic one [fF]."""


def plot_chips(
    recording: CapacitanceRecord, readouts: dict[str, Readout], electrode: str | None = None
) -> Figure:
    """Draw the change of one channel against the empty scene: true, and read out by each chip.

    Args:
        recording: The capacitances.
        readouts: Readouts by name.
        electrode: The electrode shown: its self capacitance, or its first pair; default the
            first electrode.

    Raises:
        ReadoutError: No channel of a readout has the electrode.
    """
    name = recording.electrodes[0] if electrode is None else electrode
    columns = min(3, len(readouts) + 1)
    rows = -(-(len(readouts) + 1) // columns)
    figure = Figure(figsize=(4.0 * columns, 2.6 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels = list(grid.flat)
    shown: dict[str, tuple[Array, str]] = {}
    for axes, readout in zip(panels[1:], readouts.values(), strict=False):
        k = _channel_of(readout, name)
        truth = recording.channels(readout.bank)
        empty = float(recording.empty_channels(readout.bank)[k])
        colour = SELF_COLOUR if readout.bank.patterns[k].is_self else MUTUAL_COLOUR
        change = 1e15 * (truth[:, k] - empty) * (1 if colour == SELF_COLOUR else -1)
        shown[readout.channel_names[k]] = (change, colour)
        _draw_chip(axes, readout, k, recording, truth, empty, colour)
    _draw_truth(panels[0], recording.time, shown)
    for axes in panels:
        axes.set_yscale("symlog", linthresh=LINEAR_BELOW, linscale=0.6)
        bare(axes)
    for axes in panels[len(readouts) + 1 :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("change [fF]", **LABELS)
    for column in range(columns):
        lowest = max(r for r in range(rows) if r * columns + column <= len(readouts))
        grid[lowest, column].set_xlabel("time [s]", **LABELS)
        grid[lowest, column].tick_params(labelbottom=True)
    return figure


def _channel_of(readout: Readout, electrode: str) -> int:
    """The first channel that reads an electrode, or drives it."""
    for number, pattern in enumerate(readout.bank.patterns):
        if electrode == pattern.sense or electrode in pattern.drive:
            return number
    raise ReadoutError(
        f"no channel of {readout.name} has the electrode {electrode!r}; channels are "
        f"{', '.join(readout.channel_names)}"
    )


def _draw_truth(axes: Axes, time: Array, shown: dict[str, tuple[Array, str]]) -> None:
    for label, (change, colour) in shown.items():
        what = "fall, mutual" if colour == MUTUAL_COLOUR else "rise, self"
        axes.plot(time, change, color=colour, lw=1.6, label=f"{label} ({what})")
    axes.legend(loc="lower center", **LEGEND)
    axes.set_title("true capacitance", **TITLES)


def _draw_chip(
    axes: Axes, readout: Readout, channel: int, recording: CapacitanceRecord, truth: Array,
    empty: float, colour: str,
) -> None:  # fmt: skip
    sign = 1 if readout.bank.patterns[channel].is_self else -1
    counts = readout(recording.time, truth)
    one = counts[counts.channel == channel]
    change = 1e15 * sign * (one.capacitance - empty)
    axes.plot(recording.time, 1e15 * sign * (truth[:, channel] - empty), color=FAINT, lw=1.4)
    style: dict[str, Any] = {"ls": "", "marker": ".", "zorder": 3}
    inside = ~one.saturated
    size = 2.5 if len(one) > 100 else 4.0
    axes.plot(one.time[inside], change[inside], color=colour, ms=size, mew=0, **style)
    if not inside.all():
        axes.plot(one.time[~inside], change[~inside], color=OUTSIDE, ms=3, mew=0, **style)
        axes.annotate("out of range", (0.98, 0.05), xycoords="axes fraction", ha="right",
                      fontsize=8, color=OUTSIDE)  # fmt: skip
    axes.set_title(readout.name, **TITLES)
    rate = 1 / readout.schedule.period
    axes.set_title(f"{rate:.3g} samples/s", fontsize=8, color=INK, loc="right")
