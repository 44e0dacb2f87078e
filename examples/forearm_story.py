"""What the forearm examples share: the robot, the person, the way of the sensor, the pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from shaded import Camera, Part, frame_of, picture, save_animation

import capsense as cs
from capsense._style import COLOURS, INK, LABELS, LEGEND, dress
from capsense.humans import Build, arm
from capsense.plotting.designs import outline_patch, outlines

SECONDS = 8.0
"""How long the story lasts [s]."""
RATE = 50.0
"""Readings per second [Hz]."""
FRAMES = 60
"""Of the animation."""

PERSON = arm(Build("female", percentile=50), "right")
SHOULDER = cs.Pose((0.0, 0.0, 0.95))
"""The person faces x and stretches the forearm out along it."""
ROBOT_BASE = cs.Pose((0.25, -0.50, 0.42))

# A robot arm of seven joints: link, joint axis, origin in the link before [m], capsule to [m].
ROBOT = (
    ("turret", (0, 0, 1), (0.0, 0.0, 0.00), (0.0, 0.0, 0.10), 0.055),
    ("shoulder", (0, 1, 0), (0.0, 0.0, 0.14), (0.0, 0.0, 0.12), 0.050),
    ("upper", (0, 0, 1), (0.0, 0.0, 0.16), (0.0, 0.0, 0.12), 0.045),
    ("elbow", (0, 1, 0), (0.0, 0.0, 0.16), (0.0, 0.0, 0.11), 0.042),
    ("fore", (0, 0, 1), (0.0, 0.0, 0.15), (0.0, 0.0, 0.11), 0.038),
    ("wrist", (0, 1, 0), (0.0, 0.0, 0.15), (0.0, 0.0, 0.03), 0.036),
    ("flange", (0, 0, 1), (0.0, 0.0, 0.06), (0.0, 0.0, 0.02), 0.034),
)
REST = (1.2, 0.3, 0.0, 1.6, 0.0, 1.2, 0.0)
"""Joint angles that the robot starts from [rad]."""
PAD_SIZE = (0.115, 0.085, 0.009)
PAD = cs.Pose((0.0, 0.0, 0.065))
"""The sensor frame in the flange's frame: z out of the robot."""
PAD_BOX = cs.Pose((0.0, 0.0, 0.0595))
"""The middle of the pad's housing, which ends 1 mm behind the electrodes."""


def sensor_target(t: float) -> cs.Pose:
    """Where the sensor should be at a time [s]: down over the arm, from beyond the hand inwards.

    The electrodes look down; the sensor's x runs along the forearm, from elbow to hand.
    """
    share = 0.5 - 0.5 * math.cos(math.pi * min(1.0, t / (0.9 * SECONDS)))
    along = 0.50 + (0.12 - 0.50) * share
    return cs.Pose((along, 0.0, 0.715), (1.0, 0.0, 0.0, 0.0))


def person_angles(t: float) -> dict[str, float]:
    """How the person moves [rad]: the forearm bobs and turns a little."""
    return {
        "elbow_flexion": math.radians(91.0 + 2.5 * math.sin(2 * math.pi * t / 2.0)),
        "forearm_pronation": math.radians(70.0),
        "shoulder_flexion": 0.0,
    }


View = tuple[cs.Pose, list[Part]]
"""Where the sensor is in the world, and what is drawn around it."""
SKIN, SHIRT, METAL = (0.85, 0.64, 0.52), (0.30, 0.42, 0.58), (0.62, 0.64, 0.67)


