"""Floating bodies, and bodies tied to ground through a capacitance."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx
from field_cases import ball

import capsense as cs
from capsense.constants import EPS0

Array = np.ndarray


def delta(sim: cs.Simulator, *bodies: cs.Body) -> Array:
    sim.reset()
    return sim.step(cs.Scene(bodies)).delta


def assert_same(got: Array, expected: Array, part: float) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=part * np.abs(expected).max())


def test_a_large_capacitance_to_ground_grounds(simulators):
    """Analytic: 1 F is a short circuit."""
    sim = simulators("six_patch_bare")
    assert_same(delta(sim, ball(grounding=1e-3)), delta(sim, ball()), 2e-4)


def test_a_tiny_capacitance_to_ground_floats(simulators):
    """Analytic: 1e-20 F is an open circuit."""
    sim = simulators("six_patch_bare")
    floating = delta(sim, ball(grounding="floating"))
    assert_same(delta(sim, ball(grounding=1e-20)), floating, 2e-4)


def test_impedance_lies_in_between_as_a_divider(simulators):
    """Analytic: ΔC(C_g) = ΔC_float + (ΔC_ground − ΔC_float) C_g / (C_g + C_self)."""
    sim = simulators("six_patch_bare")
    grounded, floating = delta(sim, ball()), delta(sim, ball(grounding="floating"))
    step = grounded - floating
    assert np.linalg.matrix_rank(step, tol=5e-3 * np.abs(step).max()) == 1
    ties = np.array([1e-12, 3e-12, 10e-12])
    share = np.array([(delta(sim, ball(grounding=c)) - floating)[0, 0] / step[0, 0] for c in ties])
    own = ties * (1 / share - 1)
    np.testing.assert_allclose(own, own.mean(), rtol=5e-3)
    # a free sphere has 4π eps0 R; floor and electrodes nearby add to it
    free = 4 * math.pi * EPS0 * 0.04
    assert 1.1 * free < own.mean() < 2.0 * free


def test_the_order_of_readings_does_not_matter(simulators):
    """Invariant: floating → grounded → floating returns to the same reading."""
    sim = simulators("six_patch_bare")
    sim.reset()
    first, _, third = (
        sim.step(cs.Scene([ball(grounding=g)])).delta for g in ("floating", "grounded", "floating")
    )
    assert_same(third, first, 1e-4)


HALF = (0.03, 0.06, 0.06)


@pytest.mark.parametrize(("overlap", "within"), [(0.005, 0.014), (0.0, 8e-3)])
@pytest.mark.parametrize("grounding", ["floating", 1e-12])
def test_touching_bodies_are_one(simulators, overlap, within, grounding):
    """Measured: two halves equal their union within 1 %; ties to ground act in parallel."""
    sim = simulators("six_patch_bare")
    rotation = (0.0, 0.0, 0.1, 1.0)
    pose = cs.Pose((0.0, 0.0, 0.06), rotation)
    along = pose.rotation[:, 0]
    halves = [
        cs.Body(
            cs.Box((HALF[0] + overlap, *HALF[1:])),
            cs.Pose(np.array(pose.position) + side * (HALF[0] - overlap) / 2 * along, rotation),
            grounding=grounding,
        )
        for side in (-1.0, 1.0)
    ]
    total = grounding if isinstance(grounding, str) else 2 * grounding
    union = cs.Body(cs.Box((2 * HALF[0], *HALF[1:])), pose, grounding=total)
    assert_same(delta(sim, *halves), delta(sim, union), within)


@pytest.mark.parametrize("jacobian", [False, True])
def test_what_touches_outside_of_the_domain_counts(simulators, jacobian):
    """Invariant: an arm on 10 pF that goes on outside as one on 30 pF is on 40 pF."""
    sim = simulators("six_patch_bare")
    assert sim.design.domain.upper[0] < 0.29
    lying = (0.0, 2**-0.5, 0.0, 2**-0.5)

    def arm(middle: float, grounding: float) -> cs.Body:
        pose = cs.Pose((middle, 0.0, 0.08), lying)
        return cs.Body(cs.Capsule(0.03, 0.3), pose, grounding=grounding)

    outer = arm(0.42, 30e-12)
    both = sim.step(cs.Scene([outer, arm(0.1, 10e-12)]), jacobian=jacobian)
    alone = sim.step(cs.Scene([arm(0.1, 40e-12)]), jacobian=jacobian)
    np.testing.assert_allclose(both.delta, alone.delta, rtol=1e-9)
    if jacobian:
        np.testing.assert_allclose(both.jacobian[1], alone.jacobian[0], rtol=1e-9, atol=1e-25)
    apart = sim.step(cs.Scene([arm(0.1, 10e-12)]))
    assert np.abs(apart.delta - alone.delta).max() > 0.05 * np.abs(alone.delta).max()


@pytest.mark.parametrize("seams", [10, pytest.param(30, marks=pytest.mark.e2e)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_seam_is_hardly_seen(simulators, axis, seams):
    """Measured: a plate in two equals the plate, wherever the seam is, within so much.

    Each half has functions that are weighted with its own equilibrium charge, which gathers where
    the seam is.
    """
    sim = simulators("six_patch_bare")
    size = np.array([0.15, 0.15, 0.02])

    def piece(low: float, high: float, gap: float) -> cs.Body:
        sides, place = size.copy(), np.array([0.0, 0.0, gap + size[2] / 2])
        sides[axis], place[axis] = high - low, (low + high) / 2
        return cs.Body(cs.Box(tuple(sides)), cs.Pose(place))

    for gap, within in ((0.002, 0.23), (0.005, 0.1), (0.01, 0.06), (0.02, 0.035), (0.05, 0.02)):
        whole = delta(sim, piece(-0.075, 0.075, gap))
        for seam in np.linspace(-0.0597, 0.0597, seams):  # whose parts are of as many sizes
            halves = piece(-0.075, seam, gap), piece(seam, 0.075, gap)
            assert_same(delta(sim, *halves), whole, within)


def test_a_grounded_body_grounds_what_it_touches(simulators):
    """Invariant: a floating body in contact with a grounded one is grounded."""
    sim = simulators("six_patch_bare")
    arm = cs.Body(cs.Box((0.02, 0.02, 0.2)), cs.Pose((0.03, 0.0, 0.2)))
    both = delta(sim, ball(grounding="floating"), arm)
    assert_same(both, delta(sim, ball(), arm), 1e-4)
    apart = cs.Body(cs.Box((0.02, 0.02, 0.2)), cs.Pose((0.1, 0.0, 0.2)))
    assert np.abs(
        delta(sim, ball(grounding="floating"), apart) - delta(sim, ball(), apart)
    ).max() > (0.1 * np.abs(both).max())


def test_a_floating_plate_couples_electrodes(simulators):
    """Measured: floating metal over two electrodes raises the mutual capacitance between them."""
    sim = simulators("six_patch_bare")
    plate = cs.Box((0.1, 0.03, 0.005))
    pose = cs.Pose((0.0, 0.025, 0.008))
    floating = delta(sim, cs.Body(plate, pose, grounding="floating"))
    grounded = delta(sim, cs.Body(plate, pose))
    assert floating[3, 4] < 0 < grounded[3, 4]
    assert floating[3, 5] < 0


def test_grounding_of_a_dielectric_is_ignored(simulators):
    """Invariant: what does not conduct cannot be grounded."""
    sim = simulators("six_patch_bare")
    one, two = (delta(sim, ball(material="glass", grounding=g)) for g in ("grounded", "floating"))
    np.testing.assert_array_equal(one, two)


def test_two_floating_bodies_far_apart_add_up(simulators):
    """Measured: bodies over opposite ends of the sensor change their own ends alone."""
    sim = simulators("six_patch_bare")
    left, right = (
        cs.Body(cs.Sphere(0.01), cs.Pose((x, 0.0, 0.02)), grounding="floating")
        for x in (-0.05, 0.05)
    )
    both = delta(sim, left, right)
    assert_same(both, delta(sim, left) + delta(sim, right), 0.03)


def test_a_limb_that_leaves_the_box_keeps_its_tie(simulators):
    """Invariant: on 100 pF, a limb that goes out through two walls is not grounded by them.

    Measured: 1.3 % of the change between a limb of 0.28 m and one of 2 m, 0.9 % of it true;
    grounded, it is 4 % more.
    """
    sim = simulators("six_patch_bare")

    def limb(length: float, grounding) -> float:
        pose = cs.Pose((0, 0, 0.09), (0, 1, 0, 1))
        return delta(sim, cs.Body(cs.Capsule(0.04, length), pose, "human", grounding))[0, 0]

    short, long = limb(0.2, 100e-12), limb(2.0, 100e-12)
    assert long == approx(short, rel=0.015)
    assert limb(2.0, "grounded") > 1.03 * long


def test_grounded_plates_above_each_other(simulators):
    """They are not held apart: on each other they read up to 16 % too much, as the theory says."""

    def plate(z: float, thickness: float) -> cs.Body:
        pose = cs.Pose((0.0, 0.0, z + thickness / 2))
        return cs.Body(cs.Box((0.06, 0.06, thickness)), pose, "steel")

    def ratio(second: float, whole: float) -> Array:
        sim = simulators("six_patch_bare")
        pair = delta(sim, plate(3e-3, 1e-4), plate(second, 1e-4)).diagonal()
        return pair / delta(sim, plate(3e-3, whole)).diagonal() - 1

    touching = ratio(3.1e-3, 2e-4)
    assert 0.0 < touching.min() < touching.max() < 0.17
    assert np.abs(ratio(4.1e-3, 1.2e-3)).max() < 0.04
