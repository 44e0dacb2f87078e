"""The table of a plane near a design: limits, sums, and a fresh solution of design and plane."""

from __future__ import annotations

import math
import tomllib
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
from approximate import approx
from threadpoolctl import threadpool_limits

from capsense.constants import EPS0
from capsense.design import parse_design
from capsense.design.model import Design
from capsense.field.boundary import Accuracy, BoundarySolution
from capsense.field.face import has_even_face, plane_panels
from capsense.field.gap_table import PlaneResponse, _means, build_gap_table
from capsense.field.green import build_green
from capsense.field.green_points import GreenSettings, is_flat
from capsense.field.plane_tables import GapTable, from_arrays, to_arrays

UNIT = 1.2e-3
PAD = """
name = "pad"
[domain]
size = [0.2, 0.2, 0.2]
backplane = 0.01
[[electrode]]
name = "A"
shape = "rectangle"
size = [0.01, 0.01]
center = [-0.006, 0.0]
[[electrode]]
name = "B"
shape = "rectangle"
size = [0.01, 0.01]
center = [0.006, 0.0]
"""
COVER = """
[[layer]]
name = "cover"
eps_r = 3.0
size = [0.03, 0.02]
z = [0.0, 0.0006]
"""


def _design(text: str) -> Design:
    return parse_design(tomllib.loads(text))


@cache
def _solved(text: str) -> tuple[BoundarySolution, np.ndarray]:
    solution = BoundarySolution(_design(text), Accuracy(3.0))
    return solution, solution.densities(np.eye(solution.model.n_terminals))


@cache
def _table(text: str = PAD) -> GapTable:
    solution, densities = _solved(text)
    return build_gap_table(solution, densities, UNIT)


def _entry(table: GapTable, i: int, j: int, k: int) -> float:
    """The change of C_ij by a plane at height k [F]; j = -1 for the plane at 1 V."""
    some = table.terminal == i
    column = -1 if j < 0 else table.columns[i].tolist().index(j)
    per_area = table.change[some, k, column] / (table.heights[k] + table.series[some])
    return float(EPS0 * (per_area * table.areas[some]).sum())


def test_cells_cover_the_electrodes():
    table = _table()
    for terminal in (0, 1):
        some = table.terminal == terminal
        assert table.areas[some].sum() == approx(1e-4, rel=1e-5)
        center = table.areas[some] @ table.points[some] / table.areas[some].sum()
        np.testing.assert_allclose(center, [-0.006 + 0.012 * terminal, 0.0, 0.0], atol=1e-6)
    starts = table.blocks
    assert starts[0] == 0
    assert (np.diff(starts) > 0).all()


def test_near_contact_it_is_a_plate_capacitor():
    table = _table()
    plate = EPS0 * 1e-4 / table.heights[0]
    assert _entry(table, 0, 0, 0) == approx(plate, rel=0.01)
    assert _entry(table, 0, -1, 0) == approx(-plate, rel=0.03)


def test_a_cover_is_in_series():
    table = _table(PAD + COVER)
    assert table.top == approx(0.0006)
    some = np.linalg.norm(table.points[:, :2] - [-0.006, 0.0], axis=1) < 3e-3
    np.testing.assert_allclose(table.series[some], 0.0006 / 3.0, rtol=0.1)
    plate = EPS0 * 1e-4 / (table.heights[0] + 0.0006 / 3.0)
    assert _entry(table, 0, 0, 0) == approx(plate, rel=0.1)


def test_the_plane_screens_electrodes_from_one_another():
    table = _table()
    mutual = [_entry(table, 0, 1, k) for k in range(len(table.heights))]
    np.testing.assert_allclose(mutual, [_entry(table, 1, 0, k) for k in range(len(mutual))], 0.02)
    assert all(x > 0 for x in mutual)  # -C01 falls
    assert mutual == sorted(mutual, reverse=True)
    own = [_entry(table, 0, 0, k) for k in range(len(table.heights))]
    assert own == sorted(own, reverse=True)


def test_charges_are_those_of_design_and_plane_solved_anew():
    solution, densities = _solved(PAD)
    n, height = solution.model.panels.size, 8e-4
    plane = plane_panels(solution, 8 * UNIT).at(height)
    change = PlaneResponse(solution).at(plane, densities).change
    text = PAD + (
        '[[conductor]]\nname = "plane"\nrole = "shield"\nshape = "rectangle"\n'
        f"size = [{np.ptp(plane.edges[..., 0])}, {np.ptp(plane.edges[..., 1])}]\n"
        f"center = [0.0, 0.0, {height}]\n"
    )
    other = BoundarySolution(_design(text), Accuracy(1.5))
    both = other.terminal_charges(other.densities(np.eye(3)))
    alone = solution.terminal_charges(densities)
    owner, areas = solution.model.owner, solution.model.panels.areas
    for i in range(2):
        found = (change[owner == i] * areas[owner == i, None]).sum(axis=0)
        np.testing.assert_allclose(found[:2], (both[:2, :2] - alone)[i], rtol=0.03, atol=2e-15)
        assert found[2] == approx(both[i, 2], rel=0.03)
    assert len(change) == n


def test_threads_solve_beside_each_other():
    """Regression: SciPy changes the pivots of a factorisation while LAPACK has them."""
    solution, _ = _solved(PAD)
    sides = np.random.default_rng(1).normal(size=(solution.model.panels.size, 300))
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(4) as pool:
        expected = solution.solve(sides)
        for found in pool.map(lambda _: solution.solve(sides), range(40)):
            np.testing.assert_array_equal(found, expected)


def test_means_over_panels_are_those_of_all_points_of_their_quadratures():
    """Differential: panels have different numbers of points, the others of which weigh nothing."""
    solution, densities = _solved(PAD)
    few = GreenSettings(near_sources=60, middle_sources=40, far_sources=20, training=100, wide=50,
                        far_training=200)  # fmt: skip
    green = build_green(solution, densities, settings=few)
    plane = plane_panels(solution, 8 * UNIT).at(0.003)
    assert len(set((plane.weights > 0.0).sum(axis=1))) > 1
    psi, phi = (f(plane.quad.reshape(-1, 3)) for f in (green.psi, green.phi0))
    found = _means(green, plane)
    for values, means in zip((psi, phi), found, strict=True):
        each = values.reshape(*plane.weights.shape, -1)
        expected = np.einsum("mqk,mq->mk", each, plane.weights) / plane.areas[:, None]
        np.testing.assert_allclose(means, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_it_comes_back_from_arrays():
    table = _table()
    again = from_arrays(to_arrays(table))
    assert again is not None
    for name, value in vars(table).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert from_arrays({}) is None


def test_which_designs_are_flat():
    assert is_flat(_design(PAD))
    tilted = PAD.replace("center = [0.006, 0.0]", "center = [0.006, 0.0]\ntilt = [0.0, 5.0, 0.0]")
    assert not is_flat(_design(tilted))
    assert math.isfinite(_table().validity)


def test_which_faces_are_even():
    assert has_even_face(_design(PAD))
    assert has_even_face(_design(PAD + COVER))
    half = COVER.replace("size = [0.03, 0.02]", "size = [0.012, 0.02]\ncenter = [0.006, 0.0]")
    assert not has_even_face(_design(PAD + half))
