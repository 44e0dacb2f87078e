"""One sensor, many threads: they take turns, and each gets its own scene's reading."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.adapters import skin as skin_module
from capsense.fleet.bodies import BodyTable
from capsense.masked import MaskedScenes
from capsense.readout.side_by_side import SideBySide
from capsense.solver.surface_solver import SurfaceSolver


@pytest.fixture(params=["surface", "fem_masked"])
def tiny(field_cache: Path, request: pytest.FixtureRequest) -> cs.Simulator:
    """A square and a disc in a 0.1 m box."""
    return cs.Simulator(
        tiny_design(), settings=SETTINGS, cache_dir=field_cache, method=request.param
    )


def balls(count: int, y: float = 0.0) -> list[cs.Scene]:
    """A ball that goes by."""
    places = [(0.03 * k / count, y, 0.03) for k in range(count)]
    return [cs.Scene([cs.Body(cs.Sphere(0.015), cs.Pose(place))]) for place in places]


def alone(work: Callable[..., Any]) -> Callable[..., Any]:
    """``work``, slowed down, and failing where two threads are in it at once."""
    inside: list[int] = []

    def watched(*args: Any, **options: Any) -> Any:
        inside.append(threading.get_ident())
        assert len(set(inside)) == 1, "two threads at once"
        time.sleep(0.002)
        try:
            return work(*args, **options)
        finally:
            inside.pop()

    return watched


def each_alone(patch: pytest.MonkeyPatch, owner: type, name: str) -> None:
    """Make a method :func:`alone`, for each object of its class by itself."""
    work = getattr(owner, name)
    watched: dict[int, Callable[..., Any]] = {}

    def method(self: Any, *args: Any, **options: Any) -> Any:
        return watched.setdefault(id(self), alone(partial(work, self)))(*args, **options)

    patch.setattr(owner, name, method)


SOLVERS = {"surface": SurfaceSolver, "fem_masked": MaskedScenes}


def at_once(work: Callable[[int], Any], count: int = 12) -> list[Any]:
    """What ``work`` gives for the numbers below ``count``, from four threads."""
    with ThreadPoolExecutor(4) as pool:
        return list(pool.map(work, range(count)))


def test_threads_that_share_a_simulator(
    tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No two are in the solver at once, and each reads what a thread alone reads."""
    scenes = balls(12)
    expected = [tiny.copy().step(scene).delta for scene in scenes]
    for name in ("solve", "reset"):
        each_alone(monkeypatch, SOLVERS[tiny.method], name)
    readings = at_once(lambda k: (tiny.step(scenes[k]), tiny.reset() if k % 4 == 3 else None)[0])
    for reading, delta in zip(readings, expected, strict=True):
        np.testing.assert_allclose(reading.delta, delta, rtol=1e-4, atol=1e-17)


def test_batches_at_once(tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two batches of one sensor never use the same copy together."""
    batches = [balls(4, 0.002 * k) for k in range(4)]
    expected = [tiny.copy().step_batch(batch, threads=1) for batch in batches]
    each_alone(monkeypatch, SOLVERS[tiny.method], "solve_each")
    found = at_once(lambda k: tiny.step_batch(batches[k], threads=2), 4)
    for readings, others in zip(found, expected, strict=True):
        for a, b in zip(readings, others, strict=True):
            np.testing.assert_array_equal(a.delta, b.delta)


def test_threads_that_share_a_skin(field_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The poses that a thread gives are those that its reading is of."""
    sensor = cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)
    skin = cs.Skin({"A": (sensor, cs.Pose())}, threads=1)
    scene = balls(1)[0]
    poses = [cs.Pose((0.001 * k, 0, 0)) for k in range(12)]
    expected = [skin.step(scene, {"A": pose})["A"].delta for pose in poses]
    views = skin.views

    def slow(scene: cs.Scene, poses: dict[str, cs.Pose]) -> dict[str, cs.Scene]:
        skin.poses.update(poses)
        time.sleep(0.002)
        return views(scene)

    monkeypatch.setattr(skin, "views", slow)
    found = at_once(lambda k: skin.step(scene, {"A": poses[k]})["A"].delta)
    np.testing.assert_array_equal(found, expected)


def test_threads_that_share_a_robots_skin(
    field_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All sensors are read of one instant, before the next thread's."""
    mujoco = pytest.importorskip("mujoco", reason='needs pip install "capsense[mujoco]"')
    sites = "<site name='a'/><site name='b'/>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{sites}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sensor = cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)
    skin = cs.mujoco.attach_skin(model, data, ["a", "b"], sensor, threads=1)
    monkeypatch.setattr(skin_module, "read_all", alone(skin_module.read_all))
    assert all(set(readings) == {"a", "b"} for readings in at_once(lambda _: skin.read()))


def test_threads_that_share_a_robots_sensor(
    field_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its chip is sampled by one thread at a time."""
    mujoco = pytest.importorskip("mujoco", reason='needs pip install "capsense[mujoco]"')
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><site name='a'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    simulator = cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)
    sensor = cs.mujoco.attach(model, data, "a", simulator, readout="fdc1004")
    monkeypatch.setattr(sensor.readout, "sample", alone(sensor.readout.sample))
    assert all(reading.counts is not None for reading in at_once(lambda _: sensor.read(0.1)))


def test_threads_that_share_a_fleet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its chips are sampled, and its bodies changed, by one thread at a time."""
    fleet = cs.Fleet("six_patch", [cs.Body(cs.Sphere(0.02))], 2)
    fleet.use_readout("fdc1004")
    poses = np.array([[[0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0]]] * 2)
    expected = fleet.step(poses, time=0.0).delta
    each_alone(monkeypatch, SideBySide, "sample")
    each_alone(monkeypatch, BodyTable, "change")

    def work(k: int) -> np.ndarray:
        fleet.change(0, cs.Body(cs.Sphere(0.02)))
        return fleet.step(poses, time=0.01).delta

    for delta in at_once(work):
        np.testing.assert_array_equal(delta, expected)
