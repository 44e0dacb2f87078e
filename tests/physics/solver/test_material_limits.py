"""Limits of what bodies are made of: like air, like a conductor, in pieces, with losses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx
from solver_scenes import Array, apart, cube, reading, simulator

import capsense as cs
from capsense.solver.tree.matter import CONDUCTING


def ball(material: cs.Material, grounding: str | float = "grounded") -> cs.Body:
    return cs.Body(cs.Sphere(0.03), cs.Pose((0.01, 0.0, 0.05)), material, grounding)


@pytest.mark.parametrize("sigma", [0.0, 1e-9])
def test_nothing_comes_of_matter_like_air(sigma: float) -> None:
    """Analytic: ΔC falls in proportion to eps - 1 and vanishes with it."""

    def of(eps: float) -> float:
        return float(reading(ball(cs.Material("m", eps, sigma), "floating")).max())

    metal = float(reading(ball(cs.Material("metal", 1.0, 1e6), "floating")).max())
    assert of(1.0) < 1e-4 * metal
    assert of(1.02) / of(1.01) == approx(2.0, rel=0.02)
    assert of(1.1) < 0.1 * metal


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
@pytest.mark.parametrize("lossy", [False, True])
def test_conductors_are_the_limit_of_large_eps(grounding: str, lossy: bool) -> None:
    """Measured: across the permittivity from which the inside is left out."""
    unit = 2 * math.pi * 250e3 * cs.constants.EPS0

    def of(size: float) -> Array:
        if lossy:
            return reading(ball(cs.Material("m", 2.0, size * unit), grounding))
        return reading(ball(cs.Material("m", size), grounding))

    below, above = of(0.999 * CONDUCTING), of(1.001 * CONDUCTING)
    assert apart(below, above) < 1e-3
    assert not np.array_equal(below, above)


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-12])
def test_pieces_in_a_row_read_as_the_whole(grounding: str | float) -> None:
    """Measured: three boxes that touch and one three times as long."""
    whole = cs.Body(cs.Box((0.06, 0.03, 0.03)), cs.Pose((0.0, 0.0, 0.045)), "steel", grounding)
    share = grounding / 3 if isinstance(grounding, float) else grounding
    pieces = reading(*(cube(k, share) for k in (-1, 0, 1)))
    assert apart(pieces, reading(whole)) < 0.012


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-12])
def test_losses_elsewhere_leave_joined_conductors_alone(grounding: str | float) -> None:
    """Measured: a lossy speck far off changes a little which functions are chosen."""
    row = [cube(-0.5, grounding), cube(0.5, grounding)]
    speck = cs.Body(cs.Sphere(0.002), cs.Pose((0.0, 0.1, 0.25)), cs.Material("wet", 5.0, 1e-5))
    assert apart(reading(*row, speck), reading(*row)) < 9e-3


@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_conductance_of_a_lossy_ball(sigma: float) -> None:
    """Analytic: a ball far off answers as its polarisability, (ε* − 1) / (ε* + 2)."""
    sim = simulator()
    omega = 2 * math.pi * sim.excitation_frequency

    def answer(material: cs.Material) -> cs.Reading:
        ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.15)), material, "floating")
        return sim.step(cs.Scene([ball]))

    eps = 5.0 - 1j * sigma / (omega * cs.constants.EPS0)
    reading, metal = answer(cs.Material("wet", 5.0, sigma)), answer(cs.Material("metal", 1.0, 1e6))
    assert metal.conductance is None
    wanted = (eps - 1) / (eps + 2)
    found = reading.delta - 1j * reading.conductance / omega
    assert abs(found.trace() / metal.delta.trace() - wanted) < 0.01 * abs(wanted)
    loss = np.linalg.eigvalsh(reading.conductance)
    assert loss.min() > -1e-3 * loss.max()  # it takes up power
