"""The compact Green's function against the boundary elements that it is fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

from capsense.design import parse_design
from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.background import BackgroundField
from capsense.field.boundary import Accuracy, BoundarySolution, build_model, terminals
from capsense.field.cache import load_background, save_background
from capsense.field.green import (
    LEVELS,
    TABLES,
    GreenFunction,
    _rounded,
    basis,
    build_green,
    from_arrays,
    to_arrays,
)
from capsense.field.green_points import (
    GreenSettings,
    Surroundings,
    far_points,
    openness,
    spread,
    training_points,
)

Array = np.ndarray

FEW = GreenSettings(
    near_sources=360, near_spacing=2.8e-3, middle_sources=320, middle_spacing=2.9e-3,
    far_sources=160, far_spacing=3.6e-3,
)  # fmt: skip
"""Sizes for designs of a few centimetres."""
FEWER = replace(FEW, training=300, wide=400, far_training=1000)
"""As many charges, fitted at a third of the points, for designs of many panels."""


def square(name: str, x: float, size: float = 0.024) -> dict[str, Any]:
    return {"name": name, "shape": "rectangle", "size": [size, size], "center": [x, 0.0]}


def flat(**changes: Any) -> Design:
    """Two square electrodes 10 mm above the floor of a grounded box."""
    return parse_design(
        {
            "name": "flat",
            "domain": {"size": [0.2, 0.2, 0.2], "backplane": 0.01},
            "electrode": [square("A", -0.016), square("B", 0.016)],
            **changes,
        }
    )


def guarded() -> Design:
    """Pads in a pour 0.3 mm away, a driven back plane 1.6 mm behind, a cover in front."""
    plate = {"shape": "rectangle", "size": [0.07, 0.04]}
    return flat(
        name="guarded",
        conductor=[
            {"name": "pour", "role": "ground", "clearance": 0.0003, **plate},
            {"name": "back", "role": "shield", "z": -0.0016, **plate},
        ],
        layer=[
            {"name": "board", "eps_r": 4.5, "size": [0.07, 0.04], "z": [-0.0016, 0.0]},
            {"name": "cover", "eps_r": 3.0, "size": [0.07, 0.04], "z": [0.0, 0.001]},
        ],
    )


def curved() -> Design:
    """Two electrodes bent onto a driven cylinder."""
    housing = {
        "name": "housing", "role": "shield", "shape": "cylinder", "radius": 0.022,
        "length": 0.03, "center": [0.0, 0.0, -0.025], "tilt": [90, 0, 0],
    }  # fmt: skip
    return flat(
        name="curved", domain={"size": [0.2, 0.2, 0.2], "backplane": 0.07},
        bend={"radius": 0.025}, conductor=[housing],
    )  # fmt: skip


DESIGNS = {"flat": flat, "guarded": guarded, "curved": curved}


@dataclass(frozen=True, eq=False)
class Case:
    design: Design
    solution: BoundarySolution
    densities: Array
    green: GreenFunction

    def answer(self, points: Array) -> Array:
        """Exact ψ·ψ between points, symmetric up to the error of the boundary elements."""
        zero = np.zeros((self.densities.shape[1], len(points)))
        exact = -self.solution.potential(points, self.solution.densities(zero, points))
        return 0.5 * (exact + exact.T)


@cache
def case(name: str) -> Case:
    design = DESIGNS[name]()
    scale, settings = (1.6, FEW) if name == "flat" else (2.5, FEWER)
    solution = BoundarySolution(design, Accuracy(scale))
    densities = solution.densities(np.eye(len(terminals(design))))
    return Case(design, solution, densities, build_green(solution, densities, settings=settings))


def ball(center: Array, radius: float, n: int = 150) -> Array:
    """Points evenly spread over a sphere, shape (n, 3)."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, k * np.pi * (3 - 5**0.5)
    side = np.sqrt(1 - z * z)
    return center + radius * np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)


def delta(points: Array, radius: float, answer: Array, phi: Array, floor: float) -> Array:
    """Change of C [4π eps0 m] by a grounded ball: charges at points, own part from its size."""
    n = len(points)
    images = points * [1, 1, -1] + [0, 0, 2 * floor]
    free = np.linalg.norm(points[:, None] - points, axis=2)
    # the mean potential of the cap that belongs to a point, so that a free ball has 1/R
    free[np.diag_indices(n)] = np.inf
    own = n / radius - (1 / free).sum(axis=1).mean()
    matrix = 1 / free - 1 / np.linalg.norm(points[:, None] - images, axis=2) - answer
    matrix[np.diag_indices(n)] += own
    return phi.T @ np.linalg.solve(matrix, phi)


