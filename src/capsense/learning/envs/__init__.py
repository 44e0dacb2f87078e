"""Environments for Gymnasium, in MuJoCo; importing this module registers them.

``gymnasium.make("capsense.learning.envs:capsense/LimbFollow-v0")`` imports it by itself.
The three tasks are to follow a limb, to take a sleeve along an arm, and to keep off a person.
"""

from __future__ import annotations

from capsense.errors import MissingDependencyError

try:
    import mujoco
    from gymnasium.envs.registration import register
except ImportError:
    raise MissingDependencyError(
        "environments need Gymnasium and MuJoCo; pip install 'capsense[gym]'"
    ) from None

from capsense.learning.envs.tasks import GAP, LOST, ApproachStop, Dressing, LimbFollow, across

__all__ = ["GAP", "IDS", "LOST", "ApproachStop", "Dressing", "LimbFollow", "across"]

IDS = {
    "capsense/LimbFollow-v0": ("LimbFollow", 250),
    "capsense/Dressing-v0": ("Dressing", 400),
    "capsense/ApproachStop-v0": ("ApproachStop", 300),
}
"""Name → its class, and the steps of an episode at most."""

for _name, (_class, _steps) in IDS.items():
    register(
        _name, f"{__name__}:{_class}", max_episode_steps=_steps,
        vector_entry_point=f"{__name__}.vector:{_class}Vector",
    )  # fmt: skip
