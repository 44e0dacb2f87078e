"""Energies of pairs of clusters, against integrals over rectangles and sums over points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx
from plain_leaves import plain_leaves
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from capsense.solver.interaction.pair_kernels import _mirror_mean, leaf_pairs, mean_inverse

Array = np.ndarray
DEEP = -1e5
"""A floor [m] whose images are too far away to count."""


def flat(center: Array, turn: Rotation, sides: tuple[float, float]) -> tuple[Array, float]:
    """Four points and extent of a rectangle."""
    arms = turn.as_matrix()[:, :2] * np.array(sides) / math.sqrt(12)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    if sides[0] < sides[1]:
        arms = arms[:, ::-1]
    return center + signs @ arms.T, max(sides)


def spread(center: Array, turn: Rotation, sides: tuple[float, float], n: int) -> tuple:
    """Gauss points of a rectangle, and weights."""
    x, w = np.polynomial.legendre.leggauss(n)
    u, v = np.meshgrid(0.5 * sides[0] * x, 0.5 * sides[1] * x, indexing="ij")
    local = np.stack([u.ravel(), v.ravel(), 0.0 * u.ravel()], axis=1)
    return center + turn.apply(local), np.outer(w, w).ravel() / 4


def pairs(shapes: list, owner: list[int], changing: bool, floor: float = DEEP) -> Array:
    points = np.array([flat(*s)[0] for s in shapes])
    extent = np.array([flat(*s)[1] for s in shapes])
    within = np.full(len(shapes), float(changing))
    none = np.zeros(len(shapes))
    leaves = plain_leaves(points, points, extent, 0.15 * extent, none, np.array(owner), within)
    return leaf_pairs(leaves, floor)


def brute(first: tuple, second: tuple, n: int = 10) -> float:
    """Mean of 1/r between rectangles by Gauss points."""
    (p, w), (q, v) = spread(*first, n), spread(*second, n)
    return float(w @ (1 / np.linalg.norm(p[:, None] - q, axis=-1)) @ v)


@pytest.mark.parametrize(("apart_by", "limit"), [(1.52, 1.5e-3), (3.0, 1e-4), (8.0, 1.2e-5)])
def test_pairs_far_from_each_other(apart_by: float, limit: float) -> None:
    """Differential: by second moments; the error falls with the fourth power of the distance."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        turns, sides = Rotation.random(2, random_state=rng), 10.0 ** rng.uniform(-2.5, -1, (2, 2))
        way = rng.normal(size=3)
        way *= apart_by * sides.max(axis=1).sum() / np.linalg.norm(way)
        one, other = (np.zeros(3), turns[0], sides[0]), (way, turns[1], sides[1])
        found = pairs([one, other], [0, 1], False)
        assert found[0, 1] == found[1, 0]
        assert found[0, 1] == approx(brute(one, other), rel=limit)


def test_images_in_the_floor() -> None:
    """Differential: a cluster of any body meets its own image and those of all others."""
    rng = np.random.default_rng(4)
    turns = Rotation.random(2, random_state=rng)
    down = np.array([1.0, 1.0, -1.0])
    for high in (0.03, 0.3):
        one = (np.array([0.0, 0.0, high]), turns[0], (0.02, 0.01))
        other = (np.array([0.01, 0.0, 1.5 * high]), turns[1], (0.005, 0.02))
        found = pairs([one, other], [0, 0], False, 0.0)
        for i, first in enumerate((one, other)):
            for j, second in enumerate((one, other)):
                (p, w), (q, v) = spread(*first, 10), spread(*second, 10)
                wanted = -w @ (1 / np.linalg.norm(p[:, None] - q * down, axis=-1)) @ v
                assert found[i, j] == approx(wanted, rel=2e-3)


@pytest.mark.parametrize("sides", [(0.01, 0.01), (0.01, 0.03), (0.2, 0.01)])
def test_mean_within_a_rectangle(sides: tuple[float, float]) -> None:
    """Analytic: mean of 1/r within a × b, 2 [a² b asinh(b/a) + a b² asinh(a/b) + …] / (a b)²."""
    a, b = sides
    cubes = (a**3 + b**3 - math.hypot(a, b) ** 3) / 3
    total = 2 * (a * a * b * math.asinh(b / a) + a * b * b * math.asinh(a / b) + cubes)
    found = pairs([(np.zeros(3), Rotation.identity(), sides)], [0], True)
    assert found[0, 0] == approx(total / (a * b) ** 2, rel=1e-5)


def exact_mean(one: tuple, other: tuple) -> float:
    """Mean of 1/r between rectangles: Gauss points on one, the other's potential by quadrature."""
    center, turn, (a, b) = other
    points, weights = spread(*one, 12)
    total = 0.0
    for p, w in zip(turn.inv().apply(points - center), weights, strict=True):
        # along y in closed form
        def strip(x: float, p: Array = p) -> float:
            d = math.hypot(x - p[0], p[2])
            return math.asinh((b / 2 - p[1]) / d) + math.asinh((b / 2 + p[1]) / d)

        stops = [p[0]] if abs(p[0]) < a / 2 else None
        total += w * quad(strip, -a / 2, a / 2, points=stops, epsrel=1e-6)[0]
    return total / (a * b)


