"""Chips of environments with clocks and figures of their own."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from fleet_scenes import BODIES, poses

from capsense.errors import ReadoutError
from capsense.fleet import Fleet
from capsense.readout import Readout
from capsense.readout.calibration import LinearSensor, ResponseCurve
from capsense.readout.channels import Pattern, Wiring
from capsense.readout.noise import Flicker, Mains, RandomWalk, White
from capsense.readout.presets import CHIPS
from capsense.readout.randomisation import FIGURES, Distribution, ReadoutRandomisation
from capsense.readout.side_by_side import SideBySide

E, S, NAMES = 4, 2, tuple(f"E{k}" for k in range(1, 7))
SCATTER = ReadoutRandomisation(
    gain=Distribution("normal", 1.0, 0.05), offset=Distribution("uniform", -50e-15, 50e-15),
    noise=Distribution("triangular", 0.5, 2.0, 1.0), delay=Distribution("uniform", 0.0, 0.02),
    jitter=0.004, hysteresis=Distribution("uniform", 0.0, 20e-15), crosstalk=0.01,
    dead=0.1, stuck=0.1,
)  # fmt: skip


def matrices(rng, *shape):
    """Maxwell matrices that single precision holds exactly."""
    out = rng.uniform(1e-12, 3e-12, (*shape, 6, 6)) * (2.0 * np.eye(6) - 1.0)
    return (out + np.swapaxes(out, -1, -2)).astype(np.float32).astype(float)


def plain(chip="fdc1004", patterns=(), **parts):
    whole = Readout.preset(chip, NAMES, noise=False, expected=2e-12, patterns=patterns)
    given = {"dac": whole.dac, "wiring": whole.wiring, **parts}
    return Readout(whole.bank, whole.schedule, whole.law, **given)


def on_warp(readout, *, empty=None, **how):
    """Chips on Warp of E environments with S sensors, sampled with host arrays."""
    wp = pytest.importorskip("warp")
    from capsense.fleet.warp_chips import WarpChips

    empty = np.zeros((6, 6)) if empty is None else empty
    chips = WarpChips(readout, E, S, empty, wp.get_device("cpu"), **how)
    told = chips.sample
    shields = wp.zeros((E, S, 6), dtype=wp.float64, device="cpu")

    def sample(time, matrix):
        delta = wp.array(matrix.astype(np.float32), dtype=wp.float32, device="cpu")
        held = told(time, delta, shields)
        return type(held)(*(column.numpy().copy() for column in vars(held).values()))

    chips.sample = sample
    return chips


DEVICES = [SideBySide, on_warp]


def made(kind, readout, **how):
    return kind(readout, **how) if kind is on_warp else kind(readout, E, S, **how)


@pytest.mark.parametrize("kind", DEVICES)
def test_each_environment_has_a_clock(kind):
    """Differential: with times and restarts of its own, each chip is as one alone."""
    rng, clocks = np.random.default_rng(1), np.array([0.0, 3.0, 70.0, 0.5])
    many = made(kind, plain(), start=clocks)
    alone = [[plain() for _ in range(S)] for _ in range(E)]
    for e, s in np.ndindex(E, S):
        alone[e][s].reset(start=clocks[e])
    for k in range(40):
        if k % 9 == 4:
            again = rng.random(E) < 0.5
            clocks[again] = rng.uniform(0.0, 50.0, again.sum())
            many.reset(again, start=clocks[again])
            for e, s in np.ndindex(E, S):
                if again[e]:
                    alone[e][s].reset(start=clocks[e])
        clocks += rng.uniform(0.0, 0.02, E)
        matrix = matrices(rng, E, S)
        found = many.sample(clocks, matrix)
        for e, s in np.ndindex(E, S):
            chip = alone[e][s]
            truth = chip.sample(clocks[e], chip.bank.values(matrix[e, s])).held()
            np.testing.assert_array_equal(found.code[e, s], truth.code)
            np.testing.assert_allclose(found.capacitance[e, s], truth.capacitance, rtol=1e-12)
            np.testing.assert_allclose(found.age[e, s], truth.age, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", DEVICES)
def test_a_restart_leaves_others_alone(kind):
    """Invariant, to the last bit: others' noise and figures are those without the restart; what is
    drawn depends on seed, environment and number of restarts alone."""
    readout = Readout.preset("fdc1004", NAMES, walk=1e-15, mains=1e-15)
    matrix = matrices(np.random.default_rng(2), E, S)

    def run(*restarts):
        many = made(kind, readout, seed=3, randomisation=SCATTER)
        rows = []
        for k in range(12):
            for at, environments, how in restarts:
                if at == k:
                    many.reset(environments, start=0.02 * k, **how)
            rows.append(many.sample(0.02 * k, matrix).capacitance.copy())
        return np.array(rows), {name: getattr(many.drawn, name) for name in FIGURES}

    base, figures = run()
    found, drawn = run((5, [1, 2], {}), (8, 2, {"seed": 9}))
    others = [0, 3]
    np.testing.assert_array_equal(found[:, others], base[:, others])
    for name in FIGURES:
        np.testing.assert_array_equal(drawn[name][others], figures[name][others])
    for e in (1, 2):
        assert (drawn["gain"][e] != figures["gain"][e]).all()
        assert (found[-1, e] != base[-1, e]).any()
    again, same = run((5, [True, True, True, True], {}))  # as a mask, with others
    np.testing.assert_array_equal(again[:, 1], found[:, 1])
    np.testing.assert_array_equal(same["offset"][1], drawn["offset"][1])
    repeated, first = run((5, None, {"seed": 3}))
    np.testing.assert_array_equal(first["gain"], figures["gain"])
    np.testing.assert_array_equal(repeated[:5], base[:5])


def random_parts(chip, rng):
    """A readout of a chip with parts drawn at random."""
    patterns = ()
    if rng.random() < 0.5:  # some that read or drive several electrodes
        patterns = [
            Pattern("E1", minus="E2"), Pattern(("E3", "E4"), minus=Pattern("E6")), Pattern("E2"),
            Pattern({"E1": 1.0, "E2": -2.0}, {"E6": 0.5}), Pattern("E1", {"E1": 1.0, "E4": -1.0}),
        ]  # fmt: skip
    one = plain(chip, patterns, dac=CHIPS[chip].dac)
    k = len(one.bank)
    pool = [
        White(rng.uniform(0, 2e-15), 1e-4), Flicker(1e-15), RandomWalk(1e-15), Mains(1e-15),
        LinearSensor(rng.uniform(0.9, 1.1, k), rng.uniform(-1e-13, 1e-13, k),
                     np.array(1e-16), 0.3),
        LinearSensor(rng.uniform(0.9, 1.1, (S, k)), np.zeros((E, 1, 1)), np.zeros(k), 0.0),
        ResponseCurve(np.linspace(0, 9e-12, 5), rng.uniform(0, 9e-12, (k, 5))),
    ]  # fmt: skip
    stages = [pool[number] for number in rng.permutation(len(pool))[: rng.integers(1, 5)]]
    wiring = Wiring(trace=rng.uniform(0, 1e-12), crosstalk=0.01 * rng.random())
    one = plain(chip, patterns, dac=CHIPS[chip].dac, wiring=wiring)
    one.stages = tuple(stages)  # after it was made: figures of two sensors do not fit a single one
    return one


def random_scatter(rng, period, k):
    """A randomisation of figures drawn at random; arrays of several shapes."""
    pool = {
        "gain": [1.02, Distribution("normal", 1.0, 0.05), rng.uniform(0.9, 1.1, (S, k))],
        "offset": [Distribution("uniform", -1e-13, 1e-13), rng.uniform(-1e-13, 1e-13, k)],
        "noise": [0.0, 2.0, Distribution("triangular", 0.0, 2.0, 0.5)],
        "delay": [Distribution("uniform", 0.0, 3 * period), rng.uniform(0, period, (E, 1, 1))],
        "jitter": [0.5 * period, Distribution("uniform", 0.0, period)],
        "hysteresis": [1e-13, Distribution("uniform", 0.0, 1e-12)],
        "crosstalk": [0.02, Distribution("normal", 0.0, 0.01)],
        "dead": [0.3, rng.random((E, S, 6)) < 0.2], "stuck": [0.3, rng.random(k) < 0.3],
    }  # fmt: skip
    some = [name for name in pool if rng.random() < 0.6]
    return ReadoutRandomisation(**{n: pool[n][rng.integers(len(pool[n]))] for n in some})


@pytest.mark.parametrize("chip", sorted(CHIPS))
@pytest.mark.parametrize("seed", range(2))
def test_chips_on_warp_are_those_of_the_cpu(chip, seed):
    """Differential: chips, stages, wiring and randomisations at random, with noise and restarts:
    the same figures, and codes to the last one but for rounding at an edge between two."""
    rng = np.random.default_rng([sorted(CHIPS).index(chip), seed])
    readout = random_parts(chip, rng)
    period = readout.schedule.period
    scatter = random_scatter(rng, period, len(readout.bank))
    how = {"seed": int(rng.integers(99)), "randomisation": scatter}
    many, warp = SideBySide(readout, E, S, **how), on_warp(readout, **how)
    clocks, wrong, count = np.zeros(E), 0, 0
    for k in range(40):
        if k % 10 == 7:
            some = rng.permutation(E)[: rng.integers(E)]
            clocks[some] = 0.0
            for chips in (many, warp):
                chips.reset(some)
        clocks += rng.uniform(0.0, 2.5 * period, E)
        matrix = matrices(rng, E, S)
        truth, found = many.sample(clocks, matrix), warp.sample(clocks, matrix)
        span = abs(readout.law.high - readout.law.low)
        off = np.abs(truth.code - found.code)
        assert off.max() <= 1 + 1e-9 * span
        wrong, count = wrong + np.count_nonzero(off), count + off.size
        np.testing.assert_allclose(found.age, truth.age, rtol=0, atol=1e-9)
        fine = off == 0
        np.testing.assert_allclose(
            found.capacitance[fine], truth.capacitance[fine], rtol=1e-9, atol=1e-24
        )
    assert len(np.unique(truth.code)) > 5
    assert wrong <= 1e-3 * count, (wrong, count)
    for name in FIGURES:
        np.testing.assert_array_equal(getattr(many.drawn, name), getattr(warp.drawn, name))


def settled(readout=None, matrix=None, steps=30, **figures):
    """The registers of a fleet that sees the same for a while, and its figures."""
    readout = readout or plain(stages=[White(1e-16)])
    many = SideBySide(readout, E, S, seed=5, randomisation=ReadoutRandomisation(**figures))
    matrix = matrices(np.random.default_rng(3), E, S) if matrix is None else matrix
    held = [many.sample(0.02 * k, matrix) for k in range(steps)]
    return held, many.drawn, matrix


def test_gain_offset_and_crosstalk_are_as_their_formula():
    """Measured: to the noise, gain (c + x Σ others) + offset."""
    held, drawn, matrix = settled(
        gain=Distribution("normal", 1.0, 0.1), offset=Distribution("uniform", -1e-13, 1e-13),
        crosstalk=Distribution("uniform", 0.0, 0.1),
    )  # fmt: skip
    own = np.diagonal(matrix, axis1=2, axis2=3)
    others = own.sum(axis=-1, keepdims=True) - own
    truth = drawn.gain * (own + drawn.crosstalk * others) + drawn.offset
    np.testing.assert_allclose(held[-1].capacitance, truth, rtol=0, atol=2e-15)
    assert np.std(drawn.gain) > 0.05
    assert len(np.unique(drawn.offset)) == drawn.offset.size


def test_noise_is_scaled():
    """Measured: the standard deviation of white noise, over 300 conversions."""
    held, drawn, _ = settled(
        plain(stages=[White(1e-14)]), steps=300, noise=np.array([0.0, 0.5, 1.0, 3.0])[:, None, None]
    )
    deviation = np.std([h.capacitance for h in held[2:]], axis=0)
    np.testing.assert_allclose(deviation / 1e-14, drawn.noise, rtol=0.2, atol=1e-2)


def test_delay_and_jitter_make_results_late():
    """Measured: a step reaches the registers a delay later; ages scatter by the jitter."""
    delay = np.array([0.0, 0.013, 0.02, 0.05])
    readout = plain()
    period, lag = readout.schedule.period, readout.schedule.lag
    many = SideBySide(readout, E, S, randomisation=ReadoutRandomisation(delay=delay[:, None, None]))
    low, seen = np.broadcast_to(1e-12 * np.eye(6), (E, S, 6, 6)), np.full((E, S, 6), np.inf)
    times = 0.001 * np.arange(300)
    for time in times:
        held = many.sample(time, low if time < 0.1 else 2 * low)
        seen = np.where(held.capacitance > 1.9e-12, np.minimum(seen, time), seen)
    wait = seen - 0.1 - delay[:, None, None]
    assert (wait >= lag - 2e-3).all()
    assert (wait <= lag + period + 2e-3).all()
    held, drawn, _ = settled(plain(), steps=200, jitter=0.5 * period)
    assert (drawn.jitter == 0.5 * period).all()
    ages = np.array([h.age for h in held[5:]])
    assert np.std(ages, axis=0).min() > 0.5 * period / 12**0.5 * 0.7
    assert ages.min() >= 0.0
    assert ages.max() < 1.5 * period + 1e-9


def test_dead_and_stuck():
    """Measured: a dead electrode is neither read nor driven; a stuck channel keeps its first code.
    Shares of them are as asked for."""
    dead = np.zeros((E, S, 6), bool)
    dead[1, 0, 2] = True
    patterns = [Pattern("E3"), Pattern(("E2", "E3")), Pattern("E1", minus="E3"),
                Pattern("E3", {"E1": 1.0}), Pattern("E4", {"E3": 1.0})]  # fmt: skip
    held, _, matrix = settled(plain(patterns=patterns), dead=dead)
    c, found = matrix[1, 0], held[-1].capacitance
    truth = np.array([0.0, c[1, 1], c[0, 0], 0.0, 0.0])
    np.testing.assert_allclose(found[1, 0], truth, rtol=0, atol=1e-17)
    assert (np.abs(found[1, 1]) > 1e-13).all()
    stuck = np.zeros((E, S, 6), bool)
    stuck[2, 1, 4] = True
    held, drawn, _ = settled(plain(stages=[White(1e-14)]), stuck=stuck)
    moved = np.array([h.code for h in held[3:]]).std(axis=0) > 0
    np.testing.assert_array_equal(moved, ~drawn.stuck)
    many = SideBySide(plain(), 500, 2, randomisation=ReadoutRandomisation(dead=0.2, stuck=0.05))
    shares = many.drawn.dead.mean(), many.drawn.stuck.mean()
    np.testing.assert_allclose(shares, [0.2, 0.05], atol=0.02)


def test_hysteresis_is_a_loop():
    """Measured: rising and falling branches lie the width apart; a play operator has no memory of
    smaller loops."""
    width = 0.4e-12
    many = SideBySide(plain(), E, S, randomisation=ReadoutRandomisation(hysteresis=width))
    ramp = 3e-12 + 1e-12 * np.concatenate([np.arange(50), np.arange(50, -1, -1)]) / 50
    found = []
    for k, value in enumerate(ramp):
        for part in range(2):
            matrix = np.broadcast_to(value * np.eye(6), (E, S, 6, 6))
            held = many.sample(0.1 * (k + 0.5 * part), matrix)
        found.append(held.capacitance[0, 0, 0])
    up, down = found[25], found[75]
    np.testing.assert_allclose([up, down], [ramp[25] - width / 2, ramp[75] + width / 2], rtol=1e-3)


class Drifting:
    """A stage of a user's own, which counts its samples."""

    def start(self, context):
        count = np.zeros(context.channels)
        level = context.rng.normal()

        def process(channel, time, value):
            assert (np.diff(time) >= 0).all()
            np.add.at(count, channel, 1)
            return value + 1e-15 * count[channel] + 1e-13 * level

        return process


