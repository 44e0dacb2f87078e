"""Data sets of episodes: rollouts of an environment of Gymnasium, written as LeRobot reads them.

Version 3.0, as LeRobot's own writer lays it out: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
``lerobot.datasets.LeRobotDataset(repo_id, root=folder)`` reads it.
"""

from __future__ import annotations

import json
import runpy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from capsense._validate import read_toml
from capsense.errors import ScenarioError
from capsense.learning.shards import KEY, DataSet, files_named, write_json, write_table
from capsense.readout.calibration import LinearSensor
from capsense.recording.tables import replacing
from capsense.scenario import ScenarioTable

Array = NDArray[Any]
Policy = Callable[[Array], Array]
Features = dict[str, dict[str, Any]]

TOP_KEYS = (
    "name", "description", "environment", "options", "episodes", "shard_size", "seed", "steps",
    "policy", "noise", "task",
)  # fmt: skip
RANDOM = "random"
"""The policy that draws from the space of actions."""
_FORMAT = 2
"""Goes up when the same file comes to mean other episodes or columns."""
VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CHUNK = 1000
"""Files of a folder at most."""
_EPISODES_OF_FILE = 10_000
"""Episodes whose facts go into one file."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
OBSERVED = ("observation.state", "action")
"""Columns of the spaces."""
NUMBERED = {
    "timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64",
    "task_index": "int64",
}  # fmt: skip
"""Columns that every such data set has, and their types."""
_CARD = """\
---
tags:
- LeRobot
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# {name}

