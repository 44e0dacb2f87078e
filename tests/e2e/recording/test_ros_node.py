"""``capsense ros``: from bags, in which others check what it wrote, and live with a DDS peer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_recording_live import LOCAL

import capsense as cs
from capsense.__main__ import main
from capsense.cli import BAD_INPUT, OK
from capsense.recording import ros
from capsense.recording.node import RosSensors
from capsense.scenario import Excitation, MovingBody, Scenario, load_scenario

S = 10**9
SCENARIO = """
name = "a hand over a patch"
design = "patch"
sample_rate = 20

[[body]]
name = "hand"
shape = "sphere"
radius = 0.02
material = "human"
grounding = 100e-12

[body.trajectory]
waypoints = [[0, 0, 0.1], [0.02, 0, 0.05]]
speed = 0.1
euler = [[0, 0, 0], [0, 20, 30]]

[[body]]
name = "table"
shape = "box"
size = [0.3, 0.3, 0.02]
material = "wood"
pose = { position = [0, 0, 0.15] }
"""
HERE = ["--frame", "hand=sensor/hand", "--frame", "table=sensor/table"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "hand.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture
def scenario(file: Path) -> Scenario:
    return load_scenario(file)


def bag_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, each with its time [ns], as ``rosbags`` reads them."""
    from rosbags.highlevel import AnyReader

    out: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as bag:
        for connection, stamp, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)
            out.setdefault(connection.topic, []).append((stamp, message))
    return out


def points_of(cloud: Any) -> np.ndarray[Any, Any]:
    """The points of a PointCloud2, by its own fields."""
    codes = {7: "<f4", 8: "<f8", 2: "<u1"}
    kind = np.dtype({
        "names": [f.name for f in cloud.fields],
        "formats": [codes[f.datatype] for f in cloud.fields],
        "offsets": [f.offset for f in cloud.fields],
        "itemsize": cloud.point_step,
    })  # fmt: skip
    return np.frombuffer(cloud.data.tobytes(), kind)


