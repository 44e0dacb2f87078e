"""A person-like figure as one mesh with one connected skin."""

from __future__ import annotations

import numpy as np
import trimesh

import capsense as cs


def figure() -> cs.TriMesh:
    """A figure of one connected skin: a trunk, an arm to the side, one that reaches down with three
    fingers, two legs. Its fingertips are 21 mm above the sensor."""
    boxes = np.array([
        [[-8, -10, 22], [-1, 10, 60]],  # lower and upper corners, in steps
        [[-8, 9, 45], [-4, 26, 50]],
        [[-4, -2, 5], [0, 2, 24]], [[-4, -3, 4], [0, 3, 9]],
        [[-3, -3, 1], [-2, -2, 5]], [[-3, -1, 1], [-2, 0, 5]], [[-3, 1, 1], [-2, 2, 5]],
        [[-8, -6, 58], [-5, -2, 90]], [[-8, 2, 58], [-5, 6, 90]],
    ])  # fmt: skip
    low = boxes.min(axis=(0, 1)) - 1
    solid = np.zeros(boxes.max(axis=(0, 1)) - low + 1, bool)
    for a, b in boxes - low:
        solid[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = True
    squares = []
    for axis in range(3):
        u, v = np.roll(np.eye(3), -1 - axis, axis=0)[:2]
        for way in (0, 1):
            corner = np.argwhere(solid & ~np.roll(solid, 1 - 2 * way, axis=axis)).astype(float)
            corner[:, axis] += way
            ring = corner, corner + u, corner + u + v, corner + v
            squares.append(np.stack(ring if way else ring[::-1], axis=1))
    corners = np.concatenate(squares)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    mesh = trimesh.Trimesh(vertices, faces.reshape(-1, 3), process=False)
    trimesh.smoothing.filter_laplacian(mesh, iterations=4)
    return cs.TriMesh(0.008 * (mesh.vertices + low + [0, 0, 2]), mesh.faces)


def person(open_skin: bool = False, at: tuple[float, float, float] = (0, 0, 0)) -> cs.Scene:
    """The figure on 100 pF, moved; without its soles if it is to be open."""
    mesh = figure()
    if open_skin:
        mesh = cs.TriMesh(mesh.vertices, mesh.faces[mesh.vertices[mesh.faces, 2].min(axis=1) < 0.6])
    assert (mesh.parts, mesh.closed) == (1, not open_skin)
    return cs.Scene([cs.Body(mesh, cs.Pose(at), "human", 100e-12)])
