"""Charts of signals, the matrix as a heat map, and controls of the plane of potentials."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense._style import COLOURS
from capsense.reading import Touch
from capsense.scenario import Channel
from capsense.viewer.appearance import CHARGE_DECADES, charge_colours
from capsense.viewer.plane import AXES, OCTAVES, Plane, palette, region
from capsense.viewer.player import Playback

if TYPE_CHECKING:
    from viser import GuiApi, GuiTabHandle, GuiUplotHandle


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


STYLE = "<style>.uplot, .uplot .u-wrap { min-width: 100% }</style>"
"""Charts are as wide as their part of the page before they have measured that."""


class Chart:
    """The strongest of some channels against time, as changes in femtofarads.

    The chart itself stays; where there are more channels than lines, the lines are handed over to
    channels that become stronger, and a legend above tells which they show.

    Args:
        gui: Where it is drawn, together with ``tab``.
        tab: The part of the page it is in.
        title: Above it.
        columns: The channels' columns in the table of changes.
        labels: Their names.
    """

    def __init__(
        self, gui: GuiApi, tab: GuiTabHandle, title: str, columns: Sequence[int],
        labels: Sequence[str],
    ) -> None:  # fmt: skip
        self._columns, self._labels = np.array(columns), labels
        self._peaks = np.zeros(len(columns))
        self._drawn = np.arange(min(MAX_LINES, len(columns)))
        every = len(self._drawn) == len(columns)
        lines = [
            {"label": labels[n] if every else f"{n + 1}", "stroke": COLOURS[n], "width": 1.6}
            for n in range(len(self._drawn))
        ]
        series: Any = ({"label": "s"}, *lines)
        with tab:
            self._legend = None if every else gui.add_html("")
            self._handle: GuiUplotHandle = gui.add_uplot(
                (np.array([0.0, 1.0]), *np.zeros((len(self._drawn), 2))), series, title=title,
                height=190, scales={"x": {"time": False}, "y": {"auto": True}},
                axes=({"label": "s", "labelSize": 16, "size": 28}, {"size": 52}),
                legend={"show": every, "live": False},
            )  # fmt: skip
        self._name_lines()

    def show(self, times: Array, changes: Array) -> None:
        """Draw samples, as :func:`strip` gives them: times [s], changes of all channels [F]."""
        values = changes[:, self._columns]
        self._peaks = np.maximum(self._peaks, np.abs(values).max(axis=0))
        drawn = handed_over(self._drawn, self._peaks)
        if not np.array_equal(drawn, self._drawn):
            self._drawn = drawn
            self._name_lines()
        lines = np.ascontiguousarray(FEMTO * values[:, drawn].T)
        self._handle.data = (np.ascontiguousarray(times), *lines)

    def _name_lines(self) -> None:
        if self._legend is not None:
            self._legend.content = line_legend([self._labels[int(k)] for k in self._drawn])


def handed_over(drawn: NDArray[np.intp], peaks: Array) -> NDArray[np.intp]:
    """Which channels lines show: the strongest, each of them with the line that it has already.

    Args:
        drawn: The channels shown so far, shape (n,).
        peaks: Largest change of each channel, shape (k,).
    """
    strongest = np.argsort(-peaks, kind="stable")[: len(drawn)]
    out = drawn.copy()
    out[~np.isin(drawn, strongest)] = strongest[~np.isin(strongest, drawn)]
    return out


def line_legend(labels: Sequence[str]) -> str:
    """Names of a chart's lines in their colours, as HTML."""
    marks = "".join(
        f'<span style="white-space:nowrap;margin-right:0.8em"><span style="color:{colour}">&#9632;'
        f"</span> {html.escape(label)}</span>"
        for label, colour in zip(labels, COLOURS, strict=False)
    )
    return (
        '<div class="lines" style="padding:0.3em 0.8em 0;font-size:11px;display:flex;'
        'flex-wrap:wrap;justify-content:center">'
        f"{marks}</div>"
    )


def make_charts(gui: GuiApi, tab: GuiTabHandle, channels: Sequence[Channel]) -> list[Chart]:
    """One chart of the electrodes' own channels, one of the pairs', as far as there are any."""
    charts = []
    for title, wanted in (("electrodes, ΔC [fF]", True), ("pairs, ΔC [fF]", False)):
        columns = [k for k, c in enumerate(channels) if (c.row == c.column) == wanted]
        if columns:
            charts.append(Chart(gui, tab, title, columns, [channels[k].label for k in columns]))
    return charts


