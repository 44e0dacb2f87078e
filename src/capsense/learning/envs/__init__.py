"""Environments for Gymnasium; importing this module registers them.

``gymnasium.make("capsense.learning.envs:capsense/LimbFollow-v0")`` imports it by itself. The tasks
are to follow a limb, to take a sleeve along an arm, and to keep off a person, in MuJoCo; and to do
what is right before a person or a piece of metal, for which no physics engine is needed.
"""

from __future__ import annotations

from capsense.errors import MissingDependencyError

try:
    import mujoco
    from gymnasium.envs.registration import register, registry
except ImportError:
    raise MissingDependencyError(
        "environments need Gymnasium and MuJoCo; pip install 'capsense[gym]'"
    ) from None

from capsense.learning.envs.tasks import GAP, LOST, ApproachStop, Dressing, LimbFollow, across
from capsense.learning.envs.who import WhoIsThere

__all__ = [
    "GAP", "IDS", "LOST", "ApproachStop", "Dressing", "LimbFollow", "WhoIsThere", "across",
    "register_all",
]  # fmt: skip

IDS = {
    "capsense/LimbFollow-v0": ("LimbFollow", 250),
    "capsense/Dressing-v0": ("Dressing", 400),
    "capsense/ApproachStop-v0": ("ApproachStop", 300),
    "capsense/WhoIsThere-v0": ("WhoIsThere", 30),
}
"""Name → its class, and the steps of an episode at most."""


def register_all() -> None:
    """Register what is not registered yet.

    It is the package's entry point in the group ``gymnasium.envs``. Gymnasium before 1.0 and
    other tools call those of installed packages; Gymnasium from 1.0 on does not.
    """
    for name, (kind, steps) in IDS.items():
        if name not in registry:
            module = "who" if kind == "WhoIsThere" else "vector"
            register(
                name, f"{__name__}:{kind}", max_episode_steps=steps,
                vector_entry_point=f"{__name__}.{module}:{kind}Vector",
            )  # fmt: skip


register_all()
