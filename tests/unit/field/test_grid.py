"""The table of potentials that charge functions are chosen by."""

from __future__ import annotations

import numpy as np
import pytest
import surface_twin
from numpy.typing import NDArray

import capsense as cs
from capsense.field.face_kernels import WALL_EDGE
from capsense.field.grid_kernels import (
    ALONG,
    GROWTH,
    Grid,
    grid_over,
    grid_values,
    nodes_of,
    to_grid,
)

Array = NDArray[np.float64]
BOX = np.array([[-0.06, -0.04, -0.002], [0.06, 0.03, 0.0]])
WALLS = np.array([[-0.25, -0.25, -0.01], [0.25, 0.2, 0.4]])


def waves(points: Array) -> Array:
    """Eight functions that vary over 30 mm or more."""
    ways = np.random.default_rng(0).normal(size=(3, 8))
    ways *= 1 / (0.03 * np.linalg.norm(ways, axis=0))
    return np.sin(points @ ways + np.arange(8.0)).astype(np.float32)


def columns_of(points: Array) -> NDArray[np.float32]:
    """Points as kernels take them, (3, p), the last one repeated."""
    out = np.repeat(points[-1:], 16 * -(-len(points) // 16), axis=0)
    out[: len(points)] = points
    return np.ascontiguousarray(out.T, np.float32)


def values_at(points: Array, grid: Grid) -> Array:
    columns, out = columns_of(points), np.empty((len(points), grid.values.shape[1]), np.float32)
    to_grid(columns, grid)
    grid_values(columns, grid, np.ones(len(points)), np.arange(len(points)), out)
    return out


def inside(count: int, lower: Array, upper: Array) -> Array:
    return np.random.default_rng(1).uniform(lower, upper, (count, 3))


def test_coordinates_lead_to_the_nodes() -> None:
    """Twin: nodes, which follow from the inverse of the coordinates, have whole ones."""
    grid = grid_over(BOX, WALLS, waves)
    count = grid.size[0].astype(int)
    columns = columns_of(nodes_of(grid))
    to_grid(columns, grid)
    wanted = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 3)
    found = columns[:, : len(wanted)].T
    np.testing.assert_allclose(found, np.clip(wanted, 1, count - 2), atol=2e-4)


def test_cells_grow_with_the_distance() -> None:
    """Analytic: even within the box, then by the stated part of the distance."""
    grid = grid_over(BOX, WALLS, waves)
    x = np.unique(nodes_of(grid)[:, 0])
    side = np.diff(x)
    within = (x[:-1] >= BOX[0, 0] - 1e-9) & (x[1:] <= BOX[1, 0] + 1e-9)
    np.testing.assert_allclose(side[within], 0.12 / ALONG, rtol=1e-6)
    beyond = x[:-1] >= BOX[1, 0]
    off = x[:-1][beyond] - BOX[1, 0] + 0.12 / ALONG / GROWTH
    np.testing.assert_allclose(side[beyond] / off, np.expm1(GROWTH), rtol=1e-6)
    assert x[1] < WALLS[0, 0]
    assert x[-2] > WALLS[1, 0]


def test_values_are_those_of_a_spline() -> None:
    """Twin: against SciPy's splines of second degree, over all nodes."""
    grid, points = grid_over(BOX, WALLS, waves), inside(50, WALLS[0], WALLS[1])
    wanted = [surface_twin.tabulated(grid, point) for point in points]
    np.testing.assert_allclose(values_at(points, grid), wanted, atol=5e-5)


def test_polynomials_of_second_degree_are_met() -> None:
    """Analytic: where the grid is even."""

    def squares(points: Array) -> Array:
        x, y, z = (points / 0.05).T
        out = np.stack([x * y, x * z, x * x, y * y, z * z - x, 1 + y, z, x * y - z], axis=1)
        return out.astype(np.float32)

    cube = np.array([[-0.05, -0.05, -0.05], [0.05, 0.05, 0.05]])
    part = max(0.0, 1 - 5 / ALONG)  # other nodes that count are beyond
    grid, points = grid_over(cube, 4 * cube, squares), inside(100, part * cube[0], part * cube[1])
    np.testing.assert_allclose(values_at(points, grid), squares(points), atol=2e-5)


def test_values_turn_nowhere_suddenly() -> None:
    """Invariant: along a line through all cells slopes change by little from step to step.

    A spline of first degree would change its slope by 0.2 of the largest at each node.
    """
    grid = grid_over(BOX, WALLS, waves)
    way = np.linspace(0, 1, 4001)[:, None] * (WALLS[1] - WALLS[0]) + WALLS[0]
    slopes = np.diff(values_at(way, grid).astype(float), axis=0)
    bends = np.diff(slopes[::8], axis=0)  # rounding counts for less over some steps
    assert np.abs(bends).max() < 0.1 * np.abs(slopes).max()


def test_shares_scale_rows() -> None:
    """Invariant: rows are filled in the stated places, times the stated shares, no others."""
    grid, points = grid_over(BOX, WALLS, waves), inside(3, BOX[0], BOX[1])
    columns, out = columns_of(points), np.full((5, 8), np.float32(7.0))
    to_grid(columns, grid)
    grid_values(columns, grid, np.array([1.0, 0.5]), np.array([4, 1]), out)
    whole = values_at(points, grid)
    np.testing.assert_allclose(out[[4, 1]], [whole[0], 0.5 * whole[1]], rtol=1e-6)
    assert (out[[0, 2, 3]] == 7.0).all()


@pytest.mark.parametrize("design", ["six_patch", "six_patch_bare", "stripe"])
def test_potentials_of_a_design(design: str) -> None:
    """Differential: against the fitted charges, from 10 mm on, over a point's largest potential."""
    sim = cs.Simulator(design)
    green, background = sim._solver.green, sim.background.green
    low, high = green.active_bounds + WALL_EDGE * green.extent * np.array([[1.0], [-1.0]])
    points = inside(500, low, high)
    points = points[points[:, 2] > green.box[1, 2] + 0.01]
    found = values_at(points, green.grid)[:, : green.terminals]
    wanted = background.phi0(points * background.unit)
    off = np.abs(found - wanted).max(axis=1)
    near = np.maximum(wanted.max(axis=1), 0.02)
    assert (off / near).max() < 0.06
    assert np.sqrt(np.mean((off / near) ** 2)) < 0.02
