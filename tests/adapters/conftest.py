"""A small sensor, and the adapters that the contract is checked on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from adapter_worlds import SENSORS
from tiny_field import SETTINGS, tiny_design

import capsense as cs


@pytest.fixture(scope="session")
def tiny_simulator(field_cache: Path) -> cs.Simulator:
    """A square and a disc in a 0.1 m box."""
    return cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)


@pytest.fixture(params=sorted(SENSORS))
def adapter(request: pytest.FixtureRequest) -> str:
    """The name of an adapter whose simulator is installed."""
    pytest.importorskip(request.param, reason=f"{request.param} is not installed")
    return str(request.param)


@pytest.fixture
def sensor_in(
    adapter: str, tiny_simulator: cs.Simulator, tmp_path: Path
) -> Iterator[Callable[..., Any]]:
    """``sensor_in(things, pose, **options)``: a sensor in a world of the adapter's simulator."""
    clients: list[int] = []

    def make(things: Any, pose: cs.Pose, **options: Any) -> Any:
        simulator = options.pop("simulator", tiny_simulator)
        sensor = SENSORS[adapter](things, pose, simulator, tmp_path, **options)
        if adapter == "pybullet":
            clients.append(sensor.client)
        simulator.reset()
        return sensor

    yield make
    if clients:
        import pybullet as p

        for client in clients:
            p.disconnect(physicsClientId=client)
