"""Where the bodies went: the sensor and their ways, from above and from the side."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from capsense._style import FAINT, INK, LABELS, LEGEND, TIME_COLOURS, TITLES, bare
from capsense.cli.recorder import RunWriter
from capsense.design import Design
from capsense.design.draw import LAYER_COLOUR, ROLE_COLOURS, outline_patch, outlines
from capsense.scene import Body

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]


def draw_views(recorder: RunWriter, peak: int, colours: list[str], above: Axes, side: Axes) -> None:
    """Draw sensor, domain, bodies and their ways, in millimetres and to one scale.

    Args:
        recorder: A run of at least one sample.
        peak: The sample at which bodies are drawn solid; they are dashed at the first one.
        colours: A colour for each electrode.
        above: Square axes for the view along −z.
        side: Square axes for the view along y or x, whichever shows more.
    """
    lower, upper = _window(recorder, peak)
    across = _side_axis(recorder.positions)
    span = 1.12 * float((upper - lower).max())
    middle = (lower + upper) / 2
    floor = lower[2] - 0.04 * span
    corners = {0: middle[0] - span / 2, 1: middle[1] - span / 2, 2: floor}
    name = recorder.scenario.design.name
    views = ((above, (0, 1), f"{name}, from above"), (side, (across, 2), "from the side"))
    for axes, (a, b), title in views:
        _draw_domain(recorder.scenario.design, axes, a, b)
        if b == 1:
            _sensor_from_above(recorder.scenario.design, colours, axes)
        else:
            _sensor_from_the_side(recorder.scenario.design, colours, axes, a)
        _draw_bodies(recorder, peak, axes, [a, b], (corners[a], corners[a] + span))
        axes.set_xlim(corners[a], corners[a] + span)
        axes.set_ylim(corners[b], corners[b] + span)
        axes.set_aspect("equal")
        bare(axes)
        axes.grid(visible=False)
        axes.set_xlabel(f"{'xyz'[a]} [mm]", **LABELS)
        axes.set_ylabel(f"{'xyz'[b]} [mm]", **LABELS)
        axes.set_title(title, **TITLES)
    if recorder.scenario.bodies and len(recorder.times) > 1:
        handles = [Line2D([], [], ls="-", color=INK, lw=0.9, label="body at the largest change")]
        if peak:
            style: dict[str, Any] = {"marker": "o", "ls": "--", "color": INK, "mfc": "white"}
            handles.insert(0, Line2D([], [], lw=0.9, label="start", **style))
        above.figure.legend(handles=handles, loc="outside lower right", ncols=2, **LEGEND)


def _window(recorder: RunWriter, peak: int) -> tuple[Array, Array]:
    """Corners [mm] of what there is to see: sensor, bodies and ways inside the domain."""
    design = recorder.scenario.design
    points = [e.surface.bounds for e in design.electrodes]
    points += [c.surface.bounds for c in design.conductors]
    points += [np.array([k.lower, k.upper]) for k in design.layers]
    points += list(recorder.positions)
    for moving in recorder.scenario.bodies:
        for k in (0, peak):
            body = moving.at(float(recorder.times[k]))
            points.append(body.pose.apply(body.shape.to_trimesh().vertices))
    cloud = np.clip(np.concatenate(points), design.domain.lower, design.domain.upper) * 1e3
    return cloud.min(axis=0), cloud.max(axis=0)


def _side_axis(positions: Array) -> int:
    """The horizontal axis along which the bodies move most."""
    if positions.shape[1] == 0:
        return 0
    extent = np.ptp(positions, axis=0).max(axis=0)
    return 1 if extent[1] > extent[0] else 0


def _draw_domain(design: Design, axes: Axes, a: int, b: int) -> None:
    low, high = design.domain.lower * 1e3, design.domain.upper * 1e3
    walls = shapely.geometry.box(low[a], low[b], high[a], high[b])
    axes.add_patch(outline_patch(walls, fc="none", ec=FAINT, lw=1.0))


def _draw_bodies(
    recorder: RunWriter, peak: int, axes: Axes, plane: list[int], shown: tuple[float, float]
) -> None:
    for number, moving in enumerate(recorder.scenario.bodies):
        track = recorder.positions[:, number][:, plane] * 1e3
        start = [(0, "--", 0.0)] if peak else []
        for k, dash, fill in (*start, (peak, "-", 0.12)):
            shape = _silhouette(moving.at(float(recorder.times[k])), plane)
            axes.add_patch(outline_patch(shape, fc=to_rgba(INK, fill), ec=INK, lw=0.9, ls=dash))
        if np.ptp(track, axis=0).max(initial=0.0) > 0.01:
            _draw_way(axes, track, recorder.times)
        left, _, right, top = shape.bounds
        axes.annotate(
            str(moving.body.name),
            (float(np.clip((left + right) / 2, *shown)), top),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color=INK,
            zorder=6,
            annotation_clip=True,
        )


def _sensor_from_above(design: Design, colours: list[str], axes: Axes) -> None:
    for layer in design.layers:
        low, high = layer.lower[:2] * 1e3, layer.upper[:2] * 1e3
        plate = shapely.geometry.box(*low, *high)
        axes.add_patch(outline_patch(plate, fc=LAYER_COLOUR, ec=FAINT, lw=0.6))
    for conductor in design.conductors:
        for shape in outlines(conductor.surface):
            axes.add_patch(outline_patch(shape, fc="#d5dade", ec="none"))
    for electrode, colour in zip(design.electrodes, colours, strict=True):
        for shape in outlines(electrode.surface):
            axes.add_patch(outline_patch(shape, fc=colour, ec="white", lw=0.3, zorder=2))


def _sensor_from_the_side(design: Design, colours: list[str], axes: Axes, axis: int) -> None:
    for layer in design.layers:
        low, high = layer.lower * 1e3, layer.upper * 1e3
        slab = shapely.geometry.box(low[axis], low[2], high[axis], high[2])
        axes.add_patch(outline_patch(slab, fc=LAYER_COLOUR, ec=FAINT, lw=0.6))
    sheets = [(c.surface, ROLE_COLOURS[c.role], 1.5) for c in design.conductors]
    sheets += [(e.surface, c, 3.0) for e, c in zip(design.electrodes, colours, strict=True)]
    for surface, colour, width in sheets:
        low, high = surface.bounds * 1e3
        ends = [low[axis], high[axis]], [low[2], high[2]]
        axes.plot(*ends, color=colour, lw=width, solid_capstyle="butt", zorder=2)


def _silhouette(body: Body, plane: list[int]) -> Any:
    """Convex outline [mm] of a body seen along the third axis."""
    points = body.pose.apply(body.shape.to_trimesh().vertices)[:, plane] * 1e3
    return shapely.MultiPoint(points).convex_hull


def _draw_way(axes: Axes, track: Array, times: Array) -> None:
    """The way of a body's origin, coloured by time, with its start."""
    pieces = np.stack([track[:-1], track[1:]], axis=1)
    way = LineCollection(list(pieces), cmap=TIME_COLOURS, lw=2.2, capstyle="round", zorder=4)
    way.set_array(times[:-1])
    axes.add_collection(way)
    axes.plot(*track[0], "o", ms=5, mfc="white", mec=INK, mew=1.0, zorder=5)
