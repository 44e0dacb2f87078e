"""What every shape offers, in the body's own frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import Frozen
from capsense.errors import SceneError

if TYPE_CHECKING:
    import trimesh

Array = NDArray[np.float64]


class ShapeKind(IntEnum):
    """Kinds of shapes, and what their ``params`` mean."""

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
    SURFACE = 7
    """Half edge lengths of the local bounding box."""


class Shape(Frozen, ABC):
    """A solid or a surface in its own frame."""

    kind: ClassVar[ShapeKind]
    """What sort of shape it is."""

    @cached_property
    def params(self) -> Array:
        """Sizes [m], see :class:`ShapeKind`, shape (3,), read-only."""
        half = 0.5 * np.ptp(self.bounds(), axis=0)
        half.setflags(write=False)
        return half

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
            SceneError: The points do not have shape (n, 3), or the shape has no inside.
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
