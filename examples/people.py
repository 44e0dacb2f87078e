"""People and hands of ``capsense.humans``: a picture, and how much shoes matter.

Run it: ``python examples/people.py [FOLDER]``. The picture goes to the folder (``out`` by default).
The table is for a person with detailed hands whose flat right hand is 50 mm above ``six_patch``:
the largest change of a self-capacitance, by the capacitance of the person to ground.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import trimesh
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

import capsense as cs
from capsense.humans import ON_BACK, POSTURES, Limb, capacitance_to_ground, hand, person
from capsense.humans.ground import FOOTWEAR
from capsense.scene.materials import Grounding

SKIN = "#dda98c"
FINGERS = ("index", "middle", "ring", "little")
FIST = {f"{f}_{k}_flexion": a for f in FINGERS for k, a in (("mcp", 75), ("pip", 95), ("dip", 55))}
FIST |= {"thumb_cmc_abduction": 40, "thumb_cmc_flexion": 15, "thumb_mcp_flexion": 40}
FIST |= {"thumb_ip_flexion": 45}
"""Angles of a fist [degrees]."""
SPREAD = {f"{f}_mcp_abduction": a for f, a in zip(FINGERS, (12, 0, 10, 18), strict=True)}
"""Angles of a spread hand [degrees]."""
REACH = {
    "right_shoulder_flexion": 40,
    "right_shoulder_abduction": 10,
    "right_shoulder_rotation": 0,
    "right_elbow_flexion": 30,
    "right_forearm_pronation": 80,
    "right_wrist_flexion": -20,
}
"""The right forearm held out, the palm down [degrees]."""


def figure() -> Figure:
    """Three postures and three hands."""
    fig = Figure(figsize=(9.0, 6.4), layout="constrained")
    rows = fig.subfigures(2, 1, height_ratios=(1.5, 1.0))
    whole = person(hands="detailed")
    for k, (posture, angles) in enumerate(POSTURES.items()):
        pose = cs.Pose((0, 0, 0), ON_BACK if posture == "lying" else (0, 0, 0, 1))
        axes = rows[0].add_subplot(1, 3, k + 1, projection="3d", proj_type="ortho")
        draw(axes, whole.bodies(pose, angles), (12, 40), posture, 0.85)
    right, left = hand(side="right"), hand(side="left")
    shown = (("right", right, {}), ("left, spread", left, SPREAD), ("a fist", right, FIST))
    for k, (title, limb, angles) in enumerate(shown):
        axes = rows[1].add_subplot(1, 3, k + 1, projection="3d", proj_type="ortho")
        side = -70 if limb is left else 70
        draw(axes, limb.bodies(angles=angles, degrees=True), (10, side), title, 0.09)
    return fig


def draw(
    axes: object, bodies: list[cs.Body], view: tuple[float, float], title: str, half: float
) -> None:
    """Draw capsules into axes of three dimensions.

    Args:
        axes: The axes.
        bodies: The capsules.
        view: Elevation and azimuth that they are seen from [degrees].
        title: Stands below.
        half: Half the extent of the picture [m].
    """
    found = []
    for body in bodies:
        mesh = trimesh.creation.capsule(body.shape.length, body.shape.radius, count=(18, 18))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        found.append(body.pose.apply(mesh.vertices)[mesh.faces])
    triangles = np.concatenate(found)
    axes.add_collection3d(
        Poly3DCollection(
            triangles, facecolors=[SKIN] * len(triangles), shade=True,
            lightsource=LightSource(view[1] + 60, 40),
        )
    )  # fmt: skip
    middle = 0.5 * (triangles.min(axis=(0, 1)) + triangles.max(axis=(0, 1)))
    for limit, at in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        limit(at - half, at + half)
    axes.set_box_aspect((1, 1, 1), zoom=1.5)
    axes.view_init(*view)
    axes.set_axis_off()
    axes.text2D(0.5, -0.04, title, transform=axes.transAxes, ha="center")


def above(limb: Limb, angles: Mapping[str, float], gap: float, grounding: Grounding) -> cs.Scene:
    """The middle of the right palm above the origin, the lowest point of the hand at a gap [m]."""
    bodies = limb.bodies(cs.Pose(), angles, grounding=grounding)
    places = {str(b.name): b.pose.position for b in bodies}
    x, y, z = places["person_right_palm_2"]
    part = limb.segments[[s.name for s in limb.segments].index("right_palm")].parts[1]
    shift = cs.Pose((-x, -y, gap + part.radius - z))
    return cs.Scene([b.moved(shift @ b.pose) for b in bodies])


def main() -> None:
    """Draw the picture and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("out"))
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    figure().savefig(folder / "people.png", dpi=90)
    print("| posture | footwear | C to ground (pF) | change (fF) | of that by an earthed one |")
    print("|---|---|---|---|---|")
    for row in readings():
        print("| {} | {} | {:.0f} | {:.2f} | {:.1f} % |".format(*row))


def readings() -> list[tuple[str, str, float, float, float]]:
    """Posture, footwear, capacitance to ground [pF], largest change [fF], and its share of what
    an earthed person changes [%]."""
    simulator, limb = cs.Simulator("six_patch"), person(hands="detailed")
    reach = POSTURES["standing"] | {k: float(np.radians(v)) for k, v in REACH.items()}

    def change(grounding: Grounding) -> float:
        delta = simulator.step(above(limb, reach, 0.05, grounding)).delta
        return 1e15 * float(delta.diagonal().max())

    earthed, out = change("grounded"), []
    for posture, footwear in (*(("standing", k) for k in FOOTWEAR), ("lying", "any")):
        tie = capacitance_to_ground(posture, "shoes" if footwear == "any" else footwear)
        found = change(tie)
        out.append((posture, footwear, tie * 1e12, found, 100 * found / earthed))
    return out


if __name__ == "__main__":
    main()
