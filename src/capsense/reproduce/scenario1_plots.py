"""Scenario 1's pictures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsense._style import COLOURS, FAINT, INK, LABELS, LEGEND, TITLES, bare
from capsense.reproduce.scenario1_setup import Array, PaperCurves, Scenario1Setup

MEASURED, PAPER, OURS = INK, COLOURS[1], COLOURS[0]


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
        ax.set_ylabel(f"C / C empty\n{name.replace('_', ', ')}", **LABELS)
        ax.set_xlim(0, len(ours) + 1)
        bare(ax)
    axes[0].legend(loc="lower left", ncols=3, bbox_to_anchor=(0, 1), **LEGEND)
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
    """The middle of the bar's lower face on each distinct way, and the board, to scale."""
    distinct: dict[bytes, list[str]] = {}
    ways_of = {
        name: 1e3 * np.array([p.position for p in setup.path(name, way, 1.0).waypoints])
        for name in boards
    }
    for name, points in ways_of.items():
        distinct.setdefault(points.tobytes(), []).append(name)
    for names, colour in zip(distinct.values(), (OURS, PAPER, MEASURED), strict=False):
        points = np.concatenate([ways_of[names[0]], ways_of[names[0]][:1]])
        height = points[:, 2] - 5e2 * setup.size[2]
        label = ", ".join(names)
        ax.plot(points[:, 0], height, color=colour, lw=1.0, marker="o", ms=2.5, label=label)
    half = 5e2 * setup.size[0]
    x, z = points[0, 0], height[0]
    ax.plot([x - half, x + half], [z, z], color=FAINT, lw=3, solid_capstyle="butt")
    ax.plot([-32.5, 32.5], [0, 0], color=MEASURED, lw=3, solid_capstyle="butt")
    ax.set_title(f"{way} [mm]", **TITLES)
    ax.set_xlim(-265, 265)
    ax.set_ylim(-8, 220)
    ax.set_aspect("equal")
    bare(ax)
