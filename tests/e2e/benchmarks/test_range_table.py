"""The table of ranges: thresholds and distances of cases with known answers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmark_modules import imported

import capsense as cs


@pytest.fixture(scope="module")
def table() -> Iterator[ModuleType]:
    with imported("range_table", "sizes") as found:
        yield found["range_table"]


def test_reach_of_a_power_law(table: ModuleType) -> None:
    """1 fF at 10 mm that falls with the cube of the distance meets 1 aF at 100 mm."""
    found = 1e-15 * (0.010 / table.GAPS[:, None]) ** 3
    distance, whole = table.reach(found, np.array([1e-18]))
    assert abs(distance - 0.1) < 1e-9
    assert whole
    assert table.reach(found, np.array([1.0])) == (0.0, True)
    assert table.reach(found, np.array([1e-30])) == (np.inf, True)
    assert table.shown(distance) == "100"


def test_a_change_through_zero_is_starred(table: ModuleType) -> None:
    change = np.where(table.GAPS < 0.02, 1.0, -1.0) * 1e-15
    change[(table.GAPS > 0.018) & (table.GAPS < 0.022)] = 0.0
    distance, whole = table.reach(change[:, None], np.array([1e-16]))
    assert (distance, whole) == (np.inf, False)
    assert table.shown(distance, whole) == "> 300*"


def test_thresholds(table: ModuleType) -> None:
    """White noise averages out; a coarse converter has a code; beyond the range nothing is told."""
    empty = np.array([2e-12])
    noisy = cs.Readout.preset("fdc1004", ("E",), rate=100, white=5e-15, flicker=0.0)
    each = round(table.VALUE / noisy.schedule.period)
    expected = 3 * 5e-15 / np.sqrt(each)
    assert abs(table.threshold(noisy, empty)[0] / expected - 1) < 0.1
    coarse = cs.Readout.preset("teensy", ("E",), noise=False)
    assert abs(table.threshold(coarse, empty)[0] / 20e-15 - 1) < 1e-6
    assert np.isinf(table.threshold(noisy, np.array([1e-9]))).all()


def test_page(table: ModuleType, field_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page has all designs and chips, and one of its cells is computed again."""
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    page = (Path(__file__).parents[3] / "docs" / "choosing.md").read_text(encoding="utf-8")
    start, end = (page.index(marker) for marker in table.MARKERS)
    head, _, *rows = (
        [cell.strip(" `") for cell in line.split("|")[1:-1]]
        for line in page[start:end].splitlines()[1:]
    )
    assert head[1:] == list(table.CHIPS)
    assert [r[0] for r in rows] == list(table.DESIGNS)
    shown = dict(zip(head, next(r for r in rows if r[0] == "gripper_pad"), strict=True))["fdc1004"]
    (found,) = table.row("gripper_pad", ["fdc1004"])
    numbers = [[float(n) for n in re.findall(r"[\d.]+", text)] for text in (found, shown)]
    np.testing.assert_allclose(*numbers, rtol=0.1)
