"""Conversions: which channel is sampled when, what is reported of it, and of many chips at once.

Time runs in cycles. A cycle is a row of slots, one after another; the channels of a slot are
converted at the same time. A conversion is an average over its window. For a world that moves
evenly that is the value at the middle of the window, which is therefore the channel's *instant*;
the result can be read at the end of the window, or a latency later: the sample's *time stamp*. The
neglected term is T²/24 times the second derivative of the capacitance, T being the conversion time.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints, require, require_whole


@dataclass(frozen=True)
class Schedule:
    """A repeated sequence of conversions.

    Raises:
        ReadoutError: A time is negative or not finite, or channels are left out or repeated.
    """

    slots: tuple[tuple[int, ...], ...]
    """Channels of each slot, by number; every channel once."""
    conversion: float
    """Length of a conversion's window [s]."""
    gap: float = 0.0
    """Time before each conversion, to switch over and to settle [s]."""
    idle: float = 0.0
    """Pause at the end of a cycle [s]."""
    latency: float = 0.0
    """Time from the end of a conversion until its result can be read: bus, driver, host [s]."""

    def __post_init__(self) -> None:
        require("schedule", "conversion", self.conversion, 0.0, "s", open_=True)
        for name in ("gap", "idle", "latency"):
            require("schedule", name, getattr(self, name), 0.0, "s")
        if not all(self.slots):
            raise ReadoutError("schedule: a slot holds no channel; leave it out")
        channels = sorted(c for slot in self.slots for c in slot)
        if not channels or channels != list(range(len(channels))):
            raise ReadoutError(
                f"schedule: the slots hold channels {channels}; list each of 0, 1, 2, … once"
            )

    @classmethod
    def sequential(
        cls, channels: int, conversion: float, *, inputs: int | None = None, gap: float = 0.0,
        period: float | None = None,
    ) -> Schedule:  # fmt: skip
        """One channel after another.

        Args:
            channels: Number of channels.
            conversion: Time of a conversion [s].
            inputs: Inputs of one converter. More channels are taken by further converters that
                run side by side: the first ``inputs`` channels by the first one, and so on.
            gap: Time to switch over before each conversion [s].
            period: Time from one cycle to the next [s]; default as soon as it is done.

        Raises:
            ReadoutError: A count is below one, a time out of range, or the period too short.
        """
        per_chip = channels if inputs is None else inputs
        require_whole("schedule", "the number of channels", channels, 1)
        require_whole("schedule", "the number of inputs", per_chip, 1)
        slots = tuple(
            tuple(range(first, channels, per_chip)) for first in range(min(per_chip, channels))
        )
        plan = cls(slots, conversion, gap)
        return replace(plan, idle=idle_of(period, plan.period))

    @classmethod
    def simultaneous(
        cls, channels: int, conversion: float, *, period: float | None = None
    ) -> Schedule:
        """All channels at once, every ``period`` [s], by default back to back.

        Raises:
            ReadoutError: As of :meth:`sequential`.
        """
        return cls.sequential(channels, conversion, inputs=1, period=period)

    @classmethod
    def grouped(cls, keys: Sequence[Hashable], conversion: float, *, gap: float = 0.0) -> Schedule:
        """Channels of the same key at once, the groups one after another."""
        groups: dict[Hashable, list[int]] = {}
        for channel, key in enumerate(keys):
            groups.setdefault(key, []).append(channel)
        return cls(tuple(map(tuple, groups.values())), conversion, gap)

    @cached_property
    def period(self) -> float:
        """Time from one sample of a channel to its next [s]."""
        return len(self.slots) * (self.conversion + self.gap) + self.idle

    @cached_property
    def count(self) -> int:
        """Number of channels, and of samples in a cycle."""
        return len(self.order)

    @cached_property
    def order(self) -> Ints:
        """Channels in the order they are sampled in, shape (K,)."""
        return np.array([c for slot in self.slots for c in slot], dtype=np.int64)

    @cached_property
    def offsets(self) -> Array:
        """Instants in a cycle, in sampling order, from the cycle's start [s], shape (K,)."""
        step = self.conversion + self.gap
        starts = [k * step + self.gap for k, slot in enumerate(self.slots) for _ in slot]
        return np.array(starts) + 0.5 * self.conversion

    def instant(self, sample: Ints) -> Array:
        """Instants [s] of samples by their number, from 0, the first cycle starting at 0."""
        return self.samples(sample)[0]

    def samples(self, sample: Ints) -> tuple[Array, Ints]:
        """Instants [s] and channels of samples by their number, from 0."""
        cycle, place = np.divmod(sample, self.count)
        return cycle * self.period + self.offsets[place], self.order[place]

    @property
    def lag(self) -> float:
        """Time from a sample's instant to its time stamp [s]."""
        return 0.5 * self.conversion + self.latency

    @property
    def slack(self) -> float:
        """Two times closer than this [s] count as the same."""
        return 1e-9 * self.conversion

    def samples_until(self, time: float) -> int:
        """Number of samples whose instant is not after ``time`` [s]."""
        cycle = max(0, int(time // self.period) - 1)
        # Rounding may put the time a hair into the wrong cycle: look at the neighbours too.
        near = np.arange(cycle * self.count, (cycle + 3) * self.count, dtype=np.int64)
        return int(near[0] + np.count_nonzero(self.instant(near) - self.slack <= time))


def idle_of(period: float | None, busy: float) -> float:
    """What is left of a cycle's period [s] after ``busy`` seconds of conversions.

    Raises:
        ReadoutError: The period is no positive number, or too short.
    """
    if period is None:
        return 0.0
    require("schedule", "period", period, 0.0, "s", open_=True)
    if period < busy * (1 - 1e-12):
        raise ReadoutError(
            f"schedule: a period of {period} s is too short for its conversions, which take "
            f"{busy:g} s"
        )
    return max(period - busy, 0.0)


def rounds(samples: int, channels: int) -> Iterator[slice]:
    """Cut a batch into parts that hold each of the channels once at most."""
    for first in range(0, samples, channels):
        yield slice(first, first + channels)


COLUMNS = ("time", "channel", "code", "capacitance", "flags", "baseline", "touched")
"""What is known of each conversion, in the order of the fields of :class:`Counts`."""


@dataclass(frozen=True, eq=False)
class Held:
    """The last conversion of every channel, K of them, in the order of the channels.

    A channel that has not reported yet holds 0, as a chip's register does after it is switched on.
    """

    capacitance: Array
    """What its user makes of the code and the offset DAC [F], shape (K,)."""
    code: Ints
    """What the converter put out, shape (K,)."""
    age: Array
    """Time since the result could be read [s], infinite where there is none yet, shape (K,)."""


@dataclass(frozen=True, eq=False)
class Counts:
    """Finished conversions in the order of time, n of them."""

    channel_names: tuple[str, ...]
    """Names of the readout's channels."""
    time: Array
    """Time stamps: when the result could be read [s], shape (n,)."""
    channel: Ints
    """Number of each conversion's channel, shape (n,)."""
    code: Ints
    """What the converter put out, shape (n,)."""
    capacitance: Array
    """What its user makes of the code and the offset DAC [F], shape (n,)."""
    flags: NDArray[np.uint8]
    """Saturation, of :class:`~capsense.readout.converter.Range`, shape (n,)."""
    baseline: Array | None = None
    """Tracked baselines [codes], shape (n,); None without a detector."""
    touched: NDArray[np.bool_] | None = None
    """Touch or proximity states, shape (n,); None without a detector."""
    until: float | None = None
    """When the readout was asked [s]; None for a part, a recording or many instants at once."""
    earlier: Counts | None = None
    """The last conversion of each channel that had one before these."""

    def __repr__(self) -> str:
        span = f", {self.time[0]:.6g} to {self.time[-1]:.6g} s" if len(self) else ""
        return f"<Counts: {len(self)} conversions of {len(self.channel_names)} channels{span}>"

    def __len__(self) -> int:
        return len(self.time)

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Conversions that were out of range, shape (n,)."""
        return self.flags != 0

    def __getitem__(self, which: slice | NDArray[np.bool_] | Ints) -> Counts:
        """Some of the conversions."""
        known = {name: getattr(self, name) for name in COLUMNS}
        return Counts(
            self.channel_names, **{n: v[which] for n, v in known.items() if v is not None}
        )

    def of(self, name: str) -> Counts:
        """The conversions of one channel.

        Raises:
            ReadoutError: There is no such channel.
        """
        if name not in self.channel_names:
            raise ReadoutError(f"no channel {name!r}; {suggest(name, self.channel_names)}")
        return self[self.channel == self.channel_names.index(name)]

    def latest(self) -> dict[str, float]:
        """The last capacitance of each channel that has one [F], by name."""
        return {
            self.channel_names[k]: float(c)
            for k, c in zip(self.channel.tolist(), self.capacitance, strict=True)
        }

    def last(self) -> Counts:
        """The last conversion of each channel that has one, these and earlier ones."""
        whole = self if self.earlier is None else join([self.earlier, self])
        found = dict(zip(whole.channel.tolist(), range(len(whole)), strict=True))
        return whole[np.array(sorted(found.values()), dtype=np.int64)]

    def held(self) -> Held:
        """What a chip's registers hold: the last conversion of every channel, and its age.

        The same size at every reading, whatever has finished meanwhile, as learning wants it.
        Ages count up to the reading that these conversions came with; without one, to the last of
        them.
        """
        last, k = self.last(), len(self.channel_names)
        now = self.until if self.until is not None else last.time.max(initial=-np.inf)
        held = Held(np.zeros(k), np.zeros(k, dtype=np.int64), np.full(k, np.inf))
        held.capacitance[last.channel] = last.capacitance
        held.code[last.channel] = last.code
        held.age[last.channel] = np.maximum(now - last.time, 0.0)  # sums of times are rounded
        return held

    def table(self, what: str = "capacitance") -> tuple[Array, NDArray]:
        """Whole cycles side by side.

        Args:
            what: What stands in the cells: ``"capacitance"`` [F], ``"code"``, ``"flags"``,
                ``"baseline"`` or ``"touched"``.

        Returns:
            Time stamps [s] and cells, both of shape (cycles, K), columns in the order of the
            channels; an unfinished last cycle is left out. The conversions must start with a
            cycle, as those of a whole recording do.

        Raises:
            ReadoutError: The conversions do not start with a cycle or leave some out, or they do
                not hold ``what``.
        """
        kinds = [name for name in COLUMNS[2:] if getattr(self, name) is not None]
        if what not in kinds:
            raise ReadoutError(f"the conversions hold no {what!r}; {suggest(str(what), kinds)}")
        k = len(self.channel_names)
        shape = (len(self) // k, k)
        time, channel, cells = (
            getattr(self, name)[: shape[0] * k].reshape(shape) for name in ("time", "channel", what)
        )
        order = np.argsort(channel, axis=1)
        if (np.take_along_axis(channel, order, axis=1) != np.arange(k)).any():
            raise ReadoutError("the conversions are not whole cycles; use of(name) instead")
        return np.take_along_axis(time, order, axis=1), np.take_along_axis(cells, order, axis=1)


def join(parts: Sequence[Counts]) -> Counts:
    """Successive conversions of one readout, one after another.

    Raises:
        ReadoutError: There are no parts.
    """
    if not parts:
        raise ReadoutError("there are no counts to join; give at least one")

    def column(name: str) -> NDArray | None:
        columns = [getattr(p, name) for p in parts]
        return None if columns[0] is None else np.concatenate(columns)

    return Counts(parts[0].channel_names, *(column(n) for n in COLUMNS))  # type: ignore[arg-type]
