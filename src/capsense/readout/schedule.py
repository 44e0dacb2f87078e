"""Schedules: which channel is sampled when.

Time runs in cycles. A cycle is a row of slots, one after another; the channels of a slot are
converted at the same time. A conversion is an average over its window. For a world that moves
evenly that is the value at the middle of the window, which is therefore the channel's *instant*;
the result can be read at the end of the window, or a latency later: the sample's *time stamp*. The
neglected term is T²/24 times the second derivative of the capacitance, T being the conversion time.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
        require("schedule", "gap", self.gap, 0.0, "s")
        require("schedule", "idle", self.idle, 0.0, "s")
        require("schedule", "latency", self.latency, 0.0, "s")
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
        require("schedule", "conversion", conversion, 0.0, "s", open_=True)
        require("schedule", "gap", gap, 0.0, "s")
        slots = tuple(
            tuple(range(first, channels, per_chip)) for first in range(min(per_chip, channels))
        )
        return cls(slots, conversion, gap, idle_of(period, len(slots) * (conversion + gap)))

    @classmethod
    def simultaneous(
        cls, channels: int, conversion: float, *, period: float | None = None
    ) -> Schedule:
        """All channels at once, every ``period`` [s], by default back to back.

        Raises:
            ReadoutError: As of :meth:`sequential`.
        """
        require_whole("schedule", "the number of channels", channels, 1)
        require("schedule", "conversion", conversion, 0.0, "s", open_=True)
        return cls((tuple(range(channels)),), conversion, 0.0, idle_of(period, conversion))

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
