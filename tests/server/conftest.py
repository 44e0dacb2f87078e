"""One server for the tests that do not change it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')

from running_server import RunningServer
from stopped_clock import StoppedClock

from capsense.server import connection


@pytest.fixture(scope="session")
def served() -> Iterator[RunningServer]:
    """A server of two designs."""
    with RunningServer("six_patch", "patch") as server:
        yield server


@pytest.fixture(scope="session")
def dome() -> np.ndarray:
    """A depth image, off the middle: shape (32, 32), float32."""
    u, v = np.meshgrid(np.linspace(-1, 1, 32), np.linspace(-1, 1, 32))
    squared = (u - 0.3) ** 2 + (v + 0.2) ** 2
    return np.where(squared < 0.25, 0.05 + 0.1 * squared, 0).astype(np.float32)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> StoppedClock:
    """What allowances look at."""
    clock = StoppedClock()
    monkeypatch.setattr(connection, "time", clock)
    return clock
