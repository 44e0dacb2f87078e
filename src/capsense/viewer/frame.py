"""One instant as the viewer shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.reading import Charges, Reading, Touch
from capsense.scene import Material, Pose, Scene, Shape
from capsense.viewer.plane import Plane

Array = NDArray[np.float64]


class SolidView(NamedTuple):
    """A solid of a robot's simulator."""

    shape: Shape
    pose: Pose
    material: Material


class SkinPart(NamedTuple):
    """A sensor of a skin."""

    pose: Pose
    """Where it stands in the world."""
    changes: Array
    """Changes of its electrodes' own capacitances [F], shape (M,)."""
    touch: Touch | None
    """What is pressed onto its cover, if it has one."""


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
    around: tuple[SolidView, ...] = ()
    """All solids of the robot's simulator in the sensor frame, where there is one; drawn in place
    of the bodies. Of a skin, in the frame of the world."""
    skin: Mapping[str, SkinPart] = field(default_factory=dict)
    """Of a skin, name → sensor."""
