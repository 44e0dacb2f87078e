"""Scenes and reference figures for the tests of the field core.

``tests/data/reference_capacitances.json`` holds figures computed elsewhere by boundary and finite
elements, ``tests/data/reference_capsule.json`` those of ``benchmarks/references.py``. Both state
their methods and errors.
"""

from __future__ import annotations

import json
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

import capsense as cs
from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design, Domain, Electrode
from capsense.field.background import BuildSettings
from capsense.humans import Build, arm

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "data"
PICO = 1e-12
BAR = (0.15, 0.15, 0.02)
"""The bar of the reference cases [m]."""
COARSE = BuildSettings().refined(0.5)
"""Settings for what does not ask for accuracy: a field is built in a second or two."""


@cache
def figures() -> dict[str, Any]:
    """The carried-over reference figures, as in their file."""
    return json.loads((DATA / "reference_capacitances.json").read_text())


@cache
def capsule_figures() -> dict[str, Any]:
    """The capsule's reference figures, as in their file."""
    return json.loads((DATA / "reference_capsule.json").read_text())


def empty_reference(table: str) -> Array:
    """Reference Maxwell matrix of an empty domain [F]."""
    return PICO * np.array(figures()[table]["none"])


def delta_reference(table: str, case: str) -> Array:
    """Reference change of the Maxwell matrix [F]."""
    return PICO * np.array(figures()[table][case]) - empty_reference(table)


def capsule_reference(gap_mm: int) -> Array:
    """Reference change by the limb-like capsule over ``six_patch_bare`` [F]."""
    return PICO * np.array(capsule_figures()["cases"][str(gap_mm)]["delta"])


def bar(gap: float, x: float = 0.0, **options: Any) -> cs.Body:
    """The reference bar with its lower face ``gap`` [m] above the electrode plane."""
    return cs.Body(cs.Box(BAR), cs.Pose((x, 0.0, gap + BAR[2] / 2)), **options)


def arm_scenes(gap: float) -> list[cs.Scene]:
    """An arm whose forearm lies ``gap`` [m] above the plane, along x, in three places.

    It has ten capsules, and its hand leaves the domain of ``six_patch``.
    """
    limb = arm(Build("male", percentile=50), "right")
    turn = cs.Pose.from_euler((0, 0, 0), (0, 90, 0), degrees=True).quaternion
    parts = limb.bodies(cs.Pose((0, 0, 0), turn), {})
    low = min(b.pose.position[2] - b.shape.params[0] for b in parts if "forearm" in str(b.name))
    places = (cs.Pose((x, 0, gap - low), turn) for x in (0.35, 0.45, 0.55))
    return [cs.Scene(limb.bodies(place, {})) for place in places]


def ball(z: float = 0.08, radius: float = 0.04, **options: Any) -> cs.Body:
    """A sphere over the sensor's centre."""
    return cs.Body(cs.Sphere(radius), cs.Pose((0.0, 0.0, z)), **options)


def capsule(gap: float, **options: Any) -> cs.Body:
    """The limb-like capsule with its lowest point ``gap`` [m] above the electrode plane."""
    data = capsule_figures()
    axis = np.array(data["axis"])
    center = np.array(data["center_at_gap_zero"]) + np.array([0.0, 0.0, gap])
    side = np.cross((0.0, 0.0, 1.0), axis)
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(axis, side), axis], axis=1)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rotation, center
    return cs.Body(
        cs.Capsule(data["radius"], data["length"]), cs.Pose.from_matrix(frame), **options
    )


def body_of(case: str) -> cs.Body:
    """The body of a carried-over case: ``bar 10``, ``sphere_diel_80.0``, …"""
    what, *rest = case.replace("_", " ").split()
    if what == "bar":
        return bar(float(rest[0]) / 1e3)
    if rest[0] == "diel":
        return ball(material=cs.Material("dielectric", eps_r=float(rest[1])))
    return ball(grounding=rest[0])


def rectangle(center: ArrayLike, size: ArrayLike) -> shapely.Polygon:
    """A rectangle [m] centred at (x, y)."""
    (x, y), (w, h) = np.asarray(center), np.asarray(size)
    return shapely.box(x - w / 2, y - h / 2, x + w / 2, y + h / 2)


def sheet(polygon: shapely.Polygon, z: float = 0.0) -> Surface:
    """A flat sheet at height z [m] whose outlines are its rims."""
    polygon = shapely.geometry.polygon.orient(polygon)
    rims = [
        ((*a, z), (*b, z))
        for ring in (polygon.exterior, *polygon.interiors)
        for a, b in pairwise(np.asarray(ring.coords)[:, :2])
    ]
    facet = Facet(polygon, np.array([0.0, 0.0, z]), np.eye(3))
    return Surface((facet,), np.array(rims, dtype=float))


def patches(
    *polygons: shapely.Polygon, size: ArrayLike = 0.5, backplane: float = 0.25, **parts: Any
) -> Design:
    """A design of flat electrodes in the plane z = 0 of a box [m]."""
    electrodes = tuple(Electrode(f"E{i}", sheet(p)) for i, p in enumerate(polygons, start=1))
    a, b, c = (float(v) for v in np.broadcast_to(size, 3))
    return Design("patches", Domain((a, b, c), backplane), electrodes, **parts)


def off_diagonal(matrix: Array) -> Array:
    """The entries off the diagonal, flat."""
    return matrix[~np.eye(len(matrix), dtype=bool)]


def assert_physical(matrix: Array, slack: float = 1e-3) -> None:
    """A Maxwell matrix: finite, symmetric, off-diagonals ≤ 0, row sums ≥ 0.

    To within ``slack`` of the largest entry; symmetry to rounding.
    """
    assert np.isfinite(matrix).all()
    largest = np.abs(matrix).max()
    np.testing.assert_allclose(matrix, matrix.T, rtol=0, atol=1e-6 * largest)
    worst = off_diagonal(matrix).max() / largest
    assert worst <= slack, f"an off-diagonal is positive: {worst:.2e} of the largest entry"
    least = matrix.sum(axis=1).min() / largest
    assert least >= -slack, f"a row sum is negative: {least:.2e} of the largest entry"
