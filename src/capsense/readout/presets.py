"""What a chip is: its converter, its timing and noise; and readouts built from its figures.

The chips that are known stand in ``chips.toml``, which says how well each figure is known.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from capsense._validate import as_number, read_toml, suggest
from capsense.errors import ReadoutError
from capsense.readout.channels import ChannelBank, Pattern, Wiring, mutual_patterns, self_patterns
from capsense.readout.checks import Array, require
from capsense.readout.conversions import Schedule, idle_of
from capsense.readout.converter import CapDac, Detector, SteppingTracker
from capsense.readout.laws import (
    Law,
    LinearLaw,
    ReciprocalLaw,
    ResonanceLaw,
    ShuntFrontEnd,
    ShuntLaw,
)
from capsense.readout.noise import ClimateDrift, Flicker, Mains, Profile, RandomWalk, Stage, White

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

    def rate(self, per_second: float | None) -> Rate:
        """The setting of an output rate, the default one for None.

        Raises:
            ReadoutError: There is no such setting.
        """
        if per_second is None:
            return self.rates[0]
        wanted = as_number(per_second)
        for rate in self.rates:
            if abs(rate.per_second - wanted) <= 0.01 * rate.per_second:
                return rate
        rates = ", ".join(f"{r.per_second:.4g}" for r in self.rates)
        raise ReadoutError(
            f"{self.name} has no rate of {per_second!r} conversions per second; it has {rates}"
        )


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
        given["dac"] = CapDac(**dac, channels=data.get("inputs"))
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


_TABLES = read_toml(Path(__file__).with_name("chips.toml"), "chip", ReadoutError)
CHIPS: dict[str, Chip] = {name: _chip(name, data) for name, data in _TABLES.items()}
"""The known chips by name."""


def available_chips() -> tuple[str, ...]:
    """Names of the chips that a readout can be made of, sorted."""
    return tuple(sorted(CHIPS))


EXPECTED = 10e-12
"""Capacitance that chips which adapt to it are set up for by default [F]."""
LEAST_EXPECTED = 0.2e-12
"""Least capacitance that a chip can be set up for [F]."""


@dataclass(frozen=True, kw_only=True)
class ReadoutOptions:
    """What may be chosen about a chip."""

    patterns: Sequence[Pattern] = ()
    """Channels; by default all electrodes, or all pairs, as the chip measures."""
    rate: float | None = None
    """Conversions per second [Hz], one of the chip's; by default its first."""
    period: float | None = None
    """Time from one round of all channels to the next [s]; by default as soon as it is done."""
    latency: float = 0.0
    """Time from the end of a conversion until its result can be read [s]."""
    seed: int = 0
    noise: bool = True
    """Whether the chip's noise is on; quantisation and saturation stay."""
    white: float | None = None
    """White noise of one conversion, rms [F], instead of the chip's."""
    flicker: float | None = None
    """Allan deviation of the floor [F], instead of the chip's."""
    walk: float = 0.0
    """Random walk [F/√s]."""
    mains: float = 0.0
    """Amplitude of mains pick-up before averaging [F]."""
    mains_frequency: float = 50.0
    """[Hz]"""
    temperature: Any = None
    """[°C]: a number, or (time, value) points; None for no drift with temperature."""
    humidity: Any = None
    """[%]: a number, or (time, value) points; None for no drift with humidity."""
    offset_per_kelvin: float | None = None
    """[F/K], instead of the chip's."""
    gain_per_kelvin: float | None = None
    """[1/K], instead of the chip's."""
    offset_per_percent: float | None = None
    """[F] per percent of relative humidity."""
    gain_per_percent: float | None = None
    """Per percent of relative humidity."""
    wiring: Wiring | None = None
    expected: float | None = None
    """Capacitance that a chip which adapts to it is set up for [F]."""
    capdac: int | None = None
    """Offset DAC at the start; by default the step nearest to each channel's first sample."""
    capdac_errors: Sequence[float] | None = None
    """What each bit of the offset DAC has too much [F], the least significant first, as measured on
    a specimen; by default drawn."""
    specimen: int | None = None
    """Number of the specimen, which decides the errors of its offset DAC; by default the seed
    does. Without noise and a number, all are nominal."""
    law: Law | None = None
    """The converter's law, instead of the chip's: another tank, another front end."""
    nonlinearity: float = 0.0
    """Deviation from a straight line over the range, see :class:`LinearLaw`; those that data
    sheets state are among a chip's facts."""
    stages: Sequence[Stage] = ()
    """Further analogue stages, before the chip's noise."""
    detector: Detector | None = None
    """Digital logic, instead of the chip's."""

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> ReadoutOptions:
        """Options by name.

        Raises:
            ReadoutError: There is no such option.
        """
        known = [f.name for f in dataclasses.fields(cls)]
        for name in options:
            if name not in known:
                raise ReadoutError(f"no option {name!r} of a readout; {suggest(name, known)}")
        return cls(**options)


