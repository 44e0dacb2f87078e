"""Many environments at once: arrays of poses in, arrays of matrices out."""

from capsense.fleet.fleet import Fleet
from capsense.fleet.reading import FleetCheck, FleetReading

__all__ = ["Fleet", "FleetCheck", "FleetReading"]
