"""The examples, run for real."""

from __future__ import annotations

import importlib
import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.humans import HandRecording
from capsense.scenario import play

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_five_lines(capsys: pytest.CaptureFixture[str]) -> None:
    """Six gains; by symmetry the corner electrodes gain the same, the middle ones another."""
    runpy.run_path(str(EXAMPLES / "five_lines.py"))
    found = re.findall(r"(E\d): ([+-][\d.]+) fF", capsys.readouterr().out)
    gains = {name: float(value) for name, value in found}
    assert list(gains) == ["E1", "E2", "E3", "E4", "E5", "E6"]
    assert min(gains.values()) > 10
    corners = [gains[k] for k in ("E1", "E3", "E4", "E6")]
    assert corners == approx([corners[0]] * 4, abs=0.2)
    assert gains["E2"] == approx(gains["E5"], abs=0.2)


def test_hand_approach() -> None:
    """The arm is felt by the electrodes in the order in which it crosses them."""
    scenario = cs.load_scenario(EXAMPLES / "hand_approach.toml").resampled(5.0)
    samples = list(play(scenario, cs.Simulator(scenario.design, method=scenario.method)))
    peaks = [
        max(samples, key=lambda s, k=k: s.reading.delta[k, k]).time  # type: ignore[misc]
        for k in range(6)
    ]
    assert peaks[0] < peaks[1] < peaks[2]
    assert peaks[3] < peaks[4] < peaks[5]
    first, last = (np.diag(samples[k].reading.delta) for k in (0, -1))
    np.testing.assert_allclose(first, last[::-1], rtol=0.02)  # half a turn about z
    assert max(s.reading.delta[0, 0] for s in samples) > 100 * first[0]


def test_the_sample_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """The files of the log are what its script makes, but for last digits of the solver."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "logs"))
    poses, counts = importlib.import_module("make_six_patch_ball").make()
    log = np.loadtxt(EXAMPLES / "logs/six_patch_ball.csv", delimiter=",", skiprows=2)
    told = np.loadtxt(EXAMPLES / "logs/six_patch_ball_poses.csv", delimiter=",", skiprows=2)
    np.testing.assert_allclose(told, poses, atol=6e-6)
    np.testing.assert_allclose(log[:, 0], counts.time, atol=6e-5)
    np.testing.assert_array_equal(log[:, 1], counts.channel)
    lsb = 1.0 / 2**19  # pF
    np.testing.assert_allclose(log[:, 2] * lsb, counts.code * lsb, atol=1e-4)


def test_steel_bar_triangle() -> None:
    """As in the published curve: a deep dip on the line, two shallow ones on the triangle."""
    scenario = cs.load_scenario(EXAMPLES / "steel_bar_triangle.toml").resampled(5.0)
    trajectory = scenario.bodies[0].trajectory
    assert trajectory is not None
    line_ends = 0.430 / 0.116
    apex = 0.5 * (line_ends + trajectory.duration)
    simulator = cs.Simulator(scenario.design, method=scenario.method)
    loss = [
        (s.time, -s.reading.delta[0, 2] / simulator.baseline[0, 2])
        for s in play(scenario, simulator)
    ]

    def deepest(start: float, end: float) -> float:
        return max(v for t, v in loss if start <= t <= end)

    assert 0.05 < deepest(0.0, line_ends) < 0.20
    for start, end in ((line_ends, apex - 0.3), (apex + 0.3, trajectory.duration)):
        assert 0.005 < deepest(start, end) < 0.3 * deepest(0.0, line_ends)
        assert deepest(apex - 0.15, apex + 0.15) < deepest(start, end)
    assert min(v for t, v in loss if abs(t - line_ends) < 0.2) < 0.002
    again = trajectory.duration
    assert deepest(again, again + line_ends) == approx(deepest(0.0, line_ends), rel=0.02)


def test_touch_approach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fist from 200 mm to full pressure and back; the example checks itself and draws a plot."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    module = importlib.import_module("touch_approach")
    monkeypatch.setattr(module, "RATE", 20.0)
    record = module.main(tmp_path)
    assert (tmp_path / "touch_approach.png").stat().st_size > 10_000
    code = record.codes.of("press").code
    assert code.max() - np.median(code[:5]) > 1e6


def test_hand_over_six_patch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracked hand is sensed while it is there, and leaves without a jump when it is lost.

    Filtered fingertips are nearer to the truth than what the tracker reports, at rest.
    """
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.syspath_prepend(str(EXAMPLES / "hands"))
    module, maker = importlib.import_module("hand_over_six_patch"), importlib.import_module(
        "make_reach"
    )  # fmt: skip
    recording = HandRecording.load(module.RECORDING)
    np.testing.assert_allclose(maker.make().joints, recording.joints, atol=1.01 * maker.BEST)
    assert module.RECORDING.stat().st_size < 100_000
    played = module.main(tmp_path)
    assert (tmp_path / "hand_over_six_patch.png").stat().st_size > 10_000
    status = np.array([s.status for s in played.samples])
    changes = np.flatnonzero(status[1:] != status[:-1]) + 1
    assert status[[0, *changes]].tolist() == [
        "tracked", "held", "leaving", "absent", "returning", "tracked",
    ]  # fmt: skip
    time, own = recording.time, played.delta
    assert not own[status == "absent"].any()
    pressed, fist = (time > 2.5) & (time < 2.9), (time > 5.0) & (time < 5.3)
    assert np.argmax(own[pressed].mean(axis=0)) == 1  # the middle finger is over E2
    assert np.argmax(own[fist].mean(axis=0)) == 4  # the thumb is over E5
    assert own[pressed].mean(axis=0).min() > 20 * own[time < 0.3].max()
    held = own[status == "held"]
    assert np.ptp(held[1:], axis=0).max() < 1e-20
    for edge in (np.flatnonzero(status == "leaving")[-1], changes[3]):  # out of sight by then
        assert own[edge].max() < 0.01 * held.max()
    still = ((time > 1.4) & (time < 1.8)) | pressed
    truth = np.array([maker.HAND.landmarks(j) for j in maker.truth(time[still])])
    shown = np.array([s.landmarks for s, ok in zip(played.samples, still, strict=True) if ok])
    raw = played.raw[still]

    def scatter(points: np.ndarray) -> float:  # but for the drift, which no filter can see
        off = points - truth
        return float(np.std(np.diff(off, axis=0)))

    assert scatter(shown) < 0.5 * scatter(raw)
