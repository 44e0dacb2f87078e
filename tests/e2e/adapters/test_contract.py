"""What every adapter must do: the same world gives the same reading in all of them.

Invariants and differential tests: shapes against :meth:`capsense.Simulator.step`, depth images
against those of our own rasteriser. ``adapter_worlds.WAYS`` lists the adapters, with tolerances.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapter_worlds import Thing, Way, plain_reading
from approximate import approx

import capsense as cs
from capsense.errors import ReadoutError

SensorIn = Callable[..., Any]

WEDGE = cs.TriMesh(
    np.array([[0, 0, 0], [30, 0, 0], [0, 20, 0], [0, 0, 15], [30, 0, 15], [0, 20, 15]]) * 1e-3,
    [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]],
)
SHAPES = {
    "box": cs.Box((0.03, 0.02, 0.01)),
    "sphere": cs.Sphere(0.012),
    "capsule": cs.Capsule(0.008, 0.03),
    "cylinder": cs.Cylinder(0.01, 0.02),
    "mesh": WEDGE,
}


def random_pose(rng: np.random.Generator, centre: Any = (0, 0, 0), spread: float = 0.0) -> cs.Pose:
    """A pose of any orientation."""
    return cs.Pose(np.add(centre, rng.uniform(-spread, spread, 3)), rng.normal(size=4))


def difference(a: cs.Reading, b: cs.Reading) -> float:
    """Largest difference of the changes, relative to the largest change."""
    return float(np.abs(a.delta - b.delta).max() / np.abs(b.delta).max())


def crowd(rng: np.random.Generator) -> list[Thing]:
    """One thing of every shape, side by side in front of the sensor."""
    places = [(-30, -25), (25, -28), (-28, 22), (5, 0), (20, 20)]
    return [
        Thing(name, shape, random_pose(rng, (x * 1e-3, y * 1e-3, 0.035), 0.002))
        for (name, shape), (x, y) in zip(SHAPES.items(), places, strict=True)
    ]


# -- every adapter, whatever it sees -----------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_reads_as_in_plain_capsense(
    name: str, way: Way, sensor_in: SensorIn, tiny_simulator: cs.Simulator
) -> None:
    """Differential: one thing, sensor and thing anywhere in the world."""
    rng = np.random.default_rng(1)
    sensor_pose = random_pose(rng, (1.0, 2.0, 3.0), 1.0)
    things = [Thing(name, SHAPES[name], sensor_pose @ random_pose(rng, (0.003, 0.004, 0.03)))]
    reading = sensor_in(things, sensor_pose).read()
    assert difference(reading, way.expected(things, sensor_pose, tiny_simulator)) < way.same
    assert np.diag(reading.delta).min() > 1e-16


def test_a_crowd_reads_as_in_plain_capsense(
    way: Way, sensor_in: SensorIn, tiny_simulator: cs.Simulator
) -> None:
    """Differential: all shapes at once."""
    things = crowd(np.random.default_rng(2))
    reading = sensor_in(things, cs.Pose()).read()
    assert difference(reading, way.expected(things, cs.Pose(), tiny_simulator)) < way.same


def test_moving_the_sensor_or_the_world(way: Way, sensor_in: SensorIn) -> None:
    """Invariant: only the relative pose counts."""
    things = crowd(np.random.default_rng(3))
    step = cs.Pose((0.004, -0.003, -0.005))
    by_sensor = sensor_in(things, step).read()
    moved = [Thing(t.name, t.shape, step.inverse() @ t.pose) for t in things]
    assert difference(sensor_in(moved, cs.Pose()).read(), by_sensor) < way.moved


@pytest.mark.parametrize("seed", range(3))
def test_turning_everything(seed: int, way: Way, sensor_in: SensorIn) -> None:
    """Invariant: a rigid motion of everything at random changes nothing."""
    rng = np.random.default_rng(seed)
    things = crowd(rng)
    at_rest = sensor_in(things, cs.Pose()).read()
    motion = random_pose(rng, (0.5, -1.0, 2.0), 1.0)
    turned = [Thing(t.name, t.shape, motion @ t.pose) for t in things]
    sensor = sensor_in(turned, motion)
    assert difference(sensor.read(), at_rest) < way.moved
    assert sensor.pose.apply((0, 0, 0.03)) == approx(motion.apply((0, 0, 0.03)), abs=1e-6)


@pytest.mark.parametrize("place", [(0.0605, 0.0, 0.02), (0.0, 0.0, -0.0205), (0.0, 0.0, 0.1005)])
def test_things_outside_the_domain_change_nothing(place: Any, sensor_in: SensorIn) -> None:
    """Beside, behind, beyond; and the sensor's own link, which covers it, is not seen."""
    reading = sensor_in([Thing("ball", cs.Sphere(0.01), cs.Pose(place))], cs.Pose()).read()
    assert np.abs(reading.delta).max() == 0.0


