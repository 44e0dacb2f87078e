"""Many chips at once."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capsense.errors import ReadoutError
from capsense.readout.checks import Array, require_whole
from capsense.readout.conversions import Held, _Columns
from capsense.readout.readout import Readout


class SideBySide:
    """Chips of one kind, one for each sensor of many, each with noise of its own.

    They are switched on together, so that a channel is sampled at the same instant by all. One
    conversion of all chips is as much work for Python as one of a single chip.

    Args:
        readout: A readout of one sensor with K channels; it stays as it is.
        count: How many chips, N.
        seed: Of all random numbers.

    Raises:
        ReadoutError: A number is out of range.
    """

    def __init__(self, readout: Readout, count: int, *, seed: int = 0) -> None:
        require_whole("readout", "the number of chips", count, 1)
        self._one, self._count = readout, count
        k = len(readout.bank)
        many = copy.copy(readout)
        many.bank = _Columns(readout.bank.differences, count)  # type: ignore[assignment]
        many._sensors = count
        slots = tuple(
            tuple(k * chip + channel for chip in range(count) for channel in slot)
            for slot in readout.schedule.slots
        )
        many.schedule = replace(readout.schedule, slots=slots)
        many._mixing, many._offset = None, np.zeros(k * count)
        self._many = many
        self.reset(seed=seed)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of a chip's channels."""
        return self._one.channel_names

    def reset(self, *, start: float = 0.0, seed: int | None = None) -> None:
        """Switch all chips on anew, see :meth:`~capsense.readout.Readout.reset`."""
        self._many.reset(start=start, seed=seed)

    def sample(
        self, time: float, capacitance: NDArray[np.floating], shield_coupling: Array | None = None
    ) -> Held:
        """Tell the capacitances of an instant; get what the chips' registers hold.

        Args:
            time: [s], not before the last call's.
            capacitance: Maxwell matrices [F], shape (N, M, M), or with more axes in front, N in
                all.
            shield_coupling: Charge on each electrode per volt on all shields together [F], shape
                (..., M); None where there are no shields.

        Returns:
            The last conversion of every channel, each of shape (..., K), and its age.

        Raises:
            ReadoutError: Time goes back or is not finite, or the capacitances do not fit.
        """
        values = self._one._wired(self._one.bank.values(np.asarray(capacitance), shield_coupling))
        if values.size != len(self._many.bank):
            raise ReadoutError(
                f"capacitance has shape {np.shape(capacitance)}; give matrices of {self._count} "
                "sensors"
            )
        held = self._many.sample(time, values.ravel()).held()
        return Held(*(column.reshape(values.shape) for column in vars(held).values()))
