"""Rows, verdicts, and the files and exit codes that come of them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from approximate import approx
from matplotlib.figure import Figure

from capsense import reproduce
from capsense.__main__ import main
from capsense.reproduce import STUDIES, load_study
from capsense.reproduce.harness import (
    MAX_ROWS,
    Outcome,
    Report,
    ReportTable,
    Row,
    Store,
    judged,
    write_outcome,
)


def sample_study(folder: Path, *, reduced: bool, report: Report) -> Outcome:
    """Two parts; the row is met in full and missed in reduced form."""
    store = Store(folder)
    total = 0.0
    for k in (1, 2):
        report(f"part {k}", k / 2)
        total += float(store.get("part", {"k": k}, lambda k=k: {"v": 0.1 * k})["v"])
    return Outcome(
        "A sample",
        (judged("sum", total, "F", above=0.5 if reduced else 0.2, source="made up"), Row("n", 2)),
        {"values": ReportTable(("k", "v [F]"), ((1, 1 / 3), (2, 2 / 3)))},
        {"picture": Figure()},
        ("It shows nothing.",),
        store.told(),
    )


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sample study in place of all others."""
    for name in list(STUDIES):
        monkeypatch.delitem(STUDIES, name)
    monkeypatch.setitem(STUDIES, "sample", f"{__name__}:sample_study")


def test_judged() -> None:
    """A limit itself is not better than the limit."""
    assert judged("r", 0.98, above=0.976).verdict == "met"
    assert judged("r", 0.976, above=0.976).verdict == "missed"
    assert judged("e", 0.01, below=0.016, source="paper").target == "< 0.016 (paper)"
    assert judged("e", 0.016, below=0.016).verdict == "missed"
    with pytest.raises(ValueError, match="one of above and below"):
        judged("x", 1.0)
    with pytest.raises(ValueError, match="nan"):
        Row("x", float("nan"))
    with pytest.raises(ValueError, match="1 cells for 2"):
        ReportTable(("a", "b"), ((1,),))


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize(("options", "code"), [([], 0), (["--reduced"], 3)])
def test_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int
) -> None:
    """The table is printed, everything is written, a missed row is told by the exit code."""
    assert main(["reproduce", "all", "-o", str(tmp_path), *options]) == code
    folder = tmp_path / "sample"
    verdict = "missed" if code else "met"
    printed = capsys.readouterr().out
    assert verdict in printed
    assert "2 parts computed, 0 reused" in printed
    rows = json.loads((folder / "rows.json").read_text())["rows"]
    assert [r["verdict"] for r in rows] == [verdict, "for information"]
    assert rows[0]["value"] == approx(0.3, abs=1e-15)
    with (folder / "values.csv").open() as file:
        assert list(csv.reader(file)) == [
            ["k", "v [F]"],
            ["1", "0.3333333333"],
            ["2", "0.6666666667"],
        ]
    page = (folder / "report.md").read_text()
    assert "![picture](picture.png)" in page
    assert "| 2 | 0.66667 |" in page
    assert (folder / "picture.png").stat().st_size > 0
    assert len(list((folder / "parts").iterdir())) == 2
    assert main(["reproduce", "sample", "-o", str(tmp_path), *options]) == code
    assert "0 parts computed, 2 reused" in capsys.readouterr().out


@pytest.mark.usefixtures("registered")
def test_interrupted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 130, and a word on where the parts are."""

    def stopped(folder: Path, *, reduced: bool, report: Report) -> Outcome:
        Store(folder).get("part", {}, lambda: {"v": 1})
        raise KeyboardInterrupt

    monkeypatch.setattr(__import__(__name__), "sample_study", stopped)
    assert main(["reproduce", "sample", "-o", str(tmp_path)]) == 130
    assert "kept in" in capsys.readouterr().err
    assert len(list((tmp_path / "sample" / "parts").iterdir())) == 1


@pytest.mark.usefixtures("registered")
def test_bad_output(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file in the folder's place is refused before anything is computed."""
    (tmp_path / "file").write_text("")
    assert main(["reproduce", "sample", "-o", str(tmp_path / "file")]) == 2
    assert "give another one" in capsys.readouterr().err


def test_long_tables_are_named(tmp_path: Path) -> None:
    """The report stays readable."""
    long = ReportTable(("k",), tuple((k,) for k in range(MAX_ROWS + 1)))
    write_outcome(Outcome("T", (), {"long": long}), tmp_path)
    assert f"- [long.csv](long.csv), {MAX_ROWS + 1} rows" in (tmp_path / "report.md").read_text()


def test_reduced_form_is_told(tmp_path: Path) -> None:
    """A check is not taken for a result."""
    write_outcome(Outcome("T", ()), tmp_path)
    assert not json.loads((tmp_path / "rows.json").read_text())["reduced"]
    assert "Reduced" not in (tmp_path / "report.md").read_text()
    write_outcome(Outcome("T", ()), tmp_path, reduced=True)
    assert json.loads((tmp_path / "rows.json").read_text())["reduced"]
    assert "# T\n\nReduced form" in (tmp_path / "report.md").read_text()


@pytest.mark.parametrize("study", ["scenario2", "all"])
def test_missing_package(
    study: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is named, with the line that installs it, before any study begins."""
    monkeypatch.setattr(reproduce, "find_spec", lambda name: None if name == "mujoco" else name)
    assert main(["reproduce", study, "-o", str(tmp_path / "out")]) == 2
    assert "pip install 'capsense[mujoco]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_registered_study_is_there() -> None:
    """The registry names functions that exist."""
    for name in STUDIES:
        assert callable(load_study(name))