{task}: {episodes} episodes, {frames} frames, made by CapSense. `manifest.json` holds the settings.
"""


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
        return DATA.format(**_numbers(shard))

    @cached_property
    def columns(self) -> tuple[Features, int]:
        """What LeRobot is told of the columns, by name; and frames a second.

        Beside observations and actions: reward, whether the episode ends, and the numbers among
        the facts that the first step tells, all of what follows the action (``next.…``); what
        was drawn for the episode (``drawn.…``), with the seed that the environment was reset with.
        """
        env = self.make()
        env.reset(seed=0)
        facts = env.step(np.zeros(env.action_space.shape, env.action_space.dtype))[4]
        world = env.unwrapped
        names = [getattr(world, f"{what}_names", None) for what in ("observation", "action")]
        spaces = (env.observation_space, env.action_space)
        out = {
            key: _feature("float32", space.shape[0], told)
            for key, space, told in zip(OBSERVED, spaces, names, strict=True)
        }
        out |= {"next.reward": _feature("float32"), "next.done": _feature("bool")}
        for name, value in facts.items():
            if np.ndim(value) == 0 and isinstance(value, bool | int | float | np.number | np.bool_):
                kind = "bool" if isinstance(value, bool | np.bool_) else "float32"
                out[f"next.{name}"] = _feature(kind)
        for name, drawn in _drawn(world).items():
            out[f"drawn.{name}"] = _feature("float32", len(drawn))
        out["drawn.seed"] = _feature("int64")
        env.close()
        out |= {name: _feature(kind) for name, kind in NUMBERED.items()}
        return out, round(world.metadata["render_fps"])

    def table(self, shard: int) -> Any:
        """The frames of a shard; ``index`` counts from 0 until :meth:`finish`."""
        import pyarrow as pa

        env, policy = self.make(), self._policy()
        episodes = {k: self._episode(k, env, policy) for k in self.numbers(shard)}
        env.close()
        features, rate = self.columns
        lengths = [len(e["action"]) for e in episodes.values()]
        steps = np.concatenate([np.arange(n) for n in lengths])
        counts = {
            "timestamp": steps / rate, "frame_index": steps,
            "episode_index": np.repeat(list(episodes), lengths), "index": np.arange(len(steps)),
            "task_index": np.zeros(len(steps)),
        }  # fmt: skip
        columns = {}
        for name, told in features.items():
            values = counts.get(name)
            if values is None:
                values = np.concatenate([e[name] for e in episodes.values()])
            flat, size = pa.array(values.astype(told["dtype"]).ravel()), told["shape"][0]
            columns[name] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
        return pa.table(columns)

    def about(self) -> dict[str, Any]:
        """Rate and columns."""
        features, rate = self.columns
        return {"fps": rate, "features": features}

    def finish(self, folder: Path) -> None:
        """Number the frames through; write the card and LeRobot's ``meta/``.

        ``info.json`` comes last, and says that all is there.
        """
        import pyarrow as pa

        files = [folder / self.file(k) for k in range(self.shards)]
        _number(files)
        features, rate = self.columns
        rows: list[dict[str, Any]] = []
        for place, path in zip(map(_numbers, range(self.shards)), files, strict=True):
            first = rows[-1]["dataset_to_index"] if rows else 0
            for row in _episodes_of(path, features, first):
                rows.append({**row, "tasks": [self.task], **_placed("data", place)})
        for number in range(0, len(rows), _EPISODES_OF_FILE):
            place = _numbers(number // _EPISODES_OF_FILE)
            part = [
                {**row, **_placed("meta/episodes", place)}
                for row in rows[number : number + _EPISODES_OF_FILE]
            ]
            write_table(pa.Table.from_pylist(part), folder / EPISODES.format(**place))
        write_table(_tasks(self.task), folder / "meta/tasks.parquet")
        everything = {
            name: _statistics(np.concatenate([_column(path, name) for path in files]))
            for name in features
        }
        write_json(everything, folder / "meta/stats.json")
        count, total = len(rows), rows[-1]["dataset_to_index"]
        with replacing(folder / "README.md") as card:
            text = _CARD.format(name=self.name, task=self.task, episodes=count, frames=total)
            card.write_text(text, encoding="utf-8")
        info = {
            "codebase_version": VERSION, "robot_type": None, "total_episodes": count,
            "total_frames": total, "total_tasks": 1, "chunks_size": CHUNK,
            "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": rate,
            "splits": {"train": f"0:{count}"}, "data_path": DATA, "video_path": None,
            "features": features,
        }  # fmt: skip
        write_json(info, folder / "meta/info.json")

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

    def _episode(self, number: int, env: Any, policy: Policy | None) -> dict[str, Array]:
        """An episode, which depends on the settings and its number alone."""
        rng = np.random.default_rng(np.random.SeedSequence((self.seed, number)))
        seed = int(rng.integers(2**31))
        observation, _ = env.reset(seed=seed)
        drawn = {**_drawn(env.unwrapped), "seed": np.array([seed])}
        rows: dict[str, list[Any]] = {n: [] for n in self.columns[0] if n not in NUMBERED}
        over = cut = False
        while not (over or cut):
            action = self._action(observation, env.action_space, policy, rng)
            rows["observation.state"].append(observation)
            rows["action"].append(action)
            observation, reward, over, cut, facts = env.step(action)
            told = {"reward": reward, "done": over or cut, **facts}
            for name, values in rows.items():
                kind, _, what = name.partition(".")
                if kind in ("next", "drawn"):
                    values.append(told[what] if kind == "next" else drawn[what])
        return {name: np.asarray(values) for name, values in rows.items()}

    def _action(self, observation: Array, space: Any, policy: Policy | None, rng: Generator) -> Any:
        if policy is None:
            return rng.uniform(space.low, space.high).astype(space.dtype)
        action = np.asarray(policy(observation)) + self.noise * rng.standard_normal(space.shape)
        return np.clip(action, space.low, space.high).astype(space.dtype)

    def _error(self, message: str) -> ScenarioError:
        return ScenarioError(f"{self.source}: {message}")


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
    top.needs("name", "environment", "episodes")
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


def _feature(kind: str, size: int = 1, names: Sequence[str] | None = None) -> dict[str, Any]:
    """What is told of a column: its type, how many numbers it has, and their names."""
    return {"dtype": kind, "shape": [size], "names": None if names is None else list(names)}


def _drawn(world: Any) -> dict[str, Array]:
    """What an environment has drawn for this episode, where it tells it: rows of numbers by name.

    Those of this package tell it as a dataclass, ``drawn``; and the gains of their chips.
    """
    if not is_dataclass(drawn := getattr(world, "drawn", None)):
        return {}
    numbers = {f.name: getattr(drawn, f.name) for f in fields(drawn)}
    out = {n: np.array([v], float) for n, v in numbers.items() if isinstance(v, int | float)}
    signals = getattr(world, "signals", None)
    gains = [
        np.broadcast_to(stage.gain, len(chip.channel_names))
        for chip in (signals.readouts.values() if signals else ())
        for stage in chip.stages
        if isinstance(stage, LinearSensor)
    ]
    return out | ({"chip_gain": np.concatenate(gains)} if gains else {})


def _numbers(file: int) -> dict[str, int]:
    """Numbers of a file and of its folder in the names of files."""
    chunk, index = divmod(file, CHUNK)
    return {"chunk_index": chunk, "file_index": index}


def _placed(what: str, place: Mapping[str, int]) -> dict[str, int]:
    """The columns that tell where something of an episode is."""
    return {f"{what}/{key}": number for key, number in place.items()}


def _number(files: Sequence[Path]) -> None:
    """Count ``index`` on from file to file; what is right already is left as it is."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    first = 0
    for path in files:
        schema, rows = pq.read_schema(path), pq.read_metadata(path).num_rows
        said = json.loads(schema.metadata[KEY])
        if said.get("first") != first:
            table = pq.read_table(path)
            index = pa.array(np.arange(first, first + rows))
            table = table.set_column(table.column_names.index("index"), "index", index)
            write_table(table.replace_schema_metadata({KEY: json.dumps({**said, "first": first})}),
                        path)  # fmt: skip
        first += rows


