"""Scenarios: a sensor, bodies that move in front of it, and how they are sampled."""

from capsense.scenario.bodies import (
    MAX_FORCE,
    ScenarioTable,
    read_bodies,
    read_body,
    read_grounding,
    read_material,
    read_pose,
)
from capsense.scenario.files import (
    load_scenario,
    parse_scenario,
    read_design,
)
from capsense.scenario.model import (
    FORMER_METHODS,
    METHODS,
    Channel,
    Excitation,
    MovingBody,
    Sample,
    Scenario,
    Trajectory,
    play,
)

__all__ = [
    "FORMER_METHODS",
    "MAX_FORCE",
    "METHODS",
    "Channel",
    "Excitation",
    "MovingBody",
    "Sample",
    "Scenario",
    "ScenarioTable",
    "Trajectory",
    "load_scenario",
    "parse_scenario",
    "play",
    "read_bodies",
    "read_body",
    "read_design",
    "read_grounding",
    "read_material",
    "read_pose",
]
