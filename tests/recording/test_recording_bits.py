"""What comes back out of a recording is, to the last bit, what went in."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import recorded_scenes
from hypothesis import given
from hypothesis import strategies as st
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.errors import RecordingError
from capsense.recording.design_json import design_from_json, design_to_json
from capsense.recording.messages import PACKAGE, Messages
from capsense.recording.parts import body_fields, read_body, read_shape, shape_fields

MESSAGES = Messages()
Recorded = tuple[Path, list[cs.Reading]]


def through(body: cs.Body) -> cs.Body:
    """The body, encoded and decoded."""
    shape = MESSAGES.make(f"{PACKAGE}/Shape", id=1, **shape_fields(body.shape))
    shape = MESSAGES.decode(MESSAGES.encode(shape), f"{PACKAGE}/Shape")
    message = MESSAGES.make(f"{PACKAGE}/Body", id=2, shape=1, **body_fields(body))
    message = MESSAGES.decode(MESSAGES.encode(message), f"{PACKAGE}/Body")
    return read_body(message, {1: read_shape(shape)})


@pytest.mark.parametrize("body", recorded_scenes.bodies(), ids=lambda b: type(b.shape).__name__)
def test_bodies(body: cs.Body) -> None:
    again = through(body)
    assert again.material == body.material
    assert (again.grounding, again.name) == (body.grounding, body.name)
    if isinstance(body.shape, cs.TriMesh):
        np.testing.assert_array_equal(again.shape.vertices, body.shape.vertices)
        np.testing.assert_array_equal(again.shape.faces, body.shape.faces)
        np.testing.assert_array_equal(again.shape.grid.values, body.shape.grid.values)
    else:
        assert again.shape == body.shape


@pytest.mark.parametrize(
    "shape", [recorded_scenes.SLAB, recorded_scenes.frame_at(1).scene()[0].shape]
)
def test_layers(shape: cs.Layers) -> None:
    again = through(cs.Body(shape)).shape
    assert isinstance(again, cs.Layers)
    assert (again.size, again.resolution) == (shape.size, shape.resolution)
    assert again.grid.values.tobytes() == shape.grid.values.tobytes()
    for name in ("shape", "origin", "inverse"):
        np.testing.assert_array_equal(getattr(again.grid, name), getattr(shape.grid, name))


def test_damaged_layers_do_not_reach_the_kernels() -> None:
    """Numbers that the kernels take for indices are checked, whatever their type makes of them."""
    fields = shape_fields(recorded_scenes.SLAB)
    for at, value in ((2, -3.0), (3, 1e6), (4, np.nan), (8, -2.0), (9, np.inf)):
        values = fields["values"].copy()
        values[at] = value
        message = MESSAGES.make(f"{PACKAGE}/Shape", id=1, **{**fields, "values": values})
        with pytest.raises(RecordingError, match="damaged"):
            read_shape(message)
    message = MESSAGES.make(f"{PACKAGE}/Shape", id=1, **{**fields, "values": fields["values"][:-1]})
    with pytest.raises(RecordingError, match="damaged"):
        read_shape(message)


@given(
    st.tuples(*[st.floats(-1, 1)] * 3),
    st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: max(map(abs, q)) > 1e-3),
)
def test_poses(position: tuple[float, ...], quaternion: tuple[float, ...]) -> None:
    """Making a pose of its own numbers again would change some of them."""
    pose = cs.Pose(position, quaternion)
    assert cs.Pose.from_unit(pose.position, pose.quaternion) == pose


def test_from_unit_refuses_what_is_none() -> None:
    with pytest.raises(cs.SceneError, match="length is not 1"):
        cs.Pose.from_unit((0, 0, 0), (0, 0, 0, 2.0))


@pytest.mark.parametrize("name", cs.available_designs())
def test_designs(name: str) -> None:
    """All coordinates, exactly; the content hash alone would see only nanometres."""
    design = cs.load_design(name)
    text = design_to_json(design)
    again = design_from_json(text)
    assert design_to_json(again) == text
    assert again.electrode_names == design.electrode_names
    for one, other in zip(design.sheets, again.sheets, strict=True):
        assert one.surface.triangles.tobytes() == other.surface.triangles.tobytes()
        assert one.surface.rims.tobytes() == other.surface.rims.tobytes()


def test_damaged_designs() -> None:
    data = json.loads(design_to_json(cs.load_design("six_patch")))
    data["electrodes"][0]["surface"]["facets"][0]["rings"][0][1][0] += 1e-6
    with pytest.raises(RecordingError, match="hash"):
        design_from_json(json.dumps(data))
    del data["domain"]
    with pytest.raises(RecordingError, match="domain"):
        design_from_json(json.dumps(data))


def test_steps_come_back(recorded: Recorded) -> None:
    path, readings = recorded
    steps = list(cs.open_recording(path).steps())
    assert [s.index for s in steps] == list(range(12))
    assert [s.episode for s in steps] == [0] * 8 + [1] * 4
    assert [s.time for s in steps] == [0.1 * k for k in range(8)] + [0.05 * k for k in range(4)]
    assert (np.diff([s.clock for s in steps]) > 0).all()
    for step, reading in zip(steps, readings, strict=True):
        for name in ("capacitance", "delta", "self_capacitance"):
            a, b = getattr(step.reading, name), getattr(reading, name)
            assert a.tobytes() == b.tobytes()
        assert step.reading.stats == dataclasses.replace(reading.stats, unknowns=0)  # not kept
        assert reading.counts is not None
        if len(reading.counts):
            assert step.reading.counts is not None
            assert step.reading.counts.code.tolist() == reading.counts.code.tolist()
    for k in range(8):
        for one, other in zip(steps[k].scene, recorded_scenes.scene_at(k), strict=True):
            assert one.pose == other.pose
            assert (one.name, one.material, one.grounding) == (
                other.name, other.material, other.grounding,
            )  # fmt: skip


def test_replay_is_the_same_to_the_last_bit(recorded: Recorded) -> None:
    """All shapes, bodies that come and go, a reset, depth frames, and the counts of a chip."""
    path, readings = recorded
    found = cs.replay(path)
    assert found.same
    assert (found.steps, found.differing, found.largest) == (12, 0, 0.0)
    assert found.counts == sum(len(r.counts) for r in readings if r.counts is not None) > 0
    assert found.changed == {}


@pytest.mark.parametrize(
    "options",
    [
        {"frequency": 10e6},
        {"method": "masked"},
        {"preset": "fine"},
    ],
    ids=lambda o: "-".join(o),
)
def test_design_and_settings_are_taken_over(
    options: dict[str, object], tmp_path: Path, field_cache: Path
) -> None:
    """The file is all that a replay needs. With the simulator's defaults it would differ."""
    design, path = tiny_design(), tmp_path / "a.mcap"
    sim = cs.Simulator(design, settings=SETTINGS, cache_dir=field_cache, **options)  # type: ignore[arg-type]
    plain = cs.Simulator(design, settings=SETTINGS, cache_dir=field_cache)
    ball = cs.Body(cs.Sphere(0.012), material="cortical bone")
    differs = False
    with cs.record(path, sim, name="left_wrist") as run:
        for k in range(3):
            scene = cs.Scene([ball.moved(cs.Pose((0.004 * k, 0.0, 0.03)))])
            differs |= bool((run.step(scene, float(k)).delta != plain.step(scene).delta).any())
    assert differs
    assert cs.replay(path, cache_dir=field_cache).same
    session = cs.open_recording(path).session
    assert (session.settings, session.name) == (SETTINGS, "left_wrist")
