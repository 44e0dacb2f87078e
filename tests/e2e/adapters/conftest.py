"""A small sensor, and the adapters that the contract is checked on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from adapter_worlds import WAYS, Way, release
from tiny_field import SETTINGS, tiny_design

import capsense as cs

SensorIn = Callable[..., Any]


@pytest.fixture(scope="session")
def tiny_simulator(field_cache: Path) -> cs.Simulator:
    """A square and a disc in a 0.1 m box."""
    return cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)


@pytest.fixture(params=list(WAYS))
def way(request: pytest.FixtureRequest) -> Way:
    """Every way in which an adapter sees a world, if its simulator is installed."""
    return _installed(WAYS[request.param])


@pytest.fixture(params=[name for name, way in WAYS.items() if way.sees_shapes])
def shape_way(request: pytest.FixtureRequest) -> Way:
    """The ways that see shapes and their names."""
    return _installed(WAYS[request.param])


@pytest.fixture(params=[name for name, way in WAYS.items() if not way.sees_shapes])
def image_way(request: pytest.FixtureRequest) -> Way:
    """The ways that see a depth image."""
    return _installed(WAYS[request.param])


@pytest.fixture
def sensor_in(way: Way, make_sensor: SensorIn) -> SensorIn:
    """``sensor_in(things, pose, **options)``: a sensor in a world of the adapter's simulator."""
    return lambda *args, **options: make_sensor(way, *args, **options)


@pytest.fixture
def shapes_in(shape_way: Way, make_sensor: SensorIn) -> SensorIn:
    """``sensor_in`` for those that see shapes."""
    return lambda *args, **options: make_sensor(shape_way, *args, **options)


@pytest.fixture
def image_in(image_way: Way, make_sensor: SensorIn) -> SensorIn:
    """``sensor_in`` for those that see a depth image."""
    return lambda *args, **options: make_sensor(image_way, *args, **options)


@pytest.fixture
def make_sensor(tiny_simulator: cs.Simulator, tmp_path: Path) -> Iterator[SensorIn]:
    """``make_sensor(way, things, pose, **options)``: released after the test."""
    made: list[Any] = []

    def make(way: Way, things: Any, pose: cs.Pose, **options: Any) -> Any:
        simulator = options.pop("simulator", tiny_simulator)
        made.append(way.build(things, pose, simulator, tmp_path, **way.options | options))
        simulator.reset()
        return made[-1]

    yield make
    for sensor in made:
        release(sensor)


def _installed(way: Way) -> Way:
    pytest.importorskip(way.package, reason=f"{way.package} is not installed")
    return way
