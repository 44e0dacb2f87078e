"""Converters and the logic behind them: codes, their saturation, baselines, touch decisions.

All logic works on codes, as the chips do. The *signal* of a channel is its code minus its baseline,
counted positive in the direction in which codes go when the capacitance grows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from functools import partial
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Bools, Ints, require, require_whole
from capsense.readout.conversions import rounds
from capsense.readout.laws import Law

Flags = NDArray[np.uint8]


_SPECIMENS = 0xCAB
"""Tells the random numbers of specimens from those of noise."""


class Range(IntFlag):
    """Saturation of a sample."""

    INSIDE = 0
    BELOW = 1
    """The capacitance was below what the converter can tell; its code is the last it has."""
    ABOVE = 2
    """The capacitance was above what the converter can tell."""


@dataclass(frozen=True)
class CapDac:
    """A capacitor array in the chip that is subtracted from the input, in steps.

    The chip's user adds ``code · step`` to the result. Where the capacitors of the bits differ
    from that, the sum jumps when the code changes. They differ from specimen to specimen: that of
    bit b has too much by ``bit_errors[b] + step 2^b (tolerance u + mismatch g_b)``, with u even
    from −1 to 1 for the whole array and normal g_b for each bit.
    """

    step: float
    """Nominal capacitance of one step [F]."""
    codes: int
    """Number of codes, from 0."""
    bit_errors: tuple[float, ...] = ()
    """What each bit's capacitor has too much [F], the least significant first."""
    mismatch: float = 0.0
    """Standard deviation of a bit's capacitor over its nominal value, from specimen to specimen."""
    tolerance: float = 0.0
    """Largest deviation of the whole array over its nominal value, from specimen to specimen."""
    channels: int | None = None
    """Channels that one array serves, the first ones by the first; None for all."""
    differential: bool = True
    """Whether it works in differential measurements too."""
    specimen: int | None = None
    """Number of the specimen; by default the seed of the readout is, so that another one makes
    another specimen."""
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
        if len(self.bit_errors) > self.bits:
            raise ReadoutError(
                f"CAPDAC: bit_errors are {len(self.bit_errors)}, but {self.codes} codes have "
                f"{self.bits} bits; give one a bit, the least significant first"
            )
        for name in ("mismatch", "tolerance"):
            require("CAPDAC", name, getattr(self, name), 0.0, "")
        if self.specimen is not None:
            require_whole("CAPDAC", "specimen", self.specimen, 0)

    @property
    def bits(self) -> int:
        """Bits of its codes."""
        return (self.codes - 1).bit_length()

    def specimens(self, channels: int, seed: int, sensors: int = 1) -> Array:
        """What the capacitors of specimens have too much, for each channel that they serve.

        Args:
            channels: Number of channels of one sensor.
            seed: Decides the specimens, where :attr:`specimen` does not.
            sensors: How many sensors, each with specimens of its own.

        Returns:
            Of each bit [F], shape (sensors · channels, bits).
        """
        number = seed if self.specimen is None else self.specimen
        rng = np.random.default_rng([number, _SPECIMENS])
        served = self.channels or channels
        arrays = -(-channels // served)
        common = self.tolerance * rng.uniform(-1.0, 1.0, (sensors, arrays, 1))
        own = common + self.mismatch * rng.standard_normal((sensors, arrays, self.bits))
        errors = own * self.step * 2.0 ** np.arange(self.bits)
        errors[..., : len(self.bit_errors)] += self.bit_errors
        return np.repeat(errors, served, axis=1)[:, :channels].reshape(-1, self.bits)

    def actual(self, errors: Array) -> Array:
        """What is subtracted at each code [F], shape (channels, codes).

        ``errors`` are what each channel's capacitors have too much [F], shape (channels, bits).
        """
        code = np.arange(self.codes)
        on = (code >> np.arange(self.bits)[:, None]) & 1
        wrong = np.zeros((len(errors), self.codes))
        for bit in range(self.bits):  # a product of matrices would round rows by their number
            wrong += errors[:, [bit]] * on[bit]
        return np.asarray(code * self.step + wrong, dtype=float)

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
        errors: What the DAC's capacitors have too much [F], as of :meth:`CapDac.specimens`, shape
            (channels, bits); by default its ``bit_errors``.
        without: Channels that are converted without the DAC, shape (channels,); none by default.
    """

    def __init__(
        self, law: Law, dac: CapDac | None, channels: int, errors: Array | None = None,
        without: Bools | None = None,
    ) -> None:  # fmt: skip
        self._law, self._dac, self._channels = law, dac, channels
        if dac is not None:
            if errors is None:
                errors = np.zeros((channels, dac.bits))
                errors[:, : len(dac.bit_errors)] = dac.bit_errors
            self._actual = np.empty((channels, dac.codes))
            self._with = np.ones(channels, bool) if without is None else ~without
            self.dac_codes = np.zeros(channels, np.int64)
            self.restart(np.arange(channels), errors)

    def restart(self, channel: Ints, errors: Array) -> None:
        """Set the DACs of some channels as at the start, with errors [F], shape (n, bits)."""
        if self._dac is not None:
            start = -1 if self._dac.start == "auto" else self._dac.start
            self._actual[channel] = self._dac.actual(errors)
            self.dac_codes[channel] = np.where(self._with[channel], start, 0)

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
        code, flags = quantise(self._law, value - self._actual[channel, used])
        if dac.follow and flags[self._with[channel]].any():
            return None
        return code, self._law.capacitance(code) + used * dac.step, flags

    def _in_turn(self, dac: CapDac, channel: Ints, value: Array) -> tuple[Ints, Array, Flags]:
        """Convert at most one sample a channel, and set the DAC's codes for the next one."""
        used = self.dac_codes[channel]
        used = np.where(used < 0, dac.nearest(value), used)
        code, flags = quantise(self._law, value - self._actual[channel, used])
        reported = self._law.capacitance(code) + used * dac.step
        if dac.follow:
            used = np.where(
                (flags > 0) & self._with[channel], _next_code(dac, self._law, used, flags), used
            )
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


class TrackerProcess(Protocol):
    """A baseline tracker at work."""

    def __call__(self, channel: Ints, signal: Array, touched: Bools) -> Array:
        """Return the change of the baseline along the signal [codes], shape (n,).

        Args:
            channel: Channel numbers, all different, shape (n,).
            signal: Signal against the present baseline [codes], shape (n,).
            touched: Whether the channel is held to be touched, shape (n,).
        """


class Tracker(Protocol):
    """How a baseline follows slow changes."""

    def start(self, channels: int) -> TrackerProcess:
        """Return the tracker's process."""


@dataclass(frozen=True)
class ExponentialTracker:
    """First-order low-pass of the code; stands still while the channel is touched."""

    samples: float
    """Time constant, in samples of a channel."""
    hold: bool = True
    """Whether the baseline stands still during a touch."""

    def __post_init__(self) -> None:
        require("baseline tracker", "samples", self.samples, 0.0, "", open_=True)

    def start(self, channels: int) -> TrackerProcess:
        """Return the process."""
        return partial(self._follow, -math.expm1(-1.0 / self.samples))

    def _follow(self, share: float, channel: Ints, signal: Array, touched: Bools) -> Array:
        step = share * signal
        return np.where(touched, 0.0, step) if self.hold else step


@dataclass(frozen=True)
class Filter:
    """One of the settings of :class:`SteppingTracker`."""

    max_half_delta: int = 1
    """A signal of up to twice this many codes is taken over at once (MHD)."""
    noise_half_delta: int = 1
    """Step of the baseline when a larger signal lasts (NHD) [codes]."""
    noise_count: int = 0
    """Number of such samples in a row that are taken for noise (NCL)."""
    delay: int = 0
    """The filter runs at every ``delay + 1``-th sample (FDL)."""

    def __post_init__(self) -> None:
        for name in ("max_half_delta", "noise_half_delta", "noise_count", "delay"):
            require_whole("baseline filter", name, getattr(self, name), 0, 255)


@dataclass(frozen=True)
class SteppingTracker:
    """Baseline tracking after the MPR121: three settings, for when the signal rises, falls, rests.

    The data sheet describes the registers' meaning and not the circuit; this is that meaning in
    its plainest form.
    """

    away: Filter = Filter(1, 1, 255, 2)
    """Against a growing capacitance: a hand that comes must not be taken into the baseline."""
    back: Filter = Filter(1, 1, 0, 0)
    """Against a falling capacitance: quick, so that a wrong baseline fixes itself."""
    touched: Filter = Filter(0, 0, 255, 255)

    def start(self, channels: int) -> TrackerProcess:
        """Return the process."""
        table = np.array(
            [
                (2 * f.max_half_delta, f.noise_half_delta, f.noise_count, f.delay)
                for f in (self.away, self.back, self.touched)
            ]
        )
        lasted = np.zeros(channels, dtype=np.int64)
        waited = np.zeros(channels, dtype=np.int64)
        return partial(_step, table, lasted, waited)


def _step(
    table: Ints, lasted: Ints, waited: Ints, channel: Ints, signal: Array, touched: Bools
) -> Array:
    """Baselines' changes; ``lasted`` and ``waited`` count samples of each channel, shape (K,)."""
    setting = np.where(touched, 2, np.where(signal > 0, 0, 1))
    small, step, count, delay = table[setting].T
    due = waited[channel] >= delay
    waited[channel] = np.where(due, 0, waited[channel] + 1)
    within = np.abs(signal) <= small
    run = np.where(within, 0, lasted[channel] + due)
    moved = due & (run > count)
    lasted[channel] = np.where(moved, 0, run)
    limited = np.sign(signal) * np.minimum(step, np.abs(signal))
    return np.where(due & within, signal, np.where(moved, limited, 0.0))


@dataclass(frozen=True)
class Detector:
    """Touch or proximity decision with hysteresis and debouncing, over a tracked baseline.

    Raises:
        ReadoutError: Thresholds are not ``0 < release <= touch``, or debounce is below 1.
    """

    touch: float
    """Signal from which a channel counts as touched [codes]."""
    release: float
    """Signal below which it is released [codes]."""
    tracker: Tracker
    debounce: int = 1
    """Samples in a row that a change of state takes."""

    def __post_init__(self) -> None:
        if not 0 < as_number(self.release) <= as_number(self.touch) < math.inf:
            raise ReadoutError(
                f"detector: touch = {self.touch!r} and release = {self.release!r}; give "
                "0 < release <= touch, in codes"
            )
        require_whole("detector", "debounce", self.debounce, 1)

    def start(self, channels: int, rising: bool) -> Detection:
        """Return the detector's process; ``rising`` as of the converter's law."""
        return Detection(self, channels, 1.0 if rising else -1.0)


class Detection:
    """A detector at work. Baselines start at each channel's first code."""

    def __init__(self, detector: Detector, channels: int, sign: float) -> None:
        self._spec, self._sign = detector, sign
        self._track = detector.tracker.start(channels)
        self._baseline = np.zeros(channels)
        self._seen = np.zeros(channels, dtype=bool)
        self._touched = np.zeros(channels, dtype=bool)
        self._run = np.zeros(channels, dtype=np.int64)

    def __call__(self, channel: Ints, code: Ints) -> tuple[Array, Bools]:
        """Return baselines [codes] and states after each code of a batch, each of shape (n,)."""
        baseline, touched = np.empty(len(code)), np.empty(len(code), dtype=bool)
        for part in rounds(len(code), len(self._run)):
            baseline[part], touched[part] = self._in_turn(channel[part], code[part])
        return baseline, touched

    def _in_turn(self, channel: Ints, code: Ints) -> tuple[Array, Bools]:
        """One code a channel at most."""
        fresh = ~self._seen[channel]
        if fresh.any():
            self._baseline[channel] = np.where(fresh, code, self._baseline[channel])
            self._seen[channel] = True
        signal = self._sign * (code - self._baseline[channel])
        touched = self._touched[channel]
        other = np.where(touched, signal < self._spec.release, signal >= self._spec.touch)
        run = np.where(other, self._run[channel] + 1, 0)
        flip = run >= self._spec.debounce
        touched = touched ^ flip
        self._touched[channel] = touched
        self._run[channel] = np.where(flip, 0, run)
        self._baseline[channel] += self._sign * self._track(channel, signal, touched)
        return self._baseline[channel], touched
