"""What a readout reports: integer codes with time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints

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
        return Counts(
            self.channel_names, self.time[which], self.channel[which], self.code[which],
            self.capacitance[which], self.flags[which],
            None if self.baseline is None else self.baseline[which],
            None if self.touched is None else self.touched[which],
        )  # fmt: skip

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
