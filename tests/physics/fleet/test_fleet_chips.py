"""Chips side by side, against one readout for each sensor."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from fleet_scenes import BODIES, poses

import capsense as cs
from capsense.errors import ReadoutError
from capsense.fleet import Fleet
from capsense.readout import Readout
from capsense.readout.channels import Pattern, Wiring, self_patterns
from capsense.readout.noise import allan_deviation
from capsense.readout.presets import CHIPS
from capsense.readout.side_by_side import SideBySide

COUNT, NAMES = 5, tuple(f"E{k}" for k in range(1, 7))


def without_noise(chip="fdc1004"):
    whole = Readout.preset(chip, NAMES, noise=False)
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


def test_each_sensor_has_specimens_of_its_own():
    """Measured: CAPDACs of chips side by side differ from sensor to sensor; four channels of a
    sensor share one."""
    readout = Readout.preset("fdc1004", NAMES, noise=False, capdac=8, specimen=0)
    many = SideBySide(readout, 40)
    matrix = np.broadcast_to(30e-12 * np.eye(6), (40, 6, 6))
    for _ in range(2):
        many.sample(0.0, matrix)
        found = many.sample(0.9, matrix).capacitance
        assert (found[:, 1:4] == found[:, :1]).all()
        assert (found[:, 4] == found[:, 5]).all()
        assert len(np.unique(found)) == 80
        np.testing.assert_allclose(found[:, [0, 4]].std(), 0.023 * 25e-12, rtol=0.3)
        many.reset(seed=1)  # another noise, the same specimens
    assert (many.sample(0.0, matrix).capacitance == 0).all()


def test_differences_and_two_terminals_side_by_side():
    """Differential: all modes, for many sensors as for one."""
    patterns = [
        Pattern("E1", minus="E2"), Pattern(("E3", "E4"), low=("E5",)),
        Pattern({"E1": 1.0, "E2": -2.0}, {"E6": 0.5}), Pattern("E1", {"E1": 1.0, "E4": -1.0}),
    ]  # fmt: skip
    readout = Readout.preset("fdc1004", NAMES, patterns=patterns, noise=False)
    many, rng = SideBySide(readout, COUNT), np.random.default_rng(11)
    matrix = matrices(rng) + 20e-12 * np.eye(6)
    many.sample(0.0, matrix)
    found = many.sample(0.9, matrix)
    for row in range(COUNT):
        readout.reset()
        readout.sample(0.0, matrix[row])
        alone = readout.sample(0.9, matrix[row]).held()
        np.testing.assert_array_equal(found.code[row], alone.code)
    np.testing.assert_allclose(
        found.capacitance[:, 0], matrix[:, 0, 0] - matrix[:, 1, 1], atol=1e-17
    )


def test_a_seed_repeats():
    """Invariant: to the last bit."""
    matrix = matrices(np.random.default_rng(4))
    many = SideBySide(Readout.preset("fdc1004", NAMES), COUNT, seed=7)
    first = [many.sample(0.01 * k, matrix).code for k in range(20)]
    many.reset(seed=7)
    np.testing.assert_array_equal(first, [many.sample(0.01 * k, matrix).code for k in range(20)])
    for seed in (8, None):
        many.reset(seed=seed)
        assert (first[-1] != [many.sample(0.01 * k, matrix).code for k in range(20)][-1]).any()


def test_a_fleet_reads_through_chips():
    """Differential: against the chip of a simulator, without noise, shields driven along."""
    fleet = Fleet("six_patch", BODIES[:1], COUNT)
    fleet.use_readout(without_noise())
    simulator = cs.Simulator("six_patch")
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


def on_warp(readout, count=COUNT, seed=0, empty=None):
    """Chips on Warp of ``count`` environments, and a function that samples their deltas."""
    wp = pytest.importorskip("warp")
    from capsense.fleet.warp_chips import WarpChips

    empty = np.zeros((6, 6)) if empty is None else empty
    chips = WarpChips(readout, count, 1, empty, wp.get_device("cpu"), seed=seed)
    shields = wp.zeros((count, 1, 6), dtype=wp.float64, device="cpu")

    def sample(time, matrix):
        delta = np.ascontiguousarray(matrix[:, None], np.float32)
        held = chips.sample(time, wp.array(delta, dtype=wp.float32, device="cpu"), shields)
        return [getattr(held, x).numpy()[:, 0].copy() for x in ("code", "capacitance", "age")]

    return sample


@pytest.mark.parametrize("chip", sorted(CHIPS))
def test_chips_on_warp_are_those_of_the_cpu(chip):
    """Differential: all chips by name without noise, to the last code; saturation, late results,
    large steps, and specimens of offset DACs."""
    rng = np.random.default_rng(6)
    one = without_noise(chip)
    wiring = Wiring(trace=1e-12, crosstalk=0.01)
    one = Readout(one.bank, one.schedule, one.law, dac=CHIPS[chip].dac, wiring=wiring)
    many, sample = SideBySide(one, COUNT), on_warp(one)
    step = 0.37 * one.schedule.period
    times = np.cumsum(np.concatenate([[step] * 40, [5 * step] * 20]))
    for k, time in enumerate(times):
        size = 30e-12 if k % 10 == 9 else 1e-12  # beyond the range of some
        matrix = size * rng.uniform(1, 3, (COUNT, 6, 6))
        matrix = (matrix + matrix.transpose(0, 2, 1)).astype(np.float32).astype(float)
        truth, (code, capacitance, age) = many.sample(time, matrix), sample(time, matrix)
        np.testing.assert_array_equal(code, truth.code)
        np.testing.assert_allclose(capacitance, truth.capacitance, rtol=1e-12)
        np.testing.assert_allclose(age, truth.age, rtol=0, atol=1e-9)


def test_drift_on_warp_is_that_of_the_cpu():
    """Differential: mains and a temperature that changes, which have no other random numbers."""
    whole = Readout.preset(
        "fdc1004", NAMES, noise=False, mains=1e-15, temperature=[[0.0, 25.0], [1.0, 45.0]]
    )  # fmt: skip
    assert len(whole.stages) == 2
    many, sample = SideBySide(whole, COUNT, seed=5), on_warp(whole, seed=5)
    matrix = matrices(np.random.default_rng(7)).astype(np.float32).astype(float)
    for k in range(30):
        truth, found = many.sample(0.05 * k, matrix), sample(0.05 * k, matrix)
        np.testing.assert_allclose(found[0], truth.code, rtol=0, atol=1)


@pytest.mark.parametrize("walk", [0.0, 2e-15])
def test_noise_on_warp_is_that_of_the_chip(walk):
    """Measured: deviations and Allan deviations of 400 chips are those of the CPU's 400."""
    whole = Readout.preset("fdc1004", NAMES, walk=walk)
    matrix = np.broadcast_to(
        matrices(np.random.default_rng(8), 1).astype(np.float32).astype(float), (400, 6, 6)
    )
    many, sample = SideBySide(whole, 400, seed=1), on_warp(whole, 400, seed=1)
    period = whole.schedule.period
    rows = []
    for k in range(1, 66):
        time = 1.001 * period * k
        rows.append([many.sample(time, matrix).capacitance, sample(time, matrix)[1]])
    both = np.array(rows)[1:]  # (times, 2, chips, channels)
    both = both.transpose(1, 0, 2, 3).reshape(2, 64, -1)
    for m in (1, 8):
        truth, found = (np.sqrt((allan_deviation(x, [m])[0] ** 2).mean()) for x in both)
        assert found == approx(truth, rel=0.05)
    middle, spread = both[:, -1].mean(axis=1), both[:, -1].std(axis=1)
    assert abs(middle[1] - middle[0]) < 4 * np.hypot(*spread) / both.shape[2] ** 0.5
    assert spread[1] == approx(spread[0], rel=0.1)
    together = np.corrcoef(both[1][:, :200].T)
    np.fill_diagonal(together, 0.0)
    assert np.abs(together).mean() < (0.15 if walk == 0.0 else 0.5)


