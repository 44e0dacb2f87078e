"""Many chips at once, each with a clock, noise and figures of its own."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import chosen_rows
from capsense.errors import ReadoutError
from capsense.readout.calibration import LinearSensor, ResponseCurve
from capsense.readout.checks import Array, Ints, finite, require_whole
from capsense.readout.conversions import Held
from capsense.readout.converter import Conversion
from capsense.readout.noise import (
    ClimateDrift,
    Context,
    Flicker,
    Mains,
    Process,
    RandomWalk,
    Stage,
    White,
)
from capsense.readout.randomisation import FIGURES, ReadoutRandomisation
from capsense.readout.readout import AT_ONCE, Readout
from capsense.readout.streams import COLUMNS, GAMMA, Streams, drawn, mixed, root, uniform

KNOWN = (White, Flicker, RandomWalk, Mains, ClimateDrift, LinearSensor, ResponseCurve)
"""Stages that know chips side by side; others work chip by chip."""


class ManyChips:
    """What chips side by side are, on any device: their clocks, seeds and drawn figures.

    Args:
        readout: A readout of one sensor with K channels; it stays as it is.
        environments: How many, e. Chips of an environment are restarted together.
        sensors: How many sensors each has, s.
        seed: Of all random numbers.
        start: When they are switched on [s], a number or one for each environment.
        randomisation: How they differ; by default not at all.

    Raises:
        ReadoutError: A number is out of range, or an array does not fit.
    """

    def __init__(
        self, readout: Readout, environments: int, sensors: int = 1, *, seed: int = 0,
        start: ArrayLike = 0.0, randomisation: ReadoutRandomisation | None = None,
    ) -> None:  # fmt: skip
        for name, number in (("environments", environments), ("sensors", sensors)):
            require_whole("readout", f"the number of {name}", number, 1)
        plan, k = readout.schedule, len(readout.bank)
        self._one, self.shape = readout, (int(environments), int(sensors), k)
        self.randomisation = wanted = randomisation or ReadoutRandomisation()
        if not isinstance(wanted, ReadoutRandomisation):
            raise ReadoutError(f"randomisation is {wanted!r}; give a ReadoutRandomisation")
        if wanted.most("jitter") > plan.period:
            raise ReadoutError(
                f"randomisation: jitter is up to {wanted.most('jitter'):g} s, more than the period "
                f"of {plan.period:g} s, so that results would overtake each other; give less"
            )
        late = plan.lag + wanted.most("delay") + wanted.most("jitter")
        self._depth = math.ceil(late / plan.period) + 2
        self._instant = np.empty(k)
        self._instant[plan.order] = plan.offsets
        e, n = self.shape[0], len(readout.bank.electrodes)
        self._figures: dict[str, Any] = {name: np.zeros(self.shape) for name in FIGURES}
        self._figures["dead"] = np.zeros((*self.shape[:2], n), bool)
        self._figures["stuck"] = np.zeros(self.shape, bool)
        self._start, self._last = np.zeros(e), np.full(e, -math.inf)
        self._roots, self._episode = np.zeros(e, np.uint64), np.zeros(e, np.int64)
        self._keys = np.zeros(self.shape, np.uint64)
        dac = readout.dac
        self._errors = np.zeros((*self.shape, 0 if dac is None else dac.bits))
        """What bits of offset DACs have too much [F]."""
        self._begin(np.arange(e), start, seed)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of a chip's channels."""
        return self._one.channel_names

    @property
    def drawn(self) -> ReadoutRandomisation:
        """The figures as they are, as arrays: (e, s, K), of dead electrodes (e, s, M)."""
        return ReadoutRandomisation(**{name: f.copy() for name, f in self._figures.items()})

    def reset(
        self, environments: ArrayLike | None = None, *, start: ArrayLike | None = None,
        seed: int | None = None,
    ) -> None:  # fmt: skip
        """Switch chips on anew, and draw their figures and noise anew.

        What is drawn depends on the seed, on the number of the environment, and on how often it was
        reset since it got that seed, and on nothing else.

        Args:
            environments: Their numbers, or a mask of shape (e,); all by default.
            start: When they are switched on [s], a number or one for each of these environments;
                by default 0.
            seed: A new seed for these environments.

        Raises:
            ReadoutError: There is no such environment, or a number is out of range.
        """
        rows = np.unique(chosen_rows(environments, self.shape[0], ReadoutError))
        if len(rows):
            self._begin(rows, 0.0 if start is None else start, seed)

    def _begin(self, rows: Ints, start: ArrayLike, seed: int | None) -> None:
        begun = finite("start", start)
        if begun.shape not in ((), (len(rows),)):
            raise ReadoutError(
                f"start has shape {begun.shape}; give a number, or one for each of {len(rows)} "
                "environments"
            )
        if seed is not None:
            require_whole("readout", "seed", seed, 0)
            self._roots[rows], self._episode[rows] = root(seed), 0
            if self._one.dac is not None:
                e, s, k = self.shape
                errors = self._one.dac.specimens(k, int(seed), e * s)
                self._errors[rows] = errors.reshape(e, s, k, -1)[rows]
        else:
            self._episode[rows] += 1
        self._start[rows], self._last[rows] = begun, -math.inf
        e, s, k = self.shape
        sensors, channels = np.arange(s, dtype=np.uint64), np.arange(k, dtype=np.uint64)
        life = drawn(drawn(self._roots[rows], rows), self._episode[rows])
        chips = mixed(life[:, None] + np.uint64(GAMMA) * (sensors + np.uint64(1)))
        self._keys[rows] = mixed(chips[..., None] + np.uint64(GAMMA) * (channels + np.uint64(1)))
        size = (e, s, k, self._figures["dead"].shape[-1])
        for name, found in self.randomisation.draw(chips, rows, size).items():
            self._figures[name][rows] = found

    def clock(self, time: Any, due: NDArray[np.bool_] | None = None) -> Array:
        """Times of all environments [s], shape (e,), of a number or one for each.

        Clocks of environments that are not due stand still: their times are those of their last
        samples, -inf before the first.

        Raises:
            ReadoutError: One is not finite, or before that of the last sample.
        """
        e = self.shape[0]
        try:
            times = np.broadcast_to(np.asarray(time, dtype=float).reshape(-1), (e,))
        except (TypeError, ValueError, RuntimeError):
            raise ReadoutError(
                f"time is {time!r}; give a number of seconds, or one for each of {e} environments"
            ) from None
        wrong = ~(np.isfinite(times) & (times >= self._last))
        if due is not None:
            times, wrong = np.where(due, times, self._last), wrong & due
        for number in np.flatnonzero(wrong):
            try:
                Readout.require_forward(float(times[number]), float(self._last[number]))
            except ReadoutError as error:
                raise error if e == 1 else ReadoutError(f"environment {number}: {error}") from None
        return times


