"""Replays that differ, and the command's exit codes."""

from __future__ import annotations

import dataclasses
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import recorded_scenes
from approximate import approx
from ball_scenario import ball_scenario

import capsense as cs
from capsense.__main__ import main
from capsense.errors import RecordingError

COUNT = 13


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "ball.toml"
    path.write_text(ball_scenario(), encoding="utf-8")
    return path


@pytest.fixture
def tampered(sim: cs.Simulator, tmp_path: Path) -> Path:
    """Five steps, in two of which a number is not what the simulator returned."""
    path = tmp_path / "tampered.mcap"
    with cs.record(path, sim) as run:
        for k in range(5):
            scene = recorded_scenes.scene_at(k)
            reading = sim.step(scene)
            if k in (2, 3):
                other = reading.capacitance.copy()
                other[0, 1] += 1e-18 * k
                reading = dataclasses.replace(reading, capacitance=other)
            run.write(0.1 * k, scene, reading)
    return path


def test_threads_that_share_a_recorder_take_turns(sim: cs.Simulator, tmp_path: Path) -> None:
    """Differential: every reading is that of its own scene; the file replays to the last bit."""
    scenes = [recorded_scenes.scene_at(k % 8) for k in range(64)]
    path, truth = tmp_path / "shared.mcap", [sim.step(scene).delta for scene in scenes[:8]]
    with cs.record(path, sim) as run, ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda scene: run.step(scene, 1.0).delta, scenes))
    for k, delta in enumerate(found):
        np.testing.assert_array_equal(delta, truth[k % 8])
    told = cs.replay(path)
    assert (told.steps, told.differing) == (64, 0)


def test_the_first_difference(tampered: Path) -> None:
    found = cs.replay(tampered)
    assert not found.same
    assert (found.steps, found.differing) == (5, 2)
    assert found.largest == approx(3e-18, rel=1e-3)
    first = found.first
    assert first is not None
    assert (first.step, first.time, first.what) == (2, 0.2, "C(E1, E2) [F]")
    assert first.recorded - first.replayed == approx(2e-18, rel=1e-3)
    assert str(first).startswith("step 2 at 0.2 s: C(E1, E2) [F] was -")


def test_tolerance(tampered: Path) -> None:
    assert cs.replay(tampered, tolerance=2.5e-18).differing == 1
    assert cs.replay(tampered, tolerance=3.5e-18).same
    for bad in (-1e-18, float("nan")):
        with pytest.raises(RecordingError, match="zero or more"):
            cs.replay(tampered, tolerance=bad)


def test_not_a_number_is_a_difference(sim: cs.Simulator, tmp_path: Path) -> None:
    path = tmp_path / "nan.mcap"
    with cs.record(path, sim) as run:
        reading = sim.step(cs.Scene())
        nan = np.full_like(reading.delta, np.nan)
        run.write(0.0, cs.Scene(), dataclasses.replace(reading, delta=nan))
    found = cs.replay(path, tolerance=1.0)
    assert found.differing == 1


def test_counts_that_differ(sim: cs.Simulator, tmp_path: Path) -> None:
    """The readout was restarted behind the recorder's back, so its noise is another."""
    path = tmp_path / "counts.mcap"
    with cs.record(path, sim, readout="fdc1004") as run:
        for k in range(4):
            if k == 2 and run.readout is not None:
                run.readout.reset(seed=7)
            run.step(recorded_scenes.scene_at(k), 0.1 * k)
    found = cs.replay(path)
    assert found.first is not None
    assert (found.first.step, found.largest) == (2, 0.0)
    assert cs.replay(path, tolerance=1e-21).same


