"""Potentials of a step: what they are held to, and what they must not pass."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs

BAR = cs.Body(cs.Box((0.15, 0.15, 0.02)), pose=cs.Pose((0, 0, 0.04)), material="steel")


@pytest.fixture(scope="module")
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch")


def test_empty_scene(simulator: cs.Simulator) -> None:
    """Those of the background field."""
    simulator.reset()
    simulator.step(cs.Scene())
    np.testing.assert_array_equal(simulator.potentials(), simulator.background.potentials)


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-10])
def test_what_conductors_hold(simulator: cs.Simulator, grounding: str | float) -> None:
    """One on a terminal's own nodes, none on walls, other terminals and in conducting bodies."""
    simulator.reset()
    simulator.step(cs.Scene([cs.Body(BAR.shape, BAR.pose, BAR.material, grounding)]))
    potentials, lattice = simulator.potentials(), simulator.background.lattice
    assert potentials.shape == (lattice.n_nodes, 6)
    held = lattice.owner >= 0
    np.testing.assert_allclose(potentials[held], np.eye(6)[lattice.owner[held]], atol=1e-12)
    inside = BAR.shape.signed_distance(BAR.pose.inverse().apply(lattice.points)) < -1e-3
    assert inside.sum() > 50
    np.testing.assert_allclose(potentials[inside], 0.0, atol=1e-6)


def test_between_the_conductors(simulator: cs.Simulator) -> None:
    """Nowhere above one or below zero, and a conductor lowers them everywhere."""
    simulator.reset()
    simulator.step(cs.Scene([BAR]))
    potentials = simulator.potentials()
    assert potentials.min() > -1e-3
    assert potentials.max() <= 1.0 + 1e-6
    assert (potentials - simulator.background.potentials).max() < 1e-3
    at = np.argmin(np.linalg.norm(simulator.background.lattice.points - [0, 0, 0.02], axis=1))
    assert (potentials[at] < 0.8 * simulator.background.potentials[at]).all()


def test_masked() -> None:
    """The other method refuses, and says which one does not."""
    with pytest.raises(ValueError, match='use "perturbation"'):
        cs.Simulator("six_patch", method="masked").potentials()
