"""What a readout's registers hold once a scene has stood still for long enough."""

from __future__ import annotations

from capsense.reading import Reading
from capsense.readout.conversions import Held
from capsense.readout.readout import Readout


def settling(readout: Readout) -> float:
    """Time after which every channel has reported what it sees now [s]."""
    return 2 * readout.schedule.period + readout.schedule.lag


def settled(readout: Readout, reading: Reading, start: float) -> Held:
    """The registers after a reading has stood from ``start`` [s] for the time of settling."""
    readout.sample(start, reading)
    return readout.sample(start + settling(readout), reading).held()
