"""Baseline tracking and touch logic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout.converter import Detector, ExponentialTracker, Filter, SteppingTracker


def watch(detector, codes, rising=True):
    """Baselines and states of one channel after each code."""
    detection = detector.start(1, rising)
    out = [detection(np.zeros(1, dtype=np.int64), np.array([code])) for code in codes]
    return np.array([b[0] for b, _ in out]), np.array([t[0] for _, t in out])


STILL = ExponentialTracker(1e18)


def test_hysteresis():
    """On at ``touch``, off below ``release``, nothing changes in between."""
    codes = [1000, 1049, 1050, 1030, 1049, 1020, 1019, 1049, 1050]
    _, touched = watch(Detector(50, 20, STILL), codes)
    assert touched.tolist() == [False, False, True, True, True, True, False, False, True]


def test_falling_codes():
    """A chip whose code falls as the capacitance grows is touched by falling codes."""
    codes = [500, 520, 470, 440, 490]
    _, touched = watch(Detector(50, 20, STILL), codes, rising=False)
    assert touched.tolist() == [False, False, False, True, False]


def test_debounce():
    """A change takes so many samples in a row; shorter ones are ignored."""
    pattern = "..##.###..#...."
    codes = [0] + [100 if c == "#" else 0 for c in pattern]
    _, touched = watch(Detector(50, 20, STILL, debounce=3), codes)
    assert "".join("#" if t else "." for t in touched[1:]) == ".......######.."


def test_exponential_tracker():
    """Analytic: a step decays as e^(−n/samples); a touch stops it."""
    baseline, _ = watch(Detector(1e6, 1e5, ExponentialTracker(20)), [0] + [100] * 60)
    assert 100 - baseline[1:] == approx(100 * np.exp(-np.arange(1, 61) / 20), rel=1e-9)
    baseline, touched = watch(Detector(50, 20, ExponentialTracker(20)), [0] + [100] * 60)
    assert touched[1:].all()
    assert (baseline == 0).all()
    baseline, _ = watch(Detector(50, 20, ExponentialTracker(20, hold=False)), [0] + [100] * 60)
    assert baseline[-1] > 90


def test_slow_drift_is_no_touch_and_an_approach_is():
    """A drift of many thresholds, slow against the tracker, never touches; the same, fast, does."""
    detector = Detector(50, 20, ExponentialTracker(100))
    slow = np.rint(np.linspace(0, 2000, 20_000))
    assert not watch(detector, slow)[1].any()
    assert watch(detector, slow[::40])[1].any()


def test_stepping_tracker():
    """By its definition: small signals pass at once, larger ones in steps once they last."""
    tracker = SteppingTracker(Filter(2, 3, 4, 0), Filter(1, 5, 0, 0), Filter(0, 0, 255, 255))
    detector = Detector(1000, 500, tracker)
    assert watch(detector, [100, 104])[0].tolist() == [100, 104]  # 4 = 2 · max_half_delta
    baseline, _ = watch(detector, [100] + [105] * 7)
    assert baseline.tolist() == [100, 100, 100, 100, 100, 103, 105, 105]
    baseline, _ = watch(detector, [100] + [120] * 18)  # counts anew after each step
    assert np.flatnonzero(np.diff(baseline)).tolist() == [4, 9, 14]
    baseline, _ = watch(detector, [100] + [80] * 4)
    assert baseline.tolist() == [100, 95, 90, 85, 80]


def test_stepping_tracker_runs_at_every_nth_sample():
    tracker = SteppingTracker(Filter(0, 1, 0, 3), Filter(0, 1, 0, 3))
    baseline, _ = watch(Detector(1000, 500, tracker), [0] + [100] * 12)
    steps = np.diff(baseline)
    assert steps.sum() == 3
    assert np.diff(np.flatnonzero(steps)).tolist() == [4, 4]


def test_channels_are_apart():
    """Invariant: what one channel sees changes nothing in another, in any batch."""
    rng = np.random.default_rng(0)
    codes = np.rint(rng.normal(0, 30, (200, 3))).astype(np.int64)
    detector = Detector(50, 20, SteppingTracker(), debounce=2)
    together = detector.start(3, True)
    whole = [together(np.arange(3), row) for row in codes]
    for channel in range(3):
        baseline, touched = watch(detector, codes[:, channel])
        assert (baseline == [b[channel] for b, _ in whole]).all()
        assert (touched == [t[channel] for _, t in whole]).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Detector(10, 20, STILL), "touch = 10 and release = 20"),
        (lambda: Detector(10, 0, STILL), "release = 0"),
        (lambda: Detector(math.inf, 1, STILL), "touch = inf"),
        (lambda: Detector(10, 5, STILL, 0), "debounce is 0"),
        (lambda: Detector(10, 5, STILL, 1.5), "debounce is 1.5"),
        (lambda: Detector("10", 5, STILL), "touch = '10'"),
        (lambda: ExponentialTracker(0), "samples is 0"),
        (lambda: Filter(max_half_delta=-1), "max_half_delta is -1"),
        (lambda: Filter(delay=256), "delay is 256"),
    ],
)
def test_bad_detectors_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()


def test_limits_are_allowed():
    """Limits: what lies at the ends of a range is taken."""
    for touch, release, debounce in ((10, 10, 1), (0.5, 0.25, 2), (1e12, 1e-9, 10**6)):
        made = Detector(touch, release, STILL, debounce)
        assert (made.touch, made.release, made.debounce) == (touch, release, debounce)
    assert ExponentialTracker(1e-9).samples == 1e-9
    for value in (0, 255):
        assert Filter(value, value, value, value).delay == value
        for name in ("max_half_delta", "noise_half_delta", "noise_count", "delay"):
            with pytest.raises(ReadoutError, match=f"{name} is"):
                Filter(**{name: 256 if value else -1})


def test_small_signals_are_taken_over_at_once():
    """Up to twice the half delta of 3 codes: 6 are, 7 are not."""
    tracker = SteppingTracker(away=Filter(max_half_delta=3, noise_half_delta=1, noise_count=9))
    process = tracker.start(1)
    channel, still = np.array([0]), np.array([False])
    assert process(channel, np.array([6.0]), still) == [6.0]
    assert process(channel, np.array([7.0]), still) == [0.0]


@pytest.mark.parametrize(("touch", "release"), [(1.0, -1.0), (float("inf"), 1.0), (1.0, 0.0)])
def test_thresholds_are_finite_and_above_zero(touch, release):
    with pytest.raises(ReadoutError, match="0 < release <= touch"):
        Detector(touch, release, ExponentialTracker(50))
