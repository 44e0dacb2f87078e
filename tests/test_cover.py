"""Mechanics of covers against closed forms of the elastic foundation."""

import numpy as np
import pytest

from capsense.cover import (
    MAX_STRAIN,
    StressStrain,
    compression,
    contact_force,
    depth_of_force,
    fabric_change,
)
from capsense.errors import DesignError, SceneError

T, E = 2e-3, 60e3


def test_flat_punch_is_a_linear_spring():
    height, area = np.zeros(50), np.full(50, 2e-6)
    depth = depth_of_force(height, area, 1.5, T, StressStrain.linear(E))
    assert depth == pytest.approx(1.5 * T / (E * 1e-4), rel=1e-12)


def test_sphere_force_is_pi_modulus_radius_depth_squared_over_thickness():
    radius, depth = 10e-3, 0.5e-3
    edge = np.linspace(0.0, 6e-3, 20001)
    r, area = 0.5 * (edge[1:] + edge[:-1]), np.pi * np.diff(edge**2)
    height = r**2 / (2.0 * radius)
    force = contact_force(height, area, depth, T, StressStrain.linear(E))
    assert force == pytest.approx(np.pi * E * radius * depth**2 / T, rel=1e-6)
    assert depth_of_force(height, area, force, T, StressStrain.linear(E)) == pytest.approx(depth)


def test_compression_stops_below_full_and_force_does_not():
    law, height, area = StressStrain.linear(E), np.array([0.0, np.inf]), np.full(2, 1e-4)
    depths = [depth_of_force(height, area, f, T, law) for f in (1.0, 10.0, 1e3)]
    assert np.all(np.diff(depths) > 0.0)
    np.testing.assert_allclose(compression(height, depths[-1], T, law), [MAX_STRAIN * T, 0.0])


@pytest.mark.parametrize(
    "table", [[[0, 0]], [[0, 0], [0.5, 0]], [[0, 0], [1.0, 5]], [[0.1, 0], [0.5, 5]]]
)
def test_wrong_tables_are_refused(table):
    with pytest.raises(DesignError, match="stress_strain"):
        StressStrain(*np.array(table, float).T)


def test_wrong_forces_are_refused():
    law = StressStrain.linear(E)
    with pytest.raises(SceneError, match="-1"):
        depth_of_force(np.zeros(1), np.ones(1), -1.0, T, law)
    with pytest.raises(SceneError, match="over the cover"):
        depth_of_force(np.full(1, np.inf), np.ones(1), 1.0, T, law)


def test_grounded_fabric_pressed_flat_is_a_plate_capacitor():
    owner, area = np.array([0, 0, 1, -1]), np.array([1e-5, 3e-5, 2e-5, 9e-5])
    change = fabric_change(np.array([1e-3, 1e-3, 0.0, 1e-3]), area, owner, T, 1.6, 2)
    np.testing.assert_allclose(change, [8.8541878128e-12 * 1.6 * 4e-5 / T, 0.0], rtol=1e-9)
