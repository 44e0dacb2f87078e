"""``capsense bench`` at reduced size: what it reports, not how fast."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from field_cases import delta_reference

from capsense.bench import REFERENCE_DIAGONAL, WORLDS
from capsense.cli.main import main


def test_bench_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every world has ordered times; the bar has an error within the solver's accuracy."""
    target = tmp_path / "bench.json"
    assert main(["bench", "--steps", "3", "-o", str(target)]) == 0
    text = capsys.readouterr().out
    figures = json.loads(target.read_text())
    assert set(figures["worlds"]) == set(WORLDS)
    for name, row in figures["worlds"].items():
        assert name in text
        assert 0 < row["median_ms"] <= row["p95_ms"] <= row["p99_ms"]
    assert figures["worlds"]["bar"]["error"] < 0.05


def test_reference_is_the_carried_one() -> None:
    """The figures in the package are those of the reference file."""
    expected = np.diag(delta_reference("six_patch", "bar_20"))
    np.testing.assert_allclose(REFERENCE_DIAGONAL, expected, atol=1e-17)


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Refused before anything is measured."""
    assert main(["bench", "--steps", "0"]) == 2
    assert "--steps 0" in capsys.readouterr().err
    assert main(["bench", "-o", str(tmp_path / "no" / "b.json")]) == 2
    assert "there is no folder" in capsys.readouterr().err
