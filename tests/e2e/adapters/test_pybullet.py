"""What is PyBullet's own: its shapes, its user data, articulated bodies, its clients."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapter_worlds import load, numbers, urdf
from approximate import approx

import capsense as cs

p = pytest.importorskip("pybullet", reason="PyBullet is not installed")

AHEAD = (0.0, 0.0, 0.04)


@pytest.fixture
def client() -> Iterator[int]:
    """An empty world."""
    number = p.connect(p.DIRECT)
    yield number
    if p.isConnected(physicsClientId=number):
        p.disconnect(physicsClientId=number)


@pytest.fixture
def attach(client: int, tmp_path: Path, tiny_simulator: cs.Simulator) -> Callable[..., Any]:
    """``attach(**options)``: a sensor at the world's origin."""

    def make(**options: Any) -> Any:
        body = load(client, urdf("pad", '<sphere radius="0.01"/>'), cs.Pose(), tmp_path)
        tiny_simulator.reset()
        return cs.pybullet.attach(client, body, design=tiny_simulator, **options)

    return make


def place(client: int, pose: cs.Pose | None = None, **shape: Any) -> int:
    """A body of one collision shape."""
    kind = p.createCollisionShape(physicsClientId=client, **shape)
    pose = pose or cs.Pose(AHEAD)
    return p.createMultiBody(0, kind, -1, pose.position, pose.quaternion, physicsClientId=client)


def same(found: Any, expected: Any) -> None:
    """Two primitives of one kind and size."""
    assert found.kind is expected.kind
    assert found.params == approx(expected.params, rel=1e-9)


def test_every_primitive_has_its_size(client: int, attach: Callable[..., Any]) -> None:
    """Radius and height come in an order of their own for each."""
    place(client, shapeType=p.GEOM_BOX, halfExtents=(0.01, 0.015, 0.02))
    place(client, shapeType=p.GEOM_SPHERE, radius=0.011)
    place(client, shapeType=p.GEOM_CAPSULE, radius=0.012, height=0.03)
    place(client, shapeType=p.GEOM_CYLINDER, radius=0.013, height=0.02)
    expected = (
        cs.Box((0.02, 0.03, 0.04)),
        cs.Sphere(0.011),
        cs.Capsule(0.012, 0.03),
        cs.Cylinder(0.013, 0.02),
    )
    for body, shape in zip(attach().scene(), expected, strict=True):
        same(body.shape, shape)


@pytest.mark.parametrize("shapes", ["collision", "visual"])
def test_a_urdf_stands_where_its_file_says(
    shapes: str, client: int, attach: Callable[..., Any], tmp_path: Path
) -> None:
    """Differential: origins of shapes, joints and centres of mass chained by ``Pose``."""
    rng = np.random.default_rng(6)
    rpy = rng.uniform(-1, 1, (5, 3))
    xyz = rng.uniform(-0.01, 0.01, (5, 3))
    origin = [
        f'<origin xyz="{numbers(x)}" rpy="{numbers(r)}"/>' for x, r in zip(xyz, rpy, strict=True)
    ]
    inertia = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'

    def link(name: str, mass: int, shape: int, geometry: str) -> str:
        drawn = f"{origin[shape]}<geometry>{geometry}</geometry>"
        return (
            f'<link name="{name}"><inertial>{origin[mass]}{inertia}</inertial>'
            f"<visual>{drawn}</visual><collision>{drawn}</collision></link>"
        )

    text = (
        '<robot name="arm">'
        + link("upper", 0, 1, '<box size="0.01 0.02 0.03"/>')
        + link("fore", 2, 3, '<cylinder radius="0.008" length="0.02"/>')
        + '<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>'
        f'{origin[4]}<axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>'
    )
    base = cs.Pose(AHEAD, rng.normal(size=4))
    body = load(client, text, base, tmp_path)
    p.resetJointState(body, 0, 0.7, physicsClientId=client)

    def pose(k: int) -> cs.Pose:
        return cs.Pose.from_euler(xyz[k], rpy[k])

    joint = base @ pose(4) @ cs.Pose.from_euler((0, 0, 0), (0, 0, 0.7))
    expected = {"arm/upper": base @ pose(1), "arm/fore": joint @ pose(3)}
    scene = attach(shapes=shapes).scene()
    assert {b.name for b in scene} == set(expected)
    for name, where in expected.items():
        assert scene[name].pose.matrix == approx(where.matrix, abs=1e-6)
    fore = scene["arm/fore"].shape
    assert isinstance(fore, cs.Cylinder)
    assert (fore.radius, fore.length) == approx((0.008, 0.02), rel=1e-5)


