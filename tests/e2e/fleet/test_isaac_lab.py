"""The sensor for Isaac Lab, on a stub of it with a real Newton model behind."""

from __future__ import annotations

import numpy as np
import pytest

from capsense.errors import SceneError

newton = pytest.importorskip("newton")
torch = pytest.importorskip("torch")
wp = pytest.importorskip("warp")
ENVS = 3


@pytest.fixture
def lab(monkeypatch):
    """The adapter's module; a manager without a model."""
    import isaac_lab_stub

    isaac_lab_stub.install()
    manager = isaac_lab_stub.NewtonManager
    monkeypatch.setattr(isaac_lab_stub.SimulationContext, "one", None)
    isaac_lab_stub.SimulationContext()
    for name, value in (("requests", {}), ("sites", {}), ("model", None), ("state", None)):
        monkeypatch.setattr(manager, name, value)
    from capsense.adapters import isaac_lab

    return isaac_lab, manager


def start(manager, bodies=("robot",)):
    """Build the model as Isaac Lab does: sites first, then the environments, then a state."""
    world = newton.ModelBuilder()
    robot = world.add_body(xform=wp.transform((0.0, 0.0, 0.5), wp.quat_identity()), label="robot")
    world.add_shape_sphere(
        robot, xform=wp.transform((0.0, 0.0, -0.05), wp.quat_identity()), radius=0.03, label="link"
    )
    arm = world.add_body(xform=wp.transform((0.0, 0.0, 0.58), wp.quat_identity()), label="arm")
    world.add_shape_sphere(arm, radius=0.03, label="forearm")
    links = {"robot": robot, "arm": arm}
    sites = {
        label: [world.add_site(links[b], xform=xform, label=f"{b}_{label}") for b in bodies]
        for label, (_, xform) in manager.requests.items()
    }
    shapes = world.shape_count
    builder = newton.ModelBuilder()
    builder.replicate(world, ENVS)
    manager.model = builder.finalize(device="cpu")
    manager.state = manager.model.state()
    manager.sites = {
        label: (None, [[e * shapes + k for k in mine] for e in range(ENVS)])
        for label, mine in sites.items()
    }


def move(manager, env, height):
    bodies = manager.state.body_q.numpy()
    bodies[2 * env + 1, 2] = height
    wp.copy(manager.state.body_q, wp.array(bodies, dtype=wp.transform, device="cpu"))


def test_steps_are_those_of_the_newton_sensor(lab):
    """Differential: against ``SensorCapacitance``; only environments that are due are read."""
    from capsense.adapters.newton import SensorCapacitance

    module, manager = lab
    offsets = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), ((0.03, 0.0, 0.0), (0.0, 0.1, 0.0, 0.995))]
    cfg = module.CapacitiveSensorCfg(
        prim_path="{ENV_REGEX_NS}/Robot", offsets=offsets, update_period=0.02, readout="fdc1004",
        seed=2, history_length=2, options={"materials": {"*forearm": "human"}},
    )  # fmt: skip
    sensor = cfg.class_type(cfg)
    with pytest.raises(AttributeError):
        _ = sensor.data  # as of Isaac Lab's own sensors before the start
    start(manager)
    sensor._initialize_callback(None)
    found = []
    other = SensorCapacitance(
        manager.model, "*site_*", readout="fdc1004", seed=2, materials={"*forearm": "human"}
    )
    solved = []
    fleet = sensor.newton_sensors["six_patch"].fleet
    step, clock = fleet.step, np.zeros(ENVS)
    fleet.step = lambda *args, **kw: solved.append(kw["environments"].copy()) or step(*args, **kw)
    for k, height in enumerate((0.58, 0.56, 0.54, 0.53, 0.52)):
        for env in range(ENVS):
            move(manager, env, height + 0.01 * env)
        sensor.update(0.01)
        clock += 0.01
        due = sensor._is_outdated.numpy().copy()
        data = sensor.data
        _ = sensor.data  # is not solved again
        other.update(manager.state, time=clock, environments=due)
        truth = other.data.torch()
        for name in ("delta", "error", "conductance", "codes", "measured", "ages", "time"):
            np.testing.assert_array_equal(getattr(data, name), getattr(truth, name), err_msg=name)
        found.append(data.delta.clone().numpy())
        if k == 2:
            sensor.reset([0])
            other.reset([0])
            clock[0] = 0.0
            assert not sensor.data.codes[0].any()
            assert not sensor.data.delta[0].any()
            assert torch.isinf(sensor.data.ages[0]).all()
            assert sensor.data.delta[1:].any()
    assert found[0].shape == (ENVS, 2, 6, 6)
    assert sensor.data.codes.shape == (ENVS, 2, 6)
    assert (found[1] == found[0]).all()  # the period is two steps
    assert (found[2][:, 0, 0, 0] > found[1][:, 0, 0, 0]).all()
    assert not found[3][0].any()  # has no reading since its reset
    assert (np.array([mask for mask in solved if mask.any()]) == [
        [True] * 3, [True] * 3, [True] * 3,
    ]).all()  # fmt: skip
    assert len([mask for mask in solved if mask.any()]) == 3
    np.testing.assert_allclose(sensor.data.time, [0.02, 0.05, 0.05], atol=1e-9)
    np.testing.assert_allclose(sensor.data.history.time[1], [0.05, 0.03], atol=1e-9)
    assert sensor.data.history.delta.shape == (ENVS, 2, 2, 6, 6)
    sensor._invalidate_initialize_callback(None)
    assert sensor.newton_sensors is None


