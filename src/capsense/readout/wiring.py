"""What lies between electrodes and converter: traces, cable, shield, crosstalk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from capsense.errors import ReadOutError
from capsense.readout.stage import Array, per_channel


@dataclass(frozen=True)
class Wiring:
    """Parasitics, as they change the capacitances of all channels at an instant.

    ``y_k = c_k + Σ_l crosstalk_kl c_l + trace_k + (1 − shield_gain) cable_k``

    A cable whose shield is driven with the signal counts only as far as the shield's driver falls
    short of a gain of one.
    """

    trace: Any = 0.0
    """Capacitance of traces and pins to ground [F]: a number, or one per channel."""
    cable: Any = 0.0
    """Capacitance from the cable's core to its shield [F]: a number, or one per channel."""
    shield_gain: float = 0.0
    """Gain of the driven shield: 0 for a grounded one, 1 for a perfect driver."""
    crosstalk: Any = 0.0
    """Share of each other channel that is added: a number, or a matrix of shape (K, K)."""

    def start(self, channels: int) -> tuple[Array, Array]:
        """Return mixing matrix, shape (K, K), and offsets [F], shape (K,).

        Raises:
            ReadOutError: A size does not fit the channels, a number is not finite, or the
                shield's gain is not between 0 and 1.
        """
        if not 0.0 <= self.shield_gain <= 1.0:
            raise ReadOutError(
                f"wiring: shield_gain is {self.shield_gain!r}; give a number from 0 to 1"
            )
        trace = per_channel("wiring", "trace", self.trace, channels)
        cable = per_channel("wiring", "cable", self.cable, channels)
        share = np.asarray(self.crosstalk, dtype=float)
        if share.shape not in ((), (channels, channels)) or not np.isfinite(share).all():
            raise ReadOutError(
                f"wiring: crosstalk is {self.crosstalk!r}; give a number, or {channels} lists of "
                f"{channels}"
            )
        mixing = np.array(np.broadcast_to(share, (channels, channels)))
        if share.shape == ():
            np.fill_diagonal(mixing, 0.0)
        return mixing + np.eye(channels), trace + (1.0 - self.shield_gain) * cable