class SideBySide(ManyChips):
    """Chips of one kind, one for each sensor of many environments.

    Each environment has a clock of its own, and is restarted by itself. One conversion of all chips
    is as much work for Python as one of a single chip, but for stages of a user's own. Without
    noise, a chip reports what its readout alone does. Detectors are left out.

    What it takes is as of :class:`ManyChips`.
    """

    def __init__(self, readout: Readout, environments: int, sensors: int = 1, **how: Any) -> None:
        super().__init__(readout, environments, sensors, **how)
        e, s, k = self.shape
        size = e * s * k
        self._taken, self._told = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self._values, self._play = np.zeros(size), np.zeros(size)
        self._waiting = np.zeros((self._depth, size), np.int64), np.zeros((self._depth, size))
        bank, dac = readout.bank, readout.dac
        without = np.zeros(size, bool)
        if dac is not None and not dac.differential:
            without = np.tile(bank.differences, e * s)
        errors = self._errors.reshape(size, -1)
        self._convert = Conversion(readout.law, dac, size, None if dac is None else errors, without)
        self._processes: list[tuple[Streams, Process]] = []
        plan, keys = readout.schedule, self._keys
        for number, stage in enumerate(readout.stages):
            # One number after those of the stages is for jitter.
            noise = Streams(keys, self._figures["noise"], k, len(readout.stages) + 1, number)
            context = Context(size, plan.conversion, plan.period, noise, (e, s))  # type: ignore[arg-type]
            known = isinstance(stage, KNOWN)
            process = stage.start(context) if known else _ChipByChip(stage, context, keys, number)
            self._processes.append((noise, process))

    def _begin(self, rows: Ints, start: ArrayLike, seed: int | None) -> None:
        super()._begin(rows, start, seed)
        if not hasattr(self, "_processes"):
            return
        e, s, k = self.shape
        lanes = np.arange(e * s * k).reshape(e, -1)[rows].ravel()
        self._taken[lanes] = self._told[lanes] = 0
        self._convert.restart(lanes, self._errors.reshape(e * s * k, -1)[lanes])
        for noise, process in self._processes:
            noise.at(lanes, np.full(len(lanes), -1))
            if hasattr(process, "restart"):
                process.restart(lanes)

    def clock(self, time: Any, due: NDArray[np.bool_] | None = None) -> Array:
        """As of :class:`ManyChips`; leaps over more conversions than anybody wants are refused."""
        times = super().clock(time, due)
        wanted = (times - self._start) / self._one.schedule.period * np.prod(self.shape[1:])
        seen = self._taken.reshape(len(times), -1).sum(axis=1)
        if np.maximum(wanted - seen, 0.0).sum() > AT_ONCE:
            number = int(np.argmax(wanted - seen))
            raise ReadoutError(
                f"{times[number]:g} s is more than {AT_ONCE:.0e} conversions of all chips after "
                "the last time; take smaller steps, or begin there: reset(start=…)"
            )
        return times

    def sample(
        self, time: Any, capacitance: NDArray[np.floating], shield_coupling: Array | None = None,
        due: NDArray[np.bool_] | None = None,
    ) -> Held:  # fmt: skip
        """Tell the capacitances of an instant; get what the chips' registers hold.

        Args:
            time: [s], a number or one for each environment, not before that of the last call.
            capacitance: Maxwell matrices [F], shape (e, s, M, M), or with other axes in front,
                e · s in all.
            shield_coupling: Charge on each electrode per volt on all shields together [F], shape
                (..., M); None where there are no shields.
            due: Mask of the environments whose clocks go on, shape (e,); all by default.

        Returns:
            The last conversion of every channel, each of shape (..., K), and its age.

        Raises:
            ReadoutError: Time goes back or is not finite, or the capacitances do not fit.
        """
        values = self._seen(np.asarray(capacitance), shield_coupling)
        times, lanes_each = self.clock(time, due), math.prod(self.shape[1:])
        now = np.repeat(times - self._start, lanes_each)
        before = np.repeat(self._last - self._start, lanes_each)
        value = values.ravel()
        if due is not None:
            value = np.where(np.repeat(due, lanes_each), value, self._values)
        old = np.where(before == -math.inf, value, self._values)
        start, plan = np.repeat(self._start, lanes_each), self._one.schedule
        while True:
            moment = self._moment(self._taken)
            lanes = np.flatnonzero(moment - plan.slack <= now)
            if not len(lanes):
                break
            at, since, until = moment[lanes], before[lanes], now[lanes]
            span = until - since
            with np.errstate(invalid="ignore"):
                inside = np.minimum((at - since) / np.where(span > 0, span, 1.0), 1.0)
            share = np.where((since > -math.inf) & (span > 0), inside, 1.0)
            seen = old[lanes] + share * (value[lanes] - old[lanes])
            self._take(lanes, start[lanes] + at, seen)
        self._last[:], self._values = times, value
        return self._held(now, values.shape)

    def _moment(self, taken: Ints) -> Array:
        """Instants of samples by their number, since the start [s], shape (e · s · K,)."""
        period = self._one.schedule.period
        return (taken.reshape(-1, self.shape[2]) * period + self._instant).ravel()

    def _seen(self, capacitance: Array, shield_coupling: Array | None) -> Array:
        """Capacitances of all channels, wiring included [F], shape (..., K)."""
        one, chips = self._one, math.prod(self.shape[:2])
        leading, dead = capacitance.shape[:-2], self._figures["dead"]
        if math.prod(leading) != chips:
            raise ReadoutError(
                f"capacitance has shape {capacitance.shape}; give matrices of {chips} sensors"
            )
        connected = ~dead.reshape(*leading, -1) if dead.any() else None
        own = one.bank.values(capacitance, shield_coupling, connected)
        crosstalk = self._figures["crosstalk"].reshape(own.shape)
        return one._wired(own) + crosstalk * (own.sum(axis=-1, keepdims=True) - own)

    def _take(self, lanes: Ints, time: Array, value: Array) -> None:
        """Convert one sample of some channels, at times [s]."""
        half, gain, offset, stuck = (
            self._figures[name].reshape(-1)[lanes]
            for name in ("hysteresis", "gain", "offset", "stuck")
        )
        number, half = self._taken[lanes], 0.5 * half
        play = np.clip(self._play[lanes], value - half, value + half)
        self._play[lanes] = play = np.where(number == 0, value, play)
        value = play * gain + offset
        for noise, process in self._processes:
            noise.at(lanes, number)
            value = process(lanes, time, value)
        if not np.isfinite(value).all():
            raise ReadoutError("a stage made a number that is not finite; correct its figures")
        found = self._convert(lanes, value)[:2]
        stuck, place = stuck & (number > 0), number % self._depth
        for column, made in zip(self._waiting, found, strict=True):
            column[place, lanes] = np.where(stuck, column[place - 1, lanes], made)
        self._taken[lanes] += 1
        full = self._taken[lanes] - self._told[lanes] >= self._depth
        self._told[lanes] += full  # a later one can be read by now

    def _stamp(self, number: Ints) -> Array:
        """When results can be read, by their number, since the start [s], shape (e · s · K,)."""
        plan, figures = self._one.schedule, self._figures
        late = plan.lag + figures["delay"].ravel()
        jitter = figures["jitter"].ravel()
        if jitter.any():
            jitter = jitter * self._jitter(number)
        return self._moment(number) + (late + jitter)

    def _jitter(self, number: Ints) -> Array:
        """Even numbers in (0, 1) of results by their number, shape (e · s · K,)."""
        stages = len(self._processes) + 1
        count = ((number + 1) * stages + stages - 1) * COLUMNS
        return uniform(drawn(self._keys.reshape(-1), count))

    def _held(self, now: Array, shape: tuple[int, ...]) -> Held:
        """What the registers hold at times since the starts [s], of that shape."""
        slack = self._one.schedule.slack
        while True:
            stamp = self._stamp(self._told)
            ready = (self._told < self._taken) & (stamp - slack <= now)
            if not ready.any():
                break
            self._told += ready
        some, last = self._told > 0, self._told - 1
        columns = [
            np.where(some, column[last % self._depth, np.arange(len(last))], 0)
            for column in self._waiting
        ]
        age = np.where(some, np.maximum(now - self._stamp(last), 0.0), math.inf)
        code, capacitance = columns
        return Held(capacitance.reshape(shape), code.reshape(shape), age.reshape(shape))


class _ChipByChip:
    """A user's own stage at work: a process for each chip."""

    def __init__(self, stage: Stage, context: Context, keys: NDArray[np.uint64], number: int):
        self._stage, self._context, self._number, self._keys = stage, context, number, keys
        self._processes: list[Any] = [None] * math.prod(context.chips)
        self.restart(np.arange(context.channels))

    def restart(self, channel: Ints) -> None:
        k = self._context.shape[-1]
        for chip in np.unique(channel // k).tolist():
            rng = np.random.default_rng([int(self._keys.reshape(-1)[k * chip]), self._number])
            one = replace(self._context, channels=k, rng=rng, chips=())
            self._processes[chip] = self._stage.start(one)

    def __call__(self, channel: Ints, time: Array, value: Array) -> Array:
        out, k = np.empty(len(value)), self._context.shape[-1]
        chips = channel // k
        order = np.lexsort((time, chips))
        for part in np.split(order, np.flatnonzero(np.diff(chips[order])) + 1):
            process = self._processes[chips[part[0]]]
            out[part] = process(channel[part] % k, time[part], value[part])
        return out
