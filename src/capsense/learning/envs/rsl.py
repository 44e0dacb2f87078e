"""Vectorised environments as rsl_rl takes them; needs ``capsense[rsl-rl]``."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from capsense.errors import MissingDependencyError

try:
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError:
    raise MissingDependencyError(
        "this wrapper needs rsl_rl, PyTorch and tensordict; pip install 'capsense[rsl-rl]'"
    ) from None


class RslVecEnv(VecEnv):
    """A vectorised environment of Gymnasium's, such as those of CapSense, for rsl_rl from 5 on.

    Observations are one group, ``"policy"``. Facts of a step that are single numbers go to the
    log, as means. Actions beyond ±1 are cut by the environments.

    Args:
        envs: An environment with ``autoreset_mode="SameStep"``.
        max_episode_length: Steps of an episode at most, by default what the environment's
            specification says; where rsl_rl begins with episodes at random ages.
        device: Where tensors are.
        seed: Of the first environment.

    Raises:
        ValueError: It begins new episodes in another way, or has no limit of steps.
    """

    def __init__(
        self, envs: VectorEnv[Any, Any, Any], *, max_episode_length: int | None = None,
        device: str = "cpu", seed: int | None = None,
    ) -> None:  # fmt: skip
        mode = envs.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                f"envs begin new episodes by {mode}; make them with autoreset_mode='SameStep'"
            )
        limit = max_episode_length or getattr(envs.spec, "max_episode_steps", None)
        if limit is None:
            raise ValueError("envs have no limit of steps; give max_episode_length")
        self.envs, self.cfg = envs, {"seed": seed}
        self.num_envs, self.device = envs.num_envs, device
        self.num_actions = int(np.prod(envs.single_action_space.shape or ()))
        self.max_episode_length = limit
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=device)
        self._now, _ = envs.reset(seed=seed)

    def get_observations(self) -> TensorDict:
        """What was observed last, shape (num_envs, size) in the group ``"policy"``."""
        now = torch.as_tensor(self._now, dtype=torch.float32, device=self.device)
        return TensorDict({"policy": now}, batch_size=[self.num_envs], device=self.device)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Begin all episodes."""
        self._now, _ = self.envs.reset()
        self.episode_length_buf.zero_()
        return self.get_observations(), {}

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Observations, rewards, whether episodes ended, and what rsl_rl wants besides."""
        told = actions.detach().cpu().numpy().astype(np.float32)
        self._now, rewards, over, cut, facts = self.envs.step(told)
        ended = torch.as_tensor(over | cut, device=self.device)
        self.episode_length_buf += 1
        self.episode_length_buf[ended] = 0
        log = {
            f"/{name}": float(np.mean(np.asarray(values, float)))
            for name, values in facts.items()
            if not name.startswith("_") and np.asarray(values).dtype.kind in "bif"
        }
        extras = {"time_outs": torch.as_tensor(cut & ~over, device=self.device), "log": log}
        reward = torch.as_tensor(rewards, dtype=torch.float32, device=self.device)
        return self.get_observations(), reward, ended, extras

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()
