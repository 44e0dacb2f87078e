"""MuJoCo: a robot arm with sixteen sensors on its shells stops before it touches a person.

The arm turns about its base. A person reaches into its way, and later draws the arm back. The
larger the change that any of 96 electrodes feels, the slower the arm turns; from a set change on
it stands. Run it: ``python examples/skin_stops.py [FOLDER]``. It needs no display and no OpenGL.
A plot and an animation go to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from shaded import Camera, capsule, frame_of, picture, save_animation
from skin_robot import (
    GROUNDING,
    JOINTS,
    MATERIALS,
    PERSON,
    RING_NAMES,
    SITES,
    model_text,
)

import capsense as cs
from capsense._style import COLOURS, INK, LABELS, LEGEND, dress, signal_colours

SECONDS = 9.0
"""How long the story lasts [s]."""
FRAMES = 60
"""Of the animation."""
RATE = 50.0
"""Readings of the whole skin per second [Hz]."""
SPEED = 0.45
"""How fast the arm turns when nobody is near [rad/s]."""
SLOW, STOP = 0.5e-15, 5e-15
"""Changes [F] at which the arm begins to slow down, and at which it stands."""
START, END = math.radians(65.0), math.radians(-35.0)
"""Where the arm turns from and to."""
POSTURE = (math.radians(35.0), math.radians(55.0))
"""Shoulder and elbow of the robot, which do not move [rad]: the forearm is level."""
REACH = (0.3, 1.3, 4.5, 5.5)
"""The person's arm starts to rise, is up, starts to sink and is down at these times [s]."""
SHOULDER = cs.Pose(
    (0.36, -0.64, 1.30), (0.0, 0.0, math.sin(math.radians(45)), math.cos(math.radians(45)))
)
"""The person faces y."""


def person_angles(t: float) -> dict[str, float]:
    """How the person holds the right arm at a time [rad]."""
    up = float(np.interp(t, REACH, (0.0, 1.0, 1.0, 0.0)))
    up = 0.5 - 0.5 * math.cos(math.pi * up)
    sway = math.radians(3.0) * math.sin(2 * math.pi * t / 1.5)
    return {"shoulder_flexion": math.radians(75.0) * up, "elbow_flexion": math.radians(8.0) + sway}


Rod = tuple[np.ndarray, np.ndarray, float, str]
"""A capsule to be drawn: its two ends [m] in the world, its radius [m], what it is."""


@dataclass
class Record:
    """What happened."""

    time: list[float] = field(default_factory=list)
    """Times [s]."""
    signal: list[np.ndarray] = field(default_factory=list)
    """Largest change that each sensor feels [F], shape (16,) each."""
    turn: list[float] = field(default_factory=list)
    """Angle of the robot's base [rad]."""
    gap: list[float] = field(default_factory=list)
    """Distance between the robot and the person [m]; negative where they overlap."""
    views: list[list[Rod]] = field(default_factory=list)
    """What is drawn; of a ring it says which."""


def story(feels: bool) -> Record:
    """Play the story; ``feels`` says whether the robot heeds its skin."""
    model = mujoco.MjModel.from_xml_string(model_text(SHOULDER))
    data = mujoco.MjData(model)
    person = {j.name: len(JOINTS) + k for k, j in enumerate(PERSON.joints)}
    data.qpos[: len(JOINTS)] = START, *POSTURE
    for name, angle in person_angles(0.0).items():
        data.qpos[person[name]] = angle
    data.ctrl[:] = data.qpos
    mujoco.mj_forward(model, data)

    skin = cs.mujoco.attach_skin(
        model, data, SITES, "arm_segment", materials=MATERIALS, grounding=GROUNDING
    )
    away = {name: reading.delta for name, reading in skin.read().items()}  # nobody is near yet
    record = Record()
    stride = round(1 / (RATE * model.opt.timestep))
    speed = SPEED
    for step in range(round(SECONDS / model.opt.timestep)):
        if step % stride == 0:
            signal = np.zeros(len(SITES))
            if feels:
                readings = skin.read()
                for k, site in enumerate(SITES):
                    change = np.diag(readings[site].delta - away[site])
                    signal[k] = max(0.0, change.max())
                speed = SPEED * float(np.clip((STOP - signal.max()) / (STOP - SLOW), 0.0, 1.0))
            _keep(record, model, data, signal)
        data.ctrl[0] = max(END, data.ctrl[0] - speed * model.opt.timestep)
        for name, angle in person_angles(data.time).items():
            data.ctrl[person[name]] = angle
        mujoco.mj_step(model, data)
    return record


