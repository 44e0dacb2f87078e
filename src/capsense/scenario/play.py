"""From a scenario to readings, sample by sample."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from capsense.scenario.model import Scenario
from capsense.scene import Scene

if TYPE_CHECKING:
    from capsense.reading import Reading
    from capsense.simulator import Simulator


@dataclass(frozen=True, eq=False)
class Sample:
    """One instant of a scenario."""

    index: int
    """Number of the sample, from 0."""
    time: float
    """Its time [s]."""
    scene: Scene
    """The bodies as they stood."""
    reading: Reading
    """What the sensor read."""
    values: tuple[float, ...]
    """Capacitance [F] of each of the scenario's channels."""


def play(scenario: Scenario, simulator: Simulator) -> Iterator[Sample]:
    """Step a simulator through a scenario.

    Args:
        scenario: What happens.
        simulator: A simulator of the scenario's design; it is reset first.

    Yields:
        The samples in time order.

    Raises:
        SolveError: A step did not reach its tolerance.
    """
    simulator.reset()
    for index, time in enumerate(scenario.times.tolist()):
        scene = scenario.scene_at(time)
        reading = simulator.step(scene)
        values = tuple(c.read(reading) for c in scenario.channels)
        yield Sample(index, time, scene, reading, values)