@dataclass
class Record:
    """What was seen."""

    names: tuple[str, ...]
    time: list[float] = field(default_factory=list)
    """Times [s]."""
    delta: list[np.ndarray] = field(default_factory=list)
    """Changes of the Maxwell matrix [F], shape (M, M) each."""
    along: list[float] = field(default_factory=list)
    """Position of the sensor along the forearm [m]."""
    views: list[View] = field(default_factory=list)
    """What there is to be drawn."""

    def add(self, t: float, reading: cs.Reading, pose: cs.Pose, parts: list[Part]) -> None:
        """Keep one reading, and print every tenth as a line of the table.

        ``parts`` are the robot's and the person's, in the world, to be drawn.
        """
        if not self.time:
            print("   t x,mm " + "".join(f"{n:>9}" for n in self.names) + "   change, fF")
        if len(self.time) % 10 == 0:
            row = "".join(f"{v * 1e15:9.2f}" for v in reading.delta.diagonal())
            print(f"{t:4.1f} s {pose.position[0] * 1e3:4.0f}{row}", flush=True)
        self.time.append(t)
        self.delta.append(reading.delta)
        self.along.append(pose.position[0])
        self.views.append((pose, parts))

    @property
    def diagonal(self) -> np.ndarray:
        """Changes of the self-capacitances [F], shape (samples, M)."""
        return np.array([np.diag(d) for d in self.delta])


def check(record: Record) -> None:
    """What must hold of every such ride.

    The electrodes feel the hand in the order in which they reach it; the person bobs and all
    electrodes see it; matrices are those of passive conductors.
    """
    diagonal = record.diagonal
    arrival = diagonal[np.array(record.time) < 0.45 * SECONDS]
    first = (arrival > 0.5 * arrival.max(axis=0)).argmax(axis=0)  # E1, E4 lead, E3, E6 follow
    assert first[0] < first[1] < first[2], first
    assert first[3] < first[4] < first[5], first
    assert diagonal.max() > 20e-15, diagonal.max()
    assert diagonal[0].max() < 0.1 * diagonal.max(), diagonal[0]
    for delta in record.delta:
        assert np.abs(delta - delta.T).max() < 1e-6 * np.abs(delta).max()
        assert np.all(delta[~np.eye(len(delta), dtype=bool)] > -1e-18), "shielding, never coupling"
    late = np.array(record.time) > 0.75 * SECONDS
    swing = np.ptp(diagonal[late], axis=0) / diagonal[late].mean(axis=0)
    assert swing.min() > 0.1, swing


def save(record: Record, folder: Path) -> None:
    """Write ``forearm.csv``: times, places, and the change of every entry of the matrix."""
    folder.mkdir(parents=True, exist_ok=True)
    names, count = record.names, len(record.names)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    head = ["time [s]", "along [mm]", *(f"{names[i]} {names[j]} [fF]" for i, j in pairs)]
    rows = [
        [f"{t:.3f}", f"{x * 1e3:.2f}", *(f"{d[p] * 1e15:.4f}" for p in pairs)]
        for t, x, d in zip(record.time, record.along, record.delta, strict=True)
    ]
    text = "\n".join(",".join(row) for row in [head, *rows])
    (folder / "forearm.csv").write_text(text + "\n", encoding="utf-8")


# -- pictures ------------------------------------------------------------------------------------


