"""Sensors in Genesis, against scenes made by hand; with the real package, where it is installed."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import capsense as cs

gs = pytest.importorskip("genesis")
torch = pytest.importorskip("torch")


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
