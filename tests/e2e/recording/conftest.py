"""A recording made once, for tests that only read it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import recorded_scenes

import capsense as cs

pytest.importorskip("mcap", reason="needs pip install 'capsense[record]'")
pytest.importorskip("rosbags", reason="needs pip install 'capsense[record]'")


@pytest.fixture
def sim(simulators: Callable[..., cs.Simulator]) -> cs.Simulator:
    return simulators("six_patch")


@pytest.fixture(scope="session")
def recorded(
    simulators: Callable[..., cs.Simulator], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[cs.Reading]]:
    """Eight scenes, a reset, and four depth frames; the file, and the readings returned."""
    path = tmp_path_factory.mktemp("recorded") / "all.mcap"
    readings = []
    with cs.record(path, simulators("six_patch"), readout="fdc1004") as run:
        for k in range(8):
            readings.append(run.step(recorded_scenes.scene_at(k), 0.1 * k))
        run.reset()
        for k in range(4):
            readings.append(run.step(recorded_scenes.frame_at(k), 0.05 * k))
    return path, readings
