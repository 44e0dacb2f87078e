"""What a scenario is, once its file has been read."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.design import Design
from capsense.errors import ScenarioError
from capsense.scenario.channels import Channel, Excitation, channels_of
from capsense.scenario.trajectory import Trajectory
from capsense.scene import Body, Pose, Scene

if TYPE_CHECKING:
    from capsense.simulator import Method

Array = NDArray[np.float64]

MAX_SAMPLES = 1_000_000
"""A scenario of more samples is refused."""
METHODS: tuple[Method, ...] = ("surface", "fem_masked")
"""The simulator's methods, the default first."""
FORMER_METHODS: dict[str, Method] = {"masked": "fem_masked"}
"""What earlier versions called methods in their files → the method."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """A body and its way through time."""

    body: Body
    """The body; its ``pose`` is that at time 0."""
    trajectory: Trajectory | None = None
    """None for a body at rest."""

    def at(self, time: float) -> Body:
        """The body as it stands at ``time`` [s]."""
        if self.trajectory is None:
            return self.body
        return self.body.moved(self.trajectory.pose_at(time))


@dataclass(frozen=True, eq=False)
class Scenario:
    """A sensor, the bodies in front of it, and how they are sampled.

    Raises:
        ScenarioError: The sample rate or duration is out of range, or they make more than a
            million samples.
    """

    name: str
    design: Design
    bodies: tuple[MovingBody, ...]
    sample_rate: float
    """Samples per second [Hz]."""
    duration: float = 0.0
    """Time of the last sample at most [s]."""
    excitation: Excitation = Excitation.MATRIX
    pairs: tuple[tuple[str, str], ...] = ()
    """For mutual excitation: the pairs read, by electrode name; all of them if empty."""
    method: Method = METHODS[0]
    """The simulator's method."""
    description: str = ""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise ScenarioError(f"sample_rate = {self.sample_rate} Hz must be above zero")
        if not (math.isfinite(self.duration) and self.duration >= 0):
            raise ScenarioError(f"duration = {self.duration} s must be zero or more")
        if self.count > MAX_SAMPLES:
            raise ScenarioError(
                f"{self.duration:g} s at {self.sample_rate:g} Hz make {self.count} samples, more "
                f"than {MAX_SAMPLES}; lower sample_rate or duration"
            )

    @property
    def count(self) -> int:
        """Number of samples."""
        return math.floor(self.duration * self.sample_rate * (1 + 1e-12) + 1e-9) + 1

    @cached_property
    def times(self) -> Array:
        """Times of the samples [s], from 0 on, shape (count,)."""
        return np.arange(self.count) / self.sample_rate

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """What is read at every sample."""
        return channels_of(self.excitation, self.design.electrode_names, self.pairs)

    def scene_at(self, time: float) -> Scene:
        """The scene at ``time`` [s], which need not be a sample's.

        Raises:
            ScenarioError: The time is not finite.
        """
        return Scene([b.at(time) for b in self.bodies])

    def path_of(self, index: int) -> list[Pose]:
        """The poses of body ``index`` at the sample times."""
        return [self.bodies[index].at(float(t)).pose for t in self.times]

    def resampled(self, sample_rate: float) -> Scenario:
        """The same scenario at another sample rate [Hz].

        Raises:
            ScenarioError: The rate is not positive, or makes too many samples.
        """
        return replace(self, sample_rate=sample_rate)