@pytest.mark.parametrize("perception", ["geometry", "depth_camera"])
def test_a_body_of_too_many_links(
    perception: Any, client: int, tiny_simulator: cs.Simulator, tmp_path: Path
) -> None:
    """PyBullet itself says no more than "getLinkState failed"."""
    inertia = '<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link = '<link name="a{0}"><inertial>{1}</inertial></link>'
    joint = (
        '<joint name="j{0}" type="{1}"><parent link="a0"/><child link="a{0}"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    file = tmp_path / "hairy.urdf"
    text = "".join(link.format(k, inertia) + "\n" for k in range(130))
    kinds = ["fixed" if k < 30 else "revolute" for k in range(130)]
    text += "".join(joint.format(k, kinds[k]) + "\n" for k in range(1, 130))
    file.write_text(f'<robot name="hairy">\n{text}</robot>')
    load = {"fileName": str(file), "physicsClientId": client}
    body = p.loadURDF(**load)
    fix = r"'hairy', has 129 links beside its base.* 127 at most.*URDF_MERGE_FIXED_LINKS.* 29 fixed"
    with pytest.raises(cs.SceneError, match=fix):
        cs.pybullet.attach(client, body, -1, cs.Pose(), tiny_simulator, perception=perception)
    p.removeBody(body, physicsClientId=client)
    joined = p.loadURDF(**load, flags=p.URDF_MERGE_FIXED_LINKS)
    sensor = cs.pybullet.attach(
        client, joined, -1, cs.Pose(), tiny_simulator, perception=perception
    )
    assert not sensor.read().delta.any()


def test_a_link_that_is_only_drawn_is_seen(client: int, attach: Callable[..., Any]) -> None:
    """Also one that only collides, where what is drawn is preferred; and both, if asked."""
    make = {"radius": 0.01, "physicsClientId": client}
    drawn = p.createVisualShape(p.GEOM_SPHERE, **make)
    solid = p.createCollisionShape(p.GEOM_BOX, halfExtents=[0.01] * 3, physicsClientId=client)
    p.createMultiBody(0, -1, drawn, AHEAD, physicsClientId=client)
    for shapes in ("collision", "visual", "both"):
        (ball,) = attach(shapes=shapes, exclude=["pad"]).scene()
        same(ball.shape, cs.Sphere(0.01))
    p.createMultiBody(0, solid, drawn, (0.03, 0, 0.04), physicsClientId=client)
    assert [b.shape.kind.name for b in attach(exclude=["pad"]).scene()] == ["SPHERE", "BOX"]
    kinds = [b.shape.kind.name for b in attach(shapes="both", exclude=["pad"]).scene()]
    assert kinds == ["SPHERE", "SPHERE", "BOX"]
    with pytest.raises(ValueError, match="shapes is 'hull'; choose"):
        attach(shapes="hull")


def test_shapes_of_one_link(client: int, attach: Callable[..., Any]) -> None:
    """All shapes of a compound are seen, each in its place."""
    array = p.createCollisionShapeArray(
        [p.GEOM_SPHERE, p.GEOM_BOX], radii=[0.01, 0.01], halfExtents=[[0.005] * 3] * 2,
        collisionFramePositions=[[0.01, 0, 0], [-0.01, 0, 0.01]], physicsClientId=client,
    )  # fmt: skip
    p.createMultiBody(0, array, -1, AHEAD, physicsClientId=client)
    ball, box = attach().scene()
    same(ball.shape, cs.Sphere(0.01))
    same(box.shape, cs.Box((0.01, 0.01, 0.01)))
    assert ball.pose.position == approx((0.01, 0, 0.04), abs=1e-12)
    assert box.pose.position == approx((-0.01, 0, 0.05), abs=1e-12)


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (0.6, 0, 0.8), (0, 1, 0)])
def test_planes(normal: Any, client: int, attach: Callable[..., Any]) -> None:
    """A plane of wood fills its back side."""
    place(client, cs.Pose((0.01, 0.01, 0.05)), shapeType=p.GEOM_PLANE, planeNormal=normal)
    (body,) = attach(default_material="wood").scene()
    points = np.random.default_rng(0).uniform((-0.05, -0.05, 0), (0.05, 0.05, 0.09), (200, 3))
    side = (points - (0.01, 0.01, 0.05)) @ np.array(normal)
    inside = body.shape.signed_distance(body.pose.inverse().apply(points))
    assert np.array_equal(inside < 0, side < 0)