def test_a_reset_sensor_reads_the_same(sensor_in: SensorIn) -> None:
    """Invariant: reading again, or after a reset, gives the same to the solver's tolerance."""
    sensor = sensor_in(crowd(np.random.default_rng(6)), cs.Pose())
    first = sensor.read()
    assert difference(sensor.read(), first) < 1e-4
    sensor.reset()
    assert np.array_equal(sensor.read().delta, first.delta)


# -- what sees shapes and their names ----------------------------------------------------------


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_stay_what_they_are(name: str, shapes_in: SensorIn) -> None:
    """A simulator's primitive becomes ours, not a mesh."""
    thing = Thing(name, SHAPES[name], cs.Pose((0, 0, 0.03), (0.1, 0.2, 0.3, 0.9)))
    assert [b.shape.kind for b in shapes_in([thing], cs.Pose()).scene()] == [SHAPES[name].kind]


def test_things_outside_the_domain_are_not_seen(shapes_in: SensorIn) -> None:
    """Culled exactly where the bounding box leaves the domain."""
    ball = cs.Sphere(0.01)
    sides = {"in": (0.0, 0.0, 0.02), "wall": (0.0595, 0.0, 0.02), "out": (0.0605, 0.0, 0.02)}
    sides |= {"behind": (0.0, 0.0, -0.0205), "above": (0.0, 0.0, 0.1005)}
    sensor = shapes_in([Thing(k, ball, cs.Pose(v)) for k, v in sides.items()], cs.Pose())
    seen = {label.partition("/")[0] for b in sensor.scene() if (label := b.name)}
    assert seen == {"in", "wall"}


def test_own_link_is_left_out_on_request(shapes_in: SensorIn) -> None:
    """The carrier's box covers the electrodes where it is seen."""
    things = [Thing("ball", cs.Sphere(0.01), cs.Pose((0, 0, 0.04)))]
    names = [b.name.partition("/")[0] for b in shapes_in(things, cs.Pose()).scene()]
    assert names == ["ball"]
    sensor = shapes_in(things, cs.Pose(), exclude_own=False)
    assert sorted(b.name.partition("/")[0] for b in sensor.scene()) == ["ball", "carrier"]


def test_excluded_things_are_left_out(shapes_in: SensorIn) -> None:
    """Excluding a thing reads as if it had never been there."""
    things = crowd(np.random.default_rng(4))
    without = shapes_in([t for t in things if t.name != "box"], cs.Pose()).read()
    sensor = shapes_in(things, cs.Pose(), exclude=["bo?"])
    assert difference(sensor.read(), without) < 1e-9
    assert len(shapes_in(things, cs.Pose(), exclude=["*/*"], exclude_own=False).scene()) == 0


