"""What a chip is: its converter, its timing and noise, and where each figure comes from.

The chips that are known stand in ``chips.toml``, which says how well each figure is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from capsense._validate import as_number, read_toml
from capsense.errors import ReadoutError
from capsense.readout.converter import (
    CapDac,
    Law,
    LinearLaw,
    ReciprocalLaw,
    ResonanceLaw,
    ShuntLaw,
)
from capsense.readout.detector import Detector, SteppingTracker
from capsense.readout.front_end import ShuntFrontEnd

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


_LAWS = {
    "linear": LinearLaw, "reciprocal": ReciprocalLaw, "resonance": ResonanceLaw, "shunt": ShuntLaw,
}  # fmt: skip


def _chip(name: str, data: Mapping[str, Any]) -> Chip:
    """A chip of ``chips.toml``; the classes refuse figures that they do not know."""
    given = {k: v for k, v in data.items() if k not in ("rates", "conversions", "noise")}
    law = dict(given["law"])
    kind = _LAWS[law.pop("kind")]
    if "front_end" in law:
        law["front_end"] = ShuntFrontEnd(**law["front_end"])
    if "dac" in given:
        dac = given["dac"]
        given["dac"] = CapDac(**{**dac, "bit_errors": tuple(dac.get("bit_errors", ()))})
    if "detector" in given:
        detector = given["detector"]
        tracker = {"stepping": SteppingTracker}[detector["tracker"]]()
        given["detector"] = Detector(**{**detector, "tracker": tracker})
    facts = tuple(Fact(what, value, Status(k), source) for what, value, k, source in data["facts"])
    return Chip(name, **{**given, "law": kind(**law), "rates": _rates(data), "facts": facts})


def _rates(data: Mapping[str, Any]) -> tuple[Rate, ...]:
    """The settings of a chip, from rates or conversion times, and their noise."""
    noise = data["noise"]
    steps = data["rates"] if "rates" in data else data["conversions"]
    if isinstance(noise, dict):  # white: it falls with the square root of the averaging time
        at = noise["at"]
        ratios = [s / at if "rates" in data else at / s for s in steps]
        noise = [noise["rms"] * math.sqrt(ratio) for ratio in ratios]
    per_second = steps if "rates" in data else [1 / s for s in steps]
    return tuple(Rate(*pair) for pair in zip(per_second, noise, strict=True))


CHIPS: dict[str, Chip] = {
    name: _chip(name, data)
    for name, data in read_toml(
        Path(__file__).with_name("chips.toml"), "chip", ReadoutError
    ).items()
}
"""The known chips by name."""


def available_chips() -> tuple[str, ...]:
    """Names of the chips that a readout can be made of, sorted."""
    return tuple(sorted(CHIPS))
