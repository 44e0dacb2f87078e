"""Where the bodies went: the sensor and their ways, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from capsense._style import FAINT, INK, LABELS, LEGEND, TIME_COLOURS, TITLES, bare
from capsense.design import Design
from capsense.plotting.designs import LAYER_COLOUR, ROLE_COLOURS, add_surface, outline_patch
from capsense.scene import Body, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from capsense.recording.tables import Run

Array = NDArray[np.float64]


def draw_views(run: Run, peak: int, colours: list[str], above: Axes, side: Axes) -> None:
    """Draw sensor, domain, bodies and their ways, in millimetres and to one scale.

    Parameters
    ----------
    run
        A run of at least one sample.
    peak
        The sample at which bodies are drawn solid; they are dashed at the first one.
    colours
        A colour for each electrode.
    above, side
        Square axes for the view along −z, and for that along y or x, whichever shows more.
    """
    _, positions, _ = run.poses()
    lower, upper = _window(run, positions, peak)
    across = _side_axis(positions)
    span = 1.12 * float((upper - lower).max())
    middle = (lower + upper) / 2
    floor = lower[2] - 0.04 * span
    corners = {0: middle[0] - span / 2, 1: middle[1] - span / 2, 2: floor}
    name = run.design.name
    views = ((above, (0, 1), f"{name}, from above"), (side, (across, 2), "from the side"))
    for axes, (a, b), title in views:
        _draw_domain(run.design, axes, a, b)
        if b == 1:
            _sensor_from_above(run.design, colours, axes)
        else:
            _sensor_from_the_side(run.design, colours, axes, a)
        _draw_bodies(run.scenes, peak, axes, [a, b], (corners[a], corners[a] + span))
        for track in np.moveaxis(positions[:, :, [a, b]] * 1e3, 1, 0):
            here = ~np.isnan(track).any(axis=1)
            if np.ptp(track[here], axis=0).max(initial=0.0) > 0.01:
                _draw_way(axes, track[here], np.array(run.times)[here])
        axes.set_xlim(corners[a], corners[a] + span)
        axes.set_ylim(corners[b], corners[b] + span)
        axes.set_aspect("equal")
        bare(axes)
        axes.grid(visible=False)
        axes.set_xlabel(f"{'xyz'[a]} [mm]", **LABELS)
        axes.set_ylabel(f"{'xyz'[b]} [mm]", **LABELS)
        axes.set_title(title, **TITLES)
    if positions.shape[1] and len(run.times) > 1:
        handles = [Line2D([], [], ls="-", color=INK, lw=0.9, label="body at the largest change")]
        if peak:
            style: dict[str, Any] = {"marker": "o", "ls": "--", "color": INK, "mfc": "white"}
            handles.insert(0, Line2D([], [], lw=0.9, label="start", **style))
        above.figure.legend(handles=handles, loc="outside lower right", ncols=2, **LEGEND)


def _window(run: Run, positions: Array, peak: int) -> tuple[Array, Array]:
    """Corners [mm] of what there is to see: sensor, bodies and ways inside the domain."""
    design = run.design
    points = [e.surface.bounds for e in design.electrodes]
    points += [c.surface.bounds for c in design.conductors]
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


def _draw_domain(design: Design, axes: Axes, a: int, b: int) -> None:
    low, high = design.domain.lower * 1e3, design.domain.upper * 1e3
    walls = shapely.geometry.box(low[a], low[b], high[a], high[b])
    axes.add_patch(outline_patch(walls, fc="none", ec=FAINT, lw=1.0))


def _draw_bodies(
    scenes: Sequence[Scene], peak: int, axes: Axes, plane: list[int], shown: tuple[float, float]
) -> None:
    """Bodies at the peak, dashed where they stood at the start."""
    for body in scenes[0] if peak else ():
        outline = _silhouette(body, plane)
        axes.add_patch(outline_patch(outline, fc=to_rgba(INK, 0.0), ec=INK, lw=0.9, ls="--"))
    for body in scenes[peak]:
        outline = _silhouette(body, plane)
        axes.add_patch(outline_patch(outline, fc=to_rgba(INK, 0.12), ec=INK, lw=0.9))
        left, _, right, top = outline.bounds
        axes.annotate(
            body.name or "", (float(np.clip((left + right) / 2, *shown)), top), xytext=(0, 3),
            textcoords="offset points", ha="center", fontsize=8, color=INK, zorder=6,
            annotation_clip=True,
        )  # fmt: skip


def _sensor_from_above(design: Design, colours: list[str], axes: Axes) -> None:
    for layer in design.layers:
        low, high = layer.lower[:2] * 1e3, layer.upper[:2] * 1e3
        plate = shapely.geometry.box(*low, *high)
        axes.add_patch(outline_patch(plate, fc=LAYER_COLOUR, ec=FAINT, lw=0.6))
    for conductor in design.conductors:
        add_surface(axes, conductor.surface, fc="#d5dade", ec="none")
    for electrode, colour in zip(design.electrodes, colours, strict=True):
        add_surface(axes, electrode.surface, fc=colour, ec="white", lw=0.3, zorder=2)


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
