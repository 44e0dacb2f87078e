"""The command itself, in processes of their own, with the real simulator."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

ROOT = Path(__file__).parents[3]
COMMAND = [sys.executable, "-m", "capsense"]


def test_run(tmp_path: Path) -> None:
    """A whole run: physical matrices, and a small estimate of the error."""
    scenario = ROOT / "examples" / "hand_approach.toml"
    out = tmp_path / "out"
    done = subprocess.run(
        [*COMMAND, "run", str(scenario), "-o", str(out), "--rate", "2"],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "a forearm over six electrodes" in done.stdout
    arrays = np.load(out / "readings.npz")
    capacitance = arrays["capacitance"]
    assert capacitance.shape == (12, 6, 6)
    scale = np.abs(capacitance).max()
    assert capacitance == approx(capacitance.transpose(0, 2, 1), abs=1e-6 * scale)
    off = capacitance[:, ~np.eye(6, dtype=bool)]
    assert off.max() <= 1e-3 * scale
    assert capacitance.sum(axis=2).min() >= -1e-3 * scale
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["largest_error_estimate_F"] < 0.05 * np.abs(arrays["delta"]).max()
    assert summary["field"]["boundary panels"] > 1000


DESIGN = """
name = "one"
[domain]
size = [0.5, 0.5, 0.5]
backplane = 0.010
[[electrode]]
name = "pad"
shape = "rectangle"
size = [0.031, 0.030]
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is not a signal there")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_while_a_field_is_built(tmp_path: Path, number: signal.Signals) -> None:
    """Exit code 130, a message, and nothing is left behind."""
    path, cache = tmp_path / "one.toml", tmp_path / "cache"
    path.write_text(DESIGN)
    process = subprocess.Popen(
        [*COMMAND, "design", str(path)], env={**os.environ, "CAPSENSE_CACHE_DIR": str(cache)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 300
    while not list(cache.glob("*.lock")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "no build within five minutes"
        time.sleep(0.01)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (130, "capsense: interrupted\n")
    assert list(cache.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is not a signal there")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt(tmp_path: Path, number: signal.Signals) -> None:
    """A signal in the middle: exit code 130, and every file holds the same samples."""
    out = tmp_path / "out"
    scenario = ROOT / "examples" / "hand_approach.toml"
    process = subprocess.Popen(
        [*COMMAND, "run", str(scenario), "-o", str(out), "--rate", "5000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    table = out / "readings.csv"
    deadline = time.monotonic() + 300
    while not (table.exists() and len(table.read_bytes().splitlines()) > 5):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "no samples within five minutes"
        time.sleep(0.05)
    process.send_signal(number)
    text, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "interrupted after" in errors
    assert "Traceback" not in errors
    rows = len(table.read_text(encoding="utf-8").splitlines()) - 1
    assert 5 <= rows < 28000
    assert len(np.load(out / "readings.npz")["time"]) == rows
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["samples"] == rows
    assert summary["interrupted"] is True
    assert f"{rows} of {summary['samples_planned']}, interrupted" in text
    assert (out / "plot.png").read_bytes().startswith(b"\x89PNG")
