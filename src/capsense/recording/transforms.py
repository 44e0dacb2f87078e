"""Where frames stand, from the transforms of ROS 2, with the rules of its ``tf2``."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from typing import Any, NamedTuple

from capsense.scenario.model import slerp
from capsense.scene import Pose

_SECOND = 10**9
KEPT = 10 * _SECOND
"""Transforms are kept for so long [ns], as tf2 does."""
_NOT_UNIT = 0.1
"""Quaternions whose length differs from 1 by more than this are no rotations. Those that differ by
less are normalised."""
_DEEPEST = 1000
"""Frames that a chain has at most; longer ones are loops."""


class Transform(NamedTuple):
    """Pose of a frame in its parent at one time."""

    stamp: int
    """[ns]"""
    parent: str
    pose: Pose


class Located(NamedTuple):
    """Where one frame stands in another."""

    pose: Pose
    stamp: int | None
    """The time at which it does [ns]; None where nothing between them moves."""


class TransformTree:
    """Frames, each with its parent; fixed ones, and moving ones with their last seconds."""

    def __init__(self) -> None:
        self._fixed: dict[str, Transform] = {}
        self._moving: dict[str, list[Transform]] = {}

    def add(self, message: Any, *, fixed: bool) -> None:
        """Take the transforms of a ``tf2_msgs/TFMessage``.

        Args:
            message: The message, as ``rosbags`` decodes it.
            fixed: Whether they hold at any time, as those of ``/tf_static`` do.

        Raises:
            ValueError: One is none: a number is not finite, the quaternion has no length near 1,
                or a frame is its own parent. Those before it are taken.
        """
        for t in message.transforms:
            child, parent = t.child_frame_id.lstrip("/"), t.header.frame_id.lstrip("/")
            if not child or not parent or child == parent:
                raise ValueError(f"a transform leads from {parent!r} to {child!r}")
            pose = _pose(t.transform, child)
            stamp = t.header.stamp.sec * _SECOND + t.header.stamp.nanosec
            if fixed:
                self._fixed[child] = Transform(stamp, parent, pose)
                self._moving.pop(child, None)
            else:
                self._fixed.pop(child, None)
                self._keep(self._moving.setdefault(child, []), Transform(stamp, parent, pose))

    @staticmethod
    def _keep(known: list[Transform], new: Transform) -> None:
        """Put a transform into its place in time; the first of a time stays."""
        if known and new.stamp <= known[-1].stamp:
            place = bisect_left(known, new.stamp, key=lambda k: k.stamp)
            if known[place].stamp == new.stamp or new.stamp < known[-1].stamp - KEPT:
                return
            insort(known, new, key=lambda k: k.stamp)
            return
        known.append(new)
        del known[: bisect_left(known, new.stamp - KEPT, key=lambda k: k.stamp)]

    def forget(self) -> None:
        """Forget what moves: time has begun anew."""
        self._moving.clear()

    @property
    def frames(self) -> list[str]:
        """Names of all frames that have been heard of, sorted."""
        known = {*self._fixed, *self._moving}
        parents = {t.parent for t in self._fixed.values()}
        return sorted(known | parents | {m[-1].parent for m in self._moving.values()})

    def find(self, target: str, source: str) -> Located:
        """The pose of one frame in another, at the last time for which all between is known.

        Args:
            target: In which frame.
            source: The pose of which frame.

        Raises:
            LookupError: No chain of transforms joins them, or at no common time.
        """
        up, down = self._way(source), self._way(target)
        roots = [way[-1].parent if way else frame for way, frame in ((up, source), (down, target))]
        if roots[0] != roots[1]:
            missing = [f for f in (source, target) if f not in self.frames]
            if missing:
                raise LookupError(f"nobody tells where frame {missing[0]!r} is")
            raise LookupError(
                f"frames {source!r} and {target!r} hang on different roots, "
                f"{roots[0]!r} and {roots[1]!r}"
            )
        while up and down and up[-1] is down[-1]:
            up, down = up[:-1], down[:-1]
        chains = [self._names(source, up), self._names(target, down)]
        moving = [self._moving[f] for chain in chains for f in chain if f in self._moving]
        stamp = min((known[-1].stamp for known in moving), default=None)
        above, below = (self._product(chain, stamp) for chain in chains)
        if below is None:
            return Located(above or Pose(), stamp)
        return Located(below.inverse() @ above if above else below.inverse(), stamp)

    def _way(self, frame: str) -> list[Transform]:
        """The newest transforms from a frame up to its root."""
        out: list[Transform] = []
        while frame in self._fixed or frame in self._moving:
            newest = self._fixed.get(frame) or self._moving[frame][-1]
            out.append(newest)
            frame = newest.parent
            if len(out) > _DEEPEST:
                raise LookupError(f"the parents of frame {frame!r} go round in a loop")
        return out

    @staticmethod
    def _names(frame: str, way: list[Transform]) -> list[str]:
        """The frames that the transforms of a way belong to."""
        return [frame, *(t.parent for t in way[:-1])] if way else []

    def _product(self, chain: list[str], stamp: int | None) -> Pose | None:
        """Pose of the first frame of a chain in the parent of the last; None for no frames."""
        out: Pose | None = None
        for frame in chain:
            pose = self._fixed[frame].pose if frame in self._fixed else self._at(frame, stamp)
            out = pose if out is None else pose @ out
        return out

    def _at(self, frame: str, stamp: int | None) -> Pose:
        """A moving frame's pose in its parent at a time that is not after its newest [ns]."""
        known = self._moving[frame]
        assert stamp is not None
        after = bisect_left(known, stamp, key=lambda k: k.stamp)
        late = known[after]
        if late.stamp == stamp:
            return late.pose
        if after == 0:
            behind = (late.stamp - stamp) / _SECOND
            raise LookupError(
                f"frame {frame!r} is known only from {behind:.3g} s after the last transform of "
                "another frame on the way; see whether their clocks agree"
            )
        early = known[after - 1]
        if early.parent != late.parent:
            return late.pose
        share = (stamp - early.stamp) / (late.stamp - early.stamp)
        (a, b, c), (u, v, w) = early.pose.position, late.pose.position
        place = (a + share * (u - a), b + share * (v - b), c + share * (w - c))
        return Pose(place, slerp(early.pose.quaternion, late.pose.quaternion, share))


def _pose(transform: Any, frame: str) -> Pose:
    """The pose of a ``geometry_msgs/Transform``; a unit quaternion keeps its last bit."""
    v, q = transform.translation, transform.rotation
    place, turn = (v.x, v.y, v.z), (q.x, q.y, q.z, q.w)
    length = math.hypot(*turn)
    if not all(map(math.isfinite, place)) or not abs(length - 1.0) <= _NOT_UNIT:
        raise ValueError(
            f"the transform of frame {frame!r} is none: translation {place}, rotation {turn}"
        )
    return Pose.from_unit(place, turn) if abs(length - 1.0) <= 1e-12 else Pose(place, turn)
