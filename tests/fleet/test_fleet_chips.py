"""Chips side by side, against one readout for each sensor."""

from __future__ import annotations

import numpy as np
import pytest
from test_fleet import BODIES, poses

import capsense as cs
from capsense.errors import ReadoutError
from capsense.fleet import Fleet
from capsense.readout.readout import Readout
from capsense.readout.side_by_side import SideBySide

COUNT, NAMES = 5, tuple(f"E{k}" for k in range(1, 7))


def without_noise(chip="fdc1004"):
    whole = Readout.preset(chip, NAMES)
    return Readout(whole.bank, whole.schedule, whole.law, dac=whole.dac, wiring=whole.wiring)


def matrices(rng, count=COUNT):
    out = rng.uniform(1e-12, 3e-12, (count, 6, 6))
    return out + out.transpose(0, 2, 1)


@pytest.mark.parametrize("chip", ["fdc1004", "ad7147", "mpr121"])
def test_every_chip_is_as_one_alone(chip):
    """Differential: without noise, over steps of a time that is no period's multiple."""
    rng = np.random.default_rng(1)
    one = without_noise(chip)
    many = SideBySide(one, COUNT)
    alone = [without_noise(chip) for _ in range(COUNT)]
    for k in range(150):
        matrix = matrices(rng)
        found = many.sample(0.0037 * k, matrix)
        assert found.code.shape == (COUNT, len(one.bank))
        for row, chip_alone in enumerate(alone):
            truth = chip_alone.sample(0.0037 * k, chip_alone.bank.values(matrix[row])).held()
            np.testing.assert_array_equal(found.code[row], truth.code)
            np.testing.assert_array_equal(found.capacitance[row], truth.capacitance)
            np.testing.assert_allclose(found.age[row], truth.age, rtol=0, atol=1e-12)


def test_noise_is_that_of_the_chip_and_differs():
    """Measured: standard deviations as of one chip; no two chips, nor channels, go together."""
    matrix = np.broadcast_to(matrices(np.random.default_rng(2), 1), (40, 6, 6))
    whole = Readout.preset("fdc1004", NAMES)
    many = SideBySide(whole, 40, seed=3)
    period = whole.schedule.period
    rows = np.array([many.sample(2 * period * k, matrix).capacitance for k in range(3, 203)])[5:]
    noise = (rows - rows.mean(axis=0)).reshape(len(rows), -1)
    alone = whole(2 * period * np.arange(2000), np.broadcast_to(matrix[0], (2000, 6, 6)))
    sigma = alone.table()[1].std(axis=0)
    np.testing.assert_allclose(rows.std(axis=0).mean(axis=0), sigma, rtol=0.1)
    together = np.corrcoef(noise.T)
    np.fill_diagonal(together, 0.0)
    assert np.abs(together).max() < 0.5
    assert np.abs(together).mean() < 0.1


def test_a_seed_repeats():
    """Invariant: to the last bit."""
    matrix = matrices(np.random.default_rng(4))
    many = SideBySide(Readout.preset("fdc1004", NAMES), COUNT, seed=7)
    first = [many.sample(0.01 * k, matrix).code for k in range(20)]
    many.reset()
    np.testing.assert_array_equal(first, [many.sample(0.01 * k, matrix).code for k in range(20)])
    many.reset(seed=8)
    assert (first[-1] != [many.sample(0.01 * k, matrix).code for k in range(20)][-1]).any()


def test_a_fleet_reads_through_chips():
    """Differential: against the chip of a simulator, without noise, shields driven along."""
    fleet = Fleet("six_patch", BODIES[:1], COUNT)
    fleet.use_readout(without_noise())
    simulator = cs.Simulator("six_patch", preset="learning")
    rng = np.random.default_rng(5)
    chips = [without_noise() for _ in range(COUNT)]
    for k in range(4):
        where = poses(rng, COUNT, 1)
        held = fleet.step(where, time=0.05 * k).held
        for e, chip in enumerate(chips):
            pose = cs.Pose(where[e, 0, :3], where[e, 0, 3:])
            reading = simulator.step(cs.Scene([BODIES[0].moved(pose)]))
            truth = chip.sample(0.05 * k, reading).held()
            assert np.abs(held.code[e, 0] - truth.code).max() <= 1
    assert np.isfinite(held.age).all()


def test_refused():
    """Errors name the thing and the fix."""
    fleet = Fleet("six_patch", BODIES[:1], 2)
    fleet.use_readout("fdc1004")
    with pytest.raises(ReadoutError, match=r"needs the time; write step\(poses, time=…\)"):
        fleet.step(poses(np.random.default_rng(6), 2, 1))
    with pytest.raises(ReadoutError, match="electrodes"):
        fleet.use_readout(Readout.preset("fdc1004", ("a", "b")))
    many = SideBySide(without_noise(), COUNT)
    with pytest.raises(ReadoutError, match=r"shape \(4, 6, 6\); give matrices of 5 sensors"):
        many.sample(0.0, matrices(np.random.default_rng(7), 4))
