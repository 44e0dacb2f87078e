"""``capsense tolerance`` on the page's study, which is small and coarse."""

from __future__ import annotations

from pathlib import Path

import pytest

from capsense.__main__ import BAD_INPUT, OK, main

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
    assert plot.stat().st_size > 1000
    content = table.read_bytes()
    assert main(command) == OK
    again, told = capsys.readouterr()
    assert (again, "designs" in told) == (first, False)
    assert table.read_bytes() == content
