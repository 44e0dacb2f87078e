"""Pictures of sweeps: lines over one parameter, maps over two."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense._style import LEGEND, TIME_COLOURS, dress, style_of, unit_of
from capsense._validate import suggest
from capsense.errors import ScenarioError
from capsense.studies.capacitances import is_code
from capsense.studies.points import StudyRow
from capsense.studies.template import Point, Value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LINES, MOST_MAPS = 24, 12
"""Outputs of a kind over one parameter, and outputs over two."""


def check_plot(
    points: Sequence[Point], outputs: Sequence[str], chosen: Sequence[str] = ()
) -> tuple[list[str], list[str]]:
    """What a sweep's plot will show.

    Args:
        points: Values of the parameters.
        outputs: All outputs.
        chosen: Those to show, by name or by kind, such as ``dC``; by default all that are no
            derivatives.

    Returns:
        Names of the parameters that change, one or two, and of the outputs.

    Raises:
        ScenarioError: There are no such outputs, or too many parameters or outputs.
    """
    changing = [n for n in points[0] if len({point[n] for point in points}) > 1]
    if not 1 <= len(changing) <= 2:
        raise ScenarioError(
            f"--plot shows one or two parameters, and {len(changing)} change; leave it out, or "
            "give single values to the others"
        )
    kinds = _by_kind(outputs)
    for name in chosen:
        if name not in outputs and name not in kinds:
            raise ScenarioError(f"--outputs: {name!r} is no output; {suggest(name, outputs)}")
    shown = [o for name in chosen for o in kinds.get(name, [name])]
    shown = shown or [n for n in outputs if not n.startswith(("d(", "error of "))]
    panels = [[o for o in shown if o in kind] for kind in kinds.values()]
    count, most = len(shown), MOST_MAPS
    if len(changing) == 1:
        count, most = max(map(len, panels)), MOST_LINES
    if count > most:
        raise ScenarioError(
            f"--plot shows {most} outputs at most, and there are {count}; choose with --outputs, "
            f"such as {','.join(shown[:2])}"
        )
    return changing, shown


def plot_sweep(
    rows: Sequence[StudyRow], outputs: Sequence[str], chosen: Sequence[str] = ()
) -> Figure:
    """Outputs over the one parameter that changes as lines, or over the two as maps.

    Args:
        rows: Of :func:`~capsense.studies.sweep`. Where there is an error, the plot is empty.
        outputs: Names of their results.
        chosen: Those to show, by name or by kind, such as ``dC``; by default all that are no
            derivatives.

    Raises:
        ScenarioError: See :func:`check_plot`.
    """
    from matplotlib.figure import Figure

    changing, shown = check_plot([row.point for row in rows], outputs, chosen)
    results = np.array([row.results for row in rows])
    columns = {name: results[:, outputs.index(name)] for name in shown}
    if len(changing) == 1:
        kinds = _by_kind(shown)
        figure = Figure(figsize=(7, 0.6 + 2.6 * len(kinds)), layout="constrained")
        panels = figure.subplots(len(kinds), squeeze=False)[:, 0]
        for axes, names in zip(panels, kinds.values(), strict=True):
            _lines(axes, changing[0], rows, {name: columns[name] for name in names})
        return figure
    width = min(3, len(shown))
    height = -(-len(shown) // width)
    figure = Figure(figsize=(0.6 + 3.4 * width, 0.6 + 2.8 * height), layout="constrained")
    panels = figure.subplots(height, width, squeeze=False).ravel()
    for axes, name in zip(panels, shown, strict=False):
        _map(axes, (changing[0], changing[1]), rows, name, columns[name])
    for axes in panels[len(shown) :]:
        axes.set_axis_off()
    return figure


def _by_kind(outputs: Sequence[str]) -> dict[str, list[str]]:
    """Outputs by what they are, such as ``C0`` or ``dC``."""
    kinds: dict[str, list[str]] = {}
    for output in outputs:
        kinds.setdefault(output.partition("_")[0], []).append(output)
    return kinds


def _lines(
    axes: Axes, parameter: str, rows: Sequence[StudyRow], columns: dict[str, NDArray[np.float64]]
) -> None:
    """Lines over one parameter, all in one unit."""
    where, labels = _scale([row.point[parameter] for row in rows])
    order = np.argsort(where, kind="stable")
    factor, unit = _unit(next(iter(columns)), np.concatenate(list(columns.values())))
    for number, (name, column) in enumerate(columns.items()):
        colour, dashes = style_of(number)
        axes.plot(
            where[order], factor * column[order], color=colour, ls=dashes, marker="o", ms=3, lw=1.4,
            label=name,
        )  # fmt: skip
    if labels:
        axes.set_xticks(range(len(labels)), labels)
    axes.legend(**LEGEND, ncols=1 + len(columns) // 7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    dress(axes, x=parameter, y=f"[{unit}]")


def _map(
    axes: Axes, parameters: tuple[str, str], rows: Sequence[StudyRow], name: str,
    column: NDArray[np.float64],
) -> None:  # fmt: skip
    """A map of one output over two parameters, the first along x."""
    from matplotlib.ticker import MaxNLocator

    places, ticks, sides = [], [], []
    for parameter in parameters:
        where, labels = _scale([row.point[parameter] for row in rows])
        values, place = np.unique(where, return_inverse=True)
        places.append(place)
        ticks.append(labels)
        sides.append(values)
    factor, unit = _unit(name, column)
    grid = np.full((len(sides[1]), len(sides[0])), np.nan)
    grid[places[1], places[0]] = factor * column
    drawn = axes.pcolormesh(sides[0], sides[1], grid, cmap=TIME_COLOURS, shading="nearest")
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(drawn, ax=axes).ax.tick_params(labelsize=8)
    for axis, labels in zip((axes.xaxis, axes.yaxis), ticks, strict=True):
        if labels:
            axis.set_ticks(range(len(labels)), labels)
        else:
            axis.set_major_locator(MaxNLocator(5))
    dress(axes, x=parameters[0], y=parameters[1], title=f"{name} [{unit}]")


def _scale(values: Sequence[Value]) -> tuple[NDArray[np.float64], list[str]]:
    """Where values lie along an axis, and their labels if some are texts."""
    if not any(isinstance(value, str) for value in values):
        return np.array(values, dtype=float), []
    labels = list(dict.fromkeys(map(str, values)))
    return np.array([labels.index(str(value)) for value in values], dtype=float), labels


def _unit(name: str, column: NDArray[np.float64]) -> tuple[float, str]:
    """A factor and a unit in which an output's numbers are handy."""
    if name.startswith(("d(", "error of ")):
        return 1.0, "F per unit"
    sizes = np.abs(column[np.isfinite(column)])
    return (1.0, "codes") if is_code(name) else unit_of(float(sizes.max(initial=0.0)))