def somewhere(case: Case, n: int = 200) -> Array:
    """Points that bodies can reach, none of which the modes were fitted at."""
    surface = Surroundings(case.design, case.solution.model)
    sources = case.green.near_sources.astype(float)
    points = training_points(surface, sources, replace(FEW, clearance=(3e-3, 3e-3), training=0))[0]
    distance = surface.tree.query(points)[0]
    behind = np.linalg.norm(points[:, None] - sources, axis=2).min(axis=1) < distance + 1e-3
    box = case.green.box
    under = (points[:, 2] < box[0, 2]) & (case.green.distance(points) < 0.011)
    points = points[~behind & ~under & (distance > 3e-3)]
    return points[np.random.default_rng(5).permutation(len(points))[:n]]


@pytest.mark.parametrize(
    ("name", "allowed"), [("flat", 0.008), ("guarded", 0.004), ("curved", 0.01)]
)
@pytest.mark.parametrize("gap", [0.002, 0.005, 0.013, 0.03])
@pytest.mark.e2e
def test_a_grounded_ball_changes_c_as_with_boundary_elements(
    name: str, allowed: float, gap: float
) -> None:
    """Differential; the ball is coarse, but the same for both."""
    it, radius = case(name), 0.012
    points = ball(np.array([0.008, 0.003, it.green.box[1, 2] + gap + radius]), radius)
    phi = it.solution.potential(points, it.densities)
    exact = delta(points, radius, it.answer(points), phi, it.green.floor)
    psi = it.green.psi(points)
    got = delta(points, radius, psi @ psi.T, it.green.phi0(points), it.green.floor)
    assert np.abs(got - exact).max() < (2 if gap < 0.005 else 1) * allowed * np.abs(exact).max()


@pytest.mark.parametrize(
    "name", [n if n == "flat" else pytest.param(n, marks=pytest.mark.e2e) for n in DESIGNS]
)
def test_potentials_and_answer_at_points_of_all_kinds(name: str) -> None:
    it = case(name)
    points = somewhere(it)
    phi = it.solution.potential(points, it.densities)
    assert np.abs(it.green.phi0(points) - phi).max() < 0.12
    assert np.sqrt(((it.green.phi0(points) - phi) ** 2).mean()) < 0.015
    exact, psi = it.answer(points), it.green.psi(points)
    scale = np.sqrt(np.diag(exact))
    error = (psi @ psi.T - exact) / scale / scale[:, None]
    assert np.sqrt((error**2).mean()) < 0.02
    assert np.abs(error).max() < 0.4


@pytest.mark.parametrize("name", DESIGNS)
def test_reciprocity_and_grounding(name: str) -> None:
    """Analytic: G is symmetric; whatever is grounded lowers it, and it stays positive."""
    it = case(name)
    points = somewhere(it, 120)
    g = it.green.g(points, points)
    np.testing.assert_allclose(g, g.T, rtol=1e-12, atol=0.0)
    images = points * [1, 1, -1] + [0, 0, 2 * it.green.floor]
    floor = -1 / np.linalg.norm(points[:, None] - images, axis=2)
    assert (np.diag(g) < np.diag(floor)).all()
    free = np.linalg.norm(points[:, None] - points, axis=2)
    off = ~np.eye(len(points), dtype=bool)
    total = (1 / free[off] + g[off]) * free[off]
    exact = (1 / free[off] + (floor - it.answer(points))[off]) * free[off]
    assert np.sqrt(((total - exact) ** 2).mean()) < 0.01
    assert total.max() < 1.0


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("gap", [0.005, 0.012, 0.018])
def test_levels_agree_where_they_meet(name: str, gap: float) -> None:
    """No kink in a capacitance, whichever of the levels the points of a ball use."""
    it, radius = case(name), 0.012
    points = ball(np.array([-0.01, 0.006, it.green.box[1, 2] + gap + radius]), radius)
    found = []
    near, far, mixed = [1.0, 2.0], [-2.0, -1.0], [0.018, 0.030]
    used = [[near, near], [far, near], [far, far], [mixed, near], [far, mixed]]
    for blends in used[: 2 if gap < 0.01 else None]:
        green = replace(it.green, blends=np.array(blends))
        psi = green.psi(points)
        found.append(delta(points, radius, psi @ psi.T, green.phi0(points), green.floor))
    for other in found[1:]:
        assert np.abs(other - found[0]).max() < (5 if gap < 0.01 else 2.6) * 1e-3 * found[0].max()


