"""What sensors in all stacks of parallel worlds have in common, on MuJoCo Warp and Newton."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError

wp = pytest.importorskip("warp")
WORLDS = 3
FOAM = Path(__file__).parents[2] / "data" / "foam.toml"
"""A design with a cover 2 mm thick."""
MODEL = """<mujoco><worldbody>
 <geom name="floor" type="plane" size="2 2 .1" euler="180 0 0" pos="0 0 .62"/>
 <body name="arm" pos="0 0 .57"><freejoint/><geom name="forearm" type="sphere" size=".03"/></body>
 <body name="robot" pos="0 0 .5">
  <geom name="link" type="sphere" size=".03" pos="0 0 -.05"/>
  <site name="skin_a"/><site name="skin_b" pos=".05 0 0"/><site name="palm" pos="-.05 0 0"/></body>
</worldbody></mujoco>"""


class OnMujoco:
    """A floor above two sensors, and a ball between; MuJoCo Warp."""

    def __init__(self):
        mujoco, mjw = pytest.importorskip("mujoco"), pytest.importorskip("mujoco_warp")
        from capsense.adapters.mujoco_warp import CapacitiveSensors

        self.model = mujoco.MjModel.from_xml_string(MODEL)
        data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, data)
        self.kind, self.mjw = CapacitiveSensors, mjw
        self.state = mjw.put_data(self.model, data, nworld=WORLDS)
        self.there = mjw.put_model(self.model)
        sizes = np.tile(self.model.geom_size[None].astype(np.float32), (WORLDS, 1, 1))
        self.there.geom_size = wp.array(sizes, dtype=wp.vec3, device="cpu")
        self.source = self.model, self.state
        self.options = {"warp_model": self.there}

    def move(self, heights):
        places = self.state.qpos.numpy()
        places[:, 2] = heights
        wp.copy(self.state.qpos, wp.array(places, dtype=wp.float32, device="cpu"))
        self.mjw.kinematics(self.there, self.state)

    def resize(self, radii):
        sizes = self.there.geom_size.numpy()
        sizes[:, 1, 0] = radii
        wp.copy(self.there.geom_size, wp.array(sizes, dtype=wp.vec3, device="cpu"))

    def draw(self, sensors):
        import mujoco

        scene = mujoco.MjvScene(self.model, maxgeom=100)
        count = sensors.draw(scene, world=1)
        assert scene.ngeom == count > 0
        return np.array([g.pos for g in scene.geoms[:count]])  # where lines begin


class OnNewton:
    """The same on Newton."""

    def __init__(self):
        newton = pytest.importorskip("newton")
        from capsense.adapters.newton import SensorCapacitance

        still = wp.quat_identity()
        world = newton.ModelBuilder()
        robot = world.add_body(xform=wp.transform((0.0, 0.0, 0.5), still), label="robot")
        world.add_shape_sphere(
            robot, xform=wp.transform((0.0, 0.0, -0.05), still), radius=0.03, label="link"
        )
        for name, x in (("skin_a", 0.0), ("skin_b", 0.05), ("palm", -0.05)):
            world.add_site(robot, xform=wp.transform((x, 0.0, 0.0), still), label=name)
        arm = world.add_body(xform=wp.transform((0.0, 0.0, 0.57), still), label="arm")
        world.add_shape_sphere(arm, radius=0.03, label="forearm")
        builder = newton.ModelBuilder()
        builder.replicate(world, WORLDS)
        over = wp.transform((0.0, 0.0, 0.62), wp.quat(1.0, 0.0, 0.0, 0.0))
        builder.add_shape_plane(xform=over, label="floor")
        self.model = builder.finalize(device="cpu")
        self.kind, self.state, self.options = SensorCapacitance, self.model.state(), {}
        self.source = (self.model,)
        self.viewer = newton.viewer.ViewerNull

    def move(self, heights):
        bodies = self.state.body_q.numpy()
        bodies[1::2, 2] = heights
        wp.copy(self.state.body_q, wp.array(bodies, dtype=wp.transform, device="cpu"))

    def resize(self, radii):
        sizes = self.model.shape_scale.numpy()
        mine = [k for k, label in enumerate(self.model.shape_label) if label.endswith("forearm")]
        sizes[mine, 0] = radii
        wp.copy(self.model.shape_scale, wp.array(sizes, dtype=wp.vec3, device="cpu"))

    def draw(self, sensors):
        viewer, told = self.viewer(), []
        viewer.log_lines = lambda name, starts, ends, colours: told.extend([starts, ends, colours])
        sensors.draw(viewer, environments=[1])
        starts, ends, colours = (values.numpy() for values in told)
        assert starts.shape == ends.shape == colours.shape
        return starts


@pytest.fixture(params=[OnMujoco, OnNewton], ids=["mujoco_warp", "newton"])
def stack(request):
    return request.param()


def made(stack, sites="skin_*", design="patch", material="human", **options):
    given = {"materials": {"*forearm": material}, **stack.options, **options}
    star = "" if isinstance(stack, OnMujoco) else "*"
    return stack.kind(*stack.source, star + sites, design, **given)


def truth(radius, height, x=0.0, design="patch"):
    """A ball over the sensor, and a floor above it as the attached sensors have it."""
    simulator = cs.Simulator(design)
    edge = float(np.linalg.norm(simulator.design.domain.size))
    thick = 0.1 * edge
    return simulator.step(cs.Scene([
        cs.Body(cs.Sphere(radius), cs.Pose((-x, 0, height)), "human"),
        cs.Body(cs.Box((edge, edge, thick)), cs.Pose((0, 0, 0.12 + 0.5 * thick))),
    ])).delta  # fmt: skip


def test_planes_and_sizes_of_each_world(stack):
    """Differential: against scenes made by hand, before and after the simulator draws sizes."""
    sensors = made(stack)
    assert {name.rpartition("/")[2] for name in sensors.names} == {"floor", "link", "forearm"}
    stack.move([0.56, 0.57, 0.58])
    for radii in ([0.03, 0.03, 0.03], [0.02, 0.025, 0.035]):
        stack.resize(radii)
        delta = sensors.read(stack.state).delta
        assert delta.shape == (WORLDS, 2, 4, 4) or delta.shape[:2] == (WORLDS, 2)
        for w, (radius, height) in enumerate(zip(radii, (0.06, 0.07, 0.08), strict=True)):
            for s, x in enumerate((0.0, 0.05)):
                wanted = truth(radius, height, x)
                assert np.abs(delta[w, s] - wanted).max() < 2e-3 * np.abs(wanted).max()


def test_record_of_worlds_that_are_due(stack):
    """Known values: those due are read and kept with their times; a reset clears the others'."""
    sensors = made(stack, readout="fdc1004", seed=3, history_length=2)
    times = [0.1, 0.1, 0.1]
    stack.move([0.57, 0.57, 0.57])
    sensors.read(stack.state, time=times)
    first = {name: values.numpy().copy() for name, values in sensors.data.arrays()}
    stack.move([0.56, 0.56, 0.56])
    times = [0.2, 9.0, 0.3]
    reading = sensors.read(stack.state, time=times, environments=[0, 2])
    data, history = sensors.data, sensors.data.history
    np.testing.assert_allclose(data.time.numpy(), [0.2, 0.1, 0.3])
    np.testing.assert_allclose(history.time.numpy(), [[0.2, 0.1], [0.1, 0.0], [0.3, 0.1]])
    now = {name: values.numpy() for name, values in data.arrays()}
    assert set(now) == {
        "time", "capacitance", "delta", "error", "conductance", "codes", "measured", "ages",
    }  # fmt: skip
    for name, values in now.items():
        np.testing.assert_array_equal(values[1], first[name][1], err_msg=name)
        kept = getattr(history, name).numpy()
        np.testing.assert_array_equal(kept[0, 1].ravel(), first[name][0].ravel(), err_msg=name)
        np.testing.assert_array_equal(kept[0, 0].ravel(), values[0].ravel(), err_msg=name)
    assert (now["delta"][[0, 2], 0, 0, 0] > first["delta"][[0, 2], 0, 0, 0]).all()
    np.testing.assert_array_equal(now["codes"], reading.held.code)
    assert now["codes"].dtype == np.int64
    assert now["codes"].all()
    tensors = data.torch()
    n = len(sensors.design.electrodes)
    assert tensors.history.delta.shape == (WORLDS, 2, 2, n, n)
    sensors.reset([1])
    assert not data.codes.numpy()[1].any()
    assert np.isinf(data.ages.numpy()[1]).all()
    assert data.codes.numpy()[0].all()
    sensors.read(stack.state, time=[0.25, 0.05, 0.35])  # world 1 has begun anew
    assert (data.ages.numpy()[1] < 0.05).all()