def test_a_recording_is_felt_again(
    tmp_path: Path, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The transforms of a recording make the recorded readings again, to the last bit."""
    one, two = tmp_path / "run.mcap", tmp_path / "felt.mcap"
    assert main(["record", str(file), "-o", str(one), "-q"]) == OK
    command = ["ros", str(file), "--bag", str(one), "-o", str(two), "--readout", "fdc1004", *HERE]
    assert main(command) == OK
    steps = list(cs.open_recording(one).steps())
    assert f"{len(steps)} readings in" in capsys.readouterr().out
    found = bag_of(two)
    for topic, name in (("delta", "delta"), ("capacitance", "capacitance")):
        got = found[f"/sensor/{topic}"]
        assert [t for t, _ in got] == [round(s.time * S) for s in steps]
        for (_, message), step in zip(got, steps, strict=True):
            assert message.data.tobytes() == getattr(step.reading, name).tobytes()
    assert ros.encode(found["/tf"][3][1]) == ros.encode(bag_of(one)["/tf"][3][1])
    cloud = found["/sensor/points"][-1][1]
    assert cloud.header.frame_id == "sensor"
    assert (cloud.header.stamp.sec, cloud.header.stamp.nanosec) == divmod(
        round(steps[-1].time * S), S
    )
    points = points_of(cloud)
    assert points["change"].tolist() == np.diag(steps[-1].reading.delta).tolist()
    assert points["x"].sum() < 1e-6  # the electrodes lie around the middle
    assert np.ptp(points["x"]) > 5e-3
    about = json.loads(found["/sensor/about"][0][1].data)
    assert about["electrodes"] == list(steps[0].reading.electrode_names)
    assert about["channels"] == list(steps[0].reading.electrode_names)
    chip = points_of(found["/sensor/channel_points"][-1][1])
    assert found["/sensor/counts"][-1][1].data.tolist() == chip["code"].astype(int).tolist()
    assert abs(chip["capacitance"][0] - steps[-1].reading.self_capacitance[0]) < 200e-15
    assert main(command) == BAD_INPUT  # it is there already
    assert "there already" in capsys.readouterr().err
    with pytest.raises(cs.RecordingError):
        cs.open_recording(two)


def test_frames_that_are_not_there(
    tmp_path: Path, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is read, and nothing left; the message names the frames that there are."""
    one, two = tmp_path / "run.mcap", tmp_path / "felt.mcap"
    main(["record", str(file), "-o", str(one), "-q"])
    assert main(["ros", str(file), "--bag", str(one), "-o", str(two), *HERE[:2]]) == BAD_INPUT
    told = capsys.readouterr().err
    assert "nobody tells where frame 'table' is" in told
    assert "'sensor/table'" in told
    assert not two.exists()
    options = ["--leave-out", *HERE[:2]]
    assert main(["ros", str(file), "--bag", str(one), "-o", str(two), *options]) == OK
    told = capsys.readouterr().err
    assert "frame 'table' is: left out" in told
    simulator = cs.Simulator("patch")
    hand = next(iter(cs.open_recording(one).steps())).scene["hand"]
    first = bag_of(two)["/sensor/delta"][0][1]
    assert first.data.tobytes() == simulator.step(cs.Scene([hand])).delta.tobytes()


def sensors(scenario: Scenario, **options: Any) -> tuple[RosSensors, list[str]]:
    made = RosSensors(scenario, {"pad": "pad"}, {"hand": "h"}, **options)
    told: list[str] = []
    made.warn = told.append  # type: ignore[assignment]
    return made, told


def tell(made: RosSensors, time_s: float, *frames: str) -> None:
    """Say where frames are at a time, in the sensor's."""
    place = ((0.0, 0.0, 0.08), (0.0, 0.0, 0.0, 1.0))
    given = [((divmod(round(time_s * S), S), "pad"), f, place) for f in frames]
    made.hear(ros.make("tf2_msgs/msg/TFMessage", transforms=given), fixed=False)


def topics(made: RosSensors, time_s: float) -> set[str]:
    return {topic for topic, _ in made.tick(round(time_s * S))}


def test_time_out(scenario: Scenario) -> None:
    """Silent until all is there, and when it is old; told once each; diagnostics say so."""
    made, told = sensors(scenario, timeout=0.2)
    assert topics(made, 5.0) == {"/pad/about", "/diagnostics"}
    assert told == []  # they may be on their way
    tell(made, 5.1, "h", "table")
    assert "/pad/delta" in topics(made, 5.1)
    assert "/pad/delta" in topics(made, 5.3)
    out = dict(made.tick(round(5.31 * S)))
    assert set(out) == {"/diagnostics"}
    assert out["/diagnostics"].status[0].level == 3
    assert "0.21 s old" in out["/diagnostics"].status[0].message
    for k in range(5):
        topics(made, 5.4 + 0.1 * k)
    assert len(told) == 1
    assert "body hand: its transform is 0.21 s old" in told[0]
    tell(made, 5.9, "h", "table")
    assert "/pad/delta" in topics(made, 5.9)
    assert "again" in told[1]
    tell(made, 7.0, "h")
    topics(made, 6.0)
    assert "0.1 s old" not in told[-1]
    assert "1 s ahead of this clock" in told[-1]


def test_time_goes_back(scenario: Scenario) -> None:
    """A simulator that begins anew: all transforms are forgotten, and the chip restarts."""
    made, told = sensors(scenario, readout="fdc1004")
    tell(made, 9.0, "h", "table")
    assert "/pad/counts" in topics(made, 9.0)
    assert "/pad/counts" not in topics(made, 1.0)
    assert "went back by 8 s" in told[0]
    tell(made, 1.1, "h", "table")
    assert "/pad/counts" in topics(made, 1.1)


def test_a_scene_that_cannot_be_solved(scenario: Scenario) -> None:
    """One wrong pose does not end the node; it says so, and goes on."""
    made, told = sensors(scenario)
    place = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    tell(made, 1.0, "table")
    inside = [((divmod(S, S), "pad"), "h", place)]
    made.hear(ros.make("tf2_msgs/msg/TFMessage", transforms=inside), fixed=False)
    made.tick(S)
    bad = [((divmod(S, S), "pad"), "h", ((float("nan"), 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))]
    made.hear(ros.make("tf2_msgs/msg/TFMessage", transforms=bad), fixed=False)
    assert "it is ignored" in told[-1]
    tell(made, 1.2, "h", "table")
    assert "/pad/delta" in topics(made, 1.2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frame", "hnad=x"], "did you mean 'hand'"),
        (["--sensor", "1=x"], "name is '1'"),
        (["--frame", "hand=a", "--frame", "hand=b"], "--frame names one twice"),
        (["-o", "x.mcap"], "--output goes with --bag only"),
        (["--bag", "no.mcap", "-o", "x.csv"], "ends in .mcap"),
        (["--bag", "no.mcap", "-o", "x.mcap"], "there is no bag no.mcap"),
        (["--bag", "hand.toml", "-o", "x.mcap"], "is no bag that can be read"),
        (["--bag", "no.mcap", "-o", "x.mcap", "--domain", "1"], "goes with live topics only"),
        (["--readout", "fdc1005"], "unknown chip 'fdc1005'"),
        (["--domain", "233"], "give a number from 0 to 232"),
    ],
)
def test_refusals(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    options: list[str], message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(file.parent)
    assert main(["ros", "hand.toml", *options]) == BAD_INPUT
    assert message in capsys.readouterr().err
    assert not Path("x.mcap").exists()


def test_domain_of_the_environment(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "two")
    assert main(["ros", str(file)]) == BAD_INPUT
    assert "ROS_DOMAIN_ID is 'two'" in capsys.readouterr().err


PEER = """
import json, sys, time
from dataclasses import dataclass
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, int64, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32
@dataclass
class Clock(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    clock: Time
@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str
@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64
@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64
@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion
@dataclass
class Stamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform
@dataclass
class TF(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[Stamped]
@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32
@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32
@dataclass
class Floats(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    layout: Layout
    data: sequence[float64]
@dataclass
class Whole(IdlStruct, typename="std_msgs::msg::dds_::Int64MultiArray_"):
    layout: Layout
    data: sequence[int64]
@dataclass
class Field(IdlStruct, typename="sensor_msgs::msg::dds_::PointField_"):
    name: str
    offset: uint32
    datatype: uint8
    count: uint32
@dataclass
class Cloud(IdlStruct, typename="sensor_msgs::msg::dds_::PointCloud2_"):
    header: Header
    height: uint32
    width: uint32
    fields: sequence[Field]
    is_bigendian: bool
    point_step: uint32
    row_step: uint32
    data: sequence[uint8]
    is_dense: bool
@dataclass
class Text(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str

sim = "sim" in sys.argv
here = DomainParticipant({domain})
reliable = Policy.Reliability.Reliable(duration(seconds=1))
volatile, latched = Policy.Durability.Volatile, Policy.Durability.TransientLocal
usual = Qos(reliable, volatile, Policy.History.KeepLast(10))
many = Qos(reliable, volatile, Policy.History.KeepLast(100))
last = Qos(reliable, latched, Policy.History.KeepLast(1))

def reader(topic, kind, qos=usual):
    return DataReader(here, Topic(here, "rt" + topic, kind, qos=qos), qos=qos)

def writer(topic, kind, qos):
    return DataWriter(here, Topic(here, "rt" + topic, kind, qos=qos), qos=qos)

def transform(parent, child, stamp, x, y, z):
    at = Header(Time(*divmod(stamp, 10**9)), parent)
    turn = Quaternion(0.0, 0.0, 0.0, 1.0)
    return TF([Stamped(at, child, Transform(Vector3(x, y, z), turn))])

fixed = writer("/tf_static", TF, last)
fixed.write(transform("flange", "pad", 0, 0.0, 0.0, 0.01))
moving, clock = writer("/tf", TF, many), writer("/clock", Clock, usual)
readers = dict(delta=reader("/wrist/delta", Floats), counts=reader("/wrist/counts", Whole),
               points=reader("/wrist/points", Cloud), about=reader("/wrist/about", Text, last))
found, begun = {{}}, time.monotonic()
while len(found) < 4 and time.monotonic() < begun + 150:
    now = round((time.monotonic() - begun) * 1e9) if sim else time.time_ns()
    if sim:
        clock.write(Clock(Time(*divmod(now, 10**9))))
    moving.write(transform("world", "flange", now, 0.5, 0.0, 0.0))
    moving.write(transform("world", "hand_link", now, 0.51, 0.0, 0.06))
    moving.write(transform("flange", "table", now, 0.0, 0.0, 0.16))
    for name, one in readers.items():
        for sample in one.take(N=10):
            found[name] = sample
    time.sleep(0.02)
cloud = found["points"]
print(json.dumps(dict(
    delta=list(found["delta"].data), labels=[d.label for d in found["delta"].layout.dim],
    counts=list(found["counts"].data), about=found["about"].data,
    frame=cloud.header.frame_id, stamp=cloud.header.stamp.sec, width=cloud.width,
    late=now / 1e9 - cloud.header.stamp.sec - 1e-9 * cloud.header.stamp.nanosec,
)))
"""


@pytest.mark.parametrize("clock", ["system", "sim"])
def test_live(file: Path, clock: str) -> None:
    """A peer that has the types by hand publishes /tf, /tf_static, /clock, and hears readings."""
    pytest.importorskip("cyclonedds", reason="needs pip install 'capsense[live]'")
    domain = 79 if clock == "sim" else 78
    environment = {**os.environ, "CYCLONEDDS_URI": LOCAL, "ROS_DOMAIN_ID": str(domain)}
    command = ["ros", str(file), "--sensor", "wrist=pad", "--frame", "hand=hand_link"]
    command += ["--readout", "fdc1004", *(["--sim-time"] if clock == "sim" else [])]
    node = subprocess.Popen(
        [sys.executable, "-m", "capsense", *command],
        env=environment, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        time.sleep(0.5)
        peer = subprocess.run(
            [sys.executable, "-c", PEER.format(domain=domain), clock],
            env=environment, capture_output=True, text=True, timeout=200, check=False,
        )  # fmt: skip
        assert peer.returncode == 0, peer.stderr
        node.send_signal(signal.SIGINT)
        _, told = node.communicate(timeout=30)
    finally:
        node.kill()
        node.wait()
    assert node.returncode == OK, told
    found = json.loads(peer.stdout)
    bodies = load_scenario(file).bodies
    hand = bodies[0].body.moved(cs.Pose((0.01, 0.0, 0.05)))
    table = bodies[1].body.moved(cs.Pose((0.0, 0.0, 0.15)))
    expected = cs.Simulator("patch").step(cs.Scene([hand, table])).delta.ravel()
    np.testing.assert_allclose(found["delta"], expected, rtol=1e-9, atol=1e-24)
    assert found["labels"] == ["row", "column"]
    assert found["frame"] == "pad"
    assert found["width"] == len(found["counts"]) == 4
    assert json.loads(found["about"])["bodies"] == {"hand": "hand_link", "table": "table"}
    assert -0.2 < found["late"] < 10.0  # the clocks lie years apart
    assert "readings" in told


def write_bag(path: Path, kind: str) -> None:
    """A bag as ``rosbags`` writes it: a still arm, a hand that moves, a clock that began at 100 s.

    Args:
        path: Where.
        kind: ``"sqlite"``, ``"mcap"`` or ``"ros1"``.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    old = kind == "ros1"
    store: Any = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    if old:
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    storage = {"sqlite": "SQLITE3", "mcap": "MCAP"}
    writer: Any = (
        rosbag1.Writer(path)
        if old
        else rosbag2.Writer(
            path, version=8, storage_plugin=getattr(rosbag2.StoragePlugin, storage[kind])
        )
    )
    of = store.types

    def transform(parent: str, child: str, stamp: int, x: float, z: float) -> Any:
        time = of["builtin_interfaces/msg/Time"](*divmod(stamp, S))
        head = [time, parent]
        header = of["std_msgs/msg/Header"](*([0, *head] if old else head))
        place = of["geometry_msgs/msg/Vector3"](x, 0.0, z)
        turn = of["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        moved = of["geometry_msgs/msg/Transform"](place, turn)
        return of["geometry_msgs/msg/TransformStamped"](header, child, moved)

    with writer:
        lines = {
            topic: writer.add_connection(topic, kind_of, typestore=store)
            for topic, kind_of in (
                ("/tf_static", "tf2_msgs/msg/TFMessage"),
                ("/tf", "tf2_msgs/msg/TFMessage"),
                ("/clock", "rosgraph_msgs/msg/Clock"),
            )
        }

        def put(topic: str, stamp: int, message: Any) -> None:
            name = message.__msgtype__
            raw = store.serialize_ros1(message, name) if old else store.serialize_cdr(message, name)
            writer.write(lines[topic], stamp, raw)

        fixed = [
            transform("base", "left", 0, 0.0, 0.0), transform("base", "right", 0, 0.2, 0.01),
            transform("base", "table", 0, 0.0, 0.16),
        ]  # fmt: skip
        put("/tf_static", 0, of["tf2_msgs/msg/TFMessage"](fixed))
        for k in range(11):
            stamp = k * S // 20
            clock = of["builtin_interfaces/msg/Time"](*divmod(100 * S + stamp, S))
            put("/clock", 3 * S + stamp, of["rosgraph_msgs/msg/Clock"](clock))
            hand = transform("base", "hand", 100 * S + stamp, 0.01 * k, 0.06)
            put("/tf", 3 * S + stamp + 1, of["tf2_msgs/msg/TFMessage"]([hand]))


@pytest.mark.parametrize("kind", ["sqlite", "mcap", "ros1"])
def test_bags_of_others(tmp_path: Path, file: Path, kind: str) -> None:
    """Two sensors, fixed frames, a simulator's clock; every kind of bag."""
    bag, out = tmp_path / ("drive.bag" if kind == "ros1" else "drive"), tmp_path / "felt.mcap"
    write_bag(bag, kind)
    command = ["ros", str(file), "--bag", str(bag), "-o", str(out), "--sim-time", "-q"]
    assert main([*command, "--sensor", "left=left", "--sensor", "right_arm=right"]) == OK
    found = bag_of(out)
    left, right = found["/left/delta"], found["/right_arm/delta"]
    times = [stamp for stamp, _ in left]
    assert times == [100 * S + k * S // 20 for k in range(11)]
    simulator = cs.Simulator("patch")
    hand, table = (b.body for b in load_scenario(file).bodies)
    for k, ((_, one), (_, other)) in enumerate(zip(left, right, strict=True)):
        for message, x, z in ((one, 0.0, 0.0), (other, 0.2, 0.01)):
            bodies = [
                hand.moved(cs.Pose((0.01 * k - x, 0.0, 0.06 - z))),
                table.moved(cs.Pose((-x, 0.0, 0.16 - z))),
            ]
            expected = simulator.step(cs.Scene(bodies)).delta
            np.testing.assert_allclose(message.data, expected.ravel(), rtol=1e-9, atol=1e-24)
    assert set(found) >= {"/tf", "/tf_static", "/diagnostics", "/left/about", "/right_arm/points"}
    strict = ["--force", "--rate", "40", "--timeout", "0.01", "--sensor", "left=left"]
    assert main([*command, *strict]) == OK  # in between, the hand's transform is 25 ms old
    assert [stamp for stamp, _ in bag_of(out)["/left/delta"]] == times


def test_missing_cyclonedds(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cs.ExperimentalWarning)
        assert main(["ros", str(file), "--duration", "0.1"]) == BAD_INPUT
    assert "capsense[live]" in capsys.readouterr().err


def test_touch(foam_field: cs.Design) -> None:
    """A ball that sinks into a foam: forces and compressions, and what a chip's detector says."""
    ball = cs.Body(cs.Sphere(0.01), cs.Pose(), "steel", name="ball")
    body = MovingBody(ball)
    scenario = Scenario(
        name="ball", design=foam_field, bodies=(body,), sample_rate=50.0, duration=1.0,
        excitation=Excitation.MATRIX,
    )  # fmt: skip
    made = RosSensors(scenario, {"pad": "pad"}, {}, readout="mpr121")
    simulator = cs.Simulator(foam_field)
    out: dict[str, Any] = {}
    places = [0.05] * 30 + [0.0115] * 30
    for k, z in enumerate(places):
        place = ((-0.012, 0.0, z), (0.0, 0.0, 0.0, 1.0))
        given = [((divmod(k * S // 50, S), "pad"), "ball", place)]
        made.hear(ros.make("tf2_msgs/msg/TFMessage", transforms=given), fixed=False)
        out = dict(made.tick(k * S // 50))
        scene = cs.Scene([ball.moved(cs.Pose((-0.012, 0.0, z)))])
        reading = simulator.step(scene, time=k / 50)
        if k == 29:
            assert not out["/pad/touched"].data.any()
            assert out["/pad/touch_total"].data == 0.0
    assert reading.touch is not None
    assert reading.touch.total > 0.01
    assert out["/pad/touch_total"].data == reading.touch.total
    rows = out["/pad/touch"].data.reshape(2, -1)
    np.testing.assert_array_equal(rows, [reading.touch.force, reading.touch.compression])
    points = points_of(out["/pad/points"])
    np.testing.assert_array_equal(points["compression"], reading.touch.compression)
    touched = out["/pad/touched"].data
    assert touched[int(np.argmax(reading.touch.force))] == 1
    assert points_of(out["/pad/channel_points"])["touched"].tolist() == touched.tolist()
