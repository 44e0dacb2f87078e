"""Killed recorders, full disks, files cut short and files damaged."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import capsense as cs
from capsense.errors import RecordingError

Recorded = tuple[Path, list[cs.Reading]]

PRELUDE = """
import signal, sys, time
sys.path.insert(0, {helpers!r})
import capsense as cs, recorded_scenes
sim = cs.Simulator("six_patch")
run = cs.record({path!r}, sim)
"""
STEADY = """
for k in range(10**6):
    run.step(recorded_scenes.scene_at(k % 40), 0.01 * k)
    print(time.monotonic(), k + 1, flush=True)
    time.sleep(0.01)
"""
PAUSED = """
for k in range(25):
    run.step(recorded_scenes.scene_at(k), 0.01 * k)
print(time.monotonic(), 25, flush=True)
time.sleep(600)
"""
FULL = """
import resource
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (90_000, resource.RLIM_INFINITY))
taken = 0
try:
    while True:
        run.step(recorded_scenes.frame_at(taken % 7), 0.01 * taken)
        taken += 1
        time.sleep(0.02)  # what is written at once fits, on fast machines too
except OSError as error:
    print(taken, flush=True)
    print(error, flush=True)
try:
    run.close()
except OSError as error:
    print(error, flush=True)
print(len(list(cs.open_recording({path!r}).steps())), cs.open_recording({path!r}).complete)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
run.close()
"""


def child(script: str, path: Path) -> list[str]:
    helpers = str(Path(__file__).parents[2] / "helpers")
    return [sys.executable, "-c", (PRELUDE + script).format(path=str(path), helpers=helpers)]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize("script", [STEADY, PAUSED], ids=["stepping", "paused"])
def test_a_killed_recorder_loses_at_most_a_second(script: str, tmp_path: Path) -> None:
    """Also of a loop that has come to a stand-still."""
    path = tmp_path / "killed.mcap"
    process = subprocess.Popen(child(script, path), stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = [process.stdout.readline()]
    until = time.monotonic() + 2.5
    if script is STEADY:
        while time.monotonic() < until:
            lines.append(process.stdout.readline())
    else:
        time.sleep(1.5)
    killed = time.monotonic()
    process.send_signal(signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL
    stamps = [line.split() for line in lines]
    due = max(int(count) for stamp, count in stamps if float(stamp) <= killed - 1.0)
    recording = cs.open_recording(path)
    assert not recording.complete
    steps = list(recording.steps())
    assert len(steps) >= due > 0
    found = cs.replay(recording)
    assert found.same
    assert (found.steps, found.complete) == (len(steps), False)


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of that kind")
def test_a_full_disk(tmp_path: Path) -> None:
    """The error names the file; what was recorded is in it, and the rest once there is room."""
    path = tmp_path / "full.mcap"
    done = subprocess.run(child(FULL, path), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    taken, first, second, kept = done.stdout.splitlines()
    for error in (first, second):
        assert "File too large" in error
        assert str(path) in error
        assert "half a second" in error
    steps, complete = kept.split()
    assert complete == "False"
    assert 0 < int(steps) <= int(taken)  # all of them, where the step that failed was alone in it
    recording = cs.open_recording(path)
    assert recording.complete
    assert len(list(recording.steps())) == int(taken)
    assert cs.replay(recording).same


COMMAND = """
import resource, signal, sys
from capsense.__main__ import main
from capsense.recording import files
files.FLUSH_EVERY = 0.01  # so that how much is written at once does not depend on the machine
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, resource.RLIM_INFINITY))
sys.exit(main(["record", {scenario!r}, "-o", {path!r}, "-q"]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of that kind")
@pytest.mark.parametrize("room", [5000, 40_000, 90_000])
def test_a_command_on_a_full_disk(tmp_path: Path, room: int) -> None:
    """It ends with its message, not with a trace, and what fits can be read."""
    path = tmp_path / "full.mcap"
    scenario = Path(__file__).parents[3] / "examples" / "hand_approach.toml"
    script = COMMAND.format(room=room, scenario=str(scenario), path=str(path))
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 1
    assert "File too large; the file holds what was recorded" in done.stderr
    assert "Traceback" not in done.stderr
    if room > 5000:  # the beginning fits
        assert path.stat().st_size > 0.5 * room
        recording = cs.open_recording(path)
        steps = list(recording.steps())
        assert 0 < len(steps) < 282
        assert cs.replay(recording).same


def test_every_length_can_be_read(recorded: Recorded, tmp_path: Path) -> None:
    """Cut anywhere: no recording at all if the beginning is gone, else the first n steps."""
    content = recorded[0].read_bytes()
    part = tmp_path / "part.mcap"
    lengths = [*range(0, 64), *random.Random(1).sample(range(64, len(content) - 1), 40)]
    counts = {}
    for length in sorted(lengths):
        part.write_bytes(content[:length])
        try:
            recording = cs.open_recording(part)
        except RecordingError:
            assert length < len(content) / 2
            continue
        assert not recording.complete
        counts[length] = len(list(recording.steps()))
    assert sorted(counts.values()) == list(counts.values())
    assert max(counts.values()) == 12
    assert counts


def test_zeros_at_the_end(recorded: Recorded, tmp_path: Path) -> None:
    """What some file systems leave when the power fails."""
    content = recorded[0].read_bytes()
    part = tmp_path / "zeros.mcap"
    part.write_bytes(content[:-200].ljust(len(content) + 5000, b"\0"))
    recording = cs.open_recording(part)
    assert not recording.complete
    assert len(list(recording.steps())) == 12


def test_damage_is_told(recorded: Recorded, tmp_path: Path) -> None:
    """No flipped byte gives other numbers: it is refused, or it lies where nothing is read."""
    content = recorded[0].read_bytes()
    readings = recorded[1]
    part = tmp_path / "damaged.mcap"
    refused = 0
    for place in random.Random(2).sample(range(8, len(content) - 8), 60):
        damaged = bytearray(content)
        damaged[place] ^= 0x41
        part.write_bytes(damaged)
        try:
            steps = list(cs.open_recording(part).steps())
        except RecordingError:
            refused += 1
            continue
        assert len(steps) == 12
        for step, reading in zip(steps, readings, strict=True):
            assert step.reading.capacitance.tobytes() == reading.capacitance.tobytes()
    assert refused > 20  # indexes, schemas and checksums aside, everything is read


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read"), (b"", "no MCAP file"), (b"time_s,C_E1\n", "no MCAP file")],
)
def test_other_files(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "other.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        cs.open_recording(path)


def test_mcap_of_others(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(RecordingError, match="no recording of capsense"):
        cs.open_recording(path)


def test_an_empty_recording(simulators: object, tmp_path: Path) -> None:
    sim = simulators("six_patch")  # type: ignore[operator]
    cs.record(tmp_path / "empty.mcap", sim).close()
    found = cs.replay(tmp_path / "empty.mcap")
    assert (found.steps, found.same) == (0, True)