def test_conductance_and_touch(stack):
    """Known values: wet matter conducts; what is pressed onto a cover is told."""
    from capsense.design import load_design

    wet = cs.Material("wet", 30.0, 1e-4)
    sensors = made(stack, "skin_a", load_design(FOAM), wet)
    stack.move([0.5319, 0.54, 0.57])
    sensors.read(stack.state)
    data = sensors.data
    # on a foundation, E π R d² / thickness; between the two electrodes
    wanted = 60e3 * np.pi * 0.03 * 1e-4**2 / 0.002
    np.testing.assert_allclose(data.total.numpy()[:, 0], [wanted, 0.0, 0.0], rtol=0.1)
    assert data.force.numpy().shape == data.compression.numpy().shape == (WORLDS, 1, 2)
    assert (data.conductance.numpy()[1:, 0, 0, 0] > 0.0).all()


def test_electrodes_are_drawn(stack):
    """Known values: lines lie on the electrodes of both sensors; the nearer is the louder."""
    sensors = made(stack)
    stack.move([0.55, 0.57, 0.6])
    sensors.read(stack.state)
    starts, ends, colours = sensors.electrode_lines([1])
    rims = np.concatenate([e.surface.rims for e in sensors.design.electrodes])
    count = len(rims)
    assert starts.shape == (2 * count, 3)
    for s, x in enumerate((0.0, 0.05)):
        part = slice(s * count, (s + 1) * count)
        np.testing.assert_allclose(starts[part] - [x, 0, 0.5], rims[:, 0], atol=1e-6)
        np.testing.assert_allclose(ends[part] - [x, 0, 0.5], rims[:, 1], atol=1e-6)
    assert ((colours >= 0) & (colours <= 1)).all()
    assert len(sensors.electrode_lines()[0]) == WORLDS * 2 * count
    near, far = (sensors.electrode_lines([w])[2][0] for w in (0, 2))
    assert near[0] - near[2] > far[0] - far[2]  # redder
    np.testing.assert_allclose(stack.draw(sensors), starts, atol=1e-6)


