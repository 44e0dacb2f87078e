"""How much somebody may do: some at once, and so much a second."""

from __future__ import annotations

import time


class Allowance:
    """A token bucket that can be overdrawn.

    Args:
        most: What can be spent at once, after a rest.
        rate: What comes back a second.
        first: What can be spent at the start; by default ``most``.
    """

    def __init__(self, most: float, rate: float, first: float | None = None) -> None:
        self.most, self.rate = most, rate
        self._left = most if first is None else first
        self._counted = time.monotonic()

    def spend(self, cost: float) -> float:
        """Spend some, and return what is left: below zero, more was spent than there was."""
        now = time.monotonic()
        regained = (now - self._counted) * self.rate
        self._counted = now
        self._left = min(self.most, self._left + regained) - cost
        return self._left
