"""Strip charts of the channels, and the capacitance matrix as a heat map."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.design.draw import COLOURS
from capsense.scenario import Channel

if TYPE_CHECKING:
    from viser import GuiApi

Array = NDArray[np.float64]

WINDOW = 15.0
"""How far charts reach back [s]."""
MAX_POINTS = 600
"""More samples than that are thinned out."""
MAX_LINES = 8
"""The strongest channels so far are drawn."""
MAX_NUMBERS = 10
"""A matrix of more electrodes shows colours without numbers."""
FEMTO = 1e15


class Chart:
    """The strongest of some channels against time, as changes in femtofarads.

    Args:
        gui: Where it is drawn.
        title: Above it.
        columns: The channels' columns in the table of changes.
        labels: Their names.
    """

    def __init__(
        self, gui: GuiApi, title: str, columns: Sequence[int], labels: Sequence[str]
    ) -> None:
        self._columns, self._labels = np.array(columns), labels
        count = min(MAX_LINES, len(columns))
        self._drawn = np.arange(count)
        self._handle = gui.add_uplot(
            (np.array([0.0, 1.0]), *np.zeros((count, 2))), self._series(), title=title, height=190,
            scales={"x": {"time": False}, "y": {"auto": True}}, axes=({"label": "s"}, {"size": 48}),
            legend={"show": True, "live": False},
        )  # fmt: skip

    def show(self, times: Array, changes: Array) -> None:
        """Draw samples: times [s], shape (n,), and changes [F], shape (n, all channels)."""
        values = changes[:, self._columns]
        strongest = np.argsort(-np.abs(values).max(axis=0), kind="stable")[: len(self._drawn)]
        drawn = np.sort(strongest)
        if not np.array_equal(drawn, self._drawn):
            self._drawn = drawn
            self._handle.series = self._series()
        columns = np.ascontiguousarray(FEMTO * values[:, drawn].T)
        self._handle.data = (np.ascontiguousarray(times), *columns)

    def _series(self) -> tuple[Any, ...]:
        lines = [
            {"label": self._labels[int(k)], "stroke": COLOURS[n % len(COLOURS)], "width": 1.6}
            for n, k in enumerate(self._drawn)
        ]
        return ({"label": "s"}, *lines)


def make_charts(gui: GuiApi, channels: Sequence[Channel]) -> list[Chart]:
    """One chart of the electrodes' own channels, one of the pairs', as far as there are any."""
    charts = []
    for title, wanted in (("electrodes, ΔC [fF]", True), ("pairs, ΔC [fF]", False)):
        columns = [k for k, c in enumerate(channels) if (c.row == c.column) == wanted]
        if columns:
            charts.append(Chart(gui, title, columns, [channels[k].label for k in columns]))
    return charts


def strip(times: Array, changes: Array, position: int) -> tuple[Array, Array]:
    """The samples before one that charts show.

    Args:
        times: Of all samples [s], shape (N,).
        changes: Of all samples [F], shape (N, K), NaN where they are not known.
        position: The last one shown.

    Returns:
        Times, shape (n,), and changes, shape (n, K), of at most :data:`MAX_POINTS` known samples of
        the last :data:`WINDOW` seconds, the last known one among them.
    """
    first = int(np.searchsorted(times, times[position] - WINDOW))
    known = first + np.flatnonzero(~np.isnan(changes[first : position + 1, 0]))
    stride = -(-len(known) // MAX_POINTS)
    known = known[::-1][:: max(1, stride)][::-1]
    return times[known], changes[known]


def heat_map(names: Sequence[str], delta: Array) -> str:
    """A matrix as an HTML table: cells coloured by the square root of their size.

    Args:
        names: Of the electrodes.
        delta: Change of the Maxwell matrix [F], shape (M, M).
    """
    largest = float(np.abs(delta).max()) or 1.0
    shown = [html.escape(name) for name in names]
    numbers = len(names) <= MAX_NUMBERS
    head = "".join(f"<th>{name}</th>" for name in ("", *shown)) if numbers else ""
    rows = []
    for name, row in zip(shown, delta, strict=True):
        cells = "".join(_cell(float(v), largest, numbers=numbers) for v in row)
        rows.append(f"<tr>{f'<th>{name}</th>' if numbers else ''}{cells}</tr>")
    style = "width:100%;border-collapse:collapse;font-size:10px;text-align:right;line-height:1.7"
    return (
        '<div style="padding:0 0.6em 0.6em"><div style="font-size:13px;text-align:center">'
        "ΔC, Maxwell matrix [fF]</div>"
        f'<table style="{style}"><tr>{head}</tr>{"".join(rows)}</table></div>'
    )


def _cell(value: float, largest: float, *, numbers: bool) -> str:
    red = "213,94,0" if value > 0 else "0,114,178"
    text = f"{FEMTO * value:.3g}" if numbers else "&nbsp;"
    share = (abs(value) / largest) ** 0.5
    return f'<td style="background:rgba({red},{share:.2f});padding:0 3px">{text}</td>'