def test_sites_of_several_designs(stack):
    """Differential: as one object for each design."""
    star = "" if isinstance(stack, OnMujoco) else "*"
    both = stack.kind.by_design(
        *stack.source, designs={f"{star}skin_*": "patch", f"{star}palm": "six_patch"},
        materials={"*forearm": "human"}, **stack.options,
    )  # fmt: skip
    found = both.read(stack.state)
    assert list(found) == list(both) == ["patch", "six_patch"]
    assert found["patch"].delta.shape[:2] == (WORLDS, 2)
    alone = made(stack, "palm", "six_patch")
    np.testing.assert_array_equal(found["six_patch"].delta, alone.read(stack.state).delta)
    assert both.data["six_patch"].delta.shape == (WORLDS, 1, 6, 6)
    both.reset([0])
    assert not both.data["patch"].delta.numpy()[0].any()
    with pytest.raises(SceneError, match="designs is empty"):
        stack.kind.by_design(*stack.source, designs={})


def test_refused(stack):
    """Errors name the thing and the fix."""
    with pytest.raises(SceneError, match="history_length is -1; give a whole number"):
        made(stack, history_length=-1)
    with pytest.raises(cs.errors.ReadoutError, match="fdc1005"):
        made(stack, readout="fdc1005")
    sensors = made(stack)
    with pytest.raises(SceneError, match="numbers from 0 to 2, or a mask of 3"):
        sensors.read(stack.state, environments=[3])
    with pytest.raises(SceneError, match="numbers from 0 to 2"):
        sensors.reset([5])
    with pytest.raises(SceneError, match="numbers from 0 to 2"):
        sensors.electrode_lines([3])


HILLS = """<mujoco><asset>
 <hfield name="hills" nrow="13" ncol="17" size=".8 .6 .2 .1"/></asset><worldbody>
 <geom name="hills" type="hfield" hfield="hills" pos=".1 0 0"/>
 <body name="robot" pos="0 0 .3"><freejoint/>
  <geom name="link" type="sphere" size=".01" pos="0 0 .1"/>
  <site name="left" pos="0 .03 0" euler="180 0 0"/>
  <site name="right" pos="0 -.03 0" euler="180 0 0"/>
 </body></worldbody></mujoco>"""
PLACES = np.array([[0.0, 0.0, 0.28], [0.45, -0.2, 0.26], [-0.38, 0.22, 0.27]])


