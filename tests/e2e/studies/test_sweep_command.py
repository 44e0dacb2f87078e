"""``capsense sweep`` on a real design, small and coarse."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import BAD_INPUT, OK, main

PAD = """
name = "pad"
domain = { size = [0.2, 0.2, 0.2], backplane = 0.01 }
build = { resolution = 0.25 }
electrode = [{ name = "E", shape = "rectangle", size = ["=side", "=side"] }]
"""
BALL = """
name = "ball"
design = "patch"
sample_rate = 1
[[body]]
name = "ball"
shape = "sphere"
radius = 0.01
material = "steel"
pose = { position = [0.0, 0.0, 0.03] }
"""


def test_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The table holds what a simulator of each design reads; killed halfway, it goes on."""
    design, ball, table = (tmp_path / n for n in ("pad.toml", "ball.toml", "pad.csv"))
    design.write_text(PAD)
    ball.write_text(BALL)
    command = ["sweep", str(design), "--vary", "side=10mm,20mm,300mm", "-o", str(table)]
    command += ["--scenario", str(ball)]
    assert main(command) == OK
    text, told = capsys.readouterr()
    assert "2 designs of about" in told
    assert "1 without results" in text
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [bool(row["error"]) for row in rows] == [False, False, True]
    (tmp_path / "20.toml").write_text(PAD.replace('"=side"', "0.02"))
    sim = cs.Simulator(tmp_path / "20.toml", cache_dir=tmp_path)
    steel = cs.Body(cs.Sphere(0.01), cs.Pose((0.0, 0.0, 0.03)), "steel")
    reading = sim.step(cs.Scene([steel]))
    assert float(rows[1]["C0_E_E"]) == approx(sim.baseline[0, 0], rel=1e-9)
    assert float(rows[1]["dC_E_E"]) == approx((reading.capacitance - sim.baseline)[0, 0], rel=1e-6)
    whole = table.read_bytes()
    table.write_bytes(whole[: whole.index(b"\n", whole.index(b"\n") + 1) + 20])
    assert main(command) == OK
    assert "1 designs of about" in capsys.readouterr().err
    assert table.read_bytes() == whole
    assert np.array([float(r["C0_E_E"]) for r in rows[:2]]) @ [-1, 1] > 0


def test_wrong_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Refused before any work, with what to write."""
    design = tmp_path / "pad.toml"
    design.write_text(PAD)
    table = str(tmp_path / "t.csv")
    for arguments, why in (
        (["--vary", "side=1mm", "-o", "t.txt"], "ends in .csv"),
        (["--vary", "side=1mm", "--vary", "side=2mm", "-o", table], "given twice"),
        (["--vary", "size=1mm", "-o", table], "no expression uses 'size'"),
        (["--vary", "side=1:2:999999", "-o", table], "999999 points"),
        (["--vary", "side=900mm", "-o", table], "pad.toml"),
    ):
        assert main(["sweep", str(design), *arguments]) == BAD_INPUT
        assert why in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["pad.toml"]
