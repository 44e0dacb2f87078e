"""Soft pads all over a link of a KUKA iiwa: a fist comes near, presses two of them, and leaves.

The pads are spread over the link's own mesh, which comes with PyBullet. They glow in orange with
what they sense of the fist before it touches; a blue ring tells that their foam is pressed. Run it:
``python examples/skin_touch.py [FOLDER]``. It needs no display and no OpenGL. A plot and an
animation go to the folder (``out`` by default).
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pybullet as p
import pybullet_data
import trimesh
from shaded import Camera, capsule, frame_of, picture, save_animation

import capsense as cs
from capsense._style import COLOURS, LABELS, LEGEND, dress, signal_colours
from capsense.design import parse_design

LINK = 4
"""The link of the robot that has the skin."""
ANGLES = (0.6, 0.7, 0.0, -1.5, 0.3, 0.9, 0.0)
"""How the robot stands [rad]."""
SIDE, SPACING = 0.020, 0.030
"""Edge of the electrodes, and least distance of their middles [m]."""
FOAM = 0.003
"""Thickness of the foam [m]."""
PAD = {
    "name": "soft_pad",
    "domain": {"size": [0.4, 0.4, 0.3], "backplane": 0.005},
    "electrode": [{"name": "E", "shape": "rectangle", "size": [SIDE, SIDE]}],
    "cover": [{"name": "foam", "thickness": FOAM, "eps_r": 1.6, "modulus": 60e3}],
}
"""One electrode under foam; the link behind it is at ground."""
RADIUS, LENGTH = 0.035, 0.05
"""Of the fist [m], a capsule."""
FAR = 0.12
"""Distance of the fist at the start and at the end [m]."""
DEPTH = 0.4
"""Share of the foam's thickness that the fist presses in."""
CUES = (2.0, 3.0, 4.0, 5.0, 7.0)
"""Times [s]: it touches, lets go, touches again, lets go, is away."""
READINGS, FRAMES = 70, 70
"""Of the skin, and pictures of the animation."""


@dataclass
class Record:
    """What happened; a row for each instant."""

    time: np.ndarray
    """Times [s], (n,)."""
    gap: np.ndarray
    """Distance from the foam to the fist [m], negative where it is pressed in, (n,)."""
    fist: list[cs.Pose]
    """The fist in the frame of the link."""
    names: list[str] = field(default_factory=list)
    """Of the pads."""
    change: list[np.ndarray] = field(default_factory=list)
    """Changes of the pads' capacitances [F], (pads,) each."""
    force: list[np.ndarray] = field(default_factory=list)
    """Forces on their foam [N], (pads,) each."""


def play(layout: cs.skin.SkinLayout) -> Record:
    """Let the fist come to one pad and to a neighbour, and read the skin."""
    poses = {name: pose for name, (_, pose) in layout.items()}
    middle = {name: np.array(pose.position) for name, pose in poses.items()}
    first = max(poses, key=lambda name: _aside(poses[name]))
    second = min(
        (name for name in poses if name != first),
        key=lambda name: float(np.linalg.norm(middle[name] - middle[first])),
    )
    time = np.linspace(0.0, CUES[-1], READINGS)
    press = -DEPTH * FOAM
    gap = np.interp(
        time, [0, CUES[0], CUES[0] + 0.4, CUES[1], 0.5 * (CUES[1] + CUES[2]), CUES[2],
               CUES[2] + 0.4, CUES[3], CUES[4]],
        [FAR, 0.0, press, 0.0, 0.03, 0.0, press, 0.0, FAR],
    )  # fmt: skip
    share = np.interp(time, [CUES[1], CUES[2]], [0.0, 1.0])
    record = Record(time, gap, [], names=list(poses))
    skin = cs.Skin(layout)
    fist = cs.Body(cs.Capsule(RADIUS, LENGTH), material="human", grounding=100e-12, name="fist")
    for t, distance, part in zip(time, gap, share, strict=True):
        at = _between(poses[first], poses[second], float(part))
        record.fist.append(at @ cs.Pose((0.0, 0.0, FOAM + RADIUS + distance), ACROSS))
        readings = skin.step(cs.Scene([fist.moved(record.fist[-1])]), time=float(t))
        record.change.append(np.array([readings[n].delta[0, 0] for n in record.names]))
        touches = [readings[n].touch for n in record.names]
        record.force.append(np.array([0.0 if touch is None else touch.total for touch in touches]))
    return record


