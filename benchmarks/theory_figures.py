"""Figures of the page on the theory: ``python benchmarks/theory_figures.py [FOLDER]``.

Both show computed data: the clusters that a step uses for a limb in front of ``six_patch``, and the
point charges of the Green's function of ``six_patch_bare``.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Rectangle

import capsense as cs
from capsense._style import COLOURS, FAINT, INK, LABELS, TITLES, bare
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.system.step import prepared

FOLDER = Path(__file__).parents[1] / "docs" / "images"
DESIGN, BARE = "six_patch", "six_patch_bare"
BLUE, ORANGE, GREEN = COLOURS[0], COLOURS[1], COLOURS[2]


def limb_scene() -> cs.Scene:
    """A limb of 40 mm radius, 60 mm in front of the electrodes."""
    pose = cs.Pose.from_euler((0.03, 0.0, 0.1), (0.0, math.pi / 2, 0.0))
    return cs.Scene([cs.Body(cs.Capsule(radius=0.04, length=0.24), pose=pose)])


def places_of(kids: Any, below: Any) -> tuple[Any, Any]:
    """Places of the nodes of a binary tree, parents above the middle of their parts, (n,), (n,)."""
    x, depth, free = np.zeros(len(kids)), np.zeros(len(kids)), 0
    order = [0]
    for k in order:
        order += [c for c in kids[k] if c >= 0 and below[k]]
        depth[[c for c in kids[k] if c >= 0]] = depth[k] + 1
    stack = [0]
    while stack:
        k = stack.pop()
        if below[k]:
            stack += [kids[k][1], kids[k][0]]
        else:
            x[k], free = free, free + 1
    for k in reversed(order):
        if below[k]:
            x[k] = x[list(kids[k])].mean()
    return x, depth


def draw_tree(path: Path) -> None:
    """The limb with the clusters that the step uses, and the tree with the active ones marked."""
    sim = cs.Simulator(DESIGN, preset="learning")
    solver: Any = sim._solver
    view = solver.look(limb_scene())
    packed = solver.pack(view)
    records = packed.records
    cut, _, functions, _ = prepared(
        records, solver.green, solver.preset.threshold, solver.preset.width, facing_of(records),
        records,
    )  # fmt: skip
    shape = packed.shapes[0]
    tree, panels = shape.tree, shape.panels
    count = len(cut.node)
    state = np.zeros(count)  # 1 solved for, 2 in the residual correction
    for f, cluster in enumerate(functions.cluster):
        if cluster >= 0:
            state[cluster] = 1 if f < functions.solved else 2
    kids = [tuple(pair) for pair in cut.kids]
    active = state == 1
    shown = [0]
    for k in shown:
        if active[k]:
            shown += list(kids[k])
    x, depth = places_of(kids, active)
    ends = [k for k in shown if not active[k]]
    ends.sort(key=lambda k: x[k])

    def panels_under(node: int) -> list[int]:
        stack, out = [node], []
        while stack:
            k = stack.pop()
            if tree.kids[k, 0] < 0:
                out.append(int(tree.panel[k]))
            else:
                stack += tree.kids[k].tolist()
        return out

    colours = plt.get_cmap("turbo")(np.linspace(0.05, 0.95, len(ends)))
    colours[::2, :3] += 0.45 * (1.0 - colours[::2, :3])  # neighbours differ in lightness
    owner = np.zeros(len(panels), int)
    for place, k in enumerate(ends):
        owner[panels_under(int(cut.node[k]))] = place
    figure, (left, right) = plt.subplots(
        2, 1, figsize=(7.6, 6.6), height_ratios=(1.0, 1.25), layout="constrained"
    )
    body = records[0]
    corners = body["position"] + body["scale"] * panels.corners @ body["rotation"].T
    normals = panels.normals @ body["rotation"].T
    front = np.flatnonzero(normals[:, 1] < 0)
    left.add_collection(
        PolyCollection(
            [1e3 * c[:, [0, 2]] for c in corners[front]],
            facecolors=[colours[owner[p]] for p in front],
            edgecolors="white",
            linewidths=0.4,
        )
    )
    for electrode in sim.design.electrodes:
        low, high = 1e3 * electrode.surface.bounds
        left.add_patch(Rectangle((low[0], -4), high[0] - low[0], 4, fc=INK, ec="white", lw=1))
    left.annotate("electrodes", (60, 0), (82, 14), arrowprops={"arrowstyle": "-"}, **LABELS)
    left.set(xlim=(-140, 205), ylim=(-12, 148), aspect="equal")
    left.set_xlabel("x in mm", **LABELS)
    left.set_ylabel("z in mm", **LABELS)
    left.set_title(
        "Limb above the sensor; one colour for each cluster that carries charge", **TITLES
    )
    bare(left)
    lines = [[(x[k], -depth[k]), (x[c], -depth[c])] for k in shown if active[k] for c in kids[k]]
    right.add_collection(LineCollection(lines, colors=FAINT, linewidths=1.0, zorder=1))
    inner = [k for k in shown if active[k]]
    right.scatter(x[inner], -depth[inner], s=34, color=BLUE, zorder=3, label="active: solved for")
    last = [k for k in ends if state[k] == 2]
    for place, k in enumerate(ends):
        right.add_patch(
            Rectangle((x[k] - 0.42, -depth[k] - 0.62), 0.84, 0.24, color=colours[place])
        )
    right.scatter(
        x[last], -depth[last], s=34, facecolor="white", edgecolor=COLOURS[3], lw=1.4, zorder=3,
        label="residual correction and error estimate",
    )  # fmt: skip
    rest = [k for k in ends if state[k] == 0]
    right.scatter(x[rest], -depth[rest], s=14, color=FAINT, zorder=3, label="single panel")
    right.legend(
        fontsize=8.5, frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 0.01)
    )
    right.set(xlim=(-1, len(ends)), ylim=(-depth.max() - 1.0, 0.6))
    right.set_xticks([])
    right.set_yticks(range(-int(depth.max()), 1), [str(-k) for k in range(-int(depth.max()), 1)])
    right.set_ylabel("level of the tree", **LABELS)
    right.set_title(
        f"Its tree of clusters: {len(inner)} of {len(tree.kids) // 2} are active", **TITLES
    )
    bare(right)
    right.spines["bottom"].set_visible(False)
    figure.savefig(path, facecolor="white")
    plt.close(figure)


def draw_levels(path: Path) -> None:
    """Point charges of the three levels, behind the design, and where each is used."""
    sim = cs.Simulator(BARE)
    function = sim._background.green
    unit, box = 1e3 * function.unit, 1e3 * function.unit * function.box
    blends = unit * function.blends
    names = ("near", "middle", "far")
    spans = ((0.0, blends[0, 1]), (blends[0, 0], blends[1, 1]), (blends[1, 0], math.inf))
    shares = ((0.0, blends[0, 0]), (blends[0, 1], blends[1, 0]), (blends[1, 1], math.inf))
    figure, axes = plt.subplots(3, 1, figsize=(7.6, 7.4), layout="constrained", sharex=True)
    x, z = np.meshgrid(np.linspace(-110, 110, 500), np.linspace(-12, 48, 200))
    away = np.hypot(
        np.maximum(np.maximum(box[0, 0] - x, x - box[1, 0]), 0.0), np.maximum(z - box[1, 2], 0.0)
    )
    for axis, name, colour, span, whole in zip(
        axes, names, (BLUE, ORANGE, GREEN), spans, shares, strict=True
    ):
        sources = unit * getattr(function, f"{name}_sources")
        modes = getattr(function, f"{name}_modes").shape[1]
        axis.contourf(x, z, away, [span[0] - 1e-9, min(span[1], 1e3)], colors=[colour], alpha=0.13)
        axis.contourf(
            x, z, away, [whole[0] - 1e-9, min(whole[1], 1e3)], colors=[colour], alpha=0.17
        )
        axis.add_patch(Rectangle((-110, -12), 220, 12, fc="white", ec="none", zorder=1.5))
        own = np.abs(sources[:, 0]) < 110
        own &= (np.abs(sources[:, 1]) < 110) & (sources[:, 2] < 45)
        axis.scatter(sources[own, 0], sources[own, 2], s=5, color=colour, zorder=3, lw=0)
        for electrode in sim.design.electrodes:
            low, high = 1e3 * electrode.surface.bounds
            axis.plot([low[0], high[0]], [low[2], low[2]], color=INK, lw=3, zorder=2)
        axis.axhline(unit * function.floor, color=INK, lw=1, ls=(0, (4, 2)), zorder=2)
        axis.set(xlim=(-110, 110), ylim=(-12, 48), aspect="equal")
        axis.set_ylabel("z in mm", **LABELS)
        where = f"points more than {span[0]:g} mm from"
        if math.isfinite(span[1]):
            where = f"points {span[0]:g} to {span[1]:g} mm from"
        axis.set_title(
            f"{name}: {len(sources)} charges, {modes} modes; {where} the design",
            **TITLES,
        )
        bare(axis)
    axes[-1].set_xlabel("x in mm", **LABELS)
    axes[0].text(
        -108, unit * function.floor - 0.3, "floor at ground", fontsize=8, color=INK, va="bottom"
    )
    figure.savefig(path, facecolor="white")
    plt.close(figure)


def main() -> None:
    """Draw both."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    matplotlib.rcParams["svg.hashsalt"] = "capsense"
    draw_tree(folder / "theory_clusters.svg")
    draw_levels(folder / "theory_levels.svg")


if __name__ == "__main__":
    main()
