"""A sensor attached to a simulator, whichever it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.adapters.world import Frames, Solid, World
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.scene import Pose, Scene
from capsense.simulator import Reading, Simulator

Array = NDArray[np.float64]


class AttachedSensor(ABC):
    """Reads a sensor that rides on a link of a simulated robot.

    Made by the ``attach`` of an adapter. The world's solids are taken over once; every
    :meth:`read` takes only their poses.
    """

    simulator: Simulator
    """The sensor itself."""
    world: World
    """Everything it may see."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.refresh()

    def read(self) -> Reading:
        """The reading of the simulator's present state.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
            SolveError: The solver did not reach its tolerance.
        """
        return self.simulator.step(self.scene())

    def scene(self) -> Scene:
        """The bodies within the sensor's domain, in the sensor frame, at the present state.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        frames = self._frames()  # may refresh the world
        return self.world.scene(frames)

    @property
    def pose(self) -> Pose:
        """Where the sensor frame stands in the simulator's world.

        Raises:
            SceneError: The simulator has not been stepped yet.
        """
        frames = self._frames()
        return Pose(frames.sensor_position, frames.sensor_quaternion)

    @property
    def baseline(self) -> Array:
        """Maxwell matrix with nothing in the domain [F], shape (M, M)."""
        return self.simulator.baseline

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self.simulator.electrode_names

    def refresh(self) -> None:
        """Take the world's solids over again, after their shapes, sizes or number changed.

        Raises:
            SceneError: A shape is not supported, or a name pattern fits nothing.
        """
        self.world = World(self._solids(), self.simulator.design.domain)

    def reset(self) -> None:
        """Forget the previous step, as after the simulator was set back."""
        self.simulator.reset()

    @abstractmethod
    def _solids(self) -> Sequence[Solid]:
        """The solids that the sensor may see, excluded ones left out."""

    @abstractmethod
    def _frames(self) -> Frames:
        """Where everything is now."""


def make_simulator(design: Design | str | Path | Simulator) -> Simulator:
    """The simulator of a design, or the one given.

    Raises:
        DesignError: The design is wrong.
        FieldError: The background field could not be built.
    """
    return design if isinstance(design, Simulator) else Simulator(design)


def refuse_missing(what: str, name: str, known: Sequence[str]) -> SceneError:
    """The error for a name that a model does not have."""
    if not known:
        return SceneError(f"there is no {what} named {name!r}; the model has none at all")
    return SceneError(f"there is no {what} named {name!r}; {suggest(name, known)}")
