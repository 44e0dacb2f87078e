"""Sensors in Genesis, against scenes made by hand; with the real package, where it is installed."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import capsense as cs

gs = pytest.importorskip("genesis")
torch = pytest.importorskip("torch")
ROBOT = """<mujoco><worldbody><body name="palm" pos="0 0 1"><geom type="sphere" size=".01"/>
 <body name="finger_a" pos=".85 .35 -.84"><joint type="slide" axis="0 0 1"/>
  <geom type="box" size=".01 .01 .01" mass="1"/></body>
 <body name="finger_b" pos="-1 0 -.94"><joint type="slide" axis="0 0 1"/>
  <geom type="box" size=".01 .01 .01" mass="1"/></body></body></worldbody></mujoco>"""
HEIGHT, RADIUS = 0.06, 0.01
"""Of both fingers above the ground, and of a ball [m]."""


def test_example_and_both_kinds_of_sensors():
    """Differential and measured: finite, varying, highest level with the pad, as by hand."""
    from capsense.adapters.genesis import GenesisSensors, LinkSite

    path = Path(__file__).parents[3] / "examples" / "fleet_genesis.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    scenes, scene_class = [], gs.Scene

    def made(*args, **options):
        scenes.append(scene_class(*args, **options))
        return scenes[-1]

    module.gs.Scene = made
    try:
        found = module.main(3)
    finally:
        module.gs.Scene = scene_class
    assert found.shape == (10, 3, 6, 6)
    assert np.isfinite(found).all()
    near = found[:, 0].trace(axis1=1, axis2=2)
    assert near.argmax() in (5, 6)  # 0.2 m below after 0.2 s
    assert near.max() > 20 * near[0]
    assert (np.diff(found[6, :, 0, 0]) < 0).all()

    # the class beside the scene, at the state that the run has left
    (scene,) = scenes
    wall, arm = scene.sim.rigid_solver.entities
    arm.set_pos(torch.tensor([[0.09, 0.01, 1.02], [0.1, 0.0, 1.0], [0.11, 0.0, 0.97]]))
    half = 0.5**0.5
    site = LinkSite(wall.links[0], (0.02, 0.0, 0.0), (0.0, half, 0.0, half))
    sensors = GenesisSensors(scene, [site], materials={"cylinder*": "human"})
    delta = sensors.read().delta
    simulator = cs.Simulator("six_patch")
    seen = cs.Pose((0.0, 0.0, 1.0), (0.0, half, 0.0, half)).inverse()
    shape = cs.Cylinder(0.035, 0.24)
    for e in range(3):
        place, turn = (
            x[e].numpy(force=True).astype(float) for x in (arm.get_pos(), arm.get_quat())
        )
        body = cs.Body(shape, seen @ cs.Pose(place, np.roll(turn, -1)), "human")
        truth = simulator.step(cs.Scene([body])).delta
        assert np.abs(delta[e, 0] - truth).max() < 1e-4 * np.abs(truth).max()
    assert sensors.names[-1] == "cylinder_baselink"


def over_ground(height=None):
    """The reading of a sensor that looks down from a finger, with a ball at some height or not."""
    simulator = cs.Simulator("patch")
    edge = float(np.linalg.norm(simulator.design.domain.size))
    thick = 0.1 * edge
    bodies = [cs.Body(cs.Box((edge, edge, thick)), cs.Pose((0, 0, HEIGHT + 0.5 * thick)))]
    if height is not None:
        bodies.append(cs.Body(cs.Sphere(RADIUS), cs.Pose((0, 0, HEIGHT - height)), "human"))
    return simulator.step(cs.Scene(bodies)).delta


class Context:
    """Keeps the meshes that are drawn."""

    rendered_envs_idx = (1, 0)

    def make_debug_mesh(self, mesh, T):
        return mesh, T


def test_chips_clocks_grounds_and_resets(tmp_path):
    """Differential: against scenes made by hand, and sensors beside the scene, read when due."""
    from capsense._style import signal_colours, strength
    from capsense.adapters.genesis import Capacitance, GenesisSensors, LinkSite

    if not gs._initialized:
        gs.init(backend=gs.cpu, logging_level="warning")
    (tmp_path / "robot.xml").write_text(ROBOT)
    dt, count = 0.005, 2
    scene = gs.Scene(
        sim_options=gs.options.SimOptions(dt=dt, gravity=(0.0, 0.0, 0.0)),
        rigid_options=gs.options.RigidOptions(enable_collision=False, disable_constraint=True),
        show_viewer=False,
    )
    scene.add_entity(gs.morphs.Plane())
    heights = np.zeros((12, 14))
    heights[6:] = 20.0  # beyond x = 0.6 m the ground is 0.1 m high
    scene.add_entity(
        gs.morphs.Terrain(height_field=heights, horizontal_scale=0.1, vertical_scale=0.005)
    )
    robot = scene.add_entity(gs.morphs.MJCF(file=str(tmp_path / "robot.xml")))
    ball = scene.add_entity(gs.morphs.Sphere(radius=RADIUS, pos=(-1.0, 0.0, 0.03)))
    how = {"materials": {"sphere*": "human"}}
    names = cs.Simulator("patch").electrode_names
    chip = cs.Readout.preset("fdc1004", names, noise=False)
    skin = scene.add_sensor(
        Capacitance(
            entity_idx=robot.idx, links=("finger_*",), euler_offset=(180.0, 0.0, 0.0),
            design="patch", readout=chip, update_period=2 * dt, history_length=2,
            options=how,
        )
    )  # fmt: skip
    bare = scene.add_sensor(
        Capacitance(
            entity_idx=robot.idx, links=("finger_b",), design="patch", options=how, noise=1e-15
        )
    )
    with pytest.raises(cs.errors.SceneError, match=r"no link fits 'thumb'; there are .*finger_a"):
        scene.add_sensor(Capacitance(entity_idx=robot.idx, links=("thumb",), design="patch"))
    scene.build(n_envs=count)

    fingers = [link for link in robot.links if link.name.startswith("finger")]
    assert [link.name for link in fingers] == ["finger_a", "finger_b"]
    sites = [LinkSite(link, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)) for link in fingers]
    beside = GenesisSensors(scene, sites, "patch", readout=chip, **how)
    empty = beside.fleet.empty.capacitance

    def is_blank(reading, env):
        assert not reading.delta[env].any()
        assert not reading.codes[env].any()
        assert torch.isinf(reading.ages[env]).all()
        assert not reading.time[env].any()
        np.testing.assert_allclose(
            reading.capacitance[env].numpy(force=True),
            np.broadcast_to(empty, (2, 2, 4, 4)), rtol=1e-6,
        )  # fmt: skip

    for env in range(count):
        is_blank(skin.read(), env)
    read_at, before = np.full(count, -np.inf), None
    for k in range(8):
        places = torch.tensor([[-1.0, 0.0, 0.02 + 0.002 * k], [-1.0, 0.0, 0.03]])
        ball.set_pos(places)
        scene.step()
        clock = np.broadcast_to(scene.sim.get_time().numpy(force=True), count).astype(float)
        due = clock - read_at + 1e-6 >= 2 * dt
        assert due.tolist() == [k % 2 == 0, k in (0, 2, 4, 5, 7)]
        beside.read(time=clock, environments=due)
        read_at = np.where(due, clock, read_at)
        found, truth = skin.read(), beside.data.torch()
        assert found.delta.shape == (count, 2, 2, 4, 4)
        assert found.codes.shape == (count, 2, 2, 4)
        for name in ("capacitance", "delta", "error", "conductance", "codes", "measured", "ages"):
            now = getattr(found, name)[:, 0].numpy(force=True)
            np.testing.assert_allclose(now, getattr(truth, name), rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(found.time[:, 0, 0].numpy(force=True), read_at, rtol=1e-6)
        for env in range(count):
            for site, height in enumerate((None, float(places[env, 2]))):
                wanted = over_ground(height)
                off = np.abs(found.delta[env, 0, site].numpy(force=True) - wanted)
                if due[env]:
                    assert off.max() < 0.01 * np.abs(wanted).max(), (k, env, site)
        if before is not None and k < 5:
            np.testing.assert_array_equal(found.delta[:, 1], before.delta[:, 0])
        before = found
        noisy, clean = bare.read(), bare.read_ground_truth()
        assert noisy.codes.shape == (count, 1, 0)
        if k < 4:
            assert 2e-16 < float((noisy.delta - clean.delta).std()) < 5e-15
        else:  # only the resolution is left
            steps = noisy.capacitance / 1e-14
            assert float((steps - steps.round()).abs().max()) < 1e-3
            assert (noisy.capacitance != clean.capacitance).any()
        for name in ("error", "time", "total"):
            np.testing.assert_array_equal(getattr(noisy, name), getattr(clean, name))
        if k == 3:
            bare.set_noise(0.0)
            bare.set_resolution(1e-14)
        if k == 4:
            assert (found.codes[:, 0, :, 0] != 0).all()
            scene.reset(envs_idx=[1])
            beside.reset([1])
            read_at[1] = -np.inf
            is_blank(skin.read(), 1)
            is_blank(skin.read_ground_truth(), 1)
            np.testing.assert_array_equal(skin.read().codes[0], found.codes[0])
    assert found.time[0, 0, 0] > 0.03
    assert found.time[1, 0, 0] < 0.02

    electrodes = beside.design.electrodes
    rim = np.concatenate([e.surface.triangles for e in electrodes]).reshape(-1, 3).max(axis=0)[:2]
    drawn = skin._draw_debug(Context(), [0, 1])
    assert len(drawn) == 2
    for site, ((_, (mesh, frames), _), link) in enumerate(zip(drawn, fingers, strict=True)):
        assert frames.shape == (2, 4, 4)
        corners = mesh.vertices @ frames[0, :3, :3].T + frames[0, :3, 3]
        where = link.get_pos()[1].numpy(force=True)
        np.testing.assert_allclose(corners.min(axis=0)[:2], where[:2] - rim, atol=1e-6)
        change = found.delta[1, 0, site].diagonal().numpy(force=True)
        wanted = np.unique(signal_colours(strength(change)).astype(np.uint8), axis=0)
        shown = np.unique(mesh.visual.vertex_colors[:, :3], axis=0)
        np.testing.assert_array_equal(shown, wanted)
