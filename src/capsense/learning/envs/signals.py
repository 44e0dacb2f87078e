"""What a policy gets of capacitive sensors: numbers of fixed size, through their readouts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from capsense.learning.settle import settled, settling
from capsense.reading import Reading
from capsense.readout.readout import SEED_STRIDE, Readout

UNIT = 10e-15
"""Changes of capacitance are given in this unit [F]."""
LIMIT = 100.0
"""Numbers are held within ± this."""
TARES = 16
"""Conversions of a channel that its zero is the mean of."""
_OLDEST = 1.0
"""Ages are held below this [s]."""


class Signals:
    """The registers of the chips of several sensors.

    Args:
        readouts: The readout of each sensor, by name.
    """

    def __init__(self, readouts: Mapping[str, Readout]) -> None:
        self.readouts = dict(readouts)
        self.tare: dict[str, NDArray[np.float64]] = {}
        """Zero of every channel [F], by sensor."""

    def reset(
        self, time: float, seed: int, tare: Mapping[str, Reading], now: Mapping[str, Reading]
    ) -> None:
        """Switch the chips on, with a scene at hand that is their zero, as anybody would do.

        The zero is the mean of :data:`TARES` conversions of each channel.

        Args:
            time: The simulator's time [s]; the chips have settled on the tare before it.
            seed: Of all noise.
            tare: Readings of that scene, by sensor.
            now: Readings of the scene that stands before the sensors from then on.
        """
        for number, (name, chip) in enumerate(self.readouts.items()):
            wait = settling(chip)
            begun = time - 3 * wait - TARES * chip.schedule.period
            chip.reset(start=begun, seed=seed + number * SEED_STRIDE)
            settled(chip, tare[name], begun)
            told = begun + wait + TARES * chip.schedule.period
            counts = chip.sample(told, tare[name])
            sums = np.bincount(counts.channel, counts.capacitance)
            self.tare[name] = sums / np.bincount(counts.channel)
            settled(chip, now[name], told)

    @property
    def names(self) -> tuple[str, ...]:
        """What the numbers of :meth:`read` are called."""
        return tuple(
            f"{name}.{channel}{what}"
            for name, chip in self.readouts.items()
            for what in ("", ".age")
            for channel in chip.channel_names
        )

    @property
    def limits(self) -> NDArray[np.float32]:
        """No number of :meth:`read` is further from zero than this, shape (size,)."""
        most = [_OLDEST if name.endswith(".age") else LIMIT for name in self.names]
        return np.array(most, np.float32)

    def read(self, time: float, now: Mapping[str, Reading]) -> NDArray[np.float32]:
        """Of each sensor: change of every channel since the tare [10 fF], then their ages [s].

        Args:
            time: The simulator's time [s].
            now: What the sensors read at it.
        """
        out = []
        for name, chip in self.readouts.items():
            held = chip.sample(time, now[name]).held()
            change = (held.capacitance - self.tare[name]) / UNIT
            out += [np.clip(change, -LIMIT, LIMIT), np.minimum(held.age, _OLDEST)]
        return np.concatenate(out).astype(np.float32)
