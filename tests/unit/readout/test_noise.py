"""Noise and drift: statistics against what the models specify.

Bounds are some standard errors of the estimate, as computed beside them; seeds are fixed.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout.noise import (
    ClimateDrift,
    Context,
    Flicker,
    Mains,
    Profile,
    RandomWalk,
    White,
    allan_deviation,
)

PERIOD = 0.01


def run(stage, cycles, channels, value=0.0, seed=0, conversion=PERIOD):
    """Samples of a stage fed with a constant, shape (cycles, channels)."""
    process = stage.start(Context(channels, conversion, PERIOD, np.random.default_rng(seed)))
    channel = np.arange(channels)
    constant = np.full(channels, value)
    return np.array(
        [process(channel, np.full(channels, n * PERIOD), constant) for n in range(cycles)]
    )


def spectrum(samples):
    """One-sided power spectral density, averaged over channels, Hann window."""
    n = len(samples)
    window = np.hanning(n)[:, None]
    power = np.abs(np.fft.rfft(samples * window, axis=0)) ** 2
    density = 2 * PERIOD * power / (window**2).sum()
    return np.fft.rfftfreq(n, PERIOD)[1:], density.mean(axis=1)[1:]


def slow_allan(values, m):
    """Reference: the definition, written out."""
    means = [np.mean(values[k : k + m]) for k in range(len(values) - m + 1)]
    changes = [means[k + m] - means[k] for k in range(len(means) - m)]
    return math.sqrt(0.5 * np.mean(np.square(changes)))


def test_allan_deviation_is_its_definition():
    """Differential: against means written out; a drift gives drift·τ/√2 exactly."""
    values = np.random.default_rng(0).standard_normal(200)
    for m in (1, 2, 7, 40, 100):
        assert allan_deviation(values, [m])[0] == approx(slow_allan(values, m), rel=1e-9)
    ramp = 3.0 * np.arange(100)
    assert allan_deviation(ramp, [10])[0] == approx(3.0 * 10 / math.sqrt(2), rel=1e-9)
    assert allan_deviation(np.ones((50, 2, 3)), [5]).shape == (1, 2, 3)
    with pytest.raises(ReadoutError, match="is 101; give a whole number from 1 to 100"):
        allan_deviation(values, [101])


def test_white_noise():
    """Statistical: rms, flat spectrum, Allan deviation r √(T/τ), independent channels."""
    rms = 2.5e-15
    samples = run(White(rms), 2048, 200, value=1e-12) - 1e-12
    count = samples.size
    assert samples.std() == approx(rms, rel=5 / math.sqrt(2 * count))
    assert abs(samples.mean()) < 5 * rms / math.sqrt(count)
    _, density = spectrum(samples)
    level = 2 * rms**2 * PERIOD
    bands = np.array_split(density, 8)
    for band in bands:
        assert band.mean() == approx(level, rel=5 / math.sqrt(200 * len(band) / 2))
    averages = np.array([1, 4, 16, 64])
    deviation = np.sqrt((allan_deviation(samples, averages) ** 2).mean(axis=1))
    assert deviation == approx(rms / np.sqrt(averages), rel=0.03)
    correlation = np.corrcoef(samples[:, :20].T) - np.eye(20)
    assert np.abs(correlation).max() < 6 / math.sqrt(2048)


def test_white_noise_in_proportion():
    """Statistical: absolute and relative parts add in quadrature."""
    noisy = run(White(3e-15, relative=4e-3), 2000, 50, value=1e-12) - 1e-12
    assert noisy.std() == approx(5e-15, rel=5 / math.sqrt(2 * noisy.size))


def flicker_variance(taus, variance, m):
    """Allan variance of sampled relaxation processes: from their autocovariance, exactly.

    ``2σ² = var(ȳ₂ − ȳ₁)``; for a window of weights ±1/m the variance is a sum over lags.
    """
    weights = np.concatenate([-np.ones(m), np.ones(m)]) / m
    lags = np.correlate(weights, weights, "full")[2 * m - 1 :]
    steps = np.arange(2 * m)
    total = 0.0
    for tau in taus:
        covariance = variance * np.exp(-steps * PERIOD / tau)
        total += covariance[0] * lags[0] + 2 * (covariance[1:] * lags[1:]).sum()
    return 0.5 * total


def test_flicker_model_has_the_floor_it_states():
    """Analytic: the model's exact Allan deviation is the floor within 2 % over three decades."""
    stage = Flicker(1e-15, slowest=1e5)
    taus, variance = stage.poles(PERIOD)
    for m in (4, 16, 64, 256, 1024, 4096):
        assert math.sqrt(flicker_variance(taus, variance, m)) == approx(1e-15, rel=0.02)


