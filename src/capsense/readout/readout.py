"""The chain from capacitances to what a chip reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.channels import ChannelBank, Wiring
from capsense.readout.checks import Array, Bools, phasors, real, require, require_whole
from capsense.readout.conversions import Counts, Schedule
from capsense.readout.converter import CapDac, Conversion, Detector
from capsense.readout.laws import Law, ShuntLaw
from capsense.readout.noise import Context, Process, Stage
from capsense.readout.presets import Chip, ReadoutOptions, chip_of, parts_of

_BATCH = 4096
"""Samples processed at a time."""
AT_ONCE = 20_000_000
"""Samples that a single step may hold: hours of the fastest chip."""
SEED_STRIDE = 2**32
"""How far apart the seeds of sensors side by side lie: where seeds count up from run to run, no
sensor sees in one run what another one saw in the last."""


class ReadingLike(Protocol):
    """What a simulator's reading offers."""

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrodes in matrix order."""

    @property
    def capacitance(self) -> Array:
        """Maxwell matrix, shields at ground [F], shape (M, M)."""

    @property
    def self_capacitance(self) -> Array:
        """Diagonal with the shields driven along [F], shape (M,)."""


class Readout:
    """Turns capacitances into what a chip reports: late, quantised, noisy, one after another.

    The chain, in its order: *channels* pick one capacitance each from the Maxwell matrix;
    *wiring* adds parasitics and crosstalk; the *schedule* samples each channel at its own instant;
    analogue *stages* add drift and noise; the *converter* makes an integer code; the *detector*
    tracks baselines and decides on touch.

    Between the capacitances it is given it interpolates linearly. Give them at the instants that
    :meth:`due` names, and nothing is interpolated.

    Args:
        bank: The channels of a sensor.
        schedule: When each channel is sampled.
        law: The converter.
        dac: The converter's offset DAC.
        wiring: Parasitics; none by default.
        stages: Drift and noise, in order.
        detector: Digital logic; none by default.
        seed: Of all random numbers. The same seed gives the same numbers, to the last bit.

    Raises:
        ReadoutError: The parts do not fit each other.
    """

    def __init__(
        self, bank: ChannelBank, schedule: Schedule, law: Law, *, dac: CapDac | None = None,
        wiring: Wiring | None = None, stages: Sequence[Stage] = (),
        detector: Detector | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        if not isinstance(bank, ChannelBank):
            raise ReadoutError(
                f"bank is {bank!r}; give the channels, ChannelBank(patterns, electrodes)"
            )
        self.bank = bank
        self.name = "readout"
        """For titles."""
        for kind, parts in ((Wiring, [wiring]), (Detector, [detector]), (Stage, stages)):
            for part in parts:
                if part is not None and not isinstance(part, kind):
                    raise ReadoutError(f"{part!r} is no {kind.__name__}; give one")
        if schedule.count != len(self.bank):
            raise ReadoutError(
                f"the schedule samples {schedule.count} channels and there are {len(self.bank)}; "
                "make them the same"
            )
        self.schedule, self.law, self.dac = schedule, law, dac
        self.stages, self.detector = tuple(stages), detector
        self.wiring = wiring or Wiring()
        grounds = np.array([p.sees_ground for p in self.bank.patterns])
        mixing, self._offset = self.wiring.start(grounds)
        self._mixing = None if np.array_equal(mixing, np.eye(len(self.bank))) else mixing
        self.reset(seed=seed)

    @classmethod
    def preset(cls, chip: str, electrodes: Sequence[str], **options: Any) -> Readout:
        """A readout with the figures of a known chip; see :func:`build`.

        Raises:
            ReadoutError: No such chip, or an option is wrong.
        """
        return build(chip, electrodes, ReadoutOptions.of(options))

    def __repr__(self) -> str:
        return (
            f"<Readout {self.name!r}: {len(self.bank)} channels, each every "
            f"{1e3 * self.schedule.period:.4g} ms>"
        )

    @property
    def seed(self) -> int:
        """Seed of the random numbers; :meth:`reset` takes another one."""
        return self._seed

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return self.bank.names

    def reset(self, *, start: float = 0.0, seed: int | None = None) -> None:
        """Begin anew: the first cycle starts at ``start`` [s].

        Args:
            start: Time at which the chip is switched on [s].
            seed: A new seed; by default random numbers repeat.

        Raises:
            ReadoutError: ``start`` is not finite, or the seed no whole number from 0 on.
        """
        require("reset", "start", start, -math.inf, "s")
        if seed is not None:
            require_whole("readout", "seed", seed, 0)
            self._seed = int(seed)
        seeds = np.random.SeedSequence(self._seed).spawn(len(self.stages))
        k = len(self.bank)
        plan = self.schedule
        self._processes: list[Process] = [
            stage.start(Context(k, plan.conversion, plan.period, np.random.default_rng(s)))
            for stage, s in zip(self.stages, seeds, strict=True)
        ]
        self._convert = self._converter(k, self.bank.differences)
        rising = self.law.rising
        self._detect = None if self.detector is None else self.detector.start(k, rising)
        self._start = start
        self._seen = 0  # samples whose instant has passed
        # Instants [s], channels and values [F] of samples whose result cannot be read yet.
        self._waiting = (np.empty(0), np.empty(0, dtype=np.int64), np.empty(0))
        self._last: tuple[float, Array] | None = None
        self._next_instant = float(plan.instant(np.array(0))) - plan.slack
        self._next_stamp = self._next_instant + plan.lag
        self._none = self._report(-math.inf)
        self._latest = self._none

    def _converter(self, channels: int, differences: Bools) -> Conversion:
        """The converters of many channels, with the errors of their specimens."""
        if self.dac is None:
            return Conversion(self.law, None, channels)
        without = np.zeros(channels, bool) if self.dac.differential else differences
        errors = self.dac.specimens(channels, self._seed)
        return Conversion(self.law, self.dac, channels, errors, without)

    def due(self, until: float) -> Array:
        """Instants at which capacitances are wanted next [s], up to ``until`` [s], rising."""
        require("due", "until", until, -math.inf, "s")
        self._require_patience(until - self._start)
        last = self.schedule.samples_until(until - self._start)
        return self._start + np.unique(self.schedule.instant(np.arange(self._seen, last)))

    def channel_values(self, capacitance: ReadingLike | ArrayLike) -> Array:
        """Capacitance of each channel before anything distorts it [F].

        Args:
            capacitance: A reading; or Maxwell matrices [F], shape (M, M) or (n, M, M), shields
                held at ground; or the channels themselves [F], shape (K,).

        Returns:
            Shape (K,), or (n, K).

        Raises:
            ReadoutError: The shape does not fit, or a number is not finite.
        """
        return np.asarray(self._phasors(capacitance).real)

    def _phasors(self, capacitance: ReadingLike | ArrayLike) -> NDArray[Any]:
        """As :meth:`channel_values`, but C − jG/ω of a reading whose loss the law takes."""
        if _is_reading(capacitance):
            reading = cast("ReadingLike", capacitance)
            if reading.electrode_names != self.bank.electrodes:
                raise ReadoutError(
                    f"the reading is of electrodes {reading.electrode_names}, the readout for "
                    f"{self.bank.electrodes}; make it with the simulator's electrode_names"
                )
            matrix = reading.capacitance
            shields = reading.self_capacitance - np.diag(matrix)
            conductance = getattr(reading, "conductance", None)
            if conductance is not None and isinstance(self.law, ShuntLaw):
                matrix = matrix - 1j * conductance / self.law.front_end.omega
            return self.bank.values(matrix, shields)
        array = real("capacitance", capacitance)
        if array.ndim != 1:
            return self.bank.values(array)
        return self._checked(array)

    def _checked(self, values: Array) -> Array:
        k = len(self.bank)
        if values.shape[-1:] != (k,):
            raise ReadoutError(f"channel values have shape {values.shape}; give {k} per instant")
        if not np.isfinite(values).all():
            raise ReadoutError("a channel value is not finite; correct the readings")
        return values

    def sample(self, time: float, capacitance: ReadingLike | ArrayLike) -> Counts:
        """Tell the capacitances of an instant; get the conversions finished since the last call.

        Channels whose instants lie between the last call and this one see capacitances
        interpolated linearly in time; before the first call they see those of the first call.

        Args:
            time: [s], not before the last call's.
            capacitance: As of :meth:`channel_values`.

        Returns:
            Conversions with time stamps up to ``time``, often none.

        Raises:
            ReadoutError: Time goes back or is not finite, or the capacitances do not fit.
        """
        values = self._wired(self._phasors(capacitance))
        if values.ndim != 1:
            raise ReadoutError("sample takes one instant; call the readout for a recording")
        now = as_number(time) - self._start
        last = -math.inf if self._last is None else self._last[0] + self._start
        self.require_forward(time, last)
        self._require_patience(now)
        before = self._last or (now, values)
        self._last = (now, values)
        if self._next_instant <= now:
            self._take(now, before, values)
        counts = replace(self._report(now), until=float(time), earlier=self._latest)
        if len(counts):
            self._latest = counts.last()
        return counts

    def __call__(self, times: ArrayLike, capacitance: Sequence[ReadingLike] | ArrayLike) -> Counts:
        """Read a whole recording, from its first time on; resets before and after.

        Args:
            times: [s], rising, shape (n,).
            capacitance: Readings, n of them; or Maxwell matrices [F], shape (n, M, M), which say
                nothing of driven shields; or channels [F], shape (n, K).

        Returns:
            All conversions finished by the last time: the same, to the last bit, as sampling one
            by one gives.

        Raises:
            ReadoutError: Times do not rise, or shapes do not fit.
        """
        t = real("times", times)
        if t.ndim != 1 or not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0).any():
            raise ReadoutError("times must be finite numbers that rise, of shape (n,)")
        if isinstance(capacitance, Sequence) and any(map(_is_reading, capacitance)):
            capacitance = np.array([self._phasors(c) for c in capacitance])
        array = phasors("capacitance", capacitance)
        if array.ndim not in (2, 3) or len(array) != len(t):
            raise ReadoutError(
                f"{len(t)} times for capacitances of shape {array.shape}; give (n, K) or (n, M, M)"
            )
        truth = self._checked(array) if array.ndim == 2 else self.bank.values(array)
        values = self._wired(truth)
        self.reset(start=float(t[0]))
        relative = t - t[0]
        self._require_patience(float(relative[-1]))
        self._seen = self.schedule.samples_until(float(relative[-1]))
        instant, channel = self.schedule.samples(np.arange(self._seen))
        after = np.searchsorted(relative, instant - self.schedule.slack)
        before = np.maximum(after - 1, 0)
        span = relative[after] - relative[before]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(span > 0, (instant - relative[before]) / span, 1.0)
        old = values[before, channel]
        value = old + np.minimum(share, 1.0) * (values[after, channel] - old)
        self._waiting = (instant, channel, value)
        counts = self._report(float(relative[-1]))
        self.reset()
        return counts

    @staticmethod
    def require_forward(time: float, last: float) -> None:
        """Refuse a time [s] that is not finite, or before the last one.

        Raises:
            ReadoutError: It is.
        """
        if not math.isfinite(as_number(time)):
            raise ReadoutError(f"sample at {time!r} s; give a finite time")
        if time < last:
            raise ReadoutError(
                f"sample at {time!r} s, after one at {last:g} s; time must not go back: call "
                "reset() to begin anew"
            )

    def require_times(self, times: Sequence[float]) -> None:
        """Refuse times [s] that :meth:`sample` could not be told one after another.

        Raises:
            ReadoutError: One is not finite, goes back, or leaps.
        """
        last = -math.inf if self._last is None else self._last[0] + self._start
        for time in times:
            self.require_forward(time, last)
            last = time
        if len(times):
            self._require_patience(times[0] - self._start)

    def _require_patience(self, now: float) -> None:
        """Refuse a leap over more conversions than anybody wants at once."""
        plan = self.schedule
        if (now / plan.period) * plan.count - self._seen > AT_ONCE:
            raise ReadoutError(
                f"{now + self._start:g} s is more than {AT_ONCE:.0e} conversions after the last "
                "time; take smaller steps, or begin there: reset(start=…)"
            )

    def _take(self, now: float, before: tuple[float, Array], values: Array) -> None:
        """Sample the channels whose instants have come, between two sets of values [F]."""
        plan = self.schedule
        cycles = 2 + int((now - self._next_instant) / plan.period)
        number = np.arange(self._seen, self._seen + cycles * len(self.bank))
        instant, channel = plan.samples(number)
        count = int((instant - plan.slack).searchsorted(now, "right"))
        self._next_instant = float(instant[count]) - plan.slack
        self._seen += count
        instant, channel = instant[:count], channel[:count]
        span = now - before[0]
        share = np.minimum((instant - before[0]) / span, 1.0) if span > 0 else 1.0
        old = before[1][channel]
        taken = old + share * (values[channel] - old)
        kept = self._waiting
        if len(kept[0]):
            instant = np.concatenate([kept[0], instant])
            channel = np.concatenate([kept[1], channel])
            taken = np.concatenate([kept[2], taken])
        self._waiting = (instant, channel, taken)

    def _wired(self, values: Array) -> Array:
        """What the wiring makes of channel values [F], shape (..., K)."""
        if self._mixing is not None:
            # A sum, not a matrix product: that rounds differently for one row and for many.
            values = (self._mixing * values[..., None, :]).sum(axis=-1)
        return values + self._offset

    def _report(self, now: float) -> Counts:
        """Process the waiting samples whose result can be read at ``now`` [s]."""
        plan = self.schedule
        if -math.inf < now < self._next_stamp:
            return self._none
        instant, channel, value = self._waiting
        late = plan.lag - plan.slack
        ready = int((instant + late).searchsorted(now, "right"))
        self._waiting = (instant[ready:], channel[ready:], value[ready:])
        left = self._next_instant + plan.slack if ready == len(instant) else float(instant[ready])
        self._next_stamp = left + late
        instant, value = instant[:ready], value[:ready]
        watched = self._detect is not None
        counts = Counts(
            self.bank.names,
            time=self._start + (instant + plan.lag),
            channel=channel[:ready],
            code=np.empty(ready, dtype=np.int64),
            capacitance=np.empty(ready),
            flags=np.empty(ready, dtype=np.uint8),
            baseline=np.empty(ready) if watched else None,
            touched=np.empty(ready, dtype=bool) if watched else None,
        )
        time = self._start + instant
        if ready <= _BATCH:
            self._fill(counts, time, value)
            return counts
        for first in range(0, ready, _BATCH):
            part = slice(first, first + _BATCH)
            self._fill(counts[part], time[part], value[part])
        return counts

    def _fill(self, counts: Counts, instant: Array, value: Array) -> None:
        """Send one batch through stages, converter and detector, into its place."""
        turned, value = value.imag, value.real  # drift and noise leave a loss as it is
        for process in self._processes:
            value = process(counts.channel, instant, value)
        if not np.isfinite(value).all():
            raise ReadoutError("a stage made a number that is not finite; correct its figures")
        if turned.any():
            value = value + 1j * turned
        counts.code[:], counts.capacitance[:], counts.flags[:] = self._convert(
            counts.channel, value
        )
        if self._detect is not None and counts.baseline is not None and counts.touched is not None:
            counts.baseline[:], counts.touched[:] = self._detect(counts.channel, counts.code)


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
    out = Readout(**parts_of(part, electrodes, options or ReadoutOptions()))
    out.name = part.title
    return out


def _is_reading(capacitance: object) -> bool:
    # By name: a check against the protocol takes longer than all the rest of a step.
    return hasattr(capacitance, "self_capacitance")
