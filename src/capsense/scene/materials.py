"""Materials: relative permittivity and conductivity, by name; and paths to ground.

The values are typical ones at room temperature; a sensor cares about the class of a material
(conductor, tissue, plastic) more than about its second digit. Where a number matters, measure
it and pass ``Material(name, eps_r, sigma)``. Tissues depend on frequency: their numbers are those
at 250 kHz, and :meth:`Material.at` gives those at another frequency.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from types import MappingProxyType
from typing import Any, Literal, cast, get_args

from capsense._validate import as_number, nearest, shorten, suggest
from capsense.constants import EPS0, LARGEST_TIE
from capsense.errors import SceneError
from capsense.scene.pose import as_float


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


DATA: Mapping[str, Any] = tomllib.loads(
    resources.files("capsense").joinpath("materials.toml").read_text(encoding="utf-8")
)
"""The tables of ``materials.toml``: materials, aliases, tissues, paths to ground."""


def _tissue(eps_inf: float, sigma: float, terms: Sequence[Sequence[float]]) -> ColeCole:
    units = (1e-12, 1e-9, 1e-6, 1e-3)
    return ColeCole(
        eps_inf,
        tuple((s, tau * unit, a) for (s, tau, a), unit in zip(terms, units, strict=True) if s > 0),
        sigma,
    )


GABRIEL: Mapping[str, ColeCole] = MappingProxyType(
    {name: _tissue(**figures) for name, figures in DATA["tissues"].items()}
)
"""Cole-Cole models of tissues, after Gabriel et al. 1996."""


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
            number = as_float(value)
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


MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        name: Material(
            name, m["eps_r"], m.get("sigma", 0.0), m["source"], GABRIEL.get(m.get("tissue"))
        )
        for name, m in DATA["materials"].items()
    }
)
"""The known materials by name."""

_ALIASES = {**{name.lower(): name for name in MATERIALS}, **DATA["aliases"]}


def material(name: str) -> Material:
    """Look a material up by name; upper and lower case, ``_`` and spaces are the same.

    Raises:
        SceneError: No such material; the message names the nearest one and lists all.
    """
    if not isinstance(name, str):
        raise SceneError(f"material is {name!r}; give a name or a Material(name, eps_r, sigma)")
    key = name.strip().lower().replace("_", " ")
    if key in _ALIASES:
        return MATERIALS[_ALIASES[key]]
    raise SceneError(
        f"unknown material {name!r}; {suggest(name, MATERIALS)}; or pass "
        f"Material(name, eps_r, sigma)"
    )


def checked_material(value: Material | str) -> Material:
    """A material, from itself or its name.

    Raises:
        SceneError: There is no such material.
    """
    return value if isinstance(value, Material) else material(value)


@dataclass(frozen=True)
class GroundPath:
    """A capacitance to ground, with a resistance in series and one in parallel to both.

    Raises:
        SceneError: A number is out of range.
    """

    capacitance: float
    """[F]"""
    series: float = 0.0
    """Resistance of the body itself, in series [Ω]."""
    leakage: float = math.inf
    """Resistance of shoes and floor, in parallel [Ω]."""
    source: str = ""
    """Where the numbers come from."""

    def __post_init__(self) -> None:
        if not 0 < as_number(self.capacitance) < math.inf:
            raise SceneError(
                f"ground path: capacitance is {self.capacitance!r} F; give a positive number, "
                "like 100e-12"
            )
        if not 0 <= as_number(self.series) < math.inf:
            raise SceneError(f"ground path: series is {self.series!r} Ω; give zero or more")
        if not as_number(self.leakage) > 0:
            raise SceneError(f"ground path: leakage is {self.leakage!r} Ω; give a positive number")

    def impedance(self, frequency: float) -> complex:
        """Impedance from the body to ground at ``frequency`` [Hz], in ohms.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        if not 0 < as_number(frequency) < math.inf:
            raise SceneError(f"frequency is {frequency!r} Hz; give a positive finite number")
        branch = self.series + 1 / (2j * math.pi * frequency * self.capacitance)
        return 1 / (1 / branch + 1 / self.leakage)

    def equivalent_capacitance(self, frequency: float) -> float:
        """Capacitance with the same magnitude of impedance at ``frequency`` [Hz], in farads.

        What ``Body(grounding=...)`` takes. The phase is left out: 13 degrees off a pure
        capacitance for the human-body model at 250 kHz.

        Raises:
            SceneError: The frequency is not a positive finite number.
        """
        return 1 / (2 * math.pi * frequency * abs(self.impedance(frequency)))