def test_shares_change_smoothly() -> None:
    """Invariant: each representation is alone somewhere, and gives way smoothly to the next."""
    it = case("flat").green
    z = it.box[1, 2] + np.linspace(0.0, 0.03, 301)
    shares, off = it.shares(np.stack([0 * z, 0 * z, z], axis=1)), z - it.box[1, 2]
    (first, second), (third, fourth) = it.blends
    assert shares[0, off <= first].min() == 1.0
    assert shares[1, (off >= second) & (off <= third)].min() == 1.0
    assert shares[2, off >= fourth].min() == 1.0
    np.testing.assert_allclose(shares.sum(axis=0), 1.0, atol=1e-14)
    assert (np.diff(shares[0]) <= 0.0).all()
    assert (np.diff(shares[2]) >= 0.0).all()
    assert np.abs(np.diff(shares, 2)).max() < 6 * (1e-4 / (second - first)) ** 2 * 1.01
    inside = it.box.mean(axis=0)[None]
    assert it.distance(inside)[0] == 0.0
    outside = it.box[1] + np.array([[0.003, 0.004, 0.0], [0.0, 0.003, 0.004]])
    np.testing.assert_allclose(it.distance(outside), 0.005)


@pytest.mark.parametrize("name", DESIGNS)
def test_single_precision_is_enough(name: str) -> None:
    """Sums of single precision are as good as those of double precision, to 1e-5 of ψ·ψ."""
    it = case(name).green
    points = somewhere(case(name), 100)
    b = basis(points, it.near_sources, it.floor)
    exact, single = b @ it.near_modes, b.astype(np.float32) @ it.near_modes
    size = (exact**2).sum(axis=1)
    assert (np.abs((single**2).sum(axis=1) - size) < 1e-5 * size).all()


def test_first_modes_hold_what_is_met_far_away() -> None:
    """Analytic: no other few combinations of modes hold more of the values far away (Eckart and
    Young 1936), but for the weights of distances; the others end with what is least nearby.
    """
    it = case("flat")
    sources, kept = it.green.near_sources.astype(float), it.green.far_modes.shape[1]
    surface = Surroundings(it.design, it.solution.model)
    away, near = (
        basis(points, sources, it.green.floor) @ it.green.near_modes
        for points, _ in (
            far_points(surface, sources, FEW, FEW.blends[-1][0]),
            training_points(surface, sources, FEW),
        )
    )
    held, most = (away**2).sum(axis=0), np.linalg.svd(away, compute_uv=False) ** 2
    assert held[:kept].sum() == approx(most[:kept].sum(), rel=1e-3)
    assert held[0] == approx(most[0], rel=0.01)
    rest = (near[:, kept:] ** 2).sum(axis=0)
    assert rest[-1] < 0.02 * rest[0]


def test_points_of_the_fit_are_all_over_the_domain() -> None:
    """Measured: in each eighth of it."""
    it = case("flat")
    sources = it.green.near_sources.astype(float)
    points = training_points(Surroundings(it.design, it.solution.model), sources, FEW)[0]
    domain = it.design.domain
    assert ((points > domain.lower) & (points < domain.upper)).all()
    upper = points > 0.5 * (np.array(domain.lower) + domain.upper)
    assert set(upper @ [1, 2, 4]) == set(range(8))


@pytest.mark.parametrize("name", ["flat", "guarded"])
def test_answers_by_factors_are_those_of_single_charges(name: str) -> None:
    """Differential: against the densities that each charge draws; guarded has interfaces."""
    it, rng = case(name), np.random.default_rng(3)
    points = somewhere(it, 30)
    zero = np.zeros((it.densities.shape[1], len(points)))
    exact = it.solution.potential(points, it.solution.densities(zero, points))
    answers, charges = it.solution.answers(points), rng.normal(size=(len(points), 7))
    size = np.abs(exact).max()
    np.testing.assert_allclose(answers.by(np.eye(len(points))), exact, rtol=0, atol=1e-11 * size)
    between = charges.T @ exact @ charges
    found = answers.between(charges)
    np.testing.assert_allclose(found, between, rtol=0, atol=1e-11 * np.abs(between).max())
    phi = it.solution.potential(points, it.densities)
    np.testing.assert_allclose(answers.of_densities(it.densities), phi, rtol=1e-9, atol=1e-12)


