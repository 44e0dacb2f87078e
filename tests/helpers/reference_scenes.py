"""Scenes over ``six_patch_bare`` whose ΔC is known from boundary elements.

``tests/data/reference_map.json`` holds the map of 89 scenes, carried over from elsewhere;
``tests/data/reference_more.json`` those of ``benchmarks/reference_more.py``.
Both state their own errors.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import capsense as cs

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "data"
MAP, MORE = DATA / "reference_map.json", DATA / "reference_more.json"
DESIGN = "six_patch_bare"
FEMTO = 1e-15
DIAGONAL_FLOOR = 0.01
"""Of a scene's largest entry: what diagonals smaller than it are measured against."""
SHAPES = {
    "sphere": lambda s: cs.Sphere(s[0]),
    "capsule": lambda s: cs.Capsule(*s),
    "cylinder": lambda s: cs.Cylinder(*s),
    "ellipsoid": lambda s: cs.Ellipsoid(tuple(s)),
    "box": lambda s: cs.Box(tuple(s)),
}


@dataclass(frozen=True, eq=False)
class ReferenceScene:
    """A scene, and what it changes."""

    name: str
    """Unique: the category, the gap, and a number where that is not enough."""
    category: str
    gap: float
    """Height of the lowest point above the electrode plane [m]."""
    scene: cs.Scene
    delta: Array
    """ΔC [F], shape (6, 6)."""
    error: float
    """Estimated error of the reference, relative to the largest entry."""


def body_of_json(data: dict[str, Any]) -> cs.Body:
    """The body of one entry of a case's ``bodies``."""
    kind = data["kind"]
    shape = SHAPES[data["shape"]](data["size"])
    pose = cs.Pose(tuple(data["position"]), tuple(data["quaternion"]))
    if kind == "diel":
        return cs.Body(shape, pose, cs.Material("dielectric", eps_r=data["eps_r"]), "floating")
    return cs.Body(shape, pose, "steel", kind if isinstance(kind, str) else float(kind))


@cache
def reference_scenes(path: Path = MAP) -> tuple[ReferenceScene, ...]:
    """The scenes of a file, in its order."""
    data = json.loads(path.read_text())
    seen: Counter[str] = Counter()
    out = []
    for case in data["cases"]:
        name = f"{case['category']} {case['gap_mm']:g} mm"
        seen[name] += 1
        if seen[name] > 1:
            name += f" ({seen[name]})"
        out.append(
            ReferenceScene(
                name, case["category"], 1e-3 * case["gap_mm"],
                cs.Scene([body_of_json(b) for b in case["bodies"]]),
                FEMTO * np.array(case["delta_fF"]), case.get("error", data["error"]),
            )
        )  # fmt: skip
    return tuple(out)


def fleet_of(scenes: list[ReferenceScene], **options: Any) -> tuple[cs.Fleet, Array]:
    """A fleet with a scene in each environment, and its poses."""
    most = max(len(s.scene) for s in scenes)
    fleet = cs.Fleet(DESIGN, [cs.Body(cs.Sphere(0.01))] * most, len(scenes), **options)
    poses = np.zeros((len(scenes), most, 7))
    poses[..., 6] = 1.0
    for place in range(most):
        fleet.change(place, [s.scene[place] if place < len(s.scene) else None for s in scenes])
        for e, s in enumerate(scenes):
            if place < len(s.scene):
                pose = s.scene[place].pose
                poses[e, place] = [*pose.position, *pose.quaternion]
    return fleet, poses


def diagonal_errors(delta: Array, reference: Array) -> Array:
    """Relative errors of the diagonal; entries below the floor are measured against it."""
    truth = np.diag(reference)
    floor = DIAGONAL_FLOOR * np.abs(reference).max()
    return (np.diag(delta) - truth) / np.maximum(np.abs(truth), floor)


def other_errors(delta: Array, reference: Array) -> Array:
    """Errors of the entries above the diagonal over the scene's largest entry."""
    upper = np.triu_indices(len(delta), 1)
    return (delta - reference)[upper] / np.abs(reference).max()
