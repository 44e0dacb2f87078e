"""Many environments at once: arrays of poses in, arrays of matrices out."""

from capsense.fleet.fleet import Fleet, FleetCheck, FleetReading

__all__ = ["Fleet", "FleetCheck", "FleetReading"]