def strip(times: Array, changes: Array) -> tuple[Array, Array]:
    """The end of a history, as charts show it.

    Args:
        times: Of samples [s], increasing, shape (n,), at least one.
        changes: Of their channels [F], shape (n, K).

    Returns:
        At most :data:`MAX_POINTS` samples of the last :data:`WINDOW` seconds, the last one among
        them; the only one twice, since a chart needs two.
    """
    recent = np.arange(np.searchsorted(times, times[-1] - WINDOW), len(times))
    kept = recent[:: -max(1, -(-len(recent) // MAX_POINTS))][::-1]
    if len(kept) == 1:
        return times[-1] + np.array([0.0, 0.1]), changes[[-1, -1]]
    return times[kept], changes[kept]


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
        f'<table class="matrix" style="{style}"><tr>{head}</tr>{"".join(rows)}</table></div>'
    )


def touch_table(names: Sequence[str], touch: Touch, limit: float) -> str:
    """What is pressed onto the cover above each electrode, as an HTML table with bars.

    Args:
        names: Of the electrodes.
        touch: What a reading tells.
        limit: Largest compression of the cover [m], which is a whole bar.
    """
    rows = []
    for name, force, depth in zip(names, touch.force, touch.compression, strict=True):
        bar = (
            f'<div style="background:rgba(213,94,0,0.75);height:0.8em;border-radius:2px;'
            f'width:{100 * min(depth / limit, 1.0):.1f}%"></div>'
        )
        rows.append(
            f'<tr><th style="text-align:left">{html.escape(name)}</th><td>{force:.3g} N</td>'
            f'<td style="padding-left:1em">{1e3 * depth:.2f} mm</td>'
            f'<td style="width:45%;padding-left:0.6em">{bar}</td></tr>'
        )
    style = "width:100%;border-collapse:collapse;font-size:11px;text-align:right;line-height:1.7"
    return (
        '<div style="padding:0 0.6em 0.6em"><div style="font-size:13px;text-align:center">'
        f"touch: force (arrows) and compression, {touch.total:.3g} N in total</div>"
        f'<table class="touch" style="{style}">{"".join(rows)}</table></div>'
    )


def _cell(value: float, largest: float, *, numbers: bool) -> str:
    red = "213,94,0" if value > 0 else "0,114,178"
    text = f"{FEMTO * value:.3g}" if numbers else "&nbsp;"
    share = (abs(value) / largest) ** 0.5
    return f'<td style="background:rgba({red},{share:.2f});padding:0 3px">{text}</td>'


class PlaneControls:
    """Which plane, and whose potential."""

    def __init__(self, gui: GuiApi, player: Playback) -> None:
        assert player.source.green is not None
        self._player, self._green = player, player.source.green
        design = player.source.design
        self._names = design.electrode_names
        self._region = region(design)
        self._centres = [1e3 * e.surface.bounds.mean(axis=0) for e in design.electrodes]
        self._plane: Plane | None = None
        middle = np.mean(self._centres, axis=0)
        first = int(np.argmin(np.linalg.norm(self._centres - middle, axis=1).round(3)))
        with gui.add_folder("potential"):
            self._on = gui.add_checkbox("shown", True)
            self._charge = None if player.live else gui.add_checkbox("charge on the bodies", True)
            self._driven = gui.add_dropdown("1 V at", self._names, initial_value=self._names[first])
            self._across = gui.add_dropdown("plane across", AXES, initial_value="y")
            self._at: list[Any] = [
                gui.add_slider(f"{a} [mm]", low, high, 0.5, place, visible=a == "y")
                for a, (low, high), place in zip(
                    AXES, np.round(1e3 * self._region, 1).tolist(), self._places(), strict=True
                )
            ]
            gui.add_html(legend() if player.live else legend() + charge_legend())
        self._lay()
        self._on.on_update(self._ask)
        self._driven.on_update(self._centre)
        self._across.on_update(lambda _: self._lay())
        for slider in self._at:
            slider.on_update(lambda _: self._lay())

    @property
    def driven(self) -> int:
        """Number of the electrode at 1 V."""
        return self._names.index(self._driven.value)

    @property
    def charge(self) -> bool:
        """Whether charges are wanted, too."""
        return bool(self._charge is not None and self._charge.value and self._on.value)

    @property
    def plane(self) -> Plane | None:
        """The plane; None where it is not wanted."""
        return self._plane if self._on.value else None

    def _places(self) -> list[float]:
        """Where planes cross the middle of the driven electrode, or 20 mm above it [mm]."""
        x, y, z = self._centres[self.driven]
        return [round(2 * v) / 2 for v in (x, y, min(z + 20.0, 1e3 * self._region[2, 1]))]

    def _centre(self, _: object) -> None:
        for slider, place in zip(self._at, self._places(), strict=True):
            slider.value = place
        self._lay()

    def _lay(self) -> None:
        axis = AXES.index(self._across.value)
        for k, slider in enumerate(self._at):
            if slider.visible != (k == axis):
                slider.visible = k == axis
        at = 1e-3 * float(self._at[axis].value)
        if self._plane is None or (self._plane.axis, self._plane.at) != (axis, at):
            self._plane = Plane(self._green, self._region, axis, at)
            self._ask()

    def _ask(self, _: object = None) -> None:
        """Tell the player where potentials are wanted, and to take them while time stands still."""
        self._player.plane = self.plane
        if self._player.plane is not None and not self._player.playing:
            self._player.pause()


def legend() -> str:
    """The colours of the potential, as HTML."""
    cells = "".join(
        f'<td style="background:rgb({r},{g},{b})">&nbsp;</td>' for r, g, b in palette().tolist()
    )
    return (
        '<div style="padding:0 0.8em 0.6em;font-size:12px"><table style="width:100%;'
        f'border-spacing:0;line-height:0.8"><tr>{cells}</tr></table><span style="float:right">1 V'
        f"</span>{1e3 * 2.0**-OCTAVES:.0f} mV, doubling from line to second next</div>"
    )


def charge_legend() -> str:
    """The colours of charges on the bodies, as HTML."""
    shares = np.linspace(0.0, 1.0, 16)
    cells = "".join(
        f'<td style="background:rgb({r},{g},{b})">&nbsp;</td>'
        for r, g, b in charge_colours(shares).tolist()
    )
    return (
        '<div class="charges" style="padding:0 0.8em 0.6em;font-size:12px"><table style="width:'
        f'100%;border-spacing:0;line-height:0.8"><tr>{cells}</tr></table><span style="float:right">'
        f"the densest</span>charge: {10.0**-CHARGE_DECADES:g} of</div>"
    )
