"""Decoded by others: the CDR of ROS 2 by mcap_ros2, the bag by rosbags."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import recorded_scenes
from approximate import approx
from mcap.reader import make_reader

import capsense as cs
from capsense.recording.export import export

decoder = pytest.importorskip("mcap_ros2.decoder", reason="needs mcap-ros2-support")

Recorded = tuple[Path, list[cs.Reading]]
MATRIX = "std_msgs/msg/Float64MultiArray"
TYPES = {
    "/sensor/bodies": "capsense_msgs/msg/Body",
    "/sensor/capacitance": MATRIX,
    "/sensor/counts": "capsense_msgs/msg/Counts",
    "/sensor/delta": MATRIX,
    "/sensor/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "/sensor/depth/image": "sensor_msgs/msg/Image",
    "/sensor/depth/permittivity": "sensor_msgs/msg/Image",
    "/sensor/electrodes": "visualization_msgs/msg/MarkerArray",
    "/sensor/markers": "visualization_msgs/msg/MarkerArray",
    "/sensor/shapes": "capsense_msgs/msg/Shape",
    "/sensor/signals": "capsense_msgs/msg/Signals",
    "/sensor/step": "capsense_msgs/msg/Step",
    "/tf": "tf2_msgs/msg/TFMessage",
}


@pytest.fixture(scope="module")
def decoded(recorded: Recorded) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, each with its log time [ns]."""
    out: dict[str, list[tuple[int, Any]]] = {}
    with recorded[0].open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            out.setdefault(channel.topic, []).append((message.log_time, content))
    return out


