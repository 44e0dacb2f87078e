"""Calibration: recovery of known figures, and uncertainties that mean what they say."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from approximate import approx
from scipy import stats

from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.calibration import (
    CalibrationWarning,
    LinearSensor,
    base_capacitance,
    calibrate,
    cross_correlation,
    flicker_covariance,
    least_squares,
    relative_to,
    tare,
    unit_range,
)
from capsense.readout.channels import ChannelBank, self_patterns
from capsense.readout.conversions import Schedule
from capsense.readout.laws import LinearLaw
from capsense.readout.noise import Flicker, White

GAIN, OFFSET, DRIFT = (
    np.array([1.02, 0.95]),
    np.array([3e-13, -2e-14]),
    np.array([1e-16, -4e-16]),
)


def recording(rng, count=200, rms=0.0):
    """True and measured capacitances of two channels, and times: mean time 50 s."""
    time = np.linspace(0, 100, count)
    true = (2 + rng.uniform(0, 1, (count, 2))) * 1e-12
    drifted = GAIN * true + OFFSET + DRIFT * (time[:, None] - 50)
    return true, drifted + rms * rng.standard_normal((count, 2)), time


def test_figures_are_found():
    """Analytic: without noise, gain, offset and drift come out, with no uncertainty to speak of."""
    true, measured, time = recording(np.random.default_rng(0))
    fit = calibrate(true, measured, time)
    assert fit.gain == approx(GAIN, rel=1e-9)
    assert fit.offset == approx(OFFSET, rel=1e-6)
    assert fit.drift == approx(DRIFT, rel=1e-6)
    assert (fit.residual < 1e-24).all()
    assert np.abs(fit.correct(measured, time) - true).max() < 1e-23
    assert np.abs(fit.distort(true, time) - measured).max() < 1e-23


def test_channels_with_instants_of_their_own():
    """Analytic: as of a sensor that reads one channel after another."""
    true, _, time = recording(np.random.default_rng(0))
    instants = time[:, None] + [0.0, 0.2]
    measured = GAIN * true + OFFSET + DRIFT * (instants - 50)
    fit = calibrate(true, measured, instants, floor=1e-18)
    assert fit.epoch == approx(50.1, rel=1e-12)
    assert fit.offset == approx(OFFSET + 0.1 * DRIFT, rel=1e-6)
    assert fit.drift == approx(DRIFT, rel=1e-6)
    assert np.abs(fit.correct(measured, instants) - true).max() < 1e-23
    assert np.abs(fit.distort(true, instants) - measured).max() < 1e-23


def test_one_known_pose_tells_the_offset():
    """Round trip: a tare at a pose; the sensor then measures what the simulator says there."""
    rng = np.random.default_rng(0)
    pose = np.array([2.0e-12, 2.5e-12])
    readings = pose + OFFSET + 1e-15 * rng.standard_normal((400, 2))
    base = base_capacitance(readings)
    assert np.abs(tare(readings, base).mean(axis=0)).max() < 1e-26
    fit = LinearSensor(1.0, base - pose, 0.0, 0.0)
    assert np.abs(fit.correct(readings).mean(axis=0) - pose).max() < 1e-26
    assert np.abs(fit.offset - OFFSET).max() < 5 * 1e-15 / np.sqrt(400)


def test_small_changes_on_a_large_base():
    """Analytic: a change of a hundred-thousandth of C still tells the gain, to rounding."""
    time = np.linspace(0, 100, 200)
    true = 5e-12 * (1 + 1e-5 * np.random.default_rng(0).uniform(0, 1, (200, 1)))
    fit = calibrate(true, 1.02 * true + 3e-13, time)
    assert fit.gain == approx([1.02], rel=1e-9)
    assert fit.drift == approx([0.0], abs=1e-27)


def saturated(top, random=0.0, seed=0):
    """True and measured capacitances, instants and flags of an approach, by a chip with a limit."""
    time = np.arange(0, 60, 0.05)
    true = (2 + 2 * np.exp(-(((time - 30) / 8) ** 2)))[:, None] * [1e-12, 0.9e-12]
    readout = Readout(
        ChannelBank(self_patterns("AB", shield=0.0), tuple("AB")), Schedule.simultaneous(2, 0.1),
        LinearLaw(1e-18, 0, round(top / 1e-18)), seed=seed,
        stages=(LinearSensor(1.03, 2e-13, 0.0, 0.0), White(1e-15)),
    )  # fmt: skip
    counts = readout(time, true)
    stamps, measured = counts.table()
    instants, flags = stamps - readout.schedule.lag, counts.table("flags")[1]
    rng = np.random.default_rng(seed)
    lost = rng.random(measured.shape) < random
    measured, flags = np.where(lost, top, measured), np.where(lost, 1, flags)
    world = np.stack(
        [np.interp(t, time, c) for t, c in zip(instants.T, true.T, strict=True)], axis=1
    )
    return world, measured, instants, flags


@pytest.mark.parametrize(("top", "random"), [(3.2e-12, 0.0), (1e-11, 0.2)])
def test_samples_out_of_range_are_left_out(top, random):
    """Round trip: with a fifth of the conversions at the limit, in a row or here and there."""
    world, measured, instants, flags = saturated(top, random)
    assert 0.1 < (flags != 0).mean() < 0.4
    fit = calibrate(world, measured, instants, flags=flags)
    assert np.abs(fit.gain - 1.03).max() < 4 * fit.uncertainty[:, 0].max() < 0.005
    assert not fit.doubtful.any()
    assert (fit.samples == (flags == 0).sum(axis=0)).all()
    assert (np.isnan(fit.residuals) == (flags != 0)).all()
    assert np.nanstd(fit.residuals, axis=0) == approx([1e-15, 1e-15], rel=0.2)
    with pytest.warns(CalibrationWarning, match="channel 1: many samples share its largest"):
        blind = calibrate(world, measured, instants)
    assert blind.doubtful.all()
    assert np.abs(blind.gain - 1.03).min() > 0.01


def test_a_sensor_that_is_not_linear_is_doubted():
    """Half a per cent of curvature shows; noise of any size, and flicker with its floor, do not."""
    true, _, time = recording(np.random.default_rng(0), 400)
    noise = 1e-15 * np.random.default_rng(1).standard_normal(true.shape)
    with pytest.warns(CalibrationWarning, match="channel 0"):
        assert calibrate(true, true + 5e10 * true**2 + noise, time).doubtful.all()
    mild = calibrate(true, true + 2e10 * true**2 + noise, time)  # in doubt from an excess of 2.8
    assert mild.excess.min() > 1.6
    assert not mild.doubtful.any()
    for size in (0.0, 1.0, 1000.0):
        fit = calibrate(true, 1.02 * true + size * noise, time)
        assert not fit.doubtful.any()
        if size:
            assert fit.excess == approx([1.0, 1.0], abs=0.15)


def test_without_drift():
    true, measured, _ = recording(np.random.default_rng(0))
    fit = calibrate(true, GAIN * true + OFFSET, drift=False)
    assert fit.gain == approx(GAIN, rel=1e-9)
    assert (fit.drift == 0).all()
    assert (fit.uncertainty[:, 2] == 0).all()
    assert np.abs(fit.correct(fit.distort(true)) - true).max() < 1e-23
    assert measured.shape == true.shape


def test_intervals_cover_as_often_as_they_state():
    """Statistical: 95 % intervals of all three figures cover the truth in 95 % of recordings."""
    rng = np.random.default_rng(1)
    trials, count = 1500, 12
    quantile = stats.t.ppf(0.975, count - 3)
    hits = np.zeros((2, 3))
    for _ in range(trials):
        fit = calibrate(*recording(rng, count, 2e-15))
        found = np.stack([fit.gain, fit.offset, fit.drift], axis=1)
        truth = np.stack([GAIN, OFFSET, DRIFT], axis=1)
        hits += np.abs(found - truth) <= quantile * fit.uncertainty
    spread = np.sqrt(0.95 * 0.05 / trials)
    assert np.abs(hits / trials - 0.95).max() < 4 * spread


def test_intervals_cover_with_flicker():
    """Statistical: with the floor given, 95 % intervals cover the truth though noise is not white.

    Without it they cover a third of the drifts only.
    """
    names, time = tuple("ABCDEFGHIJ"), np.arange(0.0, 10.01, 0.02)
    bank, plan = self_patterns(names, shield=0.0), Schedule.simultaneous(10, 0.02)
    true = 2e-12 + 2e-13 * np.sin(0.7 * time[:, None] + np.arange(10))
    truth = np.array([1.02, 3e-13, 0.0])
    hits = {5e-16: np.zeros(3), 0.0: np.zeros(3)}
    trials = 25
    for seed in range(trials):
        noise = (Flicker(5e-16), White(1e-15))
        readout = Readout(
            ChannelBank(bank, names),
            plan,
            LinearLaw(1e-21, -(10**12), 10**12),
            stages=noise,
            seed=seed,
        )
        stamps, rows = readout(time, truth[0] * true + truth[1]).table()
        instants = stamps[:, 0] - 0.01
        world = np.stack([np.interp(instants, time, c) for c in true.T], axis=1)
        for floor, count in hits.items():
            fit = calibrate(world, rows, instants, floor=floor)
            found = np.stack([fit.gain, fit.offset, fit.drift], axis=1)
            count += (np.abs(found - truth) <= 1.96 * fit.uncertainty).sum(axis=0)
    cases = trials * len(names)
    assert np.abs(hits[5e-16] / cases - 0.95).max() < 4 * np.sqrt(0.95 * 0.05 / cases)
    assert hits[0.0][2] / cases < 0.5


def test_flicker_covariance_is_its_definition():
    """Differential: uneven times, against the matrix written out."""
    rng = np.random.default_rng(0)
    time, columns = np.cumsum(rng.uniform(0.01, 1.0, 40)), rng.standard_normal((40, 3))
    taus, variance = Flicker(1e-15).poles(float(np.median(np.diff(time))))
    lag = np.abs(time[:, None] - time)
    matrix = variance * sum(np.exp(-lag / tau) for tau in taus)
    found, trace = flicker_covariance(columns, time, 1e-15)
    assert found == approx(matrix @ columns, rel=1e-9, abs=1e-42)
    assert trace == approx(np.trace(matrix), rel=1e-12)


def test_residual_is_the_noise():
    fit = calibrate(*recording(np.random.default_rng(2), 5000, 2e-15))
    assert fit.residual == approx(np.full(2, 2e-15), rel=0.05)
    assert fit.samples.tolist() == [5000, 5000]


def test_a_calibrated_model_measures_like_the_sensor():
    """Round trip: as a stage it distorts; calibrating the readout's counts finds it again."""
    true, measured, time = recording(np.random.default_rng(3))
    sensor = calibrate(true, measured, time)
    readout = Readout(
        ChannelBank(self_patterns("AB", shield=0.0), tuple("AB")), Schedule.simultaneous(2, 0.1),
        LinearLaw(1e-21, -(10**12), 10**12), stages=(sensor, White(1e-16)),
    )  # fmt: skip
    counts = readout(time, true)
    stamps, rows = counts.table()
    instants = stamps[:, 0] - 0.05
    world = np.stack([np.interp(instants, time, c) for c in true.T], axis=1)
    again = calibrate(world, rows, instants)
    assert np.abs(again.gain - GAIN).max() < 5 * again.uncertainty[:, 0].max()
    drift_between = DRIFT * (again.epoch - sensor.epoch)
    assert again.offset == approx(OFFSET + drift_between, abs=5e-17)
    assert again.drift == approx(DRIFT, rel=0.05)
    with pytest.raises(ReadoutError, match="list of 3, one per channel"):
        Readout(
            ChannelBank(self_patterns("ABC"), tuple("ABC")), Schedule.simultaneous(3, 0.1),
            LinearLaw(1e-15, 0, 9), stages=(sensor,),
        )  # fmt: skip