def chip_of(name: str) -> Chip:
    """The chip of a name; upper and lower case are the same.

    Raises:
        ReadoutError: There is no such chip.
    """
    key = str(name).strip().lower() if isinstance(name, str | Path) else ""
    if key.endswith(".toml"):
        raise ReadoutError(
            f"{str(name)!r} is a readout file; load_readout({str(name)!r}, electrodes, …) takes "
            "it, with the same options"
        )
    if key not in CHIPS:
        raise ReadoutError(f"unknown chip {name!r}; {suggest(str(name), CHIPS)}")
    return CHIPS[key]


def parts_of(chip: Chip, electrodes: Sequence[str], options: ReadoutOptions) -> dict[str, Any]:
    """What a :class:`~capsense.readout.Readout` with a chip's figures is made of, by keyword.

    Args:
        chip: The chip.
        electrodes: Electrode names in matrix order.
        options: What is chosen.

    Raises:
        ReadoutError: The chip does not have such a rate, or an option is wrong.
    """
    patterns = tuple(options.patterns) or default_patterns(chip, electrodes)
    bank = ChannelBank(patterns, electrodes)
    rate = chip.rate(options.rate)
    plan = schedule_of(chip, patterns, 1.0 / rate.per_second - chip.gap)
    idle = idle_of(options.period, plan.period)
    return {
        "bank": bank,
        "schedule": dataclasses.replace(plan, idle=idle, latency=options.latency),
        "law": law_of(chip, options, len(patterns)),
        "dac": _dac_of(chip, options),
        "wiring": options.wiring,
        "stages": (*options.stages, *_stages(chip, rate.rms, options)),
        "detector": options.detector or chip.detector,
        "seed": options.seed,
    }


def default_patterns(chip: Chip, electrodes: Sequence[str]) -> tuple[Pattern, ...]:
    """All electrodes of a self-measuring chip, with its shield; all pairs of a mutual one."""
    return self_patterns(electrodes) if chip.mode == "self" else mutual_patterns(electrodes)


def schedule_of(chip: Chip, patterns: Sequence[Pattern], conversion: float) -> Schedule:
    """The order in which a chip takes its channels; ``conversion`` in seconds."""
    if chip.order == "together":
        return Schedule.simultaneous(len(patterns), conversion)
    if chip.order == "by transmitter":
        return Schedule.grouped([p.excitation for p in patterns], conversion, gap=chip.gap)
    return Schedule.sequential(len(patterns), conversion, inputs=chip.inputs, gap=chip.gap)


