"""Round trips through the server: ``python benchmarks/server_round_trips.py``.

Sends a moving dome as 64 × 64 depth frames, one after another, over loopback to a server in a
process of its own, and waits for each reading. Times are of this machine, as found; what the server
says its step took is taken from each round trip, and the rest is what the protocol costs. What the
processor spent on the server is little changed by other programs, and bounds what it can do on a
machine of its own. With ``mcs`` and ``mono`` there, the Unity package is measured as well. Tracked
hands are those of ``examples/hands/reach.npz``, in place of images.
``--runs`` measures all in turn, several times.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from capsense.bench import moving_depth
from capsense.humans import HandRecording
from capsense.server import ReadingMessage
from capsense.server.client import Client

ROOT = Path(__file__).parents[1]
SKIPPED = 0.1
"""Part of the round trips that is left out, during which caches fill."""


@contextmanager
def server(design: str) -> Iterator[tuple[str, int]]:
    """A server in a process of its own; gives its address and process number."""
    command = [sys.executable, "-m", "capsense", "serve", "--design", design, "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            yield json.loads(process.stderr.readline())["url"], process.pid
        finally:
            process.terminate()


def processor_time(process: int) -> float:
    """What the processor has spent on a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def domes() -> list[np.ndarray]:
    """The frames."""
    return [moving_depth(k).depth[0].astype(np.float32) for k in range(500)]


def round_trips(url: str, count: int, frames: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Round trips and steps [s], shape (n,)."""
    taken, solve = np.empty(count), np.empty(count)
    with Client(url) as client:
        sensor = client.open()
        for k in range(count):
            start = time.perf_counter()
            solve[k] = sensor.step(frames[k % len(frames)]).wall_time
            taken[k] = time.perf_counter() - start
    first = int(SKIPPED * count)
    return taken[first:], solve[first:]


def python_client(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Round trips and steps [s], shape (n,)."""
    return round_trips(url, count, domes())


def nothing_in_view(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The same with frames that leave nothing to solve."""
    return round_trips(url, count, [np.zeros((64, 64), np.float32)])


def python_stream(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Times between readings, and steps [s], shape (n,); the next frame is sent meanwhile."""
    frames = domes()
    came, solve = np.empty(count), np.empty(count)
    with Client(url) as client:
        sensor = client.open()
        answered = 0
        for k in range(count):
            while sensor.sequence < answered + 2:
                sensor.send(frames[sensor.sequence % len(frames)])
            reading = client.receive()
            assert isinstance(reading, ReadingMessage)
            answered, solve[k] = reading.sequence + 1, reading.wall_time
            came[k] = time.perf_counter()
    first = int(SKIPPED * count)
    return np.diff(came[first - 1 :]), solve[first:]


def unity_client(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The same by the Unity package under mono."""
    sources = [*(ROOT / "tests/e2e/unity").glob("*.cs"), *(ROOT / "unity/Runtime").rglob("*.cs")]
    sources += (ROOT / "unity/Samples~").rglob("*.cs")
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/driver.exe"
        subprocess.run(
            ["mcs", "-langversion:7.2", f"-out:{program}", *map(str, sources)], check=True
        )
        told = subprocess.run(
            ["mono", program, "steps", url, str(count)], check=True, capture_output=True, text=True
        )
    figures = json.loads(told.stdout.splitlines()[-1])
    return np.array(figures["round_trip_s"]), np.array(figures["solve_s"])


def two_clients(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The same by two clients at once, each with a sensor of its own."""
    with ThreadPoolExecutor(2) as pool:
        taken, solve = zip(*pool.map(python_client, [url, url], [count, count]), strict=True)
    return np.concatenate(taken), np.concatenate(solve)


def tracked_hands(url: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames of the tracked hand of the example; the server has its model and filters them."""
    recording = HandRecording.load(ROOT / "examples" / "hands" / "reach.npz")
    taken, solve = np.empty(count), np.empty(count)
    with Client(url) as client:
        sensor = client.open(material="human", grounding=100e-12)
        length = recording.time[-1] + 1 / 60
        for k in range(count):
            lap, frame = divmod(k, len(recording))
            joints = {recording.side: recording.joints[frame]}
            now = lap * length + recording.time[frame]
            start = time.perf_counter()
            solve[k] = sensor.step_hands(joints, now, convention=recording.convention).wall_time
            taken[k] = time.perf_counter() - start
    first = int(SKIPPED * count)
    return taken[first:], solve[first:]


CLIENTS = {
    "Python": (python_client, 1),
    "Python, streaming": (python_stream, 1),
    "Python, two at once": (two_clients, 2),
    "Unity package, mono": (unity_client, 1),
    "Python, empty frames": (nothing_in_view, 1),
    "Python, tracked hands": (tracked_hands, 1),
}
COLUMNS = ("a second", "median", "p95", "p99", "solve", "protocol", "server")


def figures(name: str, design: str, count: int) -> list[float]:
    """One number for each of the columns; times in milliseconds."""
    measure, clients = CLIENTS[name]
    with server(design) as (url, process):
        measure(url, 50)
        before = processor_time(process)
        taken, solve = measure(url, count)
        spent = (processor_time(process) - before) / (count * clients)
    times = (*np.percentile(taken, [50, 95, 99]), np.median(solve), np.median(taken - solve), spent)
    return [clients / taken.mean(), *(1e3 * np.array(times))]


def main() -> None:
    """Print a row for each client."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="round trips of each client")
    parser.add_argument("--runs", type=int, default=1, help="of each; figures are their medians")
    parser.add_argument("--design", default="six_patch")
    args = parser.parse_args()
    names = [*CLIENTS]
    if not (shutil.which("mcs") and shutil.which("mono")):
        names.remove("Unity package, mono")
    runs: dict[str, list[list[float]]] = {name: [] for name in names}
    loads = []
    for _ in range(args.runs):
        for name in names:
            runs[name].append(figures(name, args.design, args.count))
            loads.append(os.getloadavg()[0])
    print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {min(loads):.1f} to {max(loads):.1f}, "
        f"Python {platform.python_version()}, {args.design}, {args.count} round trips, "
        f"median of {args.runs} runs"
    )
    print(f"{'client':20}" + "".join(f"{c:>10}" for c in COLUMNS))
    for name in names:
        rate, *times = np.median(runs[name], axis=0)
        print(f"{name:20}{rate:10.0f}" + "".join(f"{v:10.2f}" for v in times))
    print(
        "ms by the clock; solve and protocol are medians. server: processor's time of a round trip"
    )


if __name__ == "__main__":
    main()