def test_normalisations():
    """Analytic: base, tare, relative and unit range."""
    empty = np.array([[1e-12, 2e-12], [3e-12, 2e-12]])
    base = base_capacitance(empty)
    assert base == approx([2e-12, 2e-12], rel=1e-12)
    values = np.array([[2e-12, 1e-12], [4e-12, 3e-12]])
    assert tare(values, base) == approx(np.array([[0, -1e-12], [2e-12, 1e-12]]), abs=1e-24)
    assert relative_to(values, base) == approx(np.array([[1, 0.5], [2, 1.5]]), rel=1e-12)
    assert unit_range(values).tolist() == [[0, 0], [1, 1]]


def test_cross_correlation():
    """Differential: Pearson's coefficient; insensitive to gain and offset."""
    rng = np.random.default_rng(4)
    a, b = rng.standard_normal((2, 300))
    assert cross_correlation(a, b) == approx(np.corrcoef(a, b)[0, 1], rel=1e-9)
    assert cross_correlation(a, 3e-15 * a + 1e-12) == approx(1.0, rel=1e-6)
    assert cross_correlation(a, -a) == approx(-1.0, rel=1e-12)


@pytest.mark.parametrize("drift", [False, True])
def test_one_sample_more_than_unknowns_is_enough(drift):
    """Limits: a sample fewer is refused (see below)."""
    count = 4 if drift else 3
    true, time = np.array([[1.0], [3.0], [2.0], [5.0]])[:count], np.arange(count)
    fit = calibrate(true, 2.0 * true + 0.5, time, drift=drift)
    assert fit.gain == approx(2.0, rel=1e-9)
    assert fit.samples == count


