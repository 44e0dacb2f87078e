"""What is wrong with where a sensor sits and what it sees: every finding with its fix."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.scene import Body, Layers, Scene, TriMesh
from capsense.scene.contact import TOUCH, distances, points_on
from capsense.simulator import Simulator
from capsense.surface.solver import PRESETS

Array = NDArray[np.float64]

_COARSE = 0.05
"""Panels of a body wider than this [m] say little of a sensor."""


def placement(scene: Scene, simulator: Simulator) -> list[str]:
    """What is wrong with the bodies of a scene, given in the sensor frame."""
    points = {e.name: points_on(e.surface.triangles) for e in simulator.design.electrodes}
    found = []
    for body in scene:
        found += _contacts(body, points)
        found += _coarse(body, PRESETS[simulator.preset].panels)
    return found


def nothing_seen(design: Design) -> str:
    """The finding for a sensor whose domain is empty."""
    size = " × ".join(f"{v:g}" for v in design.domain.size)
    return (
        f"nothing is in view, so that every change is exactly 0: the sensor sees {size} m in front "
        "of its electrodes, along the z of its frame; bring something there, or look for what "
        "exclude, groups and exclude_own leave out"
    )


def turned_round(names: list[str]) -> str:
    """The finding for a sensor that has everything at its back."""
    listed = ", ".join(map(repr, names[:4])) + (", …" if len(names) > 4 else "")
    return (
        f"nothing is in view, so that every change is exactly 0, but {listed} would be if the "
        "sensor faced the other way: its z must point out of the sensor; if it should see that, "
        'turn its frame half round about x (quaternion (1, 0, 0, 0), in MJCF euler="180 0 0")'
    )


def _contacts(body: Body, electrodes: dict[str, Array]) -> list[str]:
    """Electrodes within a body, and electrodes that touch it."""
    if isinstance(body.shape, Layers):
        return []
    inside, touching, depth = [], [], 0.0
    for name, points in electrodes.items():
        off = distances(body, points)
        if off.min() < -TOUCH:
            inside.append(name)
            depth = max(depth, -float(off.min()))
        elif off.min() < TOUCH:
            touching.append(name)
    out = []
    if inside:
        out.append(
            f"{_electrodes(inside, 'lies', 'lie')} inside {body.name!r}, up to "
            f"{1e3 * depth:.2g} mm deep, and readings mean nothing; {_mend(body, depth)}"
        )
    if touching:
        out.append(
            f"{_electrodes(touching, 'touches', 'touch')} {body.name!r}, as a short circuit would; "
            f"{_mend(body, 1e-3)}"
        )
    return out


def _mend(body: Body, depth: float) -> str:
    return (
        f"move the sensor's frame at least {1e3 * max(depth, 1e-3):.2g} mm out of it, or leave it "
        f"out with exclude=[{body.name!r}]"
    )


def _coarse(body: Body, panels: int) -> list[str]:
    """A large mesh, whose panels are shared out over all of it."""
    if not isinstance(body.shape, TriMesh):
        return []
    corners = body.shape.vertices[body.shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    width = math.sqrt(area / panels)
    if width < _COARSE or body.shape.parts > 1:
        return []
    return [
        f"{body.name!r} is a mesh of {area:.2g} m², solved with panels of some {1e3 * width:.0f} "
        "mm; cut it into meshes of 0.4 m or less, or keep only what comes near the sensor"
    ]


def _electrodes(names: list[str], one: str, many: str) -> str:
    if len(names) == 1:
        return f"electrode {names[0]!r} {one}"
    listed = ", ".join(map(repr, names[:6])) + (f" and {len(names) - 6} more" * (len(names) > 6))
    return f"electrodes {listed} {many}"