def test_a_drawn_floor_is_its_collision_shape(client: int, attach: Callable[..., Any]) -> None:
    """Differential: a flat visual mesh, such as plane.urdf has, has no inside of its own."""
    import pybullet_data

    floor = f"{pybullet_data.getDataPath()}/plane.urdf"
    body = p.loadURDF(floor, (0, 0, 0.03), (1, 0, 0, 0), physicsClientId=client)
    readings = [attach(shapes=s, exclude=["pad"]).read().delta for s in ("visual", "collision")]
    assert readings[0][0, 0] > 1e-15
    assert np.array_equal(*readings)
    p.removeBody(body, physicsClientId=client)
    file = f"{pybullet_data.getDataPath()}/plane.obj"
    drawn = p.createVisualShape(p.GEOM_MESH, fileName=file, physicsClientId=client)
    p.createMultiBody(0, -1, drawn, physicsClientId=client)
    with pytest.warns(UserWarning, match=r"flat visual mesh .*no collision shape \(left out\)"):
        assert not len(attach(shapes="visual", exclude=["pad"]).scene())


def test_meshes_without_a_file(client: int, attach: Callable[..., Any]) -> None:
    """Corners given in code make a hull; a concave surface is left out, and named."""
    corners = [[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02]]
    place(client, shapeType=p.GEOM_MESH, vertices=corners)
    (body,) = attach().scene()
    assert body.shape.volume == approx(0.02**3 / 6, rel=1e-4)
    assert body.pose.apply(body.shape.bounds()) == approx(
        np.array([AHEAD, (0.02, 0.02, 0.06)]), abs=1e-7
    )
    faces = [0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]
    body_number = place(client, shapeType=p.GEOM_MESH, vertices=corners, indices=faces)
    with pytest.warns(UserWarning, match=f"'body{body_number}/.*' has a concave collision mesh"):
        assert len(attach(exclude=["pad"]).scene()) == 1


def test_a_height_field_is_left_out(client: int, attach: Callable[..., Any]) -> None:
    """PyBullet gives neither its heights nor its type away, but for the visual record."""
    place(
        client, shapeType=p.GEOM_HEIGHTFIELD, meshScale=[0.1, 0.1, 1],
        heightfieldData=[0.0] * 9, numHeightfieldRows=3, numHeightfieldColumns=3,
    )  # fmt: skip
    with pytest.warns(UserWarning, match=r"is a height field.*\(left out\)"):
        assert not len(attach().scene())
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*height field")
        attach(exclude=["body0"])


def test_user_data_says_what_things_are(client: int, attach: Callable[..., Any]) -> None:
    """The call's patterns come before user data, and those before the defaults."""
    for number in range(3):
        place(client, shapeType=p.GEOM_SPHERE, radius=0.01)
        if number:
            p.addUserData(number, "capsense.material", "human", physicsClientId=client)
    p.addUserData(2, "capsense.grounding", "100e-12", physicsClientId=client)
    scene = attach(materials={"body1": "copper"}, default_grounding="floating").scene()
    assert [(b.material.name, b.grounding) for b in scene] == [
        ("steel", "floating"),
        ("copper", "floating"),
        ("human", 100e-12),
    ]
    p.addUserData(2, "capsense.material", "humam", physicsClientId=client)
    with pytest.raises(cs.SceneError, match=r"user data of 'body2/.*unknown material 'humam'"):
        attach()


def test_bodies_that_come_and_go(client: int, attach: Callable[..., Any]) -> None:
    """A world that gains or loses bodies is taken over again by itself."""
    ball = place(client, shapeType=p.GEOM_SPHERE, radius=0.01)
    sensor = attach()
    near = sensor.read().delta[0, 0]
    assert near > 0
    p.removeBody(ball, physicsClientId=client)
    assert sensor.read().delta[0, 0] == 0
    place(client, shapeType=p.GEOM_SPHERE, radius=0.01)
    assert sensor.read().delta[0, 0] == approx(near, rel=1e-3, abs=0)


