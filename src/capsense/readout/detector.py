"""Digital logic behind the converter: baseline tracking, and touch or proximity decisions.

All of it works on codes, as the chips do. The *signal* of a channel is its code minus its baseline,
counted positive in the direction in which codes go when the capacitance grows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Bools, Ints, require, require_whole
from capsense.readout.schedule import rounds


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
