"""Pictures of designs, runs and chips; :func:`capsense.plot` draws any of them.

Those of runs are made here: signals against time, and the bodies' way over the electrodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import shapely
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import ArrayLike, NDArray

from capsense._style import (
    COLOURS,
    DASHES,
    FAINT,
    INK,
    LEGEND,
    TIME_COLOURS,
    dress,
    style_of,
    unit_of,
)
from capsense._validate import suggest
from capsense.design.model import Design
from capsense.plotting.designs import draw_design, draw_sensor, outline_patch
from capsense.reading import Reading
from capsense.scenario import Excitation
from capsense.scenario.model import channels_of
from capsense.scene import Body, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from capsense.adapters import AttachedSensor
    from capsense.recording.reader import Recording
    from capsense.recording.tables import Run
    from capsense.simulator import Simulator

Array = NDArray[np.float64]


def draw_views(run: Run, peak: int, colours: list[str], above: Axes, side: Axes) -> None:
    """Draw sensor, domain, bodies and their ways, in millimetres and to one scale.

    Args:
        run: A run of at least one sample.
        peak: The sample at which bodies are drawn solid; they are dashed at the first one.
        colours: A colour for each electrode.
        above: Square axes for the view along −z.
        side: The same for that along y or x, whichever shows more.
    """
    _, positions, _ = run.poses()
    lower, upper = _window(run, positions, peak)
    across = _side_axis(positions)
    span = 1.12 * float((upper - lower).max())
    middle = (lower + upper) / 2
    corners = {0: middle[0] - span / 2, 1: middle[1] - span / 2, 2: lower[2] - 0.04 * span}
    from_above = f"{run.design.name}, from above"
    views = ((above, (0, 1), from_above), (side, (across, 2), "from the side"))
    tags = _tags(run.scenes[peak])
    for axes, (a, b), title in views:
        draw_sensor(run.design, colours, axes, (a, b))
        _draw_bodies(run.scenes, peak, axes, [a, b])
        _name_bodies(run.scenes[peak], tags, axes, [a, b], (corners[a], corners[b], span))
        for track in np.moveaxis(positions[:, :, [a, b]] * 1e3, 1, 0):
            here = ~np.isnan(track).any(axis=1)
            if np.ptp(track[here], axis=0).max(initial=0.0) > 0.01:
                _draw_way(axes, track[here], np.array(run.times)[here])
        axes.set_xlim(corners[a], corners[a] + span)
        axes.set_ylim(corners[b], corners[b] + span)
        axes.set_aspect("equal")
        dress(axes, f"{'xyz'[a]} [mm]", f"{'xyz'[b]} [mm]", title)
        axes.grid(visible=False)
    if positions.shape[1] and len(run.times) > 1:
        handles = [Line2D([], [], ls="-", color=INK, lw=0.9, label="body at the largest change")]
        if peak:
            style: dict[str, Any] = {"marker": "o", "ls": "--", "color": INK, "mfc": "white"}
            handles.insert(0, Line2D([], [], lw=0.9, label="start", **style))
        above.figure.legend(handles=handles, loc="outside lower right", ncols=2, **LEGEND)
    listed = {tag: _owner(n, list(tags)) for n, tag in tags.items() if tag.isdigit() and tag != n}
    if listed:
        handles = [Line2D([], [], ls="", label=f"{tag}  {name}") for tag, name in listed.items()]
        above.figure.legend(
            handles=handles, loc="outside lower left", ncols=7, handlelength=0, handletextpad=0,
            columnspacing=1.4, **LEGEND,
        )  # fmt: skip


def _window(run: Run, positions: Array, peak: int) -> tuple[Array, Array]:
    """Corners [mm] of what there is to see: sensor, bodies and ways inside the domain."""
    design = run.design
    points = [sheet.surface.bounds for sheet in design.sheets]
    points += [np.array([k.lower, k.upper]) for k in design.layers]
    points += [positions[~np.isnan(positions).any(axis=2)]]
    for k in (0, peak):
        points += [_corners(body) for body in run.scenes[k]]
    cloud = np.clip(np.concatenate(points), design.domain.lower, design.domain.upper) * 1e3
    return cloud.min(axis=0), cloud.max(axis=0)


def _side_axis(positions: Array) -> int:
    """The horizontal axis along which the bodies move most."""
    if positions.shape[1] == 0:
        return 0
    extent = (np.nanmax(positions, axis=0) - np.nanmin(positions, axis=0)).max(axis=0)
    return 1 if extent[1] > extent[0] else 0


def _draw_bodies(scenes: Sequence[Scene], peak: int, axes: Axes, plane: list[int]) -> None:
    """Bodies at the peak, dashed where they stood at the start."""
    start = scenes[0] if peak else ()
    for bodies, opacity, dash in ((start, 0.0, "--"), (scenes[peak], 0.12, "-")):
        for body in bodies:
            fill, outline = to_rgba(INK, opacity), _silhouette(body, plane)
            axes.add_patch(outline_patch(outline, fc=fill, ec=INK, lw=0.9, ls=dash))


def _tags(scene: Scene) -> dict[str, str]:
    """What stands in the picture for each name: the name; of many, a number.

    Of many, the parts of one body, such as ``arm/hand`` and ``arm/wrist``, share a number.
    """
    names = list(dict.fromkeys(body.name for body in scene if body.name))
    if len(names) <= FEW:
        return {name: name for name in names}
    owners = {name: _owner(name, names) for name in names}
    numbers = {owner: str(k + 1) for k, owner in enumerate(dict.fromkeys(owners.values()))}
    if len(numbers) <= FEW:
        return owners
    return {name: numbers[owner] for name, owner in owners.items()}


def _owner(name: str, names: Sequence[str]) -> str:
    """The body that a name such as ``arm/hand`` is a part of, where others are too."""
    body = name.partition("/")[0]
    return body if sum(other.partition("/")[0] == body for other in names) > 1 else name


def _name_bodies(
    scene: Scene, tags: dict[str, str], axes: Axes, plane: list[int], window: Sequence[float]
) -> None:
    """Write each tag once, over the largest of its bodies, where there is room for it.

    Args:
        scene: The bodies.
        tags: Name → what is written.
        axes: Where.
        plane: The two axes of the view.
        window: Lower left corner and width of what is shown [mm].
    """
    left, bottom, span = window
    point = span / VIEW_WIDTH
    largest: dict[str, Any] = {}
    for body in scene:
        tag, outline = tags.get(body.name or ""), _silhouette(body, plane)
        if tag and (tag not in largest or outline.area > largest[tag].area):
            largest[tag] = outline
    taken: list[Any] = []
    for tag, outline in largest.items():
        low, _, high, top = outline.bounds
        half, height = 2.6 * len(tag) * point, 9 * point
        x = float(np.clip((low + high) / 2, left, left + span))
        for row in range(2 if tag.isdigit() else 5):
            y = top + 3 * point + row * height
            place = shapely.geometry.box(x - half, y, x + half, y + height)
            if not any(place.intersects(other) for other in taken):
                break
        else:
            continue  # the other view, or the list, tells
        if not bottom <= y <= bottom + span:
            continue
        taken.append(place)
        axes.text(
            x, y, tag, ha="center", va="bottom", fontsize=8, color=INK, zorder=6,
            path_effects=[Stroke(linewidth=2, foreground="white"), Normal()],
        )  # fmt: skip


def _corners(body: Body) -> Array:
    """Points on a body [m], shape (n, 3)."""
    return body.pose.apply(body.shape.to_trimesh().vertices)


def _silhouette(body: Body, plane: list[int]) -> Any:
    """Convex outline [mm] of a body seen along the third axis."""
    return shapely.MultiPoint(_corners(body)[:, plane] * 1e3).convex_hull


def _draw_way(axes: Axes, track: Array, times: Array) -> None:
    """The way of a body's origin, coloured by time, with its start."""
    pieces = np.stack([track[:-1], track[1:]], axis=1)
    way = LineCollection(list(pieces), cmap=TIME_COLOURS, lw=2.2, capstyle="round", zorder=4)
    way.set_array(times[:-1])
    axes.add_collection(way)
    axes.plot(*track[0], "o", ms=5, mfc="white", mec=INK, mew=1.0, zorder=5)


