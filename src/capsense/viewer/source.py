"""Where the frames of a view come from: a scenario, or a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.design import Design
from capsense.errors import RecordingError
from capsense.reading import Reading
from capsense.recording.session import GONE
from capsense.scenario import Channel, Scenario
from capsense.scene import Pose, Scene, Shape
from capsense.simulator import Simulator
from capsense.surface.solver import SurfaceSolver

if TYPE_CHECKING:
    from capsense.field.green import GreenFunction
    from capsense.recording.reader import Recording
    from capsense.viewer.charts import Plane

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Charges:
    """Charges that the terminals draw onto the bodies."""

    points: Array
    """Where they sit [m], shape (n, 3)."""
    density: Array
    """Size of the surface density for each terminal at 1 V [C/m²], shape (n, terminals)."""
    pitch: float
    """Usual distance of neighbours [m]."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One instant: what stood where, and what the sensor read."""

    index: int
    """Number of the sample, from 0."""
    time: float
    """Its time [s]."""
    scene: Scene
    reading: Reading
    plane: Plane | None = None
    """Where potentials were asked for."""
    potentials: Array | None = None
    """Potentials at its points [V], shape (n, terminals)."""
    charges: Charges | None = None
    """On the bodies, where potentials were asked for."""
    around: tuple[tuple[Shape, Pose], ...] = ()
    """All solids of the robot's simulator in the sensor frame, where there is one; drawn in place
    of the bodies."""


class Source(Protocol):
    """A sensor, and instants of it."""

    title: str
    design: Design
    channels: tuple[Channel, ...]
    """What charts show."""
    empty: Reading
    """The reading with nothing in front of the sensor."""
    green: GreenFunction | None
    """Of the sensor, where potentials can be had; None where they cannot."""

    def close(self) -> None:
        """Let go of what is held."""


class Stream(Source, Protocol):
    """Instants that come by themselves."""

    def next(self, timeout: float) -> Frame | None:
        """The next one; None if none came within a time [s].

        Raises:
            CapSenseError: There will be none, or not before another call finds a new beginning.
        """

    def potentials(self, frame: Frame, plane: Plane) -> Array:
        """Potentials of an instant at a plane's points [V], shape (n, terminals).

        Raises:
            CapSenseError: They could not be had.
        """


class Seekable(Source, Protocol):
    """A row of instants, any of which can be asked for."""

    times: Array
    """Of the instants [s], increasing, shape (N,)."""

    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        """The instant of a number.

        Args:
            index: Its number.
            plane: Where potentials are wanted, if they are; ``green`` is not None then.

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
        self.empty = simulator.empty
        self.green = green_of(simulator)

    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        """See :class:`Seekable`."""
        time = float(self.times[index])
        scene = self._scenario.scene_at(time)
        reading = self._simulator.step(scene)
        if plane is None:
            return Frame(index, time, scene, reading)
        found = self._simulator.potentials(plane.points)
        return Frame(index, time, scene, reading, plane, found, charges_of(self._simulator))

    def close(self) -> None:
        """Nothing is held."""


class RecordingSource:
    """Shows what a recording holds; the simulator is asked for potentials only.

    Those of a recording of a method that is gone come from ``"surface"``.

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
        gone = session.method in GONE
        self._simulator = session.simulator(method="surface" if gone else None, progress=progress)
        self.green = green_of(self._simulator)

    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        """See :class:`Seekable`."""
        step = self._steps[index]
        frame = Frame(index, float(self.times[index]), step.scene, step.reading)
        if plane is None:
            return frame
        self._simulator.step(step.scene)
        found = self._simulator.potentials(plane.points)
        return replace(frame, plane=plane, potentials=found, charges=charges_of(self._simulator))

    def close(self) -> None:
        """Nothing is held."""


def green_of(simulator: Simulator) -> GreenFunction | None:
    """Green's function of a simulator that gives potentials; None if it does not."""
    return simulator.background.green if simulator.method == "surface" else None


def charges_of(simulator: Simulator) -> Charges | None:
    """Charges of a simulator's last step; None where no body was near or it has none to show."""
    solver = simulator._solver
    if not isinstance(solver, SurfaceSolver) or solver._last is None:
        return None
    _, solution = solver._last
    terminals = solver.green.terminals
    area = np.maximum(solution.extent, 1e-9)[:, None] ** 2
    density = 4 * np.pi * EPS0 * np.abs(solution.charge[:, :terminals]) / area
    return Charges(solution.points.mean(axis=1), density, float(np.median(solution.extent)))
