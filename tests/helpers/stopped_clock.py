"""A clock that stands still until it is set."""

from __future__ import annotations


class StoppedClock:
    """Stands in for the module ``time``."""

    now = 100.0
    """[s]."""

    def monotonic(self) -> float:
        """The time [s]."""
        return self.now
