"""What a scenario is, once its file has been read."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.design import Design
from capsense.errors import ScenarioError
from capsense.scene import Body, Pose, Scene
from capsense.scene.pose import Vec4

if TYPE_CHECKING:
    from capsense.reading import Reading
    from capsense.simulator import Method, Simulator

Array = NDArray[np.float64]


class Excitation(StrEnum):
    """How the electrodes are driven and read."""

    MATRIX = "matrix"
    """Every entry of the Maxwell matrix, as it is (off-diagonals negative)."""
    SELF = "self"
    """Each electrode against everything else at ground, guards driven with it."""
    MUTUAL = "mutual"
    """Pairs of electrodes: minus the off-diagonal entry, a positive number."""


@dataclass(frozen=True)
class Channel:
    """One number per sample."""

    excitation: Excitation
    row: int
    """Index of the electrode, or of the pair's first one."""
    column: int
    """Index of the pair's second electrode; ``row`` for a single one."""
    electrodes: tuple[str, str]
    """Names of the two electrodes."""

    @property
    def label(self) -> str:
        """Short name, as in plots: ``E1``, ``E1–E2``."""
        one, two = self.electrodes
        return one if self.row == self.column else f"{one}–{two}"

    @property
    def column_name(self) -> str:
        """Name in tables, without its unit: ``C_E1_E2`` (matrix, self), ``Cm_E1_E2`` (mutual)."""
        one, two = self.electrodes
        if self.excitation is Excitation.SELF:
            return f"C_{one}"
        return f"{'Cm' if self.excitation is Excitation.MUTUAL else 'C'}_{one}_{two}"

    @property
    def meaning(self) -> str:
        """What the number is, in words."""
        one, two = self.electrodes
        if self.excitation is Excitation.SELF:
            return f"self capacitance of {one}"
        if self.excitation is Excitation.MUTUAL:
            return f"mutual capacitance between {one} and {two}, positive"
        return f"entry ({one}, {two}) of the Maxwell matrix"

    def read(self, reading: Reading) -> float:
        """The channel's capacitance [F] in a reading."""
        if self.excitation is Excitation.SELF:
            return float(reading.self_capacitance[self.row])
        value = float(reading.capacitance[self.row, self.column])
        return -value if self.excitation is Excitation.MUTUAL else value


def channels_of(
    excitation: Excitation, names: Sequence[str], pairs: Sequence[tuple[str, str]] = ()
) -> tuple[Channel, ...]:
    """The channels of an excitation.

    Args:
        excitation: How the electrodes are driven.
        names: Electrode names in matrix order.
        pairs: For ``MUTUAL``, the pairs to read, by name; all of them if empty.

    Returns:
        For ``MATRIX`` the upper triangle row by row, the diagonal included; for ``SELF`` one per
        electrode; for ``MUTUAL`` one per pair.
    """
    index = {name: k for k, name in enumerate(names)}
    count = len(names)
    if excitation is Excitation.SELF:
        chosen = [(k, k) for k in range(count)]
    elif excitation is Excitation.MATRIX:
        chosen = [(i, j) for i in range(count) for j in range(i, count)]
    elif pairs:
        chosen = [(index[a], index[b]) for a, b in pairs]
    else:
        chosen = [(i, j) for i in range(count) for j in range(i + 1, count)]
    return tuple(Channel(excitation, i, j, (names[i], names[j])) for i, j in chosen)


def read_channels(channels: Sequence[Channel], reading: Reading) -> Array:
    """Capacitance of each channel in a reading [F], shape (K,)."""
    return np.array([c.read(reading) for c in channels])


MAX_SAMPLES = 1_000_000
"""A scenario of more samples is refused."""
METHODS: tuple[Method, ...] = ("surface", "fem_masked")
"""The simulator's methods, the default first."""
FORMER_METHODS: dict[str, Method] = {"masked": "fem_masked"}
"""What earlier versions called methods in their files → the method."""


