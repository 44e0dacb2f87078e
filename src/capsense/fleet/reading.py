"""What a fleet's step takes and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.readout.conversions import Held

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FleetReading:
    """What the sensors of all environments see; e environments, s sensors, n electrodes.

    Arrays of NumPy on the CPU, else of Warp, in single precision, which PyTorch and JAX take by
    DLPack; those are written anew by the next step.
    """

    capacitance: Any
    """Maxwell capacitance matrices [F], shape (e, s, n, n)."""
    delta: Any
    """Their change by the bodies [F], shape (e, s, n, n)."""
    error: Any = None
    """Estimated error of the largest entry [F], shape (e, s)."""
    shield_coupling: Any = None
    """Charge on each electrode per volt on all shields together [F], shape (e, s, n), in double
    precision."""
    conductance: Any = None
    """Conductance that matter with losses adds [S], shape (e, s, n, n); None on the CPU where
    there is none."""
    held: Held | None = None
    """What the chips' registers hold, where there is a readout, each of shape (e, s, channels)."""
    jacobian: Any = None
    """Change of the matrices as each body moves along the sensor frame's x, y, z [F/m] and turns
    about axes parallel to these through its origin [F/rad], shape (e, s, b, n, n, 6)."""


@dataclass(frozen=True)
class FleetCheck:
    """Errors of some environments against :class:`Simulator`, over each one's largest entry."""

    environments: tuple[int, ...]
    """Which environments."""
    rms: float
    """Root of the mean square over all entries."""
    worst: float
    """The largest."""
    where: tuple[int, int]
    """Environment and sensor that have it."""
    contact: tuple[tuple[int, int], ...] = ()
    """Environments and sensors whose readings mean nothing: an electrode lies inside a body, or
    within 0.2 mm of a conductor."""


def on_device(values: Any) -> bool:
    """Whether values are an array of Warp, PyTorch or JAX, which is taken by DLPack."""
    return hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)
