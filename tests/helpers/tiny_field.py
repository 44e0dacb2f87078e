"""A design whose field is built in a fraction of a second, and a process that builds it.

``python tiny_field.py CACHE LOG DELAY`` writes each stage to LOG as ``PID STAGE``, pauses DELAY
seconds where the fit begins, and prints a digest of the field.
"""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from capsense.design import Design, parse_design
from capsense.field.background import BackgroundField, BuildSettings, MeshSettings
from capsense.field.cache import load_or_build
from capsense.field.green import build_green, to_arrays
from capsense.field.green_points import GreenSettings

SETTINGS = BuildSettings(panel_scale=8.0, mesh=MeshSettings().refined(0.5))
FIT = "response to charges: fit"
"""The last stage of a build but one."""
FEW = GreenSettings(
    near_sources=60, middle_sources=50, far_sources=40, modes=40, middle_modes=24, far_modes=16,
    training=150, wide=150, far_training=400,
)  # fmt: skip


@contextmanager
def few_sources() -> Iterator[None]:
    """Fields have Green's functions of few sources: rough, and built in a tenth of the time."""
    with patch("capsense.field.background.build_green", partial(build_green, settings=FEW)):
        yield


def tiny_data(**changes: Any) -> dict[str, Any]:
    """A square and a disc in a small box, as a design file holds them."""
    return {
        "name": "tiny",
        "domain": {"size": [0.1, 0.1, 0.1], "backplane": 0.01},
        "electrode": [
            {"name": "A", "shape": "rectangle", "size": [0.02, 0.02], "center": [-0.015, 0.0]},
            {"name": "B", "shape": "disc", "radius": 0.01, "center": [0.015, 0.0]},
        ],
        **changes,
    }


def tiny_design(**changes: Any) -> Design:
    """The design of :func:`tiny_data`."""
    return parse_design(tiny_data(**changes))


def arrays(field: BackgroundField) -> dict[str, np.ndarray]:
    """All arrays of a field."""
    green = {f"green {name}": values for name, values in to_arrays(field.green).items()}
    return {"capacitance": field.capacitance, **green}


def digest(field: BackgroundField) -> str:
    """SHA-256 of all arrays, with their types and shapes."""
    total = hashlib.sha256()
    for name, array in arrays(field).items():
        total.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return total.hexdigest()


def main() -> None:
    """Build, and report."""
    cache, log, delay = Path(sys.argv[1]), Path(sys.argv[2]), float(sys.argv[3])

    def progress(stage: str, fraction: float) -> None:
        with log.open("a") as stream:
            stream.write(f"{os.getpid()} {stage}\n")
        time.sleep(delay if stage == FIT else 0.0)

    with few_sources():
        field = load_or_build(tiny_design(), SETTINGS, cache_dir=cache, progress=progress)
    sys.stdout.write(f"{digest(field)}\n")


if __name__ == "__main__":
    # what a shell starts in the background ignores it, and so does all that is started from there
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
