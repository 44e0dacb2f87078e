"""``capsense sweep`` on a real design, small and coarse."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import BAD_INPUT, OK, main
from capsense.readout.channels import Wiring
from capsense.studies import derivatives

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
    command += ["--scenario", str(ball), "--jobs", "1"]
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
        (["--vary", "side=1mm", "-o", table, "--derivatives", "edge"], "it is not varied"),
        (["--vary", "side=1mm", "-o", table, "--outputs", "C0"], "give --plot"),
        (["--vary", "side=1mm", "-o", table, "--plot", f"{table}.png"], "0 change"),
        (["--vary", "side=1mm", "-o", table, "--plot", f"{table}.txt"], "is no picture"),
        (["--vary", "wiring.trace=1pF", "-o", table], "give --readout"),
    ):
        assert main(["sweep", str(design), *arguments]) == BAD_INPUT
        assert why in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["pad.toml"]


def test_bodies_and_chips(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Keys of a body and of a chip: what a simulator and its readout give, with one field for all
    points, by all processors, in Parquet, with a plot."""
    parquet = pytest.importorskip("pyarrow.parquet", reason='needs pip install "capsense[record]"')
    ball, table, plot = (tmp_path / n for n in ("ball.toml", "t.parquet", "t.png"))
    ball.write_text(BALL)
    command = ["sweep", "patch", "--scenario", str(ball), "--readout", "fdc1004"]
    command += ["--vary", "body.ball.pose.position.z=20mm,30mm", "-o", str(table)]
    command += ["--vary", "body.ball.material=steel,glass", "--vary", "wiring.trace=2pF"]
    command += ["--plot", str(plot), "--outputs", "dC_E1_E1,dcode_E1"]
    assert main(command) == OK
    text, told = capsys.readouterr()
    assert "4 points; 1 designs of about" in told
    assert "its field is there" in told
    assert text == f"4 rows in {table}\n"
    assert plot.stat().st_size > 10_000
    sim = cs.Simulator("patch")
    rows = parquet.read_table(table).to_pylist()
    for row in rows:
        place = cs.Pose((0.0, 0.0, row["body.ball.pose.position.z"]))
        body = cs.Body(cs.Sphere(0.01), place, row["body.ball.material"])
        reading = sim.step(cs.Scene([body]))
        assert row["dC_E1_E2"] == approx(reading.delta[0, 1], rel=1e-9)
        chip = cs.Readout.preset(
            "fdc1004", sim.electrode_names, noise=False, wiring=Wiring(trace=2e-12)
        )
        counts = chip([0.0, 1.0, 1.1, 2.0], [sim.empty, sim.empty, reading, reading]).of("E1")
        assert row["code0_E1"] == counts.code[0]
        assert row["dcode_E1"] == counts.code[-1] - counts.code[0]
    assert rows[0]["dC_E1_E1"] > 2 * rows[1]["dC_E1_E1"] > 0


def test_derivatives_of_changes(tmp_path: Path) -> None:
    """By a body's height they are the solver's own Jacobian, but for its choice of functions, and
    differences of its readings over small steps, within their estimated errors."""
    (tmp_path / "ball.toml").write_text(BALL)
    key = "body.ball.pose.position.z"
    found = derivatives("patch", {key: 0.03}, scenario=tmp_path / "ball.toml")
    sim = cs.Simulator("patch")
    ball = cs.Body(cs.Sphere(0.01), cs.Pose((0.0, 0.0, 0.03)), "steel")
    jacobian = sim.step(cs.Scene([ball]), jacobian=True).jacobian
    assert jacobian is not None
    upper = np.triu_indices(4)
    here = np.array([name.startswith("dC") for name in found.outputs])
    np.testing.assert_array_equal(found.values[~here], 0.0)
    values, errors = found.values[here, 0], found.errors[here, 0]
    np.testing.assert_allclose(values, jacobian[0, :, :, 2][upper], rtol=5e-3)
    assert (errors < 2e-3 * np.abs(values)).all()
    ends = [
        sim.step(cs.Scene([ball.moved(cs.Pose((0.0, 0.0, z)))])).delta[upper]
        for z in (0.0299, 0.0301)
    ]
    assert (np.abs(values - (ends[1] - ends[0]) / 2e-4) < 3 * errors + 2e-4 * abs(values)).all()


def test_derivatives_in_the_table(tmp_path: Path) -> None:
    """They agree with the difference of neighbouring rows."""
    design, table = tmp_path / "pad.toml", tmp_path / "pad.csv"
    design.write_text(PAD)
    command = ["sweep", str(design), "--vary", "side=19.9mm,20mm,20.1mm", "-o", str(table)]
    assert main([*command, "--derivatives", "side=0.5mm", "--jobs", "1", "-q"]) == OK
    with table.open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k != "key"} for row in csv.DictReader(file)]
    low, middle, high = (float(row["C0_E_E"]) for row in rows)
    slope = float(rows[1]["d(C0_E_E)/d(side)"])
    assert slope == approx((high - low) / 2e-4, rel=1e-3)
    assert 0 < float(rows[1]["error of d(C0_E_E)/d(side)"]) < 1e-3 * slope
    assert low < middle < high