def check(felt: Record, blind: Record) -> None:
    """The skin keeps the robot off the person; without it the two meet."""
    time, gap, turn = np.array(felt.time), np.array(felt.gap), np.array(felt.turn)
    assert min(blind.gap) < -0.01, f"without its skin the arm would miss by {min(blind.gap)} m"
    assert gap.min() > 0.03, f"the arm comes as near as {gap.min()} m"
    stands = (time > 3.5) & (time < REACH[2])
    assert np.ptp(turn[stands]) < math.radians(2.0), np.ptp(turn[stands])
    assert turn[stands].min() > END + math.radians(20.0), "it stands on its way, not at the end"
    assert abs(turn[-1] - END) < math.radians(1.0), "it goes on when the person is gone"
    loudest = SITES[int(np.argmax(felt.signal[int(np.flatnonzero(stands)[0])]))]
    assert loudest.startswith("fore"), loudest


# -- what is kept and drawn ----------------------------------------------------------------------


def _keep(record: Record, model: mujoco.MjModel, data: mujoco.MjData, signal: np.ndarray) -> None:
    """Keep one instant, and print every twentieth as a line of the table."""
    kinds = {int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE),
             int(mujoco.mjtGeom.mjGEOM_CYLINDER)}  # fmt: skip
    solid = [g for g in range(model.ngeom) if int(model.geom_type[g]) in kinds]
    whose = {g: "person" if model.geom(g).name.partition("_")[0] in ("right", "torso", "head")
             else "robot" for g in solid}  # fmt: skip
    arm = [g for g in solid if whose[g] == "robot" and model.geom(g).name != "pedestal"]
    people = [g for g in solid if whose[g] == "person"]
    gap = min(mujoco.mj_geomDistance(model, data, a, b, 2.0, None) for a in arm for b in people)
    rods = []
    for g in solid:
        radius, half = model.geom_size[g, 0], model.geom_size[g, 1]
        if int(model.geom_type[g]) == int(mujoco.mjtGeom.mjGEOM_SPHERE):
            half = 0.0
        along = data.geom_xmat[g].reshape(3, 3)[:, 2] * half
        name = model.body(int(model.geom_bodyid[g])).name
        what = name if name in RING_NAMES else whose[g]
        rods.append((data.geom_xpos[g] - along, data.geom_xpos[g] + along, float(radius), what))
    if not record.time:
        print("   t   turn     gap   largest change, and where it is felt")
    if len(record.time) % 20 == 0:
        k = int(np.argmax(signal))
        felt = f"{signal[k] * 1e15:6.2f} fF  {SITES[k]}" if signal[k] > 0 else "     —"
        turn = math.degrees(data.qpos[0])
        print(f"{data.time:4.1f} s {turn:4.0f}° {gap * 1e3:4.0f} mm {felt}", flush=True)
    record.time.append(data.time)
    record.signal.append(signal)
    record.turn.append(float(data.qpos[0]))
    record.gap.append(gap)
    record.views.append(rods)


LOOKS = {"robot": (0.55, 0.58, 0.62), "person": (0.85, 0.64, 0.52)}
CAMERA = Camera((1.75, 1.45, 1.85), (0.26, -0.15, 1.13), math.radians(27.0), (440, 500))


