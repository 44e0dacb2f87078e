"""A simulator that reports through a chip."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import capsense as cs
from capsense.errors import ReadoutError

Make = Callable[..., cs.Simulator]
COLUMNS = ("time", "channel", "code", "capacitance", "flags")
TIMES = np.arange(0.0, 0.3, 0.02)
FEW = TIMES[::7]
"""For a method that takes a third of a second for a reading."""


@pytest.fixture
def make(simulators: Callable[..., cs.Simulator]) -> Make:
    """``make(readout=…)``: a sensor of its own that shares the field."""
    shared = simulators("six_patch")
    return lambda **options: cs.Simulator(shared.design, background=shared.background, **options)


def scene_at(time: float) -> cs.Scene:
    """A ball that comes nearer."""
    return cs.Scene([cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.1 - 0.1 * time)))])


def by_hand(
    sim: cs.Simulator, seed: int = 0, start: float = 0.0, times: np.ndarray = TIMES
) -> list[cs.Counts]:
    """What the chip reports when it is told every reading."""
    chip = cs.Readout.preset("fdc1004", sim.electrode_names)
    chip.reset(seed=seed, start=start)
    return [chip.sample(start + t, sim.step(scene_at(t))) for t in times]


def same(found: list[cs.Counts], expected: list[cs.Counts]) -> bool:
    """Whether all columns agree to the last bit."""
    assert sum(map(len, expected)) > 10
    return all(
        np.array_equal(getattr(a, c), getattr(b, c))
        for a, b in zip(found, expected, strict=True)
        for c in COLUMNS
    )


@pytest.mark.parametrize(("method", "times"), [("surface", TIMES), ("fem_masked", FEW)])
@pytest.mark.e2e
def test_counts_are_those_of_the_chip(make: Make, method: str, times: np.ndarray) -> None:
    """Differential: a chip's name, or a readout; and again after a reset, or with other noise."""
    plain = make(method=method)
    expected = by_hand(plain, times=times)
    for choice in ("fdc1004", cs.Readout.preset("fdc1004", plain.electrode_names)):
        sim = make(method=method, readout=choice)
        for _ in range(2):
            found = [sim.step(scene_at(t), time=t).counts for t in times]
            assert same(found, expected)
            sim.reset()
    sim.reset(seed=3, start=7.0)
    found = [sim.step(scene_at(t), time=7.0 + t).counts for t in times]
    plain.reset()
    assert same(found, by_hand(plain, 3, 7.0, times))
    assert not same(found, expected)


def test_copies_go_on(make: Make) -> None:
    """A pickled sensor reports what the original does; copies have no chip."""
    sim = make(readout="fdc1004")
    for t in TIMES[:5]:
        sim.step(scene_at(t), time=t)
    twin = pickle.loads(pickle.dumps(sim))
    rest = [[s.step(scene_at(t), time=t).counts for t in TIMES[5:]] for s in (sim, twin)]
    assert same(*rest)
    assert sim.copy().readout is None
    sim.use_readout(None)
    assert all(r.counts is None for r in sim.step_batch([scene_at(t) for t in TIMES]))
    assert sim.step(scene_at(0.0)).counts is None


@pytest.mark.parametrize("threads", [1, 3])
def test_batches(make: Make, threads: int) -> None:
    """Differential: a chip is told the scenes of a batch as it is those of steps; it goes on."""
    sim, plain = make(readout="fdc1004"), make()
    expected, scenes = by_hand(plain), [scene_at(t) for t in TIMES]
    first = [sim.step(scene_at(t), time=t).counts for t in TIMES[:4]]
    many = sim.step_batch(scenes[4:9], times=TIMES[4:9], threads=threads)
    rest = sim.step_batch(iter(scenes[9:]), times=TIMES[9:].tolist(), threads=threads)
    assert same(first + [r.counts for r in (*many, *rest)], expected)
    for reading, scene in zip(many, scenes[4:9], strict=True):
        np.testing.assert_array_equal(reading.delta, plain.step(scene).delta)
    assert sim.step_batch([], times=[]) == []
    assert all(r.counts is None for r in sim.solved_batch(scenes[:2]))


