"""Trees of rigid segments with hinges: what people are made of."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from capsense._validate import suggest
from capsense.errors import SceneError
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
    """A rigid segment; it hangs on its parent."""

    name: str
    origin: Vec3
    """Its joint centre [m] in the frame of its parent."""
    joints: tuple[Joint, ...]
    """Its joints; the first turns all the others."""
    parts: tuple[LimbPart, ...]
    mass: float
    """Mass [kg]."""
    parent: str | None = None
    """Name of the segment that it hangs on; None for the limb's frame."""

    @property
    def volume(self) -> float:
        """Sum of the volumes of the parts [m³]; where they overlap, they count twice."""
        return sum(p.shape.volume for p in self.parts)


@dataclass(frozen=True)
class Chain:
    """A tree of segments: each hangs on its parent, which comes before it.

    Raises:
        SceneError: A parent is not there, or comes later.
    """

    name: str
    """Prefix of the names of its bodies, ``"right_arm"`` say."""
    segments: tuple[Segment, ...]
    neutral: Mapping[str, float] = field(default_factory=dict, hash=False)
    """Angles [rad] of joints at ease where they are not zero. Segments that overlap then do not
    collide in MuJoCo."""

    def __post_init__(self) -> None:
        known: set[str | None] = {None}
        for segment in self.segments:
            if segment.parent not in known:
                raise SceneError(
                    f"{self.name}: {segment.name} hangs on {segment.parent!r}, which is no segment "
                    "before it; give parents first"
                )
            known.add(segment.name)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """All joints in order, from the body outwards."""
        return tuple(j for s in self.segments for j in s.joints)

    def forward(
        self, angles: Mapping[str, float] | None = None, *, degrees: bool = False
    ) -> dict[str, Pose]:
        """Poses of the segments in the limb's frame.

        Args:
            angles: Angle of each joint by name [rad]; those not given are zero.
            degrees: Whether the angles are in degrees.

        Raises:
            SceneError: There is no such joint, or it does not bend so far.
        """
        checked = self._checked(angles or {}, degrees)
        poses: dict[str | None, Pose] = {None: Pose()}
        for segment in self.segments:
            here = poses[segment.parent] @ Pose(segment.origin)
            for joint in segment.joints:
                angle = checked.get(joint.name)
                if angle:
                    x, y, z = (math.sin(0.5 * angle) * a for a in joint.axis)
                    here = here @ Pose((0, 0, 0), (x, y, z, math.cos(0.5 * angle)))
            poses[segment.name] = here
        return {name: pose for name, pose in poses.items() if name is not None}

    def named_parts(self, segment: Segment) -> list[tuple[str, LimbPart]]:
        """The parts of a segment with the names of their bodies."""
        return [(f"{self.name}_{segment.name}_{k}", p) for k, p in enumerate(segment.parts, 1)]

    def _checked(self, angles: Mapping[str, float], degrees: bool) -> dict[str, float]:
        """Angles [rad], refused where a joint is missing or does not bend so far."""
        joints = {j.name: j for j in self.joints}
        out = {}
        for name, value in angles.items():
            if name not in joints:
                raise SceneError(f"{self.name} has no joint {name!r}; {suggest(name, joints)}")
            joint = joints[name]
            angle = math.radians(value) if degrees else float(value)
            if not joint.lower - 1e-9 <= angle <= joint.upper + 1e-9:
                raise SceneError(
                    f"{self.name}: {name} is {math.degrees(angle):.4g} degrees; it bends from "
                    f"{math.degrees(joint.lower):.4g} to {math.degrees(joint.upper):.4g}"
                )
            out[name] = angle
        return out


def scaled_masses(segments: Iterable[Segment], mass: float) -> tuple[Segment, ...]:
    """Segments of a mass [kg] together, shared out by their volumes."""
    found = tuple(segments)
    volume = sum(s.volume for s in found)
    return tuple(replace(s, mass=mass * s.volume / volume) for s in found)