ACROSS = (0.0, math.sin(math.pi / 4), 0.0, math.cos(math.pi / 4))
"""Turns a capsule's axis from z to x."""


def _between(a: cs.Pose, b: cs.Pose, part: float) -> cs.Pose:
    """A pose between two."""
    position = (1 - part) * np.array(a.position) + part * np.array(b.position)
    sign = 1.0 if np.dot(a.quaternion, b.quaternion) >= 0 else -1.0
    turn = (1 - part) * np.array(a.quaternion) + part * sign * np.array(b.quaternion)
    return cs.Pose(tuple(position), tuple(turn / np.linalg.norm(turn)))


def check(record: Record) -> None:
    """Pads sense the fist before it touches them; two are pressed, one after the other."""
    change, force = np.array(record.change), np.array(record.force)
    before = record.gap > 1e-9
    assert np.all(force[before] == 0.0), "no force without touch"
    loudest = int(np.argmax(change.max(axis=0)))
    near = change[(record.gap < 0.04) & (record.time < CUES[0]), loudest]
    assert near.min() > 20.0 * abs(change[0, loudest]), "it is sensed 40 mm away"
    for start, end in ((CUES[0], CUES[1]), (CUES[2], CUES[3])):
        during = (record.time > start) & (record.time < end)
        assert force[during].sum(axis=1).max() > 0.5, "it is pressed"
    early, late = (force[record.time < 3.5].sum(axis=0), force[record.time > 3.5].sum(axis=0))
    assert np.argmax(early) != np.argmax(late), "two pads, one after the other"


# -- the robot and pictures ----------------------------------------------------------------------


class Robot:
    """The robot as it stands: meshes of its links and their places in the world."""

    def __init__(self) -> None:
        client = p.connect(p.DIRECT)
        self.folder = Path(pybullet_data.getDataPath()) / "kuka_iiwa"
        robot = p.loadURDF(str(self.folder / "model.urdf"), useFixedBase=True,
                           physicsClientId=client)  # fmt: skip
        for k, angle in enumerate(ANGLES):
            p.resetJointState(robot, k, angle, physicsClientId=client)
        self.parts = []
        for _, link, _, size, file, *pose, rgba in (
            s[:8] for s in p.getVisualShapeData(robot, physicsClientId=client)
        ):
            frame = cs.Pose()
            if link >= 0:
                state = p.getLinkState(
                    robot, link, computeForwardKinematics=1, physicsClientId=client
                )
                frame = cs.Pose(*state[4:6])
            mesh = trimesh.load(file.decode(), force="mesh", process=False)
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            mesh.apply_scale(size)
            self.parts.append((mesh, frame @ cs.Pose(*pose), np.clip(rgba[:3], 0.0, 0.9)))
            if link == LINK - 1:
                self.link = frame
                self.middle = (frame @ cs.Pose(*pose)).apply(mesh.bounds.mean(axis=0))
        p.disconnect(client)


CAMERA = Camera((1.05, -0.75, 1.05), (0.26, 0.14, 0.66), math.radians(25.0), (430, 520))


