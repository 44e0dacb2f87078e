"""Environments for Gymnasium, in MuJoCo; importing this module registers them.

With the package installed, ``gymnasium.make("capsense/LimbFollow-v0")`` finds them by itself.
"""

from __future__ import annotations

from capsense.errors import MissingDependencyError

try:
    import gymnasium
    import mujoco  # noqa: F401
    from gymnasium.envs.registration import register as _register
except ImportError as error:
    raise MissingDependencyError(
        f"environments need {error.name}; pip install 'capsense[gym]'"
    ) from None

IDS = {
    "capsense/LimbFollow-v0": ("follow:LimbFollow", 250),
    "capsense/Dressing-v0": ("dressing:Dressing", 400),
    "capsense/ApproachStop-v0": ("approach:ApproachStop", 300),
}
"""Name → its class, and the steps of an episode at most."""


def register() -> None:
    """Tell Gymnasium of the environments that it does not know yet."""
    for name, (where, steps) in IDS.items():
        if name not in gymnasium.envs.registration.registry:
            _register(name, f"capsense.learning.envs.{where}", max_episode_steps=steps)


register()