def test_a_users_stage_works_chip_by_chip():
    """Invariant: its memory is that of one chip, restarts are those of one environment."""
    many = SideBySide(plain(stages=[Drifting()]), E, S, seed=1)
    matrix = np.broadcast_to(2e-12 * np.eye(6), (E, S, 6, 6))
    first = [many.sample(0.02 * k, matrix).capacitance for k in range(10)]
    assert len(np.unique(first[-1][..., 0])) == E * S
    many.reset([1], start=0.2)
    second = [many.sample(0.2 + 0.02 * k, matrix).capacitance for k in range(10)]
    assert (second[-1][[0, 2, 3]] > first[-1][[0, 2, 3]]).all()
    level = second[-1][1] - first[-1][1]
    np.testing.assert_allclose(level, level[:, :1] + np.zeros((1, 6)), atol=1.1e-15)
    np.testing.assert_allclose(second[-1][1] - second[2][1], first[-1][1] - first[2][1], atol=1e-17)


def test_curves_and_calibrations_of_every_channel():
    """Measured: points of a curve are met, ends go on straight; a single readout has the same."""
    k, rng = 6, np.random.default_rng(6)
    true = np.cumsum(rng.uniform(0.5e-12, 1e-12, (k, 4)), axis=1)
    curve = ResponseCurve(true, true**2 * 1e11 + true)
    fit = LinearSensor(rng.uniform(0.9, 1.1, k), rng.uniform(-1e-13, 1e-13, k), np.zeros(k), 0.0)
    readout = plain(stages=[curve, fit])
    for number in range(4):
        matrix = np.broadcast_to(np.diag(true[:, number]), (E, S, 6, 6))
        held, _, _ = settled(readout, matrix)
        measured = curve.measured[:, number] * fit.gain + fit.offset
        np.testing.assert_allclose(held[-1].capacitance, measured + np.zeros((E, S, 1)), rtol=1e-5)
        readout.reset()
        readout.sample(0.0, true[:, number])
        alone = readout.sample(0.9, true[:, number]).held()
        np.testing.assert_array_equal(held[-1].code[0, 0], alone.code)
    beyond = true[:, 3] + 1e-13
    slope = np.diff(curve.measured[:, 2:])[:, 0] / np.diff(true[:, 2:])[:, 0]
    held, _, _ = settled(plain(stages=[curve]), np.broadcast_to(np.diag(beyond), (E, S, 6, 6)))
    truth = curve.measured[:, 3] + 1e-13 * slope
    np.testing.assert_allclose(held[-1].capacitance[0, 0], truth, rtol=1e-5)


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_a_fleet_restarts_environments(device):
    """Invariant: others go on to the last bit; a copy and a pickle go on alike; figures drawn can
    be given back."""
    if device != "cpu":
        pytest.importorskip("warp")
    where = poses(np.random.default_rng(8), 3, 1)

    def begin():
        fleet = Fleet("six_patch", BODIES[:1], 3, device=device, budget=32)
        fleet.use_readout("fdc1004", seed=4, randomisation=SCATTER)
        return fleet

    def codes(fleet, time):
        held = fleet.step(where, time=time).held
        return held.code.numpy().copy() if device != "cpu" else held.code.copy()

    fleets = begin(), begin()
    for fleet in fleets:
        for k in range(3):
            codes(fleet, 0.05 * k)
    one, other = fleets
    one.reset([1])
    later = np.array([0.15, 0.0, 0.15])
    gone = []
    for k in range(4):
        found, truth = codes(one, later + 0.05 * k), codes(other, 0.15 + 0.05 * k)
        np.testing.assert_array_equal(found[[0, 2]], truth[[0, 2]])
        gone.append(found)
    assert (gone[0][1] == 0).all()  # just switched on
    again = begin()
    again.use_readout("fdc1004", seed=4, randomisation=other.drawn)
    for name in FIGURES:
        np.testing.assert_array_equal(getattr(again.drawn, name), getattr(other.drawn, name))
    if device == "cpu":
        for twin in (copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
            twin.reset([0], start=0.4)
            one_twin = copy.deepcopy(one)
            one_twin.reset([0], start=0.4)
            for k in range(3):
                time = np.array([0.4, 0.3, 0.5]) + 0.05 * k
                np.testing.assert_array_equal(codes(twin, time), codes(one_twin, time))
    one.use_readout(None)
    assert one.drawn is None
    one.reset([0])


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_each_sensor_has_a_readout_of_its_own(device, tmp_path):
    """Differential: sensors with chips of their own read as fleets of one such sensor."""
    if device != "cpu":
        pytest.importorskip("warp")
    rng = np.random.default_rng(10)
    file = tmp_path / "left.toml"
    fit = LinearSensor(rng.uniform(0.9, 1.1, 6), rng.uniform(0, 1e-13, 6), np.zeros(6), 0.0)
    file.write_text('chip = "fdc1004"\nrandom = false\n' + fit.toml(), encoding="utf-8")
    given = [file, plain("ad7747", seed=3)]
    gains = rng.uniform(0.9, 1.1, (2, 6))
    frames = poses(rng, 3, 2, low=(-0.02, -0.02, 0.0), high=(0.02, 0.02, 0.01))
    frames[..., 3:] = [0.0, 0.0, 0.0, 1.0]
    both = Fleet("six_patch", BODIES[:1], 3, sensors=2, device=device, budget=32)
    both.use_readout(given, randomisation=ReadoutRandomisation(gain=gains, delay=0.001))
    assert [r.schedule.period for r in both.readouts] == [0.04, plain("ad7747").schedule.period]
    ones = [Fleet("six_patch", BODIES[:1], 3, device=device, budget=32) for _ in given]
    for one, readout, gain in zip(ones, given, gains, strict=True):
        one.use_readout(readout, randomisation=ReadoutRandomisation(gain=gain, delay=0.001))
    for k in range(8):
        where, time = poses(rng, 3, 1), 0.03 * k + np.array([0.0, 0.1, 0.2])
        if k == 4:
            for fleet in (both, *ones):
                fleet.reset([1], start=0.2)
        held = both.step(where, frames, time=time).held
        for number, one in enumerate(ones):
            truth = one.step(where, frames[:, [number]], time=time).held
            for column in ("code", "capacitance", "age"):
                each = [getattr(h, column) for h in (held, truth)]
                each = each if device == "cpu" else [x.numpy() for x in each]
                np.testing.assert_array_equal(each[0][:, [number]], each[1])
    np.testing.assert_array_equal(both.drawn.gain, np.broadcast_to(gains, (3, 2, 6)))
    for wrong, words in (
        (["fdc1004"] * 3, "there are 3 readouts and 2 sensors"),
        (["fdc1004", "sdr"], "readouts have 6 and 15 channels"),
        (["fdc1004", 3], "readout is 3; give a chip's name, a file, or a Readout"),
        ([], "there are 0 readouts"),
    ):
        with pytest.raises(ReadoutError, match=words):
            both.use_readout(wrong)


def test_starts_go_with_their_environments():
    """Differential: numbers in any order, each with its start, as one reset for each of them."""
    rng = np.random.default_rng(12)
    fleets = [Fleet("six_patch", BODIES[:1], 5) for _ in range(2)]
    where = poses(rng, 5, 1)
    for fleet in fleets:
        fleet.use_readout("fdc1004", seed=4)
        fleet.step(where, time=0.05)
    fleets[0].reset([4, 1, 4, 2], start=[0.4, 0.1, 0.4, 0.2], seed=8)
    for number in (1, 2, 4):
        fleets[1].reset(number, start=0.1 * number, seed=8)
    held = [fleet.step(where, time=0.6).held for fleet in fleets]
    for column in ("code", "age"):
        np.testing.assert_array_equal(getattr(held[0], column), getattr(held[1], column))
    assert len(np.unique(held[0].age[1:, 0, 0].round(6))) > 1


def test_times_and_environments_on_the_device():
    """Differential: arrays of Warp beside those of the host, in single and double precision."""
    wp = pytest.importorskip("warp")
    where = poses(np.random.default_rng(9), 3, 1)
    fleets = [Fleet("six_patch", BODIES[:1], 3, device="warp:cpu", budget=32) for _ in range(3)]
    for fleet in fleets:
        fleet.use_readout("teensy", seed=2)
    for k in range(6):
        time = 0.125 * k + np.array([0.0, 0.25, 0.5])
        if k == 3:
            time[1] = 0.0
            fleets[0].reset([1])
            for fleet in fleets[1:]:
                fleet.reset(wp.array([1], dtype=wp.int32, device="cpu"))
        host = fleets[0].step(where, time=time).held.code.numpy()
        for fleet, dtype in zip(fleets[1:], (wp.float32, wp.float64), strict=True):
            held = fleet.step(where, time=wp.array(time, dtype=dtype, device="cpu")).held
            np.testing.assert_array_equal(held.code.numpy(), host)
    with pytest.raises(ReadoutError, match=r"float32, of \(1,\) or \(3,\)"):
        fleets[0].step(where, time=wp.zeros(2, dtype=wp.float64, device="cpu"))


REFUSED = [
    ({"gain": "much"}, "no real numbers"),
    ({"gain": np.ones((2, 3))}, r"gain is of shape \(2, 3\).*broadcast to \(4, 2, 6\)"),
    ({"delay": -1.0}, "delay holds -1; give numbers at least 0 s"),
    ({"dead": 1.5}, "dead holds 1.5; give numbers from 0 to 1"),
    ({"stuck": Distribution("uniform", 0.0, 1.0)}, "stuck is .*give a probability, or booleans"),
    ({"gain": np.ones(6, bool)}, "gain is of booleans"),
    ({"gain": Distribution("uniform", 1.0, 0.5)}, r"gain is .*\('uniform', low, high\)"),
    ({"gain": Distribution("even", 1.0, 2.0)}, r"gain is .*\('uniform', low, high\)"),
    ({"jitter": 1.0}, "jitter is up to 1 s, more than the period of .* give less"),
]


@pytest.mark.parametrize(("figures", "words"), REFUSED)
def test_refused_figures(figures, words):
    """Errors name the figure and the fix."""
    with pytest.raises(ReadoutError, match=words):
        SideBySide(plain(), E, S, randomisation=ReadoutRandomisation(**figures))


def test_refused():
    """Errors name the thing and the fix; a refused time changes nothing."""
    many = SideBySide(Readout.preset("fdc1004", NAMES), E, S, seed=1)
    twin = copy.deepcopy(many)
    matrix = matrices(np.random.default_rng(4), E, S)
    many.sample(0.1, matrix)
    for time, words in (
        ([0.2, 0.2, 0.05, 0.2], r"environment 2: sample at 0.05 s, after one at 0.1 s"),
        ([0.2, np.nan, 0.2, 0.2], "environment 1: sample at nan s; give a finite time"),
        ([0.2, 0.2], "one for each of 4 environments"),
        ("soon", "one for each of 4 environments"),
        (1e9, "take smaller steps"),
    ):
        with pytest.raises(ReadoutError, match=words):
            many.sample(time, matrix)
    for environments in (4, [-1], [True, False], 0.5, ["a"]):
        with pytest.raises(ReadoutError, match="give numbers from 0 to 3, or a mask of 4"):
            many.reset(environments)
    for how, words in (
        ({"start": [1.0, 2.0]}, "one for each of 1 environments"),
        ({"start": np.inf}, "start: a number is not finite"),
        ({"seed": -1}, "seed is -1"),
    ):
        with pytest.raises(ReadoutError, match=words):
            many.reset([2], **how)
    many.reset([])
    twin.sample(0.1, matrix)
    np.testing.assert_array_equal(many.sample(0.2, matrix).code, twin.sample(0.2, matrix).code)
    with pytest.raises(ReadoutError, match="give a ReadoutRandomisation"):
        SideBySide(plain(), E, randomisation={"gain": 1.0})
    with pytest.raises(ReadoutError, match="curve: true values do not rise"):
        ResponseCurve(np.array([1.0, 1.0]), np.array([1.0, 2.0]))
    with pytest.raises(ReadoutError, match="at least two points"):
        ResponseCurve(np.array([1.0]), np.array([1.0]))
    with pytest.raises(ReadoutError, match="give a number, or a list of 6, one per channel"):
        plain(stages=[LinearSensor(np.ones(5), np.zeros(5), np.zeros(5), 0.0)])
