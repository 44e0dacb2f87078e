"""Benchmarks of steps and of error against time: worlds are what they say, options reach."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from approximate import approx
from benchmark_modules import imported

import capsense as cs

ROOT = Path(__file__).parents[3]
MODULES = ("step_scenes", "steps", "accuracy_map")


@pytest.fixture(scope="module")
def parts() -> Iterator[dict[str, ModuleType]]:
    """The benchmarks' modules."""
    with imported(*MODULES) as found:
        yield found


def lowest(scene: cs.Scene) -> float:
    """Lowest point of a scene [m]."""
    return float(scene.pack().bounds[:, 0, 2].min())


@pytest.mark.parametrize(
    ("name", "count", "gap"),
    [("ball", 1, 0.030), ("finger at 15 mm", 1, 0.015), ("finger at 5 mm", 1, 0.005),
     ("forearm", 1, 0.020), ("bar", 1, 0.020), ("hand", 7, 0.020), ("12 far", 13, 0.015)],
)  # fmt: skip
def test_bodies_are_where_the_name_says(
    parts: dict[str, ModuleType], name: str, count: int, gap: float
) -> None:
    """At every sample."""
    worlds = [w for w in parts["step_scenes"].worlds() if w.name.endswith(name) or name in w.name]
    for k in (0, 10, 60):
        scene = worlds[0].sample(k)
        if name == "12 far":
            scene = next(w for w in worlds if "far" in w.name).sample(k)
        assert len(scene) == count
        assert lowest(scene) == approx(gap, abs=1e-9)


def test_the_person_is_one_closed_mesh(parts: dict[str, ModuleType]) -> None:
    """Some 20,000 triangles, the hand 20 mm from the sensor, the rest beyond the domain."""
    mesh = parts["step_scenes"].person_mesh()
    assert 19_000 < len(mesh.faces) < 22_000
    assert mesh.closed
    low, high = mesh.bounds()
    assert low[2] == approx(0.020, abs=1e-3)
    assert high[2] > 0.5


def test_a_depth_frame_and_a_sheet_follow_the_samples(
    parts: dict[str, ModuleType], simulators: Any
) -> None:
    """Frames and sheets are made within the timed step, and change from one to the next."""
    sim = simulators("six_patch")
    for world in parts["step_scenes"].worlds():
        if not callable(world.sample(0)):
            continue
        first, later = (parts["steps"].reader(sim, world, k)().delta for k in (0, 25))
        assert np.abs(first - later).max() > 0.01 * np.abs(first).max()


def test_random_scenes_hold_one_body_over_the_sensor(parts: dict[str, ModuleType]) -> None:
    scenes = parts["step_scenes"].random_scenes(40)
    assert all(len(scene) == 1 for scene in scenes)
    assert all(0.005 - 1e-9 <= lowest(scene) <= 0.1 for scene in scenes)
    other = parts["step_scenes"].random_scenes(40, after=1)
    assert scenes[0][0].pose != other[0][0].pose


def test_every_method_runs_with_every_preset(parts: dict[str, ModuleType]) -> None:
    found = parts["accuracy_map"].configurations(
        ["surface"], ["fast", "fine"], ["excitation_frequency=1"]
    )
    assert found == [
        (
            "surface fast excitation_frequency=1",
            dict(method="surface", preset="fast", excitation_frequency=1),
        ),
        (
            "surface fine excitation_frequency=1",
            dict(method="surface", preset="fine", excitation_frequency=1),
        ),
    ]
    assert parts["accuracy_map"].configurations([], [], []) == [("surface", {"method": "surface"})]


def test_the_curve_goes_from_fast_to_slow(
    parts: dict[str, ModuleType], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What could not be solved is left out."""
    figures = {"rms": 1.0, "p95": 2.0, "worst": 3.0}
    results = [
        {"label": "surface fine", "all": {**figures, "ms": 2.0}},
        {"label": "surface fast", "all": {**figures, "ms": 0.5}},
        {"label": "surface failed"},
    ]
    parts["accuracy_map"].curve(results)
    printed = capsys.readouterr().out
    assert printed.index("fast") < printed.index("fine")
    assert "failed" not in printed
    parts["accuracy_map"].plot(results, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000