@dataclass(frozen=True)
class Trajectory:
    """A way through waypoints: position linear in time, orientation by the shortest rotation.

    The body rests ``dwell[k]`` at waypoint k, then moves to the next one at ``speeds[k]``. An
    open trajectory ends with the last rest, and the body stays there. A closed one goes from the
    last waypoint back to the first, and round again for as long as time runs.

    Raises:
        ScenarioError: Wrong counts, a speed that is not positive, a negative dwell, or two
            successive waypoints at the same position.
    """

    waypoints: tuple[Pose, ...]
    """Poses in the sensor frame, at least one."""
    speeds: tuple[float, ...] = ()
    """Speed on each leg [m/s]; one leg less than waypoints, or as many if ``closed``."""
    dwell: tuple[float, ...] = ()
    """Rest at each waypoint [s]; empty for none."""
    closed: bool = False
    """Whether the last waypoint is joined to the first."""

    def __post_init__(self) -> None:
        count = len(self.waypoints)
        least = 2 if self.closed else 1
        if count < least:
            raise ScenarioError(
                f"{count} waypoints make no {'closed ' if self.closed else ''}trajectory; give at "
                f"least {least}"
            )
        legs = count if self.closed else count - 1
        if len(self.speeds) != legs:
            raise ScenarioError(
                f"{len(self.speeds)} speeds for {legs} legs; give one number, or one per leg"
            )
        if len(self.dwell) not in (0, count):
            raise ScenarioError(
                f"{len(self.dwell)} dwell times for {count} waypoints; give one number, or one "
                "per waypoint"
            )
        for speed in self.speeds:
            if not (math.isfinite(speed) and speed > 0):
                raise ScenarioError(f"a speed is {speed} m/s; give a number above zero")
        for rest in self.dwell:
            if not (math.isfinite(rest) and rest >= 0):
                raise ScenarioError(f"a dwell time is {rest} s; give zero or more")
        for k in range(legs):
            if self._length(k) == 0.0:
                raise ScenarioError(
                    f"waypoints {k} and {(k + 1) % count} are the same point, "
                    f"{list(self.waypoints[k].position)}; to rest there, use dwell"
                )

    def _length(self, leg: int) -> float:
        start = self.waypoints[leg].position
        end = self.waypoints[(leg + 1) % len(self.waypoints)].position
        return math.dist(start, end)

    @cached_property
    def _knots(self) -> tuple[list[float], list[int]]:
        """Times [s] at which the body arrives at or leaves a waypoint, and which one."""
        times, stops = [], []
        now = 0.0
        count = len(self.waypoints)
        for k in range(count + self.closed):
            if k > 0:
                now += self._length(k - 1) / self.speeds[k - 1]
            times.append(now)
            stops.append(k % count)
            if self.dwell and k < count:
                now += self.dwell[k]
                times.append(now)
                stops.append(k)
        return times, stops

    @property
    def duration(self) -> float:
        """Time [s] until the trajectory ends; of a closed one, until it first comes round."""
        return self._knots[0][-1]

    def pose_at(self, time: float) -> Pose:
        """The pose at ``time`` [s]; before 0 the first one.

        Raises:
            ScenarioError: The time is not finite.
        """
        if not math.isfinite(time):
            raise ScenarioError(f"time is {time} s; give a finite number")
        times, stops = self._knots
        if self.closed and time > times[-1]:
            time = math.fmod(time, times[-1])
        after = bisect_right(times, time)
        if after == 0:
            return self.waypoints[0]
        if after == len(times):
            return self.waypoints[stops[-1]]
        start, end = self.waypoints[stops[after - 1]], self.waypoints[stops[after]]
        if start is end:
            return start
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        position = [a + share * (b - a) for a, b in zip(start.position, end.position, strict=True)]
        return Pose(position, slerp(start.quaternion, end.quaternion, share))


def slerp(start: Vec4, end: Vec4, share: float) -> Vec4:
    """Spherical linear interpolation between unit quaternions (x, y, z, w), the short way.

    Args:
        start: Orientation at ``share`` 0.
        end: Orientation at ``share`` 1.
        share: From 0 to 1.
    """
    cosine = sum(a * b for a, b in zip(start, end, strict=True))
    sign = -1.0 if cosine < 0 else 1.0
    # From the chord, since acos loses half its digits near 1.
    chord = math.dist(start, [sign * c for c in end])
    angle = 2 * math.asin(min(1.0, 0.5 * chord))
    if angle < 1e-12:
        return start
    p = math.sin((1 - share) * angle) / math.sin(angle)
    q = sign * math.sin(share * angle) / math.sin(angle)
    x, y, z, w = (p * a + q * b for a, b in zip(start, end, strict=True))
    return x, y, z, w


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

    def resampled(self, sample_rate: float) -> Scenario:
        """This scenario at another sample rate [Hz].

        Raises:
            ScenarioError: The rate is not positive, or makes too many samples.
        """
        return replace(self, sample_rate=sample_rate)


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
        reading = simulator.step(scene, time=time)
        values = tuple(c.read(reading) for c in scenario.channels)
        yield Sample(index, time, scene, reading, values)
