"""Sensors in all worlds of MuJoCo Warp and Newton, against simulators of one world."""

from __future__ import annotations

import importlib.util
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError

wp = pytest.importorskip("warp")
WORLDS = 3
MODEL = """<mujoco><worldbody>
 <geom name="floor" type="plane" size="2 2 .1"/>
 <geom name="table" type="box" size=".1 .1 .01" pos="0 0 .75"/>
 <body name="arm" pos="0 0 .6"><freejoint/><geom name="arm" type="capsule" size=".02 .06"/></body>
 <body name="robot" pos="0 0 .5"><joint type="hinge" axis="0 0 1"/>
  <geom name="link" type="sphere" size=".03" pos="0 0 -.05"/>
  <site name="skin_a"/><site name="skin_b" pos="0.05 0 0" euler="0 10 0"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def mujoco_worlds():
    """A model, data of three worlds in which the arm lies elsewhere, and their states."""
    mujoco = pytest.importorskip("mujoco")
    mjw = pytest.importorskip("mujoco_warp")
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(1)
    states = np.tile(data.qpos, (WORLDS, 1))
    states[:, :3] = rng.uniform([-0.05, -0.05, 0.57], [0.05, 0.05, 0.62], (WORLDS, 3))
    turn = rng.normal(size=(WORLDS, 4))
    states[:, 3:7] = turn / np.linalg.norm(turn, axis=1)[:, None]
    states[:, 7] = [0.0, 0.5, 1.0]
    mujoco.mj_forward(model, data)
    there = mjw.put_data(model, data, nworld=WORLDS)
    wp.copy(there.qpos, wp.array(states.astype(np.float32), dtype=wp.float32, device="cpu"))
    mjw.kinematics(mjw.put_model(model), there)
    return model, there, states


def warns_of_planes(device):
    """On Warp a fleet tells that a plane is wide; on the CPU it does not."""
    if device is None:
        return nullcontext()
    return pytest.warns(UserWarning, match="m is wide for a body on Warp")


@pytest.mark.filterwarnings("error:.*wide for a body:UserWarning")
@pytest.mark.parametrize(("device", "bound"), [(None, 1e-5), ("warp:cpu", 0.05)])
def test_mujoco_warp(mujoco_worlds, device, bound):
    """Differential: against a sensor attached to each world; on Warp within 5 % of the largest."""
    import mujoco

    from capsense.adapters.mujoco_warp import CapacitiveSensors

    model, there, states = mujoco_worlds
    with warns_of_planes(device):
        sensors = CapacitiveSensors(
            model, there, ["skin_a", "skin_b"], materials={"arm": "human"}, device=device
        )
    assert {name.rpartition("/")[2] for name in sensors.names} == {"floor", "table", "arm", "link"}
    found = sensors.read(there).delta
    found = found if device is None else found.numpy()
    assert found.shape == (WORLDS, 2, 6, 6)
    for w in range(WORLDS):
        data = mujoco.MjData(model)
        data.qpos[:] = states[w]
        mujoco.mj_forward(model, data)
        for s, site in enumerate(sensors.sites):
            sensor = cs.mujoco.attach(
                model, data, site, cs.Simulator("six_patch"),
                materials={"arm": "human"}, exclude=["floor"],
            )  # fmt: skip
            truth = sensor.read().delta
            assert np.abs(found[w, s] - truth).max() < bound * np.abs(truth).max()
    assert np.ptp(found[:, 0, 0, 0]) > 0


PERSON = """<mujoco><worldbody>
 <geom name="plate" type="box" size=".03 .05 .005" pos=".08 0 .1"/>
 <body name="arm" pos="-.02 0 .05"><freejoint/>
  <geom name="upper" type="capsule" size=".02 .05" pos="-.05 0 0" euler="0 90 0"/>
  <body name="fore" pos=".0 0 0"><joint type="hinge" axis="0 1 0"/>
   <geom name="lower" type="capsule" size=".018 .05" pos=".05 0 0" euler="0 90 0"/></body></body>
 <site name="skin"/></worldbody></mujoco>"""


@pytest.mark.parametrize("grounding", ["floating", 20e-12], ids=["floating", "tied"])
def test_parts_of_one_articulated_body_are_one_conductor(grounding):
    """Differential: two links that touch, against an attached sensor, which finds their contact."""
    mujoco, mjw = pytest.importorskip("mujoco"), pytest.importorskip("mujoco_warp")
    from capsense.adapters.mujoco_warp import CapacitiveSensors

    model = mujoco.MjModel.from_xml_string(PERSON)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    options = {"materials": {"*er": "human"}, "grounding": {"*er": grounding}}
    sensors = CapacitiveSensors(
        model, mjw.put_data(model, data, nworld=2), "skin", preset="standard", **options
    )
    assert sensors.sites == ("skin",)
    there = mjw.put_data(model, data, nworld=2)
    mjw.kinematics(mjw.put_model(model), there)
    truth = cs.mujoco.attach(model, data, "skin", **options).read().delta
    found = sensors.read(there).delta[:, 0]
    assert np.abs(found - truth).max() < 1e-5 * np.abs(truth).max()


def test_mujoco_warp_refuses(mujoco_worlds):
    """Errors name the thing."""
    from capsense.adapters.mujoco_warp import CapacitiveSensors

    model, there, _ = mujoco_worlds
    with pytest.raises(SceneError, match="skin_x"):
        CapacitiveSensors(model, there, ["skin_x"])
    with pytest.raises(SceneError, match="nothing to see"):
        CapacitiveSensors(model, there, ["skin_a"], exclude=["arm", "table", "floor", "link"])


def newton_model(newton):
    """Three worlds of a robot's link with two sites and an arm; a table outside of them."""
    world = newton.ModelBuilder()
    robot = world.add_body(xform=wp.transform((0.0, 0.0, 0.5), wp.quat_identity()), label="robot")
    world.add_shape_sphere(
        robot, xform=wp.transform((0.0, 0.0, -0.05), wp.quat_identity()), radius=0.03, label="link"
    )
    world.add_site(robot, label="skin_a")
    tilt = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), 0.17)
    world.add_site(robot, xform=wp.transform((0.05, 0.0, 0.0), tilt), label="skin_b")
    arm = world.add_body(xform=wp.transform((0.0, 0.0, 0.6), wp.quat_identity()), label="arm")
    world.add_shape_capsule(arm, radius=0.02, half_height=0.06, label="forearm")
    builder = newton.ModelBuilder()
    builder.replicate(world, WORLDS)
    builder.add_shape_box(
        -1, xform=wp.transform((0.0, 0.0, 0.75), wp.quat_identity()), hx=0.1, hy=0.1, hz=0.01,
        label="table",
    )  # fmt: skip
    builder.add_ground_plane()
    return builder.finalize(device="cpu")


