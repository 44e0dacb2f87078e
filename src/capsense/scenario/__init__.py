"""Scenarios: a sensor, bodies that move in front of it, and how they are sampled."""

from capsense.scenario.loader import load_scenario, parse_scenario
from capsense.scenario.model import (
    Channel,
    Excitation,
    MovingBody,
    Sample,
    Scenario,
    Trajectory,
    play,
)
