"""Planes through the lattice, and the potentials they show."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.viewer.plane import OCTAVES, Plane, interpolation, paint, palette, region


@pytest.fixture(scope="module")
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch")


def test_interpolation(simulator: cs.Simulator) -> None:
    """A linear function is carried exactly to any point of all storeys; nodes are kept."""
    lattice = simulator.background.lattice
    assert len(lattice.storeys) > 1
    slope = np.array([1.0, -2.0, 3.0])
    bounds = np.array(lattice.bounds)
    points = np.random.default_rng(7).uniform(bounds[:, 0], bounds[:, 1], (2000, 3))
    matrix = interpolation(lattice, points)
    np.testing.assert_allclose(matrix @ (lattice.points @ slope), points @ slope, atol=1e-12)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0)
    assert matrix.data.min() >= 0
    corners = bounds[:, [0, 1]].T
    np.testing.assert_allclose(
        interpolation(lattice, corners) @ (lattice.points @ slope), corners @ slope
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_plane(simulator: cs.Simulator, axis: int) -> None:
    """Its points lie on it, in the region, evenly."""
    bounds = region(simulator.design)
    plane = Plane(simulator.background.lattice, bounds, axis, 0.02)
    points = plane.points.reshape(-1, 3)
    assert set(points[:, axis]) == {0.02}
    assert (points >= bounds[:, 0] - 1e-12).all()
    assert (points <= bounds[:, 1] + 1e-12).all()
    steps = np.diff(plane.points, axis=0)[..., 1 if axis == 0 else 0]
    np.testing.assert_allclose(steps, plane.pitch)
    height = plane.sample(simulator.background.lattice.points[:, 2])
    np.testing.assert_allclose(height, plane.points[..., 2], atol=1e-12)


def test_plane_outside_is_taken_in(simulator: cs.Simulator) -> None:
    """A coordinate beyond the region is its end."""
    bounds = region(simulator.design)
    assert Plane(simulator.background.lattice, bounds, 0, 9.0).at == bounds[0, 1]


def test_region(simulator: cs.Simulator) -> None:
    """Around the electrodes, within the domain."""
    bounds, domain = region(simulator.design), simulator.design.domain
    assert (bounds[:, 0] >= domain.lower).all()
    assert (bounds[:, 1] <= domain.upper).all()
    for electrode in simulator.design.electrodes:
        low, high = electrode.surface.bounds
        assert (low >= bounds[:, 0]).all()
        assert (high <= bounds[:, 1]).all()


def test_paint() -> None:
    """One colour for each halving; nothing below the last, nor below zero."""
    potential = np.array([[1.0, 0.51, 0.49], [2.0**-OCTAVES * 1.01, 2.0**-OCTAVES * 0.99, -0.1]])
    shown, colours = paint(potential)
    np.testing.assert_array_equal(shown, [[True, True, True], [True, False, False]])
    c = palette()
    np.testing.assert_array_equal(colours, c[[-1, -1, -2, 0]])
    assert len(np.unique(c, axis=0)) == OCTAVES
    brightness = c.astype(float).sum(axis=1)
    assert (np.diff(brightness) < 0).all()
