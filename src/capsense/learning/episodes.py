"""Data sets of episodes: rollouts of an environment of Gymnasium, written as LeRobot reads them."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from capsense._validate import read_toml
from capsense.errors import ScenarioError
from capsense.learning import lerobot
from capsense.learning.shards import DataSet, files_named
from capsense.scenario.loader import ScenarioTable

Array = NDArray[Any]
Policy = Callable[[Array], Array]

TOP_KEYS = (
    "name", "description", "environment", "options", "episodes", "shard_size", "seed", "steps",
    "policy", "noise", "task",
)  # fmt: skip
RANDOM = "random"
"""The policy that draws from the space of actions."""
_FORMAT = 1
"""Goes up when the same file comes to mean other episodes or columns."""


@dataclass(frozen=True, eq=False)
class Episodes(DataSet):
    """A data set of episodes as its file describes it; made by :func:`load_episodes`."""

    unit = "episodes"
    environment: str
    """Its name at Gymnasium."""
    options: Mapping[str, Any]
    """What it is made with."""
    steps: int | None
    """Steps of an episode at most; None for what the environment says."""
    policy: str
    """``"random"``, or ``"FILE.py:FUNCTION"``, a function from observations to actions."""
    noise: float
    """Rms of the Gaussian noise that is added to actions."""
    task: str
    """What is done, in words."""

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All that the numbers depend on, but for versions; contents of files by their SHA-256."""
        return {
            "format": _FORMAT, "environment": self.environment, "options": dict(self.options),
            "episodes": self.count, "shard_size": self.shard_size, "seed": self.seed,
            "steps": self.steps, "policy": self.policy, "noise": self.noise, "task": self.task,
            "files": files_named([self.policy.partition(":")[0]], self.folder),
        }  # fmt: skip

    def file(self, shard: int) -> str:
        """LeRobot's names."""
        return lerobot.place(shard)

    def table(self, shard: int) -> Any:
        """The frames of a shard; see :func:`capsense.learning.lerobot.frames`."""
        env, policy = self.make(), self._policy()
        features, rate = described(env)
        episodes = {k: self._episode(k, env, policy, features) for k in self.numbers(shard)}
        env.close()
        return lerobot.frames(features, episodes, rate)

    def about(self) -> dict[str, Any]:
        """Rate and columns."""
        env = self.make()
        features, rate = described(env)
        env.close()
        return {"fps": rate, "features": features}

    def finish(self, folder: Path) -> None:
        """Number the frames through, and write LeRobot's ``meta/``."""
        told = self.about()
        lerobot.numbered(folder, self.shards)
        lerobot.write_meta(folder, self.name, told["features"], told["fps"], self.task, self.shards)

    def make(self) -> Any:
        """The environment.

        Raises:
            ScenarioError: There is none of this name, it takes no such options, its spaces are no
                boxes, or its episodes need not end.
            MissingDependencyError: Gymnasium or MuJoCo is not installed.
        """
        import gymnasium

        import capsense.learning.envs  # noqa: F401, it registers them

        limit = {} if self.steps is None else {"max_episode_steps": self.steps}
        try:
            env = gymnasium.make(self.environment, **limit, **self.options)  # type: ignore[arg-type]
        except (gymnasium.error.Error, TypeError, ImportError) as error:
            raise self._error(f"environment {self.environment!r} cannot be made: {error}") from None
        for what, space in (("observations", env.observation_space), ("actions", env.action_space)):
            if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
                raise self._error(f"{what} of {self.environment} are {space}; a row of numbers, "
                                  "Box of shape (n,), is needed")  # fmt: skip
        if env.spec is None or env.spec.max_episode_steps is None:
            raise self._error(f"episodes of {self.environment} need not end; give steps = N")
        if not env.unwrapped.metadata.get("render_fps"):
            raise self._error(f"{self.environment} does not tell its rate, metadata['render_fps']")
        return env

    def _policy(self) -> Policy | None:
        """The function that acts; None for random actions.

        Raises:
            ScenarioError: There is no such file or function.
        """
        if self.policy == RANDOM:
            return None
        file, _, name = self.policy.partition(":")
        path = self.folder / file
        if not name or not path.is_file():
            raise self._error(f'policy = "{self.policy}" must be "random" or "FILE.py:FUNCTION" '
                              f"with a file in {self.folder}")  # fmt: skip
        found = runpy.run_path(str(path)).get(name)
        if not callable(found):
            raise self._error(f"policy: {file} has no function {name!r}")
        policy: Policy = found
        return policy

    def _episode(
        self, number: int, env: Any, policy: Policy | None, features: lerobot.Features
    ) -> dict[str, Array]:
        """An episode, which depends on the settings and its number alone."""
        rng = np.random.default_rng(np.random.SeedSequence((self.seed, number)))
        observation, _ = env.reset(seed=int(rng.integers(2**31)))
        rows: dict[str, list[Any]] = {n: [] for n in features if n not in lerobot.NUMBERED}
        over = cut = False
        while not (over or cut):
            action = self._action(observation, env.action_space, policy, rng)
            rows["observation.state"].append(observation)
            rows["action"].append(action)
            observation, reward, over, cut, facts = env.step(action)
            told = {"reward": reward, "done": over or cut, **facts}
            for name, values in rows.items():
                if name.startswith("next."):
                    values.append(told[name.removeprefix("next.")])
        return {name: np.asarray(values) for name, values in rows.items()}

    def _action(self, observation: Array, space: Any, policy: Policy | None, rng: Generator) -> Any:
        if policy is None:
            return rng.uniform(space.low, space.high).astype(space.dtype)
        action = np.asarray(policy(observation)) + self.noise * rng.standard_normal(space.shape)
        return np.clip(action, space.low, space.high).astype(space.dtype)

    def _error(self, message: str) -> ScenarioError:
        return ScenarioError(f"{self.source}: {message}")