GROUND_PATHS: Mapping[str, GroundPath] = MappingProxyType(
    {name: GroundPath(**figures) for name, figures in DATA["ground_paths"].items()}
)
"""Models of a person's path to ground, by name."""


@dataclass(frozen=True)
class Ties:
    """What ties a conductor to earth and to the local ground of the sensor.

    The local ground is that of the sensor's design, see ``Design.with_grounding``; where it is
    earthed, the two ties are one.

    Raises:
        SceneError: A number is out of range, or both are 0.
    """

    earth: float = 0.0
    """Capacitance to earth [F]."""
    local: float = 0.0
    """Capacitance to the local ground [F]; infinite for a link of the same robot, or a person who
    holds it."""

    def __post_init__(self) -> None:
        for name, most in (("earth", LARGEST_TIE), ("local", math.inf)):
            value = as_number(getattr(self, name))
            if not (0.0 <= value <= LARGEST_TIE or value == most):
                raise SceneError(
                    f"ties: {name} is {getattr(self, name)!r} F; give 0 to {LARGEST_TIE:g} F"
                    + (", or math.inf" if most == math.inf else "")
                )
        if self.earth == self.local == 0.0:
            raise SceneError('ties: both are 0 F; give one, or grounding = "floating"')

    def __truediv__(self, count: float) -> Ties:
        """The share of each of so many bodies that are one conductor together."""
        return Ties(self.earth / count, self.local / count)


_Tie = Literal["grounded", "floating", "local"]
Grounding = _Tie | float | Ties


def ties_of(grounding: Grounding) -> tuple[float, float]:
    """Capacitances of a grounding to earth and to the local ground [F], 0 for none."""
    if isinstance(grounding, Ties):
        return grounding.earth, grounding.local
    if isinstance(grounding, float):
        return grounding, 0.0
    words = {"grounded": (math.inf, 0.0), "floating": (0.0, 0.0), "local": (0.0, math.inf)}
    return words[grounding]


def checked_grounding(grounding: object) -> Grounding:
    """Check a grounding.

    Raises:
        SceneError: Neither one of the words, nor a positive capacitance up to 1 mF, nor ties.
    """
    if isinstance(grounding, Ties):
        return grounding
    fix = (
        'give "grounded", "floating", "local", a capacitance to ground in farads, like 100e-12, or '
        "Ties(earth=…, local=…)"
    )
    if isinstance(grounding, str):
        if grounding in get_args(_Tie):
            return cast("_Tie", grounding)
        close = nearest(grounding, get_args(_Tie))
        hint = f"did you mean {close!r}? " if close else ""
        raise SceneError(f"grounding is {shorten(grounding)}, which is not known; {hint}{fix}")
    farads = math.nan if isinstance(grounding, bool) else as_float(grounding)
    if not 0 < farads < math.inf:
        raise SceneError(
            f"grounding is {shorten(grounding)}, not a positive finite capacitance; {fix}"
        )
    if farads > LARGEST_TIE:
        raise SceneError(
            f"grounding is {farads:g} F, more than {LARGEST_TIE:g} F; the capacitance to ground is "
            f'in farads; did you mean {farads * 1e-12:g}? A body of a large one is "grounded"'
        )
    return farads
