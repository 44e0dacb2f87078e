"""Labels of what stands before a sensor: what is nearest to its electrodes, where a limb is."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from capsense.design import Design
from capsense.errors import SceneError
from capsense.scene import Body, Capsule, Cylinder, Scene
from capsense.scene.contact import distances, points_on

Array = NDArray[np.float64]

_PITCH = 0.01
"""Points on the plates of a design lie no further apart than this [m]."""
_STEP = 1e-5
"""Differences of distances are taken over twice this [m]."""
_ROUNDS = 100
"""Projections between a body and the electrodes, at most."""
_STILL = 1e-9
"""Nearest points that move by less than this [m] are found."""


@dataclass(frozen=True, eq=False)
class Near:
    """The shortest way from the electrodes to a body, in the sensor frame."""

    body: Body
    """The nearest body."""
    distance: float
    """From the nearest electrode to its surface [m], negative inside."""
    point: Array
    """The closest point of its surface [m], shape (3,)."""
    normal: Array
    """Unit normal of its surface there, out of the body, shape (3,)."""

    @property
    def axis(self) -> Array | None:
        """Unit vector along a capsule or cylinder, in the direction of its own z, shape (3,)."""
        if not isinstance(self.body.shape, Capsule | Cylinder):
            return None
        return self.body.pose.rotation[:, 2]


class Outline:
    """The surfaces of a sensor.

    Args:
        design: Its design.
    """

    def __init__(self, design: Design) -> None:
        self._triangles = np.concatenate([e.surface.triangles for e in design.electrodes])
        self._starts = np.concatenate([points_on(e.surface.triangles) for e in design.electrodes])
        self._spread = float(np.sqrt(0.04 * max(e.surface.area for e in design.electrodes)))
        """How far apart they lie, at most about [m]."""
        rest = [points_on(c.surface.triangles) for c in design.conductors]
        rest += [
            points_on(layer.surface.triangles)
            if layer.facets
            else _on_box(layer.lower, layer.upper)
            for layer in design.layers
        ]
        self._all = np.concatenate([self._starts, *rest])

    def gap(self, scene: Iterable[Body]) -> float:
        """Least distance from any body to electrodes, shields and plates, by points on them [m]."""
        return min((float(distances(b, self._all).min()) for b in scene), default=np.inf)

    def nearest(self, scene: Scene) -> Near | None:
        """What is nearest to the electrodes; None where the scene is empty.

        From the nearest of many points on the electrodes it is projected to the body's surface
        and back to the electrodes in turn, until both points rest.
        """
        found = [(float(distances(b, self._starts).min()), k) for k, b in enumerate(scene)]
        if not found:
            return None
        least = min(found)[0]
        # another body may be nearer than its points tell, by what they lie apart at most
        ways = [self._way(scene[k]) for off, k in found if off <= least + self._spread]
        return min(ways, key=lambda way: way.distance)

    def _way(self, body: Body) -> Near:
        start = self._starts[int(np.argmin(distances(body, self._starts)))]
        for _ in range(_ROUNDS):
            distance, normal = _gradient(body, start)
            point = start - distance * normal
            feet = closest_point(self._triangles, np.broadcast_to(point, (len(self._triangles), 3)))
            foot = feet[int(np.argmin(np.linalg.norm(feet - point, axis=1)))]
            moved = float(np.linalg.norm(foot - start))
            if distance <= 0 or moved < _STILL:
                break
            start = foot
        return Near(body, distance, point, normal)


def _gradient(body: Body, point: Array) -> tuple[float, Array]:
    """Distance of a point from a body [m], and the unit vector along which it grows."""
    around = point + _STEP * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    off = distances(body, around)
    slope = off[1:4] - off[4:]
    return float(off[0]), slope / np.linalg.norm(slope)


def _on_box(lower: Array, upper: Array) -> Array:
    """Points on the lower and upper face of a box and between [m], shape (n, 3)."""
    counts = np.ceil((upper - lower) / _PITCH).astype(int) + 1
    axes = [np.linspace(a, b, n) for a, b, n in zip(lower, upper, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


class LimbPose(NamedTuple):
    """Where a limb is before a sensor whose x axis is to lie along it, in the sensor frame."""

    lateral: float = 0.0
    """y of the limb's axis where it crosses the plane x = 0 [m]."""
    vertical: float = 0.05
    """z of the axis there, less the limb's radius: the gap to the skin [m]."""
    pitch: float = 0.0
    """Angle of the axis to the electrode plane, positive where +x is the farther end [rad]."""
    yaw: float = 0.0
    """Angle of the axis to x about the sensor's z, in the electrode plane [rad]."""

    @property
    def direction(self) -> Array:
        """Unit vector along the axis, shape (3,)."""
        p, y = self.pitch, self.yaw
        return np.array([math.cos(p) * math.cos(y), math.cos(p) * math.sin(y), math.sin(p)])


def limb_pose(bodies: Iterable[Body]) -> LimbPose:
    """The pose of a limb made of capsules, by the one that is thickest where x = 0.

    Args:
        bodies: Capsules in the sensor frame.

    Raises:
        SceneError: None of them crosses the plane x = 0, or a body is no capsule.
    """
    thickest, found = 0.0, None
    for body in bodies:
        if not isinstance(body.shape, Capsule):
            raise SceneError(f"{body.name}: a limb is made of capsules, not {body.shape!r}")
        along = body.pose.rotation[:, 2]
        if abs(along[0]) < 1e-3:
            continue
        along = along * math.copysign(1.0, along[0])
        way = -body.pose.position[0] / along[0]
        beyond = max(0.0, abs(way) - 0.5 * body.shape.length)
        radius = math.sqrt(max(0.0, body.shape.radius**2 - beyond**2))
        if radius > thickest:
            _, y, z = np.array(body.pose.position) + way * along
            pitch, yaw = math.asin(along[2]), math.atan2(along[1], along[0])
            thickest, found = radius, LimbPose(float(y), float(z - radius), pitch, yaw)
    if found is None:
        raise SceneError("no capsule crosses the plane x = 0 of the sensor frame; move the limb")
    return found