@pytest.mark.filterwarnings("error:.*wide for a body:UserWarning")
@pytest.mark.parametrize(("device", "bound"), [(None, 1e-5), ("warp:cpu", 0.05)])
def test_newton(device, bound):
    """Differential: against scenes made by hand."""
    newton = pytest.importorskip("newton")
    from capsense.adapters.newton import SensorCapacitance

    model = newton_model(newton)
    state = model.state()
    bodies = state.body_q.numpy()
    rng = np.random.default_rng(2)
    bodies[1::2, :3] = rng.uniform([-0.05, -0.05, 0.57], [0.05, 0.05, 0.62], (WORLDS, 3))
    turn = rng.normal(size=(WORLDS, 4))
    bodies[1::2, 3:] = turn / np.linalg.norm(turn, axis=1)[:, None]
    wp.copy(state.body_q, wp.array(bodies, dtype=wp.transform, device="cpu"))
    with warns_of_planes(device):
        sensor = SensorCapacitance(model, "*skin_*", materials={"*forearm": "human"}, device=device)
    assert len(sensor.names) == 4
    assert sum("plane" in name for name in sensor.names) == 1
    sensor.update(state)
    found = sensor.delta if device is None else sensor.delta.numpy()
    assert found.shape == (WORLDS, 2, 6, 6)
    simulator = cs.Simulator("six_patch")
    arm, table = cs.Capsule(0.02, 0.12), cs.Box((0.2, 0.2, 0.02))
    frames = [cs.Pose((0, 0, 0.5)), cs.Pose.from_euler((0.05, 0, 0.5), (0, 0.17, 0))]
    for w in range(WORLDS):
        pose = bodies[2 * w + 1].astype(float)
        for s, frame in enumerate(frames):
            seen = frame.inverse()
            truth = simulator.step(cs.Scene([
                cs.Body(arm, seen @ cs.Pose(pose[:3], pose[3:]), "human"),
                cs.Body(table, seen @ cs.Pose((0, 0, 0.75))),
            ])).delta  # fmt: skip
            assert np.abs(found[w, s] - truth).max() < bound * np.abs(truth).max()
    with pytest.raises(SceneError, match="no site fits 'nose'"):
        SensorCapacitance(model, "nose")


