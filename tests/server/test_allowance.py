"""Token buckets: some at once, and so much a second."""

from __future__ import annotations

from approximate import approx
from stopped_clock import StoppedClock

from capsense.server.connection import Allowance


def test_spends_what_is_there_and_what_comes_back(clock: StoppedClock) -> None:
    """Overdrawn, it is paid back first; a rest never fills it beyond its brim."""
    bucket = Allowance(10, 5)
    assert bucket.spend(4) == 6
    assert bucket.spend(8) == -2
    clock.now += 1
    assert bucket.spend(1) == 2
    clock.now += 1e6
    assert bucket.spend(0) == 10
    bucket.rate = 100
    bucket.spend(10)
    clock.now += 0.05
    assert bucket.spend(0) == approx(5)


def test_what_is_there_at_first(clock: StoppedClock) -> None:
    """A newcomer has less than one who rests."""
    bucket = Allowance(10, 5, first=1)
    assert bucket.spend(0) == 1
    clock.now += 10
    assert bucket.spend(0) == 10
