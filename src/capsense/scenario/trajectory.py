"""Trajectories: straight legs between waypoints at given speeds, with rests in between."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property

from capsense.errors import ScenarioError
from capsense.scene import Pose
from capsense.scene.pose import Vec4


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
