"""Laplace's equation has no scale: scenes and designs of any size have the same readings."""

from __future__ import annotations

import math
import tomllib
from functools import cache
from typing import Any

import numpy as np
import pytest
from approximate import approx
from tiny_field import few_sources

import capsense as cs
from capsense.constants import EPS0
from capsense.design import parse_design
from capsense.field.background import BuildSettings, build_background

SCALES = (1e-3, 0.1, 10.0, 1e3)
DESIGN = """
name = "scaled"
[domain]
size = [0.0100, 0.0100, 0.0080]
backplane = 0.0008
[[electrode]]
name = "A"
shape = "rectangle"
size = [0.0011, 0.0014]
center = [-0.0008, 0.0]
[[electrode]]
name = "B"
shape = "disc"
radius = 0.0006
center = [0.0008, 0.0]
[[layer]]
name = "board"
eps_r = 4.5
size = [0.0050, 0.0040]
z = [-0.0003, 0.0]
[[conductor]]
name = "pour"
role = "floating"
shape = "rectangle"
size = [0.0040, 0.0030]
center = [0.0, 0.0, -0.0003]
"""


def _scaled(data: Any, scale: float) -> Any:
    """Lengths of a design file, ``scale`` times as large."""
    if isinstance(data, dict):
        kept = ("eps_r",)
        return {k: v if k in kept else _scaled(v, scale) for k, v in data.items()}
    if isinstance(data, list):
        return [_scaled(v, scale) for v in data]
    return data * scale if isinstance(data, float) else data


@cache
def _simulator(scale: float) -> cs.Simulator:
    design = parse_design(_scaled(tomllib.loads(DESIGN), scale))
    with few_sources():
        field = build_background(design, BuildSettings(panel_scale=8.0))
    return cs.Simulator(design, background=field)


def _scenes(s: float) -> dict[str, list[cs.Body]]:
    turned = (0.1, 0.2, 0.3, math.sqrt(0.86))
    tetrahedron = s * 1e-3 * np.array([[0, 0, 0], [1.0, 0, 0.1], [0, 1.2, 0.1], [0.3, 0.3, 0.9]])
    faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]
    return {
        "ball": [cs.Body(cs.Sphere(0.8e-3 * s), cs.Pose((0, 0, 1.6e-3 * s)))],
        "near": [cs.Body(cs.Box((2e-3 * s, 1e-3 * s, 5e-4 * s)),
                         cs.Pose((0, 2e-4 * s, 4e-4 * s), turned))],
        "floating": [cs.Body(cs.Cylinder(6e-4 * s, 1e-3 * s), cs.Pose((0, 0, 8e-4 * s)),
                             grounding="floating"),
                     cs.Body(cs.Sphere(5e-4 * s), cs.Pose((0, 0, 1.9e-3 * s)), "water")],
        "tied": [cs.Body(cs.Sphere(5e-4 * s), cs.Pose((0, 0, 8e-4 * s)), grounding=1e-13 * s)],
        "wide": [cs.Body(cs.Box((0.03 * s, 0.02 * s, 0.01 * s)), cs.Pose((0, 0, 6.5e-3 * s)))],
        "mesh": [cs.Body(cs.TriMesh(tetrahedron, faces), cs.Pose((0, 0, 5e-4 * s)), "wood")],
        "at the wall": [cs.Body(cs.Sphere(1e-3 * s), cs.Pose((4.8e-3 * s, 0, 1e-3 * s)))],
    }  # fmt: skip


def _close(found: np.ndarray, expected: np.ndarray, within: float = 1e-3) -> None:
    np.testing.assert_allclose(found, expected, rtol=0, atol=within * np.abs(expected).max())


