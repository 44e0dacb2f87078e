"""The chips of a fleet's sensors: of one kind, or each sensor with its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from capsense.readout import SEED_STRIDE, Readout
from capsense.readout.checks import Ints
from capsense.readout.conversions import Held
from capsense.readout.randomisation import FIGURES, ReadoutRandomisation


class ChipsOfSensors:
    """Chips of which every sensor has its own kind, with as many channels.

    Args:
        readouts: One for each sensor.
        make: Makes the chips of a sensor in all environments, by its number and readout.
        seed: Of the first sensor; by default the readouts' own. Those of others lie apart.
        start: When they are switched on [s].
        randomisation: Of all sensors; by default none.
        registers: What the chips hold, shape (e, s, K), if each writes its own part there.
    """

    def __init__(
        self, readouts: Sequence[Readout], make: Callable[..., Any], *, seed: int | None,
        start: ArrayLike, randomisation: ReadoutRandomisation | None, registers: Held | None = None,
    ) -> None:  # fmt: skip
        self._registers = registers
        wanted = randomisation or ReadoutRandomisation()
        self._parts: list[Any] = []
        for number, readout in enumerate(readouts):
            own = (readout.seed if seed is None else seed) + number * SEED_STRIDE
            part = wanted.of_sensor(number, len(readouts))
            self._parts.append(make(number, readout, seed=own, start=start, randomisation=part))

    @property
    def drawn(self) -> ReadoutRandomisation:
        """As of :class:`ManyChips`."""
        parts = [part.drawn for part in self._parts]
        return ReadoutRandomisation(
            **{name: np.concatenate([getattr(p, name) for p in parts], axis=1) for name in FIGURES}
        )

    def reset(self, rows: Ints, *, start: ArrayLike | None, seed: int | None) -> None:
        """As of :class:`ManyChips`."""
        for number, part in enumerate(self._parts):
            own = None if seed is None else seed + number * SEED_STRIDE
            part.reset(rows, start=start, seed=own)

    def clock(self, time: Any, due: Any = None) -> Any:
        """As of :class:`ManyChips`."""
        for part in self._parts:
            time = part.clock(time, due)
        return time

    def sample(self, time: Any, matrix: Any, shields: Any, due: Any = None) -> Held:
        """As of the chips of either device."""
        found = []
        for k, part in enumerate(self._parts):
            own = (None if x is None else x[:, k : k + 1] for x in (matrix, shields))
            found.append(part.sample(time, *own, due))
        if self._registers is not None:
            return self._registers
        columns = zip(*(vars(held).values() for held in found), strict=True)
        return Held(*(np.concatenate(column, axis=1) for column in columns))