def test_other_versions_are_told(
    tampered: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import capsense.recording.reader as module

    here = {**module.versions(), "numba": "9.9", "processor": "other"}
    monkeypatch.setattr(module, "versions", lambda: here)
    assert set(cs.replay(tampered).changed) == {"numba", "processor"}
    assert main(["replay", str(tampered)]) == 3
    errors = capsys.readouterr().err
    assert "recorded with numba" in errors
    assert "replayed with 9.9" in errors


# ---- the commands ----


def test_record_and_replay(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ball.mcap"
    arguments = ["record", str(scenario), "-o", str(path), "--readout", "fdc1004"]
    assert main(arguments) == 0
    out, errors = capsys.readouterr()
    assert f"{COUNT} of {COUNT}, at 10 Hz" in out
    assert errors == ""
    assert main(["replay", str(path)]) == 0
    out, errors = capsys.readouterr()
    assert "same to the last bit" in out
    assert errors == ""
    assert main(arguments) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*arguments, "--force", "--quiet", "--rate", "5"]) == 0
    assert capsys.readouterr().out == ""
    assert main(["replay", str(path), "-q"]) == 0
    assert capsys.readouterr().out == ""
    session = cs.open_recording(path).session
    assert session.title == "ball over six electrodes"


def test_replay_tells_what_differs(tampered: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tampered)]) == 3
    out, errors = capsys.readouterr()
    assert "2 steps differ; capacitances by at most 3e-18 F" in out
    assert "first, step 2 at 0.2 s: C(E1, E2) [F] was -" in errors
    assert main(["replay", str(tampered), "--tolerance", "1e-17"]) == 0
    assert "at most 3e-18 F" in capsys.readouterr().out


def test_replay_of_other_files(
    tampered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = tampered.read_bytes()
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(content[:9] + bytes(50) + content[59:])
    for path in (broken, tmp_path / "none.mcap", tmp_path):
        assert main(["replay", str(path)]) == 2
        assert "Traceback" not in capsys.readouterr().err
    broken.write_bytes(content[:-8])
    assert main(["replay", str(broken), "--tolerance", "1e-17"]) == 0
    assert "was not closed" in capsys.readouterr().err


def test_record_refuses_before_computing(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.delitem(cs.__dict__, "Simulator", raising=False)
    monkeypatch.setitem(cs.__dict__, "Simulator", None)  # calling it would fail
    (tmp_path / "file").write_text("")
    for output in (tmp_path, tmp_path / "no" / "a.mcap", tmp_path / "file", tmp_path / "a.bag"):
        assert main(["record", str(scenario), "-o", str(output)]) == 2
        assert str(output) in capsys.readouterr().err
    output = tmp_path / "a.mcap"
    for option, value in (("--readout", "fdc1005"), ("--readout", "no.toml"), ("--name", "a b")):
        assert main(["record", str(scenario), "-o", str(output), option, value]) == 2
        assert value in capsys.readouterr().err
    assert not output.exists()


def test_a_failing_step_keeps_what_was_recorded(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    step = cs.Simulator.step

    def fail(self: cs.Simulator, scene: cs.Scene, **options: float) -> cs.Reading:
        if self.steps == 5:
            raise cs.SolveError("the residual is 1e-3")
        return step(self, scene, **options)

    monkeypatch.setattr(cs.Simulator, "step", fail)
    path = tmp_path / "ball.mcap"
    assert main(["record", str(scenario), "-o", str(path)]) == 1
    errors = capsys.readouterr().err
    assert f"stopped at sample 5 of {COUNT} (t = 0.5 s)" in errors
    assert "residual" in errors
    recording = cs.open_recording(path)
    assert recording.complete
    assert len(list(recording.steps())) == 5


def test_attachments_are_plain_json(tampered: Path) -> None:
    """Others can read the settings, too."""
    from mcap.reader import make_reader

    with tampered.open("rb") as file:
        found = {a.name: json.loads(a.data) for a in make_reader(file).iter_attachments()}
    assert found["session.json"]["method"] == "surface"
    assert found["session.json"]["settings"]["panel_scale"] == 1.0
    assert [e["name"] for e in found["design.json"]["electrodes"]][:2] == ["E1", "E2"]