def draw(felt: Record, blind: Record, folder: Path) -> None:
    """Write ``skin_stops.png`` and ``skin_stops.webp``."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(8, 7), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 2))
    signal = np.array(felt.signal) * 1e15
    for n, k in enumerate(np.argsort(-signal.max(axis=0))[:6]):
        top.plot(felt.time, signal[:, k], color=COLOURS[n], label=SITES[k])
    for level, text in ((SLOW, "slows down"), (STOP, "stands")):
        top.axhline(level * 1e15, color=INK, linestyle=":", linewidth=1)
        top.text(felt.time[-1], level * 1e15, text, ha="right", va="bottom", **LABELS)
    dress(top, "", "largest change\nof a sensor [fF]", "A robot arm stops before a person")
    top.legend(ncols=2, title="sensor", **LEGEND)
    for record, text, style in ((felt, "with its skin", "-"), (blind, "without", "--")):
        colour = COLOURS[0] if record is felt else COLOURS[3]
        middle.plot(record.time, np.degrees(record.turn), style, color=colour, label=text)
        bottom.plot(record.time, np.array(record.gap) * 1e3, style, color=colour, label=text)
    dress(middle, "", "angle of\nthe arm [°]")
    bottom.axhspan(min(blind.gap) * 1e3 - 10, 0, color=COLOURS[3], alpha=0.12, linewidth=0)
    bottom.text(0.1, min(blind.gap) * 1e3, "touches", color=COLOURS[3], va="bottom")
    bottom.set_ylim(-80, 300)
    dress(bottom, "time [s]", "distance to\nthe person [mm]")
    middle.legend(**LEGEND)
    figure.savefig(folder / "skin_stops.png", dpi=100)
    _animate(felt, folder / "skin_stops.webp")


def _animate(record: Record, file: Path) -> None:
    """Robot and person; a ring's colour tells the largest change that it feels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(CAMERA.size[1] / 100, CAMERA.size[0] / 100), dpi=100)
    FigureCanvasAgg(figure)
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    image = axis.imshow(np.zeros((*CAMERA.size, 3), np.uint8))
    words = axis.text(16, 26, "", **LABELS)
    meshes: dict[tuple[float, float], object] = {}
    frames = []
    for k in np.linspace(0, len(record.time) - 1, FRAMES).astype(int):
        rings = record.signal[k].reshape(len(RING_NAMES), -1).max(axis=1) / STOP
        looks = LOOKS | dict(zip(RING_NAMES, signal_colours(rings) / 255, strict=True))
        parts = []
        for a, b, radius, what in record.views[k]:
            size = radius, round(float(np.linalg.norm(b - a)), 6)
            mesh = meshes.setdefault(size, capsule(*size))
            parts.append((mesh, _along(a, b), looks[what]))
        image.set_data(picture(parts, CAMERA))
        words.set_text(
            f"{record.time[k]:.1f} s    distance {record.gap[k] * 1e3:.0f} mm    "
            f"largest change {record.signal[k].max() * 1e15:.1f} fF"
        )
        frames.append(frame_of(figure))
    save_animation(frames, file, 150)


def _along(a: np.ndarray, b: np.ndarray) -> cs.Pose:
    """The pose of a capsule along z whose ends are to be at two points."""
    x, y, z = (b - a) / max(float(np.linalg.norm(b - a)), 1e-12)
    quaternion = (-y, x, 0.0, 1.0 + z) if z > -0.999 else (1.0, 0.0, 0.0, 0.0)
    if not (x or y or z):
        quaternion = (0.0, 0.0, 0.0, 1.0)
    return cs.Pose(tuple((a + b) / 2), quaternion)


def main(folder: Path) -> Record:
    """Play the story with and without the skin, draw both, and check them."""
    felt = story(feels=True)
    print("\nthe same without the skin:")
    blind = story(feels=False)
    draw(felt, blind, folder)
    check(felt, blind)
    return felt


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