def hills():
    """Heights from 0 to 1 of 13 rows along y and 17 columns along x."""
    x, y = np.meshgrid(np.linspace(-1, 1, 17), np.linspace(-1, 1, 13))
    return (0.5 + 0.5 * np.cos(3 * x + 1) * np.cos(2 * y)).astype(np.float32)


def attached(model, places):
    """Readings of both sensors at some places, one by one, shape (places, 2, n, n)."""
    import mujoco

    data, out = mujoco.MjData(model), []
    for place in places:
        data.qpos[:3] = place
        mujoco.mj_forward(model, data)
        sensors = [
            cs.mujoco.attach(model, data, site, cs.Simulator("patch")) for site in ("left", "right")
        ]
        out.append([sensor.read().delta for sensor in sensors])
    return np.array(out)


def test_terrains():
    """Differential: against attached sensors, over tiles that differ, and after a walk."""
    mujoco, mjw = pytest.importorskip("mujoco"), pytest.importorskip("mujoco_warp")
    newton = pytest.importorskip("newton")
    from capsense.adapters.mujoco_warp import CapacitiveSensors
    from capsense.adapters.newton import SensorCapacitance

    model = mujoco.MjModel.from_xml_string(HILLS)
    model.hfield_data[:] = hills().ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    state = mjw.put_data(model, data, nworld=WORLDS)
    there = mjw.put_model(model)
    sensors = CapacitiveSensors(model, state, ["left", "right"], "patch")
    assert sensors.names == ("world/hills", "world/hills", "robot/link")

    builder, still = newton.ModelBuilder(), wp.quat_identity()
    world, down = newton.ModelBuilder(), wp.quat(1.0, 0.0, 0.0, 0.0)
    robot = world.add_body(label="robot")
    world.add_shape_sphere(
        robot, xform=wp.transform((0.0, 0.0, 0.1), still), radius=0.01, label="link"
    )
    for name, y in (("left", 0.03), ("right", -0.03)):
        world.add_site(robot, xform=wp.transform((0.0, y, 0.0), down), label=name)
    builder.replicate(world, WORLDS)
    low, high = (0.2 * float(edge) for edge in (hills().min(), hills().max()))
    field = newton.Heightfield(hills(), 13, 17, 0.8, 0.6, min_z=low, max_z=high)
    field_at = wp.transform((0.1, 0.0, 0.0), still)
    builder.add_shape_heightfield(heightfield=field, xform=field_at, label="hills")
    whole = builder.finalize(device="cpu")
    same, bodies = SensorCapacitance(whole, ["*left", "*right"], "patch"), whole.state()

    for places in (PLACES, PLACES[[1, 2, 0]]):
        truth = attached(model, places)
        states = state.qpos.numpy()
        states[:, :3] = places
        wp.copy(state.qpos, wp.array(states, dtype=wp.float32, device="cpu"))
        mjw.kinematics(there, state)
        poses = np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0], np.float32), (WORLDS, 1))
        poses[:, :3] = places
        wp.copy(bodies.body_q, wp.array(poses, dtype=wp.transform, device="cpu"))
        for found in (sensors.read(state).delta, same.read(bodies).delta):
            off = np.abs(found - truth).max(axis=(2, 3))
            assert (off < 2e-3 * np.abs(truth).max(axis=(2, 3))).all()
    assert len(sensors.terrains[0].known) == 4


def example_of(heading):
    """The example on the page about fleets that follows a line with that beginning."""
    page = (Path(__file__).parents[3] / "docs" / "fleets.md").read_text()
    return page.partition(f"\n{heading}")[2].partition("```py\n")[2].partition("```")[0]


def test_examples_of_the_page(stack):
    """Known values: those of MuJoCo Warp and Newton run as they are, but for the physics."""
    from types import SimpleNamespace

    heading = "MuJoCo Warp (`" if isinstance(stack, OnMujoco) else "Newton (`"
    names = {"model": stack.model, "data": stack.state, "state": stack.state}
    if isinstance(stack, OnMujoco):
        names["mujoco_warp"] = SimpleNamespace(step=lambda model, data: None)
        names["warp_model"] = stack.there
        wp.copy(stack.state.time, wp.array([0.1] * WORLDS, dtype=float, device="cpu"))
    else:
        names["viewer"] = stack.viewer()
    exec(example_of(heading), names)
    assert names["codes"].shape == (WORLDS, 2, 6)
