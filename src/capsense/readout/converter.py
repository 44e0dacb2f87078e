"""Converters: from a capacitance to an integer code, and what a user makes of the code."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints, require, require_whole
from capsense.readout.front_end import ShuntFrontEnd
from capsense.readout.schedule import rounds

Flags = NDArray[np.uint8]


_MOST_CURVED = 0.1
"""Larger deviations from a straight line are refused; beyond 0.25 codes would fall again."""


class Range(IntFlag):
    """Saturation of a sample."""

    INSIDE = 0
    BELOW = 1
    """The capacitance was below what the converter can tell; its code is the last it has."""
    ABOVE = 2
    """The capacitance was above what the converter can tell."""


class Law(Protocol):
    """How code and capacitance belong together."""

    @property
    def low(self) -> int:
        """Smallest code."""

    @property
    def high(self) -> int:
        """Largest code."""

    @property
    def rising(self) -> bool:
        """Whether the code grows with the capacitance."""

    def level(self, capacitance: Array) -> Array:
        """Code before rounding, of capacitances [F] of any shape."""

    def capacitance(self, code: Ints) -> Array:
        """Capacitance [F] that a code stands for."""


@dataclass(frozen=True)
class LinearLaw:
    """``code = C/lsb + zero``: sigma-delta converters with a reference capacitor, and counters."""

    lsb: float
    """Capacitance of one code [F]."""
    low: int
    high: int
    zero: int = 0
    """Code at 0 F."""
    nonlinearity: float = 0.0
    """Largest deviation of the codes from the straight line through the ends of their range, over
    the range: a parabola, up where it is positive. Its user does not know of it."""
    rising = True

    def __post_init__(self) -> None:
        require("linear law", "lsb", self.lsb, 0.0, "F", open_=True)
        _require_codes(self.low, self.high)
        if not abs(as_number(self.nonlinearity)) <= _MOST_CURVED:
            raise ReadoutError(
                f"linear law: nonlinearity is {self.nonlinearity!r}; give a share of the range, up "
                f"to {_MOST_CURVED} of it"
            )

    def level(self, capacitance: Array) -> Array:
        """Code before rounding."""
        code = capacitance / self.lsb + self.zero
        if not self.nonlinearity:
            return code
        share = np.clip((code - self.low) / (self.high - self.low), 0.0, 1.0)
        return code + 4.0 * self.nonlinearity * (self.high - self.low) * share * (1.0 - share)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        return self.lsb * (np.asarray(code) - self.zero).astype(float)


@dataclass(frozen=True)
class ReciprocalLaw:
    """``code = 2^bits · I T/(C V_dd)``: charge with a current I for a time T, read the voltage.

    The charger needs a headroom to either rail; codes beyond it are out of range.
    """

    current: float
    """I [A]."""
    time: float
    """T [s]."""
    supply: float
    """V_dd [V]."""
    bits: int = 10
    headroom: float = 0.7
    """[V]"""
    rising = False

    def __post_init__(self) -> None:
        for name, unit in (("current", "A"), ("time", "s"), ("supply", "V")):
            require("reciprocal law", name, getattr(self, name), 0.0, unit, open_=True)
        require("reciprocal law", "headroom", self.headroom, 0.0, "V")
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code in range: at the largest capacitance."""
        return math.ceil(self.headroom / self.supply * 2**self.bits)

    @property
    def high(self) -> int:
        """Largest code in range."""
        full = 2**self.bits
        return min(math.floor((self.supply - self.headroom) / self.supply * full), full - 1)

    @property
    def _product(self) -> float:
        return 2**self.bits * self.current * self.time / self.supply

    def level(self, capacitance: Array) -> Array:
        """Code before rounding; beyond all codes for a capacitance of zero or less."""
        with np.errstate(divide="ignore"):
            return np.where(capacitance > 0, self._product / np.maximum(capacitance, 0.0), np.inf)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]; infinite at code 0."""
        with np.errstate(divide="ignore"):
            return self._product / np.asarray(code, dtype=float)

    def set_for(self, capacitance: float) -> ReciprocalLaw:
        """The same with an MPR121's current and time that bring a capacitance [F] near 90 %.

        Raises:
            ReadoutError: No setting brings it into the range.
        """
        settings = [(k * 1e-6, 0.5e-6 * 2**power) for power in range(7) for k in range(1, 64)]
        laws = [replace(self, current=current, time=time) for current, time in settings]
        wanted = np.array(capacitance)
        fitting = [law for law in laws if law.low <= float(law.level(wanted)) <= law.high]
        if not fitting:
            raise ReadoutError(
                f"expected = {capacitance:g} F is outside of what an MPR121 can charge; give "
                "0.2e-12 to 2800e-12 F"
            )
        goal = self.low + 0.9 * (self.high - self.low)
        return min(fitting, key=lambda law: abs(float(law.level(wanted)) - goal))


@dataclass(frozen=True)
class ResonanceLaw:
    """``code = 2^bits f/f_ref`` with ``f = 1/(2π √(L (C_fixed + C)))``: an LC tank's frequency."""

    inductance: float
    """L [H]."""
    fixed: float
    """C_fixed, the tank's own capacitor [F]."""
    reference: float
    """f_ref [Hz]."""
    bits: int = 28
    slowest: float = 10e3
    """Least frequency that is counted [Hz]."""
    rising = False

    def __post_init__(self) -> None:
        for name, unit in (
            ("inductance", "H"), ("fixed", "F"), ("reference", "Hz"), ("slowest", "Hz"),
        ):  # fmt: skip
            require("resonance law", name, getattr(self, name), 0.0, unit, open_=True)
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code: that of the least frequency."""
        return math.ceil(self.slowest / self.reference * 2**self.bits)

    @property
    def high(self) -> int:
        """Largest code: a quarter of the reference frequency, beyond which it is not counted."""
        return 2**self.bits // 4

    def level(self, capacitance: Array) -> Array:
        """Code before rounding; beyond all codes where the tank has no capacitance left."""
        total = np.maximum(self.fixed + capacitance, 0.0)
        with np.errstate(divide="ignore"):
            frequency = 1 / (2 * math.pi * np.sqrt(self.inductance * total))
        return frequency / self.reference * 2**self.bits

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        frequency = np.asarray(code, dtype=float) * (self.reference / 2**self.bits)
        return 1 / (self.inductance * (2 * math.pi * frequency) ** 2) - self.fixed


@dataclass(frozen=True)
class ShuntLaw:
    """``code = 2^(bits−1) |V_o|/full_scale``: a front end's IQ magnitude, sampled by a radio.

    The phase tells the sign, so that noise about zero stays noise about zero. The capacitance is
    what the recovery formula makes of the magnitude, as in Schöffmann et al. 2022; see
    :mod:`capsense.readout.front_end` for its error. A complex capacitance C − jG/ω, of matter that
    conducts, has a phasor V_o of another phase and magnitude.
    """

    front_end: ShuntFrontEnd
    full_scale: float
    """Largest amplitude [V]."""
    bits: int = 16
    rising = True

    def __post_init__(self) -> None:
        require("shunt law", "full_scale", self.full_scale, 0.0, "V", open_=True)
        require_whole("shunt law", "bits", self.bits, 2)
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code; the one below it has no counterpart."""
        return -self.high

    @property
    def high(self) -> int:
        """Largest code: the radio's, or the last below what the amplifier gives for any C."""
        most = self.front_end.gain * self.front_end.amplitude / self.full_scale
        return min(2 ** (self.bits - 1) - 1, math.ceil(most * 2 ** (self.bits - 1)) - 1)

    def level(self, capacitance: Array) -> Array:
        """Code before rounding."""
        sign = np.where(capacitance.real < 0.0, -1.0, 1.0)
        size = np.abs(self.front_end.output(sign * capacitance))
        scale = 2 ** (self.bits - 1) / self.full_scale
        return np.asarray(sign * size * scale, dtype=float)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        volts = np.abs(code) * (self.full_scale / 2 ** (self.bits - 1))
        return np.asarray(np.sign(code) * self.front_end.recover(volts), dtype=float)


