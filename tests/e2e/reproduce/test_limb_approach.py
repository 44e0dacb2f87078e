"""The limb approach: its figures on known curves, and what must hold of a run."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

from capsense.reproduce import limb_curves
from capsense.reproduce.harness import Outcome, write_outcome
from capsense.reproduce.limb_approach import run
from capsense.reproduce.limb_curves import (
    EDGES,
    FAR,
    FITS,
    RANGES,
    counts,
    distances,
    slopes,
    zero_distance,
)


@pytest.mark.parametrize("power", [-1.0, -2.5])
def test_slopes_of_a_power(power: float) -> None:
    z = distances(4)
    assert slopes(z, 3e-14 * z**power) == approx([power] * len(RANGES), abs=1e-9)


def test_no_slope_where_nothing_is_left() -> None:
    """A tare taken at 12 cm leaves nothing beyond."""
    z = distances(6)
    found = slopes(z, 1 / z - 1 / 0.12)
    assert np.isfinite(found[:3]).all()
    assert np.isnan(found[3])


@pytest.mark.parametrize("fit", list(FITS.values()))
def test_zero_of_a_fit(fit: tuple[float, float]) -> None:
    k, b = fit
    z = distances(60)
    assert zero_distance(z, k / z - b) == approx(k / b, rel=2e-3)


def test_distances_hold_the_ends_of_the_ranges() -> None:
    z = distances(3)
    assert np.all(np.diff(z) > 0)
    for end in np.unique(RANGES):
        assert np.abs(z - end).min() < 1e-9


def test_counts_are_tared_codes() -> None:
    """16 bits over 16 pF; what exceeds the range stays at its end."""
    values = 1e-12 + np.array([0.0, 100e-15, 50e-12])
    found = counts(values, 1e-12)
    assert found[0] == approx(0, abs=1)
    assert found[1] == approx(100e-15 / (16e-12 / 2**16), abs=1)
    assert found[2] < 8e-12 / (16e-12 / 2**16) * 2
    assert np.array_equal(found, counts(values, 1e-12))


@pytest.fixture(scope="module")
def reduced(
    tmp_path_factory: pytest.TempPathFactory, field_cache: Path
) -> Iterator[tuple[Outcome, Path]]:
    folder = tmp_path_factory.mktemp("approach")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
        outcome = run(folder, reduced=True, report=lambda stage, fraction: None)
        write_outcome(outcome, folder)
        yield outcome, folder


def test_reduced_run_meets_its_targets(reduced: tuple[Outcome, Path]) -> None:
    outcome, folder = reduced
    assert not outcome.missed
    assert (folder / "limb_approach.png").stat().st_size > 10_000
    free = [row.value for row in outcome.rows[:4]]
    assert free == sorted(free, reverse=True), "steeper and steeper"
    assert -1.3 < free[0] < -1.0


def test_grounding_and_backing(reduced: tuple[Outcome, Path]) -> None:
    """A person on 100 pF is all but grounded; a floating limb, or a plane behind, takes range."""
    _, folder = reduced
    with (folder / "curves.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def change(behind: str, limb: str) -> np.ndarray:
        return np.array(
            [float(r["change [fF]"]) for r in rows if (r["behind it"], r["limb"]) == (behind, limb)]
        )

    grounded, tied = change("free", "grounded"), change("free", "100 pF")
    floating, plane = change("free", "floating"), change("ground plane", "grounded")
    assert len(grounded) == len(distances(3))
    assert np.all(tied < grounded)
    assert np.all(tied > 0.85 * grounded)
    assert np.all(floating < tied)
    assert np.all(plane < grounded)
    assert plane[-1] < 0.15 * grounded[-1]


def test_parts_are_reused(reduced: tuple[Outcome, Path]) -> None:
    """A second run computes nothing, and finds the same."""
    outcome, folder = reduced
    before = {path: path.stat().st_mtime_ns for path in (folder / "parts").iterdir()}
    again = run(folder, reduced=True, report=lambda stage, fraction: None)
    assert {path: path.stat().st_mtime_ns for path in (folder / "parts").iterdir()} == before
    assert again.rows == outcome.rows


def test_fit_to_the_arm_finds_its_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves of a known law, from which the slopes are made: edge, offset and tare come back."""
    z = np.append(distances(6), FAR)
    edges = np.array(EDGES)[:, None]

    def reading(edge: np.ndarray, distance: np.ndarray) -> np.ndarray:
        return 1e-14 / (distance * (distance + edge))

    true = (0.05, 0.012, 0.3)
    seen = reading(np.array(true[0]), z[:-3] + true[1]) - true[2] * reading(
        np.array(true[0]), np.array(0.15 + true[1])
    )
    monkeypatch.setattr(limb_curves, "ARM", tuple(slopes(z[:-3], seen)))
    found = limb_curves.fit_arm(EDGES, z, reading(edges, z))
    assert found.apart < 0.003
    assert found.figures[1] == approx(true[1], abs=0.003)
    assert all(low <= value <= high for value, (low, high) in zip(true, found.ranges, strict=True))


def test_fit_to_the_arm_says_where_there_is_none() -> None:
    """Readings that fall as 1/d⁶ are too steep wherever the offset ends."""
    z = np.append(distances(6), FAR)
    found = limb_curves.fit_arm(EDGES, z, np.tile(1e-20 * z**-6.0, (len(EDGES), 1)))
    assert found.ranges == ()
    assert found.apart > limb_curves.WITHIN