def faces_camera(_: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Which parts of the link, given by their normals in its frame (n, 3), the pads are on."""
    return normals @ ROBOT.link.rotation.T @ CAMERA.axes[2] < -0.15


def _aside(pose: cs.Pose) -> float:
    """How well a touch of a pad is seen: it faces the picture's right, and is in its middle."""
    world = ROBOT.link @ pose
    return float(world.rotation[:, 2] @ CAMERA.axes[0]) - 2.0 * abs(
        float(np.subtract(world.position, ROBOT.middle) @ CAMERA.axes[1])
    )


def _plate(side: float, height: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((side, side, 0.0015))
    mesh.apply_translation((0.0, 0.0, height))
    return mesh


def draw(record: Record, layout: cs.skin.SkinLayout, folder: Path) -> None:
    """Write ``skin_touch.png`` and ``skin_touch.webp``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    change, force = 1e15 * np.array(record.change), np.array(record.force)
    strongest = np.argsort(-change.max(axis=0))[:4]
    figure = Figure(figsize=(9.6, 4.3), dpi=100)
    FigureCanvasAgg(figure)
    left = figure.add_axes((0, 0, 5.2 / 9.6, 1))
    left.set_axis_off()
    image = left.imshow(np.zeros((*CAMERA.size, 3), np.uint8))
    words = left.text(16, 26, "", **LABELS)
    top, bottom = (figure.add_axes((0.63, y, 0.35, 0.34)) for y in (0.58, 0.12))
    lines = []
    for axes, values in ((top, change), (bottom, force)):
        for n, k in enumerate(strongest):
            axes.plot(record.time, values[:, k], color=COLOURS[n], lw=0.8, alpha=0.35)
            label = record.names[k].replace("_", " ")
            lines += axes.plot([], [], color=COLOURS[n], lw=1.8, label=label)
    top.set_yscale("symlog", linthresh=1.0)
    top.set_ylim(0.0, 2.0 * change.max())
    dress(top, "", "change of capacitance [fF]")
    dress(bottom, "time [s]", "force on the foam [N]")
    top.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=4, handlelength=1.0,
               columnspacing=0.8, **LEGEND)  # fmt: skip
    electrode, ring = _plate(SIDE, FOAM), _plate(SIDE + 0.006, FOAM - 0.001)
    blue, quiet = np.array(to_rgb(COLOURS[0])), np.array((0.30, 0.32, 0.35))
    strength = np.log10(1.0 + np.clip(change, 0.0, None)) / np.log10(1.0 + change.max())
    fist = capsule(RADIUS, LENGTH)
    frames = []
    for k in np.linspace(0, len(record.time) - 1, FRAMES).astype(int):
        glowing = []
        for n, name in enumerate(record.names):
            at = ROBOT.link @ layout[name][1]
            pressed = min(1.0, 1.5 * force[k, n] / force.max())
            glowing.append((ring, at, quiet + pressed * (blue - quiet)))
            glowing.append((electrode, at, signal_colours(strength[k, n : n + 1])[0] / 255))
        skin_colour = (0.85, 0.64, 0.52)
        parts = [*ROBOT.parts, (fist, ROBOT.link @ record.fist[k], skin_colour)]
        image.set_data(picture(parts, CAMERA, glowing))
        gap = f"{1e3 * record.gap[k]:.0f} mm away" if record.gap[k] > 0 else "touches"
        words.set_text(f"{record.time[k]:.1f} s    fist {gap}")
        for n, line in enumerate(lines):
            values = (change, force)[n // len(strongest)][: k + 1, strongest[n % len(strongest)]]
            line.set_data(record.time[: k + 1], values)
        frames.append(frame_of(figure))
    figure.savefig(folder / "skin_touch.png")
    save_animation(frames, folder / "skin_touch.webp", round(1e3 * record.time[-1] / FRAMES))


ROBOT = Robot()


def main(folder: Path) -> Record:
    """Lay the skin out, play the story, check and draw it."""
    mesh = trimesh.load(ROBOT.folder / "meshes" / f"link_{LINK}.stl", force="mesh")
    layout = cs.skin.from_mesh(mesh, spacing=SPACING, region=faces_camera, patch=parse_design(PAD))
    record = play(layout)
    change, force = 1e15 * np.array(record.change), np.array(record.force)
    print("   t      gap   largest change, and where   force")
    for k in range(0, READINGS, 5):
        n = int(np.argmax(change[k]))
        print(
            f"{record.time[k]:4.1f} s {1e3 * record.gap[k]:5.1f} mm {change[k, n]:9.2f} fF  "
            f"{record.names[n]} {force[k].sum():8.2f} N"
        )
    draw(record, layout, folder)
    check(record)
    return record


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default="out", type=Path, help="of the pictures")
    main(parser.parse_args().folder)
