"""Runs in front of a design with a cover print and keep what is pressed onto it."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import main

FOAM = Path(__file__).parents[2] / "data/foam.toml"
SCENARIO = f"""
name = "press"
design = "{FOAM}"
sample_rate = 10.0
duration = 0.2

[[body]]
name = "ball"
shape = "sphere"
radius = 0.01
material = "steel"
force = 0.5
pose = {{ position = [-0.012, 0.0, 0.012] }}
"""


def test_a_run_tells_of_touch(
    foam_field: cs.Design, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "press.toml", tmp_path / "out"
    file.write_text(SCENARIO)
    assert main(["run", str(file), "-o", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:3] == ["whole", "cover", "0.5"] for line in lines)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["touch"]["largest_total_N"] == approx(0.5)
    assert summary["touch"]["largest_force_N"] == approx([0.5, 0.0], rel=0.05)
    assert summary["columns"]["force_A_N"] == "force that the cover carries above A, N"
    with (out / "readings.csv").open() as table:
        assert float(next(csv.DictReader(table))["force_total_N"]) == approx(0.5)
