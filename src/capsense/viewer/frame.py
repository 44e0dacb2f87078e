"""One instant as the viewer shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capsense.reading import Charges, Reading
from capsense.scene import Pose, Scene, Shape
from capsense.viewer.plane import Plane

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Frame:
    """One instant: what stood where, and what the sensor read."""

    index: int
    """Number of the sample, from 0."""
    time: float
    """Its time [s]."""
    scene: Scene
    reading: Reading
    plane: Plane | None = None
    """Where potentials were asked for."""
    potentials: Array | None = None
    """Potentials at its points [V], shape (n, terminals)."""
    charges: Charges | None = None
    """On the bodies, where potentials were asked for."""
    around: tuple[tuple[Shape, Pose], ...] = ()
    """All solids of the robot's simulator in the sensor frame, where there is one; drawn in place
    of the bodies. Of a skin, in the frame of the world."""
    skin: Mapping[str, tuple[Pose, Array]] = field(default_factory=dict)
    """Of a skin, name → where the sensor stands in the world, and changes of its electrodes' own
    capacitances [F]."""
