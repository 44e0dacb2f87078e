"""Fig. 8: the paper's curve, the arithmetic, and what must hold of a run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

from capsense.reproduce import fig8
from capsense.reproduce.harness import Outcome, write_outcome

FIGURES = Path(__file__).parents[2] / "data" / "reference_capacitances.json"


def test_the_papers_curve() -> None:
    """Its text says 107 ms at 30,000 elements; the figure is read to about 2 %."""
    elements, times = fig8.paper_figure()
    assert len(elements) == 15
    assert (np.diff(elements) > 0).all()
    assert fig8.at_size(elements, times, 30_000) == approx(107, rel=0.03)


@pytest.mark.parametrize("gap", fig8.REFERENCE)
def test_carried_figures(gap: int) -> None:
    table = json.loads(FIGURES.read_text())[fig8.DESIGN]
    change = np.diag(np.array(table[f"bar {gap}"]) - np.array(table["none"]))
    corner, middle = fig8.REFERENCE[gap]
    expected = [middle if k in fig8.MIDDLE else corner for k in range(6)]
    assert change == approx(expected, abs=2e-6)


def test_power_laws_are_met_exactly() -> None:
    n = np.array([4e4, 1e4, 2e4])
    t = 3e-5 * n**1.2
    assert fig8.exponent(n, t) == approx(1.2)
    assert fig8.at_size(n, t, 3e4) == approx(3e-5 * 3e4**1.2)
    assert fig8.at_size(n, t, 1e4) == approx(t[1])
    with pytest.raises(ValueError, match="outside 10000 to 40000"):
        fig8.at_size(n, t, 5e4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fig8")


@pytest.fixture(scope="module")
def outcome(folder: Path) -> Outcome:
    told: list[float] = []
    found = fig8.run(folder, reduced=True, report=lambda _, fraction: told.append(fraction))
    assert told == sorted(told)
    assert told[-1] == 1.0
    return found


def points(outcome: Outcome, method: str) -> list[dict[str, object]]:
    """Rows of a method, by column, from the smallest."""
    table = outcome.tables["fig8"]
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    return [row for row in rows if str(row["method"]).startswith(method)]


def largest_errors(outcome: Outcome, method: str) -> np.ndarray:
    rows = points(outcome, method)
    return np.array([max(float(row[f"error at {g} mm [%]"]) for g in fig8.REFERENCE)
                     for row in rows])  # fmt: skip


def test_errors_of_the_default(outcome: Outcome) -> None:
    rows = {row.what: row for row in outcome.rows}
    assert rows["largest error of ΔC, CapSense, gaps 5 to 100 mm"].verdict == "met"
    assert rows["time of a step at 30,000 tetrahedra, the paper, three electrodes"].value > 100


def test_more_unknowns_err_less(outcome: Outcome) -> None:
    unknowns = [row["unknowns"] for row in points(outcome, "CapSense")]
    assert [row["preset or refinement"] for row in points(outcome, "CapSense")] == [*fig8.PRESETS]
    assert unknowns == sorted(unknowns)
    errors = largest_errors(outcome, "CapSense")
    assert errors[0] > errors[1:].max()


def test_times_are_of_whole_steps(outcome: Outcome) -> None:
    columns = outcome.tables["fig8"].columns
    for row in outcome.tables["fig8"].rows:
        of = dict(zip(columns, row, strict=True))
        assert 0 < float(of["median [ms]"]) <= float(of["95 % [ms]"]) <= float(of["99 % [ms]"])
        assert float(of["unknowns"]) >= 1


def test_a_second_run_measures_nothing(outcome: Outcome, folder: Path) -> None:
    again = fig8.run(folder, reduced=True, report=lambda *_: None)
    assert again.rows == outcome.rows


def test_it_writes_all(outcome: Outcome, tmp_path: Path) -> None:
    names = write_outcome(outcome, tmp_path)
    assert set(names) == {"fig8.csv", "fig8_paper.csv", "fig8.png", "rows.json", "report.md"}
    assert all((tmp_path / name).stat().st_size > 0 for name in names)


def test_the_papers_scheme_errs_more(outcome: Outcome) -> None:
    """On its finest mesh of the run it is farther off than CapSense's fastest preset."""
    masked = points(outcome, "paper's scheme")
    assert masked[0]["tetrahedra"] < fig8.SIZE < masked[-1]["tetrahedra"]
    assert (
        largest_errors(outcome, "paper's scheme").min() > largest_errors(outcome, "CapSense").max()
    )
