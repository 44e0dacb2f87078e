"""Thin dielectrics, like cloth: what they add, by first-order theory."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from sheet_theory import first_order

import capsense as cs

EPS_R = 1.6
SIZE = 0.2


def sheet(z: float, thickness: float = 0.001, eps_r: float = EPS_R) -> cs.Body:
    """A level sheet [m]."""
    return cs.Body(
        cs.Box((SIZE, SIZE, thickness)), cs.Pose((0.0, 0.0, z)), cs.Material("cloth", eps_r)
    )


@pytest.mark.parametrize("thickness", [0.0005, 0.001, 0.002])
def test_level_sheets_against_first_order_theory(simulators, thickness):
    """Measured: within 17 % from 18 to 33 mm, 28 % at 0.5 mm; nearer these read 40 % high."""
    sim = simulators("six_patch")
    for z in (0.008, 0.010, 0.012, 0.0147, 0.018, 0.022, 0.025, 0.030, 0.033):
        sim.reset()
        found = sim.step(cs.Scene([sheet(z, thickness)])).delta[1, 1]
        ratio = found / first_order(sim, z, thickness, SIZE, EPS_R, 1)
        most = 1.28 if z > 0.016 else 1.4
        assert 0.84 <= ratio <= most, f"{ratio:.2f} of the theory at {1e3 * z:.1f} mm"


@pytest.mark.parametrize("turn", [0.0, 0.2, 0.5, 0.785])
def test_a_sheet_that_rises_is_followed(simulators, turn):
    """Measured: no step over 0.5 mm takes more than a quarter of what the sheet does."""
    sim = simulators("six_patch")
    values = []
    for k in range(24):
        pose = cs.Pose((0, 0, 0.045 + 5e-4 * k), (0, np.sin(turn / 2), 0, np.cos(turn / 2)))
        body = cs.Body(cs.Box((SIZE, SIZE, 0.001)), pose, cs.Material("cloth", EPS_R))
        values.append(sim.step(cs.Scene([body])).delta[1, 1])
    assert np.abs(np.diff(values)).max() <= 0.25 * np.mean(values)
    assert values[-1] < values[0]


def test_twice_the_sheet_does_twice_as_much(simulators):
    """Measured: to 5 %, in thickness and in permittivity less one."""
    sim = simulators("six_patch")
    for z in (0.012, 0.02, 0.03):
        thin, thick = (sim.step(cs.Scene([sheet(z, t)])).delta[1, 1] for t in (2.5e-4, 5e-4))
        assert thick == approx(2 * thin, rel=0.05)
        light, dense = (sim.step(cs.Scene([sheet(z, 5e-4, e)])).delta[1, 1] for e in (1.01, 1.02))
        assert dense == approx(2 * light, rel=0.05)


@pytest.mark.parametrize(("eps_r", "sigma"), [(3.0, 2.8e-5), (10.0, 4.2e-4)])
def test_losses_of_what_deforms(simulators, eps_r, sigma):
    """Differential: a ball and a sheet of 2 mm, as surfaces that deform, against rigid shapes.

    With a permittivity of 10 they are 0.3 and 4 % apart in phase, in quadrature 8 and 25 %. What is
    left is the sheet's own: with the preset "fine" it is 0.5 % in phase, 28 to 31 % in quadrature.
    """
    sim, matter = simulators("six_patch"), cs.Material("wet", eps_r, sigma)
    ball = cs.Sphere(0.03).to_trimesh()
    side = np.linspace(-0.05, 0.05, 17)
    grid = np.stack([*np.meshgrid(side, side, indexing="ij"), np.full((17, 17), 0.02)], axis=-1)
    a = np.arange(17 * 17).reshape(17, 17)
    low = np.stack([a[:-1, :-1], a[1:, :-1], a[1:, 1:]], axis=-1).reshape(-1, 3)
    high = np.stack([a[:-1, :-1], a[1:, 1:], a[:-1, 1:]], axis=-1).reshape(-1, 3)
    for shape, vertices, faces in (
        (cs.Sphere(0.03), np.add(ball.vertices, (0, 0, 0.045)), ball.faces),
        (cs.Box((0.1, 0.1, 0.002)), grid.reshape(-1, 3), np.concatenate([low, high])),
    ):
        rigid = cs.Body(shape, cs.Pose((0, 0, vertices[:, 2].mean())), matter, "floating")
        surface = cs.DeformableSurface(
            vertices, faces, thickness=0.002, material=matter, grounding="floating"
        )
        wanted, found = (sim.step(cs.Scene([b])) for b in (rigid, surface.body()))
        assert found.delta[1, 1] == approx(wanted.delta[1, 1], rel=0.16)
        assert found.conductance[1, 1] == approx(wanted.conductance[1, 1], rel=0.25)
