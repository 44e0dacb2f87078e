"""A domain without walls: ground is at infinity. Held against closed forms."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from approximate import approx
from tiny_field import few_sources

import capsense as cs
from capsense import codec
from capsense.constants import EPS0
from capsense.design import parse_design
from capsense.field.background import build_background

RADIUS = 0.010


def disc(**domain: object) -> cs.Design:
    return parse_design(
        {
            "name": "disc",
            "domain": {"size": [0.5, 0.5, 0.5], "backplane": 0.1, **domain},
            "electrode": [{"name": "E", "shape": "disc", "radius": RADIUS}],
        }
    )


@pytest.fixture(scope="module")
def sim(field_cache: Path) -> cs.Simulator:
    return cs.Simulator(disc(open=True), cache_dir=field_cache)


@pytest.fixture(scope="module")
def boxed(field_cache: Path) -> cs.Simulator:
    return cs.Simulator(disc(), cache_dir=field_cache)


@pytest.mark.e2e
def test_disc_alone_has_the_capacitance_of_the_textbook(sim, boxed):
    """8 eps0 a (Jackson, Classical Electrodynamics, section 3.13), of a polygon, by panels."""
    expected = 8 * EPS0 * RADIUS
    assert sim.baseline[0, 0] == approx(expected, rel=5e-4)
    assert boxed.baseline[0, 0] > 1.01 * expected


@pytest.mark.e2e
@pytest.mark.parametrize("z", [0.05, 0.1, 0.2, 0.35])
@pytest.mark.parametrize("b", [0.005, 0.015])
def test_small_ball_sees_the_potential_of_a_disc(sim, z, b):
    """ΔC = 4π eps0 [b φ² / (1 − b g) + b³ E²], φ = (2/π) atan(a/z) and E = −φ' in its middle.

    g, the disc's answer at the ball, is near φ² / (8 a/4π) for a ball far away. The second term is
    the dipole's.
    """
    ball = cs.Body(cs.Sphere(b), cs.Pose((0, 0, z)), "steel")
    phi = 2 / math.pi * math.atan(RADIUS / z)
    own = b * phi**2 / (2 * RADIUS / math.pi)
    slope = 2 / math.pi * RADIUS / (RADIUS**2 + z**2)
    expected = 4 * math.pi * EPS0 * (b * phi**2 / (1 - own) + b**3 * slope**2)
    found = sim.step(cs.Scene([ball])).delta[0, 0]
    assert found == approx(expected, rel=0.02)


@pytest.mark.e2e
def test_walls_pull_the_field_of_a_far_ball_down(sim, boxed):
    """Beside the far wall of a box a ball is hardly seen; without walls it is."""
    scene = cs.Scene([cs.Body(cs.Sphere(0.015), cs.Pose((0, 0, 0.35)), "steel")])
    assert sim.step(scene).delta[0, 0] > 3 * boxed.step(scene).delta[0, 0] > 0


def test_open_is_part_of_a_design(tmp_path):
    opened, closed = disc(open=True), disc()
    assert opened.content_hash() != closed.content_hash()
    assert disc(open=False).content_hash() == closed.content_hash()
    back = codec.design_from_json(codec.design_to_json(opened))
    assert back.domain.open
    assert back.content_hash() == opened.content_hash()


def test_masked_scheme_needs_walls():
    with pytest.raises(ValueError, match=r"'disc' has an open domain.*use method 'surface'"):
        cs.Simulator(disc(open=True), method="fem_masked")


def test_open_is_true_or_false():
    with pytest.raises(cs.DesignError, match="open"):
        disc(open="yes")


@pytest.mark.e2e
def test_matrix_is_physical_with_a_layer_at_the_end_of_the_box():
    """A layer that reaches the box's end has an interface there, since no wall is."""
    layer = {"name": "cover", "eps_r": 3.0, "size": [0.1, 0.1], "z": [0.0, 0.002]}
    data = {"size": [0.1, 0.1, 0.2], "backplane": 0.05, "open": True}
    design = disc(**data)
    covered = parse_design(
        {
            "name": "covered",
            "domain": data,
            "electrode": [{"name": "E", "shape": "disc", "radius": RADIUS}],
            "layer": [layer],
        }
    )
    with few_sources():  # capacitances come from the boundary elements alone
        bare, more = (build_background(d).capacitance[0, 0] for d in (design, covered))
    assert 1.05 < more / bare < 2.0
    assert np.isfinite(more)
