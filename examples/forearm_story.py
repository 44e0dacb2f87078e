"""What the forearm examples share: the robot, the person, the way of the sensor, the pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from sticks import Rod, frame_of, save_animation, silhouettes

import capsense as cs
from capsense.humans import Build, arm

SECONDS = 8.0
"""How long the story lasts [s]."""
RATE = 50.0
"""Readings per second [Hz]."""

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


View = tuple[cs.Pose, list[Rod]]
"""Where the sensor is in the world, and what is drawn around it."""


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

    def add(self, t: float, reading: cs.Reading, pose: cs.Pose, capsules: list[Rod]) -> None:
        """Keep one reading, and print every tenth as a line of the table.

        ``capsules`` are the robot's and the person's, in the world, to be drawn.
        """
        if not self.time:
            print("   t    x " + "".join(f"{n:>9}" for n in self.names) + "   change, fF")
        if len(self.time) % 10 == 0:
            row = "".join(f"{v * 1e15:9.2f}" for v in reading.delta.diagonal())
            print(f"{t:4.1f} s {pose.position[0] * 1e3:4.0f}{row}", flush=True)
        self.time.append(t)
        self.delta.append(reading.delta)
        self.along.append(pose.position[0])
        self.views.append((pose, capsules))

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
    """Write ``forearm.png`` and ``forearm.gif``."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, (top, bottom) = plt.subplots(2, 1, sharex=True, figsize=(8, 5.5), height_ratios=(3, 1))
    for k, name in enumerate(record.names):
        top.plot(
            record.time, record.diagonal[:, k] * 1e15, label=name,
            color=f"C{k % 3}", linestyle="-" if k < 3 else "--",
        )  # fmt: skip
    top.set(ylabel="change of capacitance, fF", title=title)
    top.legend(ncols=2)
    bottom.plot(record.time, np.array(record.along) * 1e3, color="black")
    bottom.set(xlabel="time, s", ylabel="sensor along\nforearm, mm")
    for axis in (top, bottom):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(folder / "forearm.png", dpi=130)
    plt.close(figure)
    _animate(record, folder / "forearm.gif")


COLOURS = {"robot": "#8090a0", "person": "#e0a080", "pad": "C1"}
RIGHT = np.array((-0.94, -0.34, 0.0))
UP = np.array((-0.10, 0.28, 0.95))
"""Axes of the picture in the world: seen from the person's left, a little from above."""


def _animate(record: Record, file: Path) -> None:
    """Robot and person, and the electrodes as bars."""
    from matplotlib import pyplot as plt
    from matplotlib.collections import PolyCollection

    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 4), dpi=70, width_ratios=(3, 2))
    left.set(xlim=(-0.66, 0.20), ylim=(0.28, 1.04), aspect="equal")
    left.set_axis_off()
    left.set_title("0.0 s")
    shapes = PolyCollection([], edgecolor="0.25", linewidth=0.5)
    left.add_collection(shapes)
    bars = right.bar(record.names, np.zeros(len(record.names)), color="C1")
    right.set(ylim=(0, record.diagonal.max() * 1.1e15), ylabel="change of capacitance, fF")
    figure.tight_layout()
    frames = []
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    box = 0.5 * corners * PAD_SIZE - (0.0, 0.0, 0.5 * PAD_SIZE[2])
    for k in range(0, len(record.time), max(1, len(record.time) // 50)):
        pose, capsules = record.views[k]
        polygons = silhouettes(capsules, RIGHT, UP, [(pose.apply(box), "pad")])
        shapes.set_verts([p for p, _ in polygons])
        shapes.set_facecolor([COLOURS[what] for _, what in polygons])
        for bar, value in zip(bars, record.diagonal[k], strict=True):
            bar.set_height(value * 1e15)
        left.set_title(f"{record.time[k]:.1f} s")
        frames.append(frame_of(figure))
    save_animation(frames, file, 120)
    plt.close(figure)
