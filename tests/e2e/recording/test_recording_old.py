"""Recordings of earlier versions, by a method that no longer exists."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import recorded_scenes
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.__main__ import main
from capsense.errors import RecordingError
from capsense.field.background import MeshSettings
from capsense.recording import Session, read_session
from capsense.viewer.source import RecordingSource


def as_before(text: str) -> str:
    """The settings as versions with a lattice wrote them."""
    data = json.loads(text)
    lattice = {**data["settings"].pop("mesh"), "storey": 0.022, "thinning": 0.35}
    data["settings"] = {"lattice": lattice, **data["settings"], "calibration": 0.22}
    del data["preset"]
    data.update(method="perturbation", tolerance_F=1e-18, relative_tolerance=1e-5)
    return json.dumps(data)


@pytest.fixture
def old(
    tmp_path: Path, field_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Path, list[cs.Reading]]:
    """A recording of three steps, and its readings."""
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    sim = cs.Simulator(tiny_design(), settings=SETTINGS)
    plain = Session.to_json
    with monkeypatch.context() as patch:
        patch.setattr(Session, "to_json", lambda self: as_before(plain(self)))
        with cs.record(tmp_path / "old.mcap", sim) as run:
            readings = [run.step(recorded_scenes.scene_at(k), 0.1 * k) for k in range(3)]
    return tmp_path / "old.mcap", readings


def test_readings_can_be_read(old: tuple[Path, list[cs.Reading]]) -> None:
    recording = cs.open_recording(old[0])
    assert recording.session.method == "perturbation"
    assert recording.session.settings == SETTINGS
    for step, reading in zip(recording.steps(), old[1], strict=True):
        np.testing.assert_array_equal(step.reading.delta, reading.delta)


def test_a_replay_names_another_method(
    old: tuple[Path, list[cs.Reading]], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RecordingError, match=r"'perturbation' of capsense .*, which is gone"):
        cs.replay(old[0])
    assert main(["replay", str(old[0])]) == 2
    assert "--method surface" in capsys.readouterr().err
    assert cs.replay(old[0], method="surface").same
    assert main(["replay", str(old[0]), "--method", "surface"]) == 0


def test_it_can_be_viewed(old: tuple[Path, list[cs.Reading]]) -> None:
    source = RecordingSource(cs.open_recording(old[0]))
    assert source.green is not None
    np.testing.assert_array_equal(source.frame(1).reading.delta, old[1][1].delta)


def test_other_methods_are_damage(old: tuple[Path, list[cs.Reading]]) -> None:
    session = cs.open_recording(old[0]).session
    data = json.loads(as_before(session.to_json()))
    mesh = read_session(json.dumps(data).encode(), session.design).settings.mesh
    assert mesh == MeshSettings().refined(0.5)
    data["method"] = "masked"
    assert read_session(json.dumps(data).encode(), session.design).method == "fem_masked"
    data["method"] = "guessing"
    with pytest.raises(RecordingError, match="damaged"):
        read_session(json.dumps(data).encode(), session.design)
