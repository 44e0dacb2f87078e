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
    for name, value in (("requests", {}), ("sites", {}), ("model", None), ("state", None)):
        monkeypatch.setattr(manager, name, value)
    from capsense.adapters import isaac_lab

    return isaac_lab, manager


def start(manager, per_env=1):
    """Build the model as Isaac Lab does: sites first, then the environments, then a state."""
    world = newton.ModelBuilder()
    robot = world.add_body(xform=wp.transform((0.0, 0.0, 0.5), wp.quat_identity()), label="robot")
    world.add_shape_sphere(
        robot, xform=wp.transform((0.0, 0.0, -0.05), wp.quat_identity()), radius=0.03, label="link"
    )
    sites = {
        label: world.add_site(robot, xform=xform, label=label)
        for label, (_, xform) in manager.requests.items()
    }
    arm = world.add_body(xform=wp.transform((0.0, 0.0, 0.58), wp.quat_identity()), label="arm")
    world.add_shape_sphere(arm, radius=0.03, label="forearm")
    shapes = world.shape_count
    builder = newton.ModelBuilder()
    builder.replicate(world, ENVS)
    manager.model = builder.finalize(device="cpu")
    manager.state = manager.model.state()
    manager.sites = {
        label: (None, [[e * shapes + k] * per_env for e in range(ENVS)])
        for label, k in sites.items()
    }


def move(manager, env, height):
    bodies = manager.state.body_q.numpy()
    bodies[2 * env + 1, 2] = height
    wp.copy(manager.state.body_q, wp.array(bodies, dtype=wp.transform, device="cpu"))


def test_steps_are_those_of_the_newton_sensor(lab):
    """Differential: against ``SensorCapacitance``; only what is out of date is read anew."""
    from capsense.adapters.newton import SensorCapacitance

    module, manager = lab
    offsets = [((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)), ((0.03, 0.0, 0.0), (0.0, 0.1, 0.0, 0.995))]
    cfg = module.CapacitiveSensorCfg(
        prim_path="{ENV_REGEX_NS}/Robot", offsets=offsets, update_period=0.02,
        options={"materials": {"*forearm": "human"}},
    )  # fmt: skip
    sensor = cfg.class_type(cfg)
    with pytest.raises(AttributeError):
        _ = sensor.data  # as of Isaac Lab's own sensors before the start
    start(manager)
    sensor._initialize_callback(None)
    found = []
    other = SensorCapacitance(manager.model, "*site_*", materials={"*forearm": "human"})
    for height in (0.58, 0.56, 0.54):
        for env in range(ENVS):
            move(manager, env, height + 0.01 * env)
        sensor.update(0.01)
        found.append(sensor.data.delta.clone().numpy())
        other.update(manager.state)
    assert found[0].shape == (ENVS, 2, 6, 6)
    assert np.isfinite(found).all()
    assert (found[1] == found[0]).all()  # it is read every second step
    assert (found[2][:, 0, 0, 0] > found[1][:, 0, 0, 0]).all()
    sensor.reset([0])
    part = sensor.data.delta.numpy()
    np.testing.assert_allclose(part[0], other.delta[0], rtol=1e-5)
    sensor.reset()
    np.testing.assert_allclose(sensor.data.delta.numpy(), other.delta, rtol=1e-5)
    near = sensor.data.delta[:, 0, 0, 0]
    assert (near.diff() < 0).all()
    assert (sensor.data.capacitance - sensor.data.delta)[0, 0, 0, 0] > 1e-13
    sensor._invalidate_initialize_callback(None)
    assert sensor.newton_sensor is None


def test_refused(lab):
    """Errors name the thing and the fix."""
    module, manager = lab
    cfg = module.CapacitiveSensorCfg(prim_path="/World/envs/env_.*/Hand.*")
    sensor = cfg.class_type(cfg)
    start(manager, per_env=2)
    with pytest.raises(SceneError, match=r"fits \[2\] bodies in an environment"):
        sensor._initialize_callback(None)
    model, manager.model = manager.model, None
    with pytest.raises(AttributeError):
        sensor._initialize_callback(None)  # the stub counts environments on the model
    manager.model = model