ONES = np.ones((10, 1))
RISING = np.linspace(1, 2, 10)[:, None]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: calibrate(ONES, np.ones((9, 1)), np.arange(10)), r"shape \(10, 1\), measured"),
        (lambda: calibrate(RISING * np.nan, RISING, np.arange(10)), "not finite"),
        (lambda: calibrate(RISING, RISING, np.arange(10), flags=[0]), r"flags have shape \(1,\)"),
        (lambda: calibrate(RISING, RISING, drift=False, flags=RISING > 1.15), "2 samples for 2"),
        (lambda: calibrate(RISING, RISING, drift=False, flags=RISING > 1.0), "1 samples for 2"),
        (lambda: calibrate(RISING, RISING, drift=False, flags=RISING > 0.0), "0 samples for 2"),
        (lambda: calibrate(RISING[:2], RISING[:2], np.arange(2)), "2 samples for 3 unknowns"),
        (lambda: calibrate(RISING, RISING), "drift and floor need the times"),
        (lambda: calibrate(RISING, RISING, np.arange(10), floor=-1.0), "floor is -1.0"),
        (lambda: calibrate(RISING, RISING**2, np.zeros(10), drift=False, floor=1.0), "must rise"),
        (lambda: calibrate(RISING, RISING, np.arange(9)), "time has shape"),
        (lambda: calibrate(RISING[:3], RISING[:3], np.arange(3)), "3 samples for 3 unknowns"),
        (lambda: calibrate(ONES, ONES, drift=False), "channel 0: the recording does not tell"),
        (lambda: calibrate(RISING, RISING, np.arange(10)), "not along with time only"),
        (lambda: calibrate(ONES[:, :0], ONES[:, :0], np.arange(10)), r"give both as \(n, K\)"),
        (lambda: calibrate(RISING, RISING, np.ones((10, 2))), r"time has shape \(10, 2\)"),
        (lambda: LinearSensor(1.0, 0.0, 0.0, 0.0).correct([[1.0]], [np.nan]), "time: a number is"),
        (lambda: LinearSensor([1.0, 0.0], 0.0, 0.0, 0.0), "a gain is 0"),
        (lambda: LinearSensor(1.0, np.nan, 0.0, 0.0), "offset: a number is not finite"),
        (lambda: base_capacitance([]), "at least one"),
        (lambda: base_capacitance([np.nan]), "readings: a number is not finite"),
        (lambda: tare(np.ones((3, 2)), np.ones(3)), "one base a channel"),
        (lambda: relative_to([1.0], [np.nan]), "base: a number is not finite"),
        (lambda: unit_range([]), "no readings"),
        (lambda: unit_range([1.0, np.nan]), "readings: a number is not finite"),
        (lambda: cross_correlation([1.0, np.nan], [1.0, 2.0]), "signal: a number is not finite"),
        (lambda: relative_to([1.0], [0.0]), "a base is 0"),
        (lambda: unit_range([[1.0], [1.0]]), "constant"),
        (lambda: cross_correlation([1.0, 1.0], [1.0, 2.0]), "constant"),
        (lambda: cross_correlation([1.0], [1.0, 2.0]), "make them the same"),
    ],
)
def test_bad_recordings_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()


