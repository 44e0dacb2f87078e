"""Random scenes of every kind, for tests of what must always hold."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.random import Generator

import capsense as cs

KINDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid", "mesh")
PLACES = ("space", "near", "touching", "covering", "wall", "outside")
GROUNDINGS = ("grounded", "floating", 1e-13, 1e-12, 100e-12)
DIELECTRICS = (1.0, 2.0, 3.0, 10.0, 80.0)


@cache
def wedge() -> cs.TriMesh:
    """A closed surface without symmetry: a box with one end drawn to an edge."""
    v = [(0, 0, 0), (60, 0, 0), (60, 40, 0), (0, 40, 0), (0, 0, 30), (0, 40, 30)]
    f = [
        (0, 2, 1), (0, 3, 2), (0, 1, 4), (1, 2, 5), (1, 5, 4), (2, 3, 5), (0, 4, 5), (0, 5, 3),
    ]  # fmt: skip
    return cs.TriMesh(np.array(v) * 1e-3 - [0.03, 0.02, 0.015], f)


def random_shape(rng: Generator, kind: str, size: float) -> cs.Box:
    """A shape of about this size [m], of random proportions."""
    a, b, c = size * rng.uniform(0.3, 1.0, 3)
    return {
        "box": lambda: cs.Box((a, b, c)),
        "sphere": lambda: cs.Sphere(a / 2),
        "capsule": lambda: cs.Capsule(a / 2, b),
        "cylinder": lambda: cs.Cylinder(a / 2, b),
        "ellipsoid": lambda: cs.Ellipsoid((a / 2, b / 2, c / 2)),
        "mesh": wedge,
    }[kind]()


def random_pose(rng: Generator, place: str, size: float) -> cs.Pose:
    """A pose of random orientation in the box of a packaged design."""
    x, y = rng.uniform(-0.09, 0.09, 2)
    z = {
        "space": rng.uniform(0.02, 0.4),
        "near": rng.uniform(0.3, 0.8) * size,
        "touching": size / 2,
        "covering": rng.uniform(-0.3, 0.3) * size,
        "wall": rng.uniform(0.0, 0.4),
        "outside": rng.uniform(0.0, 0.4),
    }[place]
    if place == "wall":
        side = 0.25 * rng.choice([-1.0, 1.0])
        x, y = (side, y) if rng.random() < 0.5 else (x, side)
        if rng.random() < 0.3:
            z = 0.49
    if place == "outside":
        x = (0.26 + 2 * size) * rng.choice([-1.0, 1.0])
    upright = place in ("touching",) or rng.random() < 0.3
    quaternion = (0, 0, 0, 1) if upright else rng.normal(size=4)
    return cs.Pose((x, y, z), quaternion)


def random_body(rng: Generator, places: Sequence[str] = PLACES) -> cs.Body:
    """Any shape, size, place, material and grounding."""
    size = float(10 ** rng.uniform(-2.3, -0.7))
    roll = rng.random()
    if roll < 0.05:
        size = 1e-5
    elif roll < 0.1:
        size = 2.0
    kind = str(rng.choice(KINDS))
    if kind == "mesh":
        size = 0.06
    metal = rng.random() < 0.65
    material = "steel" if metal else cs.Material("matter", float(rng.choice(DIELECTRICS)))
    grounding = GROUNDINGS[rng.integers(len(GROUNDINGS))]
    place = str(rng.choice(places))
    return cs.Body(
        random_shape(rng, kind, size), random_pose(rng, place, size), material, grounding
    )


def random_scene(rng: Generator, most: int = 4) -> cs.Scene:
    """One to ``most`` bodies; in a third of the scenes two of them overlap or touch."""
    bodies = [random_body(rng) for _ in range(rng.integers(1, most + 1))]
    if len(bodies) > 1 and rng.random() < 0.33:
        bodies[1] = bodies[1].moved(cs.Pose(bodies[0].pose.position, bodies[1].pose.quaternion))
    return cs.Scene(bodies)
