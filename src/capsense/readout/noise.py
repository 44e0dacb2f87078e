"""The analogue stages of a readout: noise and drift, added to what a conversion sees.

A stage is a small frozen description. When a readout starts it makes a *process* of it, which
holds what changes: random numbers, filters' memories. Stages are applied in their order; each takes
the capacitances of a batch of samples and returns new ones. A batch is a run of successive samples
of the schedule, of any length; a process with a memory for each channel goes through it in
:func:`~capsense.readout.conversions.rounds`. It gives the same numbers, to the last bit, however
samples are dealt into batches.

Levels are stated the way data sheets and Allan plots state them. With conversions back to back and
averaged over a time τ, the Allan deviation is

- white noise of rms r per conversion, period T: r √(T/τ);
- flicker (1/f) noise: a floor that does not depend on τ;
- random walk of rate k [F/√s]: k √(τ/3).

References: IEEE Std 1139 for the relation of spectra and Allan variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints, finite, require, require_whole, spread

_POLES_PER_DECADE = 2.0


@dataclass(frozen=True, eq=False)
class Context:
    """What a stage is told when a readout starts."""

    channels: int
    """Number of channels K."""
    conversion: float
    """Length of a conversion's window [s]."""
    period: float
    """Time from one sample of a channel to its next [s]."""
    rng: np.random.Generator
    """Random numbers of this stage alone."""
    chips: tuple[int, ...] = ()
    """How many environments, and sensors in each, have a chip; the channels are those of all, chip
    after chip. Empty for a single chip."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The channels, chip by chip: (K,), or (environments, sensors, K)."""
        return (*self.chips, self.channels // math.prod(self.chips))

    def figures(self, owner: str, name: str, value: object) -> Array:
        """A stage's figures, one a channel, shape (channels,).

        Args:
            owner: Of which stage, for messages.
            name: What they are.
            value: A number for all, one a channel, or more axes in front: one a channel and chip.

        Raises:
            ReadoutError: The count does not fit, or a number is not finite.
        """
        return spread(owner, name, value, self.shape).reshape(-1)


class Process(Protocol):
    """A stage at work.

    One that knows chips side by side, as all of this package do, has a method
    ``restart(channel)`` too, if it holds anything that changes: it begins anew for some channels.
    Those of a user's own work chip by chip.

    A copy of a readout copies its processes: keep what changes in objects that can be copied, as
    the arguments of a ``functools.partial``, and not in the variables of an enclosing function.
    """

    def __call__(self, channel: Ints, time: Array, value: Array) -> Array:
        """Return the new capacitances of a batch [F], shape (n,).

        Args:
            channel: Channel numbers; any K in a row are all different; shape (n,).
            time: Instants [s], not falling, shape (n,).
            value: Capacitances [F], shape (n,).
        """


@runtime_checkable
class Stage(Protocol):
    """One link of the analogue chain."""

    def start(self, context: Context) -> Process:
        """Return the stage's process, in its initial state."""


@dataclass(frozen=True)
class White:
    """Gaussian noise, independent from conversion to conversion."""

    rms: float = 0.0
    """Standard deviation of one conversion [F]."""
    relative: float = 0.0
    """A further part, proportional to the capacitance; added in quadrature."""

    def __post_init__(self) -> None:
        require("white noise", "rms", self.rms, 0.0, "F")
        require("white noise", "relative", self.relative, 0.0, "")

    def start(self, context: Context) -> Process:
        """Return the process."""
        return partial(self._add, context.rng)

    def _add(self, rng: Generator, channel: Ints, time: Array, value: Array) -> Array:
        scale = np.hypot(self.rms, self.relative * value) if self.relative else self.rms
        return value + scale * rng.standard_normal(len(value))


@dataclass(frozen=True)
class Flicker:
    """1/f noise: a sum of relaxation processes, two to a decade of frequency.

    Each is an Ornstein–Uhlenbeck process of time constant τ_i and variance h ln r, where r is the
    ratio of successive time constants; the sum of their one-sided spectra 4 σ² τ/(1 + (2πfτ)²) is
    h/f between the slowest and the fastest, and h = floor²/(2 ln 2).
    """

    floor: float
    """Allan deviation of the floor [F]."""
    slowest: float = 3e4
    """Longest time constant [s]; the noise is white below 1/(2π slowest)."""

    def __post_init__(self) -> None:
        require("flicker noise", "floor", self.floor, 0.0, "F")
        require("flicker noise", "slowest", self.slowest, 0.0, "s", open_=True)

    def poles(self, period: float) -> tuple[Array, float]:
        """Time constants [s] down to half the period, and the variance of each [F²]."""
        fastest = min(0.5 * period, 0.5 * self.slowest)
        decades = math.log10(self.slowest / fastest)
        taus = np.geomspace(
            fastest, self.slowest, max(2, 1 + math.ceil(decades * _POLES_PER_DECADE))
        )
        h = self.floor**2 / (2 * math.log(2))
        return taus, h * math.log(taus[1] / taus[0])

    def start(self, context: Context) -> Process:
        """Return the process, in its stationary state."""
        taus, variance = self.poles(context.period)
        rng = context.rng
        keep = np.exp(-context.period / taus)
        kick = np.sqrt(variance * -np.expm1(-2 * context.period / taus))
        return Poles(rng, context.channels, keep, kick, math.sqrt(variance))


@dataclass(frozen=True)
class RandomWalk:
    """Drift without memory: each channel walks at random, from 0."""

    rate: float
    """Standard deviation after one second [F/√s]."""

    def __post_init__(self) -> None:
        require("random walk", "rate", self.rate, 0.0, "F/√s")

    def start(self, context: Context) -> Process:
        """Return the process."""
        step = np.array([self.rate * math.sqrt(context.period)])
        return Poles(context.rng, context.channels, np.ones(1), step, 0.0)


class Poles:
    """First-order processes at work, the same for each channel; their sum is added.

    Args:
        rng: Random numbers.
        channels: Number of channels.
        keep: What each process keeps of its state from sample to sample, shape (p,).
        kick: Standard deviation of what is added to it [F], shape (p,).
        spread: Standard deviation of the states at the start [F].
    """

    def __init__(
        self, rng: Generator, channels: int, keep: Array, kick: Array, spread: float
    ) -> None:
        self.keep, self.kick, self.spread, self._rng = keep, kick, spread, rng
        self._state = np.zeros((channels, len(keep)))
        self.restart(np.arange(channels))

    def restart(self, channel: Ints) -> None:
        """Draw the states of some channels anew."""
        self._state[channel] = 0.0
        if self.spread:
            drawn = self._rng.standard_normal((len(channel), len(self.keep)))
            self._state[channel] = self.spread * drawn

    def __call__(self, channel: Ints, time: Array, value: Array) -> Array:
        """See :class:`Process`."""
        states = self.kick * self._rng.standard_normal((len(value), len(self.kick)))
        _recur(states, self.keep, self._state, channel)
        return value + states.sum(axis=1)


def _recur(kicks: Array, keep: Array, state: Array, channel: Ints) -> None:
    """Add ``keep`` times its channel's last state to each kick, in place.

    As any K samples in a row are of different channels, a channel's last state lies K rows back;
    for the first K it is in ``state``, shape (K, ...), which is brought up to date.
    """
    count = len(state)
    kicks[:count] += keep * state[channel[:count]]
    for first in range(count, len(kicks), count):
        part = kicks[first : first + count]
        part += keep * kicks[first - count : first - count + len(part)]
    state[channel[-count:]] = kicks[-count:]


@dataclass(frozen=True)
class Mains:
    """Pick-up from the mains: a sine that each conversion averages over its window.

    A window of length T passes a frequency f with the factor sinc(fT)^order; order 1 is a plain
    average, 3 the filter of a third-order sigma-delta converter. What is left is sampled, and so
    folded to low frequency. The phase is drawn at the start.
    """

    amplitude: float
    """Before averaging, as a capacitance [F]."""
    frequency: float = 50.0
    """[Hz]"""
    order: int = 1
    """Order of the averaging filter."""

    def __post_init__(self) -> None:
        require("mains", "amplitude", self.amplitude, 0.0, "F")
        require("mains", "frequency", self.frequency, 0.0, "Hz", open_=True)
        if self.order not in (1, 2, 3, 4):
            raise ReadoutError(f"mains: order is {self.order!r}; give 1, 2, 3 or 4")

    def start(self, context: Context) -> Process:
        """Return the process."""
        return PickUp(self, context)

    def passed(self, conversion: float) -> float:
        """Amplitude after an average over a conversion of that length [s], in farads."""
        return self.amplitude * float(np.sinc(self.frequency * conversion)) ** self.order


class PickUp:
    """Pick-up from the mains at work, of a phase for each chip."""

    def __init__(self, mains: Mains, context: Context) -> None:
        self._passed, self._omega = mains.passed(context.conversion), 2 * math.pi * mains.frequency
        self._channels, self._rng = context.shape[-1], context.rng
        self._phase = np.zeros(context.channels // self._channels)
        self.restart(np.arange(context.channels))

    def restart(self, channel: Ints) -> None:
        """Draw the phases of some channels' chips anew."""
        chips = np.unique(channel // self._channels)
        self._phase[chips] = 2 * math.pi * self._rng.random(len(chips))

    def __call__(self, channel: Ints, time: Array, value: Array) -> Array:
        """See :class:`Process`."""
        phase = self._phase[channel // self._channels]
        return value + self._passed * np.sin(self._omega * time + phase)


@dataclass(frozen=True)
class Profile:
    """A quantity that changes with time, linear between points, constant beyond them."""

    times: tuple[float, ...]
    """[s], rising."""
    values: tuple[float, ...]

    @classmethod
    def of(cls, value: float | Sequence[tuple[float, float]], name: str) -> Profile:
        """From a constant, or from (time [s], value) points.

        Raises:
            ReadoutError: The points are none, not pairs, not finite, or times do not rise.
        """
        points = finite(name, [(0.0, value)] if np.isscalar(value) else value)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ReadoutError(f"{name} is {value!r}; give a number or [[time, value], …]")
        if (np.diff(points[:, 0]) <= 0).any():
            raise ReadoutError(f"{name} is {value!r}; times must rise from point to point")
        return cls(tuple(points[:, 0].tolist()), tuple(points[:, 1].tolist()))

    def at(self, time: Array) -> Array:
        """Values at times [s]."""
        return np.interp(time, self.times, self.values)


@dataclass(frozen=True)
class ClimateDrift:
    """Offset and gain that follow temperature and relative humidity."""

    offset_per_kelvin: float = 0.0
    """[F/K]"""
    gain_per_kelvin: float = 0.0
    """[1/K]"""
    offset_per_percent: float = 0.0
    """[F] per percent of relative humidity."""
    gain_per_percent: float = 0.0
    """Per percent of relative humidity."""
    temperature: Profile = Profile((0.0,), (25.0,))
    """[°C]"""
    humidity: Profile = Profile((0.0,), (50.0,))
    """[%]"""
    reference: tuple[float, float] = (25.0, 50.0)
    """Temperature [°C] and relative humidity [%] at which there is no error."""

    def __post_init__(self) -> None:
        for name in (
            "offset_per_kelvin", "gain_per_kelvin", "offset_per_percent", "gain_per_percent",
        ):  # fmt: skip
            require("climate", name, getattr(self, name), -math.inf, "")

    def start(self, context: Context) -> Process:
        """Return the process."""
        return self._drift

    def _drift(self, channel: Ints, time: Array, value: Array) -> Array:
        warmer = self.temperature.at(time) - self.reference[0]
        damper = self.humidity.at(time) - self.reference[1]
        gain = 1 + self.gain_per_kelvin * warmer + self.gain_per_percent * damper
        offset = self.offset_per_kelvin * warmer + self.offset_per_percent * damper
        return gain * value + offset


def allan_deviation(values: ArrayLike, averages: Sequence[int] | NDArray[np.int64]) -> Array:
    """Overlapping Allan deviation of evenly spaced samples.

    ``σ²(m T) = ½ ⟨(ȳ_{k+m} − ȳ_k)²⟩``, ȳ_k being the mean of m samples from k on.

    Args:
        values: Samples, shape (n, ...); time runs along the first axis.
        averages: Numbers m of samples averaged, each from 1 to n/2.

    Returns:
        Deviations in the unit of the samples, shape (len(averages), ...).

    Raises:
        ReadoutError: A number m is out of range.
    """
    samples = finite("samples", values)
    total = np.concatenate([np.zeros((1, *samples.shape[1:])), np.cumsum(samples, axis=0)])
    out = []
    for m in averages:
        require_whole(f"averages of {len(samples)} samples", "one", m, 1, len(samples) // 2)
        change = (total[2 * m :] - 2 * total[m:-m] + total[: -2 * m]) / m
        out.append(np.sqrt(0.5 * np.mean(change**2, axis=0)))
    return np.array(out)
