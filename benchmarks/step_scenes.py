"""The worlds that ``steps.py`` times, each in motion: what a sensor sees at sample k.

Lowest points are at the stated height; bodies go to and fro along x by 10 mm, 100 samples a period.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from layered_views import view

import capsense as cs
from capsense.humans import arm, leg

Array = NDArray[np.float64]
View = cs.Scene | cs.DepthFrame
DESIGN = "six_patch"
PERIOD, REACH = 100, 0.010
PIXELS, WIDE = 64, 0.5
QUADS = 20
"""Along each edge of the sheet."""
ROUND = 16
"""Points around and along the capsules of the person's mesh: 480 triangles each."""
FINGER, FOREARM, BAR = (
    cs.Capsule(0.008, 0.060),
    cs.Capsule(0.040, 0.250),
    cs.Box((0.15, 0.15, 0.02)),
)
SLANT = (0.3, 0.5, 0.0)
"""Turns of a finger about z, then the new y, then the new x [rad]."""
LEVEL = (0.4, math.pi / 2, 0.0)


def sway(k: int) -> float:
    """How far along x bodies are at sample k [m]."""
    return REACH * math.sin(2 * math.pi * k / PERIOD)


def low(shape: cs.Shape, gap: float, at: tuple[float, float] = (0.0, 0.0),
        turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> cs.Body:  # fmt: skip
    """A grounded conductor, turned, its lowest point ``gap`` [m] above the sensor."""
    rotation = Rotation.from_euler("ZYX", turn)
    down = np.abs(rotation.as_matrix()[2])
    if isinstance(shape, cs.Box):
        half = float(down @ np.array(shape.size) / 2)
    elif isinstance(shape, cs.Capsule):
        half = shape.radius + down[2] * shape.length / 2
    else:
        half = shape.radius
    return cs.Body(shape, cs.Pose((*at, gap + half), tuple(rotation.as_quat())), "steel")


def moved(body: cs.Body, x: float) -> cs.Body:
    """The body, shifted along x [m]."""
    (a, b, c), turn = body.pose.position, body.pose.quaternion
    return body.moved(cs.Pose((a + x, b, c), turn))


def swaying(*bodies: cs.Body) -> Callable[[int], cs.Scene]:
    """All bodies go to and fro together."""
    return lambda k: cs.Scene([moved(b, sway(k)) for b in bodies])


def hand(gap: float) -> list[cs.Body]:
    """Five fingers and a palm, level, the lowest finger at ``gap`` [m]; behind it, a body."""
    parts = [low(cs.Box((0.085, 0.09, 0.028)), gap, (0.04, 0.0))]
    for k in range(4):
        y = -0.036 + 0.024 * k
        parts.append(low(cs.Capsule(0.008, 0.065), gap + 0.003, (-0.035, y), (0, math.pi / 2, 0)))
    parts.append(low(cs.Capsule(0.009, 0.05), gap + 0.003, (0.03, 0.065), (0.9, math.pi / 2, 0)))
    return [*parts, low(cs.Box((0.3, 0.3, 0.1)), 0.15)]


def far_capsules() -> list[cs.Body]:
    """Twelve capsules, 0.12 to 0.25 m above the sensor."""
    rng = np.random.default_rng(1)
    return [
        low(cs.Capsule(0.02, 0.06), float(rng.uniform(0.12, 0.25)),
            (-0.15 + 0.1 * (n % 4), -0.1 + 0.1 * (n // 4)), tuple(rng.uniform(0, 1, 3)))
        for n in range(12)
    ]  # fmt: skip


def near_capsules() -> list[cs.Body]:
    """Twelve fingers side by side, 12 to 20 mm above the sensor."""
    rng = np.random.default_rng(2)
    return [
        low(FINGER, float(rng.uniform(0.012, 0.020)),
            (-0.06 + 0.04 * (n % 4), -0.035 + 0.035 * (n // 4)), (0.0, rng.uniform(0, 0.5), 0.0))
        for n in range(12)
    ]  # fmt: skip


# -- what a camera sees ----------------------------------------------------------------------------


def seen(body: cs.Body) -> Callable[[int], Callable[[], cs.DepthFrame]]:
    """The body in a camera of 64 × 64 pixels over 0.5 m. The images are there before; frames are
    made within the timed step."""

    @cache
    def image(k: int) -> Array:
        return view(body.shape, moved(body, sway(k)).pose, PIXELS, WIDE)[0]

    def sample(k: int) -> Callable[[], cs.DepthFrame]:
        depth = image(k % PERIOD)
        return lambda: cs.DepthFrame(depth)

    return sample


def sheet() -> tuple[Array, NDArray[np.int64]]:
    """A level sheet of 120 × 100 mm of 400 quads, two triangles each."""
    u, v = (np.linspace(-0.5, 0.5, QUADS + 1) * side for side in (0.12, 0.10))
    x, y = np.meshgrid(u, v)
    first = (np.arange(QUADS)[:, None] * (QUADS + 1) + np.arange(QUADS)).ravel()
    across = first + QUADS + 2
    faces = np.concatenate([
        np.column_stack([first, first + 1, across]), np.column_stack([first, across, across - 1]),
    ])  # fmt: skip
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.025)]), faces


def waving() -> Callable[[int], Callable[[], cs.Scene]]:
    """A conducting sheet 20 to 30 mm above the sensor in which a wave runs; its vertices are set
    within the timed step."""
    vertices, faces = sheet()
    foil = cs.DeformableSurface(vertices, faces, material="steel")

    def sample(k: int) -> Callable[[], cs.Scene]:
        wave = 0.005 * np.sin(40 * vertices[:, 0] + 2 * math.pi * k / PERIOD)
        now = vertices + np.column_stack([0 * wave, 0 * wave, wave])

        def make() -> cs.Scene:
            foil.vertices = now
            return cs.Scene([foil.body()])

        return make

    return sample


# -- a person --------------------------------------------------------------------------------------


def person_parts() -> list[cs.Body]:
    """A person whose right arm reaches down to the sensor: the limbs of ``capsense.humans``, and
    capsules for trunk and head. The fingertips are 20 mm above the sensor."""
    reach = {"shoulder_flexion": 75.0, "elbow_flexion": 15.0, "wrist_flexion": 20.0}
    parts = arm(side="right").bodies(cs.Pose((0, -0.19, 1.4)), reach, degrees=True)
    parts += arm(side="left").bodies(cs.Pose((0, 0.19, 1.4)))
    for side, y in (("right", -0.09), ("left", 0.09)):
        parts += leg(side=side).bodies(cs.Pose((0, y, 0.9)))
    parts.append(cs.Body(cs.Capsule(0.13, 0.35), cs.Pose((0, 0, 1.17))))
    parts.append(cs.Body(cs.Capsule(0.09, 0.08), cs.Pose((0, 0, 1.62))))
    turn = cs.Pose((0, 0, 0), tuple(Rotation.from_euler("y", 90, degrees=True).as_quat()))
    parts = [p.moved(turn @ p.pose) for p in parts]  # what was ahead is below
    ends = [
        p.pose.apply(np.array([[0, 0, s * p.shape.length / 2] for s in (-1, 1)])) for p in parts
    ]
    depth = [(e[:, 2] - p.shape.radius).min() for e, p in zip(ends, parts, strict=True)]
    lowest = int(np.argmin(depth))
    tip = ends[lowest][ends[lowest][:, 2].argmin()]
    shift = cs.Pose((-tip[0], -tip[1], 0.020 - depth[lowest]))
    return [cs.Body(p.shape, shift @ p.pose, "human", 100e-12) for p in parts]


@cache
def person_mesh() -> cs.TriMesh:
    """The same as one mesh of some 20,000 triangles, a closed part for each capsule."""
    found = []
    for part in person_parts():
        mesh = trimesh.creation.capsule(part.shape.length, part.shape.radius, (ROUND, ROUND))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        mesh.apply_transform(part.pose.matrix)
        found.append(mesh)
    whole = trimesh.util.concatenate(found)
    return cs.TriMesh(whole.vertices, whole.faces)


def person() -> cs.Body:
    """The mesh as a body, tied to ground by 100 pF."""
    return cs.Body(person_mesh(), cs.Pose(), "human", 100e-12)


# -- the list --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class World:
    """What is timed."""

    name: str
    sample: Callable[[int], View | Callable[[], View]]
    """What is seen at a sample, or what makes it within the timed step."""
    target: float | None
    """Of the standard preset's median [ms], if it has one."""
    exact: Callable[[], cs.Scene] | None = None
    """The bodies of sample 0 as plain shapes; None where these are what is seen anyway."""
    judged: bool = True
    """Whether its error is asked for."""
    single: bool = False
    """Whether it is one plain body, which the paper's scheme is timed with, too."""


def worlds() -> list[World]:
    """All of them."""
    ball, near = low(cs.Sphere(0.03), 0.030), low(FINGER, 0.005, (0.012, 0.007), SLANT)
    finger = low(FINGER, 0.015, (0.012, 0.007), SLANT)
    forearm, bar = low(FOREARM, 0.020, turn=LEVEL), low(BAR, 0.020)
    table = low(cs.Box((0.6, 0.5, 0.04)), 0.020)
    trunk = low(cs.Capsule(0.12, 0.3), 0.020, turn=LEVEL)
    return [
        World("ball of 30 mm radius at 30 mm", swaying(ball), 0.3, single=True),
        World("finger at 15 mm", swaying(finger), 0.3, single=True),
        World("finger at 5 mm", swaying(near), 0.7, single=True),
        World("forearm at 20 mm", swaying(forearm), 0.3, single=True),
        World("bar 150 x 150 x 20 mm at 20 mm", swaying(bar), 0.3, single=True),
        World("table 600 x 500 x 40 mm at 20 mm", swaying(table), None),
        World("trunk of 120 mm radius at 20 mm", swaying(trunk), None),
        World("hand at 20 mm, body behind", swaying(*hand(0.020)), 0.8),
        World("finger at 15 mm, 12 far capsules", swaying(finger, *far_capsules()), 0.6),
        World("12 near capsules", swaying(*near_capsules()), 2.5),
        World("depth frame 64 x 64, forearm", seen(forearm), 2.5, lambda: swaying(forearm)(0)),
        World("depth frame 64 x 64, bar", seen(bar), 2.5, lambda: swaying(bar)(0)),
        World("deforming sheet, 400 quads", waving(), 4.0, judged=False),
        World("person, mesh", swaying(person()), 2.0),
    ]  # fmt: skip


def random_scenes(count: int, after: int = 0) -> list[cs.Scene]:
    """One body each, of four shapes, anywhere over the sensor, 5 to 100 mm above it."""
    rng = np.random.default_rng(after)
    shapes = (FINGER, FOREARM, cs.Sphere(0.03), BAR)
    return [
        cs.Scene([low(shapes[n % 4], float(rng.uniform(0.005, 0.1)),
                      tuple(rng.uniform(-0.06, 0.06, 2)), tuple(rng.uniform(0, 0.5, 3)))])
        for n in range(count)
    ]  # fmt: skip
