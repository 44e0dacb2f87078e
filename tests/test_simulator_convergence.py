"""How fast ΔC converges with the lattice: second order for smooth conductors."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import capsule, capsule_reference, delta_reference

import capsense as cs
from capsense.field.background import BuildSettings
from capsense.field.lattice import LatticeSettings

Array = np.ndarray

SHIFTS = np.random.default_rng(5).uniform(-0.003, 0.003, (8, 3))
"""Offsets [m] of body against lattice, over which errors are averaged (root mean square)."""


def lattice(factor: float) -> BuildSettings:
    """A refined lattice; coarse panels, whose error all lattices share, make it quick to build."""
    return BuildSettings(lattice=LatticeSettings().refined(factor), panel_scale=2.0)


def rate(factors: list[float], errors: list[float]) -> float:
    """Fitted order: slope of log error over log spacing."""
    return float(np.polyfit(np.log(1 / np.array(factors)), np.log(errors), 1)[0])


def errors(simulators, factors, body, expected_of) -> list[float]:
    """Root-mean-square error of ΔC's diagonal relative to the reference, per refinement."""
    out = []
    for factor in factors:
        settings = lattice(factor)
        sim = simulators("six_patch_bare", settings=settings)
        got = np.array([np.diag(sim.step(cs.Scene([body(s)])).delta) for s in SHIFTS])
        expected = np.array([np.diag(expected_of(s)) for s in SHIFTS])
        out.append(float(np.sqrt(np.mean((got / expected - 1) ** 2))))
    return out


def shifted_by_reference(simulators, body, factor: float):
    """Diagonals of the finest lattice, for offsets that no reference was computed for."""
    settings = lattice(factor)
    sim = simulators("six_patch_bare", settings=settings)
    cache: dict[bytes, Array] = {}

    def expected(shift: Array) -> Array:
        key = shift.tobytes()
        if key not in cache:
            cache[key] = sim.step(cs.Scene([body(shift)])).delta
        return cache[key]

    return expected


def sphere(shift: Array) -> cs.Body:
    return cs.Body(cs.Sphere(0.04), cs.Pose(np.array([0.0, 0.0, 0.08]) + shift))


def limb(shift: Array) -> cs.Body:
    body = capsule(0.02)
    return body.moved(cs.Pose(np.array(body.pose.position) + shift, body.pose.quaternion))


def test_sphere_on_two_lattices(simulators):
    """Measured: from 0.5 to 1 times the default's nodes per axis the error falls by 2^1.7."""
    fine = shifted_by_reference(simulators, sphere, 2.0)
    wrong = errors(simulators, [0.5, 1.0], sphere, fine)
    assert rate([0.5, 1.0], wrong) >= 1.7, wrong


@pytest.mark.slow
@pytest.mark.parametrize("body", [sphere, limb], ids=["sphere", "limb"])
def test_order_is_two(simulators, body):
    """Measured: fitted rate of at least 1.7 for smooth grounded conductors."""
    factors = [0.5, 0.7, 1.0, 1.4]
    wrong = errors(simulators, factors, body, shifted_by_reference(simulators, body, 2.4))
    assert rate(factors, wrong) >= 1.7, wrong


@pytest.mark.slow
def test_the_finest_lattice_meets_the_references(simulators):
    """Measured: what the rate is fitted against is itself right to 1.5 %."""
    settings = BuildSettings(lattice=LatticeSettings().refined(2.4))
    sim = simulators("six_patch_bare", settings=settings)
    none = np.zeros(3)
    for body, expected in (
        (sphere(none), delta_reference("six_patch_bare", "sphere grounded 1.0")),
        (limb(none), capsule_reference(20)),
    ):
        got = np.diag(sim.step(cs.Scene([body])).delta)
        np.testing.assert_allclose(got, np.diag(expected), rtol=0.015)
