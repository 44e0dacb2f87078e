"""What lies between electrodes and converter: traces, cable, shield, crosstalk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, finite, per_channel


@dataclass(frozen=True)
class Wiring:
    """Parasitics, as they change the capacitances of all channels at an instant.

    A self measurement charges what its lead has to ground; a mutual one does not see that, but
    what the receiver's lead has to the transmitter's:

        ``y_k = c_k + Σ_l crosstalk_kl c_l + (ground_k or coupling_k)``,
        ``ground_k = trace_k + (1 − shield_gain) cable_k``.

    A cable whose shield is driven with the signal counts only as far as the shield's driver falls
    short of a gain of one. What a mutual channel's receiver has to ground loads its shunt, if it
    has one: :attr:`~capsense.readout.front_end.ShuntFrontEnd.parasitic`.
    """

    trace: Any = 0.0
    """Capacitance of traces and pins to ground [F]: a number, or one per channel."""
    cable: Any = 0.0
    """Capacitance from the cable's core to its shield [F]: a number, or one per channel."""
    shield_gain: float = 0.0
    """Gain of the driven shield: 0 for a grounded one, 1 for a perfect driver."""
    crosstalk: Any = 0.0
    """Share of each other channel that is added: a number, or a matrix of shape (K, K)."""
    coupling: Any = 0.0
    """Capacitance between the leads of transmitter and receiver [F]: a number, or one per
    channel."""

    def ground(self, channels: int) -> Array:
        """Capacitance of each channel's lead to ground [F], shape (K,).

        Raises:
            ReadoutError: A size does not fit the channels, a number is negative or not finite,
                or the shield's gain is not between 0 and 1.
        """
        if not 0.0 <= as_number(self.shield_gain) <= 1.0:
            raise ReadoutError(
                f"wiring: shield_gain is {self.shield_gain!r}; give a number from 0 to 1"
            )
        trace, cable = self._capacitances("trace", channels), self._capacitances("cable", channels)
        return trace + (1.0 - self.shield_gain) * cable

    def start(self, is_self: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Mixing matrix and offsets of channels.

        Args:
            is_self: Which channels are self measurements, shape (K,).

        Returns:
            The matrix, shape (K, K), and offsets [F], shape (K,).

        Raises:
            ReadoutError: As of :meth:`ground`.
        """
        channels = len(is_self)
        share = finite("wiring: crosstalk", self.crosstalk)
        if share.shape not in ((), (channels, channels)):
            raise ReadoutError(
                f"wiring: crosstalk is {self.crosstalk!r}; give a number, or {channels} lists of "
                f"{channels}"
            )
        mixing = np.array(np.broadcast_to(share, (channels, channels)))
        if share.shape == ():
            np.fill_diagonal(mixing, 0.0)
        coupling = self._capacitances("coupling", channels)
        return mixing + np.eye(channels), np.where(is_self, self.ground(channels), coupling)

    def _capacitances(self, name: str, channels: int) -> Array:
        values = per_channel("wiring", name, getattr(self, name), channels)
        if (values < 0).any():
            raise ReadoutError(f"wiring: {name} holds {values.min():g} F; give zero or more")
        return values