FEW = 3
"""So many bodies are named in the views; of more, numbers stand there."""
VIEW_WIDTH = 170.0
"""About the width of a view [points]."""
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
    """Capacitances with nothing in front of the sensor [F], shape (k,)."""


def plot(
    what: Design | Recording | Sequence[Reading],
    simulator: Simulator | AttachedSensor | None = None,
    *,
    times: ArrayLike | None = None,
    scenes: Sequence[Scene] | None = None,
    excitation: Excitation | str = Excitation.MATRIX,
) -> Figure:
    """Draw a design, a recording, or readings: ``cs.plot(design).savefig("design.png")``.

    Args:
        what: A design; an open recording; or the readings of a run, n of them.
        simulator: With readings: the simulator, or the sensor on a robot, that took them.
        times: With readings: their times [s], shape (n,); by default their numbers.
        scenes: With readings: what the simulator was given, n scenes, to show the bodies' ways.
        excitation: With readings: the signals shown, ``"matrix"``, ``"self"`` or ``"mutual"``.

    Returns:
        The figure. A run's shows the changes of self and mutual capacitances from the empty scene
        [F], and force and compression of a cover; beside them the bodies' ways over the electrodes,
        from above and from the side.

    Raises:
        TypeError: ``what`` is something else.
        ValueError: There is no reading, readings come without their simulator, times or scenes are
            not as many, or there is no such excitation.
    """
    from capsense.adapters import AttachedSensor
    from capsense.recording.export import run_of
    from capsense.recording.reader import Recording
    from capsense.recording.tables import Run
    from capsense.simulator import Simulator

    if isinstance(what, Design):
        return cast(Figure, draw_design(what).figure)
    numbered = times is None and not isinstance(what, Recording)
    if isinstance(what, Recording):
        run = run_of(what, list(what.steps()))
    else:
        if not isinstance(what, Sequence) or not all(isinstance(r, Reading) for r in what):
            raise TypeError(
                "plot takes a design, an open recording or a list of readings, not "
                f"{type(what).__name__}; write plot(cs.load_design(name)) or plot(readings, sim)"
            )
        if isinstance(simulator, AttachedSensor):
            simulator = simulator.simulator
        if not isinstance(simulator, Simulator):
            raise ValueError(
                "readings are drawn with the simulator, or the sensor, that took them; give "
                "plot(readings, sim)"
            )
        known = [e.value for e in Excitation]
        if excitation not in known:
            raise ValueError(f"excitation is {excitation!r}; {suggest(excitation, known)}")
        design, count = simulator.design, len(what)
        moments = np.arange(count) if times is None else np.asarray(times, dtype=float)
        seen = [Scene()] * count if scenes is None else scenes
        if moments.shape != (count,) or len(seen) != count:
            also = "" if scenes is None else f" and {len(seen)} scenes"
            raise ValueError(
                f"{count} readings, times of shape {moments.shape}{also}; give as many of each"
            )
        channels = channels_of(Excitation(excitation), design.electrode_names)
        run = Run(
            design.name, design, channels, simulator.empty, (), moments.tolist(), list(what),
            list(seen),
        )  # fmt: skip
    if not run.times:
        raise ValueError("there is no reading to draw; take a step first")
    return plot_run(run, "number of the reading" if numbered else "time [s]")


