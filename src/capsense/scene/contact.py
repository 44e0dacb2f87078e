"""Whether electrodes lie inside a body, or touch one, and which."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capsense.errors import listed
from capsense.scene.mesh_shape import SurfaceMesh, TriangleShape
from capsense.scene.scene import Body, Scene
from capsense.scene.shapes import ShapeKind

Array = NDArray[np.float64]

TOUCH = 2e-4
"""What is nearer to an electrode than this [m] touches it."""
_FEW = 10
"""About so many points of each electrode are looked at first."""


class Sheets:
    """The electrodes of a sensor, as points.

    Args:
        sheets: Triangles of each electrode [m], shapes (t, 3, 3).
        touch: What is nearer to an electrode than this [m] touches it.
    """

    def __init__(self, sheets: Sequence[Array], touch: float = TOUCH) -> None:
        self._touch = touch
        few = np.concatenate([points_on(corners, _FEW) for corners in sheets])
        self._few = np.unique(few, axis=0)
        self._many = np.concatenate([points_on(corners) for corners in sheets])
        apart = np.linalg.norm(self._many[:, None] - self._few, axis=2)
        self._nearest = apart.argmin(axis=1)
        self._reach = apart.min(axis=1) + touch
        self._middle = self._few.mean(axis=0, keepdims=True)
        arms = np.concatenate([self._few, self._many]) - self._middle
        self._radius = float(np.linalg.norm(arms, axis=1).max()) + touch
        low, high = self._many.min(axis=0), self._many.max(axis=0)
        self._wide = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1).reshape(-1, 3)
        self._margin = float(self._reach.max())
        self.bounds = np.array([self._few.min(axis=0) - touch, self._few.max(axis=0) + touch])
        """Corners of a box around all of them [m], shape (2, 3)."""

    def meet(self, body: Body, conducting: bool) -> bool:
        """Whether one of them lies inside a body, or touches one that conducts.

        A depth image has no inside.
        """
        if body.shape.kind == ShapeKind.LAYERS:
            return False
        near = None
        if isinstance(body.shape, SurfaceMesh):  # another one at each step
            corners = body.pose.inverse().apply(self._wide)
            low, high = corners.min(axis=0) - self._margin, corners.max(axis=0) + self._margin
            near = body.shape.over(low[:2], high[:2])
            if not len(near.faces):
                return False
        if distances(body, self._middle, each=False, near=near)[0] > self._radius:
            return False
        off = distances(body, self._few, each=False, near=near)
        close = off[self._nearest] <= self._reach  # others are no nearer than the few around them
        if close.any():
            more = distances(body, self._many[close], each=False, near=near)
            off = np.concatenate([off, more])
        return met(off, conducting, self._touch)


def met(off: Array, conducting: bool, touch: float = TOUCH) -> bool:
    """Whether points at such distances from a body [m] mean that it holds an electrode.

    One lies inside it, or is nearer to it than ``touch`` [m] where it conducts.
    """
    return bool(off.min() < -touch or (conducting and np.abs(off).min() < touch))


def distances(
    body: Body, points: Array, *, each: bool = True, near: SurfaceMesh | None = None
) -> Array:
    """Distances of points to a body [m], negative inside; of an open mesh, by its winding.

    Of the points that rays find inside an open mesh, ``each`` is made sure, or the deepest only.
    ``near`` holds the triangles of a changing surface that are looked at, those over and under all
    points (:meth:`SurfaceMesh.over`).
    """
    local, shape = body.pose.inverse().apply(points), near or body.shape
    if not isinstance(shape, TriangleShape) or shape.closed or not len(points):
        return shape.signed_distance(local)
    whole = body.shape
    assert isinstance(whole, TriangleShape)
    off = np.minimum(shape.ray_distance(local), shape.ray_distance(local, down=True))
    inside = off < 0
    if not each:
        deepest = int(off.argmin())
        if off[deepest] < -TOUCH and not _wound(whole, local[[deepest]], -off[[deepest]])[0]:
            inside[:] = False
    else:
        inside[inside] = _wound(whole, local[inside], -off[inside])
    return np.where(inside, off, np.abs(off))


def _wound(shape: TriangleShape, points: Array, off: Array) -> NDArray[np.bool_]:
    """Points that an open surface winds round by more than a half.

    Points nearer to one another than one of them is to the surface, ``off`` [m], are alike.

    A. Jacobson, L. Kavan, O. Sorkine-Hornung, *Robust inside-outside segmentation using
    generalized winding numbers* (2013); solid angles after A. van Oosterom and J. Strackee (1983).
    """
    out = np.zeros(len(points), dtype=bool)
    left = np.ones(len(points), dtype=bool)
    for k in np.argsort(-off).tolist():
        if not left[k]:
            continue
        arms = shape.vertices[shape.faces] - points[k]
        a, b, c = arms[:, 0], arms[:, 1], arms[:, 2]
        u, v, w = (np.linalg.norm(x, axis=1) for x in (a, b, c))
        below = u * v * w + (a * b).sum(1) * w + (b * c).sum(1) * u + (c * a).sum(1) * v
        angle = 2 * np.arctan2((a * np.cross(b, c)).sum(axis=1), below)
        alike = np.linalg.norm(points - points[k], axis=1) <= off[k]
        out[alike & left] = abs(angle.sum()) > 2 * math.pi
        left[alike] = False
    return out


@dataclass
class Contacts:
    """Which electrodes meet which bodies."""

    met: dict[str, list[str]] = field(default_factory=dict)
    """Electrode → names of bodies."""
    depth: float = 0.0
    """How far electrodes lie inside them, at most [m]."""

    @property
    def electrodes(self) -> str:
        """The electrodes, as a sentence begins with them."""
        some = "electrode" if len(self.met) == 1 else "electrodes"
        return f"{some} {listed(list(self.met), 6)}"

    @property
    def bodies(self) -> list[str]:
        """Names of the bodies, each once."""
        return list(dict.fromkeys(body for bodies in self.met.values() for body in bodies))

    def verb(self, one: str, many: str) -> str:
        """The form of a verb that goes with the electrodes."""
        return one if len(self.met) == 1 else many


def find_contacts(
    scene: Scene, electrodes: Mapping[str, Array], touch: float = TOUCH
) -> tuple[Contacts, Contacts]:
    """The electrodes that lie inside bodies, and those that touch some; not in depth images.

    Args:
        scene: The bodies.
        electrodes: Name → points on it [m], shape (n, 3).
        touch: What is nearer to an electrode than this [m] touches it.
    """
    inside, touching = Contacts(), Contacts()
    bodies = {
        body.name or f"bodies[{k}]": body
        for k, body in enumerate(scene)
        if body.shape.kind != ShapeKind.LAYERS
    }
    for name, points in electrodes.items():
        for body_name, body in bodies.items():
            nearest = float(distances(body, points).min())
            if nearest < touch:
                found = inside if nearest < -touch else touching
                found.met.setdefault(name, []).append(body_name)
                found.depth = max(found.depth, -nearest)
    return inside, touching


def warn_of_contact(scene: Scene, electrodes: Mapping[str, Array], touch: float) -> None:
    """Warn that a reading means nothing since bodies go through electrodes or touch them.

    Args:
        scene: The bodies.
        electrodes: Name → its triangles [m], shape (t, 3, 3).
        touch: What is nearer to an electrode than this [m] touches it.
    """
    points = {name: points_on(triangles) for name, triangles in electrodes.items()}
    inside, touching = find_contacts(scene, points, touch)
    found, how = inside, inside.verb("lies inside", "lie inside")
    if not inside.met:
        found, how = touching, touching.verb("touches", "touch")
    if found.met:
        deep = f", up to {1e3 * found.depth:.2g} mm deep," if inside.met else ""
        warnings.warn(
            f"{found.electrodes} {how} {listed(found.bodies, 4)}{deep} and readings mean nothing "
            f"until this ends; keep bodies at least {1e3 * touch:.2g} mm in front of the "
            "electrodes. Such readings are marked as in contact; further warnings are suppressed",
            stacklevel=4,
        )


def doubt_of(scene: Scene, electrode: tuple[str, Array], share: float, reason: str) -> str:
    """What a warning says of a reading of which the estimated error is large.

    Args:
        scene: The bodies.
        electrode: Name of the one that changes most, and its triangles [m], shape (t, 3, 3).
        share: Estimated error over its change.
        reason: What most of the error comes from, or nothing.
    """
    name, triangles = electrode
    points = points_on(triangles, _FEW)
    near = {
        body.name or f"bodies[{k}]": float(distances(body, points, each=False).min())
        for k, body in enumerate(scene)
        if body.shape.kind != ShapeKind.LAYERS
    }
    what = min(near, key=lambda body: near[body]) if near else "the camera sees"
    far = f", {1e3 * max(near[what], 0.0):.2g} mm away," if near else ""
    return (
        f"the estimated error of electrode {name} is {share:.0%} of what {what}{far} changes"
        f'{reason and ": " + reason}; move it away, or take preset "fine"'
    )


def points_on(corners: Array, count: int = 100) -> Array:
    """Corners of triangles (t, 3, 3), and some ``count`` points spread evenly [m], shape (n, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    steps = np.arange(count) + 0.5
    triangle = np.searchsorted(np.cumsum(area) / area.sum(), steps / count)
    u, v = np.sqrt(steps * 0.7548776662 % 1.0), steps * 0.5698402910 % 1.0  # Roberts' R2 sequence
    shares = np.stack([1 - u, u * (1 - v), u * v], axis=1)
    spread = (shares[:, :, None] * corners[np.minimum(triangle, len(area) - 1)]).sum(axis=1)
    few = corners.reshape(-1, 3)[:: max(1, 3 * len(corners) // count)]
    return np.concatenate([few, spread])