def _episodes_of(path: Path, features: Features, first: int) -> Iterator[dict[str, Any]]:
    """What is told of the episodes of a file, whose frames count from ``first`` on."""
    episode = _column(path, "episode_index")[:, 0]
    starts = np.flatnonzero(np.diff(episode, prepend=-1))
    columns = {name: np.split(_column(path, name), starts[1:]) for name in features}
    for k, number in enumerate(episode[starts].tolist()):
        length = len(columns["index"][k])
        yield {
            "episode_index": number, "length": length,
            "dataset_from_index": first, "dataset_to_index": first + length,
            **{f"stats/{name}/{what}": value for name, parts in columns.items()
               for what, value in _statistics(parts[k]).items()},
        }  # fmt: skip
        first += length


def _column(path: Path, name: str) -> NDArray[Any]:
    """A column of a file, shape (frames, size)."""
    import pyarrow.parquet as pq

    column = pq.read_table(path, columns=[name]).column(0).combine_chunks()
    flat = column.flatten() if hasattr(column, "flatten") else column
    return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(column), -1)


def _statistics(values: NDArray[Any]) -> dict[str, list[float]]:
    """Statistics over frames, of each number of a column."""
    x = values.astype(float)
    out = {"min": x.min(axis=0), "max": x.max(axis=0), "mean": x.mean(axis=0), "std": x.std(axis=0)}
    out |= dict(zip(_QUANTILES, np.quantile(x, list(_QUANTILES.values()), axis=0), strict=True))
    return {**{k: v.tolist() for k, v in out.items()}, "count": [len(x)]}


def _tasks(task: str) -> Any:
    """The table of tasks: Pandas finds them as its index."""
    import pyarrow as pa

    def told(name: str, kind: str, of_numpy: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": of_numpy,
                "metadata": None}  # fmt: skip

    about = {
        "index_columns": ["task"], "column_indexes": [],
        "columns": [told("task_index", "int64", "int64"), told("task", "unicode", "object")],
    }  # fmt: skip
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    return table.replace_schema_metadata({b"pandas": json.dumps(about)})