def law_of(chip: Chip, options: ReadoutOptions, channels: int) -> Law:
    """The chip's law, as it is set up and wired.

    One that charges is set up for the capacitance expected. Over a shunt lies what the leads have
    to ground, their mean: there is one front end for all.
    """
    law = options.law or chip.law
    if options.nonlinearity:
        if not isinstance(law, LinearLaw):
            raise ReadoutError(
                f"nonlinearity is {options.nonlinearity!r}, but the law of the {chip.name} is "
                "curved by itself; leave it out"
            )
        return dataclasses.replace(law, nonlinearity=options.nonlinearity)
    if isinstance(law, ShuntLaw) and options.wiring is not None:
        load = law.front_end.parasitic + float(options.wiring.ground(channels).mean())
        loaded = dataclasses.replace(law.front_end, parasitic=load)
        return dataclasses.replace(law, front_end=loaded)
    if options.law is None and isinstance(law, ReciprocalLaw):
        expected = EXPECTED if options.expected is None else options.expected
        require("readout", "expected", expected, 0.0, "F", open_=True)
        return law.set_for(expected)
    return law


def _dac_of(chip: Chip, options: ReadoutOptions) -> CapDac | None:
    """The chip's offset DAC, as it is set at the start, with what is known of the specimen."""
    if chip.dac is None:
        for name in ("capdac", "capdac_errors", "specimen"):
            if (value := getattr(options, name)) is not None:
                raise ReadoutError(
                    f"{name} is {value!r}, but the {chip.name} has no offset DAC; leave it out"
                )
        return None
    changes: dict[str, Any] = {}
    if options.specimen is not None:
        changes["specimen"] = options.specimen
    if options.capdac is not None:
        changes["start"] = options.capdac
    if options.capdac_errors is not None:
        changes["bit_errors"] = tuple(options.capdac_errors)
    if options.capdac_errors is not None or (not options.noise and options.specimen is None):
        changes["mismatch"] = changes["tolerance"] = 0.0
    return dataclasses.replace(chip.dac, **changes) if changes else chip.dac


def expected_of(empty: Array) -> float:
    """What a chip is to be set up for, given all channels' capacitances with an empty scene [F].

    The least of them: one setting serves all channels, and codes rise as capacitance falls.
    """
    return max(float(empty.min()), LEAST_EXPECTED)


def _stages(chip: Chip, rms: float, options: ReadoutOptions) -> list[Stage]:
    """Climate, random walk, flicker, mains and white noise, those that are not zero."""
    out = _climate(chip, options)
    if options.walk:
        out.append(RandomWalk(options.walk))
    floor = _first(options.flicker, chip.flicker if options.noise else 0.0)
    if floor:
        out.append(Flicker(floor))
    if options.mains:
        out.append(Mains(options.mains, options.mains_frequency))
    if options.white is not None:
        out += [White(options.white)] if options.white else []
    elif options.noise and (rms or chip.relative_noise):
        out.append(White(rms, chip.relative_noise))
    return out


def _climate(chip: Chip, options: ReadoutOptions) -> list[Stage]:
    """Drift with temperature and humidity, where one is given; what would do nothing is refused."""
    known = {"temperature": chip.offset_per_kelvin or chip.gain_per_kelvin, "humidity": 0.0}
    for quantity, unit in (("temperature", "kelvin"), ("humidity", "percent")):
        given = {n: getattr(options, n) for n in (f"offset_per_{unit}", f"gain_per_{unit}")}
        if getattr(options, quantity) is None:
            for name, value in given.items():
                if value:
                    raise ReadoutError(f"{name} does nothing without a {quantity}; give one")
        elif not known[quantity] and all(value is None for value in given.values()):
            raise ReadoutError(
                f"{quantity} changes nothing, as no such drift of the {chip.name} is known; give "
                f"{' or '.join(given)}"
            )
    if options.temperature is None and options.humidity is None:
        return []
    return [
        ClimateDrift(
            _first(options.offset_per_kelvin, chip.offset_per_kelvin),
            _first(options.gain_per_kelvin, chip.gain_per_kelvin),
            _first(options.offset_per_percent, 0.0),
            _first(options.gain_per_percent, 0.0),
            temperature=Profile.of(_first(options.temperature, 25.0), "temperature"),
            humidity=Profile.of(_first(options.humidity, 50.0), "humidity"),
        )
    ]


def _first(value: Any, otherwise: Any) -> Any:
    return otherwise if value is None else value