def test_base_of_one_channel_or_many():
    assert base_capacitance([1.0, 2.0, 6.0]) == approx(3.0)
    assert base_capacitance([[1.0, 4.0], [3.0, 8.0]]) == approx([2.0, 6.0])
    for nothing in (1.0, []):
        with pytest.raises(ReadoutError, match="needs readings"):
            base_capacitance(nothing)


def test_a_floor_needs_times_and_recordings_two_axes():
    values = np.arange(12.0).reshape(6, 2) * 1e-15
    with pytest.raises(ReadoutError, match="floor need the times"):
        calibrate(values, values, floor=1e-16, drift=False)
    with pytest.raises(ReadoutError, match=r"give both as \(n, K\)"):
        calibrate(values[:, :, None], values[:, :, None])


def test_white_noise_is_what_flicker_leaves_of_the_residuals():
    """By definition: (|r|² − tr Σ + tr QᵀΣQ) / (n − p), and P (white + Σ) Pᵀ of the figures."""
    rng = np.random.default_rng(4)
    time = np.arange(40) * 0.1
    design = np.column_stack([rng.uniform(1.0, 2.0, 40), np.ones(40)])
    seen = design @ [1.1, 0.3] + rng.normal(0.0, 0.1, 40)
    figures, covariance, explained = least_squares(design, seen, 0, time, 0.02)
    q = np.linalg.qr(design)[0]
    covered, total = flicker_covariance(q, time, 0.02)
    left = total - np.trace(q.T @ covered)
    assert explained == approx(left)
    squares = ((seen - design @ figures) ** 2).sum()
    white = (squares - left) / 38
    inverse = np.linalg.pinv(design) @ q
    wanted = inverse @ (white * np.eye(2) + q.T @ covered) @ inverse.T
    assert 0.1 * squares < left < 0.9 * squares
    assert covariance == approx(wanted)