def test_flicker_noise():
    """Statistical: samples have the floor, and a spectrum h/f with h = floor²/(2 ln 2)."""
    floor = 1e-15
    samples = run(Flicker(floor, slowest=1e4), 4096, 300)
    deviation = np.sqrt((allan_deviation(samples, [8, 32, 128, 512]) ** 2).mean(axis=1))
    assert deviation == approx(np.full(4, floor), rel=0.06)
    frequency, density = spectrum(samples)
    band = (frequency > 0.2) & (frequency < 5)
    slope, _ = np.polyfit(np.log(frequency[band]), np.log(density[band]), 1)
    assert slope == approx(-1.0, abs=0.05)
    h = floor**2 / (2 * math.log(2))
    assert (density[band] * frequency[band]).mean() == approx(h, rel=0.05)


def test_flicker_starts_in_its_stationary_state():
    """Statistical: the variance over channels is the same at the start and later."""
    samples = run(Flicker(1e-15), 200, 4000)
    taus, variance = Flicker(1e-15).poles(PERIOD)
    for row in (samples[0], samples[-1]):
        assert row.var() == approx(variance * len(taus), rel=5 * math.sqrt(2 / 4000))


def test_random_walk():
    """Statistical: Allan deviation k √(τ/3), and a spread of k √t."""
    rate = 1e-15
    samples = run(RandomWalk(rate), 2000, 400)
    time = 2000 * PERIOD
    assert samples[-1].std() == approx(rate * math.sqrt(time), rel=5 / math.sqrt(800))
    averages = np.array([20, 60, 200])
    deviation = np.sqrt((allan_deviation(samples, averages) ** 2).mean(axis=1))
    assert deviation == approx(rate * np.sqrt(averages * PERIOD / 3), rel=0.05)


@pytest.mark.parametrize("order", [1, 3])
def test_mains_is_averaged_and_folded(order):
    """Analytic: amplitude × sinc(fT)^order, folded; nothing is left of whole periods."""
    stage = Mains(1e-14, 50.0, order)
    samples = run(stage, 1000, 1, conversion=0.004)[:, 0]
    # 50 Hz sampled at 100 Hz alternates in sign, with one amplitude.
    assert samples[::2] == approx(np.full(500, samples[0]), abs=1e-20)
    assert samples[1::2] == approx(np.full(500, -samples[0]), abs=1e-20)
    shifted = run(Mains(1e-14, 47.0, order), 1000, 1, conversion=0.004)[:, 0]
    expected = 1e-14 * abs(np.sinc(47 * 0.004)) ** order
    assert np.sqrt(2 * np.mean(shifted**2)) == approx(expected, rel=1e-3)
    assert np.abs(run(stage, 100, 1, conversion=0.02)).max() < 1e-28


def test_averaging_of_the_mains_is_that_of_the_window():
    """Differential: the factor sinc(fT) against the mean of a finely sampled sine."""
    stage = Mains(1.0, 50.0)
    process = stage.start(Context(1, 0.0073, PERIOD, np.random.default_rng(5)))
    phase = 2 * math.pi * np.random.default_rng(5).random()
    for middle in (0.1, 0.237):
        window = middle + 0.0073 * ((np.arange(100_000) + 0.5) / 100_000 - 0.5)
        mean = np.sin(2 * math.pi * 50 * window + phase).mean()
        found = process(np.array([0]), np.array([middle]), np.zeros(1))[0]
        assert found == approx(mean, abs=1e-9)


