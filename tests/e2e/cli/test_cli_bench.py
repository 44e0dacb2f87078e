"""``capsense bench`` at reduced size: what it reports, not how fast."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from approximate import approx
from field_cases import delta_reference

from capsense.__main__ import main
from capsense.bench import BATCH, CHECKS, WORLDS, Times, batch_scenes, check_error
from capsense.simulator import Simulator


def test_bench_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every world has ordered times, and an error within the solver's accuracy."""
    target = tmp_path / "bench.json"
    assert main(["bench", "--steps", "3", "-o", str(target)]) == 0
    text = capsys.readouterr().out
    figures = json.loads(target.read_text())
    assert set(figures["worlds"]) == set(WORLDS) == set(CHECKS)
    for name, row in figures["worlds"].items():
        assert f"\n{name} " in text
        for clock in ("", "clock_"):
            assert 0 < row[f"{clock}median_ms"] <= row[f"{clock}p95_ms"] <= row[f"{clock}p99_ms"]
        assert f"{row['clock_median_ms']:.2f}" in text
        assert row["error"] < 0.05
    batch = figures["batch"]
    assert f"threads: {batch['clock_per_s']:.0f} scenes a second" in text
    assert batch["clock_per_s"] > 0
    for name in ("import_s", "simulator_s", "first_step_s"):
        assert figures[name] > 0


def test_reference_of_the_bar_is_the_carried_one() -> None:
    """The figures in the package are those of the reference file."""
    expected = 1e12 * np.diag(delta_reference("six_patch", "bar_20"))
    np.testing.assert_allclose(CHECKS["bar"][1], expected, atol=1e-5)


@pytest.mark.parametrize("name", CHECKS)
def test_errors_are_of_the_world_itself(name: str) -> None:
    """A second solve of the same sample has the same error, whatever was solved before."""
    sim = Simulator("six_patch")
    first = check_error(sim, name)
    for other in CHECKS:
        check_error(sim, other)
    assert check_error(sim, name) == approx(first, abs=1e-4)


def test_scenes_of_a_batch_differ() -> None:
    places, later = (
        np.array([body.pose.position for scene in batch_scenes(after=k) for body in scene])
        for k in (0, 2)
    )
    assert len(np.unique(places, axis=0)) == BATCH
    np.testing.assert_allclose(np.linalg.norm(later - places, axis=1), 2 * 0.116 / 100)


def test_times_leave_warm_up_out() -> None:
    """Calls that are not kept are made, and not counted."""
    times, made = Times(), []
    for k in range(5):
        assert times.take(lambda k=k: made.append(k) or k, keep=k >= 2) == k
    assert made == [0, 1, 2, 3, 4]
    assert times.summary()["steps"] == 3


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--steps", "0"], "argument --steps: 0; give 1 or more"),
        (["--steps", "many"], "argument --steps: invalid"),
        (["-o", "nowhere/b.json"], "there is no folder nowhere"),
        (["-o", "."], "is a folder; name a file"),
    ],
)
def test_bad_options_are_usage_errors(
    options: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refused before anything is measured, as the command line refuses all bad options."""
    with pytest.raises(SystemExit) as stop:
        main(["bench", *options])
    assert stop.value.code == 2
    text = capsys.readouterr().err
    assert text.startswith("usage: capsense bench")
    assert told in text
