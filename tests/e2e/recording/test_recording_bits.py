"""What comes back out of a recording is, to the last bit, what went in."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded_scenes
from hypothesis import given
from hypothesis import strategies as st
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.codec import (
    body_fields,
    design_from_json,
    design_to_json,
    read_body,
    read_rest,
    read_shape,
    shape_fields,
)
from capsense.errors import RecordingError
from capsense.recording import describe
from capsense.recording.ros import PACKAGE, Moment, StepMessages, decode, encode, make
from capsense.scene import RestSurface, SurfaceMesh, Ties

Recorded = tuple[Path, list[cs.Reading]]


def through(body: cs.Body) -> cs.Body:
    """The body, encoded and decoded."""
    shape = make(f"{PACKAGE}/Shape", id=1, **shape_fields(body.shape))
    shape = decode(encode(shape), f"{PACKAGE}/Shape")
    message = make(f"{PACKAGE}/Body", id=2, shape=1, **body_fields(body))
    message = decode(encode(message), f"{PACKAGE}/Body")
    return read_body(message, {1: read_shape(shape)})


@pytest.mark.parametrize("body", recorded_scenes.bodies(), ids=lambda b: type(b.shape).__name__)
def test_bodies(body: cs.Body) -> None:
    again = through(body)
    assert again.material == body.material
    assert (again.grounding, again.name) == (body.grounding, body.name)
    assert again.conductor is body.conductor is None
    assert through(dataclasses.replace(body, conductor="p")).conductor == "p"
    if isinstance(body.shape, cs.TriMesh):
        np.testing.assert_array_equal(again.shape.vertices, body.shape.vertices)
        np.testing.assert_array_equal(again.shape.faces, body.shape.faces)
    else:
        assert again.shape == body.shape


@pytest.mark.parametrize(
    "shape", [recorded_scenes.SLAB, recorded_scenes.frame_at(1).scene()[0].shape]
)
def test_layers(shape: cs.Layers) -> None:
    again = through(cs.Body(shape)).shape
    assert isinstance(again, cs.Layers)
    assert (again.size, again.resolution) == (shape.size, shape.resolution)
    assert again.front.tobytes() == shape.front.tobytes()
    assert again.back.tobytes() == shape.back.tobytes()


@pytest.mark.parametrize(
    "grounding", ["local", Ties(1e-10, 2e-11), Ties(0.0, float("inf")), Ties(1e-12)]
)
def test_ties_to_a_local_ground(grounding: object) -> None:
    body = cs.Body(cs.Sphere(0.01), grounding=grounding)
    assert through(body).grounding == grounding


def shape_message(**fields: object) -> Any:
    """A ``Shape`` message that was written and read; fields not given are empty."""
    none = {"sizes": np.empty(0), "vertices": np.empty(0)}
    none |= {"faces": np.empty(0, np.uint32), "values": np.empty(0, np.float32)}
    message = make(f"{PACKAGE}/Shape", **{"id": 1, **none, **fields})
    return decode(encode(message), f"{PACKAGE}/Shape")


def test_surfaces() -> None:
    """What is kept is written once, and shared again by what is read."""
    vertices = np.random.default_rng(0).normal(size=(5, 3))
    rest = RestSurface(vertices, [[0, 1, 2], [2, 3, 4]])
    kept = read_rest(shape_message(**shape_fields(rest)))
    assert kept.vertices.tobytes() == rest.vertices.tobytes()
    np.testing.assert_array_equal(kept.faces, rest.faces)
    for k in range(2):
        shape = SurfaceMesh(vertices + 0.1 * k, rest)
        message = shape_message(**shape_fields(shape, 7))
        assert len(message.faces) == 0
        again = read_shape(message, {7: kept})
        assert again.rest is kept
        assert again.vertices.tobytes() == shape.vertices.tobytes()
    with pytest.raises(RecordingError, match="shape 1 is damaged"):
        read_shape(message, {8: kept})
    with pytest.raises(RecordingError, match="damaged: vertices have shape"):
        read_shape(shape_message(kind="surface", sizes=np.array([7.0])), {7: kept})
    with pytest.raises(RecordingError, match="damaged: faces have shape"):
        read_rest(shape_message(kind="rest", vertices=vertices.ravel()))


def test_steps_of_a_deforming_surface(sim: cs.Simulator) -> None:
    """Of a surface that moves, only the vertices come again; a reader puts all together."""
    session = describe(sim, "sensor")
    writer = StepMessages(session)
    foil = cs.DeformableSurface(np.eye(3), [[0, 1, 2]], material="steel", name="foil")
    bodies, kinds = [], []
    shapes: dict[int, Any] = {}
    rests: dict[int, RestSurface] = {}
    for k in range(3):
        foil.vertices = np.eye(3) * (1 + k)
        out = writer.of(Moment(k, 0, 0.0), cs.Scene([foil.body()]), sim.empty, None, None)
        (number,) = out[-1][1].bodies
        for topic, m in out:
            if topic == "/sensor/bodies":
                assert m.id == number
                bodies.append(read_body(m, shapes))
            elif topic == "/sensor/shapes":
                if m.kind == "rest":
                    rests[m.id] = read_rest(m)
                else:
                    shapes[m.id] = read_shape(m, rests)
        kinds.append([m.kind for topic, m in out if topic == "/sensor/shapes"])
    assert kinds == [["rest", "surface"], ["surface"], ["surface"]]
    for k, body in enumerate(bodies):
        np.testing.assert_array_equal(body.shape.vertices, np.eye(3) * (1 + k))
        assert body.shape.rest is bodies[0].shape.rest


def old_layers() -> dict[str, Any]:
    """A message as capsense wrote it until layers became plain: a cropped grid in one array."""
    slots, rows, columns = 2, 5, 6
    fields = np.full((slots, rows, columns, 3), (0.07, 0.08, -1.0), np.float32)
    fields[0, 1:4, 1:5] = (0.05, 0.07, 0.5)
    fields[1, 2, 3] = (0.1, 0.2, 0.25)
    header, table, blocks = np.ones(2), np.ones(10 * slots), np.ones(4 * 4 * slots)
    values = np.concatenate([header, table, fields.ravel(), blocks]).astype(np.float32)
    # an image of 8 rows of 10 mm and 10 columns of 20 mm; the grid begins in row 1, column 3
    sizes = [
        0.2,
        0.08,
        8,
        10,
        -0.1 + 3.5 * 0.02,
        -0.04 + 1.5 * 0.01,
        0.0,
        50.0,
        slots,
        rows,
        columns,
    ]
    return {"kind": "layers", "sizes": np.array(sizes), "values": values}


def test_layers_of_old_recordings() -> None:
    """Fronts and backs of the pixels that were hit; nothing of what was carried on around them."""
    shape = read_shape(shape_message(**old_layers()))
    assert isinstance(shape, cs.Layers)
    assert (shape.size, shape.resolution) == ((0.2, 0.08), (8, 10))
    front, back = np.full((2, 2, 8, 10), np.nan, np.float32)
    front[0, 2:5, 4:8], back[0, 2:5, 4:8] = 0.05, 0.07
    front[1, 3, 6], back[1, 3, 6] = 0.1, 0.2
    np.testing.assert_array_equal(shape.front, front)
    np.testing.assert_array_equal(shape.back, back)


def test_meshes_of_old_recordings() -> None:
    """Their size was the spacing of a grid."""
    mesh = next(b.shape for b in recorded_scenes.bodies() if isinstance(b.shape, cs.TriMesh))
    fields = {**shape_fields(mesh), "sizes": np.array([0.003])}
    again = read_shape(shape_message(**fields))
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)


def test_damaged_layers() -> None:
    """Old ones and new ones are refused."""
    old, new = old_layers(), shape_fields(recorded_scenes.SLAB)
    for fields, at, value in (
        (old, 8, -2.0), (old, 9, np.inf), (old, 10, 1e6), (old, 4, -3.0), (old, 5, np.nan),
        (old, 2, 2.0), (new, 0, -1.0), (new, 2, 7.0), (new, 3, np.nan),
    ):  # fmt: skip
        sizes = fields["sizes"].copy()
        sizes[at] = value
        with pytest.raises(RecordingError, match="damaged"):
            read_shape(shape_message(**{**fields, "sizes": sizes}))
    for fields, length in ((old, 40), (new, -1)):
        with pytest.raises(RecordingError, match="damaged"):
            read_shape(shape_message(**{**fields, "values": fields["values"][:length]}))


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
        {"excitation_frequency": 10e6},
        {"method": "fem_masked"},
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