def draw(record: Record, folder: Path, title: str) -> None:
    """Write ``forearm.png`` and ``forearm.webp``."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    _curves(top, record, len(record.time))
    figure.suptitle(title, fontsize=10, fontweight="bold", color=INK)
    bottom.plot(record.time, np.array(record.along) * 1e3, color=INK)
    dress(bottom, "time [s]", "along forearm [mm]")
    figure.savefig(folder / "forearm.png", dpi=130)
    _animate(record, folder / "forearm.webp", FRAMES)


def _curves(axes: Any, record: Record, count: int) -> list[Any]:
    """The first samples of all electrodes."""
    lines = [
        axes.plot(record.time[:count], record.diagonal[:count, k] * 1e15, color=COLOURS[k],
                  lw=1.8, label=name)[0]
        for k, name in enumerate(record.names)
    ]  # fmt: skip
    axes.set(xlim=(0, record.time[-1]), ylim=(0, record.diagonal.max() * 1.08e15))
    place = {"loc": "lower left", "bbox_to_anchor": (-0.02, 1.0), "ncols": 6}
    axes.legend(**place, **LEGEND, handlelength=1.0, columnspacing=0.8)
    dress(axes, "", "change of capacitance [fF]")
    return lines


CAMERA = Camera((1.55, 0.78, 1.33), (0.15, -0.13, 0.745), math.radians(32.0), (430, 520))
SCALE = 0.1
"""Length of the bar that is drawn as a scale [m]."""


def _electrodes() -> list[Any]:
    """The electrodes as meshes in the sensor frame, and once more on the back of the pad."""
    out = []
    for electrode in cs.load_design("six_patch").electrodes:
        corners = electrode.surface.triangles.reshape(-1, 3)
        back = corners - (0.0, 0.0, PAD_SIZE[2] + 0.0025)
        both = np.concatenate([corners, back])
        out.append(trimesh.Trimesh(both, np.arange(len(both)).reshape(-1, 3), process=False))
    return out


def _plan(figure: Any) -> list[Any]:
    """The electrodes as seen from the front, with their names, in a corner of the picture."""
    axes = figure.add_axes((0.012, 0.03, 0.15, 0.22))
    patches = []
    for electrode in cs.load_design("six_patch").electrodes:
        (outline,) = outlines(electrode.surface)
        patches.append(axes.add_patch(outline_patch(outline, ec="white", lw=0.8)))
        x, y, _ = 1e3 * electrode.surface.bounds.mean(axis=0)
        axes.text(x, y, electrode.name, ha="center", va="center", fontsize=7, color="white")
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_axis_off()
    return patches


def _animate(record: Record, file: Path, count: int) -> None:
    """Robot, person and pad; electrodes light up in the colours of their curves."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.2, 4.3), dpi=100)
    FigureCanvasAgg(figure)
    left, right = figure.add_axes((0, 0, 5.2 / 9.2, 1)), figure.add_axes((0.635, 0.13, 0.35, 0.78))
    left.set_axis_off()
    image = left.imshow(np.zeros((*CAMERA.size, 3), np.uint8))
    distance = float(np.linalg.norm(np.subtract(CAMERA.target, CAMERA.position)))
    long = SCALE * CAMERA.focal / distance
    left.plot([500 - long, 500], [408, 408], color=INK, lw=2)
    left.text(500 - long / 2, 402, f"{1e3 * SCALE:.0f} mm", ha="center", **LABELS)
    clock = left.text(20, 28, "", **LABELS)
    plan = _plan(figure)
    lines = _curves(right, record, 0)
    right.set_xlabel("time [s]", **LABELS)
    dots = right.scatter([0.0] * len(lines), [0.0] * len(lines), c=COLOURS[: len(lines)], s=22)
    housing = trimesh.creation.box(PAD_SIZE)
    below = cs.Pose((0.0, 0.0, PAD_BOX.position[2] - PAD.position[2]))
    plates, strongest = _electrodes(), record.diagonal.max(axis=0)
    frames = []
    for k in np.linspace(0, len(record.time) - 1, count).astype(int):
        pose, parts = record.views[k]
        lit = np.sqrt(np.clip(record.diagonal[k] / strongest, 0.0, 1.0))[:, None]
        colours = 0.30 + lit * (np.array([to_rgb(c) for c in COLOURS[: len(lit)]]) - 0.30)
        pad = (housing, pose @ below, (0.16, 0.17, 0.19))
        glowing = [(plate, pose, c) for plate, c in zip(plates, colours, strict=True)]
        image.set_data(picture([*parts, pad], CAMERA, glowing))
        for patch, colour in zip(plan, colours, strict=True):
            patch.set_facecolor(colour)
        clock.set_text(f"{record.time[k]:.1f} s")
        for line, values in zip(lines, 1e15 * record.diagonal[: k + 1].T, strict=True):
            line.set_data(record.time[: k + 1], values)
        now = np.full(len(lit), record.time[k])
        dots.set_offsets(np.column_stack([now, 1e15 * record.diagonal[k]]))
        frames.append(frame_of(figure))
    save_animation(frames, file, round(1e3 * record.time[-1] / count))
