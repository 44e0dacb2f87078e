"""Scenarios, recordings and watched sensors as sources of a view."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest

import capsense as cs
from capsense.errors import ProtocolError, RecordingError, ServerError
from capsense.scenario import parse_scenario
from capsense.viewer.plane import Plane, region
from capsense.viewer.source import Frame, RecordingSource, ScenarioSource

DATA = {
    "name": "a ball goes by",
    "design": "six_patch",
    "sample_rate": 5.0,
    "body": [
        {
            "name": "ball", "shape": "sphere", "radius": 0.02, "material": "water",
            "trajectory": {"waypoints": [[-0.06, 0.0, 0.05], [0.06, 0.0, 0.05]], "speed": 0.1},
        }
    ],
}  # fmt: skip


def test_scenario() -> None:
    """Any sample may be asked for; readings are the simulator's, potentials where wanted."""
    scenario = parse_scenario(DATA)
    source = ScenarioSource(scenario, cs.Simulator("six_patch"))
    assert source.title == "a ball goes by"
    np.testing.assert_array_equal(source.times, scenario.times)
    assert source.green is not None
    plane = Plane(source.green, region(source.design), 1, 0.0)
    for index, wanted in ((3, plane), (0, None), (5, plane)):
        frame = source.frame(index, wanted)
        assert (frame.index, frame.time) == (index, scenario.times[index])
        expected = cs.Simulator("six_patch").step(scenario.scene_at(frame.time))
        np.testing.assert_array_equal(frame.reading.delta, expected.delta)
        assert frame.plane is wanted
        assert (frame.potentials is None) == (wanted is None)
    assert frame.potentials.shape == (len(plane.points), 6)
    source.close()


def test_masked_gives_no_potentials() -> None:
    """The other method solves on a mesh of its own."""
    source = ScenarioSource(parse_scenario(DATA), cs.Simulator("six_patch", method="fem_masked"))
    assert source.green is None
    assert source.frame(0).potentials is None


def test_recording(tmp_path: Path) -> None:
    """The very readings that were recorded; potentials from a simulator of its settings."""
    pytest.importorskip("mcap", reason='needs mcap: pip install "capsense[record]"')
    simulator = cs.Simulator("six_patch")
    scenario = parse_scenario(DATA)
    written = []
    with cs.record(tmp_path / "a.mcap", simulator) as recorder:
        for time_ in scenario.times:
            scene = scenario.scene_at(time_)
            reading = simulator.step(scene)
            recorder.write(time_, scene, reading)
            written.append(reading)
    source = RecordingSource(cs.open_recording(tmp_path / "a.mcap"))
    np.testing.assert_allclose(source.times, scenario.times)
    plane = Plane(source.green, region(source.design), 2, 0.02)
    for index in (4, 1):
        frame = source.frame(index, plane if index == 1 else None)
        np.testing.assert_array_equal(frame.reading.delta, written[index].delta)
        assert [b.name for b in frame.scene] == ["ball"]
    assert frame.potentials.shape == (len(plane.points), 6)


def test_empty_recording(tmp_path: Path) -> None:
    """It is named, and refused."""
    pytest.importorskip("mcap", reason='needs mcap: pip install "capsense[record]"')
    with cs.record(tmp_path / "a.mcap", cs.Simulator("six_patch")):
        pass
    with pytest.raises(RecordingError, match="holds no steps"):
        RecordingSource(cs.open_recording(tmp_path / "a.mcap"))


BALL = {"name": "ball", "shape": "sphere", "radius": 0.03, "material": "water"}


def at(z: float) -> dict[str, list[float]]:
    return {"position": [0.0, 0.0, z]}


