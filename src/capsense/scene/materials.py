"""Materials: relative permittivity and conductivity, by name.

The values are typical ones at room temperature; a sensor cares about the class of a material
(conductor, tissue, plastic) more than about its second digit. Where a number matters, measure
it and pass ``Material(name, eps_r, sigma)``.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from capsense.constants import EPS0
from capsense.errors import SceneError

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

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SceneError(f"material name is {self.name!r}; give a non-empty string")
        for key, low in (("eps_r", 1.0), ("sigma", 0.0)):
            value = getattr(self, key)
            try:
                number = float(value)
            except (TypeError, ValueError):
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

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        if not (math.isfinite(frequency) and frequency > 0):
            raise SceneError(f"frequency is {frequency!r} Hz; give a positive finite number")
        return complex(self.eps_r, -self.sigma / (2 * math.pi * frequency * EPS0))

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
    # Insulators. Their losses are far below what capacitive read-outs resolve: sigma = 0.
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
    # Tissues, at 250 kHz. All count as conductors there; fat no longer does at 1 MHz.
    Material("skin", 1098.0, 1.26e-3, _GABRIEL + "dry skin"),
    Material("wet skin", 7180.0, 0.131, _GABRIEL + "wet skin"),
    Material("muscle", 5763.0, 0.396, _GABRIEL + "muscle"),
    Material("fat", 67.79, 0.0436, _GABRIEL + "infiltrated fat"),
    Material("blood", 4813.0, 0.715, _GABRIEL + "blood"),
    Material("human", 5763.0, 0.396, _GABRIEL + "muscle, standing for a limb as a whole"),
)

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