def plot_run(run: Run, across: str = "time [s]") -> Figure:
    """Draw a run, with this label on the axis of time; see :func:`plot`."""
    values = run.values
    families = _families(run, values)
    touched = run.design.cover is not None
    columns = 1 + touched
    figure = Figure(figsize=(5.6 * columns + 4.4, 7.0), layout=ConstrainedLayoutEngine(w_pad=0.1))
    grid = figure.add_gridspec(2, columns + 1, width_ratios=[1.0] * columns + [0.75])
    peak = _strongest(values, run.levels)
    shared: Axes | None = None
    for row, family in enumerate(families):
        place = grid[row, 0] if len(families) > 1 else grid[:, 0]
        axes = figure.add_subplot(place, sharex=shared)
        shared = shared or axes
        _draw_family(family, np.array(run.times), peak, axes)
    assert shared is not None
    lowest = [axes]
    if touched:
        upper, lower = (figure.add_subplot(grid[row, 1], sharex=shared) for row in range(2))
        _draw_touch(run, peak, upper, lower)
        lowest.append(lower)
    for below in lowest:
        dress(below, across)
        _draw_time(below, np.array(run.times))
    for above in figure.axes:
        above.tick_params(labelbottom=above in lowest)
    colours = [style_of(k)[0] for k in range(len(run.design.electrodes))]
    if run.channels[0].excitation is Excitation.MUTUAL:
        colours = [PLAIN_ELECTRODE] * len(colours)
    views = [figure.add_subplot(grid[row, columns]) for row in range(2)]
    draw_views(run, peak, colours, views[0], views[1])
    figure.suptitle(run.title, fontsize=13, fontweight="bold", color=INK)
    return figure


def _draw_touch(run: Run, peak: int, upper: Axes, lower: Axes) -> None:
    """Draw what the cover carries above each electrode, and how far it is compressed."""
    from capsense.recording.tables import touch_values

    m, times = len(run.design.electrodes), np.array(run.times)
    rows = np.array([touch_values(r, run.design) for r in run.readings])
    marker = "o" if len(times) < 3 else ""
    for axes, signals in ((upper, rows[:, :m]), (lower, 1e3 * rows[:, m:-1])):
        for k in range(m - 1, -1, -1):
            colour, dash = style_of(k)
            axes.plot(
                times, signals[:, k], color=colour, ls=dash, marker=marker, lw=1.6,
                label=run.design.electrode_names[k],
            )  # fmt: skip
        if len(times) > 1:
            axes.axvline(times[peak], color=INK, lw=0.7, ls=":", zorder=1)
        axes.margins(x=0.01)
        axes.set_ylim(bottom=0.0)
    lines = upper.get_lines()[:m][::-1][:MAX_LINES]
    upper.legend(
        lines, [str(line.get_label()) for line in lines],
        loc="lower left", bbox_to_anchor=(-0.02, 1.0),
        ncols=5 if m > 6 else 6, handlelength=1.4, columnspacing=0.8, title="touch",
        alignment="left", title_fontproperties={"size": 10, "weight": "bold"}, **LEGEND,
    )  # fmt: skip
    dress(upper, y="force on the cover [N]")
    dress(lower, y="compression of the cover [mm]")


