"""Readouts built from a chip's figures and a few options."""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from capsense._validate import suggest
from capsense.errors import ReadoutError
from capsense.readout.channels import ChannelBank, Pattern, mutual_patterns, self_patterns
from capsense.readout.checks import Array, require
from capsense.readout.chips import CHIPS, Chip
from capsense.readout.converter import CapDac, Law, LinearLaw, ReciprocalLaw, ShuntLaw
from capsense.readout.detector import Detector
from capsense.readout.front_end import Wiring
from capsense.readout.noise import ClimateDrift, Flicker, Mains, Profile, RandomWalk, Stage, White
from capsense.readout.readout import Readout
from capsense.readout.schedule import Schedule, idle_of

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
    key = name.strip().lower() if isinstance(name, str) else ""
    if key not in CHIPS:
        raise ReadoutError(f"unknown chip {name!r}; {suggest(str(name), CHIPS)}")
    return CHIPS[key]


def build(
    chip: str | Chip, electrodes: Sequence[str], options: ReadoutOptions | None = None
) -> Readout:
    """A readout with a chip's figures.

    Args:
        chip: A known chip's name, or a chip.
        electrodes: Electrode names in matrix order.
        options: What is chosen.

    Raises:
        ReadoutError: No such chip, a rate it does not have, or an option is wrong.
    """
    part = chip if isinstance(chip, Chip) else chip_of(chip)
    chosen = options or ReadoutOptions()
    patterns = tuple(chosen.patterns) or default_patterns(part, electrodes)
    bank = ChannelBank(patterns, electrodes)
    rate = part.rate(chosen.rate)
    if rate is None:
        rates = ", ".join(f"{r.per_second:.4g}" for r in part.rates)
        raise ReadoutError(
            f"{part.name} has no rate of {chosen.rate!r} conversions per second; it has {rates}"
        )
    plan = schedule_of(part, patterns, 1.0 / rate.per_second - part.gap)
    idle = idle_of(chosen.period, plan.period)
    out = Readout(
        bank,
        dataclasses.replace(plan, idle=idle, latency=chosen.latency),
        law_of(part, chosen, len(patterns)),
        dac=_dac_of(part, chosen.capdac),
        wiring=chosen.wiring,
        stages=(*chosen.stages, *_stages(part, rate.rms, chosen)),
        detector=chosen.detector or part.detector,
        seed=chosen.seed,
    )
    out.name = part.title
    return out


def default_patterns(chip: Chip, electrodes: Sequence[str]) -> tuple[Pattern, ...]:
    """All electrodes of a self-measuring chip, with its shield; all pairs of a mutual one."""
    return self_patterns(electrodes) if chip.mode == "self" else mutual_patterns(electrodes)


def schedule_of(chip: Chip, patterns: Sequence[Pattern], conversion: float) -> Schedule:
    """The order in which a chip takes its channels; ``conversion`` in seconds."""
    count = len(patterns)
    if chip.order == "together":
        return Schedule.simultaneous(count, conversion)
    if chip.order == "by transmitter":
        groups: dict[Hashable, list[int]] = {}
        for number, pattern in enumerate(patterns):
            groups.setdefault(_excitation(pattern), []).append(number)
        return Schedule(tuple(tuple(g) for g in groups.values()), conversion, chip.gap)
    return Schedule.sequential(count, conversion, inputs=chip.inputs, gap=chip.gap)


def _excitation(pattern: Pattern) -> Hashable:
    """What the electrodes do: patterns of which it is the same can be measured at once.

    Receivers are held at ground, as the rest is. Where the rest floats or is driven, what another
    pattern reads would have to float or be driven: such a pattern is measured by itself.
    """
    alone = "" if pattern.rest == "grounded" else pattern.name
    driven = frozenset(pattern.drive.items())
    return driven, frozenset(pattern.floating), pattern.shield, alone


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
        return charge_for(expected)
    return law


def _dac_of(chip: Chip, start: int | None) -> CapDac | None:
    """The chip's offset DAC, as it is set at the start."""
    if start is None:
        return chip.dac
    if chip.dac is None:
        raise ReadoutError(
            f"capdac is {start!r}, but the {chip.name} has no offset DAC; leave it out"
        )
    return dataclasses.replace(chip.dac, start=start)


def expected_of(empty: Array) -> float:
    """What a chip is to be set up for, given all channels' capacitances with an empty scene [F].

    The least of them: one setting serves all channels, and codes rise as capacitance falls.
    """
    return max(float(empty.min()), LEAST_EXPECTED)


def charge_for(capacitance: float) -> ReciprocalLaw:
    """MPR121 current and time with which a capacitance [F] reads nearest to 90 % of the range.

    Raises:
        ReadoutError: No setting brings it into the range.
    """
    usual = CHIPS["mpr121"].law
    assert isinstance(usual, ReciprocalLaw)
    settings = [(k * 1e-6, 0.5e-6 * 2**power) for power in range(7) for k in range(1, 64)]
    laws = [dataclasses.replace(usual, current=current, time=time) for current, time in settings]
    wanted = np.array(capacitance)
    fitting = [law for law in laws if law.low <= float(law.level(wanted)) <= law.high]
    if not fitting:
        raise ReadoutError(
            f"expected = {capacitance:g} F is outside of what an MPR121 can charge; give 0.2e-12 "
            "to 2800e-12 F"
        )
    goal = fitting[0].low + 0.9 * (fitting[0].high - fitting[0].low)
    return min(fitting, key=lambda law: abs(float(law.level(wanted)) - goal))


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
