"""Planes in front of the sensor, and the potentials they show."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.viewer.plane import NEAR, OCTAVES, Plane, is_flat, levels, palette, region


@pytest.fixture(scope="module")
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_plane(simulator: cs.Simulator, axis: int) -> None:
    """Its points lie on it, in the region, evenly; hardly any is left out."""
    bounds = region(simulator.design)
    plane = Plane(simulator.background.green, bounds, axis, 0.02)
    for points, pitch in ((plane.drawn, plane.pitch), (plane.points, None)):
        assert set(points[:, axis]) == {0.02}
        assert (points >= bounds[:, 0] - 1e-12).all()
        assert (points <= bounds[:, 1] + 1e-12).all()
        lines = [np.unique(points[:, k]) for k in range(3) if k != axis]
        assert len(points) > 0.998 * len(lines[0]) * len(lines[1])
        for line in lines:
            steps = np.diff(line)
            np.testing.assert_allclose(steps, pitch or steps[0])
    assert len(plane.points) < 0.08 * len(plane.drawn)


def test_carrying_keeps_linear_functions(simulator: cs.Simulator) -> None:
    """To any point that is drawn, the ends of the region included."""
    slope = np.array([1.0, -2.0, 3.0])
    for axis in range(3):
        plane = Plane(simulator.background.green, region(simulator.design), axis, 0.03)
        np.testing.assert_allclose(
            plane.carried(plane.points @ slope), plane.drawn @ slope, atol=1e-12
        )


def test_plane_outside_is_taken_in(simulator: cs.Simulator) -> None:
    """A coordinate beyond the region is its end."""
    bounds = region(simulator.design)
    assert Plane(simulator.background.green, bounds, 0, 9.0).at == bounds[0, 1]


@pytest.mark.parametrize("name", cs.available_designs())
def test_region(name: str) -> None:
    """Around the electrodes, within the domain; of a flat design, in front of all it is made of."""
    design = cs.load_design(name)
    bounds, domain = region(design), design.domain
    assert is_flat(design) == (name != "arm_segment")
    assert (bounds[:, 0] >= domain.lower).all()
    assert (bounds[:, 1] <= domain.upper).all()
    for electrode in design.electrodes:
        low, high = electrode.surface.bounds
        assert (low[:2] >= bounds[:2, 0]).all()
        assert (high[:2] <= bounds[:2, 1]).all()
    if is_flat(design):
        parts = [b.surface.bounds[1, 2] for b in design.sheets]
        assert bounds[2, 0] == max(parts + [layer.upper[2] for layer in design.layers])


def test_points_close_to_charges_are_left_out() -> None:
    """Planes of a curved sensor go through what it is made of."""
    simulator = cs.Simulator("arm_segment")
    green, bounds = simulator.background.green, region(simulator.design)
    sources = green.unit * green.near_sources
    middle = sources[np.argmin(np.abs(sources[:, 1]))]
    plane = Plane(green, bounds, 1, float(middle[1]))
    away = np.linalg.norm(plane.drawn[:, None] - sources, axis=2).min(axis=1)
    assert NEAR * green.unit <= away.min() < NEAR * green.unit + plane.pitch


def test_potentials_on_a_plane(simulator: cs.Simulator) -> None:
    """Near 1 V in front of the electrode, falling with height; a grounded body is at 0 V."""
    centre = simulator.design.electrodes[1].surface.bounds.mean(axis=0)
    plane = Plane(simulator.background.green, region(simulator.design), 1, float(centre[1]))
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((centre[0], centre[1], 0.06)), "steel")
    x, _, z = plane.drawn.T
    above = np.abs(x - centre[0]) < 0.6 * plane.pitch
    lowest = above & (z < z.min() + 0.5 * plane.pitch)
    inside = np.linalg.norm(plane.drawn - ball.pose.position, axis=1) < 0.012
    empty, found = (
        plane.carried(simulator.step(scene, keep_field=True).potentials(plane.points)[:, 1])
        for scene in (cs.Scene(), cs.Scene([ball]))
    )
    assert (empty[lowest] > 0.8).all()
    line = empty[above & (x == x[above][0])]
    assert (np.diff(line) < 0).all()
    assert np.abs(found[inside]).max() < 0.05 * empty[inside].max()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_contours(simulator: cs.Simulator, axis: int) -> None:
    """Lines of a linear potential are straight, on the plane, where it has their value."""
    bounds = region(simulator.design)
    plane = Plane(simulator.background.green, bounds, axis, 0.02)
    across = next(k for k in range(3) if k != axis)
    low, high = bounds[across]
    pieces, colours = plane.contours((plane.points[:, across] - low) / (high - low))
    assert pieces.shape == colours.shape
    np.testing.assert_allclose(pieces[..., axis], 0.02)
    value = (pieces[..., across] - low) / (high - low)
    nearest = np.abs(value[..., None] - levels()).argmin(axis=-1)
    np.testing.assert_allclose(value, levels()[nearest], rtol=1e-6)
    np.testing.assert_array_equal(colours, palette()[nearest])


def test_colours_of_lines() -> None:
    """Two from each halving to the next, darker and darker."""
    np.testing.assert_allclose(levels()[2:] / levels()[:-2], 2.0)
    assert levels()[0] == 2.0**-OCTAVES
    assert levels()[-1] < 1.0
    c = palette()
    assert len(np.unique(c, axis=0)) == len(levels())
    assert (np.diff(c.astype(float).sum(axis=1)) < 0).all()