def test_misfit_is_that_of_the_points_of_the_fit() -> None:
    """Analytic, of every fourth point, weighted by its distance d: d^¾ / (1 + d / 50 mm)."""
    it = case("flat")
    sources = it.green.near_sources.astype(float)
    surface = Surroundings(it.design, it.solution.model)
    points, d = (values[::4] for values in training_points(surface, sources, FEW))
    exact, psi = it.answer(points), basis(points, sources, it.green.floor) @ it.green.near_modes
    weight = np.outer(d**0.75 / (1 + d / 0.05), d**0.75 / (1 + d / 0.05))
    misfit = np.linalg.norm(weight * (psi @ psi.T - exact)) / np.linalg.norm(weight * exact)
    assert it.green.misfit == approx(misfit, rel=0.3)


@pytest.mark.parametrize("name", DESIGNS)
def test_charges_lie_where_no_body_can_be(name: str) -> None:
    it = case(name)
    lower, upper = it.design.domain.lower, it.design.domain.upper
    for level in LEVELS:
        sources = getattr(it.green, f"{level}_sources")
        inside = ((sources > lower) & (sources < upper)).all(axis=1)
        assert (~inside).sum() == 125
        if name == "curved":
            assert openness(it.design, sources[inside].astype(float)).max() == 0.0
        else:
            assert sources[inside, 2].max() < (0.001 if name == "guarded" else 0.0)
        assert (sources[:, 2] > it.green.floor).all()


def test_openness_of_plates_and_housings() -> None:
    """Analytic: one half in front of a wide sheet, nothing inside of a closed housing."""
    plate, pipe = flat(electrode=[square("A", 0.0, 0.15)]), curved()
    above, below = openness(plate, np.array([[0.0, 0.0, 1e-4], [0.0, 0.0, -1e-3]]))
    assert above == approx(0.5, abs=0.03)
    assert below < 0.25
    middle, aside = openness(pipe, np.array([[0.0, 0.0, -0.025], [0.06, 0.0, 0.05]]))
    assert middle == 0.0
    assert aside > 0.7


def test_things_are_coarser_away_from_electrodes() -> None:
    """Differential: a step for each 15 mm to the nearest point of an electrode, from 1 to 5."""
    plate = {"shape": "rectangle", "size": [0.18, 0.01], "center": [0.0, 0.05]}
    design = flat(
        conductor=[{"name": "guard", "role": "shield", **plate}],
        layer=[{"name": "board", "eps_r": 4.0, "size": [0.19, 0.03], "z": [-0.002, 0.0]}],
    )
    surface = Surroundings(design, build_model(design, Accuracy(4.0, fitted=False)))
    x, y, z = surface.points.T
    on = (np.abs(np.abs(x) - 0.016) < 0.012) & (np.abs(y) < 0.012) & (z == 0.0)
    assert 0 < on.sum() < len(on)
    away = np.linalg.norm(surface.points[:, None] - surface.points[on], axis=2).min(axis=1)
    expected = np.minimum(np.maximum(away / 0.015, 1.0), 5.0)
    np.testing.assert_allclose(surface.coarseness, expected, rtol=1e-12)
    assert (expected.min(), expected.max()) == (1.0, 5.0)
    assert ((expected > 1.0) & (expected < 5.0)).any()


