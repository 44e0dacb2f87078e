"""Touch between server and client: only to those who ask for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from running_server import RunningServer

import capsense as cs
from capsense.errors import ProtocolError
from capsense.reading import Touch
from capsense.server import CONVERSION, ReadingMessage, pack_reading, unpack_reading
from capsense.server.messages import MessageTable, read_poses, read_scene
from capsense.server.sensor import scene_message

FOAM = str(Path(__file__).parents[1] / "data/foam.toml")
BALL = {
    "name": "ball", "shape": "sphere", "radius": 0.01, "material": "steel",
    "pose": {"position": [-0.012, 0, 0.0119]},
}  # fmt: skip


def reading(touch: Touch | None) -> ReadingMessage:
    one = np.eye(2) * 1e-12
    none = np.zeros(0, CONVERSION)
    return ReadingMessage(0, 1, 0.5, one, one, one[0], 0, 0, 1e-15, 1e-3, none, touch)


def test_a_reading_holds_touch_or_does_not() -> None:
    touch = Touch(np.array([0.1, 0.2]), np.array([1e-4, 2e-4]), 0.35)
    found = unpack_reading(pack_reading(reading(touch))).touch
    assert found is not None
    assert (found.force.tolist(), found.total) == ([0.1, 0.2], 0.35)
    assert found.compression.tolist() == [1e-4, 2e-4]
    bare, whole = pack_reading(reading(None)), pack_reading(reading(touch))
    assert unpack_reading(bare).touch is None
    assert len(whole) - len(bare) == 8 * 5
    with pytest.raises(ProtocolError, match="flags"):
        unpack_reading(bare[:6] + b"\x04" + bare[7:])
    with pytest.raises(ProtocolError, match="payload"):
        unpack_reading(bare[:6] + b"\x01" + bare[7:])


def test_scenes_and_poses_hold_forces() -> None:
    address = {"sensor": 0, "sequence": 1}
    scene = {"type": "scene", **address, "body": [{**BALL, "force": 0.5}]}
    found = read_scene(MessageTable(scene, "message", "scene"), 8)
    assert found.bodies[0].force == 0.5
    assert '"force": 0.5' in scene_message(found)
    poses = {"type": "poses", **address, "poses": {}, "forces": {"ball": None, "cup": 2}}
    forces = read_poses(MessageTable(poses, "message", "poses"), 8).forces
    assert forces == {"ball": None, "cup": 2.0}
    poses["forces"] = {"ball": -1.0}
    with pytest.raises(ProtocolError, match="ball"):
        read_poses(MessageTable(poses, "message", "poses"), 8)


def test_clients_feel_what_simulators_feel(foam_field: cs.Design) -> None:
    """Differential, and one client that does not ask for touch."""
    simulator = cs.Simulator(foam_field)
    body = cs.Body(cs.Sphere(0.01), cs.Pose((-0.012, 0, 0.0119)))
    with RunningServer(FOAM) as server, server.client() as client:
        sensor, plain = client.open(), client.open(touch=False)
        for force in (0.5, 1.0, None):
            if force == 0.5:
                found = sensor.step_scene([{**BALL, "force": force}])
            else:
                found = sensor.step_poses({}, forces={"ball": force})
            truth = simulator.step(cs.Scene([body.pressed(force)]))
            assert found.touch is not None
            assert truth.touch is not None
            np.testing.assert_array_equal(found.touch.force, truth.touch.force)
            np.testing.assert_array_equal(found.delta, truth.delta)
        assert plain.step_scene([{**BALL, "force": 0.5}]).touch is None