def test_newton_sees_what_collides():
    """And what is only drawn where nothing that collides stands in its place."""
    newton = pytest.importorskip("newton")
    from capsense.adapters.newton import SensorCapacitance

    builder = newton.ModelBuilder()
    body = builder.add_body(label="robot")
    builder.add_site(body, label="pad")
    drawn = newton.ModelBuilder.ShapeConfig(has_shape_collision=False)
    arm = builder.add_body(xform=wp.transform((0.0, 0.0, 0.1), wp.quat_identity()), label="arm")
    builder.add_shape_capsule(arm, radius=0.02, half_height=0.06, label="hull")
    builder.add_shape_capsule(arm, radius=0.019, half_height=0.06, cfg=drawn, label="shell")
    far = wp.transform((0.0, 0.0, 0.2), wp.quat_identity())
    builder.add_shape_sphere(arm, xform=far, radius=0.01, cfg=drawn, label="lamp")
    model = builder.finalize(device="cpu")
    seen = {
        shapes: set(SensorCapacitance(model, "pad", shapes=shapes).names)
        for shapes in ("collision", "visual", "both")
    }
    assert seen["collision"] == {"hull", "lamp"}
    assert seen["visual"] == {"shell", "lamp"}
    assert seen["both"] == {"hull", "shell", "lamp"}


def test_newton_links_of_one_robot_are_one_conductor():
    """Differential: against one whose places are joined by hand; a body of its own is not."""
    newton = pytest.importorskip("newton")
    from capsense.adapters.newton import SensorCapacitance

    builder = newton.ModelBuilder()
    builder.add_site(-1, label="skin")
    links = [builder.add_link(label=f"link{k}") for k in range(2)]
    for k, link in enumerate(links):
        pose = wp.transform((0.04 * k, 0.0, 0.06), wp.quat_identity())
        builder.add_shape_sphere(link, xform=pose, radius=0.02, label=f"ball{k}")
    joints = [
        builder.add_joint_revolute(parent, child) for parent, child in ((-1, links[0]), links)
    ]
    builder.add_articulation(joints)
    alone = builder.add_body(label="alone")
    pose = wp.transform((-0.05, 0.0, 0.06), wp.quat_identity())
    builder.add_shape_sphere(alone, xform=pose, radius=0.02, label="ball2")
    model = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    sensor = SensorCapacitance(model, "skin", default_grounding="floating")
    sensor.update(state)
    ball = cs.Body(cs.Sphere(0.02), grounding="floating")
    fleet = cs.Fleet("six_patch", [ball] * 3, 1)
    fleet.join([0, 1])
    poses = np.array([[[x, 0, 0.06, 0, 0, 0, 1] for x in (0.0, 0.04, -0.05)]])
    truth = fleet.step(poses).delta
    assert sensor.names == ("ball0", "ball1", "ball2")
    np.testing.assert_allclose(sensor.delta, truth, rtol=0, atol=1e-6 * np.abs(truth).max())


def fall(model, data):
    """A step of a free fall."""
    step = float(model.opt.timestep.numpy()[0])
    speed, place = data.qvel.numpy(), data.qpos.numpy()
    speed[:, 2] -= 9.81 * step
    place[:, :3] += step * speed[:, :3]
    for there, here in ((data.qvel, speed), (data.qpos, place)):
        wp.copy(there, wp.array(here, dtype=wp.float32, device=there.device))


@pytest.mark.parametrize(
    ("name", "whole"),
    [
        ("mujoco_warp", False), ("newton", True),
        pytest.param("mujoco_warp", True, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_examples(name, whole, monkeypatch):
    """The arm falls past: finite, varying, highest when it is level with the pad.

    Where it is not the whole example, a free fall stands in for MuJoCo Warp's step, most of whose
    kernels would be compiled for it alone.
    """
    pytest.importorskip(name)
    path = Path(__file__).parents[3] / "examples" / f"fleet_{name}.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not whole:
        monkeypatch.setattr(module.mjw, "step", fall)
    found = module.main(4)
    assert found.shape == (10, 4, 1, 6, 6)
    assert np.isfinite(found).all()
    near = found[:, 0, 0].trace(axis1=1, axis2=2)
    assert near.argmax() in (5, 6)  # 0.2 m below after 0.2 s
    assert near.max() > 20 * near[0]
    assert (np.diff(found[6, :, 0, 0, 0]) < 0).all()
