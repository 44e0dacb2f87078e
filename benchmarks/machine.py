"""What a benchmark ran on, how to hold it to one core, and how it takes time."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

_T = TypeVar("_T")

THREADS = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS",
     "NGS_NUM_THREADS"), "1",
)  # fmt: skip


def on_one_core() -> None:
    """Start the program again with one thread for every library, unless it was started so."""
    if any(os.environ.get(name) != value for name, value in THREADS.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **THREADS})


@dataclass
class Times:
    """Times of calls [ms], by the clock and by what the processor spent on them.

    On a machine that other programs use too, a long call is interrupted more often than a short
    one, and the clock makes it look longer than it is; the processor's time does not.
    """

    clock: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)

    def take(self, call: Callable[[], _T], keep: bool = True) -> _T:
        """Make a call, and keep its times if wanted."""
        clock, processor = time.perf_counter(), time.process_time()
        out = call()
        spent, passed = time.process_time() - processor, time.perf_counter() - clock
        if keep:
            self.clock.append(1e3 * passed)
            self.processor.append(1e3 * spent)
        return out

    def summary(self) -> dict[str, float]:
        """Median, mean, p95 and p99 of the processor's time [ms], and the same by the clock."""
        out: dict[str, float] = {"steps": len(self.clock)}
        for prefix, times in (("", self.processor), ("clock_", self.clock)):
            out[f"{prefix}median_ms"] = float(np.median(times))
            out[f"{prefix}mean_ms"] = float(np.mean(times))
            out[f"{prefix}p95_ms"], out[f"{prefix}p99_ms"] = np.percentile(times, (95, 99)).tolist()
        return out


def describe_machine(packages: tuple[str, ...]) -> dict[str, Any]:
    """Processor, cores, load and versions; missing packages are left out."""
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "machine": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
        "versions": versions,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), "unknown")
