"""Versions of what the numbers depend on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

from llvmlite.binding import get_host_cpu_name

from capsense.field.background import NUMERICS


def versions() -> dict[str, str]:
    """Versions of Python, the packages that compute and the fields' numerics; the processor."""
    out = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": get_host_cpu_name(),
        "numerics": str(NUMERICS),
    }
    for package in ("capsense", "numpy", "scipy", "numba"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = "not installed"
    return out
