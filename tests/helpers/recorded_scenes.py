"""Scenes that hold every kind of body, for tests of recordings."""

from __future__ import annotations

import numpy as np

import capsense as cs

CORNERS = np.array(
    [[0, 0, 0], [0.06, 0, 0.001], [0, 0.05, 0], [0.01, 0.01, 0.04]], dtype=float
)  # fmt: skip
TETRAHEDRON = cs.TriMesh(CORNERS, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
SLAB = cs.Layers(np.full((6, 8), 0.09), np.full((6, 8), 0.1), (0.08, 0.06))


def bodies() -> list[cs.Body]:
    """One body of each shape; of each grounding; of a plain, a known and a dispersive material."""
    glass = cs.Material("my glass", 5.25, 1e-9)
    return [
        cs.Body(cs.Box((0.03, 0.02, 0.01)), material="steel", name="box"),
        cs.Body(cs.Sphere(0.012), material="water", grounding="floating", name="ball"),
        cs.Body(cs.Capsule(0.01, 0.05), material="human", grounding=97e-12, name="finger"),
        cs.Body(cs.Cylinder(0.01, 0.02), material=glass, name="rod"),
        cs.Body(cs.Ellipsoid((0.02, 0.01, 0.015)), material="fat"),
        cs.Body(TETRAHEDRON, material="wood", name="wedge"),
    ]


def scene_at(k: int) -> cs.Scene:
    """Sample k: the bodies stand in a row and turn; each third sample one is missing."""
    out = []
    for i, body in enumerate(bodies()):
        if k % 3 == 2 and i == k % 6:
            continue
        angles = (0.3 * i, 0.11 * k, 0.7 * i)
        place = (-0.09 + 0.036 * i, 0.01 * i - 0.03, 0.05 + 0.003 * ((k + i) % 5))
        out.append(body.moved(cs.Pose.from_euler(place, angles)))
    return cs.Scene(out)


def frame_at(k: int, other: float = np.inf) -> cs.DepthFrame:
    """Sample k of a depth camera: rows stored top down, a camera that turns.

    The half on the right has permittivity ``other``; the surface solver knows conductors only.
    """
    y, x = np.mgrid[0:24, 0:32]
    depth = np.where((x > 5) & (x < 20) & (y > 3) & (y < 15), 0.06 + 0.002 * k + 0.001 * y, np.nan)
    eps_r = np.where(x < 12, np.inf, other)
    pose = cs.Pose.from_euler((0.001 * k, 0.0, 0.0), (0.0, 0.0, 0.05 * k))
    camera = cs.OrthographicCamera(0.2, 0.15, pose, far=0.4, rows="-y", columns="-x")
    return cs.DepthFrame(depth, eps_r, camera, back=0.02)
