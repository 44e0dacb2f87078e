"""Sensors and skins in other processes, and copies of them, after use."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import capsense as cs

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

BALL = cs.Scene([cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, 0.05)))])
CLOTH = """<flexcomp name="cloth" type="grid" count="4 4 1" spacing=".01 .01 .01" dim="2"
  pos="0 0 .05" radius=".001"/>"""


def world(body: str = "") -> tuple[Any, Any]:
    """Two sites beside a ball that slides."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0"/><worldbody><site name="a"/><site name="b" pos=".01 0 0"/>'
        '<body name="ball" pos="0 0 .05"><joint type="slide"/><geom size=".02"/></body>'
        f"{body}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture(params=["sensor", "readout", "depth", "cloth", "skin"])
def sensor(request: pytest.FixtureRequest, tiny_simulator: cs.Simulator) -> Any:
    """One of each kind, used once."""
    simulator = tiny_simulator.copy()
    if request.param == "skin":
        made = cs.mujoco.attach_skin(*world(), ["a", "b"], simulator, threads=2)
    elif request.param == "depth":
        spec = mujoco.MjSpec.from_string("<mujoco><worldbody><body name='ball' pos='0 0 .05'>"
            "<joint type='slide'/><geom size='.02'/></body></worldbody></mujoco>")  # fmt: skip
        cs.mujoco.add_sensor(spec, "world", cs.Pose(), "a", camera=0.1, resolution=16)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        made = cs.mujoco.attach(model, data, "a", simulator, perception="depth_camera")
    else:
        made = cs.mujoco.attach(
            *world(CLOTH if request.param == "cloth" else ""), "a", simulator,
            readout="fdc1004" if request.param == "readout" else None,
        )  # fmt: skip
    made.read()
    return made


def numbers(readings: Any) -> list[float]:
    """All changes of a reading or of those of a skin."""
    every = readings.values() if isinstance(readings, dict) else [readings]
    return [float(v) for r in every for v in r.delta.ravel()]


def in_a_fork(task: Callable[[], list[float]]) -> list[float]:
    """What a forked process makes of a task, with a limit to how long it may hang."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    child = os.fork()
    if child == 0:
        try:
            threading.Timer(60, os._exit, [9]).start()
            sender.send(task())
        finally:
            os._exit(0)
    sender.close()
    try:
        return receiver.recv()
    finally:
        os.waitpid(child, 0)


@pytest.mark.parametrize("how", ["pickle", "deepcopy"])
def test_a_copy_reads_the_same_and_stands_alone(sensor: Any, how: str) -> None:
    """A copied sensor has a copy of its simulator's state, and goes on from there."""
    twin = copy.deepcopy(sensor) if how == "deepcopy" else pickle.loads(pickle.dumps(sensor))
    before = numbers(sensor.read())
    assert numbers(twin.read()) == before
    first = next(iter(sensor.sensors.values())) if hasattr(sensor, "sensors") else sensor
    first.data.qpos[0] += 0.01
    mujoco.mj_forward(first.model, first.data)
    assert numbers(twin.read()) == before
    assert numbers(sensor.read()) != before


def test_a_fork_reads_on(sensor: Any) -> None:
    """A forked process has none of its parent's threads; it must not wait for them."""
    assert in_a_fork(lambda: numbers(sensor.read())) == numbers(sensor.read())


def test_plain_skins_and_batches(tiny_simulator: cs.Simulator) -> None:
    """The same for sensors without a simulator of robots."""
    skin = cs.Skin({k: (tiny_simulator, cs.Pose()) for k in "ab"}, threads=2)
    here = numbers(skin.step(BALL))
    assert in_a_fork(lambda: numbers(skin.step(BALL))) == here
    assert numbers(copy.deepcopy(skin).step(BALL)) == here
    assert numbers(pickle.loads(pickle.dumps(skin)).step(BALL)) == here
    tiny_simulator.step_batch([BALL] * 3, threads=2)
    batch = in_a_fork(lambda: numbers(tiny_simulator.step_batch([BALL] * 3, threads=2)[2]))
    assert batch == numbers(tiny_simulator.step_batch([BALL])[0])


def test_a_spawned_process_reads_the_same(tiny_simulator: cs.Simulator) -> None:
    """A process that shares nothing but the pickled skin."""
    skin = cs.mujoco.attach_skin(*world(), ["a", "b"], tiny_simulator.copy(), threads=2)
    here = skin.read()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(skin.read)
    for name, reading in here.items():
        assert np.array_equal(there[name].delta, reading.delta)
