"""Touch in recordings: written, read, replayed, exported and drawn."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.codec import design_from_json, design_to_json
from capsense.recording.export import export

FORCES = [None, 0.0, 0.4, 1.0, 0.4]


def scene(force: float | None, other: float | None = None) -> cs.Scene:
    ball = cs.Body(cs.Sphere(0.01), cs.Pose((-0.012, 0, 0.0119)), name="ball", force=force)
    far = cs.Body(cs.Sphere(0.01), cs.Pose((0.03, 0, 0.05)), "wood", name="far", force=other)
    return cs.Scene([ball, far])


@pytest.fixture
def run(foam_field: cs.Design, tmp_path: Path) -> tuple[Path, list[cs.Reading]]:
    """Five steps of a ball on a foam; the file, and the readings returned."""
    path, sim = tmp_path / "touch.mcap", cs.Simulator(foam_field, preset="fast")
    with cs.record(path, sim) as recorder:
        return path, [recorder.step(scene(f), 0.1 * k) for k, f in enumerate(FORCES)]


def test_touch_comes_back_and_replays(run: tuple[Path, list[cs.Reading]]) -> None:
    path, readings = run
    steps = list(cs.open_recording(path).steps())
    assert [[b.force for b in s.scene] for s in steps] == [[f, None] for f in FORCES]
    for step, reading in zip(steps, readings, strict=True):
        assert step.reading.touch is not None
        assert reading.touch is not None
        np.testing.assert_array_equal(step.reading.touch.force, reading.touch.force)
        np.testing.assert_array_equal(step.reading.touch.compression, reading.touch.compression)
        assert step.reading.touch.total == reading.touch.total
    told = cs.replay(path)
    assert (told.steps, told.same) == (len(FORCES), True)


def test_a_changed_force_is_found(foam_field: cs.Design, tmp_path: Path) -> None:
    """Mutation: the recording claims another touch than the simulator gives."""
    path, sim = tmp_path / "other.mcap", cs.Simulator(foam_field, preset="fast")
    with cs.record(path, sim) as recorder:
        reading = sim.step(scene(0.5), time=0.0)
        assert reading.touch is not None
        reading.touch.force[0] += 0.1
        recorder.write(0.0, scene(0.5), reading)
    told = cs.replay(path)
    assert told.first is not None
    assert told.first.what == "force on A [N]"


def test_a_viscous_cover_replays_by_its_times(foam_field: cs.Design, tmp_path: Path) -> None:
    """Relaxation follows the recorded times: without these a replay differs."""
    from dataclasses import replace

    cover = foam_field.cover
    assert cover is not None
    slow = replace(foam_field, cover=replace(cover, relaxation=((0.5, 0.2),), hysteresis=0.3))
    path, sim = tmp_path / "slow.mcap", cs.Simulator(slow, preset="fast")
    with cs.record(path, sim) as recorder:
        depths = [
            recorder.step(scene(1.0), 0.1 * k).touch.compression[0]  # type: ignore[union-attr]
            for k in range(4)
        ]
    assert (np.diff(depths) > 1e-6).all()
    assert cs.replay(path).same


def test_designs_with_a_cover_are_written_down(foam_field: cs.Design) -> None:
    found = design_from_json(design_to_json(foam_field))
    assert found.cover is not None
    assert foam_field.cover is not None
    np.testing.assert_array_equal(found.cover.law.stress, foam_field.cover.law.stress)
    assert (found.cover.name, found.cover.limit) == ("foam", foam_field.cover.limit)
    bare = cs.load_design("six_patch")
    assert design_from_json(design_to_json(bare)).cover is None


def test_tables_have_columns_of_touch(run: tuple[Path, list[cs.Reading]], tmp_path: Path) -> None:
    path, readings = run
    recording = cs.open_recording(path)
    assert export(recording, tmp_path / "t.csv") == len(FORCES)
    with (tmp_path / "t.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert float(rows[3]["force_total_N"]) == approx(1.0)
    force = readings[3].touch.force[0]  # type: ignore[union-attr]
    assert float(rows[3]["force_A_N"]) == approx(force, rel=1e-9)
    assert float(rows[3]["compression_B_m"]) == 0.0
    export(recording, tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as arrays:
        assert arrays["touch_force"].shape == arrays["touch_compression"].shape == (5, 2)
        np.testing.assert_allclose(arrays["touch_total"][1:], FORCES[1:], rtol=1e-9, atol=1e-12)
    pq = pytest.importorskip("pyarrow.parquet")
    export(recording, tmp_path / "t.parquet")
    table = pq.read_table(tmp_path / "t.parquet").to_pydict()
    assert table["force_total_N"][3] == approx(1.0)
    assert table["episode"] == [0] * 5


def test_plots_have_a_panel_of_touch(run: tuple[Path, list[cs.Reading]]) -> None:
    figure = cs.plot(cs.open_recording(run[0]))
    labels = [axes.get_ylabel() for axes in figure.axes]
    at = labels.index("force on the cover [N]")
    lines: list[Any] = list(figure.axes[at].get_lines())
    force = [r.touch.force[0] for r in run[1]]  # type: ignore[union-attr]
    assert any(np.array_equal(line.get_ydata(), force) for line in lines)
    assert "compression of the cover [mm]" in labels
