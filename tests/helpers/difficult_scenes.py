"""Scenes with difficult bodies, whose ΔC is known from ``benchmarks/difficult_reference.py``."""

from __future__ import annotations

import json
import math
import tomllib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reference_scenes import DATA, body_of_json

import capsense as cs
from capsense.design import parse_design

Array = NDArray[np.float64]
DIFFICULT = DATA / "difficult.json"
SECTIONS = 16
"""Sides of cups and of what fills them."""


def outline(shape: str, size: list[float]) -> Array:
    """Radius and height [m] of the corners of a cup or a prism, from the lower pole, (n, 2)."""
    if shape == "prism":
        radius, height = size
        return np.array([[0, 0], [radius, 0], [radius, height], [0, height]])
    radius, height, wall, base = size
    inner = radius - wall
    return np.array(
        [[0, 0], [radius, 0], [radius, height], [inner, height], [inner, base], [0, base]]
    )


def polyhedron(shape: str, size: list[float]) -> cs.TriMesh:
    """A cup or a prism of :data:`SECTIONS` sides, standing on z = 0."""
    rings = outline(shape, size)
    turn = 2 * math.pi * np.arange(SECTIONS) / SECTIONS
    round_ = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    points = [[0.0, 0.0, rings[0, 1]], [0.0, 0.0, rings[-1, 1]]]
    for radius, z in rings[1:-1]:
        points += [[*(radius * p), z] for p in round_]
    faces = []
    last = 2 + SECTIONS * (len(rings) - 3)
    for k in range(SECTIONS):
        n = (k + 1) % SECTIONS
        faces += [[0, 2 + n, 2 + k], [1, last + k, last + n]]
        for ring in range(2, last, SECTIONS):
            a, b, c, d = ring + k, ring + n, ring + SECTIONS + n, ring + SECTIONS + k
            faces += [[a, b, c], [a, c, d]]
    return cs.TriMesh(np.array(points), np.array(faces))


def body_of(data: dict[str, Any]) -> cs.Body:
    """The body of one entry of a case's ``bodies``."""
    if data["shape"] not in ("cup", "prism"):
        return body_of_json(data)
    plain = body_of_json({**data, "shape": "sphere", "size": [1.0]})
    mesh = polyhedron(data["shape"], data["size"])
    return cs.Body(mesh, plain.pose, plain.material, plain.grounding)


def scene_of(case: dict[str, Any]) -> cs.Scene:
    """The scene of a case."""
    return cs.Scene([body_of(b) for b in case["bodies"]])


def design_of(name: str, texts: dict[str, str]) -> cs.Design:
    """A design that the file holds, or a packaged one."""
    return parse_design(tomllib.loads(texts[name])) if name in texts else cs.load_design(name)


def difficult() -> tuple[list[dict[str, Any]], dict[str, str]]:
    """The cases of the file, and the texts of designs that are not packaged."""
    data = json.loads(DIFFICULT.read_text())
    return data["cases"], data["designs"]
