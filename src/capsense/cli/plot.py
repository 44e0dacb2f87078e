"""The picture of a run: signals against time, and the bodies' way over the electrodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from capsense._style import (
    COLOURS,
    DASHES,
    FAINT,
    INK,
    LABELS,
    TIME_COLOURS,
    bare,
    style_of,
    unit_of,
)
from capsense.cli.plot_views import draw_views
from capsense.cli.recorder import RunWriter
from capsense.scenario import Channel, Excitation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

PLAIN_ELECTRODE = "#c08a3e"
MAX_LINES = 8
"""So many lines of a family are coloured; the rest, the weakest, stay grey."""


@dataclass(frozen=True)
class _Family:
    """Signals that share a pair of axes."""

    title: str
    symbol: str
    labels: list[str]
    styles: list[tuple[str, Any]]
    values: Array
    """Capacitance [F], shape (n, k)."""
    levels: Array
    """The same with nothing in front of the sensor [F], shape (k,)."""


def plot_run(recorder: RunWriter) -> Figure:
    """Draw a run.

    Args:
        recorder: A run of at least one sample.

    Returns:
        Each family of signals relative to the empty scene and as a change in farads; beside
        them the bodies' way over the electrodes, from above and from the side.
    """
    scenario = recorder.scenario
    families = _families(recorder)
    columns = len(families)
    figure = Figure(figsize=(4.4 * columns + 4.4, 7.0), layout=ConstrainedLayoutEngine(w_pad=0.1))
    grid = figure.add_gridspec(2, columns + 1, width_ratios=[1.0] * columns + [0.95])
    peak = _strongest(recorder)
    shared: Axes | None = None
    for column, family in enumerate(families):
        upper = figure.add_subplot(grid[0, column], sharex=shared)
        shared = shared or upper
        lower = figure.add_subplot(grid[1, column], sharex=shared)
        _draw_family(family, recorder.times, peak, upper, lower)
    colours = [style_of(k)[0] for k in range(len(scenario.design.electrodes))]
    if scenario.excitation is Excitation.MUTUAL:
        colours = [PLAIN_ELECTRODE] * len(colours)
    views = [figure.add_subplot(grid[row, columns]) for row in range(2)]
    draw_views(recorder, peak, colours, views[0], views[1])
    figure.suptitle(scenario.name, fontsize=13, fontweight="bold", color=INK)
    return figure


def _families(recorder: RunWriter) -> list[_Family]:
    channels = recorder.scenario.channels
    selves = [k for k, c in enumerate(channels) if c.row == c.column]
    pairs = [k for k, c in enumerate(channels) if c.row != c.column]
    out = []
    if selves:
        matrix = channels[selves[0]].excitation is Excitation.MATRIX
        out.append(
            _Family(
                "diagonal of the matrix" if matrix else "self capacitance",
                "C",
                [channels[k].label for k in selves],
                [style_of(channels[k].row) for k in selves],
                recorder.values[:, selves],
                recorder.levels[selves],
            )
        )
    if pairs:
        # A pair's capacitance is positive, whatever the sign of its entry in the matrix.
        sign = -1.0 if channels[pairs[0]].excitation is Excitation.MATRIX else 1.0
        values, levels = sign * recorder.values[:, pairs], sign * recorder.levels[pairs]
        rank = np.argsort(-np.abs(values - levels).max(axis=0), kind="stable")
        order = [*sorted(rank[:MAX_LINES].tolist()), *rank[MAX_LINES:].tolist()]
        shown = [channels[pairs[k]] for k in order]
        out.append(
            _Family(
                "mutual capacitance",
                "C",
                [c.label for c in shown],
                _pair_styles(shown),
                values[:, order],
                levels[order],
            )
        )
    return out


def _pair_styles(channels: list[Channel]) -> list[tuple[str, Any]]:
    """Colours for the strongest pairs, dashed in turns so that neighbours differ twice."""
    return [
        (COLOURS[k], DASHES[k % 2]) if k < MAX_LINES else (FAINT, "-") for k in range(len(channels))
    ]


def _strongest(recorder: RunWriter) -> int:
    """The sample with the largest relative change; the middle one where it stays that large."""
    scale = np.maximum(np.abs(recorder.levels), 1e-18)
    change = (np.abs(recorder.values - recorder.levels) / scale).max(axis=1)
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
                times,
                signals[:, k],
                color=colour,
                ls=dash,
                marker=marker,
                lw=1.6 if strong else 0.8,
                zorder=3 if strong else 2,
                label=family.labels[k],
            )
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
        *zip(*entries, strict=True),
        loc="lower left",
        bbox_to_anchor=(-0.02, 1.0),
        ncols=5 if len(entries) > 6 else 6,
        fontsize=8,
        frameon=False,
        handlelength=1.4,
        columnspacing=0.8,
        title=family.title,
        alignment="left",
        title_fontproperties={"size": 10, "weight": "bold"},
    )
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
    axes.imshow(
        np.linspace(0, 1, 256)[None],
        cmap=TIME_COLOURS,
        aspect="auto",
        extent=(times[0], times[-1], low - height, low),
        zorder=0,
    )
    axes.set_ylim(low - height, high)
