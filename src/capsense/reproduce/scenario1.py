"""Scenario 1: a grounded steel bar on four trajectories over three boards."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsense._style import COLOURS, FAINT, INK, LABELS, LEGEND, TITLES, bare
from capsense.readout.calibration import cross_correlation
from capsense.reproduce.harness import (
    Outcome,
    Report,
    ReportTable,
    Row,
    Store,
    correlation_of_change,
    correlations,
    judged,
    notes,
    raw_correlation,
    rmse,
)
from capsense.reproduce.scenario1_setup import (
    TRIANGLE,
    ZIGZAG,
    Array,
    Board,
    Panel,
    PaperCurves,
    Scenario1Setup,
    load_curves,
    load_setup,
    matrices,
    mutual,
    normalised,
)
from capsense.simulator import Simulator

MEASURED, PAPER, OURS = INK, COLOURS[1], COLOURS[0]
WAYS = (COLOURS[2], PAPER, MEASURED)
"""Colours of the boards' ways."""


def plot_panels(panels: Mapping[str, tuple[Array, PaperCurves | None]]) -> Figure:
    """Fig. 9's panels with our curves: hardware and the paper's simulation where given, ours."""
    figure = Figure(figsize=(8.2, 2.4 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
    for ax, (name, (ours, panel)) in zip(axes, panels.items(), strict=True):
        sample = np.arange(1, len(ours) + 1)
        if panel:
            ax.plot(sample, panel.simulated, color=PAPER, lw=1.2, label="the paper's simulation")
            ax.plot(sample, panel.measured, ".", color=MEASURED, ms=3, label="hardware (the paper)")
        else:
            name += ", predicted"
        ax.plot(sample, ours, color=OURS, lw=1.6, label="CapSense")
        ax.set_title(name.replace("_", ", "), **TITLES)
        ax.set_ylabel("C / C empty", **LABELS)
        ax.set_xlim(0, len(ours) + 1)
        bare(ax)
    axes[0].legend(loc="lower right", ncols=3, bbox_to_anchor=(1, 1), **LEGEND)
    axes[-1].set_xlabel("sample", **LABELS)
    return figure


def plot_trajectories(
    setup: Scenario1Setup, curves: Mapping[tuple[str, str], tuple[Array, Array]]
) -> Figure:
    """Ways of the bar in the upper row; below, a row per board with its readings.

    Args:
        setup: The scenario.
        curves: Times [s] and normalised readings by board and trajectory.
    """
    boards = list(dict.fromkeys(board for board, _ in curves))
    ways = list(dict.fromkeys(way for _, way in curves))
    figure = Figure(figsize=(3.0 * len(ways) + 0.6, 1.2 + 2.0 * len(boards)), layout="constrained")
    axes = figure.subplots(
        len(boards) + 1, len(ways), squeeze=False, sharey="row",
        height_ratios=[0.7] + [1.0] * len(boards),
    )  # fmt: skip
    for column, way in enumerate(ways):
        _draw_way(axes[0, column], setup, boards, way)
        for row, board in enumerate(boards, start=1):
            ax = axes[row, column]
            ax.plot(*curves[board, way], color=OURS, lw=1.0)
            bare(ax)
            if column == 0:
                ax.set_ylabel(f"{board}: C / C empty", **LABELS)
        axes[-1, column].set_xlabel("time [s]", **LABELS)
    axes[0, -1].legend(loc="upper left", handlelength=1.2, **LEGEND)
    return figure


def _draw_way(ax: Axes, setup: Scenario1Setup, boards: list[str], way: str) -> None:
    """The middle of the bar's lower face on its way over each board, and the board, to scale."""
    for n, name in enumerate(boards):
        corners = [p.position for p in setup.path(name, way, 1.0).waypoints]
        points = 1e3 * np.array([*corners, corners[0]])
        height = points[:, 2] - 5e2 * setup.size[2]
        ax.plot(  # ways that are the same for two boards show both colours
            points[:, 0], height, color=WAYS[n % len(WAYS)], ls=(2.5 * n, (5, 2.5 * n)), lw=1.2,
            marker="o", ms=2.5, label=name,
        )  # fmt: skip
    half = 5e2 * setup.size[0]
    x, z = points[0, 0], height[0]
    ax.plot([x - half, x + half], [z, z], color=FAINT, lw=3, solid_capstyle="butt")
    ax.plot([-32.5, 32.5], [0, 0], color=MEASURED, lw=3, solid_capstyle="butt")
    ax.set_title(f"{way} [mm]", **TITLES)
    ax.set_xlim(-265, 265)
    ax.set_ylim(-8, 220)
    ax.set_aspect("equal")
    bare(ax)


@dataclass(frozen=True)
class Case:
    """A board on a trajectory at a speed."""

    panel: Panel
    """As shown in the paper, or made up where it is not."""
    speed: float

    @property
    def name(self) -> str:
        """File name of its curve, without ending."""
        return f"{self.panel.name}_{self.speed:g}"


@dataclass(frozen=True, eq=False)
class Curve:
    """What a board reads in a case, normalised, shape (n,)."""

    case: Case
    times: Array
    """Of the samples [s]."""
    reading: Array
    """Rounded by the converter, without noise."""
    noisy: Array
    """With the noise of the set-up."""


def cases_of(setup: Scenario1Setup, *, reduced: bool) -> list[Case]:
    """All boards, trajectories and speeds; reduced, the paper's panels only.

    At the panels' speed these have as many samples as in the paper; other cases last once round.
    """
    shown = [Case(panel, setup.panel_speed) for panel in setup.panels.values()]
    if reduced:
        return shown
    names = {case.name for case in shown}
    rest = []
    for board, trajectory, speed in product(setup.boards, setup.ways, setup.speeds):
        time = setup.rest + setup.path(board, trajectory, speed).duration
        samples = math.ceil(time * setup.sample_rate) + 1
        rest.append(Case(Panel(board, trajectory, samples), speed))
    return shown + [case for case in rest if case.name not in names]


@lru_cache(maxsize=3)
def _simulator(board: Board, pour: str, excitation_frequency: float) -> Simulator:
    return Simulator(board.sensor(pour), excitation_frequency=excitation_frequency)


def curve_of(setup: Scenario1Setup, case: Case, store: Store) -> Curve:
    """Simulate a case, or take its capacitances from the store, and read them."""
    board, times = setup.boards[case.panel.board], setup.times(case.panel)
    poses = setup.poses(board.design, case.panel.trajectory, case.speed, times)

    def compute() -> dict[str, Array]:
        sim = _simulator(board, setup.pour, setup.excitation_frequency)
        values = mutual(matrices(sim, setup, poses), sim.electrode_names, board.pair)
        return {"values": values, "empty": mutual(sim.baseline, sim.electrode_names, board.pair)}

    inputs = {
        "design": board.sensor(setup.pour).content_hash(),
        "pair": board.pair,
        "frequency": setup.excitation_frequency,
        "bar": [setup.size, setup.material],
        "positions": np.array([pose.position for pose in poses]),
    }
    found = store.get(case.name, inputs, compute)
    values, empty = found["values"], float(found["empty"])
    clean, noisy = (
        setup.level_of(case.panel) * normalised(setup, board, values, empty, noise=noise)
        for noise in (False, True)
    )
    return Curve(case, times, clean, noisy)


def run(folder: Path, *, reduced: bool, report: Report) -> Outcome:
    """Carry the study out; see :class:`capsense.reproduce.harness.Study`."""
    setup = load_setup()
    store = Store(folder)
    cases = cases_of(setup, reduced=reduced)
    work = np.cumsum([0] + [case.panel.samples for case in cases])
    curves = []
    for case, done in zip(cases, work, strict=False):
        what = f"{case.panel.board}, {case.panel.trajectory} at {case.speed:g} m/s"
        report(what, done / work[-1])
        curves.append(curve_of(setup, case, store))
    shown = {curve.case.panel.name: curve for curve in curves[: len(setup.panels)]}
    panels = {name: load_curves(panel) for name, panel in setup.panels.items() if panel.file}
    rows, compared = _compare(shown, panels)
    tables = {
        "comparison": compared, "hardware_of_the_paper_eq12": _table_1(setup),
        "fitted": _fitted(setup), "curves": _listed(curves),
    }  # fmt: skip
    noise = ("reading", "reading with noise")
    header = ("measured", "the paper's simulation", "CapSense", "CapSense with noise")
    for name, p in panels.items():
        c = shown[name]
        tables[f"panel_{name}"] = _samples(header, p.measured, p.simulated, c.reading, c.noisy)
    for c in curves:
        tables[c.case.name] = _samples(("time [s]", *noise), c.times, c.reading, c.noisy)
    plots = {
        "panels": plot_panels({n: (c.reading, panels.get(n)) for n, c in shown.items()}),
        "trajectories": plot_trajectories(
            setup,
            {
                (c.case.panel.board, c.case.panel.trajectory): (c.times, c.reading)
                for c in curves
                if c.case.speed == setup.panel_speed
            },
        ),
    }
    title = "Scenario 1: a steel bar over stripe, patch and meander electrodes"
    return Outcome(title, rows, tables, plots, notes("scenario1"), store.told())


def _compare(
    shown: dict[str, Curve], panels: dict[str, PaperCurves]
) -> tuple[tuple[Row, ...], ReportTable]:
    """Our curves and the paper's simulation, each against hardware."""
    rows: list[Row] = []
    cells: list[tuple[str | float, ...]] = []
    measures = {
        "zero-mean correlation": cross_correlation,
        "rms error": rmse,
        "Eq. 12 of the change from the level": correlation_of_change,
        "Eq. 12 of the values as they are": raw_correlation,
    }
    ways = {TRIANGLE: "triangle", ZIGZAG: "zig-zag"}
    for name, panel in panels.items():
        curve, measured = shown[name], panel.measured
        title = f"{curve.case.panel.board}, {ways[curve.case.panel.trajectory]}"
        for what, measure in measures.items():
            ours, theirs = measure(curve.reading, measured), measure(panel.simulated, measured)
            label, source = f"{title}: {what}", "the paper's simulation"
            if measure is rmse:
                rows.append(judged(label, ours, below=theirs, source=source))
            elif measure is cross_correlation:
                rows.append(judged(label, ours, above=theirs, source=source))
            else:
                rows.append(Row(label, ours))
            cells.append((title, what, ours, theirs))
    header = ("panel", "against hardware", "CapSense", "the paper's simulation")
    return tuple(rows), ReportTable(header, tuple(cells))


def _table_1(setup: Scenario1Setup) -> ReportTable:
    """The paper's Table I, simulation against hardware over all trajectories."""
    rows = [
        (speed, *(correlations(1)[f"{speed:g}"][name] for name in setup.boards))
        for speed in setup.speeds
    ]
    return ReportTable(("speed [m/s]", *setup.boards), tuple(rows))


def _fitted(setup: Scenario1Setup) -> ReportTable:
    rows = [(key, setup.value(key), u) for key, u in setup.uncertainty.items()]
    return ReportTable(
        ("figure (SI units; tilt in degrees)", "value", "standard uncertainty"), tuple(rows)
    )


def _listed(curves: list[Curve]) -> ReportTable:
    header = ("board", "trajectory", "speed [m/s]", "samples", "least", "most")
    return ReportTable(
        header,
        tuple(
            (c.case.panel.board, c.case.panel.trajectory, c.case.speed, c.case.panel.samples,
             float(c.reading.min()), float(c.reading.max()))
            for c in curves
        ),
    )  # fmt: skip


def _samples(header: tuple[str, ...], *columns: Array) -> ReportTable:
    """Columns of numbers, a row for each sample."""
    rows = zip(range(1, len(columns[0]) + 1), *(c.tolist() for c in columns), strict=True)
    return ReportTable(("sample", *header), tuple(rows))