def test_batches_are_refused(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without times, with others than there are scenes, or going back: before anything is solved,
    and with the chip as it was."""
    sim, scenes = make(readout="fdc1004"), [scene_at(t) for t in TIMES[:3]]
    sim.step(scenes[0], time=1.0)
    with monkeypatch.context() as patch:
        patch.setattr(sim, "solved_batch", lambda *_, **__: pytest.fail("solved"))
        with pytest.raises(ReadoutError, match=r"write step_batch\(scenes, times=\[…\]\)"):
            sim.step_batch(scenes)
        with pytest.raises(ValueError, match="2 times for 3 scenes; give one for each"):
            sim.step_batch(scenes, times=[1.0, 2.0])
        for times in ([0.5, 1.0, 1.5], [1.1, 1.3, 1.2], [1.1, np.nan, 1.2], [1.1, "2", 1.2]):
            with pytest.raises(ReadoutError, match=r"time must not go back|give a finite time"):
                sim.step_batch(scenes, times=times)
    twin = pickle.loads(pickle.dumps(sim))
    found = sim.step_batch(scenes, times=[1.1, 1.2, 1.3])
    expected = [twin.step(s, time=t).counts for s, t in zip(scenes, (1.1, 1.2, 1.3), strict=True)]
    assert same([r.counts for r in found], expected)


def test_a_failed_batch_leaves_the_chip_alone(make: Make) -> None:
    """It can be given again, without the scenes that failed."""
    sim, good = make(readout="fdc1004"), [scene_at(t) for t in TIMES[:4]]
    twin = pickle.loads(pickle.dumps(sim))
    wrong = cs.DepthFrame(np.full((16, 16), 0.02), 10.0, cs.OrthographicCamera(0.1))

    def fail() -> cs.Scene:
        raise cs.SceneError("nothing there")

    object.__setattr__(wrong, "scene", fail)
    with pytest.raises(cs.BatchError, match="nothing there"):
        sim.step_batch([*good, wrong], times=[0.0, 0.1, 0.2, 0.3, 0.4], threads=1)
    times = [0.0, 0.1, 0.2, 0.3]
    found = [r.counts for r in sim.step_batch(good, times=times)]
    assert same(found, [r.counts for r in twin.step_batch(good, times=times)])


def test_refused(make: Make, tmp_path: Path) -> None:
    """By name, before anything is solved."""
    sim = make(readout="fdc1004")
    with pytest.raises(ReadoutError, match=r"write step\(scene, time=…\)"):
        sim.step(scene_at(0.0))
    assert sim.steps == 0
    sim.step(scene_at(0.0), time=1.0)
    with pytest.raises(ReadoutError, match="time must not go back"):
        sim.step(scene_at(0.0), time=0.5)
    for choice in ("fdc1005", tmp_path / "none.toml", 3):
        with pytest.raises(ReadoutError):
            make(readout=choice)


def test_the_empty_reading(make: Make) -> None:
    """That of a step without bodies, to the last bit; nothing is solved for it."""
    sim = make()
    empty, step = sim.empty, sim.step(cs.Scene())
    assert sim.steps == 1
    for name in ("capacitance", "delta", "self_capacitance", "mutual_capacitance"):
        np.testing.assert_array_equal(getattr(empty, name), getattr(step, name))
    np.testing.assert_array_equal(empty.capacitance, sim.baseline)


def test_recorded(make: Make, tmp_path: Path) -> None:
    """The sensor's own chip is recorded; a second one is refused."""
    pytest.importorskip("mcap", reason="needs pip install 'capsense[record]'")
    sim = make(readout="fdc1004")
    expected = by_hand(make())
    with cs.record(tmp_path / "a.mcap", sim) as run:
        found = [run.step(scene_at(t), t).counts for t in TIMES]
    assert same(found, expected)
    steps = list(cs.open_recording(tmp_path / "a.mcap").steps())
    there = [s.reading.counts for s in steps if s.reading.counts is not None]
    assert same([c for c in there if len(c)], [c for c in expected if len(c)])
    with pytest.raises(ReadoutError, match="readout of its own"):
        cs.record(tmp_path / "b.mcap", sim, readout="fdc1004")


def test_attached(make: Make) -> None:
    """A sensor on a robot has a copy of the simulator's chip, or one of its own; the simulator's
    stays, and goes on as if there were no sensor."""
    mujoco = pytest.importorskip("mujoco", reason='needs pip install "capsense[mujoco]"')
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><site name='s'/></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sim = make(readout="fdc1004")
    sensor = cs.mujoco.attach(model, data, site="s", design=sim)
    chip, twin = sim.readout, pickle.loads(pickle.dumps(sim))
    assert chip is not None
    assert sensor.readout is not chip
    sim.step(cs.Scene(), time=5.0)
    sensor.read(0.0)
    assert len(sensor.read(0.1).counts) > 10
    other = cs.mujoco.attach(model, data, site="s", design=sim, readout="mpr121")
    assert "mpr121" in repr(other.readout).lower()
    bare = cs.mujoco.attach(model, data, site="s", design=sim)
    bare.use_readout(None)
    skin = cs.mujoco.attach_skin(model, data, ["s"], sim)
    assert skin.sensors["s"].readout is not chip
    for each in (sensor, other, bare):
        each.reset(seed=4)
        each.check()
    skin.reset(seed=5)
    assert bare.read(0.0).counts is None
    assert sim.readout is chip
    assert chip.seed == 0
    twin.step(cs.Scene(), time=5.0)
    expected = [twin.step(scene_at(t), time=5.0 + t).counts for t in TIMES]
    assert same([sim.step(scene_at(t), time=5.0 + t).counts for t in TIMES], expected)


def test_a_lossy_body_turns_the_phase_that_a_demodulating_chip_sees(make: Make) -> None:
    """The chip's magnitude grows beyond that of the capacitance alone; a plain chip sees that."""
    body = cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.03)), cs.Material("gel", 5.0, 2e-4))
    sim = make(readout="sdr")
    for time in (0.0, 0.1):
        reading = sim.step(cs.Scene([body]), time=time)
    assert reading.conductance is not None
    assert reading.counts is not None
    dry = replace(reading, conductance=None, counts=None)
    wet = replace(reading, conductance=1e3 * reading.conductance, counts=None)
    for chip, seen in (("sdr", True), ("ad7746", False)):
        one, other = (
            cs.Readout.preset(chip, sim.electrode_names)([0.0, 0.1], [r, r]) for r in (dry, wet)
        )
        assert np.array_equal(one.code, other.code) != seen
    assert len(reading.counts) > 0
