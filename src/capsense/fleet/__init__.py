"""Many environments at once: arrays of poses in, arrays of matrices out."""

from capsense.fleet.check import FleetCheck
from capsense.fleet.fleet import Fleet
from capsense.reading import FleetReading, FleetTouch

__all__ = ["Fleet", "FleetCheck", "FleetReading", "FleetTouch"]
