"""Chips of one kind side by side, one for each sensor of many, sampled together."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from capsense.errors import ReadoutError
from capsense.readout.checks import Array, require_whole
from capsense.readout.conversions import Held
from capsense.readout.readout import Readout


class _Columns:
    """Stands for the channels of all chips: there is nothing to pick from a matrix any more."""

    def __init__(self, count: int) -> None:
        self.names = tuple(map(str, range(count)))

    def __len__(self) -> int:
        return len(self.names)


class SideBySide:
    """Chips with the same channels, schedule and figures, each with noise of its own.

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
        many.bank = _Columns(k * count)  # type: ignore[assignment]
        first = k * np.arange(count)
        many.schedule = replace(
            readout.schedule,
            slots=tuple(
                tuple((np.array(slot) + first[:, None]).ravel().tolist())
                for slot in readout.schedule.slots
            ),
        )
        many._mixing, many._offset = None, np.zeros(k * count)
        self._many = many
        self.reset(seed=seed)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of a chip's channels."""
        return self._one.channel_names

    def reset(self, *, start: float = 0.0, seed: int | None = None) -> None:
        """Switch all chips on anew, see :meth:`Readout.reset`."""
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
        held, shape = self._many.sample(time, values.ravel()).held(), values.shape
        return Held(
            held.capacitance.reshape(shape), held.code.reshape(shape), held.age.reshape(shape)
        )
