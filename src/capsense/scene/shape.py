"""What every shape offers: signed distance and line intersection, in the body's own frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]


class ShapeKind(IntEnum):
    """Which formula a compiled kernel uses for a shape, and what its ``params`` mean."""

    BOX = 0
    """Half edge lengths."""
    SPHERE = 1
    """Radius, 0, 0."""
    CAPSULE = 2
    """Radius, half length without caps, 0."""
    CYLINDER = 3
    """Radius, half length, 0."""
    ELLIPSOID = 4
    """Three radii."""
    MESH = 5
    """Half edge lengths of the local bounding box."""
    LAYERS = 6
    """Half edge lengths of the local bounding box."""


class Shape(ABC):
    """A solid in its own frame."""

    kind: ClassVar[ShapeKind]
    """Selects the compiled formula."""
    max_intervals: ClassVar[int] = 1
    """How many disjoint stretches of a line inside the solid are told apart."""

    @cached_property
    @abstractmethod
    def params(self) -> Array:
        """Sizes [m] as the kernels take them, see :class:`ShapeKind`, shape (3,), read-only."""

    @property
    def breadth(self) -> float:
        """Diameter of the largest ball inside [m], or less where it is not known."""
        return 0.0

    @cached_property
    def packed(self) -> tuple[float, ...]:
        """``params`` and the centre of the local bounding box [m], six numbers."""
        return (*self.params.tolist(), *self.bounds().mean(axis=0).tolist())

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume [m³]."""

    @abstractmethod
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m] in the local frame, shape (2, 3)."""

    @abstractmethod
    def signed_distance(self, points: ArrayLike) -> Array:
        """Distance to the surface [m], negative inside.

        Args:
            points: Points [m] in the local frame, shape (n, 3).

        Returns:
            Shape (n,).

        Raises:
            SceneError: The points do not have shape (n, 3).
        """

    @abstractmethod
    def line_intervals(self, origins: ArrayLike, direction: ArrayLike) -> Array:
        """Where infinite lines ``origin + t * direction`` run inside the solid.

        Args:
            origins: A point [m] on each line in the local frame, shape (n, 3).
            direction: Direction of the lines, shape (3,) or (n, 3), of any non-zero length.

        Returns:
            Entry and exit parameter t of each line, shape (n, 2); ``[inf, -inf]`` for a line
            that misses, so that ``t_in <= t_out`` tells a hit. Never NaN. Meshes return
            shape (n, max_intervals, 2).

        Raises:
            SceneError: Wrong shapes, a number that is not finite, or a zero direction.
        """

    @abstractmethod
    def to_trimesh(self) -> trimesh.Trimesh:
        """A surface mesh of the shape in its local frame, for drawing and for checks."""


def as_points(points: ArrayLike) -> Array:
    """Check points of shape (n, 3) and return them as floats.

    Raises:
        SceneError: Another shape.
    """
    out = np.asarray(points, dtype=float)
    if out.ndim != 2 or out.shape[1] != 3:
        raise SceneError(f"points have shape {out.shape}; give (n, 3)")
    return out


def as_lines(origins: ArrayLike, direction: ArrayLike) -> tuple[Array, Array]:
    """Check lines and return origins and directions, both of shape (n, 3).

    Raises:
        SceneError: Wrong shapes, a number that is not finite, or a zero direction.
    """
    o = as_points(origins)
    d = np.asarray(direction, dtype=float)
    if d.shape not in ((3,), o.shape):
        raise SceneError(f"direction has shape {d.shape}; give (3,) or {o.shape}")
    if not (np.isfinite(o).all() and np.isfinite(d).all()):
        raise SceneError("lines hold a number that is not finite")
    if not np.all(np.abs(d).max(axis=-1) > 1e-100):
        raise SceneError("a line has a direction of length zero; give a non-zero direction")
    return o, np.broadcast_to(d, o.shape)
