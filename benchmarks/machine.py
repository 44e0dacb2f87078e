"""What a benchmark ran on, and how to hold it to one core."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from capsense.bench import Times

__all__ = ["Times", "describe_machine", "on_one_core"]

THREADS = {
    **dict.fromkeys(
        ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS",
         "NGS_NUM_THREADS", "OMP_THREAD_LIMIT"), "1",
    ),
    "KMP_WARNINGS": "0",
}  # fmt: skip
"""The limit is for CHOLMOD, which asks OpenMP for four threads whatever the number of them is set
to; and OpenMP would tell of every request that it cuts."""


def on_one_core() -> None:
    """Start the program again with one thread for every library, unless it was started so."""
    if any(os.environ.get(name) != value for name, value in THREADS.items()):
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **THREADS})


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