def _families(run: Run, values: Array) -> list[_Family]:
    channels = run.channels
    selves = [k for k, c in enumerate(channels) if c.row == c.column]
    pairs = [k for k, c in enumerate(channels) if c.row != c.column]
    out = []
    if selves:
        styles = [style_of(channels[k].row) for k in selves]
        labels = [channels[k].label for k in selves]
        levels = run.levels[selves]
        out.append(_Family("self capacitance", labels, styles, values[:, selves], levels))
    if pairs:
        # A pair's capacitance is positive, whatever the sign of its entry in the matrix.
        sign = -1.0 if channels[pairs[0]].excitation is Excitation.MATRIX else 1.0
        values, levels = sign * values[:, pairs], sign * run.levels[pairs]
        rank = np.argsort(-np.abs(values - levels).max(axis=0), kind="stable")
        order = [*sorted(rank[:MAX_LINES].tolist()), *rank[MAX_LINES:].tolist()]
        labels = [channels[pairs[k]].label for k in order]
        # Colours for the strongest pairs, dashed in turns so that neighbours differ twice.
        styles = [(COLOURS[k], DASHES[k % 2]) for k in range(min(len(labels), MAX_LINES))]
        styles += [(FAINT, "-")] * (len(labels) - len(styles))
        out.append(_Family("mutual capacitance", labels, styles, values[:, order], levels[order]))
    return out


def _strongest(values: Array, levels: Array) -> int:
    """The sample with the largest relative change; the middle one where it stays that large."""
    change = (np.abs(values - levels) / np.maximum(np.abs(levels), 1e-18)).max(axis=1)
    first = int(np.argmax(change))
    less = np.flatnonzero(change < 0.995 * change[first])
    ends = np.array([-1, *less, len(change)])
    after = int(np.searchsorted(ends, first))
    return int(ends[after - 1] + ends[after]) // 2


def _draw_family(family: _Family, times: Array, peak: int, axes: Axes) -> None:
    """Draw the changes of one family of signals from the empty scene."""
    changes = family.values - family.levels
    factor, unit = unit_of(float(np.abs(changes).max(initial=0.0)))
    marker = "o" if len(times) < 3 else ""
    for k in range(changes.shape[1] - 1, -1, -1):
        colour, dash = family.styles[k]
        strong = k < MAX_LINES or colour != FAINT
        axes.plot(
            times, factor * changes[:, k], color=colour, ls=dash, marker=marker,
            lw=1.6 if strong else 0.8, zorder=3 if strong else 2, label=family.labels[k],
        )  # fmt: skip
    if len(times) > 1:
        axes.axvline(times[peak], color=INK, lw=0.7, ls=":", zorder=1)
    axes.margins(x=0.01)
    lines = axes.get_lines()[: len(family.labels)][::-1]
    entries = [
        (line, label)
        for line, label, style in zip(lines, family.labels, family.styles, strict=True)
        if style[0] != FAINT
    ]
    rest = len(lines) - len(entries)
    if rest:
        entries.append((lines[-1], f"{rest} others"))
    axes.legend(
        *zip(*entries, strict=True), loc="lower left", bbox_to_anchor=(-0.02, 1.0),
        ncols=5 if len(entries) > 6 else 6, handlelength=1.4, columnspacing=0.8, title=family.title,
        alignment="left", title_fontproperties={"size": 10, "weight": "bold"}, **LEGEND,
    )  # fmt: skip
    dress(axes, y=f"change from the empty scene [{unit}]")


def _draw_time(axes: Axes, times: Array) -> None:
    """Draw the colours of time along the bottom, as they are used for the bodies' ways."""
    if len(times) < 2:
        return
    low, high = axes.get_ylim()
    height = 0.025 * (high - low)
    place = (times[0], times[-1], low - height, low)
    colours = np.linspace(0, 1, 256)[None]
    axes.imshow(colours, cmap=TIME_COLOURS, aspect="auto", extent=place, zorder=0)
    axes.set_ylim(low - height, high)
