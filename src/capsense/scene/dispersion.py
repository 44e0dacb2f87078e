"""Permittivity against frequency: the four-term Cole–Cole model of biological tissues."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from capsense._validate import as_number
from capsense.constants import EPS0
from capsense.errors import SceneError


@dataclass(frozen=True)
class ColeCole:
    """``ε(ω) = ε_∞ + Σ Δε/(1 + (jωτ)^(1−α)) + σ/(jωε₀)``.

    Raises:
        SceneError: A number is out of range.
    """

    eps_inf: float
    """ε_∞, at least 1."""
    terms: tuple[tuple[float, float, float], ...]
    """(Δε, τ [s], α) of each dispersion, with Δε ≥ 0, τ > 0 and 0 ≤ α < 1."""
    sigma: float = 0.0
    """Ionic conductivity [S/m]."""

    def __post_init__(self) -> None:
        if not 1 <= as_number(self.eps_inf) < math.inf:
            raise SceneError(f"Cole-Cole: eps_inf is {self.eps_inf!r}; give at least 1")
        if not 0 <= as_number(self.sigma) < math.inf:
            raise SceneError(f"Cole-Cole: sigma is {self.sigma!r}; give at least 0 S/m")
        for term in self.terms:
            step, tau, alpha = (as_number(figure) for figure in term)
            if not (0 <= step < math.inf and 0 < tau < math.inf and 0 <= alpha < 1):
                raise SceneError(
                    f"Cole-Cole: the term {term} must be (step >= 0, tau > 0 in "
                    "seconds, 0 <= alpha < 1)"
                )

    def permittivity(self, frequency: float) -> complex:
        """Complex relative permittivity at ``frequency`` [Hz], which must be above zero."""
        omega = 2 * math.pi * frequency
        total = self.eps_inf + self.sigma / (1j * omega * EPS0)
        return total + sum(s / (1 + (1j * omega * tau) ** (1 - a)) for s, tau, a in self.terms)


_PS, _NS, _US, _MS = 1e-12, 1e-9, 1e-6, 1e-3


def _tissue(eps_inf: float, sigma: float, *terms: tuple[float, float, float]) -> ColeCole:
    units = (_PS, _NS, _US, _MS)
    return ColeCole(
        eps_inf,
        tuple((s, tau * unit, a) for (s, tau, a), unit in zip(terms, units, strict=True) if s > 0),
        sigma,
    )


GABRIEL: Mapping[str, ColeCole] = MappingProxyType(
    {
        "skin dry": _tissue(
            4, 0.0002, (32, 7.234, 0), (1100, 32.481, 0.2), (0, 159.155, 0.2), (0, 15.915, 0.2)
        ),
        "skin wet": _tissue(
            4, 0.0004, (39, 7.958, 0.1), (280, 79.577, 0), (3e4, 1.592, 0.16), (3e4, 1.592, 0.2)
        ),
        "muscle": _tissue(
            4, 0.2, (50, 7.234, 0.1), (7000, 353.678, 0.1), (1.2e6, 318.310, 0.1), (2.5e7, 2.274, 0)
        ),
        "fat": _tissue(
            2.5, 0.035, (9, 7.958, 0.2), (35, 15.915, 0.1), (3.3e4, 159.155, 0.05),
            (1e7, 15.915, 0.01),
        ),
        "bone cortical": _tissue(
            2.5, 0.02, (10, 13.263, 0.2), (180, 79.577, 0.2), (5e3, 159.155, 0.2), (1e5, 15.915, 0)
        ),
        "bone cancellous": _tissue(
            2.5, 0.07, (18, 13.263, 0.22), (300, 79.577, 0.25), (2e4, 159.155, 0.2),
            (2e7, 15.915, 0),
        ),
        "blood": _tissue(
            4, 0.7, (56, 8.377, 0.1), (5200, 132.629, 0.1), (0, 159.155, 0.2), (0, 15.915, 0)
        ),
    }
)  # fmt: skip
"""Parameters of S. Gabriel, R. W. Lau and C. Gabriel, "The dielectric properties of biological
tissues: III", Phys. Med. Biol. 41 (1996) 2271; 10 Hz to 100 GHz. Fat is infiltrated fat.

The ionic conductivity of skin, 0.2 and 0.4 mS/m, is printed as 0.000 in tables of three decimals;
it is what the published conductivities of skin need (tests/scene/test_dispersion.py)."""