def described(env: Any) -> tuple[lerobot.Features, int]:
    """Columns of an environment's episodes, and its steps a second.

    Beside observations and actions: reward, whether the episode ends, and the numbers among the
    facts that the first step tells, all of what follows the action (``next.…``).
    """
    env.reset(seed=0)
    facts = env.step(np.zeros(env.action_space.shape, env.action_space.dtype))[4]
    world = env.unwrapped
    names = [getattr(world, f"{what}_names", None) for what in ("observation", "action")]
    out = {
        "observation.state": lerobot.feature("float32", env.observation_space.shape[0], names[0]),
        "action": lerobot.feature("float32", env.action_space.shape[0], names[1]),
        "next.reward": lerobot.feature("float32"), "next.done": lerobot.feature("bool"),
    }  # fmt: skip
    for name, value in facts.items():
        if np.ndim(value) == 0 and isinstance(value, bool | int | float | np.number | np.bool_):
            kind = "bool" if isinstance(value, bool | np.bool_) else "float32"
            out[f"next.{name}"] = lerobot.feature(kind)
    out |= {name: lerobot.feature(kind) for name, kind in lerobot.NUMBERED.items()}
    return out, round(world.metadata["render_fps"])


def load_episodes(path: str | Path) -> Episodes:
    """Load the file of a data set of episodes, and see that the environment can be made.

    Args:
        path: The ``.toml`` file. A policy that it names is relative to its folder.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong.
        MissingDependencyError: Gymnasium or MuJoCo is not installed.
    """
    file = Path(path)
    top = ScenarioTable(read_toml(file, "data set", ScenarioError), file.name, "data set")
    top.only(TOP_KEYS)
    options = ScenarioTable(top.data.get("options", {}), file.name, "options")
    environment = top.string("environment")
    spec = Episodes(
        name=top.string("name"), count=top.integer("episodes", 1, 10**7),
        shard_size=top.integer("shard_size", 1, 10**5, 50),
        seed=top.integer("seed", 0, 2**63 - 1, 0), source=file.name,
        folder=file.resolve().parent, environment=environment, options=options.data,
        steps=top.integer("steps", 1, 10**6) if "steps" in top else None,
        policy=top.string("policy", RANDOM), noise=top.number("noise", 0.0, 10.0, 0.0),
        task=top.string("task", environment),
    )  # fmt: skip
    spec.make().close()
    spec._policy()
    return spec
