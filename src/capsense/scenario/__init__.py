"""Scenarios: a sensor, bodies that move in front of it, and how they are sampled."""

from capsense.scenario.channels import Channel, Excitation
from capsense.scenario.loader import load_scenario, parse_scenario
from capsense.scenario.model import MovingBody, Scenario
from capsense.scenario.play import Sample, play
from capsense.scenario.trajectory import Trajectory

__all__ = [
    "Channel",
    "Excitation",
    "MovingBody",
    "Sample",
    "Scenario",
    "Trajectory",
    "load_scenario",
    "parse_scenario",
    "play",
]