def test_a_few_samples_far_off_are_doubted():
    """Most residuals are normal noise of 1 fF by their median deviation, some are 20 fF off."""
    true, _, time = recording(np.random.default_rng(0), 400)
    noise = np.random.default_rng(1).standard_normal(true.shape)
    noise[::20] += 20.0
    with pytest.warns(CalibrationWarning, match="channel 0"):
        fit = calibrate(true, true + 1e-15 * noise, time)
    left = fit.residuals
    scale = 1.4826 * np.median(np.abs(left - np.median(left, axis=0)), axis=0)
    assert fit.excess == approx(np.sqrt((left**2).mean(axis=0)) / scale)


def test_samples_out_of_order_are_doubted():
    """Statistical: shuffled, nothing follows the truth; weak but followed for long, it is not."""
    true, seen, time = recording(np.random.default_rng(5), 400, 1e-16)
    doubted = 0
    for seed in range(50):
        order = np.random.default_rng(seed).permutation(len(true))
        with pytest.warns(CalibrationWarning, match="what it measured does not follow the true"):
            doubted += calibrate(true, seen[order], time).doubtful.sum()
    assert doubted >= 98
    weak = seen + 5e-13 * np.random.default_rng(6).standard_normal(seen.shape)
    fit = calibrate(true, weak, time)
    assert not fit.doubtful.any()
    assert (np.abs(fit.gain - GAIN) < 4 * fit.uncertainty[:, 0]).all()


def test_samples_that_are_left_out_may_be_anything():
    """Invariant: NaN where flags are set changes nothing; elsewhere it is refused."""
    true, seen, time = recording(np.random.default_rng(7), 60, 1e-16)
    flags = np.zeros(seen.shape, int)
    flags[[3, 8], [0, 1]] = 1
    plain = calibrate(true, seen, time, flags=flags)
    true[3, 0], seen[3, 0], seen[8, 1] = np.nan, np.inf, np.nan
    found = calibrate(true, seen, time, flags=flags)
    np.testing.assert_array_equal(found.gain, plain.gain)
    np.testing.assert_array_equal(found.covariance, plain.covariance)
    seen[9, 1] = np.nan
    with pytest.raises(ReadoutError, match="measured: a number is not finite"):
        calibrate(true, seen, time, flags=flags)


@pytest.mark.parametrize("noise", [1e-16, 5e-14])
@pytest.mark.parametrize("count", [40, 200])
@pytest.mark.parametrize("order", ["smooth", "random"])
def test_a_sensor_that_stops_at_the_end_of_its_range(order, count, noise):
    """Statistical: that a fifth of the samples is cut is seen in 95 of 100 recordings."""
    missed = 0
    for seed in range(100):
        rng, time = np.random.default_rng(seed), 0.1 * np.arange(count)
        way = np.sin(6 * time / time[-1]) if order == "smooth" else rng.uniform(-1, 1, count)
        true = (2e-12 + 1.5e-12 * way)[:, None]
        seen = 1.03 * true + noise * rng.normal(size=true.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)
            fit = calibrate(true, np.minimum(seen, 1.03 * np.quantile(true, 0.8)), time)
        missed += not fit.doubtful[0] and abs(fit.gain[0] - 1.03) > 4 * fit.uncertainty[0, 0]
    assert missed <= 5


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 1.0, 3.0, 100.0])
@pytest.mark.parametrize("way", ["sine", "ramp", "random", "rest"])
def test_steps_of_a_converter_are_no_end_of_its_range(way, noise):
    """Statistical: counts that repeat, also the largest, while the body moves or rests; of 100
    recordings no more than one is doubted."""
    step, count, doubted = 1e-15, 400, 0
    for seed in range(100):
        rng, phase = np.random.default_rng(seed), np.linspace(0, 1, count)
        ways = {
            "sine": np.sin(9 * phase + seed),
            "ramp": phase,
            "random": rng.uniform(-1, 1, count),
            "rest": np.clip(3 * phase - 1, 0, 1),
        }
        true = 200 * step * ways[way]
        seen = step * np.round(1.03 * true / step + noise * rng.normal(size=count))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", CalibrationWarning)
            calibrate(true[:, None], seen[:, None], drift=False)
        doubted += any("share its largest" in str(w.message) for w in told)
    assert doubted <= 1
