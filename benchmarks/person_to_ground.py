"""Capacitance of a person to a grounded floor: ``python benchmarks/person_to_ground.py``.

Boundary elements of the capsules of ``capsense.humans.person``: triangles of constant charge, their
images in the floor, equations at centroids. Triangles inside another capsule are left out. The
stray part is what remains without the air under the soles, as a plate capacitor. The figures for
soles of 25 mm, and lying 0.5 m above the floor, are the table of ``capsense.humans.ground``; with
triangles of 40 mm instead of 80 mm they grow by 2 %.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
import trimesh
from numpy.typing import NDArray

import capsense as cs
from capsense.constants import EPS0, UNIT
from capsense.humans import ON_BACK, POSTURES, person
from capsense.humans.ground import SOLE_AREA

Array = NDArray[np.float64]
CASES = (
    *((posture, gap) for posture in ("standing", "sitting") for gap in (0.01, 0.025, 0.05)),
    ("lying", 0.5),
    ("standing", 100.0),
)
"""Postures, and heights of the lowest point above the floor [m]."""


def surface(bodies: list[cs.Body], edge: float) -> Array:
    """Triangles of edges up to some length [m] on capsules, without those inside another one."""
    found = []
    for body in bodies:
        radius, length = body.shape.radius, body.shape.length
        around = max(8, round(2 * math.pi * radius / edge))
        mesh = trimesh.creation.capsule(length, radius, count=(around, max(6, around)))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 1.5 * edge)
        triangles = body.pose.apply(vertices)[faces]
        keep = areas(triangles) > 1e-12
        for other in bodies:
            if other is not body:
                inside = other.pose.inverse().apply(triangles.mean(axis=1))
                keep &= other.shape.signed_distance(inside) > 0
        found.append(triangles[keep])
    return np.concatenate(found)


def areas(triangles: Array) -> Array:
    """Areas [m²], shape (n,)."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return 0.5 * np.linalg.norm(np.cross(first, second), axis=1)


def own_potential(triangles: Array) -> Array:
    """Integral of 1 / r over each triangle, r from its centroid [m], shape (n,)."""
    middle, out = triangles.mean(axis=1), np.zeros(len(triangles))
    for k in range(3):
        start, along = triangles[:, k], triangles[:, (k + 1) % 3] - triangles[:, k]
        length = np.linalg.norm(along, axis=1)
        along /= length[:, None]
        low = ((start - middle) * along).sum(axis=1)
        height = np.linalg.norm(start - middle - low[:, None] * along, axis=1)
        out += height * (np.arcsinh((low + length) / height) - np.arcsinh(low / height))
    return out


def capacitance(bodies: list[cs.Body], edge: float) -> float:
    """Of one conductor above a grounded floor at z = 0 [F]."""
    triangles = surface(bodies, edge)
    middle, area = triangles.mean(axis=1), areas(triangles)
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    np.fill_diagonal(apart, 1.0)
    matrix = area / apart
    np.fill_diagonal(matrix, own_potential(triangles))
    matrix -= area / np.linalg.norm(middle[:, None] - middle * (1, 1, -1), axis=-1)
    return float(UNIT * area @ np.linalg.solve(matrix, np.ones(len(area))))


def stray(posture: str, gap: float, edge: float) -> tuple[float, float]:
    """Capacitance of a man to ground [F], and what remains without the air under the soles."""
    man, angles = person(), POSTURES[posture]
    lying = posture == "lying"
    turn = ON_BACK if lying else (0.0, 0.0, 0.0, 1.0)
    found = capacitance(man.bodies(man.on_floor(angles, turn=turn, floor=gap), angles), edge)
    return found, found - (0.0 if lying else 2 * EPS0 * SOLE_AREA / gap)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--edge", type=float, default=0.08, help="edges of triangles [m]")
    edge = parser.parse_args().edge
    print("| posture | above the floor (m) | C (pF) | without the air under the soles (pF) |")
    print("|---|---|---|---|")
    for posture, gap in CASES:
        whole, rest = (1e12 * value for value in stray(posture, gap, edge))
        print(f"| {posture} | {gap:g} | {whole:.1f} | {rest:.1f} |", flush=True)


if __name__ == "__main__":
    main()