def test_materials_and_grounding_by_name(
    shape_way: Way, shapes_in: SensorIn, tiny_simulator: cs.Simulator
) -> None:
    """The first pattern that fits decides; a dielectric and a floating body read as such."""
    things = [
        Thing("left_arm", cs.Sphere(0.012), cs.Pose((-0.015, 0, 0.03))),
        Thing("right_arm", cs.Sphere(0.012), cs.Pose((0.015, 0, 0.03))),
    ]
    glass = cs.Material("window glass", 7.0)
    sensor = shapes_in(
        things, cs.Pose(),
        materials={"left_*": glass, "*_arm": "human"},
        grounding={"right_arm": 5e-14}, default_grounding="floating",
    )  # fmt: skip
    left, right = sorted(sensor.scene(), key=lambda b: str(b.name))
    assert (left.material, left.grounding) == (glass, "floating")
    assert (right.material.name, right.grounding) == ("human", 5e-14)
    plain = tiny_simulator.step(
        cs.Scene([
            cs.Body(things[0].shape, things[0].pose, glass),
            cs.Body(things[1].shape, things[1].pose, "human", 5e-14),
        ])
    )  # fmt: skip
    tiny_simulator.reset()
    assert difference(sensor.read(), plain) < shape_way.same


def test_what_a_rule_gives_a_capacitance_is_one_conductor(
    shape_way: Way, shapes_in: SensorIn, tiny_simulator: cs.Simulator
) -> None:
    """Whether they touch or not, and whether they are seen or not."""
    half = cs.Box((0.02, 0.03, 0.01))
    things = [
        Thing("arm_a", half, cs.Pose((-0.0110, 0, 0.03))),
        Thing("arm_b", half, cs.Pose((0.0110, 0, 0.03))),
        Thing("arm_far", half, cs.Pose((0.5, 0, 0.03))),
    ]
    sensor = shapes_in(things, cs.Pose(), grounding={"arm_*": 3e-15})
    assert [b.grounding for b in sensor.scene()] == [3e-15] * 3
    reading = sensor.read()
    options = {"grounding": 3e-15}
    pair = plain_reading(things, cs.Pose(), tiny_simulator, **options, conductor="arm")
    assert difference(reading, pair) < shape_way.same
    each = plain_reading(things, cs.Pose(), tiny_simulator, **options)
    assert difference(reading, each) > 10 * shape_way.same


def test_two_sensors_at_once(way: Way, sensor_in: SensorIn, tiny_simulator: cs.Simulator) -> None:
    """Each keeps its own frame and its own state, read in any order."""
    things = crowd(np.random.default_rng(5))
    other = cs.Pose((0.002, 0.001, 0.003), (0, 0, 0.3, 1.0))
    first, second = sensor_in(things, cs.Pose()), sensor_in(things, other)
    expected = [way.expected(things, pose, tiny_simulator) for pose in (cs.Pose(), other)]
    for _ in range(2):
        assert difference(first.read(), expected[0]) < way.same
        assert difference(second.read(), expected[1]) < way.same


def test_reading_shape_and_names(sensor_in: SensorIn, tiny_simulator: cs.Simulator) -> None:
    """A handle speaks of the same electrodes and baseline as its simulator."""
    sensor = sensor_in([Thing("ball", cs.Sphere(0.01), cs.Pose((0, 0, 0.03)))], cs.Pose())
    reading = sensor.read()
    assert sensor.electrode_names == tiny_simulator.electrode_names == reading.electrode_names
    assert reading.capacitance == approx(sensor.baseline + reading.delta, abs=0)


# -- what sees depth images --------------------------------------------------------------------


def test_a_camera_inside_a_body(image_way: Way, image_in: SensorIn) -> None:
    """As documented: rays tell where they leave it, and PyBullet draws nothing of it."""
    block = Thing("block", cs.Box((0.06, 0.05, 0.04)), cs.Pose())
    sensor = image_in([block], cs.Pose())
    frame = sensor.frame()
    if image_way.package == "pybullet":
        assert not frame.valid.any()
    else:
        assert frame.points()[:, 2] == approx(np.full(frame.valid.sum(), 0.02), abs=1e-6)
        assert frame.valid.mean() == approx(0.30, abs=0.02)
    assert np.isfinite(sensor.read().delta).all()