def test_clients_are_kept_apart(attach: Callable[..., Any], client: int) -> None:
    """A second physics client has a world of its own."""
    sensor = attach()
    other = p.connect(p.DIRECT)
    try:
        place(other, shapeType=p.GEOM_SPHERE, radius=0.01)
        assert len(sensor.scene()) == 0
    finally:
        p.disconnect(physicsClientId=other)


def test_wrong_calls_are_refused(
    attach: Callable[..., Any], client: int, tiny_simulator: cs.Simulator
) -> None:
    """A missing client, body or link; a choice that there is not."""
    sensor = attach()
    for options, message in (
        ({"link": "pad_lnk"}, "no link named 'pad_lnk'; did you mean 'pad_link'"),
        ({"link": 3}, "has no link 3; give a name, or an index from -1"),
        ({"body": 7}, r"no body 7 in the world; there are \[0\]"),
        ({"client": 77}, "no physics client 77; call pybullet"),
        ({"client": "direct"}, "client is 'direct'"),
        ({"shapes": "drawn"}, "shapes is 'drawn'; choose"),
        ({"pose_in_link": (0, 0, 0)}, "pose_in_link is"),
        ({"resolution": 128}, 'resolution goes with perception="depth_camera"'),
        ({"size": 0.2}, 'size goes with perception="depth_camera"'),
    ):
        call = {"client": client, "body": sensor.body, "design": tiny_simulator, **options}
        with pytest.raises(ValueError, match=message):
            cs.pybullet.attach(**call)


def test_named_bodies_may_leave(client: int, tiny_simulator: cs.Simulator) -> None:
    """A pattern must fit something at attach; what it fits may go and come back."""
    pad = p.createMultiBody(0, physicsClientId=client)

    def ball() -> int:
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.01, physicsClientId=client)
        body = p.createMultiBody(0, shape, basePosition=[0, 0, 0.04], physicsClientId=client)
        p.addUserData(body, "capsense.body", "ball", physicsClientId=client)
        return int(body)

    first = ball()
    for perception in ("geometry", "depth_camera"):
        sensor = cs.pybullet.attach(
            client, pad, design=tiny_simulator, perception=perception, materials={"ball": "human"}
        )
        there = sensor.read().delta
        p.removeBody(first, physicsClientId=client)
        assert np.abs(sensor.read().delta).max() == 0.0
        first = ball()
        assert np.array_equal(sensor.read().delta, there)
    p.removeBody(pad, physicsClientId=client)
    with pytest.raises(cs.SceneError, match="which carries the sensor, has left the world"):
        sensor.read()


@pytest.mark.parametrize("perception", ["geometry", "depth_camera"])
def test_a_world_that_was_reset(perception: str, client: int, tiny_simulator: cs.Simulator) -> None:
    """Bodies of the same numbers are others then."""

    def fill(radius: float) -> int:
        p.resetSimulation(physicsClientId=client)
        pad = p.createMultiBody(0, physicsClientId=client)
        make = {"radius": radius, "physicsClientId": client}
        shapes = (
            p.createCollisionShape(p.GEOM_SPHERE, **make),
            p.createVisualShape(p.GEOM_SPHERE, **make),
        )
        p.createMultiBody(0, *shapes, basePosition=[0, 0, 0.04], physicsClientId=client)
        return int(pad)

    sensor = cs.pybullet.attach(client, fill(0.01), design=tiny_simulator, perception=perception)
    small = sensor.read().delta[0, 0]
    fill(0.02)
    assert sensor.read().delta[0, 0] > 1.5 * small
    fill(0.01)
    assert sensor.read().delta[0, 0] == small


def test_a_client_that_is_gone(tiny_simulator: cs.Simulator) -> None:
    """The error says so."""
    client = p.connect(p.DIRECT)
    sensor = cs.pybullet.attach(
        client, p.createMultiBody(0, physicsClientId=client), design=tiny_simulator
    )
    p.disconnect(client)
    with pytest.raises(cs.SceneError, match="is not connected any more"):
        sensor.read()


@pytest.mark.parametrize("shapes", ["collision", "visual"])
@pytest.mark.parametrize(
    "geometry",
    ['<box size="0 0 0"/>', '<sphere radius="0"/>', '<cylinder radius="0.01" length="0"/>'],
)
def test_shapes_without_volume_are_left_out(
    geometry: str, shapes: str, client: int, attach: Callable[..., Any], tmp_path: Path
) -> None:
    """Real robots have such boxes; they are named once, and the rest is read."""
    load(client, urdf("robot", geometry), cs.Pose(AHEAD), tmp_path)
    shape = {"radius": 0.01, "physicsClientId": client}
    ball = (f(p.GEOM_SPHERE, **shape) for f in (p.createCollisionShape, p.createVisualShape))
    p.createMultiBody(0, *ball, basePosition=AHEAD, physicsClientId=client)
    with pytest.warns(UserWarning, match=r"sensor: 'robot/robot_link' (.|\n)*\(left out\)$"):
        sensor = attach(shapes=shapes)
    (body,) = sensor.scene()
    assert body.shape == cs.Sphere(0.01)


