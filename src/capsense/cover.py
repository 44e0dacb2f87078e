"""Covers: soft layers on electrodes, and their mechanics as an elastic (Winkler) foundation.

Each point of the cover gives way on its own: its pressure depends on its own compression only
(Johnson, *Contact Mechanics*, section 4.3). Relaxation and hysteresis act on the pressure as a
whole, the same everywhere under a body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from capsense.errors import DesignError

Array = NDArray[np.float64]

MAX_STRAIN = 0.95
"""Compression of a cover with a modulus stays below this share of its thickness."""


@dataclass(frozen=True, eq=False)
class StressStrain:
    """Pressure of a cover against its strain, compression over thickness; piecewise linear."""

    strain: Array
    """Ascending from 0, below 1, shape (n,), n >= 2."""
    stress: Array
    """Pressure at each strain [Pa], strictly ascending from 0, shape (n,)."""

    def __post_init__(self) -> None:
        """Check the table.

        Raises:
            DesignError: If it is not a strictly ascending table from (0, 0) with strains below 1.
        """
        strain, stress = (np.array(a, dtype=float) for a in (self.strain, self.stress))
        good = strain.ndim == 1 and strain.shape == stress.shape and len(strain) >= 2
        good = good and bool(np.isfinite(strain).all() and np.isfinite(stress).all())
        good = good and strain[0] == 0.0 and stress[0] == 0.0 and strain[-1] < 1.0
        if not (good and (np.diff(strain) > 0.0).all() and (np.diff(stress) > 0.0).all()):
            raise DesignError(
                f"cover: stress_strain has strains {strain.tolist()} and pressures "
                f"{stress.tolist()}; give pairs [strain, pressure in Pa] that ascend strictly from "
                "[0, 0], strains below 1"
            )
        object.__setattr__(self, "strain", strain)
        object.__setattr__(self, "stress", stress)

    @classmethod
    def linear(cls, modulus: float) -> StressStrain:
        """Pressure ``modulus * strain``; ``modulus`` in Pa.

        Raises:
            DesignError: If the modulus is not a positive number.
        """
        if not (np.isfinite(modulus) and modulus > 0.0):
            raise DesignError(f"cover: modulus is {modulus} Pa; give a positive number")
        return cls(np.array([0.0, MAX_STRAIN]), np.array([0.0, MAX_STRAIN * modulus]))

    def pressure(self, strain: Array) -> Array:
        """Pressure at strains [Pa], any shape; past the table its last slope continues."""
        slope = (self.stress[-1] - self.stress[-2]) / (self.strain[-1] - self.strain[-2])
        beyond = np.maximum(np.asarray(strain) - self.strain[-1], 0.0)
        return np.asarray(np.interp(strain, self.strain, self.stress) + slope * beyond)


NONE, GROUND, FLOATING = TOPS = ("none", "ground", "floating")
"""What can be on top of a cover: nothing, a grounded or a floating conducting fabric."""


@dataclass(frozen=True, eq=False)
class Cover:
    """A soft dielectric layer on the face of a flat design."""

    name: str
    eps_r: float
    """Relative permittivity; compression does not change it."""
    lower: Array
    """Lower corner [m], shape (3,)."""
    upper: Array
    """Upper corner, undeformed [m], shape (3,)."""
    law: StressStrain
    """Pressure against strain, loaded fast."""
    relaxation: tuple[tuple[float, float], ...] = ()
    """Shares of the pressure that relax, and their time constants [s] (a Prony series)."""
    hysteresis: float = 0.0
    """Share of the stiffness that is missing at the end of unloading, 0 to below 1."""
    top: str = NONE
    """What lies on it, one of :data:`TOPS`."""
    bending_length: float = 0.0
    """Distance over which a fabric on top carries compression beyond the contact [m]."""

    @property
    def thickness(self) -> float:
        """Undeformed thickness [m]."""
        return float(self.upper[2] - self.lower[2])

    @property
    def limit(self) -> float:
        """Largest compression [m]: what is pressed in further counts as that far."""
        return float(self.law.strain[-1]) * self.thickness

    def measured_in(self, unit: float) -> Cover:
        """The same cover with lengths in a unit [m]; pressures stay in Pa."""
        return replace(
            self, lower=self.lower / unit, upper=self.upper / unit,
            bending_length=self.bending_length / unit,
        )  # fmt: skip


class Viscosity:
    """Force of one contact over time: hysteresis, then relaxation, of the elastic force.

    Quasi-linear viscoelasticity (Fung, *Biomechanics*, section 7.6): the force is the convolution
    of the reduced relaxation function 1 - sum g_k (1 - exp(-t / tau_k)) with the changes of the
    elastic force. Unloading from the largest elastic force m since the last rest follows
    F (1 - h (1 - F / m)).
    """

    def __init__(self, cover: Cover) -> None:
        self._share, self._tau = np.array(cover.relaxation, float).reshape(-1, 2).T
        self._hysteresis = cover.hysteresis
        self.time = -math.inf
        self._most = self._last = 0.0
        self._memory = np.zeros(len(self._share))

    def _rates(self, time: float) -> tuple[Array, Array]:
        """Decay of the memory up to a time, and the part of a change that it takes up."""
        step = (time - self.time) / self._tau if len(self._tau) else np.zeros(0)
        decay = np.exp(-step)
        # a change is spread evenly over the step; the first one comes at once
        mean = np.where(step > 1e-9, -np.expm1(-step) / np.maximum(step, 1e-9), 1.0)
        return decay, np.where(np.isfinite(step), mean, 1.0) * self._share

    def force(self, elastic: float, time: float) -> float:
        """Force at a time [N] of what would be an elastic force [N], which is remembered."""
        held = self._unloaded(elastic)
        decay, taken = self._rates(time)
        self._memory = decay * self._memory + taken * (held - self._last)
        self._most = max(self._most, elastic) if elastic > 0.0 else 0.0
        self._last, self.time = held, time
        return max(0.0, held * (1.0 - float(self._share.sum())) + float(self._memory.sum()))

    def elastic(self, force: float, time: float) -> float:
        """Elastic force at which :meth:`force` would give a force at a time [N]."""
        decay, taken = self._rates(time)
        own = 1.0 - float(self._share.sum()) + float(taken.sum())
        rest = float((decay * self._memory - taken * self._last).sum())
        held, h, most = max(0.0, (force - rest) / own), self._hysteresis, self._most
        if h == 0.0 or held >= most:
            return held
        # F (1 - h (1 - F / m)) = held
        low = 1.0 - h
        return 2.0 * held / (low + math.sqrt(low * low + 4.0 * h * held / most))

    def _unloaded(self, elastic: float) -> float:
        if elastic >= self._most:
            return elastic
        return elastic * (1.0 - self._hysteresis * (1.0 - elastic / self._most))
