"""Pictures of sensors: a design from above with its stack, and what chips report of a channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
import shapely.geometry
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray
from shapely.geometry import Polygon

from capsense._style import COLOURS, FAINT, INK, LABELS, LEGEND, TITLES, bare, dress
from capsense.design.geometry import Surface, ring_vertices
from capsense.design.model import Design, Role
from capsense.errors import ReadoutError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import PathPatch

    from capsense.readout import Readout
    from capsense.readout.recording import CapacitanceRecord


Array = NDArray[np.float64]

ELECTRODES = ("#d9822b", "#eab676")  # neighbours in matrix order differ
ROLE_COLOURS = {Role.GROUND: "#8fa3ad", Role.SHIELD: "#7fb59a", Role.FLOATING: "#b59ac4"}
LAYER_COLOUR = "#eef0e4"
LEGEND_WIDTH = 100
"""So many characters fit side by side into the figure of a design."""


def draw_design(design: Design, ax: Axes | None = None) -> Axes:
    """Draw a design seen from the world (along −z), in millimetres.

    Without ``ax`` a figure is made with a side view under the top view, its heights stretched
    and not to scale unless electrodes are curved; with ``ax`` only the top view is drawn into it.

    Args:
        design: The design to draw.
        ax: Matplotlib axes to draw into; by default those of a new figure.

    Returns:
        The axes of the top view; ``axes.figure`` is the figure.
    """
    side: Axes | None = None
    if ax is None:
        from matplotlib.figure import Figure

        ratios = _heights(design)
        figure = Figure(figsize=(7.0, sum(ratios) + 1.4), layout="constrained")
        top_axes, side = figure.subplots(2, 1, height_ratios=ratios)
        ax = top_axes
    _top_view(design, ax)
    if side is not None:
        _side_view(design, side)
    return ax


def outlines(surface: Surface, plane: tuple[int, int] = (0, 1)) -> list[Polygon]:
    """Shadows [mm] of a surface on a plane, xy unless told; facets on edge leave none."""
    shadows = []
    for facet in surface.facets:
        rings = [r[:, list(plane)] * 1e3 for r in ring_vertices(facet)]
        shadows.append(Polygon(rings[0], rings[1:]).buffer(0))
    if len(shadows) > 1:  # without the seams between the strips of a bent sheet
        shadows = [s.buffer(1e-6, join_style="mitre") for s in shadows]
    parts = shapely.get_parts(shapely.union_all(shadows))
    return [p for p in parts if isinstance(p, Polygon) and p.area > 1e-4]


def outline_patch(polygon: Polygon, **style: Any) -> PathPatch:
    """A Matplotlib patch of a polygon with its holes; ``style`` as ``PathPatch`` takes it."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    rings = [shapely.get_coordinates(r) for r in (polygon.exterior, *polygon.interiors)]
    codes = [[Path.MOVETO, *[Path.LINETO] * (len(r) - 2), Path.CLOSEPOLY] for r in rings]
    return PathPatch(Path(np.concatenate(rings), np.concatenate(codes)), **style)


def add_surface(ax: Axes, surface: Surface, label: str = "", **style: Any) -> None:
    """Draw a surface seen from above, in millimetres; ``style`` as ``PathPatch`` takes it."""
    for number, outline in enumerate(outlines(surface)):
        ax.add_patch(outline_patch(outline, label="" if number else label, **style))


def draw_sensor(design: Design, colours: Sequence[str], ax: Axes, plane: tuple[int, int]) -> None:
    """Draw a sensor within its domain as seen along one axis, in millimetres.

    Args:
        design: Its design.
        colours: A colour for each electrode.
        ax: Where it is drawn.
        plane: The axes to the right and up, (0, 1) from above.
    """
    a, b = plane
    low, high = design.domain.lower * 1e3, design.domain.upper * 1e3
    walls = shapely.geometry.box(low[a], low[b], high[a], high[b])
    ax.add_patch(outline_patch(walls, fc="none", ec=FAINT, lw=1.0))
    for layer in design.layers:
        for outline in outlines(layer.surface, plane):
            ax.add_patch(outline_patch(outline, fc=LAYER_COLOUR, ec=FAINT, lw=0.6))
    electrodes = list(zip(design.electrodes, colours, strict=True))
    if plane == (0, 1):
        for conductor in design.conductors:
            add_surface(ax, conductor.surface, fc="#d5dade", ec="none")
        for electrode, colour in electrodes:
            add_surface(ax, electrode.surface, fc=colour, ec="white", lw=0.3, zorder=2)
        return
    sheets = [(c.surface, ROLE_COLOURS[c.role], 1.5) for c in design.conductors]
    for surface, colour, width in sheets + [(e.surface, c, 3.0) for e, c in electrodes]:
        low, high = surface.bounds * 1e3
        ends = [low[a], high[a]], [low[b], high[b]]
        ax.plot(*ends, color=colour, lw=width, solid_capstyle="butt", zorder=2)


