"""The sensor for mjlab, in a scene of it, where it is installed."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError

mjlab_sensor = pytest.importorskip("mjlab.sensor")
mujoco = pytest.importorskip("mujoco")
torch = pytest.importorskip("torch")
ROBOT = """<mujoco><worldbody><body name="base" pos="0 0 1">
 <geom name="shell" type="box" size=".01 .1 .1" pos="-.02 0 0" contype="0" conaffinity="0"/>
 <site name="pad" euler="0 90 0"/></body></worldbody></mujoco>"""
ARM = """<mujoco><worldbody><body name="arm" pos=".08 0 1.2"><freejoint/>
 <geom name="forearm" type="capsule" size=".03 .12" euler="90 0 0" mass="1" contype="0"
  conaffinity="0"/></body></worldbody></mujoco>"""
WORLDS = 3


def test_a_scene_steps():
    """Differential: against a sensor of one world; the arm falls past, highest before the pad."""
    from mjlab.entity import EntityCfg
    from mjlab.scene import Scene, SceneCfg
    from mjlab.sim import Simulation, SimulationCfg
    from mjlab.viewer.debug_visualizer import NullDebugVisualizer

    from capsense.adapters.mjlab import CapacitanceCfg

    skin = CapacitanceCfg(
        name="skin", sites=("robot/pad*",), options={"materials": {"*forearm": "human"}},
        readout="fdc1004", seed=1, update_period=0.004, history_length=2, debug_vis=True,
    )  # fmt: skip
    with pytest.raises(TypeError):
        CapacitanceCfg()
    parts = {
        name: EntityCfg(spec_fn=lambda xml=xml: mujoco.MjSpec.from_string(xml))
        for name, xml in (("robot", ROBOT), ("arm", ARM))
    }
    scene = Scene(SceneCfg(num_envs=WORLDS, entities=parts, sensors=(skin,)), device="cpu")
    model = scene.compile()
    sim = Simulation(num_envs=WORLDS, cfg=SimulationCfg(), model=model, device="cpu")
    scene.initialize(sim.mj_model, sim.model, sim.data)
    sim.data.qpos[:, 0] = torch.tensor([0.08, 0.1, 0.12])
    rows, dt = [], float(model.opt.timestep)
    steps = round(0.3 / dt)
    for k in range(steps):
        sim.step()
        scene.update(dt)
        if k % (steps // 10) == 0:
            rows.append(scene["skin"].data.delta.clone().numpy())
    found = np.array(rows)
    assert found.shape[1:] == (WORLDS, 1, 6, 6)
    assert np.isfinite(found).all()
    near = found[:, 0, 0].trace(axis1=1, axis2=2)
    assert abs(near.argmax() * (steps // 10) * dt - 0.2) < 0.04  # 0.2 m below after 0.2 s
    assert near.max() > 20 * near[0]
    assert (np.diff(found[near.argmax(), :, 0, 0, 0]) < 0).all()
    sim.forward()
    scene.update(0.0)
    skin = scene["skin"]
    data, last = skin.data, skin._read_at.clone()
    codes, clock = data.codes.clone(), steps * dt
    np.testing.assert_allclose(skin._clock, clock, rtol=1e-9)
    assert data.codes.all()
    assert (data.ages < 0.1).all()
    assert (data.time == last).all()
    skin.update(0.001)  # nothing is due
    assert (skin.data.time == last).all()
    skin.update(0.003)
    skin.reset(torch.tensor([1]))
    assert not data.codes[1].any()
    data = skin.data
    assert (data.codes[[0, 2]] != 0).all()
    assert torch.isinf(data.ages[1]).all()  # at 0 s nothing is converted yet
    np.testing.assert_allclose(data.time, [clock + 0.004, 0.0, clock + 0.004], atol=1e-9)
    assert data.history.delta.shape == (WORLDS, 2, 1, 6, 6)
    assert (data.history.time[0, 1] == last[0]).all()
    assert codes.shape == (WORLDS, 1, 6)
    now = data.delta.numpy()
    for w in range(WORLDS):
        data = mujoco.MjData(model)
        data.qpos[:] = sim.data.qpos[w].numpy()
        mujoco.mj_forward(model, data)
        sensor = cs.mujoco.attach(
            model, data, "robot/pad", cs.Simulator("six_patch"),
            materials={"*forearm": "human"},
        )  # fmt: skip
        truth = sensor.read().delta
        assert np.abs(now[w, 0] - truth).max() < 1e-4 * np.abs(truth).max()
    drawn = []

    class Lines(NullDebugVisualizer):
        def add_cylinder(self, start, end, radius, color, label=None):
            drawn.append((start, end, color, label))

    skin.debug_vis(Lines(env_idx=1))
    assert len(drawn) == len(skin.sensors["six_patch"].electrode_lines([1])[0]) > 0
    assert len({label for *_, label in drawn}) == len(drawn)

    # sizes that are drawn for each world
    sim.expand_model_fields(("geom_size",))
    scene.initialize(sim.mj_model, sim.model, sim.data)
    arm = model.geom("arm/forearm").id
    near = scene["skin"].data.delta[:, 0, 0, 0].clone()
    sim.model.geom_size[1, arm, 0] = 0.02
    scene["skin"].reset(torch.tensor([1]))
    thin = scene["skin"].data.delta[:, 0, 0, 0]
    assert (near == thin).tolist() == [True, False, True]
    other = CapacitanceCfg(name="other", sites=("robot/nose",)).build()
    with pytest.raises(SceneError, match="robot/nose"):
        other.initialize(sim.mj_model, sim.model, sim.data, "cpu")