@pytest.mark.parametrize(
    ("center", "turned", "sides", "limit"),
    [
        ((0.01, 0.0, 0.0), (0.0, 0.0, 0.0), (0.01, 0.01), 0.02),
        ((0.005, 0.0, 0.005), (0.0, math.pi / 2, 0.0), (0.01, 0.01), 0.004),
        ((0.01, 0.01, 0.0), (0.0, 0.0, 0.0), (0.01, 0.01), 0.003),
        ((0.0, 0.0, 0.002), (0.0, 0.0, 0.0), (0.01, 0.01), 0.005),
        ((0.0075, 0.001, 0.0), (0.0, 0.0, 0.0), (0.005, 0.004), 0.011),
        ((0.006, 0.0, 0.001), (0.0, 0.3, 0.0), (0.002, 0.03), 0.008),
        ((0.012, 0.004, 0.003), (0.5, 0.3, 0.2), (0.01, 0.005), 0.001),
    ],
)
def test_pairs_of_one_surface_near_each_other(center, turned, sides, limit: float) -> None:
    """Measured: rectangles that touch, meet at an edge, lie close above each other."""
    one = (np.zeros(3), Rotation.identity(), (0.01, 0.01))
    other = (np.array(center), Rotation.from_rotvec(turned), sides)
    found = pairs([one, other], [0, 0], True)
    assert found[0, 1] == approx(exact_mean(one, other), rel=limit)
    assert found[0, 1] == found[1, 0]


@pytest.mark.parametrize("distance", [0.0118, 0.0148, 0.0152])  # to both sides of 0.75 × 20 mm
def test_pairs_of_one_surface_are_the_same_in_any_frame(distance: float) -> None:
    """Invariant: axes change places, and so do rectangles."""
    found = []
    for turns in range(3):
        frame = Rotation.from_rotvec(np.full(3, turns * 2 * math.pi / 3 / math.sqrt(3)))
        for sign in (-1, 1):
            center = frame.apply([sign * 0.8 * distance, 0.6 * distance, 0.0])
            one = (np.zeros(3), frame, (0.01, 0.01))
            found.append(pairs([one, (center, frame, (0.01, 0.01))], [0, 0], True)[0, 1])
    np.testing.assert_allclose(found, found[0], rtol=1e-5)


@pytest.mark.parametrize("side", [1.0, 0.01])
@pytest.mark.parametrize("gap", [1e-4, 1e-3, 1e-2, 3e-2])
def test_pairs_that_all_but_coincide(gap: float, side: float) -> None:
    """Analytic: squares one above the other, and what charge of opposite signs on them costs;
    that is 2π times the gap where it is small, for sides of one."""
    one = (np.zeros(3), Rotation.identity(), (side, side))
    other = (np.array([0.0, 0.0, gap * side]), Rotation.identity(), (side, side))
    found = side * pairs([one, other], [0, 0], True, -1e9)
    own = 4 * math.log(1 + math.sqrt(2)) - 4 * (math.sqrt(2) - 1) / 3
    assert found[0, 0] == approx(own, rel=1e-5)
    assert found[0, 1] == approx(_mirror_mean(gap), rel=3e-3)
    cost = own - found[0, 1]
    assert cost == approx(2 * math.pi * gap, rel=0.15, abs=1e-5)


def test_rigid_bodies_have_no_pairs_of_their_own() -> None:
    """Invariant: clusters of one rigid body meet through the shape's energies alone."""
    one = (np.zeros(3), Rotation.identity(), (0.01, 0.01))
    other = (np.array([0.01, 0.0, 0.0]), Rotation.identity(), (0.01, 0.01))
    np.testing.assert_allclose(pairs([one, other], [0, 0], False), 0.0, atol=1e-4)


def test_pairs_of_bodies_near_each_other() -> None:
    """Differential: the mean over all sixteen pairs of points, for any number of near ones."""
    rng = np.random.default_rng(7)
    count = 37
    points = rng.uniform(-0.02, 0.02, (count, 1, 3)) + rng.uniform(-3e-3, 3e-3, (count, 4, 3))
    extent, owner = rng.uniform(0.04, 0.12, count), np.repeat([0, 1, 2], [5, 20, 12])
    none = np.zeros(count)
    soft = rng.uniform(0.2, 0.4, count) * extent
    found = leaf_pairs(plain_leaves(points, points, extent, soft, none, owner, none), DEEP)
    for i in range(count):
        for j in range(i):
            wanted = 0.0 if owner[i] == owner[j] else mean_inverse(
                points[i], points[j], max(soft[i], soft[j])
            )  # fmt: skip
            assert found[i, j] == approx(wanted, rel=3e-6, abs=1e-4)


def test_bounded_inverse_distance() -> None:
    """Analytic: 1/√√(r⁴ + s⁴), whatever the order."""
    rng = np.random.default_rng(6)
    first, second = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    square = ((first[:, None] - second) ** 2).sum(axis=-1)
    for soft in (0.0, 0.15, 4.5):
        wanted = ((square**2 + soft**4) ** -0.25).mean()
        assert mean_inverse(first, second, soft) == approx(wanted, rel=1e-6)
        assert mean_inverse(second, first, soft) == approx(wanted, rel=1e-6)
