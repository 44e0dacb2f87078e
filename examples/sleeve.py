"""An arm in a sleeve of conducting cloth: a surface that moves at every step.

Run it: ``python examples/sleeve.py [FOLDER]``. A forearm in a loose, fluttering sleeve of silvered
cloth goes by in front of six electrodes, then the bare arm, then the sleeve alone; all are at
ground. A plot goes to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import capsense as cs
from capsense.humans import Build, arm
from capsense.scene.scene import DeformableSurface

STEPS = 80
CLOTH = cs.Material("silvered cloth", 1.0, 1e5)
ALONG, AROUND = 24, 32
"""Vertices of the sleeve along the arm and around it."""

LIMB = arm(Build("female"))
FOREARM = next(s for s in LIMB.segments if s.name == "forearm")
LENGTH = 0.24
TURN = cs.Pose((0.0, 0.0, 0.0), (0.7071067811865476, 0.0, 0.0, 0.7071067811865476))
"""Lays the hanging forearm along the sensor's y."""


def where(step: int) -> cs.Pose:
    """The elbow in the sensor frame: the arm crosses from left to right at 80 mm, hand at +y."""
    x = -0.15 + 0.30 * step / (STEPS - 1)
    return cs.Pose((x, -0.12, 0.08)) @ TURN


def bare_arm(pose: cs.Pose) -> list[cs.Body]:
    """The forearm's capsules."""
    return [cs.Body(p.shape, pose @ p.pose, "human", name=f"forearm {k}")
            for k, p in enumerate(FOREARM.parts)]  # fmt: skip


def sleeve_vertices(step: int, pose: cs.Pose) -> np.ndarray:
    """Vertices of the sleeve [m] in the sensor frame, shape (n, 3): a tube with folds that run."""
    along, around = np.meshgrid(
        np.linspace(0.0, -LENGTH, ALONG), np.arange(AROUND) * 2 * np.pi / AROUND, indexing="ij"
    )
    widest = max(p.radius for p in FOREARM.parts)
    fold = np.sin(3 * around + 40 * along + 0.3 * step) * np.sin(60 * along - 0.2 * step)
    radius = widest + 0.008 + 0.004 * fold
    local = np.stack([radius * np.cos(around), radius * np.sin(around), along], axis=-1)
    return pose.apply(local.reshape(-1, 3))


def sleeve_faces() -> np.ndarray:
    """Triangles of the tube, open at both ends, shape (m, 3)."""
    index = np.arange(ALONG * AROUND).reshape(ALONG, AROUND)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def main(folder: Path) -> dict[str, np.ndarray]:
    """Sense the arm with and without its sleeve, check, and draw."""
    sim = cs.Simulator("six_patch")
    sleeve = DeformableSurface(
        sleeve_vertices(0, where(0)), sleeve_faces(), material=CLOTH, name="sleeve"
    )  # fmt: skip
    curves: dict[str, np.ndarray] = {}
    for title in ("arm in a sleeve", "bare arm", "sleeve alone"):
        sim.reset()
        rows = []
        for step in range(STEPS):
            pose = where(step)
            bodies = [] if title == "sleeve alone" else bare_arm(pose)
            if title != "bare arm":
                sleeve.vertices = sleeve_vertices(step, pose)
                bodies.append(sleeve.body())
            rows.append(np.diag(sim.step(cs.Scene(bodies)).delta))
        curves[title] = np.array(rows)
        peak = curves[title].max(axis=0) * 1e15
        print(f"{title:>16}: largest changes " + " ".join(f"{v:7.2f}" for v in peak) + " fF")
    draw(curves, folder)
    check(curves)
    return curves


def check(curves: dict[str, np.ndarray]) -> None:
    """The sleeve is nearer than the arm, and hides it."""
    covered, bare, alone = (curves[k] for k in ("arm in a sleeve", "bare arm", "sleeve alone"))
    peak = covered.max(axis=0)
    print("sleeve over arm: peaks", np.round(peak / bare.max(axis=0), 2))
    print("arm in the sleeve:", np.round(np.abs(covered - alone).max(axis=0) / peak, 3))
    assert np.all(peak > bare.max(axis=0)), "a conductor in front of another raises the signal"
    assert np.all(np.abs(covered - alone).max(axis=0) < 0.05 * peak), "a conductor is a screen"
    for k in range(6):
        assert np.corrcoef(covered[:, k], bare[:, k])[0, 1] > 0.95


def draw(curves: dict[str, np.ndarray], folder: Path) -> None:
    """Write ``sleeve.png``."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    plt.style.use("capsense.plotting.capsense")
    folder.mkdir(parents=True, exist_ok=True)
    x = np.linspace(-150, 150, STEPS)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8))
    for title, style in (("arm in a sleeve", "-"), ("bare arm", ":"), ("sleeve alone", "--")):
        left.plot([], [], style, color="0.3", label=title)
        for k in range(3):
            on_top = {"color": "0.2", "linewidth": 0.9} if style == "--" else {"color": f"C{k}"}
            left.plot(x, curves[title][:, k] * 1e15, style, **on_top)
    covered = curves["arm in a sleeve"] * 1e15
    for k in range(3):
        top = int(covered[:, k].argmax())
        left.annotate(
            f"E{k + 1}", (x[top], covered[top, k]), xytext=(0, 4), textcoords="offset points",
            ha="center", color=f"C{k}",
        )  # fmt: skip
    left.set(xlabel="arm's position [mm]", ylabel="change of capacitance [fF]")
    left.set_ylim(top=1.6 * covered.max())
    left.legend(loc="upper left")
    middle = STEPS // 2
    points = sleeve_vertices(middle, where(middle)).reshape(ALONG, AROUND, 3) * 1e3
    for ring in points:
        right.plot(*np.vstack([ring, ring[:1]])[:, 1:].T, color="0.6", linewidth=0.7)
    for row in points.transpose(1, 0, 2):
        right.plot(*row[:, 1:].T, color="0.6", linewidth=0.7)
    right.plot([-42.5, 42.5], [0, 0], color="C1", linewidth=4)
    right.set(xlabel="y [mm]", ylabel="z [mm]", aspect="equal", title="the sleeve over the sensor")
    figure.tight_layout()
    figure.savefig(folder / "sleeve.png", dpi=130)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
