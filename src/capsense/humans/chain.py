"""Chains of rigid segments with hinges: what limbs are made of."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from capsense.scene import Capsule, Pose
from capsense.scene.pose import Vec3


@dataclass(frozen=True)
class LimbPart:
    """A capsule of a segment, in the segment's frame."""

    start: Vec3
    """Centre of one cap [m]."""
    end: Vec3
    """Centre of the other cap [m]."""
    radius: float
    """Radius [m]."""

    @cached_property
    def shape(self) -> Capsule:
        """The solid."""
        return Capsule(self.radius, math.dist(self.start, self.end))

    @cached_property
    def pose(self) -> Pose:
        """Where the solid stands in the segment's frame."""
        start, end = np.array(self.start), np.array(self.end)
        x, y, z = (end - start) / np.linalg.norm(end - start)
        turn = (1.0, 0.0, 0.0, 0.0) if z < -1 + 1e-12 else (-y, x, 0.0, 1.0 + z)
        return Pose(0.5 * (start + end), turn)


@dataclass(frozen=True)
class Joint:
    """A hinge at the origin of a segment."""

    name: str
    axis: Vec3
    """Unit axis in the segment's frame, after the joints before it have turned."""
    lower: float
    """Smallest angle [rad]."""
    upper: float
    """Largest angle [rad]."""


@dataclass(frozen=True)
class Segment:
    """A rigid segment; it hangs on the one before it."""

    name: str
    origin: Vec3
    """Its joint centre [m] in the frame of the segment before, or of the limb."""
    joints: tuple[Joint, ...]
    """Its joints; the first turns all the others."""
    parts: tuple[LimbPart, ...]
    mass: float
    """Mass [kg]."""


@dataclass(frozen=True)
class Chain:
    """Segments, each of which hangs on the one before it."""

    name: str
    """Prefix of the names of its bodies, ``"right_arm"`` say."""
    segments: tuple[Segment, ...]

    @property
    def joints(self) -> tuple[Joint, ...]:
        """All joints in order, from the body outwards."""
        return tuple(j for s in self.segments for j in s.joints)

    def named_parts(self, segment: Segment) -> list[tuple[str, LimbPart]]:
        """The parts of a segment with the names of their bodies."""
        return [(f"{self.name}_{segment.name}_{k}", p) for k, p in enumerate(segment.parts, 1)]
