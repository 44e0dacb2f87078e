"""What a sensor is: electrodes, dielectric layers and other conductors in a grounded box."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from capsense.design.geometry import Surface

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Domain:
    """The grounded box around a sensor, centred in x and y, its floor at z = −backplane."""

    size: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Full edge lengths of the box [m]."""
    backplane: float = 0.010
    """Distance from the electrode plane z = 0 down to the box's floor [m]."""

    @property
    def lower(self) -> Array:
        """Lower corner of the box [m] in the sensor frame, shape (3,)."""
        return np.array([-self.size[0] / 2, -self.size[1] / 2, -self.backplane])

    @property
    def upper(self) -> Array:
        """Upper corner of the box [m] in the sensor frame, shape (3,)."""
        return self.lower + np.array(self.size)


class Role(StrEnum):
    """What a conductor that is not an electrode is tied to."""

    GROUND = "ground"
    SHIELD = "shield"
    FLOATING = "floating"


@dataclass(frozen=True, eq=False)
class Electrode:
    """One electrode: a conducting sheet that the read-out drives or listens to."""

    name: str
    surface: Surface


@dataclass(frozen=True, eq=False)
class Conductor:
    """A conductor that is not read out: a copper pour, a back plane, a shield or a housing."""

    name: str
    role: Role
    surface: Surface


@dataclass(frozen=True, eq=False)
class Layer:
    """A dielectric slab: an axis-aligned box of homogeneous material."""

    name: str
    material: str
    eps_r: float
    lower: Array
    """Lower corner [m], shape (3,)."""
    upper: Array
    """Upper corner [m], shape (3,)."""


@dataclass(frozen=True, eq=False)
class Design:
    """A sensor as it is built: geometry and materials, no numerical settings."""

    name: str
    domain: Domain
    electrodes: tuple[Electrode, ...]
    layers: tuple[Layer, ...] = ()
    conductors: tuple[Conductor, ...] = ()
    description: str = ""

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return tuple(e.name for e in self.electrodes)
