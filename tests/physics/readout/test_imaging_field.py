"""Sensitivity and images from a simulator's own fields, against the simulator."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.readout.imaging import (
    back_projection,
    electrode_pairs,
    grounded_sensitivity,
    landweber,
    sensitivity,
    tikhonov,
    voxel_centres,
)

PAIRS = electrode_pairs(6, diagonal=True)


@pytest.fixture(scope="module")
def sensor(simulators):
    """A simulator, and its potentials on a grid."""
    sim = simulators("six_patch")

    def potentials(grid):
        nodes = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1)
        reading = sim.step(cs.Scene(), keep_field=True)
        return reading.potentials(nodes.reshape(-1, 3))[:, :6].reshape(*nodes.shape[:3], 6)

    return sim, potentials


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


GRID = (np.linspace(-0.08, 0.08, 17), np.linspace(-0.07, 0.07, 15), np.linspace(0.005, 0.105, 11))
REGION = ((-0.045, -0.035, 0.035), (0.045, 0.035, 0.08), (30, 3))


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
@pytest.mark.parametrize("method", [back_projection, tikhonov])
def test_images_show_where_something_is(sensor, method, grounding):
    """A ball's image is brightest within a voxel or so of it, sideways and in depth.

    Bounds are for 90 % of the places; 8 and 10 mm are measured, with 0.1 fF of noise on what is
    grounded. Voxels measure 10 mm.
    """
    rng = np.random.default_rng(7)
    sim, potentials = sensor
    kind = grounded_sensitivity if grounding == "grounded" else sensitivity
    image_of = method(kind(potentials(GRID), GRID, PAIRS))
    off = []
    for place in rng.uniform(*REGION):
        ball = cs.Body(cs.Sphere(0.015), cs.Pose(place), "steel", grounding)
        noise = 0.1e-15 if grounding == "grounded" else 0.0
        seen = change(sim, ball) + noise * rng.standard_normal(len(PAIRS))
        off.append(voxel_centres(GRID)[np.argmax(image_of @ seen)] - place)
    off = np.abs(np.array(off))
    assert np.percentile(np.hypot(off[:, 0], off[:, 1]), 90) < 0.0125
    assert np.percentile(off[:, 2], 90) < 0.016


def test_positive_images_lie_in_the_middle_of_what_they_show(sensor):
    """Landweber's: the middle of the brighter half, sideways; no voxel is negative."""
    sim, potentials = sensor
    image_of = landweber(grounded_sensitivity(potentials(GRID), GRID, PAIRS), unit_voxels=True)
    places = np.random.default_rng(8).uniform(*REGION)
    balls = [cs.Body(cs.Sphere(0.015), cs.Pose(place), "steel") for place in places]
    images = image_of([change(sim, ball) for ball in balls])
    assert (images >= 0).all()
    bright = np.where(images > 0.5 * images.max(axis=1, keepdims=True), images, 0.0)
    off = bright @ voxel_centres(GRID) / bright.sum(axis=1, keepdims=True) - places
    assert np.percentile(np.hypot(off[:, 0], off[:, 1]), 90) < 0.025