# -- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"exclude": ["bal"]}, "exclude: nothing is named 'bal'; did you mean 'ball'"),
        ({"materials": {"bell*": "human"}}, "materials: nothing is named 'bell"),
        ({"grounding": {"nobody": "floating"}}, "grounding: nothing is named 'nobody'"),
        ({"hull": ["nothing"]}, "hull: nothing is named 'nothing'"),
        ({"exclude": "ball"}, "exclude is 'ball'; give a list"),
        ({"exclude": [3]}, "exclude holds 3"),
        ({"materials": ["human"]}, "materials is .*; give a dict"),
        ({"materials": {"ball": "humam"}}, "unknown material 'humam'.*human"),
        ({"default_material": "steal"}, "unknown material 'steal'.*steel"),
        ({"grounding": {"ball": -1e-12}}, "grounding is -1e-12"),
        ({"default_grounding": "grouded"}, "grounding is 'grouded'"),
    ],
)
def test_wrong_rules_are_refused(
    options: dict[str, Any], message: str, shapes_in: SensorIn
) -> None:
    """A slip in a pattern or a material is an error that names it, not a steel body."""
    things = [Thing("ball", cs.Sphere(0.01), cs.Pose((0, 0, 0.03)))]
    with pytest.raises(cs.SceneError, match=message):
        shapes_in(things, cs.Pose(), **options)


def test_an_open_mesh_is_taken(shape_way: Way, shapes_in: SensorIn) -> None:
    """A surface without an inside is taken as it is, or its hull on request."""
    vertices, faces = WEDGE.vertices, WEDGE.faces[:-1]
    shape = object.__new__(cs.TriMesh)
    shape.__dict__.update(vertices=vertices, faces=faces)
    things = [Thing("wedge", shape, cs.Pose((0, 0, 0.03)))]
    own_surface = {"shapes": "visual"} if shape_way.package == "pybullet" else {}
    (body,) = shapes_in(things, cs.Pose(), **own_surface).scene()
    assert not body.shape.closed
    assert len(body.shape.faces) == len(faces)
    (body,) = shapes_in(things, cs.Pose(), hull=["wedge"], **own_surface).scene()
    assert body.shape.volume == approx(WEDGE.volume, rel=1e-5)


def test_a_readout_may_be_a_file(sensor_in: SensorIn, tmp_path: Path) -> None:
    """As text or as a path; what is neither a name, nor a file, nor a readout is refused."""
    sensor = sensor_in([], cs.Pose())
    file = tmp_path / "chip.toml"
    file.write_text('chip = "fdc1004"\nrate = 400\n', encoding="utf-8")
    for choice in (file, str(file)):
        sensor.use_readout(choice)
        assert sensor.readout.schedule.conversion == approx(2.5e-3, rel=1e-12)
    with pytest.raises(ReadoutError, match="readout is 3; give a chip's name, a file, or a"):
        sensor.use_readout(3)


def test_a_reading_holds_the_counts_of_its_chip(sensor_in: SensorIn, way: Way) -> None:
    """Differential: the same conversions as of a readout fed by hand; none without one."""
    sensor = sensor_in([], cs.Pose())
    assert sensor.read().counts is None
    sensor.use_readout("fdc1004")
    by_hand = cs.Readout.preset("fdc1004", sensor.electrode_names)
    start = sensor.time if way.has_clock else 0.0
    by_hand.reset(start=start)
    total = 0
    for k in range(1, 6):
        reading = sensor.read(time=start + 0.01 * k)
        expected = by_hand.sample(start + 0.01 * k, reading)
        np.testing.assert_array_equal(reading.counts.time, expected.time)
        np.testing.assert_array_equal(reading.counts.code, expected.code)
        total += len(expected.time)
    assert total > 0
    sensor.reset()
    sensor.use_readout("mpr121")  # set up for these electrodes: in range
    flags = [sensor.read(time=0.1 * k).counts.flags for k in range(3)]
    assert sum(map(len, flags)) > 0
    assert not np.concatenate(flags).any()
    if way.has_clock:
        sensor.reset()
        sensor.read()
    else:
        with pytest.raises(cs.SceneError, match=r"read\(time="):
            sensor.read()
