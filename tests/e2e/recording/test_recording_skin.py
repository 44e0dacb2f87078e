"""Recordings of skins: all sensors in one file, each as it would be recorded alone."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import capsense as cs
from capsense.__main__ import main
from capsense.errors import RecordingError
from capsense.recording import reader

PLACES = {"front": cs.Pose((0.0, 0.0, 0.0)), "back": cs.Pose((0.0, 0.0, -0.01), (1, 0, 0, 0))}


def scene(height: float) -> cs.Scene:
    """A ball over the front, and one under the back."""
    balls = [
        cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, z)), name=name)
        for name, z in (("over", height), ("under", -height - 0.01))
    ]
    return cs.Scene(balls)


@pytest.fixture
def skin(sim: cs.Simulator) -> cs.Skin:
    return cs.Skin({name: (sim, pose) for name, pose in PLACES.items()})


@pytest.fixture
def file(skin: cs.Skin, tmp_path: Path) -> Path:
    """Three steps, the sensors moving, and one after a reset."""
    path = tmp_path / "skin.mcap"
    with cs.record(path, skin) as run:
        for k in range(3):
            poses = {"front": cs.Pose((0.002 * k, 0.0, 0.0))}
            run.step(scene(0.05 - 0.005 * k), poses, time=0.1 * k)
        run.reset()
        run.step(scene(0.05), time=0.0)
        assert run.count == 4
    return path


def test_each_sensor_is_recorded_as_alone(
    file: Path, skin: cs.Skin, sim: cs.Simulator, tmp_path: Path
) -> None:
    """Differential: the same steps of one of the sensors by a recorder of its own."""
    alone = tmp_path / "alone.mcap"
    with cs.record(alone, sim.copy(), name="back") as run:
        for k in range(4):
            seen = scene(0.05 - 0.005 * (k % 3)).bodies[1]
            if k == 3:
                run.reset()
            run.step(cs.Scene([seen.moved(PLACES["back"].inverse() @ seen.pose)]), 0.1 * (k % 3))
    ours, theirs = (list(cs.open_recording(f, "back").steps()) for f in (file, alone))
    assert len(ours) == len(theirs) == 4
    for one, other in zip(ours, theirs, strict=True):
        assert (one.time, one.episode, one.stamp) == (other.time, other.episode, other.stamp)
        np.testing.assert_array_equal(one.reading.delta, other.reading.delta)
        assert [b.name for b in one.scene] == [b.name for b in other.scene]
    front = [step.reading.delta for step in cs.open_recording(file, "front").steps()]
    assert np.abs(front[1]).max() > np.abs(front[0]).max() > 0


def test_a_sensor_must_be_named(file: Path) -> None:
    """The error lists them."""
    with pytest.raises(RecordingError, match="holds 2 sensors; name one of them: 'front', 'back'"):
        cs.open_recording(file)
    with pytest.raises(RecordingError, match="no sensor 'frnt'; did you mean 'front'"):
        cs.open_recording(file, "frnt")
    assert [r.session.name for r in reader.open_all(file)] == ["front", "back"]


def test_all_are_replayed(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command, to the last bit."""
    assert main(["replay", str(file)]) == 0
    told = capsys.readouterr().out
    assert told.count("same to the last bit") == 2
    assert "sensor       front" in told
    assert cs.replay(cs.open_recording(file, "back")).same


def test_export(file: Path, tmp_path: Path) -> None:
    """Tables of one sensor; whole files of all."""
    table, whole = tmp_path / "back.csv", tmp_path / "whole.mcap"
    assert main(["export", str(file), "--sensor", "back", "-o", str(table)]) == 0
    assert len(list(csv.reader(table.open()))) == 5
    assert main(["export", str(file), "-o", str(whole)]) == 0
    assert [r.session.name for r in reader.open_all(whole)] == ["front", "back"]
    assert main(["export", str(file), "-o", str(tmp_path / "x.csv")]) == 2


def test_frames_of_all_sensors(file: Path) -> None:
    """Each stands in the world by its name, for ROS 2."""
    from mcap.reader import make_reader

    from capsense.recording.ros import decode

    frames: dict[str, list[Any]] = {}
    topics = set()
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            topics.add(channel.topic)
            if channel.topic == "/tf":
                for t in decode(message.data, "tf2_msgs/msg/TFMessage").transforms:
                    if t.header.frame_id == "world":
                        at = t.transform.translation
                        frames.setdefault(t.child_frame_id, []).append((at.x, at.y, at.z))
    assert {f"/{name}/delta" for name in PLACES} <= topics
    assert frames["front"][:3] == [(0.0, 0, 0), (0.002, 0, 0), (0.004, 0, 0)]
    assert frames["back"] == [(0, 0, -0.01)] * 4


def test_a_skin_on_a_robot(sim: cs.Simulator, tmp_path: Path) -> None:
    """Differential: what is recorded is what the skin reads, with its chips' counts."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint axis="0 0 1"/>'
        '<geom size=".001" mass="1"/><site name="front"/>'
        '<site name="back" pos="0 0 -.01" quat="0 1 0 0"/></body>'
        '<body name="ball" mocap="true" pos="0 0 .05"><geom size=".02"/></body>'
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sites = ["front", "back"]
    skin, twin = (
        cs.mujoco.attach_skin(model, data, sites, sim.copy(), readout="fdc1004") for _ in range(2)
    )
    file = tmp_path / "robot.mcap"
    expected = []
    with cs.record(file, skin) as run:
        for _ in range(3):
            mujoco.mj_step(model, data)
            found = run.read()
            expected.append(twin.read())
            for name in sites:
                np.testing.assert_array_equal(found[name].delta, expected[-1][name].delta)
    for name in sites:
        steps = list(cs.open_recording(file, name).steps())
        for step, readings in zip(steps, expected, strict=True):
            np.testing.assert_array_equal(step.reading.delta, readings[name].delta)
            counts = readings[name].counts
            assert counts is not None
            if step.reading.counts is not None:
                np.testing.assert_array_equal(step.reading.counts.code, counts.code)
    with pytest.raises(RecordingError, match="attached to a robot; write read"):
        run.step(scene(0.05), time=9.0)


def test_what_cannot_be_a_topic_is_refused(
    sim: cs.Simulator, tmp_path: Path, skin: cs.Skin
) -> None:
    """Before there is a file."""
    bad = cs.Skin({"left arm": (sim, cs.Pose())})
    with pytest.raises(RecordingError, match="name is 'left arm'; give letters"):
        cs.record(tmp_path / "x.mcap", bad)
    assert not (tmp_path / "x.mcap").exists()
    with cs.record(tmp_path / "y.mcap", skin) as run:
        with pytest.raises(RecordingError, match="on no robot; write step"):
            run.read()
        run.step(scene(0.05), time=1.0)
        with pytest.raises(RecordingError, match="the last step was at 1 s"):
            run.step(scene(0.05), time=0.5)
