"""Where the shots of a view come from: a scenario, a recording, or a server."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.design import Design
from capsense.errors import RecordingError, ScenarioError
from capsense.recording.session import reading_of
from capsense.scenario import Channel, Scenario
from capsense.scene import Scene
from capsense.simulator import Reading, Simulator, StepStats

if TYPE_CHECKING:
    from capsense.field.lattice import Lattice
    from capsense.recording.reader import Recording
    from capsense.server.client import Client
    from capsense.server.frames import ReadingMessage

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shot:
    """One instant: what stood where, and what the sensor read."""

    index: int
    """Number of the sample, from 0."""
    time: float
    """Its time [s]."""
    scene: Scene
    reading: Reading
    potentials: Array | None
    """Potentials at the lattice's nodes [V], shape (n, terminals), where they were asked for."""


class Source(Protocol):
    """A sensor, and instants of it."""

    title: str
    design: Design
    channels: tuple[Channel, ...]
    """What charts show."""
    empty: Reading
    """The reading with nothing in front of the sensor."""
    lattice: Lattice | None
    """Where potentials are given; None if they are not."""

    def close(self) -> None:
        """Let go of what is held."""


class Seekable(Source, Protocol):
    """A row of instants, any of which can be asked for."""

    times: Array
    """Of the instants [s], increasing, shape (N,)."""

    def shot(self, index: int, *, field: bool) -> Shot:
        """The instant of a number.

        Args:
            index: Its number.
            field: Whether potentials are wanted, where there are any.

        Raises:
            CapSenseError: It could not be had.
        """


class ScenarioSource:
    """Simulates a scenario, sample by sample as they are asked for.

    Args:
        scenario: What happens.
        simulator: Of the scenario's design.
    """

    def __init__(self, scenario: Scenario, simulator: Simulator) -> None:
        self.title, self.design = scenario.name, scenario.design
        self.times, self.channels = scenario.times, scenario.channels
        self._scenario, self._simulator = scenario, simulator
        self.empty = simulator.step(Scene())
        self.lattice = _lattice_of(simulator)

    def shot(self, index: int, *, field: bool) -> Shot:
        """See :class:`Seekable`."""
        time = float(self.times[index])
        scene = self._scenario.scene_at(time)
        reading = self._simulator.step(scene)
        wanted = field and self.lattice is not None
        return Shot(index, time, scene, reading, self._simulator.potentials() if wanted else None)

    def close(self) -> None:
        """Nothing is held."""


class RecordingSource:
    """Shows what a recording holds; the simulator is asked for potentials only.

    Args:
        recording: Is read as a whole.
        progress: As for :class:`capsense.Simulator`.

    Raises:
        RecordingError: The recording is empty, or damaged.
        FieldError: The background field could not be built.
    """

    def __init__(
        self, recording: Recording, progress: Callable[[str, float], None] | None = None
    ) -> None:
        session = recording.session
        self._steps = list(recording.steps())
        if not self._steps:
            raise RecordingError(f"{recording.path} holds no steps; record some")
        self.title, self.design = session.title or session.name, session.design
        self.times = np.array([step.clock for step in self._steps])
        self.channels, self.empty = session.channels, session.empty
        self._simulator = session.simulator(progress=progress)
        self.lattice = _lattice_of(self._simulator)

    def shot(self, index: int, *, field: bool) -> Shot:
        """See :class:`Seekable`."""
        step, potentials = self._steps[index], None
        if field and self.lattice is not None:
            self._simulator.step(step.scene)
            potentials = self._simulator.potentials()
        return Shot(index, float(self.times[index]), step.scene, step.reading, potentials)

    def close(self) -> None:
        """Nothing is held."""


class ServerSource:
    """Plays a scenario to a server's sensor, and shows what it answers; no potentials.

    Args:
        client: A connection, closed by :meth:`close`.
        scenario: What happens.
        bodies: Tables of the scenario file's ``[[body]]``; the server has no meshes.

    Raises:
        ProtocolError: The server refused.
        ScenarioError: The server's design has other electrodes.
    """

    lattice: Lattice | None = None

    def __init__(
        self, client: Client, scenario: Scenario, bodies: Sequence[Mapping[str, Any]]
    ) -> None:
        self.title, self.design = scenario.name, scenario.design
        self.times, self.channels = scenario.times, scenario.channels
        self._client, self._scenario = client, scenario
        self._sensor = client.open(design=self.design.name)
        if self._sensor.electrode_names != self.design.electrode_names:
            raise ScenarioError(
                f"the server's {self.design.name!r} has electrodes "
                f"{', '.join(self._sensor.electrode_names)}, the scenario's has "
                f"{', '.join(self.design.electrode_names)}; give both the same design"
            )
        self._sent = 0
        self.empty = self._reading(self._sensor.step_scene([], self._clock()))
        at_start = self._poses(scenario.scene_at(0.0))
        tables = [
            {k: v for k, v in table.items() if k not in ("pose", "trajectory")}
            | {"pose": at_start[table["name"]]}
            for table in bodies
        ]
        self._sensor.step_scene(tables, self._clock())

    def shot(self, index: int, *, field: bool) -> Shot:
        """See :class:`Seekable`."""
        time = float(self.times[index])
        scene = self._scenario.scene_at(time)
        answer = self._sensor.step_poses(self._poses(scene), self._clock())
        return Shot(index, time, scene, self._reading(answer), None)

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def _clock(self) -> float:
        """Time of the next frame [s]; it goes on where the scenario begins anew."""
        self._sent += 1
        return (self._sent - 1) / self._scenario.sample_rate

    def _reading(self, answer: ReadingMessage) -> Reading:
        coupling = answer.self_capacitance - np.diag(answer.capacitance)
        stats = StepStats(answer.iterations, answer.error_estimate, float("nan"), answer.wall_time)
        return reading_of(self.design, answer.capacitance, answer.delta, coupling, stats)

    @staticmethod
    def _poses(scene: Scene) -> dict[str, dict[str, list[float]]]:
        return {
            str(b.name): {
                "position": list(map(float, b.pose.position)),
                "quaternion": list(map(float, b.pose.quaternion)),
            }
            for b in scene
        }


def _lattice_of(simulator: Simulator) -> Lattice | None:
    return simulator.background.lattice if simulator.method == "perturbation" else None