def test_a_mesh_that_cannot_be_read(
    client: int, attach: Callable[..., Any], tmp_path: Path
) -> None:
    """As without the reader of its format: the link's collision shape is taken, and told."""
    file = tmp_path / "hand.dae"
    file.write_text("no mesh at all")
    drawn = p.createVisualShape(p.GEOM_MESH, fileName=str(file), physicsClientId=client)
    solid = p.createCollisionShape(p.GEOM_SPHERE, radius=0.01, physicsClientId=client)
    p.createMultiBody(0, solid, drawn, basePosition=AHEAD, physicsClientId=client)
    with pytest.warns(UserWarning, match=r"hand\.dae cannot be read: (.|\n)*collision shapes are"):
        sensor = attach(shapes="visual")
    assert [b.shape for b in sensor.scene()] == [cs.Sphere(0.01)]


@pytest.mark.parametrize("shapes", ["collision", "visual"])
@pytest.mark.parametrize(
    ("robot", "link"), [("kuka_iiwa/model.urdf", 6), ("franka_panda/panda.urdf", "panda_hand")]
)
def test_real_robots_are_read_at_once(
    robot: str, link: int | str, shapes: str, client: int, tiny_simulator: cs.Simulator
) -> None:
    """The robots of pybullet_data, with their open and crossing meshes, and a hand before them."""
    import pybullet_data

    file = f"{pybullet_data.getDataPath()}/{robot}"
    body = p.loadURDF(file, useFixedBase=True, physicsClientId=client)
    pad = cs.Pose((0.0, 0.0, 0.15))
    sensor = cs.pybullet.attach(client, body, link, pad, tiny_simulator, shapes=shapes)
    found = sensor.check()  # the robot behind is no reason to turn the sensor round
    assert not any("faced the other way" in text for text in found)
    empty = sensor.read().delta
    assert np.isfinite(empty).all()
    pose = sensor.pose @ cs.Pose((0, 0, 0.04))
    place(client, pose, shapeType=p.GEOM_SPHERE, radius=0.01)
    assert np.abs(sensor.read().delta - empty).max() > 1e-16


@pytest.mark.parametrize("file", ["bicycle/bike.urdf", "stadium.sdf", "racecar/racecar.urdf"])
@pytest.mark.parametrize("shapes", ["collision", "visual"])
def test_no_reading_is_zero_silently(
    file: str, shapes: str, client: int, tiny_simulator: cs.Simulator
) -> None:
    """Models of pybullet_data: large meshes, flat ones, bodies in view by their boxes only."""
    import pybullet_data

    path = f"{pybullet_data.getDataPath()}/{file}"
    load = p.loadURDF if file.endswith("urdf") else p.loadSDF
    found = load(path, physicsClientId=client)
    body = found if isinstance(found, int) else found[0]
    sensor = cs.pybullet.attach(
        client, body, -1, cs.Pose((0, 0, 0.08)), tiny_simulator, shapes=shapes
    )
    told = any("nothing is in view" in text for text in sensor.check())
    assert told == (not sensor.read().delta.any())


def test_a_plane_that_is_drawn_is_seen_without_a_word(tiny_simulator: cs.Simulator) -> None:
    """PyBullet tells its normal of the collision shape only, which is the same plane."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    client = p.connect(p.DIRECT)
    ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.01, physicsClientId=client)
    carrier = p.createMultiBody(0, ball, basePosition=(0, 0, 0.03), physicsClientId=client)
    plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
    p.createMultiBody(0, plane, physicsClientId=client)
    down = cs.Pose((0, 0, 0), (1, 0, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen, solid = (
            cs.pybullet.attach(client, carrier, -1, down, tiny_simulator, shapes=shapes).read()
            for shapes in ("visual", "collision")
        )
    assert seen.delta.any()
    np.testing.assert_array_equal(seen.delta, solid.delta)
    p.disconnect(physicsClientId=client)