def _note(ax: Axes, text: str, at: tuple[float, float], **style: Any) -> None:
    """A word in the picture, by default small and in the middle of its place."""
    ax.annotate(text, at, **{"ha": "center", "va": "center", "fontsize": 8, "color": INK, **style})


def _top_view(design: Design, ax: Axes) -> None:
    reach: list[Array] = []
    for layer in sorted(design.layers, key=lambda k: float(k.upper[2])):
        matter = "" if layer.material == "custom" else f"{layer.material}, "
        style: dict[str, Any] = {"fc": LAYER_COLOUR, "ec": "#9a9c86", "lw": 1.0, "ls": "--"}
        label = f"{layer.name} ({matter}εr {layer.eps_r:g})"
        add_surface(ax, layer.surface, label, zorder=0, **style)
        reach += list(layer.surface.bounds[:, :2] * 1e3)
    conductors = sorted(design.conductors, key=lambda c: float(c.surface.bounds[1, 2]))
    top = max(float(e.surface.bounds[1, 2]) for e in design.electrodes)
    for order, conductor in enumerate(conductors, start=1):
        buried = float(conductor.surface.bounds[1, 2]) < top - 1e-5 and bool(design.layers)
        colour = ROLE_COLOURS[conductor.role]
        style = {"fc": colour, "ec": "#5d6b73", "lw": 0.6, "ls": "-"}
        if buried:
            style = {"fc": "none", "ec": colour, "lw": 1.6, "ls": ":"}
        label = f"{conductor.name} ({conductor.role.value}{', below' if buried else ''})"
        add_surface(ax, conductor.surface, label, zorder=order / 100 + 1, **style)
        reach += list(conductor.surface.bounds[:, :2] * 1e3)
    for number, electrode in enumerate(design.electrodes):
        label, style = "" if number else "electrodes", {"ec": "#7d4510", "lw": 0.8, "zorder": 2}
        add_surface(ax, electrode.surface, label, fc=ELECTRODES[number % 2], **style)
        reach += list(electrode.surface.bounds[:, :2] * 1e3)
        x, y, room = _label_place(electrode.surface, outlines(electrode.surface))
        back = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": room}
        _note(ax, electrode.name, (x, y), fontsize=9, zorder=3, fontweight="bold", bbox=back)
    points = np.array(reach)
    margin = 0.06 * float(np.ptp(points, axis=0).max())
    ax.set_xlim(points[:, 0].min() - margin, points[:, 0].max() + margin)
    ax.set_ylim(points[:, 1].min() - margin, points[:, 1].max() + margin)
    ax.set_aspect("equal")
    dress(ax, "x [mm]", "y [mm]", design.name)
    below = ax.transAxes + ScaledTranslation(0, -0.5, ax.figure.dpi_scale_trans)
    longest = max(len(str(label)) for label in ax.get_legend_handles_labels()[1])
    columns = min(4, max(1, LEGEND_WIDTH // (longest + 6)))
    ax.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=below, ncols=columns, **LEGEND
    )


def _heights(design: Design) -> tuple[float, float]:
    """Heights of the top view and the side view [inches] that both fill the figure's width."""
    surfaces = [s.surface for s in (*design.layers, *design.sheets)]
    x, y, z = np.ptp(np.concatenate([s.bounds for s in surfaces]), axis=0)
    margin = 0.06 * max(x, y)
    wide = 6.0 / (x + 2 * margin)
    top = float(np.clip(wide * (y + 2 * margin), 2.0, 8.0))
    return top, float(np.clip(wide * z, 1.2, 5.0)) if _is_curved(design) else 1.6


def _label_place(surface: Surface, parts: list[Polygon]) -> tuple[float, float, float]:
    """Where a name goes [mm], and how opaque its background must be."""
    if not parts:
        x, y = surface.bounds.mean(axis=0)[:2] * 1e3
        return float(x), float(y), 0.8
    largest = max(parts, key=lambda p: p.area)
    spot = largest.centroid if largest.contains(largest.centroid) else None
    if spot is None or len(largest.exterior.coords) > 24:
        spot = shapely.maximum_inscribed_circle(largest).interpolate(0.0)
        spot = largest.centroid if largest.convex_hull.area < 1.1 * largest.area else spot
    return float(spot.x), float(spot.y), 0.75


def _is_curved(design: Design) -> bool:
    """Whether some electrode is not level, or some dielectric no upright prism."""
    bent = any(np.ptp(ring_vertices(f)[0][:, 2]) > 1e-6
               for e in design.electrodes for f in e.surface.facets)  # fmt: skip
    tilts = [abs(float(f.axes[2][2])) for layer in design.layers for f in layer.facets]
    return bent or any(1e-6 < t < 1 - 1e-6 for t in tilts)


def _profile(design: Design, ax: Axes) -> None:
    """What is curved, seen along +y, to scale."""
    for layer in design.layers:
        for outline in outlines(layer.surface, (0, 2)):
            ax.add_patch(outline_patch(outline, fc=LAYER_COLOUR, ec="#9a9c86", lw=0.8))
    for conductor in design.conductors:
        _edge_on(ax, conductor.surface, lambda z: z * 1e3, ROLE_COLOURS[conductor.role], 0.8)
    for number, electrode in enumerate(design.electrodes):
        _edge_on(ax, electrode.surface, lambda z: z * 1e3, ELECTRODES[number % 2], 2.0, 2.0)
    ax.set_aspect("equal")
    ax.set_xlim(ax.figure.axes[0].get_xlim())
    dress(ax, "x [mm]", "z [mm]", "side view")


def _side_view(design: Design, ax: Axes) -> None:
    """The stack seen along +y: every level of the design at equal steps, with its z in mm."""
    if _is_curved(design):
        _profile(design, ax)
        return
    backplane = -design.domain.backplane
    values = [backplane]
    for layer in design.layers:
        values += [float(layer.lower[2]), float(layer.upper[2])]
    sheets = [e.surface for e in design.electrodes] + [c.surface for c in design.conductors]
    values += [float(z) for s in sheets for z in s.bounds[:, 2]]
    levels = sorted({round(v * 1e3, 4) for v in values})

    def height(z: float) -> float:
        return float(np.interp(z * 1e3, levels, np.arange(len(levels))))

    ax.axhline(height(backplane), color=INK, lw=1.5)
    place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    floor = (0.01, height(backplane))
    _note(ax, "grounded floor of the domain", floor, xytext=(0, 3), ha="left", va="bottom", **place)
    for layer in design.layers:
        x, width = layer.lower[0] * 1e3, (layer.upper[0] - layer.lower[0]) * 1e3
        bottom, top = height(layer.lower[2]), height(layer.upper[2])
        ax.bar(x, top - bottom, width, bottom, align="edge", fc=LAYER_COLOUR, ec="#9a9c86", lw=0.8)
        thick = f"{layer.name}, {(layer.upper[2] - layer.lower[2]) * 1e3:g} mm"
        _note(ax, thick, (x + width / 2, (bottom + top) / 2))
    for conductor in design.conductors:
        _edge_on(ax, conductor.surface, height, ROLE_COLOURS[conductor.role])
    for number, electrode in enumerate(design.electrodes):
        _edge_on(ax, electrode.surface, height, ELECTRODES[number % 2])
    top_axes = ax.figure.axes[0]
    ax.set_xlim(top_axes.get_xlim())
    ax.set_ylim(-0.35, len(levels) - 0.4)
    ax.set_yticks(np.arange(len(levels)), [f"{v:.4g}" for v in levels], fontsize=8)
    dress(ax, "x [mm]", "z [mm]", "side view, heights not to scale")


def _edge_on(
    ax: Axes, surface: Surface, height: Any, colour: str, width: float = 4.0, upright: float = 0.8
) -> None:
    """Draw each facet's extent in x and z, with one line width for level facets, one for others."""
    for facet in surface.facets:
        points = ring_vertices(facet)[0]
        x, z = points[:, 0] * 1e3, points[:, 2]
        if np.ptp(z) < 1e-6:
            for low, high in _runs(facet):
                ax.plot(
                    [low, high], [height(z[0])] * 2, color=colour, lw=width, solid_capstyle="butt"
                )
        else:
            ax.fill(x, [height(v) for v in z], color=colour, alpha=0.5, lw=upright)


def _runs(facet: Any) -> list[tuple[float, float]]:
    """Where a line along x through the centroid of a level facet meets it: x [mm] from, to."""
    rings = ring_vertices(facet)
    outline = Polygon(rings[0][:, :2], [r[:, :2] for r in rings[1:]])
    (x0, _, x1, _), y = outline.bounds, outline.centroid.y
    cut = outline.intersection(shapely.geometry.LineString([(x0 - 1, y), (x1 + 1, y)]))
    parts = [p.bounds for p in shapely.get_parts(cut) if p.length > 0]
    return [(b[0] * 1e3, b[2] * 1e3) for b in parts]


SELF_COLOUR, MUTUAL_COLOUR, OUTSIDE = COLOURS[0], COLOURS[2], COLOURS[3]
LINEAR_BELOW = 1.0
"""Changes below this are drawn on a linear scale, those above on a logarithmic one [fF]."""


def plot_chips(
    recording: CapacitanceRecord, readouts: dict[str, Readout], electrode: str | None = None
) -> Figure:
    """Draw the change of one channel against the empty scene: true, and read out by each chip.

    Args:
        recording: The capacitances.
        readouts: Readouts by name.
        electrode: The electrode shown: its self capacitance, or its first pair; default the
            first electrode.

    Raises:
        ReadoutError: No channel of a readout has the electrode.
    """
    name = recording.electrodes[0] if electrode is None else electrode
    columns = min(3, len(readouts) + 1)
    rows = -(-(len(readouts) + 1) // columns)
    figure = Figure(figsize=(4.0 * columns, 2.6 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels = list(grid.flat)
    shown: dict[str, tuple[Array, str]] = {}
    for axes, readout in zip(panels[1:], readouts.values(), strict=False):
        k = _channel_of(readout, name)
        truth = recording.channels(readout.bank)
        empty = float(recording.empty_channels(readout.bank)[k])
        colour = SELF_COLOUR if readout.bank.patterns[k].is_self else MUTUAL_COLOUR
        change = 1e15 * (truth[:, k] - empty) * (1 if colour == SELF_COLOUR else -1)
        shown[readout.channel_names[k]] = (change, colour)
        _draw_chip(axes, readout, k, recording, truth, empty, colour)
    _draw_truth(panels[0], recording.time, shown)
    for axes in panels:
        axes.set_yscale("symlog", linthresh=LINEAR_BELOW, linscale=0.6)
        bare(axes)
    for axes in panels[len(readouts) + 1 :]:
        axes.remove()
    for axes in grid[:, 0]:
        axes.set_ylabel("change [fF]", **LABELS)
    for column in range(columns):
        lowest = max(r for r in range(rows) if r * columns + column <= len(readouts))
        grid[lowest, column].set_xlabel("time [s]", **LABELS)
        grid[lowest, column].tick_params(labelbottom=True)
    return figure


def _channel_of(readout: Readout, electrode: str) -> int:
    """The first channel that reads an electrode, or drives it."""
    for number, pattern in enumerate(readout.bank.patterns):
        if electrode in pattern.weights or electrode in pattern.drive:
            return number
    raise ReadoutError(
        f"no channel of {readout.name} has the electrode {electrode!r}; channels are "
        f"{', '.join(readout.channel_names)}"
    )


def _draw_truth(axes: Axes, time: Array, shown: dict[str, tuple[Array, str]]) -> None:
    for label, (change, colour) in shown.items():
        what = "fall, mutual" if colour == MUTUAL_COLOUR else "rise, self"
        axes.plot(time, change, color=colour, lw=1.6, label=f"{label} ({what})")
    axes.plot([], [], color=FAINT, lw=1.4, label="true, in the other panels")
    axes.plot([], [], color=INK, ls="", marker=".", ms=4, mew=0, label="reported by the chip")
    axes.legend(loc="lower center", **LEGEND)
    axes.set_title("true capacitance", **TITLES)


def _draw_chip(
    axes: Axes, readout: Readout, channel: int, recording: CapacitanceRecord, truth: Array,
    empty: float, colour: str,
) -> None:  # fmt: skip
    sign = 1 if readout.bank.patterns[channel].is_self else -1
    counts = readout(recording.time, truth)
    one = counts[counts.channel == channel]
    change = 1e15 * sign * (one.capacitance - empty)
    axes.plot(recording.time, 1e15 * sign * (truth[:, channel] - empty), color=FAINT, lw=1.4)
    style: dict[str, Any] = {"ls": "", "marker": ".", "zorder": 3}
    inside = ~one.saturated
    size = 2.5 if len(one) > 100 else 4.0
    axes.plot(one.time[inside], change[inside], color=colour, ms=size, mew=0, **style)
    if not inside.all():
        axes.plot(one.time[~inside], change[~inside], color=OUTSIDE, ms=3, mew=0, **style)
        axes.annotate("out of range", (0.98, 0.05), xycoords="axes fraction", ha="right",
                      fontsize=8, color=OUTSIDE)  # fmt: skip
    axes.set_title(readout.name, **TITLES)
    rate = 1 / readout.schedule.period
    axes.set_title(f"{rate:.3g} samples/s", fontsize=8, color=INK, loc="right")