def _require_codes(low: int, high: int) -> None:
    if not low < high:
        raise ReadoutError(
            f"the codes run from {low} to {high}; widen the range (at a reciprocal law, raise the "
            "supply or lower the headroom; at a shunt law, lower the full scale)"
        )


@dataclass(frozen=True)
class CapDac:
    """A capacitor array in the chip that is subtracted from the input, in steps.

    The chip's user adds ``code · step`` to the result. Where the capacitors of the bits differ
    from that, the sum jumps when the code changes.
    """

    step: float
    """Nominal capacitance of one step [F]."""
    codes: int
    """Number of codes, from 0."""
    bit_errors: tuple[float, ...] = ()
    """What each bit's capacitor has too much [F], the least significant first."""
    start: int | Literal["auto"] = "auto"
    """Code at the start; ``"auto"`` takes that nearest to each channel's first sample."""
    follow: bool = True
    """Whether a channel whose sample saturated gets a new code, for its next sample."""

    def __post_init__(self) -> None:
        require("CAPDAC", "step", self.step, 0.0, "F", open_=True)
        require_whole("CAPDAC", "codes", self.codes, 1)
        if self.start != "auto":
            require_whole("CAPDAC", 'start (if not "auto")', self.start, 0, self.codes - 1)
        for error in self.bit_errors:
            require("CAPDAC", "bit_errors", error, -math.inf, "F")

    def actual(self) -> Array:
        """What is subtracted at each code [F], shape (codes,)."""
        code = np.arange(self.codes)
        errors = sum(error * ((code >> bit) & 1) for bit, error in enumerate(self.bit_errors))
        return np.asarray(code * self.step + errors, dtype=float)

    def nearest(self, capacitance: Array) -> Ints:
        """Code nominally nearest to capacitances [F]."""
        return np.clip(np.rint(capacitance.real / self.step), 0, self.codes - 1).astype(np.int64)

    def stride(self, law: Law) -> int:
        """Steps to a new code after a saturated sample: half a converter's range, at least one."""
        span = abs(float(law.capacitance(np.array(law.high)) - law.capacitance(np.array(law.low))))
        return max(1, round(0.5 * span / self.step))