@pytest.mark.parametrize("scale", SCALES)
def test_scaled_scenes_have_the_same_readings(scale: float):
    one, other = _simulator(1.0), _simulator(scale)
    _close(other.baseline / scale, one.baseline)
    for (name, before), after in zip(_scenes(1.0).items(), _scenes(scale).values(), strict=True):
        was, now = one.step(cs.Scene(before)), other.step(cs.Scene(after))
        assert np.abs(was.delta).max() > 0, name
        _close(now.delta / scale, was.delta)
        assert now.stats.solver_error / scale == approx(was.stats.solver_error, rel=1e-3)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_slopes_and_potentials_scale(scale: float):
    one, other = _simulator(1.0), _simulator(scale)
    points = np.array([[0.0, 0.0, 4e-4], [1e-3, 2e-4, 3e-3]])
    for name in ("ball", "near"):
        readings = [
            sim.step(cs.Scene(_scenes(s)[name]), jacobian=True, keep_field=True)
            for sim, s in ((one, 1.0), (other, scale))
        ]
        was, now = (reading.jacobian for reading in readings)
        _close(now[..., :3], was[..., :3])
        _close(now[..., 3:] / scale, was[..., 3:])
        _close(readings[1].potentials(scale * points), readings[0].potentials(points))
        held = [reading.charges() for reading in readings]
        assert held[1].pitch == approx(scale * held[0].pitch)
        _close(held[1].points / scale, held[0].points)
        _close(held[1].density * scale, held[0].density)


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_fleets_scale(device: str, monkeypatch: pytest.MonkeyPatch):
    if device != "cpu":
        pytest.importorskip("warp")
    readings = []
    for scale in (1.0, 1e-3):
        sim = _simulator(scale)
        monkeypatch.setattr("capsense.fleet.fleet.load_or_build", lambda *_, s=sim: s.background)
        bodies = [
            cs.Body(cs.Sphere(8e-4 * scale), grounding="floating"),
            cs.Body(cs.Box((2e-3 * scale, 1e-3 * scale, 5e-4 * scale))),
        ]
        fleet = cs.Fleet(sim.design, bodies, 2, device=device)
        poses = np.zeros((2, 2, 7))
        poses[..., 6] = 1.0
        # not symmetric: where two points are nearest, rounding decides between them
        poses[:, 0, 2] = [1.1e-3, 1.6e-3]
        poses[:, 1, :3] = [[7e-5, 1e-3, 5e-4], [1e-3, 0, 4e-3]]
        poses[:, 1, 3:] = [0.1, 0.2, 0.3, math.sqrt(0.86)]
        poses[..., :3] *= scale
        found = fleet.step(poses, jacobian=True)
        delta, slope = (
            np.array(x if isinstance(x, np.ndarray) else x.numpy())
            for x in (found.delta, found.jacobian)
        )
        readings.append((delta, slope.reshape(*slope.shape[:4], -1, 6)))
    (was, slope), (now, other) = readings
    _close(now / 1e-3, was)
    _close(other[..., :3], slope[..., :3], 5e-3)  # of single precision on Warp
    _close(other[..., 3:] / 1e-3, slope[..., 3:], 5e-3)


def _disc(radius: float, domain: float, backplane: float, is_open: bool) -> cs.Simulator:
    domain_of = {"size": [domain] * 3, "backplane": backplane, "open": is_open}
    disc = {"name": "E", "shape": "disc", "radius": radius}
    return cs.Simulator(parse_design({"name": "disc", "domain": domain_of, "electrode": [disc]}))


def _ball(radius: float, z: float) -> cs.Scene:
    return cs.Scene([cs.Body(cs.Sphere(radius), cs.Pose((0.0, 0.0, z)))])


@pytest.mark.e2e
def test_a_ball_over_a_disc_in_the_open_reads_what_exact_images_say():
    """0.0786 and 0.2009 of the disc's own capacitance at gaps of two radii and one."""
    for radius in (5e-3, 5e-6):
        sim = _disc(radius, 100 * radius, 50 * radius, True)
        own = 8 * EPS0 * radius
        assert sim.baseline[0, 0] == approx(own, rel=2e-3)
        for z, expected in ((3 * radius, 0.0786), (2 * radius, 0.2009)):
            assert sim.step(_ball(radius, z)).delta[0, 0] / own == approx(expected, rel=0.02)


@pytest.mark.e2e
def test_small_boxes_are_like_large_ones():
    # boundary elements of disc, walls and ball, by PlaneResponse with 320 triangles for a plane
    for size, expected in ((0.3, 52.2), (0.05, 50.4), (0.04, 48.9), (0.03, 45.2)):
        reading = _disc(5e-3, size, 5e-3, False).step(_ball(4e-3, 8e-3))
        assert reading.delta[0, 0] == approx(1e-15 * expected, rel=0.02)
    small, large = (_disc(5e-3, size, 0.5 * size, True) for size in (0.03, 0.3))
    for z, within in ((0.01, 5e-3), (0.015, 5e-3), (0.03, 0.05)):  # the last far outside the box
        one, other = (sim.step(_ball(5e-3, z)).delta[0, 0] for sim in (small, large))
        assert one == approx(other, rel=within)
