"""Single bodies of every rigid kind at a known distance in front of a flat design."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.fleet import Fleet
from capsense.scene import Shape

Array = NDArray[np.float64]


class NearScenes(NamedTuple):
    """One body in each environment."""

    bodies: list[cs.Body]
    poses: Array
    """Shape (e, 1, 7), exact in single precision."""
    names: list[str]


def shapes(rng: np.random.Generator) -> dict[str, Shape]:
    """One of each kind, of random proportions; the mesh is an ellipsoid of 320 triangles."""
    ball = trimesh.creation.icosphere(2, 0.012)
    size = rng.uniform(0.006, 0.02, 3)
    return {
        "box": cs.Box(tuple(2.0 * size)),
        "sphere": cs.Sphere(size[0]),
        "capsule": cs.Capsule(0.7 * size[0], 2.5 * size[1]),
        "cylinder": cs.Cylinder(0.7 * size[0], 2.0 * size[1]),
        "ellipsoid": cs.Ellipsoid(tuple(size)),
        "mesh": cs.TriMesh(ball.vertices * [1.0, 1.5, 0.7], ball.faces),
    }


def reach_down(shape: Shape, turn: Array) -> float:
    """How far a shape reaches below its origin when it is turned by a matrix [m]."""
    if isinstance(shape, cs.TriMesh):
        return -float((shape.vertices @ turn.T)[:, 2].min())
    (a, b, c), z = shape.params, np.abs(turn[2])
    match shape:
        case cs.Box():
            return float(shape.params @ z)
        case cs.Capsule():
            return float(a + b * z[2])
        case cs.Cylinder():
            return float(b * z[2] + a * np.sqrt(max(0.0, 1.0 - z[2] ** 2)))
        case cs.Ellipsoid():
            return float(np.linalg.norm([a * z[0], b * z[1], c * z[2]]))
    return float(a)


def near_scenes(
    fleet: Fleet, count: int, gaps: tuple[float, float], grounding: str | float, seed: int
) -> NearScenes:
    """Scenes over the electrodes of a fleet's design, the lowest points between two gaps [m].

    Gaps are spread evenly by their logarithms; negative ones, bodies that overlap the face, evenly.
    A quarter of the bodies stands upright, the others are turned at random.
    """
    solver, rng = fleet._solver, np.random.default_rng(seed)
    top = solver.length * solver.green.gap.top
    pads = np.array([e.surface.bounds.mean(axis=0)[:2] for e in fleet.design.electrodes])
    bodies, poses, names = [], np.zeros((count, 1, 7)), []
    for e in range(count):
        name, shape = list(shapes(rng).items())[e % 6]
        turn = Rotation.random(random_state=int(rng.integers(1 << 30)))
        turn = Rotation.identity() if e % 4 == 3 else turn
        gap = rng.uniform(*gaps) if gaps[0] < 0 else np.exp(rng.uniform(*np.log(gaps)))
        poses[e, 0, :2] = pads[rng.integers(len(pads))] + rng.uniform(-0.004, 0.004, 2)
        poses[e, 0, 2] = top + gap + reach_down(shape, turn.as_matrix())
        poses[e, 0, 3:] = turn.as_quat()
        bodies.append(cs.Body(shape, material="steel", grounding=grounding))
        names.append(f"{name} {1e3 * gap:.3f} mm")
    poses = poses.astype(np.float32).astype(float)
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    return NearScenes(bodies, poses, names)


def fleet_of(design: cs.Design | str, scenes: NearScenes, **options: object) -> Fleet:
    """A fleet with a scene in each environment."""
    fleet = Fleet(design, scenes.bodies[:1], len(scenes.bodies), **options)
    fleet.change(0, scenes.bodies)
    return fleet
