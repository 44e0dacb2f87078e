"""``capsense tolerance`` on the page's study, which is small and coarse."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import tiny_field

from capsense.__main__ import BAD_INPUT, OK, main

EXAMPLES = Path(__file__).parents[3] / "examples"
PAGE = Path(__file__).parents[3] / "docs" / "sweeps.md"


def test_the_page_s_study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It runs as printed, with four samples; of a finished table, nothing is computed again."""
    text = PAGE.read_text(encoding="utf-8").split('```toml title="study.toml"\n')[1].split("```")[0]
    study, table, plot = (tmp_path / n for n in ("study.toml", "samples.csv", "tornado.png"))
    study.write_text(text.replace("samples = 16 ", "samples = 4 "))
    command = ["tolerance", str(study), "-o", str(table), "--plot", str(plot)]
    assert main([*command[:-1], str(tmp_path / "a.txt")]) == BAD_INPUT
    assert not table.exists()
    capsys.readouterr()
    assert main(command) == OK
    first, told = capsys.readouterr()
    assert "4 designs of about" in told
    rows = [line.split() for line in first.splitlines() if line]
    assert rows[1][0] == "C0_E_E"
    assert next(row[:2] for row in rows if row[0] == "all") == ["all", "100.0"]
    assert next(row[:4] for row in rows if row[0] == "side")[1:2] == ["100.0"]
    assert plot.stat().st_size > 1000
    content = table.read_bytes()
    assert main(command) == OK
    again, told = capsys.readouterr()
    assert (again, "designs" in told) == (first, False)
    assert table.read_bytes() == content


def test_the_decision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example ranks parameters, finds the cheapest choice that reaches its target by the linear
    fit, and checks it by a study of its own; run again, it computes nothing."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    example = importlib.import_module("tolerance_decision")
    monkeypatch.setattr(
        "capsense.studies.capacitances.default_settings", lambda _: tiny_field.SETTINGS
    )
    monkeypatch.setattr("capsense.field.background.has_even_face", lambda _: False)
    monkeypatch.setattr(example, "JOBS", 1)
    with tiny_field.few_sources():
        confirmed = example.main(tmp_path, samples=16)
    text = capsys.readouterr().out
    assert (tmp_path / "tornado.png").stat().st_size > 10_000
    ranked = [line.split()[0] for line in text.splitlines() if "of the variance" in line]
    assert ranked[0] == "standoff"
    assert set(ranked) == {"side", "standoff", "cover", "eps", "gain", "trace", "person"}
    choices = re.findall(r"^(\w.*), (\d\.\d\d): ([\d.]+) %$", text, re.M)
    assert len(choices) == 8
    yields = {name: float(share) for name, _, share in choices}
    assert max(yields, key=lambda name: yields[name]).startswith("spacers")
    enough = [(float(cost), name) for name, cost, share in choices if float(share) >= 99.0]
    assert text.splitlines()[-1].startswith(f"decision: {min(enough)[1]} for {min(enough)[0]:.2f}")
    assert ("do it" in text.splitlines()[-1]) == confirmed
    monkeypatch.setattr("capsense.studies.capacitances.build_background", None)
    assert example.main(tmp_path, samples=16) == confirmed
    assert capsys.readouterr().out == text