def test_climate():
    """Analytic: offset and gain at temperatures and humidities along a profile."""
    stage = ClimateDrift(
        2e-15, 1e-3, 3e-15, 2e-3,
        temperature=Profile.of([(0.0, 25.0), (10.0, 35.0)], "temperature"),
        humidity=Profile.of(60.0, "humidity"),
    )  # fmt: skip
    process = stage.start(Context(3, PERIOD, PERIOD, np.random.default_rng(0)))
    found = process(np.arange(3), np.array([0.0, 5.0, 20.0]), np.full(3, 1e-12))
    kelvin = np.array([0.0, 5.0, 10.0])
    expected = (1 + 1e-3 * kelvin + 0.02) * 1e-12 + 2e-15 * kelvin + 3e-14
    assert found == approx(expected, rel=1e-12)


STAGES = [White(1e-15, 1e-3), Flicker(1e-15), RandomWalk(1e-15), Mains(1e-15)]


@pytest.mark.parametrize("stage", STAGES, ids=lambda s: type(s).__name__)
def test_same_seed_same_bits_however_dealt(stage):
    """Invariant: one channel at a time, or all at once; another seed, other numbers."""
    together = run(stage, 50, 4, value=1e-12, seed=3)
    process = stage.start(Context(4, PERIOD, PERIOD, np.random.default_rng(3)))
    single = [
        process(np.array([c]), np.array([n * PERIOD]), np.array([1e-12]))[0]
        for n in range(50)
        for c in range(4)
    ]
    assert (together.ravel() == single).all()
    process = stage.start(Context(4, PERIOD, PERIOD, np.random.default_rng(3)))
    channel, time = np.tile(np.arange(4), 50), np.repeat(PERIOD * np.arange(50), 4)
    cuts = [0, 1, 7, 8, 90, 200]
    dealt = [process(channel[a:b], time[a:b], np.full(b - a, 1e-12)) for a, b in pairwise(cuts)]
    assert (together.ravel() == np.concatenate(dealt)).all()
    assert (run(stage, 50, 4, value=1e-12, seed=3) == together).all()
    assert (run(stage, 50, 4, value=1e-12, seed=4) != together).any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: White(-1.0), "rms is -1.0"),
        (lambda: White(0.0, math.nan), "relative is nan"),
        (lambda: Flicker(-1.0), "floor is -1.0"),
        (lambda: Flicker(1.0, 0.0), "slowest is 0.0"),
        (lambda: RandomWalk(math.inf), "rate is inf"),
        (lambda: Mains(1.0, 0.0), "frequency is 0.0"),
        (lambda: Mains(1.0, 50.0, 0), "order is 0"),
        (lambda: ClimateDrift(math.nan), "offset_per_kelvin is nan"),
        (lambda: Profile.of([(0.0, 1.0), (0.0, 2.0)], "temperature"), "times must rise"),
        (
            lambda: Profile.of([(0.0, math.nan)], "temperature"),
            "temperature: a number is not finite",
        ),
        (lambda: Profile.of([(0.0, 1.0, 2.0)], "humidity"), "humidity is"),
        (lambda: Profile.of([(0.0, 1.0), (2.0,)], "humidity"), "humidity: rows differ in length"),
        (lambda: Profile.of("hot", "temperature"), "temperature: .*no real numbers"),
        (lambda: White("loud"), "rms is 'loud'; give a number at least 0 F"),
        (lambda: allan_deviation([1.0, math.nan, 2.0, 3.0], [1]), "samples: a number is not"),
        (lambda: allan_deviation(np.ones(10), [1.5]), "is 1.5; give a whole number from 1 to 5"),
    ],
)
def test_bad_stages_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()


def test_climate_coefficients_of_either_sign_and_profiles_of_pairs():
    drift = ClimateDrift(offset_per_kelvin=-1e-15, gain_per_percent=-1e-4)
    assert drift.offset_per_kelvin == -1e-15
    with pytest.raises(ReadoutError, match="give a number or"):
        Profile.of([(0.0,), (1.0,)], "temperature")
