"""Many environments at once: arrays of poses in, arrays of matrices out."""

from capsense.fleet.bodies import FleetCheck, FleetReading
from capsense.fleet.fleet import Fleet

__all__ = ["Fleet", "FleetCheck", "FleetReading"]
