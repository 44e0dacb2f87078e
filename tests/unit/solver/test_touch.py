"""Which conductors touch each other."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from approximate import approx
from scipy.optimize import lsq_linear

import capsense as cs
from capsense.scene.geometry_kernels import parted
from capsense.solver.tree.matter import matter_of, segment_distance, touch


def test_distance_of_segments() -> None:
    """Differential: against bounded least squares, for segments of any length, points too."""
    rng = np.random.default_rng(1)
    for k in range(60):
        first, second = rng.normal(size=(2, 2, 3))
        if k % 5 == 0:
            second[1] = second[0]
        if k % 5 == 1:
            second[1] = second[0] + 0.7 * (first[1] - first[0])
        if k % 7 == 0:
            first[1] = first[0]

        ways = np.stack([first[1] - first[0], second[0] - second[1]], axis=1)
        best = lsq_linear(ways, second[0] - first[0], (0, 1), tol=1e-14)
        apart = math.sqrt(2 * best.cost)
        assert segment_distance(first, second) == approx(apart, abs=2e-4)
        assert segment_distance(first, second) <= apart + 1e-9


BALL, CAPSULE = cs.Sphere(0.02), cs.Capsule(0.01, 0.05)
BOX, CYLINDER = cs.Box((0.04, 0.04, 0.04)), cs.Cylinder(0.02, 0.04)


@pytest.mark.parametrize(
    ("one", "other", "reach"),
    [(BALL, BALL, 0.04), (BALL, CAPSULE, 0.055), (CAPSULE, CAPSULE, 0.07), (BALL, BOX, 0.04),
     (CAPSULE, BOX, 0.055), (BOX, BOX, 0.04), (BOX, CYLINDER, 0.04), (CAPSULE, CYLINDER, 0.055)],
    ids=repr,
)  # fmt: skip
def test_bodies_one_above_the_other(one: cs.Shape, other: cs.Shape, reach: float) -> None:
    """Analytic: they touch at the sum of their half heights, in either order, in any frame."""
    turn = cs.Pose((0.3, -0.1, 0.2), (0.2, 0.5, -0.1, 0.8))
    for gap, expected in ((-1e-3, True), (1e-7, True), (1e-4, False)):
        first = cs.Body(one, turn @ cs.Pose((0, 0, 0)))
        second = cs.Body(other, turn @ cs.Pose((0, 0, reach + gap)))
        assert touch(first, second) is expected
        assert touch(second, first) is expected


def _floating(rng: np.random.Generator, count: int, spread: float) -> cs.Scene:
    """Floating conductors of all kinds of primitives, anywhere."""
    shapes = [
        BALL,
        CAPSULE,
        BOX,
        CYLINDER,
        cs.Ellipsoid((0.03, 0.02, 0.01)),
        cs.Box((0.1, 0.02, 0.01)),
    ]
    poses = (
        cs.Pose(*np.split(rng.normal(size=7) * [*[spread] * 3, 1, 1, 1, 1], [3]))
        for _ in range(count)
    )
    return cs.Scene(
        [cs.Body(shapes[rng.integers(len(shapes))], p, "steel", "floating") for p in poses]
    )


def test_conductors_that_touch_are_one() -> None:
    """Differential: groups of random scenes, against all pairs, one by one."""
    rng = np.random.default_rng(2)
    joined = 0
    for _ in range(40):
        scene = _floating(rng, 12, 0.05)
        group = list(range(len(scene)))
        for a, b in combinations(range(len(scene)), 2):
            if touch(scene[a], scene[b]):
                group = [min(group[a], group[b]) if g in (group[a], group[b]) else g for g in group]
        found = matter_of(list(scene), 1e5).joined(scene, scene.pack(), np.arange(len(scene)))
        assert found.group.tolist() == group
        joined += len(scene) - len(set(group))
    assert 50 < joined < 400


def test_bodies_that_are_parted() -> None:
    """Analytic: distances of projections onto the axes of both, from points of surfaces."""
    rng = np.random.default_rng(3)
    scene = _floating(rng, 60, 0.03)
    pairs = np.array(list(combinations(range(len(scene)), 2)))
    packed = scene.pack()
    found = parted(pairs, packed.kinds, packed.params, packed.rotation, packed.position, 0.002)
    points = [b.pose.apply(b.shape.to_trimesh().vertices) for b in scene]
    wide = np.full(len(pairs), -np.inf)
    for p, (a, b) in enumerate(pairs.tolist()):
        for axis in np.concatenate([packed.rotation[a].T, packed.rotation[b].T]):
            x, y = points[a] @ axis, points[b] @ axis
            wide[p] = max(wide[p], x.min() - y.max(), y.min() - x.max())
    known = np.abs(wide - 0.002) > 1e-3  # meshes of round shapes lie within them
    np.testing.assert_array_equal(found[known], wide[known] > 0.002)
    assert 0.1 < found.mean() < 0.9
    assert known.mean() > 0.9
