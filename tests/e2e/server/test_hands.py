"""Hands over the server: joints in, readings out; the model and the filter are the server's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from running_server import RunningServer

import capsense as cs
from capsense.errors import ProtocolError, SceneError
from capsense.humans import Build, HandFilter, OneEuroFilter, TrackedHand
from capsense.server.messages import MessageTable, read_hands, read_open, read_scene

DOWN = cs.Pose.from_matrix(np.stack([(0, 1, 0), (0, 0, -1), (-1, 0, 0)], axis=1))
"""The palm over the sensor, the fingers along +x."""


def over(height: float, side: str = "right", x: float = -0.1) -> cs.Pose:
    turn = DOWN if side == "right" else cs.Pose.from_euler((0, 0, 0), (np.pi, 0, 0)) @ DOWN
    return cs.Pose((x, 0.0, height)) @ turn


def message(**content: Any) -> MessageTable:
    base = {"type": "hands", "sensor": 0, "sequence": 1, "time": 0.5, "hands": []}
    return MessageTable({**base, **content}, "message", "hands")


@pytest.mark.parametrize("convention", ["openxr", "mediapipe", "leap"])
def test_joints_are_sensed_as_the_same_hand_here(served: RunningServer, convention: str) -> None:
    """Frame by frame, with the filter, a missing joint and a gap; to the last bit."""
    rng = np.random.default_rng(1)
    model = TrackedHand(Build("female"), "right", convention)
    smooth = HandFilter(OneEuroFilter(2.0, 30.0), hold=0.05, fade=0.05)
    simulator = cs.Simulator("six_patch")
    options = {
        "build": {"sex": "female"},
        "filter": {"min_cutoff": 2.0, "beta": 30.0, "hold": 0.05, "fade": 0.05},
    }
    with served.client() as client:
        sensor = client.open(material="human", grounding=100e-12, hands=options)
        changes = []
        for k in range(12):
            joints: np.ndarray | None = None
            if not 5 <= k < 9:
                joints = model.joints({"index_pip_flexion": 0.1 * k}, over(0.06 - 0.002 * k))
                joints = joints + (1.0 if convention == "leap" else 1e-3) * rng.normal(
                    size=joints.shape
                )
                joints[9 if k == 2 else []] = np.nan
            found = sensor.step_hands({"right": joints}, 0.02 * k, convention=convention)
            sample = smooth.update(0.02 * k, None if joints is None else model.landmarks(joints))
            bodies = model.bodies(sample.landmarks, conductor="hands")
            here = simulator.step(cs.Scene(bodies))
            np.testing.assert_array_equal(found.delta, here.delta)
            changes.append(found.delta[1, 1])
        assert max(changes) > 5e-15


def test_hands_beside_other_bodies(served: RunningServer) -> None:
    """Both hands, a ball that moves between them; then only the ball is left."""
    models = {side: TrackedHand(side=side) for side in ("left", "right")}  # type: ignore[arg-type]
    ball = {"name": "ball", "shape": "sphere", "radius": 0.02, "material": "steel",
            "pose": {"position": [0.05, 0, 0.05]}}  # fmt: skip
    simulator = cs.Simulator("six_patch")
    with served.client() as client:
        sensor = client.open(
            material="human", grounding="floating",
            hands={"filter": {"hold": 0.01, "fade": 0, "retreat": None}},
        )  # fmt: skip
        alone = sensor.step_scene([ball], 0.0).delta
        joints = {"left": models["left"].joints({}, over(0.05, "left", -0.08)),
                  "right": models["right"].joints({}, over(0.09))}  # fmt: skip
        both = sensor.step_hands(joints, 0.1).delta
        moved = sensor.step_poses({"ball": {"position": [0.05, 0.01, 0.05]}}, 0.2).delta
        for found, y in ((both, 0.0), (moved, 0.01)):
            body = cs.Body(cs.Sphere(0.02), cs.Pose((0.05, y, 0.05)), name="ball")
            bodies = [
                b for side in ("left", "right")
                for b in models[side].bodies(
                    models[side].landmarks(joints[side]), grounding="floating", conductor="hands"
                )
            ]  # fmt: skip
            here = simulator.step(cs.Scene([body, *bodies])).delta
            np.testing.assert_allclose(found, here, rtol=1e-9, atol=1e-21)
        sensor.step_hands({}, 0.15)
        left = sensor.step_hands({}, 0.3).delta
        sensor.step_scene([ball], 0.4)
        np.testing.assert_allclose(sensor.step_scene([ball], 0.5).delta, alone, atol=1e-20)
        assert abs(left - alone).max() > 0  # the ball had moved
        sensor.step_hands(joints, 0.6)
        sensor.reset()
        np.testing.assert_allclose(sensor.step_scene([ball], 0.0).delta, alone, atol=1e-20)


def test_watchers_see_the_hands() -> None:
    """As capsules of one conductor in a scene that can be read again."""
    model = TrackedHand()
    with (
        RunningServer("six_patch", watch=True) as server,
        server.client() as client,
        server.client() as other,
    ):
        sensor = client.open(material="human", grounding=100e-12)
        other.ask("watching", type="watch")
        sensor.step_hands({"right": model.joints({}, over(0.05))}, 0.0)
        seen = other.receive()
        assert isinstance(seen, dict)
        read = read_scene(MessageTable(seen, "message", "scene"), 64)
        wanted = model.bodies(model.landmarks(model.joints({}, over(0.05))))
        assert len(read.bodies) == len(wanted) == 19
        for one, two in zip(read.bodies, wanted, strict=True):
            assert (one.name, one.conductor, one.grounding) == (two.name, "hands", 100e-12)
            np.testing.assert_allclose(one.pose.matrix, two.pose.matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("hand", "match"),
    [
        ({}, "side"),
        ({"side": "both"}, "side = 'both' is not known"),
        ({"side": "left", "convention": "kinect"}, "convention"),
        ({"side": "left", "tip": "nail"}, "tip"),
        ({"side": "left", "joints": [[0, 0, 0]]}, r"shape \(1, 3\); give \(26, 3\)"),
        ({"side": "left", "joints": 3}, "no position"),
        ({"side": "left", "joints": [["x", 0, 0]] * 26}, "no position"),
        ({"side": "left", "radii": [1, 2]}, "26 numbers"),
        ({"side": "left", "wrist": [1, 2]}, "wrist"),
        ({"side": "left", "confidence": 2}, "confidence = 2"),
        ({"side": "left", "more": 1}, "unknown key 'more'"),
    ],
)
def test_bad_hands(hand: dict[str, Any], match: str) -> None:
    with pytest.raises((ProtocolError, SceneError), match=match):
        read_hands(message(hands=[hand]))


def test_bad_messages() -> None:
    for content, match in (
        ({"hands": [{"side": "left"}] * 2}, "two left hands"),
        ({"hands": [{"side": "left"}] * 3}, "3 hands"),
        ({"hands": {}}, "array"),
        ({"more": 1}, "unknown key"),
    ):
        with pytest.raises(ProtocolError, match=match):
            read_hands(message(**content))
    bare = {"type": "hands", "sensor": 0, "sequence": 1, "hands": []}
    with pytest.raises(ProtocolError, match="missing key 'time'"):
        read_hands(MessageTable(bare, "message", "hands"))
    for options, match in (
        ({"size": 1}, "unknown key 'size'"),
        ({"build": {"sex": "other"}}, "sex is 'other'"),
        ({"build": {"height": 1.7}}, "unknown key 'height'"),
        ({"filter": {"hold": "long"}}, "hold is 'long'"),
        ({"filter": {"retreat": [1]}}, "retreat is"),
        ({"filter": {"beta": -1}}, "beta = -1"),
    ):
        opened = {"type": "open", "sensor": 0, "hands": options}
        with pytest.raises((ProtocolError, SceneError), match=match):
            read_open(MessageTable(opened, "message", "open"))


def test_a_bad_hand_leaves_the_connection_open(served: RunningServer) -> None:
    model = TrackedHand()
    with served.client() as client:
        sensor = client.open(material="human")
        with pytest.raises(ProtocolError, match="openxr gives metres") as caught:
            sensor.step_hands({"right": 1e3 * model.joints({}, over(0.05))}, 0.0)
        assert caught.value.code == "scene"
        good = sensor.step_hands({"right": model.joints({}, over(0.05))}, 0.1)
        assert good.delta[1, 1] > 1e-15
        late = sensor.step_hands({"right": None}, 0.05)  # a frame of the past moves nothing
        np.testing.assert_array_equal(late.delta, good.delta)
