"""How large people are.

Lengths of segments are fractions of stature: R. Drillis and R. Contini, "Body Segment
Parameters", Report 1166-03, New York University, 1966, as printed in D. A. Winter,
"Biomechanics and Motor Control of Human Movement", 4th ed., Wiley, 2009, figure 4.1. Masses of
segments are fractions of body mass: Winter, table 4.1.

Circumferences are means over 4082 men and 1986 women: C. C. Gordon et al., "2012 Anthropometric
Survey of U.S. Army Personnel: Methods and Summary Statistics" (ANSUR II), NATICK/TR-15/007,
2014, and were taken from its public data, as were heights, breadths and depths. Those of upper
arm and forearm were taken flexed, so they are the largest. The survey's people are fit adults;
others are reached with ``girth``.

The spread of stature is the distance of the 5th from the 95th percentile in R. L. Huston,
"Principles of Biomechanics", CRC Press, 2009 (men 1.649 to 1.869 m, women 1.518 to 1.724 m),
divided by 2 · 1.645, as for a normal distribution.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from statistics import NormalDist
from types import MappingProxyType
from typing import Any, Literal, get_args

from capsense.errors import SceneError

Sex = Literal["female", "male"]

DATA: Mapping[str, Any] = tomllib.loads(
    resources.files("capsense.humans").joinpath("people.toml").read_text(encoding="utf-8")
)
"""The tables of ``people.toml``: sizes of people, and the segments of their limbs."""
LENGTHS: Mapping[str, float] = MappingProxyType(DATA["lengths"])
"""Lengths as fractions of stature (Drillis and Contini 1966)."""
MASSES: Mapping[str, float] = MappingProxyType(DATA["masses"])
"""Masses as fractions of body mass (Winter 2009)."""
STATURE: Mapping[Sex, tuple[float, float]] = MappingProxyType(DATA["stature"])
"""Mean [m] (ANSUR II) and standard deviation [m] (Huston 2009) of stature."""
CIRCUMFERENCES: Mapping[str, Mapping[Sex, float]] = MappingProxyType(DATA["circumferences"])
"""Mean circumferences [m] at mean stature (ANSUR II)."""
HEIGHTS: Mapping[str, Mapping[Sex, float]] = MappingProxyType(DATA["heights"])
"""Mean heights above the floor [m] at mean stature (ANSUR II)."""
SECTIONS: Mapping[str, Mapping[Sex, tuple[float, float]]] = MappingProxyType(DATA["sections"])
"""Mean breadth and depth [m] at mean stature (ANSUR II); of the head, breadth and length."""
CHEST_DEPTH: Mapping[Sex, float] = MappingProxyType(DATA["chest_depth"])
"""Mean depth of the chest [m] at mean stature (ANSUR II)."""
SHOULDER_BREADTH: Mapping[Sex, float] = MappingProxyType(DATA["shoulder_breadth"])
"""Mean breadth over the deltoids [m] at mean stature (ANSUR II)."""
HAND_BREADTH: Mapping[Sex, float] = MappingProxyType(DATA["hand_breadth"])
"""Mean breadth of the hand at the knuckles [m] at mean stature (ANSUR II)."""
ANKLE = 0.13
"""Circumference of the ankle as a fraction of stature; an estimate, rounded."""
BODY_MASS_INDEX = 25.0
"""Body mass over stature squared [kg/m²] that masses are reckoned with; an assumption."""


@dataclass(frozen=True)
class Build:
    """The size of a person.

    Lengths follow stature; circumferences follow stature and ``girth``.

    Raises:
        SceneError: Another sex, or a number out of range.
    """

    sex: Sex = "male"
    stature: float | None = None
    """Height of the body [m]; by default that of the percentile."""
    percentile: float = 50.0
    """Percentile of stature within the sex; ignored where stature is given."""
    girth: float = 1.0
    """Factor on all circumferences. Those of forearms spread by about a tenth."""

    def __post_init__(self) -> None:
        if self.sex not in get_args(Sex):
            raise SceneError(f'sex is {self.sex!r}; choose "female" or "male"')
        _within("percentile", self.percentile, 0.1, 99.9, "")
        _within("girth", self.girth, 0.5, 2.0, "")
        if self.stature is None:
            mean, spread = STATURE[self.sex]
            stature = NormalDist(mean, spread).inv_cdf(self.percentile / 100)
            object.__setattr__(self, "stature", stature)
        else:
            _within("stature", self.stature, 0.8, 2.3, " m")

    @property
    def height(self) -> float:
        """Height of the body [m]."""
        assert self.stature is not None
        return self.stature

    @property
    def mass(self) -> float:
        """Body mass [kg]."""
        return BODY_MASS_INDEX * self.height**2

    def length(self, name: str) -> float:
        """A length [m] of :data:`LENGTHS`."""
        return LENGTHS[name] * self.height

    def level(self, name: str) -> float:
        """A height above the floor [m] of :data:`HEIGHTS`."""
        return HEIGHTS[name][self.sex] * self._scale

    def section(self, name: str) -> tuple[float, float]:
        """Breadth and depth [m] of a section of the trunk, of :data:`SECTIONS`.

        That of the chest is a stadium of known depth and circumference. The head has the same size
        at any girth.
        """
        if name == "chest":
            depth = self.girth * CHEST_DEPTH[self.sex] * self._scale
            around = 2 * math.pi * self.radius("chest")
            return depth + 0.5 * (around - math.pi * depth), depth
        breadth, depth = SECTIONS[name][self.sex]
        factor = self._scale * (1.0 if name == "head" else self.girth)
        return factor * breadth, factor * depth

    @property
    def shoulder_spacing(self) -> float:
        """Distance [m] between the shoulder centres.

        At a girth of 1, the shoulders are as broad as surveyed: over the upper arms.
        """
        around = CIRCUMFERENCES["upper arm"][self.sex]
        return self._scale * (SHOULDER_BREADTH[self.sex] - around / math.pi)

    @property
    def hip_spacing(self) -> float:
        """Distance [m] between the hip centres.

        At a girth of 1, the hips are as broad as surveyed: over the thighs.
        """
        around = CIRCUMFERENCES["thigh"][self.sex]
        return self._scale * (SECTIONS["hips"][self.sex][0] - around / math.pi)

    def segment_mass(self, name: str) -> float:
        """The mass [kg] of a segment of :data:`MASSES`."""
        return MASSES[name] * self.mass

    def radius(self, name: str) -> float:
        """The radius [m] of the circle that has a circumference of :data:`CIRCUMFERENCES`."""
        if name == "ankle":
            around = ANKLE * self.height
        else:
            around = CIRCUMFERENCES[name][self.sex] * self._scale
        return self.girth * around / (2 * math.pi)

    @property
    def hand_breadth(self) -> float:
        """Breadth of the hand at the knuckles [m]."""
        return self.girth * HAND_BREADTH[self.sex] * self._scale

    @property
    def hand_thickness(self) -> float:
        """Thickness [m] of a hand whose section is a stadium of known breadth and circumference.

        Around a stadium of breadth b and thickness t run 2 (b − t) + π t.
        """
        around = 2 * math.pi * self.radius("hand")
        return (around - 2 * self.hand_breadth) / (math.pi - 2)

    @property
    def _scale(self) -> float:
        return self.height / STATURE[self.sex][0]


def _within(name: str, value: object, low: float, high: float, unit: str) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not low <= value <= high:  # type: ignore[operator]
        raise SceneError(f"{name} is {value!r}; give a number from {low:g} to {high:g}{unit}")
