"""What a policy gets of capacitive sensors: numbers of fixed size, through their readouts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.skin import AttachedSkin
from capsense.learning.settle import settled, settling
from capsense.reading import Reading
from capsense.readout.readout import SEED_STRIDE, Readout

UNIT = 10e-15
"""Changes of capacitance are given in this unit [F]."""
LIMIT = 100.0
"""Numbers are held within ± this."""
_OLDEST = 1.0
"""Ages are held below this [s]."""


class Signals:
    """The registers of all chips of a skin.

    Args:
        skin: Sensors without readouts of their own.
        readouts: The readout of each, by name.
    """

    def __init__(self, skin: AttachedSkin, readouts: Mapping[str, Readout]) -> None:
        self.skin, self.readouts = skin, dict(readouts)
        self._tare: dict[str, NDArray[np.float64]] = {}

    def reset(self, time: float, seed: int, tare: Mapping[str, Reading]) -> None:
        """Switch the chips on, with a scene at hand that is their zero, as anybody would do.

        Args:
            time: The simulator's time [s]; the chips have settled on the tare before it.
            seed: Of all noise.
            tare: Readings of that scene, by sensor.
        """
        now = self._now()
        for number, (name, chip) in enumerate(self.readouts.items()):
            start = time - 3 * settling(chip)
            chip.reset(start=start, seed=seed + number * SEED_STRIDE)
            self._tare[name] = settled(chip, tare[name], start).capacitance
            settled(chip, now[name], start + settling(chip))

    @property
    def limits(self) -> NDArray[np.float32]:
        """No number of :meth:`read` is further from zero than this, shape (size,)."""
        sizes = [len(r.channel_names) for r in self.readouts.values()]
        parts = [part for k in sizes for part in (np.full(k, LIMIT), np.full(k, _OLDEST))]
        return np.concatenate(parts).astype(np.float32)

    def read(self, time: float) -> NDArray[np.float32]:
        """Of each sensor: change of every channel since the tare [10 fF], then their ages [s]."""
        out, now = [], self._now()
        for name, chip in self.readouts.items():
            held = chip.sample(time, now[name]).held()
            change = (held.capacitance - self._tare[name]) / UNIT
            out += [np.clip(change, -LIMIT, LIMIT), np.minimum(held.age, _OLDEST)]
        return np.concatenate(out).astype(np.float32)

    def _now(self) -> Mapping[str, Reading]:
        return self.skin.read()
