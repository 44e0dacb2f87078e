"""What a chip is: its converter, its timing and noise, and where each figure comes from."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from capsense._validate import as_number
from capsense.readout.converter import CapDac, Law
from capsense.readout.detector import Detector

Mode = Literal["self", "mutual"]


class Status(StrEnum):
    """How well a figure is known."""

    CONFIRMED = "confirmed"
    """Read in the source named."""
    COMPUTED = "computed"
    """Follows from confirmed figures."""
    REMEMBERED = "remembered"
    """Commonly stated, also as from the data sheet; not read there. Check before relying on it."""
    ASSUMED = "assumed"
    """No source states it; a plausible value, to be fitted to one's own sensor."""


@dataclass(frozen=True)
class Fact:
    """One figure of a chip."""

    quantity: str
    value: str
    status: Status
    source: str


@dataclass(frozen=True)
class Rate:
    """One setting of the output rate."""

    per_second: float
    """Conversions per second of one converter [Hz]."""
    rms: float
    """Noise of one conversion [F]."""


@dataclass(frozen=True)
class Chip:
    """A converter chip with its figures."""

    name: str
    title: str
    mode: Mode
    law: Law
    rates: tuple[Rate, ...]
    """The first one is the default."""
    facts: tuple[Fact, ...]
    inputs: int | None = None
    """Channels of one chip, scanned in turn; None where a switch brings any number to it."""
    order: Literal["scan", "together", "by transmitter"] = "scan"
    """Channels one after another; all at once; or all receivers of one transmitter at once."""
    gap: float = 0.0
    """Time to switch over before a conversion [s]."""
    dac: CapDac | None = None
    relative_noise: float = 0.0
    """Noise in proportion to the capacitance."""
    flicker: float = 0.0
    """Allan deviation of the floor [F]."""
    offset_per_kelvin: float = 0.0
    """[F/K]"""
    gain_per_kelvin: float = 0.0
    """[1/K]"""
    detector: Detector | None = None
    """The chip's own logic; None where there is none or it is left to the host."""

    def rate(self, per_second: float | None) -> Rate | None:
        """The setting of an output rate, the default one for None; None if there is no such."""
        if per_second is None:
            return self.rates[0]
        wanted = as_number(per_second)
        near = [r for r in self.rates if abs(r.per_second - wanted) <= 0.01 * r.per_second]
        return near[0] if near else None
