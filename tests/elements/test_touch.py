"""Which conductors touch each other."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import capsense as cs
from capsense.elements.matter import segment_distance, touch


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
        assert segment_distance(first, second) == pytest.approx(apart, abs=2e-4)
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
