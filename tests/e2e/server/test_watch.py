"""Watching the sensor of another client."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')

from running_server import RunningServer

from capsense.codec import design_from_json
from capsense.errors import ProtocolError
from capsense.server import DepthMessage, ReadingMessage
from capsense.server.messages import MessageTable, read_scene

BALL = {"name": "ball", "shape": "sphere", "radius": 0.03, "material": "water"}
WALL = {"name": "wall", "shape": "box", "size": [0.1, 0.1, 0.01], "grounding": 1e-10,
        "material": {"eps_r": 3.0}}  # fmt: skip


@pytest.fixture(scope="module")
def watchable() -> Iterator[RunningServer]:
    """A server whose sensors may be watched."""
    with RunningServer("patch", watch=True) as server:
        yield server


def at(z: float) -> dict[str, list[float]]:
    return {"position": [0.0, 0.0, z]}


def test_sees_what_the_sensor_sees(watchable: RunningServer, dome: np.ndarray) -> None:
    """Depth images and bodies where they stand, each with the very reading the client got."""
    with watchable.client() as client, watchable.client() as watcher:
        sensor = client.open(5, material="human")
        told = watcher.ask("watching", type="watch")
        assert (told["sensor"], told["open"]["material"]) == (5, "human")
        assert (
            design_from_json(json.dumps(told["design"])).electrode_names == sensor.electrode_names
        )
        np.testing.assert_array_equal(told["baseline"], sensor.baseline)

        codes = np.full(dome.shape, 40, dtype=np.uint8)
        reading = sensor.step(dome, codes, time=0.5)
        seen, copied = watcher.receive(), watcher.receive()
        assert isinstance(seen, DepthMessage)
        np.testing.assert_array_equal(seen.depth, dome)
        np.testing.assert_array_equal(seen.eps_r, codes)
        assert_same(copied, reading)
        assert copied.time == seen.time == 0.5

        sensor.step_scene([{**BALL, "pose": at(0.08)}, {**WALL, "pose": at(0.2)}])
        watcher.receive()
        watcher.receive()
        reading = sensor.step_poses({"ball": at(0.05)}, time=2.0)  # the wall stays
        seen, copied = watcher.receive(), watcher.receive()
        assert isinstance(seen, dict)
        scene = read_scene(MessageTable(seen, "message", "scene"), 9)
        assert [b.pose.position[2] for b in scene.bodies] == [0.05, 0.2]
        assert [b.name for b in scene.bodies] == ["ball", "wall"]
        assert scene.bodies[1].grounding == 1e-10
        assert (scene.sequence, scene.time) == (2, 2.0)
        assert_same(copied, reading)

        sensor.close()
        assert watcher.receive() == {"type": "unwatched", "sensor": 5}


def test_which(watchable: RunningServer) -> None:
    """The newest, or the one that is named; a client that leaves is no longer watched."""
    with watchable.client() as one, watchable.client() as watcher:
        with pytest.raises(ProtocolError, match="no sensor to watch; open are none") as caught:
            watcher.ask("watching", type="watch")
        assert caught.value.code == "sensor"
        first, second = one.open(0), one.open(1)
        client = watcher.ask("watching", type="watch")["client"]
        second.step_scene([])
        assert watcher.receive()["sensor"] == 1
        assert watcher.receive().sensor == 1
        watcher.ask("watching", type="watch", client=client, sensor=0)
        second.step_scene([])
        first.step_scene([])
        assert watcher.receive()["sensor"] == 0  # and nothing of the other one
        watcher.receive()
        with pytest.raises(
            ProtocolError, match=rf"no sensor {client}:2 .* are {client}:0, {client}"
        ):
            watcher.ask("watching", type="watch", client=client, sensor=2)
        with pytest.raises(ProtocolError, match="unknown key"):
            watcher.ask("watching", type="watch", sensor=2)
        one.close()
        assert watcher.receive() == {"type": "unwatched", "sensor": 0}


def test_either_or(watchable: RunningServer) -> None:
    """A client has sensors, or watches one."""
    with watchable.client() as client, watchable.client() as watcher:
        client.open()
        watcher.ask("watching", type="watch")
        with pytest.raises(ProtocolError, match="opens no sensors") as caught:
            watcher.open()
        assert caught.value.code == "watch"
        with pytest.raises(ProtocolError, match="watches none"):
            client.ask("watching", type="watch")


def test_only_where_allowed(served: RunningServer) -> None:
    """Without the option nobody sees what others do."""
    with served.client() as client, served.client() as watcher:
        client.open(design="patch")
        with pytest.raises(ProtocolError, match="--watch") as caught:
            watcher.ask("watching", type="watch")
        assert caught.value.code == "watch"


def test_a_watcher_that_does_not_look(watchable: RunningServer) -> None:
    """It holds up nobody, and sees the newest when it looks again."""
    with watchable.client() as client, watchable.client() as watcher:
        sensor = client.open()
        watcher.ask("watching", type="watch")
        for k in range(300):
            last = sensor.step_scene([{**BALL, "pose": at(0.05 + 1e-4 * k)}])
        sequences = []
        while not sequences or sequences[-1] != last.sequence:
            found = watcher.receive()
            if isinstance(found, ReadingMessage):
                sequences.append(found.sequence)
        assert sequences == sorted(set(sequences))
        assert_same(found, last)


def assert_same(one: object, other: ReadingMessage) -> None:
    assert isinstance(one, ReadingMessage)
    np.testing.assert_array_equal(one.delta, other.delta)
    np.testing.assert_array_equal(one.self_capacitance, other.self_capacitance)
    assert (one.sequence, one.wall_time) == (other.sequence, other.wall_time)