class Conversion:
    """A converter at work: holds the codes of its offset DAC.

    Args:
        law: How code and capacitance belong together.
        dac: The offset DAC, if it has one.
        channels: Number of channels.
    """

    def __init__(self, law: Law, dac: CapDac | None, channels: int) -> None:
        self._law, self._dac, self._channels = law, dac, channels
        if dac is not None:
            self._actual = dac.actual()
            self.dac_codes = np.full(channels, -1 if dac.start == "auto" else dac.start)

    def __call__(self, channel: Ints, value: Array) -> tuple[Ints, Array, Flags]:
        """Convert a batch.

        Args:
            channel: Channel numbers; any K in a row are all different; shape (n,).
            value: Capacitances [F], shape (n,).

        Returns:
            Codes; the capacitances that the chip's user makes of them [F]; flags of
            :class:`Range`. Each of shape (n,).
        """
        if self._dac is None:
            code, flags = quantise(self._law, value)
            return code, self._law.capacitance(code), flags
        whole = self._with_dac(self._dac, channel, value)
        if whole is not None:
            return whole
        parts = [
            self._in_turn(self._dac, channel[part], value[part])
            for part in rounds(len(value), self._channels)
        ]
        code, reported, flags = (np.concatenate(column) for column in zip(*parts, strict=True))
        return code, reported, flags

    def _with_dac(
        self, dac: CapDac, channel: Ints, value: Array
    ) -> tuple[Ints, Array, Flags] | None:
        """Convert with the DAC's codes as they stand; None if any would change on the way."""
        used = self.dac_codes[channel]
        if (used < 0).any():
            return None
        code, flags = quantise(self._law, value - self._actual[used])
        if dac.follow and flags.any():
            return None
        return code, self._law.capacitance(code) + used * dac.step, flags

    def _in_turn(self, dac: CapDac, channel: Ints, value: Array) -> tuple[Ints, Array, Flags]:
        """Convert at most one sample a channel, and set the DAC's codes for the next one."""
        used = self.dac_codes[channel]
        used = np.where(used < 0, dac.nearest(value), used)
        code, flags = quantise(self._law, value - self._actual[used])
        reported = self._law.capacitance(code) + used * dac.step
        if dac.follow:
            used = np.where(flags > 0, _next_code(dac, self._law, used, flags), used)
        self.dac_codes[channel] = used
        return code, reported, flags


def _next_code(dac: CapDac, law: Law, used: Ints, flags: Flags) -> Ints:
    """Half a converter's range up or down, at least one step."""
    direction = np.where(flags & Range.ABOVE, 1, -1)
    return np.clip(used + direction * dac.stride(law), 0, dac.codes - 1)


def quantise(law: Law, capacitance: ArrayLike) -> tuple[Ints, Flags]:
    """Round capacitances [F] to codes, halves to even, and clip them to the law's range.

    Returns:
        Codes, and flags of :class:`Range`, of the capacitances' shape.
    """
    level = np.rint(law.level(np.asarray(capacitance)))
    clipped = np.minimum(np.maximum(level, law.low), law.high)
    flags = np.zeros(level.shape, dtype=np.uint8)
    wrong = clipped != level
    if wrong.any():
        above = (level > clipped) == law.rising
        flags[wrong] = np.where(above[wrong], Range.ABOVE, Range.BELOW)
    return clipped.astype(np.int64), flags
