"""Processes that work for another one end with it, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")

DATA_SET = """
name = "balls"
design = "patch"
scenes = 100000
shard_size = 5

[[body]]
name = "ball"
shape = "sphere"
radius = { from = 0.01, to = 0.03 }
material = "steel"
pose = { position = [0, 0, { from = 0.05, to = 0.1 }] }
"""
SCENARIO = """
name = "ball"
design = "patch"
sample_rate = 1

[[body]]
name = "ball"
shape = "sphere"
radius = 0.02
material = "steel"
pose = { position = [0, 0, 0.06] }
"""
BUSY = """
import sys, time
from capsense._workers import process_pool
if __name__ == "__main__":
    with process_pool(2) as pool:
        list(pool.map(time.sleep, [1000, 1000]))
"""


def workers_of(pid: int) -> set[int]:
    """Processes of multiprocessing's spawning that another process has started."""
    out = set()
    for folder in Path("/proc").iterdir():
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if parent == pid and b"spawn_main" in (folder / "cmdline").read_bytes():
                out.add(int(folder.name))
        except (OSError, ValueError):
            continue
    return out


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and not been collected does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(what: Callable[[], bool], seconds: float) -> bool:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if what():
            return True
        time.sleep(0.05)
    return what()


@pytest.mark.parametrize("how", ["busy", "dataset", "sweep"])
def test_workers_end_with_a_killed_parent(tmp_path: Path, how: str) -> None:
    """After kill -9 of the command nothing of it is left; one that is not killed goes on."""
    if how == "dataset":
        pytest.importorskip("pyarrow")
    text = {"busy": BUSY, "dataset": DATA_SET, "sweep": SCENARIO}[how]
    file = tmp_path / ("busy.py" if how == "busy" else "spec.toml")
    file.write_text(text)
    out = tmp_path / ("out.csv" if how == "sweep" else "out")
    command = {
        "busy": [],
        "dataset": ["dataset", file, "-o", out, "--workers", "2"],
        "sweep": ["sweep", "patch", "--scenario", file, "-o", out, "--jobs", "2"],
    }[how]
    if how == "sweep":
        command += ["--vary", "body.ball.pose.position.z=50mm:100mm:20000"]
    command = [sys.executable, *(["-m", "capsense", *command] if command else [file])]
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        assert wait_for(lambda: len(workers_of(parent.pid)) == 2, 120)
        found = workers_of(parent.pid)
        done = {
            "busy": lambda: True,
            "dataset": lambda: len(list(out.glob("data/*.parquet"))) > 2,
            "sweep": lambda: out.exists() and len(out.read_text().splitlines()) > 3,
        }[how]
        assert wait_for(done, 240)
        assert all(map(is_alive, found))
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        assert wait_for(lambda: not any(map(is_alive, found)), 10)
    finally:
        for pid in [*workers_of(parent.pid), *([] if parent.poll() is not None else [parent.pid])]:
            os.kill(pid, signal.SIGKILL)
        parent.wait()
