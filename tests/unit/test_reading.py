"""Signs of what a reading tells, which tests of magnitudes would not notice."""

from __future__ import annotations

import numpy as np

import capsense as cs
from capsense.field.background import Terminals


def test_mutual_capacitances_are_positive() -> None:
    """Definition: minus the Maxwell matrix off its diagonal, zero on it; a new array."""
    reading = cs.Simulator("six_patch").step(
        cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.06)))])
    )
    mutual = reading.mutual_capacitance
    off = ~np.eye(6, dtype=bool)
    np.testing.assert_array_equal(mutual[off], -reading.capacitance[off])
    assert (mutual[off] > 0).all()
    assert not np.diag(mutual).any()
    assert (np.diag(reading.capacitance) > 0).all()
    assert "shield_coupling" not in repr(reading)


def test_shields_take_charge_away() -> None:
    """Definition: with the shields driven along, what couples to them is not charged."""
    simulator = cs.Simulator("arm_segment")
    terminals = Terminals(simulator.design, simulator.background.capacitance)
    n = terminals.electrodes
    assert terminals.driven > n
    reading = simulator.step(cs.Scene())
    along = np.concatenate([np.ones(terminals.driven - n)])
    expected = np.diag(terminals.empty)[:n] + terminals.empty[:n, n:] @ along
    np.testing.assert_allclose(reading.self_capacitance, expected, rtol=1e-12)
    assert (reading.self_capacitance < np.diag(reading.capacitance)).all()
    assert (reading.self_capacitance > 0).all()


def test_the_empty_reading_took_no_work() -> None:
    """Definition: nothing was solved, nothing changed, and no chip has seen it."""
    simulator = cs.Simulator("six_patch")
    empty = simulator.empty
    assert (empty.stats.solver_error, empty.stats.wall_time) == (0.0, 0.0)
    assert (empty.stats.unknowns, empty.stats.iterations) == (0, 0)
    np.testing.assert_array_equal(empty.capacitance, simulator.baseline)
    assert not empty.delta.any()
    assert empty.counts is empty.jacobian is empty.conductance is None
