"""Sensitivity and images from a simulator's own fields, against the simulator."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.readout.imaging import (
    electrode_pairs,
    grounded_sensitivity,
    sensitivity,
    tikhonov,
    voxel_centres,
)

PAIRS = electrode_pairs(6, diagonal=True)


@pytest.fixture(scope="module")
def sensor(simulators):
    """A simulator, and its potentials on a grid."""
    sim = simulators("six_patch")
    field = sim.background
    return sim, lambda grid: field.lattice.on_grid(field.potentials[:, :6], grid)


def change(sim, body):
    """Changes of capacitance that a body makes, one for each pair [F]."""
    delta = sim.step(cs.Scene([body])).delta
    return np.array([delta[p] for p in PAIRS])


@pytest.mark.parametrize("place", [(0.03, 0.02, 0.05), (-0.038, -0.025, 0.04), (0.02, -0.01, 0.1)])
def test_weak_ball(sensor, place):
    """Differential: a ball hardly denser than air changes C as its sensitivity says.

    Its field inside is 3/(ε + 2) of that outside. The simulator's own error is some per cent.
    """
    sim, potentials = sensor
    grid = tuple(np.linspace(x - 0.025, x + 0.025, 27) for x in place)
    j = sensitivity(potentials(grid), grid, PAIRS)
    inside = np.linalg.norm(voxel_centres(grid) - place, axis=1) < 0.025
    expected = j[:, inside].sum(axis=1) * 3 * 0.05 / 3.05
    weak = cs.Body(cs.Sphere(0.025), cs.Pose(place), cs.Material("weak", 1.05))
    assert np.abs(change(sim, weak) - expected).max() < 0.05 * np.abs(expected).max()


@pytest.mark.parametrize("place", [(-0.02, 0.015, 0.05), (0.03, -0.02, 0.04), (0.0, 0.0, 0.06)])
@pytest.mark.parametrize("grounding", ["grounded", "floating"])
def test_images_show_where_something_is(sensor, place, grounding):
    """A ball's image is brightest above the place where it is, within one and a half voxels."""
    sim, potentials = sensor
    grid = (
        np.linspace(-0.08, 0.08, 17),
        np.linspace(-0.07, 0.07, 15),
        np.linspace(0.005, 0.105, 11),
    )
    kind = grounded_sensitivity if grounding == "grounded" else sensitivity
    j = kind(potentials(grid), grid, PAIRS)
    ball = cs.Body(cs.Sphere(0.015), cs.Pose(place), "steel", grounding)
    image = tikhonov(j, 1e-3) @ change(sim, ball)
    brightest = voxel_centres(grid)[np.argmax(image)]
    assert np.abs(brightest[:2] - place[:2]).max() <= 0.0151
