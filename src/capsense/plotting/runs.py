"""Pictures of runs: signals against time, and the bodies' way over the electrodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import ArrayLike, NDArray

from capsense._style import (
    COLOURS,
    DASHES,
    FAINT,
    INK,
    LABELS,
    LEGEND,
    TIME_COLOURS,
    bare,
    style_of,
    unit_of,
)
from capsense.design.model import Design
from capsense.errors import CapSenseError
from capsense.plotting.designs import draw_design
from capsense.plotting.views import draw_views
from capsense.reading import Reading
from capsense.recording.export import run_of
from capsense.recording.reader import Recording
from capsense.recording.tables import Run
from capsense.scenario import Excitation
from capsense.scenario.model import channels_of
from capsense.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from capsense.simulator import Simulator

Array = NDArray[np.float64]

PLAIN_ELECTRODE = "#c08a3e"
MAX_LINES = 8
"""So many lines of a family are coloured; the rest, the weakest, stay grey."""


@dataclass(frozen=True)
class _Family:
    """Signals that share a pair of axes."""

    title: str
    labels: list[str]
    styles: list[tuple[str, Any]]
    values: Array
    """Capacitance [F], shape (n, k)."""
    levels: Array
    """The same with nothing in front of the sensor [F], shape (k,)."""


def plot(
    what: Design | Recording | Sequence[Reading],
    simulator: Simulator | None = None,
    *,
    times: ArrayLike | None = None,
    scenes: Sequence[Scene] | None = None,
    excitation: Excitation | str = Excitation.MATRIX,
) -> Figure:
    """Draw a design, a recording, or readings: ``cs.plot(design).savefig("design.png")``.

    Args:
        what: A design; an open recording; or the readings of a run, n of them.
        simulator: With readings: the simulator that took them.
        times: With readings: their times [s], shape (n,); by default their numbers.
        scenes: With readings: what the simulator was given, n scenes, to show the bodies' ways.
        excitation: With readings: the signals shown, ``"matrix"``, ``"self"`` or ``"mutual"``.

    Returns:
        The figure. A run's shows signals relative to the empty scene and as changes in farads;
        beside them the bodies' ways over the electrodes, from above and from the side.

    Raises:
        CapSenseError: There is no reading, readings come without their simulator, or times or
            scenes are not as many.
    """
    if isinstance(what, Design):
        return cast(Figure, draw_design(what).figure)
    if isinstance(what, Recording):
        run = run_of(what, list(what.steps()))
    else:
        if simulator is None:
            raise CapSenseError("readings are drawn with their simulator; give plot(readings, sim)")
        design, count = simulator.design, len(what)
        moments = np.arange(count) if times is None else np.asarray(times, dtype=float)
        seen = [Scene()] * count if scenes is None else scenes
        if moments.shape != (count,) or len(seen) != count:
            raise CapSenseError(
                f"{count} readings, times of shape {moments.shape} and {len(seen)} scenes; give as "
                "many of each"
            )
        channels = channels_of(Excitation(excitation), design.electrode_names)
        run = Run(
            design.name, design, channels, simulator.empty, (), moments.tolist(), list(what),
            list(seen),
        )  # fmt: skip
    if not run.times:
        raise CapSenseError("there is no reading to draw; take a step first")
    return plot_run(run)


def plot_run(run: Run) -> Figure:
    """Draw a run; see :func:`plot`."""
    families = _families(run)
    columns = len(families)
    figure = Figure(figsize=(4.4 * columns + 4.4, 7.0), layout=ConstrainedLayoutEngine(w_pad=0.1))
    grid = figure.add_gridspec(2, columns + 1, width_ratios=[1.0] * columns + [0.95])
    peak = _strongest(run)
    shared: Axes | None = None
    for column, family in enumerate(families):
        upper = figure.add_subplot(grid[0, column], sharex=shared)
        shared = shared or upper
        lower = figure.add_subplot(grid[1, column], sharex=shared)
        _draw_family(family, np.array(run.times), peak, upper, lower)
    colours = [style_of(k)[0] for k in range(len(run.design.electrodes))]
    if run.channels[0].excitation is Excitation.MUTUAL:
        colours = [PLAIN_ELECTRODE] * len(colours)
    views = [figure.add_subplot(grid[row, columns]) for row in range(2)]
    draw_views(run, peak, colours, views[0], views[1])
    figure.suptitle(run.title, fontsize=13, fontweight="bold", color=INK)
    return figure


def _families(run: Run) -> list[_Family]:
    channels = run.channels
    selves = [k for k, c in enumerate(channels) if c.row == c.column]
    pairs = [k for k, c in enumerate(channels) if c.row != c.column]
    out = []
    if selves:
        matrix = channels[selves[0]].excitation is Excitation.MATRIX
        shown = [channels[k] for k in selves]
        title = "diagonal of the matrix" if matrix else "self capacitance"
        styles = [style_of(c.row) for c in shown]
        labels = [c.label for c in shown]
        out.append(_Family(title, labels, styles, run.values[:, selves], run.levels[selves]))
    if pairs:
        # A pair's capacitance is positive, whatever the sign of its entry in the matrix.
        sign = -1.0 if channels[pairs[0]].excitation is Excitation.MATRIX else 1.0
        values, levels = sign * run.values[:, pairs], sign * run.levels[pairs]
        rank = np.argsort(-np.abs(values - levels).max(axis=0), kind="stable")
        order = [*sorted(rank[:MAX_LINES].tolist()), *rank[MAX_LINES:].tolist()]
        shown = [channels[pairs[k]] for k in order]
        # Colours for the strongest pairs, dashed in turns so that neighbours differ twice.
        styles = [(COLOURS[k], DASHES[k % 2]) for k in range(min(len(shown), MAX_LINES))]
        styles += [(FAINT, "-")] * (len(shown) - len(styles))
        labels = [c.label for c in shown]
        out.append(_Family("mutual capacitance", labels, styles, values[:, order], levels[order]))
    return out


def _strongest(run: Run) -> int:
    """The sample with the largest relative change; the middle one where it stays that large."""
    scale = np.maximum(np.abs(run.levels), 1e-18)
    change = (np.abs(run.values - run.levels) / scale).max(axis=1)
    first = int(np.argmax(change))
    below = np.flatnonzero(change[first:] < 0.995 * change[first])
    last = first + int(below[0]) - 1 if len(below) else len(change) - 1
    above = np.flatnonzero(change[:first] < 0.995 * change[first])
    start = int(above[-1]) + 1 if len(above) else 0
    return (start + last) // 2


def _draw_family(family: _Family, times: Array, peak: int, upper: Axes, lower: Axes) -> None:
    changes = family.values - family.levels
    factor, unit = unit_of(float(np.abs(changes).max(initial=0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(family.levels != 0, family.values / family.levels, np.nan)
    marker = "o" if len(times) < 3 else ""
    for axes, signals in ((upper, relative), (lower, factor * changes)):
        for k in range(signals.shape[1] - 1, -1, -1):
            colour, dash = family.styles[k]
            strong = k < MAX_LINES or colour != FAINT
            axes.plot(
                times, signals[:, k], color=colour, ls=dash, marker=marker,
                lw=1.6 if strong else 0.8, zorder=3 if strong else 2, label=family.labels[k],
            )  # fmt: skip
        if len(times) > 1:
            axes.axvline(times[peak], color=INK, lw=0.7, ls=":", zorder=1)
        bare(axes)
        axes.margins(x=0.01)
    lines = upper.get_lines()[: len(family.labels)][::-1]
    entries = [
        (line, label)
        for line, label, style in zip(lines, family.labels, family.styles, strict=True)
        if style[0] != FAINT
    ]
    rest = len(lines) - len(entries)
    if rest:
        entries.append((lines[-1], f"{rest} others"))
    upper.legend(
        *zip(*entries, strict=True), loc="lower left", bbox_to_anchor=(-0.02, 1.0),
        ncols=5 if len(entries) > 6 else 6, handlelength=1.4, columnspacing=0.8, title=family.title,
        alignment="left", title_fontproperties={"size": 10, "weight": "bold"}, **LEGEND,
    )  # fmt: skip
    upper.set_ylabel("relative to the empty scene", **LABELS)
    upper.tick_params(labelbottom=False)
    lower.set_ylabel(f"change from the empty scene [{unit}]", **LABELS)
    lower.set_xlabel("time [s]", **LABELS)
    if len(times) > 1:
        _time_strip(lower, times)


def _time_strip(axes: Axes, times: Array) -> None:
    """Colours of time along the bottom, as they are used for the way."""
    low, high = axes.get_ylim()
    height = 0.025 * (high - low)
    place = (times[0], times[-1], low - height, low)
    colours = np.linspace(0, 1, 256)[None]
    axes.imshow(colours, cmap=TIME_COLOURS, aspect="auto", extent=place, zorder=0)
    axes.set_ylim(low - height, high)