def at(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def test_what_rosbag2_wants(recorded: Recorded) -> None:
    """Profile, encodings and notes of the channels, and an index with statistics."""
    with recorded[0].open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
        attachments = [a.name for a in reader.iter_attachments()]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert header.profile == "ros2"
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 0
    assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == TYPES
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    for channel in summary.channels.values():
        assert channel.message_encoding == "cdr"
        assert re.fullmatch("RIHS01_[0-9a-f]{64}", channel.metadata["topic_type_hash"])
    assert attachments == ["design.json", "session.json"]
    assert metadata["capsense"]["design"] == "six_patch"


def test_type_hashes() -> None:
    """Hashes as ROS 2 itself has them, in its type description of the message."""
    from capsense.recording.ros import type_hash

    known = {
        "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6"
        "b06203e41c891e17701b1cb597ce6a01",
    }  # fmt: skip
    for name, digest in known.items():
        assert type_hash(name) == f"RIHS01_{digest}"


def test_opens_as_a_bag(recorded: Recorded) -> None:
    """The other reader of bags sees the same topics, and gives the same numbers."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path, readings = recorded
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as bag:
        assert {c.topic: c.msgtype for c in bag.connections} == TYPES
        qos = {c.topic: c.ext.offered_qos_profiles for c in bag.connections}
        only = [c for c in bag.connections if c.topic == "/sensor/delta"]
        found = [bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages(only)]
    for message, reading in zip(found, readings, strict=True):
        assert message.data.tobytes() == reading.delta.tobytes()
    assert {topic: profiles[0].durability.name for topic, profiles in qos.items() if profiles} == {
        f"/sensor/{name}": "TRANSIENT_LOCAL"
        for name in ("bodies", "electrodes", "markers", "shapes")
    }


def test_matrices(recorded: Recorded, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    for name in ("capacitance", "delta"):
        for (_, message), reading in zip(decoded[f"/sensor/{name}"], recorded[1], strict=True):
            assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
                ("row", 6, 36),
                ("column", 6, 6),
            ]
            assert list(message.data) == getattr(reading, name).ravel().tolist()


def test_steps_and_counts(recorded: Recorded, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    for (log_time, step), reading in zip(decoded["/sensor/step"], recorded[1], strict=True):
        assert at(step.header.stamp) == log_time
        assert step.header.frame_id == "sensor"
        assert list(step.capacitance) == reading.capacitance.ravel().tolist()
        assert step.iterations == reading.stats.iterations
        assert len(step.bodies) == len(step.poses)
    codes = [c for _, m in decoded["/sensor/counts"] for c in m.code]
    expected = [c for r in recorded[1] if r.counts is not None for c in r.counts.code.tolist()]
    assert codes == expected
    first = [log_time for log_time, _ in decoded["/sensor/step"]]
    assert first[:3] == [0, 100_000_000, 200_000_000]
    # the second episode begins on a later second, so that nothing lies on top of the first
    assert first[8:10] == [2_000_000_000, 2_050_000_000]


def test_transforms(decoded: dict[str, list[tuple[int, Any]]]) -> None:
    """Poses of the bodies in the sensor's frame, under their names."""
    for k, (log_time, message) in enumerate(decoded["/tf"][:8]):
        scene = recorded_scenes.scene_at(k)
        assert len(message.transforms) == len(scene)
        for i, (t, body) in enumerate(zip(message.transforms, scene, strict=True)):
            assert at(t.header.stamp) == log_time
            assert t.header.frame_id == "sensor"
            assert t.child_frame_id == f"sensor/{body.name or f'body{i}'}"
            v, q = t.transform.translation, t.transform.rotation
            assert (v.x, v.y, v.z) == body.pose.position
            assert (q.x, q.y, q.z, q.w) == body.pose.quaternion


def test_depth_images(decoded: dict[str, list[tuple[int, Any]]]) -> None:
    """Pixels land, through ``p`` and the camera's transform, on the points of the frame."""
    images, infos = decoded["/sensor/depth/image"], decoded["/sensor/depth/camera_info"]
    matter = decoded["/sensor/depth/permittivity"]
    assert len(images) == len(infos) == 4
    for k in range(4):
        frame, (_, image), (_, info) = recorded_scenes.frame_at(k), images[k], infos[k]
        assert (image.height, image.width, image.step, image.encoding) == (24, 32, 128, "32FC1")
        assert image.header.frame_id == "sensor/depth_camera"
        assert list(info.k) == [0.0] * 9
        depth = np.frombuffer(image.data, "<f4").reshape(24, 32)
        (pose,) = [
            t.transform
            for t in decoded["/tf"][8 + k][1].transforms
            if t.child_frame_id == "sensor/depth_camera"
        ]
        v, q = pose.translation, pose.rotation
        camera = cs.Pose.from_unit((v.x, v.y, v.z), (q.x, q.y, q.z, q.w))
        points = camera.inverse().apply(frame.points())
        p = np.array(info.p).reshape(3, 4)
        u, row, one = p @ np.column_stack([points, np.ones(len(points))]).T
        assert (one == 1).all()
        assert np.abs(u - np.rint(u)).max() < 1e-9
        seen = depth[np.rint(row).astype(int), np.rint(u).astype(int)]
        np.testing.assert_allclose(seen, points[:, 2], rtol=1e-6)
        assert np.isfinite(depth).sum() == len(points)
        eps = np.frombuffer(matter[k][1].data, "<f4").reshape(24, 32)
        assert set(eps[np.isfinite(depth)].tolist()) == {np.inf}
        assert (eps[~np.isfinite(depth)] == 0).all()


def test_permittivity_images(sim: cs.Simulator, tmp_path: Path) -> None:
    """Those of a frame of two kinds of matter, which need not be what the reading is of."""
    frame = recorded_scenes.frame_at(0, 4.0)
    with cs.record(tmp_path / "a.mcap", sim) as run:
        run.write(0.0, frame, sim.step(cs.Scene()))
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        content = {c.topic: m for _, c, _, m in reader.iter_decoded_messages()}
    image, matter = content["/sensor/depth/image"], content["/sensor/depth/permittivity"]
    seen = np.isfinite(np.frombuffer(image.data, "<f4"))
    assert set(np.frombuffer(matter.data, "<f4")[seen].tolist()) == {np.inf, 4.0}


def test_markers(decoded: dict[str, list[tuple[int, Any]]]) -> None:
    """Bodies are drawn anew when they change, in their own frames."""
    messages = [m for _, m in decoded["/sensor/markers"]]
    assert 1 < len(messages) < 8
    first = messages[0].markers
    assert (first[0].action, first[0].type) == (3, 1)
    kinds = {m.ns: [] for m in first[1:]}
    for m in first[1:]:
        assert m.header.frame_id == m.ns
        assert m.frame_locked
        kinds[m.ns].append((m.type, round(m.scale.x, 9), round(m.scale.z, 9)))
    assert kinds == {
        "sensor/box": [(1, 0.03, 0.01)],
        "sensor/ball": [(2, 0.024, 0.024)],
        "sensor/finger": [(3, 0.02, 0.05), (2, 0.02, 0.02), (2, 0.02, 0.02)],
        "sensor/rod": [(3, 0.02, 0.02)],
        "sensor/body4": [(2, 0.04, 0.03)],
        "sensor/wedge": [(11, 1.0, 1.0)],
    }


def test_electrodes_light_up(recorded: Recorded, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    """In place; the larger the change of their capacitance, the less green in their colour."""
    design, stamps = cs.load_design("six_patch"), [t for t, _ in decoded["/sensor/step"]]
    for log_time, message in decoded["/sensor/electrodes"]:
        change = np.abs(np.diagonal(recorded[1][stamps.index(log_time)].delta))
        assert [m.ns for m in message.markers] == list(design.electrode_names)
        for marker, electrode in zip(message.markers, design.electrodes, strict=True):
            points = np.array([[p.x, p.y, p.z] for p in marker.points])
            np.testing.assert_array_equal(points, electrode.surface.triangles.reshape(-1, 3))
        green = np.array([m.color.g for m in message.markers])[np.argsort(change)]
        assert (np.diff(green) <= 0).all()
        assert green[-1] < green[0] < 219 / 255


def test_signals(recorded: Recorded, decoded: dict[str, list[tuple[int, Any]]]) -> None:
    """Stamped, named, in femtofarads."""
    names = recorded[1][0].electrode_names
    for (log_time, message), reading in zip(decoded["/sensor/signals"], recorded[1], strict=True):
        assert at(message.header.stamp) == log_time
        found = {c.name: (c.capacitance, c.change) for c in message.channels}
        assert len(found) == 21
        for i, j in ((0, 0), (0, 3), (4, 5)):
            expected = 1e15 * reading.capacitance[i, j], 1e15 * reading.delta[i, j]
            assert found[f"C_{names[i]}_{names[j]}"] == approx(expected, rel=1e-9)


def test_package_of_the_messages() -> None:
    """A ROS 2 package: every message is there, and every package that they name."""
    from capsense import recording
    from capsense.recording.ros import OWN

    folder = Path(recording.__file__).parent / "capsense_msgs"
    texts = {path.stem: path.read_text() for path in folder.glob("msg/*.msg")}
    assert sorted(texts) == sorted(OWN)
    used = set(re.findall(r"^(\w+)/", "\n".join(texts.values()), re.MULTILINE))
    package = ElementTree.parse(folder / "package.xml").getroot()
    build = (folder / "CMakeLists.txt").read_text()
    assert package.findtext("name") == "capsense_msgs"
    assert {e.text for e in package.findall("depend")} == used
    for name in used:
        assert f"find_package({name} REQUIRED)" in build
        assert name in build[build.index("DEPENDENCIES") :]


def test_layout(recorded: Recorded, tmp_path: Path) -> None:
    """Every panel is placed once, and shows topics and channels that are in the file."""
    assert export(cs.open_recording(recorded[0]), tmp_path / "layout.json") == 1
    layout = json.loads((tmp_path / "layout.json").read_text())
    panels = layout["configById"]
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(panels) == ["3D!sensor", "Plot!own", "Plot!pairs"]
    assert set(panels["3D!sensor"]["topics"]) <= set(TYPES)
    paths = [p["value"] for k in ("own", "pairs") for p in panels[f"Plot!{k}"]["paths"]]
    names = recorded[1][0].electrode_names
    known = {f"C_{a}_{b}" for a in names for b in names}
    for path in paths:
        topic, name = re.fullmatch(r'(.*)\.channels\[:\]{name=="(\w+)"}\.change', path).groups()
        assert TYPES[topic] == "capsense_msgs/msg/Signals"
        assert name in known
    assert len(set(paths)) == len(paths) == 6 + 8


def test_attached_sensor(simulators: Callable[..., cs.Simulator], tmp_path: Path) -> None:
    """A moving sensor: its frame in the world, the robot simulator's time, its chip's counts."""
    mujoco = pytest.importorskip("mujoco", reason="needs pip install 'capsense[mujoco]'")
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody>
        <body name="tool" pos="0 0 0.1"><freejoint/><geom type="sphere" size=".03"/></body>
        <body name="arm"><joint type="slide" axis="1 0 0"/><geom type="box" size=".01 .01 .001"
          pos="0 0 -.1"/><site name="pad"/>
          <camera name="pad" projection="orthographic" resolution="24 24" fovy="0.3"
            euler="180 0 0"/></body>
        </worldbody><sensor><rangefinder camera="pad" data="depth"/></sensor></mujoco>"""
    )
    for perception in ("geometry", "depth_camera"):
        data = mujoco.MjData(model)
        data.qvel[-1] = 0.5
        sensor = cs.mujoco.attach(
            model, data, "pad", simulators("six_patch"), perception=perception, readout="fdc1004"
        )
        path = tmp_path / f"{perception}.mcap"
        places = []
        with cs.record(path, sensor) as run:
            for _ in range(2):
                for _ in range(6):
                    mujoco.mj_step(model, data)
                    reading = run.read()
                    places.append(float(data.site_xpos[0, 0]))
                mujoco.mj_resetData(model, data)
                run.reset()
        assert reading.counts is not None
        assert cs.replay(path).same
        steps = list(cs.open_recording(path).steps())
        assert [s.episode for s in steps] == [0] * 6 + [1] * 6
        assert steps[5].time == steps[11].time == approx(6 * model.opt.timestep)
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[decoder.DecoderFactory()])
            found = [d for *_, d in reader.iter_decoded_messages(topics=["/tf"])]
        first = [m.transforms[0] for m in found]
        assert {(t.header.frame_id, t.child_frame_id) for t in first} == {("world", "sensor")}
        assert [t.transform.translation.x for t in first] == places
        assert places[5] > places[0]
