"""Vectorised environments as Stable-Baselines3 takes them; needs ``capsense[train]``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from capsense.errors import MissingDependencyError

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    raise MissingDependencyError(
        "this wrapper needs Stable-Baselines3; pip install 'capsense[train]'"
    ) from None


class SB3VecEnv(VecEnv):
    """A vectorised environment of Gymnasium's, such as those of CapSense, for Stable-Baselines3.

    Episodes begin again in the same step, as Stable-Baselines3 expects. The last observation of an
    episode is ``terminal_observation`` among its facts, and ``TimeLimit.truncated`` tells whether
    the episode was cut.

    Args:
        envs: An environment with ``autoreset_mode="SameStep"``.

    Raises:
        ValueError: It begins new episodes in another way.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        require_same_step(envs)
        self.envs = envs
        """The environment that is wrapped."""
        self.render_mode = envs.render_mode
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self.metadata = envs.metadata

    def reset(self) -> NDArray[Any]:
        """Begin all episodes, with the seeds that were set last; each is used once."""
        seeds: Any = None if all(s is None for s in self._seeds) else list(self._seeds)
        observation, facts = self.envs.reset(seed=seeds)
        self.reset_infos = facts_of_each(facts, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observation

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of the next step."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], list[dict[str, Any]]]:
        """Observations, rewards, whether episodes ended, and facts of each."""
        observation, rewards, over, cut, facts = self.envs.step(self._actions)
        ended, last = over | cut, facts.pop("final_obs", None)
        final = facts.pop("final_info", {})
        told, finals = (facts_of_each(f, self.num_envs) for f in (facts, final))
        for k in np.flatnonzero(ended).tolist():
            self.reset_infos[k] = told[k]
            told[k] = {**finals[k], "terminal_observation": last[k],
                       "TimeLimit.truncated": bool(cut[k] and not over[k])}  # fmt: skip
        return observation, rewards.astype(np.float32), ended, told

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()

    def get_images(self) -> Sequence[Any]:
        """A picture of each environment."""
        pictures = self.envs.render()
        return [None] * self.num_envs if pictures is None else list(pictures)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the vectorised environment, once for each environment asked."""
        value = getattr(self.envs, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the vectorised environment, of all environments at once.

        Raises:
            ValueError: Some environments are named, which cannot have attributes of their own.
        """
        if indices is not None:
            raise ValueError(f"indices is {indices!r}; leave it out: attributes are those of all")
        setattr(self.envs, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vectorised environment once; its result for each one asked."""
        value = getattr(self.envs, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Whether environments are wrapped, each by itself: never."""
        return [False for _ in self._get_indices(indices)]


def require_same_step(envs: VectorEnv[Any, Any, Any]) -> None:
    """Refuse environments that begin new episodes at the next step.

    Raises:
        ValueError: They do.
    """
    mode = envs.metadata.get("autoreset_mode")
    if mode != AutoresetMode.SAME_STEP:
        raise ValueError(
            f"envs begin new episodes by {mode}; make them with autoreset_mode='SameStep'"
        )


def facts_of_each(facts: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Facts of vectorised environments, of each environment by itself."""
    out: list[dict[str, Any]] = [{} for _ in range(count)]
    for name, values in facts.items():
        if name.startswith("_"):
            continue
        for k in np.flatnonzero(facts.get(f"_{name}", np.ones(count, np.bool_))).tolist():
            out[k][name] = values[k]
    return out
