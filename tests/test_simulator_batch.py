"""Batches: the readings of many scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from random_scenes import random_scene
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.errors import BatchError, SolveError
from capsense.masked import MaskedScenes
from capsense.reading import CapacitanceChange
from capsense.solver import surface_solver as solver
from capsense.solver.surface_solver import SurfaceSolver, View


@pytest.fixture
def tiny(field_cache: Path) -> cs.Simulator:
    """A square and a disc in a 0.1 m box."""
    return cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)


def scenes(count: int = 20) -> list[cs.Scene]:
    """Scenes of every kind, empty ones among them."""
    rng = np.random.default_rng(7)
    return [random_scene(rng) if k % 5 else cs.Scene() for k in range(count)]


def frame() -> cs.DepthFrame:
    """A flat thing 20 mm before the sensor."""
    return cs.DepthFrame(np.full((16, 16), 0.02), 10.0, cs.OrthographicCamera(0.1))


@pytest.mark.parametrize("threads", [1, 2, 7, None])
def test_each_reading_is_that_of_a_step_from_rest(tiny: cs.Simulator, threads: int | None) -> None:
    """Differential: to the last bit, whatever stands beside it; and again in a second batch."""
    views = [*scenes(), frame()]
    alone = tiny.copy()
    expected = []
    for view in views:
        alone.reset()
        expected.append(alone.step(view))
    for _ in range(2):
        readings = tiny.step_batch(views, threads=threads)
        assert len(readings) == len(views)
        for a, b in zip(readings, expected, strict=True):
            np.testing.assert_array_equal(a.delta, b.delta)
            np.testing.assert_array_equal(a.self_capacitance, b.self_capacitance)
            assert a.stats.unknowns == b.stats.unknowns
            assert a.stats.solver_error == approx(b.stats.solver_error, rel=1e-12)
        views, expected = views[::-1], expected[::-1]


def test_layouts_of_bodies_are_kept_and_stay_few(tiny: cs.Simulator) -> None:
    """Invariant: the same reading, to the last bit, with a layout that was kept and without; no
    more than a few are, and one of bodies that change."""
    shapes = [cs.Sphere(0.005 + 1e-4 * k) for k in range(solver._LAYOUTS + 3)]
    views = [cs.Scene([cs.Body(shape, cs.Pose((0.0, 0.0, 0.03)))]) for shape in shapes]
    for view in [*views[:3], *views[:3]]:
        np.testing.assert_array_equal(tiny.step(view).delta, tiny.copy().step(view).delta)
    kept = tiny._solver._laid
    assert len(kept) == 3
    tiny.step(cs.Scene([cs.Body(cs.Sphere(0.005), cs.Pose((0.0, 0.0, 0.04)))]))
    assert len(kept) == 3, "a shape made anew is the same shape"
    for view in views:
        tiny.step(view)
        assert 0 < len(kept) <= solver._LAYOUTS
    for _ in range(2):
        tiny.step(frame())
        assert len(kept) == 1


def test_the_sensor_itself_is_left_alone(tiny: cs.Simulator) -> None:
    """Its walk goes on as if there had been no batch."""
    other = tiny.copy()
    walk = scenes(6)
    for sim in (tiny, other):
        sim.step(walk[1])
    tiny.step_batch(scenes())
    assert tiny.steps == 1
    np.testing.assert_array_equal(tiny.step(walk[2]).delta, other.step(walk[2]).delta)


def test_an_empty_batch_gives_nothing(tiny: cs.Simulator) -> None:
    """Nor does it start anything."""
    assert tiny.step_batch([]) == []


def test_a_failing_scene_does_not_lose_the_others(
    tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names it by its number and holds the readings of the others."""
    views = scenes(6)
    look = SurfaceSolver.look

    def fail(self: SurfaceSolver, scene: cs.Scene) -> View:
        if scene is views[2]:
            raise SolveError("no convergence")
        return look(self, scene)

    monkeypatch.setattr(SurfaceSolver, "look", fail)
    with pytest.raises(BatchError, match=r"1 of 6 scenes failed; 2: no convergence;") as caught:
        tiny.step_batch(views, threads=2)
    assert list(caught.value.readings) == [0, 1, 3, 4, 5]
    assert isinstance(caught.value.failures[2], SolveError)
    monkeypatch.undo()
    assert len(tiny.step_batch(views, threads=2)) == 6, "and the next batch is sound"


@pytest.mark.parametrize("threads", [1, 3])
def test_scenes_without_a_solution(
    tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """Those whose matrix has no factor, or is not finite, fail alone, as they do in a step."""
    views = scenes(40)
    hollow = solver.solve_each

    def broken(*args: Any) -> Any:
        delta, error, size = hollow(*args)
        for k in np.flatnonzero(size > 0)[:1]:  # where it is 0, no body was in sight
            delta[k, 0, 0] = np.nan
        return delta, error, size

    monkeypatch.setattr(solver, "solve_each", broken)
    with pytest.raises(BatchError, match="do two bodies coincide") as caught:
        tiny.step_batch(views, threads=threads)
    failures = caught.value.failures
    assert len(failures) >= min(2, threads)
    assert sorted([*failures, *caught.value.readings]) == list(range(40))
    for number, reading in caught.value.readings.items():
        np.testing.assert_array_equal(reading.delta, tiny.step(views[number]).delta)


def test_the_scheme_of_the_paper(field_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each scene from rest too, and one that fails does not lose the others."""
    masked = cs.Simulator(
        tiny_design(), settings=SETTINGS, cache_dir=field_cache, method="fem_masked"
    )
    views = [cs.Scene([cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, z)))]) for z in (0.02, 0.03, 0.04)]
    expected = []
    for view in views:
        masked.reset()
        expected.append(masked.step(view).delta)
    for reading, delta in zip(masked.step_batch(views, threads=2), expected, strict=True):
        np.testing.assert_array_equal(reading.delta, delta)
    solve = MaskedScenes.solve

    def fail(self: MaskedScenes, scene: cs.Scene) -> CapacitanceChange:
        if scene is views[1]:
            raise SolveError("no convergence")
        return solve(self, scene)

    monkeypatch.setattr(MaskedScenes, "solve", fail)
    with pytest.raises(BatchError, match="1 of 3 scenes failed; 1: no convergence;") as caught:
        masked.step_batch(views, threads=2)
    assert list(caught.value.readings) == [0, 2]


def test_scenes_as_they_come(tiny: cs.Simulator) -> None:
    """A generator will do; readings are those of the list."""
    scenes = [cs.Scene([cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, z)))]) for z in (0.03, 0.05)]
    many, listed = tiny.step_batch(s for s in scenes), tiny.step_batch(scenes)
    assert [r.delta.tolist() for r in many] == [r.delta.tolist() for r in listed]


def test_refused_before_any_work(tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    """By name, with the fix."""
    monkeypatch.setattr(SurfaceSolver, "look", lambda *_: pytest.fail("worked"))
    with pytest.raises(TypeError, match=r"scenes\[2\]: a batch holds a Scene .*, not list"):
        tiny.step_batch([cs.Scene(), cs.Scene(), []])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="threads is 0"):
        tiny.step_batch([cs.Scene()], threads=0)