class TestWatched:
    """A server's sensor, as another client drives it."""

    @pytest.fixture(autouse=True)
    def _websockets(self) -> None:
        pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')

    @staticmethod
    def next_of(source: object) -> Frame:
        limit = time.monotonic() + 10.0
        while time.monotonic() < limit:
            frame = source.next(0.1)
            if frame is not None:
                return frame
        raise AssertionError("nothing came")

    def test_bodies_and_depth(self) -> None:
        """Scenes and readings are those of the client; shapes that stay are not made anew."""
        from running_server import RunningServer

        from capsense.viewer.source import Watched

        with RunningServer("six_patch", watch=True) as server, server.client() as client:
            sensor = client.open(material="steel", back=0.02)
            source = Watched(server.url)
            np.testing.assert_array_equal(source.empty.capacitance, sensor.baseline)
            assert source.next(0.01) is None

            sensor.step_scene([{**BALL, "pose": at(0.08)}])
            one = self.next_of(source)
            answer = sensor.step_poses({"ball": at(0.06)})
            two = self.next_of(source)
            (ball,) = two.scene
            assert ball.shape is next(iter(one.scene)).shape
            assert ball.pose.position[2] == 0.06
            np.testing.assert_array_equal(two.reading.delta, answer.delta)
            np.testing.assert_allclose(two.reading.self_capacitance, answer.self_capacitance)
            assert (two.index, one.index) == (1, 0)
            assert two.time > one.time

            mine = cs.Simulator("six_patch").step(two.scene, keep_field=True)
            plane = Plane(source.green, region(source.design), 0, 0.0)
            np.testing.assert_array_equal(
                source.potentials(two, plane), mine.potentials(plane.points)
            )

            depth = np.full((16, 16), np.nan)
            depth[6:10, 6:10] = 0.07
            answer = sensor.step(depth)
            three = self.next_of(source)
            expected = cs.Simulator("six_patch").step(
                cs.DepthFrame(np.float32(depth), "steel", back=0.02)
            )
            np.testing.assert_array_equal(three.reading.delta, answer.delta)
            np.testing.assert_allclose(answer.delta, expected.delta, rtol=1e-3, atol=1e-18)
            assert next(iter(three.scene)).material.name == "steel"
            source.close()

    def test_waits_for_the_next_client(self) -> None:
        """It says what it waits for, and finds a new sensor of the same design by itself."""
        from running_server import RunningServer

        from capsense.viewer.source import Watched

        with RunningServer("patch", "six_patch", watch=True) as server:
            told = threading.Event()
            sources: list[Watched] = []
            thread = threading.Thread(
                target=lambda: sources.append(Watched(server.url, waiting=told.set))
            )
            thread.start()
            assert told.wait(10)
            with server.client() as client:
                client.open()
                thread.join(20)
                (source,) = sources
                client.close()
            with pytest.raises(ProtocolError, match="waiting for another"):
                self.next_of(source)
            with pytest.raises(ProtocolError, match="no sensor to watch"):
                source.next(0.1)
            with server.client() as client:
                client.open(design="six_patch")
                with pytest.raises(ProtocolError, match="'six_patch'; start the view anew"):
                    source.next(0.1)
            with server.client() as client:
                sensor = client.open()
                assert source.next(0.1) is None
                sensor.step_scene([])
                assert self.next_of(source).index == 0
            source.close()

    def test_refused(self) -> None:
        """No server, no permission, a wrong token, no such sensor."""
        from running_server import RunningServer

        from capsense.viewer.source import Watched

        with pytest.raises(ServerError, match=r"no server to watch at ws://127\.0\.0\.1:9"):
            Watched("ws://127.0.0.1:9")
        with pytest.raises(ProtocolError, match="elsewhere is no server"):
            Watched("elsewhere")
        with RunningServer("patch") as server, pytest.raises(ProtocolError, match="--watch"):
            Watched(server.url)
        with RunningServer("patch", watch=True, token="correct horse") as server:
            with pytest.raises(ProtocolError, match="token"):
                Watched(server.url)
            with pytest.raises(ProtocolError, match="no sensor 3:0 to watch"):
                Watched(server.url, token="correct horse", which=(3, 0))
