"""How a body is tied to ground: the impedance through shoes, floor and surroundings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from capsense._validate import as_number
from capsense.errors import SceneError


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
    {
        "human-body model": GroundPath(
            100e-12, 1.5e3, source="ANSI/ESDA/JEDEC JS-001, human-body model: 100 pF, 1.5 kohm"
        ),
        "IEC 61000-4-2": GroundPath(150e-12, 330.0, source="IEC 61000-4-2: 150 pF, 330 ohm"),
        "standing, thick soles": GroundPath(
            100e-12, source="lower end of 100-300 pF, the range common in EMC literature"
        ),
        "standing, thin soles": GroundPath(
            300e-12, source="upper end of 100-300 pF, the range common in EMC literature"
        ),
    }
)
"""Models of a person's path to ground, by name."""
