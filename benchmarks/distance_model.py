"""Six electrodes as robot simulators have them today: each reads eps A / d, and nothing else."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.constants import EPS0

Array = NDArray[np.float64]


class DistanceModel:
    """Capacitances of parallel plates: area over the distance to the nearest body.

    Args:
        design: Its electrodes count by their areas and centres.
        scale: Factor on all capacitances.
    """

    def __init__(self, design: cs.Design, scale: float = 1.0) -> None:
        self.centres = np.array([e.surface.triangles.mean(axis=(0, 1)) for e in design.electrodes])
        self.areas = np.array([e.surface.area for e in design.electrodes])
        self.scale = scale

    def read(self, bodies: Iterable[cs.Body]) -> Array:
        """Capacitances [F], shape (electrodes,)."""
        distances = [b.shape.signed_distance(b.pose.inverse().apply(self.centres)) for b in bodies]
        nearest = np.maximum(np.min(distances, axis=0), 1e-3) if distances else np.inf
        return self.scale * EPS0 * self.areas / nearest