def test_a_fleet_on_warp_reads_through_chips_on_the_device():
    """Differential: against chips on the CPU of the same matrices, shields driven along."""
    pytest.importorskip("warp")
    fleet = Fleet("six_patch", BODIES[:1], COUNT, device="warp:cpu", budget=32)
    fleet.use_readout(without_noise())
    many = SideBySide(without_noise(), COUNT)
    rng = np.random.default_rng(9)
    for k in range(4):
        reading = fleet.step(poses(rng, COUNT, 1), time=0.05 * k)
        matrix = fleet.baseline + reading.delta.numpy().astype(float)
        truth = many.sample(0.05 * k, matrix, reading.shield_coupling.numpy())
        np.testing.assert_allclose(reading.held.code.numpy(), truth.code, rtol=0, atol=1)
    with pytest.raises(ReadoutError, match="time must not go back"):
        fleet.step(poses(rng, COUNT, 1), time=0.0)


def test_refused_on_warp():
    """Errors name the thing and the fix."""

    class Own:
        def start(self, context):
            return lambda channel, time, value: value

    whole = without_noise()
    with pytest.raises(ReadoutError, match='device "cpu" only'):
        on_warp(Readout(whole.bank, whole.schedule, whole.law, stages=[Own()]))
    with pytest.raises(ReadoutError, match="leaves electrodes open"):
        on_warp(Readout.preset("fdc1004", NAMES, patterns=self_patterns(NAMES, rest="floating")))
    pattern = Pattern("E1", low=("E2",))
    with pytest.raises(ReadoutError, match=r"channel 'E1 to E2' .*its transmitter floats"):
        on_warp(Readout.preset("fdc1004", NAMES, patterns=[pattern]))


def test_chips_are_switched_on_anew():
    """Invariant: a reset draws other noise, or repeats it; the readout given stays as it is."""
    fleet, given = Fleet("six_patch", BODIES[:1], 2), Readout.preset("teensy", NAMES, seed=4)
    where = poses(np.random.default_rng(8), 2, 1)

    def codes(begun=0.0):
        return [fleet.step(where, time=begun + 0.05 * k).held.code.tolist() for k in range(3)]

    fleet.use_readout(given)
    first = codes()
    fleet.reset()
    assert codes() != first
    fleet.reset(seed=4)
    assert codes() == first
    fleet.reset(start=5.0, seed=4)
    assert codes(5.0) == first
    fleet.reset(seed=9)
    assert codes() != first
    fleet.use_readout("teensy", seed=4)
    assert codes() == first
    assert given.seed == 4
    fleet.use_readout(None)
    assert fleet.step(where).held is fleet.readout is None
    fleet.reset()