@pytest.mark.parametrize(("backplane", "slope"), [(0.002, 0), (0.01, 0), (0.01, 12)])
def test_charges_behind_a_plate_stay_above_the_floor(backplane: float, slope: int) -> None:
    """Analytic: as deep as asked for, and at most six tenths of the way to the floor."""
    design = flat(
        domain={"size": [0.2, 0.2, 0.2], "backplane": backplane},
        electrode=[{**square("A", 0.0, 0.06), "tilt": [slope, 0, 0]}],
    )
    surface = Surroundings(design, build_model(design, Accuracy(4.0)))
    chosen = np.flatnonzero(np.abs(surface.points[:, :2]).max(axis=1) < 0.02)
    assert len(chosen) > 10
    angle = np.radians(slope)
    normal = np.array([0.0, -np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(surface.normals[chosen], [normal] * len(chosen), atol=1e-12)
    room = (surface.points[chosen, 2] - design.domain.floor) / np.cos(angle)
    for depth in (0.1 * backplane, 0.5 * backplane, 0.7 * backplane, 1.0):
        found = surface.behind(chosen, np.full(len(chosen), depth))
        deep = np.minimum(depth, 0.6 * room)
        expected = surface.points[chosen] - deep[:, None] * normal
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("thickness", [0.8e-3, 1.6e-3, 5e-3])
def test_charges_of_both_sides_of_a_stack_stay_apart(thickness: float) -> None:
    """Invariant: those of a pad and of the plane behind it, which bodies see from below, are on
    their own sides of the middle; where they met, both sides would have one potential."""
    design = flat(
        domain={"size": [0.4, 0.4, 0.4], "backplane": 0.2},
        electrode=[square("A", 0.0, 0.03)],
        conductor=[{"name": "back", "role": "shield", "shape": "rectangle",
                    "size": [0.03, 0.03], "z": -thickness}],
    )  # fmt: skip
    surface = Surroundings(design, build_model(design, Accuracy(4.0)))
    up = surface.normals[:, 2] > 0.0
    assert 0.3 < up.mean() < 0.7
    for depth in (0.5 * thickness, thickness, 1.7 * thickness, 0.02):
        found = surface.behind(np.arange(len(up)), np.full(len(up), depth))
        deep = np.where(up, -found[:, 2], found[:, 2] + thickness)
        assert (deep > 0.0).all()
        wide = np.abs(surface.points[:, :2]).max(axis=1) < 0.01
        if depth > thickness:  # else they do not come out behind, where bodies can be
            np.testing.assert_array_less(deep[wide], 0.4 * thickness)


def test_spread_takes_the_farthest_point_every_time() -> None:
    points = np.random.default_rng(2).uniform(size=(400, 3)) * [1.0, 1.0, 0.0]
    chosen = spread(points, np.ones(400), 40)
    assert len(set(chosen)) == 40
    gaps = np.linalg.norm(points[chosen][:, None] - points[chosen], axis=2)
    closest = np.where(np.eye(40, dtype=bool), np.inf, gaps).min()
    reach = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
    assert reach.max() <= closest


def test_spread_takes_the_same_points_as_its_definition() -> None:
    """Differential, to the last bit: with all distances from each chosen point anew."""
    rng = np.random.default_rng(4)
    points, scale = rng.normal(size=(900, 3)), rng.uniform(1.0, 5.0, 900)
    nearest = np.full(900, np.inf)
    pick, expected = int(np.argmin(points @ [1.0, 1.1, 1.2])), []
    for _ in range(300):
        expected.append(pick)
        square = ((points - points[pick]) ** 2).sum(axis=1) / scale**2
        nearest = np.minimum(nearest, square)
        pick = int(np.argmax(nearest))
    assert spread(points, scale, 300).tolist() == expected


def test_tables_are_rounded_to_the_nearest() -> None:
    """Analytic: twelve binary digits are kept, the first of which is not stored."""
    rng = np.random.default_rng(0)
    table = (rng.normal(size=1000) * 10.0 ** rng.integers(-20, 20, 1000)).astype(np.float32)
    fraction, exponent = np.frexp(table.astype(float))
    expected = np.ldexp(np.round(fraction * 2.0**12), exponent - 12)
    np.testing.assert_array_equal(_rounded(table), expected)
    np.testing.assert_array_equal(_rounded(_rounded(table)), expected)


def test_stored_to_the_last_bit(built: BackgroundField, tmp_path: Path) -> None:
    for compact in (False, True):
        save_background(built, tmp_path / "a.npz", compact=compact)
        back = load_background(tmp_path / "a.npz").green
        found_all = to_arrays(back)
        for name, values in to_arrays(built.green).items():
            found = found_all[name]
            assert np.array_equal(found, values), name
            assert np.asarray(found).dtype == values.dtype, name
            assert np.asarray(found).flags.c_contiguous or name == "gap_change", name
    assert {getattr(built.green, name).dtype for name in TABLES} == {np.dtype(np.float32)}
    again = from_arrays(to_arrays(built.green))
    assert to_arrays(again).keys() == to_arrays(built.green).keys()


def test_what_is_not_finite_is_never_stored(built: BackgroundField, tmp_path: Path) -> None:
    for name in (*TABLES, "box"):
        bad = getattr(built.green, name).copy()
        bad.flat[0] = np.nan
        wrong = replace(built, green=replace(built.green, **{name: bad}))
        with pytest.raises(FieldError, match="not finite"):
            save_background(wrong, tmp_path / f"{name}.npz", compact=True)
