"""Materials: relative permittivity and conductivity, by name.

The values are typical ones at room temperature; a sensor cares about the class of a material
(conductor, tissue, plastic) more than about its second digit. Where a number matters, measure
it and pass ``Material(name, eps_r, sigma)``. Tissues depend on frequency: their numbers are those
at 250 kHz, and :meth:`Material.at` gives those at another frequency.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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


CONDUCTOR_PERMITTIVITY = 1000.0
"""Magnitude of the complex relative permittivity from which matter counts as a conductor."""

_DEFAULT_FREQUENCY = 250e3


@dataclass(frozen=True)
class Material:
    """A homogeneous isotropic material.

    Raises:
        SceneError: The permittivity is below 1, the conductivity negative, or either is not
            a finite number.
    """

    name: str
    eps_r: float
    """Relative permittivity, real part."""
    sigma: float = 0.0
    """Conductivity [S/m] at the excitation frequency."""
    source: str = field(default="", compare=False)
    """Where the numbers come from."""
    dispersion: ColeCole | None = None
    """How they depend on frequency; None for matter whose numbers hold at any."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SceneError(f"material name is {self.name!r}; give a non-empty string")
        for key, low in (("eps_r", 1.0), ("sigma", 0.0)):
            value = getattr(self, key)
            try:
                number = float(value)
            except (TypeError, ValueError, OverflowError):
                number = math.nan
            if not math.isfinite(number) or number < low:
                raise SceneError(
                    f"material {self.name!r}: {key} is {value!r}; give a finite number, at "
                    f"least {low:g}"
                    + ("; metals have eps_r 1 and a large sigma" if key == "eps_r" else "")
                )
            object.__setattr__(self, key, number)

    def complex_permittivity(self, frequency: float = _DEFAULT_FREQUENCY) -> complex:
        """Complex relative permittivity eps_r − j sigma / (2π f ε₀) at ``frequency`` [Hz].

        Matter with a ``dispersion`` follows that instead of ``eps_r`` and ``sigma``.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        _require_frequency(frequency)
        if self.dispersion is not None:
            return self.dispersion.permittivity(frequency)
        return complex(self.eps_r, -self.sigma / (2 * math.pi * frequency * EPS0))

    def at(self, frequency: float) -> Material:
        """The material with the numbers it has at ``frequency`` [Hz].

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        if self.dispersion is None:
            _require_frequency(frequency)
            return self
        eps = self.complex_permittivity(frequency)
        sigma = max(0.0, -eps.imag * 2 * math.pi * frequency * EPS0)
        return replace(self, eps_r=eps.real, sigma=sigma)

    def is_conductor(self, frequency: float = _DEFAULT_FREQUENCY) -> bool:
        """Whether the material may be treated as an equipotential at ``frequency`` [Hz].

        The rule: the complex relative permittivity has a magnitude of 1000 or more. The error
        of treating such matter as a perfect conductor is of the order 1/(N·1000), N being the
        depolarisation factor along the field: for a sphere the polarisability falls short by
        3/(ε + 2) = 0.3 %, for a plate facing the sensor (N near 1) by 0.1 %. For a grounded
        body of depth d the field sees the surface d/1000 further away, 0.1 mm for a limb.
        Only along the axis of a slender isolated body (N = 0.02 at an aspect of ten) does the
        error reach some per cent.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        return abs(self.complex_permittivity(frequency)) >= CONDUCTOR_PERMITTIVITY


def _require_frequency(frequency: float) -> None:
    if not (math.isfinite(frequency) and frequency > 0):
        raise SceneError(f"frequency is {frequency!r} Hz; give a positive finite number")


_METAL = "resistivity at 20 °C, common handbook value; any metal is an ideal conductor here"
_PERMITTIVITY = "common range of datasheets and tables: "
_GABRIEL = "Gabriel et al. 1996, four-term Cole-Cole model, evaluated at 250 kHz: "

_TABLE = (
    Material("air", 1.0, 0.0, "1.0006 at 1 bar, rounded to the vacuum the domain is made of"),
    # Metals.
    Material("steel", 1.0, 6.99e6, "carbon steel 1010, 1.43e-7 ohm m; " + _METAL),
    Material("stainless steel", 1.0, 1.45e6, "grade 304, 6.9e-7 ohm m; " + _METAL),
    Material("copper", 1.0, 5.96e7, "1.68e-8 ohm m; " + _METAL),
    Material("aluminium", 1.0, 3.77e7, "2.65e-8 ohm m; " + _METAL),
    # Insulators. Their losses are far below what capacitive readouts resolve: sigma = 0.
    Material("polycarbonate", 2.9, 0.0, _PERMITTIVITY + "2.8-3.0"),
    Material("FR4", 4.5, 0.0, _PERMITTIVITY + "4.3-5.0"),
    Material("glass", 5.0, 0.0, _PERMITTIVITY + "4-10, borosilicate 4.3-5.0"),
    Material("wood", 3.0, 0.0, _PERMITTIVITY + "dry 2-6, lower half; wet wood has 10-30"),
    Material("silicone rubber", 3.5, 0.0, _PERMITTIVITY + "3.2-9.8, unfilled grades low"),
    Material("PLA", 3.0, 0.0, _PERMITTIVITY + "PLA, PET-G and ABS 2.88-3.48 at 1-100 MHz"),
    Material("cotton", 3.2, 0.0, _PERMITTIVITY + "dry fibre 3.2; fabric with air lower"),
    # Water: 78.54 (1 - 4.579e-3 (T - 25) + 1.19e-5 (T - 25)^2 - 2.8e-8 (T - 25)^3), T in °C.
    Material("water", 78.5, 0.05, "eps_r at 25 °C; sigma of tap water, common 0.005-0.08 S/m"),
    Material("deionised water", 78.5, 5.5e-6, "eps_r and sigma of pure water at 25 °C"),
    # Tissues, at 250 kHz. All count as conductors there; fat and cortical bone not at 1 MHz.
    Material("skin", 1098.0, 1.46e-3, _GABRIEL + "dry skin", GABRIEL["skin dry"]),
    Material("wet skin", 7180.0, 0.131, _GABRIEL + "wet skin", GABRIEL["skin wet"]),
    Material("muscle", 5763.0, 0.396, _GABRIEL + "muscle", GABRIEL["muscle"]),
    Material("fat", 67.79, 0.0436, _GABRIEL + "infiltrated fat", GABRIEL["fat"]),
    Material("blood", 4813.0, 0.715, _GABRIEL + "blood", GABRIEL["blood"]),
    Material("cortical bone", 197.0, 0.0212, _GABRIEL + "cortical bone", GABRIEL["bone cortical"]),
    Material(
        "cancellous bone", 366.4, 0.0850, _GABRIEL + "cancellous bone", GABRIEL["bone cancellous"]
    ),
    Material(
        "human",
        5763.0,
        0.396,
        _GABRIEL + "muscle, standing for a limb as a whole",
        GABRIEL["muscle"],
    ),
)


def water(temperature: float, sigma: float = 0.05) -> Material:
    """Water at a temperature; from below 1 GHz down its permittivity does not depend on frequency.

    ``78.54 (1 − 4.579e-3 θ + 1.19e-5 θ² − 2.8e-8 θ³)``, θ = T − 25 °C (Handbook of Chemistry and
    Physics).

    Args:
        temperature: T [°C], from 0 to 100.
        sigma: Conductivity [S/m]; tap water by default.

    Raises:
        SceneError: The temperature is out of range, or the conductivity negative.
    """
    if not 0 <= temperature <= 100:
        raise SceneError(f"temperature is {temperature!r} °C; give a number from 0 to 100")
    t = temperature - 25.0
    eps_r = 78.54 * (1 + t * (-4.579e-3 + t * (1.19e-5 - t * 2.8e-8)))
    return Material(f"water at {temperature:g} °C", eps_r, sigma, "permittivity: handbook series")


MATERIALS: Mapping[str, Material] = MappingProxyType({m.name: m for m in _TABLE})
"""The known materials by name."""

_ALIASES = {
    **{name.lower(): name for name in MATERIALS},
    "aluminum": "aluminium",
    "dry wood": "wood",
    "dry skin": "skin",
    "tap water": "water",
    "deionized water": "deionised water",
}


def material(name: str) -> Material:
    """Look a material up by name; upper and lower case, ``_`` and spaces are the same.

    Raises:
        SceneError: No such material; the message lists the known ones, the nearest first.
    """
    if not isinstance(name, str):
        raise SceneError(f"material is {name!r}; give a name or a Material(name, eps_r, sigma)")
    key = name.strip().lower().replace("_", " ")
    if key in _ALIASES:
        return MATERIALS[_ALIASES[key]]
    matcher = difflib.SequenceMatcher(b=key)

    def likeness(known: str) -> float:
        matcher.set_seq1(known.lower())
        return -matcher.ratio()

    names = ", ".join(sorted(MATERIALS, key=likeness))
    raise SceneError(
        f"unknown material {name!r}; known, nearest first: {names}; or pass "
        f"Material(name, eps_r, sigma)"
    )
