"""Mechanics of covers against closed forms of the elastic foundation."""

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.cover import Cover, StressStrain
from capsense.design import parse_design
from capsense.errors import DesignError, SceneError
from capsense.solver.gap.touch_kernels import Foundation, contact_force, depth_of_force, foundation

T, E = 2e-3, 60e3
BOX = {"size": [0.1, 0.1, 0.1], "backplane": 0.01}
PAD = {"name": "A", "shape": "rectangle", "size": [0.01, 0.01], "center": [0.0, 0.0]}


def cover(law: StressStrain) -> Foundation:
    """A cover of 40 x 40 mm, in metres."""
    corners = np.array([-0.02, -0.02, 0.0]), np.array([0.02, 0.02, T])
    pad = parse_design({"name": "pad", "domain": BOX, "electrode": [PAD]})
    surface = pad.electrodes[0].surface
    return foundation(Cover("foam", 1.5, *corners, law), [surface], 1.0)


def test_flat_punch_is_a_linear_spring():
    depth = depth_of_force(np.zeros(50), 2e-6, 1.5, cover(StressStrain.linear(E)))
    assert depth == approx(1.5 * T / (E * 1e-4), rel=1e-12)


def test_sphere_force_is_pi_modulus_radius_depth_squared_over_thickness():
    """Rings of equal area about the lowest point."""
    radius, depth, count, soft = 10e-3, 0.5e-3, 20000, cover(StressStrain.linear(E))
    area = np.pi * 6e-3**2 / count
    height = area * (np.arange(count) + 0.5) / (2.0 * np.pi * radius)
    force = contact_force(height, area, depth, soft)
    assert force == approx(np.pi * E * radius * depth**2 / T, rel=1e-6)
    assert depth_of_force(height, area, force, soft) == approx(depth)


def test_forces_are_those_of_the_table():
    """Differential: the pressure of each cell by linear interpolation, its last slope beyond."""
    rng = np.random.default_rng(5)
    strain = np.concatenate([[0.0], np.sort(rng.uniform(0.05, 0.9, 5))])
    law = StressStrain(strain, np.concatenate([[0.0], np.sort(rng.uniform(1e3, 1e5, 5))]))
    height = np.where(rng.uniform(size=200) < 0.2, np.inf, rng.uniform(0.0, T, 200))
    depths = np.linspace(-0.5e-3, 1.8e-3, 24)
    found = [contact_force(height, 1e-6, depth, cover(law)) for depth in depths]
    wanted = [1e-6 * law.pressure(np.maximum(d - height, 0.0) / T).sum() for d in depths]
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert found[0] == 0.0 < found[-1]


def test_deeper_than_full_compression_more_force_is_needed_still():
    soft, height = cover(StressStrain.linear(E)), np.array([0.0, np.inf])
    depths = [depth_of_force(height, 1e-4, f, soft) for f in (1.0, 10.0, 1e3)]
    assert np.all(np.diff(depths) > 0.0)
    assert depths[-1] > T


@pytest.mark.parametrize(
    "table", [[[0, 0]], [[0, 0], [0.5, 0]], [[0, 0], [1.0, 5]], [[0.1, 0], [0.5, 5]]]
)
def test_wrong_tables_are_refused(table):
    with pytest.raises(DesignError, match="stress_strain"):
        StressStrain(*np.array(table, float).T)


@pytest.mark.parametrize("force", [-1.0, np.nan, np.inf])
def test_wrong_forces_are_refused(force):
    with pytest.raises(SceneError, match=str(force)):
        cs.Body(cs.Sphere(0.01), force=force)