def test_several_bodies_and_designs(lab):
    """Known values: a sensor on each body that the path fits; each design by its name."""
    module, manager = lab
    cfg = module.CapacitiveSensorCfg(
        prim_path="{ENV_REGEX_NS}/.*", design={"*robot": "patch", "*": "six_patch"},
        options={"exclude_own": False},
    )  # fmt: skip
    sensor = cfg.class_type(cfg)
    start(manager, bodies=("robot", "arm"))
    sensor._initialize_callback(None)
    data = sensor.data
    assert {name: tuple(part.delta.shape[:3]) for name, part in data.items()} == {
        "patch": (ENVS, 1, len(sensor.newton_sensors["patch"].design.electrodes)),
        "six_patch": (ENVS, 1, 6),
    }  # fmt: skip
    carriers = {name: tuple(x.rpartition("/")[2] for x in each) for name, each in
                sensor.sensor_names.items()}  # fmt: skip
    assert carriers == {"patch": ("robot",), "six_patch": ("arm",)}
    one = module.CapacitiveSensorCfg(prim_path="x", design={"*hand": "patch"})
    lone = one.class_type(one)
    lone._labels = sensor._labels
    with pytest.raises(SceneError, match="no design is given for"):
        lone._initialize_callback(None)


def test_sizes_that_a_reset_draws_are_followed(lab):
    """Differential: against a sensor that is made after the sizes were drawn."""
    from capsense.adapters.newton import SensorCapacitance

    module, manager = lab
    cfg = module.CapacitiveSensorCfg(prim_path="{ENV_REGEX_NS}/Robot")
    sensor = cfg.class_type(cfg)
    start(manager)
    sensor._initialize_callback(None)
    before = sensor.data.delta.clone()
    sensor.reset([1, 2])
    sizes = manager.model.shape_scale.numpy()
    mine = [k for k, label in enumerate(manager.model.shape_label) if label.endswith("forearm")]
    sizes[mine, 0] = [0.03, 0.02, 0.04]
    wp.copy(manager.model.shape_scale, wp.array(sizes, dtype=wp.vec3, device="cpu"))
    sensor.update(0.01)
    other = SensorCapacitance(manager.model, "*site_*")
    other.update(manager.state)
    np.testing.assert_allclose(sensor.data.delta, other.delta, rtol=1e-5)
    assert (sensor.data.delta[1:, 0, 0, 0] != before[1:, 0, 0, 0]).all()


def test_electrodes_are_drawn(lab):
    """Known values: boxes lie along the electrodes' edges, one block for each line."""
    module, manager = lab
    import isaac_lab_stub

    cfg = module.CapacitiveSensorCfg(prim_path="{ENV_REGEX_NS}/Robot", debug_vis=True)
    sensor = cfg.class_type(cfg)
    start(manager)
    sensor._initialize_callback(None)
    context = isaac_lab_stub.SimulationContext.instance()
    context.vis_marker_registry.dispatch_callbacks()
    shown = {name: values.numpy() for name, values in sensor._markers.shown.items()}
    starts, ends, _ = sensor.newton_sensors["six_patch"].electrode_lines([0])
    middle, turn = shown["translations"][::ENVS], shown["orientations"][::ENVS]
    np.testing.assert_allclose(middle, 0.5 * (starts + ends), atol=1e-6)
    x, y, z, w = turn.T
    along = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1)
    reach = along * shown["scales"][::ENVS, :1]
    np.testing.assert_allclose(reach, ends - starts, atol=1e-6)
    sensor.set_debug_vis(False)
    assert not sensor._markers.visible
    assert not context.vis_marker_registry.callbacks


def test_refused(lab):
    """Errors name the thing and the fix."""
    module, manager = lab
    cfg = module.CapacitiveSensorCfg(prim_path="/World/envs/env_.*/Hand.*")
    sensor = cfg.class_type(cfg)
    start(manager)
    for wrong in ([[0], [1, 2], [3]], [[], [], []]):
        manager.sites = {label: (None, wrong) for label in manager.sites}
        with pytest.raises(SceneError, match="bodies in an environment; give a path that fits"):
            sensor._initialize_callback(None)
    model, manager.model = manager.model, None
    with pytest.raises(AttributeError):
        sensor._initialize_callback(None)  # the stub counts environments on the model
    manager.model = model


def test_example_of_the_page(lab):
    """Known values: it runs as it is, with a scene that starts its sensor."""
    from pathlib import Path

    _, manager = lab
    page = (Path(__file__).parents[3] / "docs" / "fleets.md").read_text()
    example = page.partition("\nIsaac Lab 3, on its")[2].partition("```py\n")[2].partition("```")[0]

    class Scenes:
        def __getitem__(self, name):
            cfg = getattr(names["SceneCfg"], name)
            sensor = cfg.class_type(cfg)
            start(manager, bodies=("robot", "arm"))
            sensor._initialize_callback(None)
            sensor.update(0.02)
            return sensor

    names = {"configclass": lambda cls: cls, "InteractiveSceneCfg": object, "scene": Scenes()}
    exec(example + "\nfound = scene['skin'].data", names)
    assert names["found"].delta.shape == (ENVS, 2, 6, 6)
    assert names["found"].codes.shape == (ENVS, 2, 6)
