"""Episodes as a LeRobot data set, version 3.0, as LeRobot's own writer lays it out.

Read by ``lerobot.datasets.LeRobotDataset(repo_id, root=folder)``. The layout is that of
https://huggingface.co/docs/lerobot/lerobot-dataset-v3.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.learning.shards import KEY, write_json, write_table
from capsense.recording.tables import replacing

VERSION = "v3.0"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CHUNK = 1000
"""Files of a folder at most."""
_EPISODES_OF_FILE = 10_000
"""Episodes whose facts go into one file."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
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

Features = dict[str, dict[str, Any]]


def feature(kind: str, size: int = 1, names: Sequence[str] | None = None) -> dict[str, Any]:
    """What is told of a column: its type, how many numbers it has, and their names."""
    return {"dtype": kind, "shape": [size], "names": None if names is None else list(names)}


def place(number: int, pattern: str = DATA) -> str:
    """Where file ``number`` lies."""
    chunk, file = divmod(number, CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file)


def frames(
    features: Features, episodes: Mapping[int, Mapping[str, NDArray[Any]]], rate: float
) -> Any:
    """The frames of some episodes as a table; ``index`` counts from 0, see :func:`numbered`.

    Args:
        features: All columns but the numbered ones.
        episodes: Episode → column → values, shape (frames, size).
        rate: Frames a second.
    """
    import pyarrow as pa

    lengths = [len(next(iter(e.values()))) for e in episodes.values()]
    steps = np.concatenate([np.arange(n) for n in lengths])
    counts = {
        "timestamp": steps / rate, "frame_index": steps,
        "episode_index": np.repeat(list(episodes), lengths), "index": np.arange(len(steps)),
        "task_index": np.zeros(len(steps)),
    }  # fmt: skip
    columns = {}
    for name, told in features.items():
        if name in NUMBERED:
            columns[name] = pa.array(counts[name].astype(NUMBERED[name]))
            continue
        values = np.concatenate([e[name] for e in episodes.values()]).astype(told["dtype"])
        flat = pa.array(values.ravel())
        size = told["shape"][0]
        columns[name] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(columns)


def numbered(folder: Path, files: int) -> None:
    """Count ``index`` on from file to file; what is right already is left as it is."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    first = 0
    for path in (folder / place(k) for k in range(files)):
        schema, rows = pq.read_schema(path), pq.read_metadata(path).num_rows
        said = json.loads(schema.metadata[KEY])
        if said.get("first") != first:
            table = pq.read_table(path)
            index = pa.array(np.arange(first, first + rows))
            table = table.set_column(table.column_names.index("index"), "index", index)
            write_table(table.replace_schema_metadata({KEY: json.dumps({**said, "first": first})}),
                        path)  # fmt: skip
        first += rows


def write_meta(
    folder: Path, name: str, features: Features, rate: int, task: str, files: int
) -> None:
    """Write the card and all of ``meta/``; ``info.json`` comes last, and says that all is there.

    Args:
        folder: Of the data set, whose frames are there and :func:`numbered`.
        name: Of the data set.
        features: All columns.
        rate: Frames a second.
        task: What is done in all episodes, in words.
        files: How many files of frames there are.
    """
    import pyarrow as pa

    rows: list[dict[str, Any]] = []
    for file in range(files):
        rows += _episodes_of(folder, file, features, task, rows[-1] if rows else None)
    for number in range(0, len(rows), _EPISODES_OF_FILE):
        part = rows[number : number + _EPISODES_OF_FILE]
        at = number // _EPISODES_OF_FILE
        chunk, index = divmod(at, CHUNK)
        for row in part:
            row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": index}
        write_table(pa.Table.from_pylist(part), folder / place(at, EPISODES))
    write_table(_tasks(task), folder / "meta/tasks.parquet")
    everything = {
        name: _statistics(np.concatenate([_column(folder / place(k), name) for k in range(files)]))
        for name in features
    }
    write_json(everything, folder / "meta/stats.json")
    count, total = len(rows), rows[-1]["dataset_to_index"]
    with replacing(folder / "README.md") as part_of:
        card = _CARD.format(name=name, task=task, episodes=count, frames=total)
        part_of.write_text(card, encoding="utf-8")
    info = {
        "codebase_version": VERSION, "robot_type": None, "total_episodes": count,
        "total_frames": total, "total_tasks": 1, "chunks_size": CHUNK,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": rate,
        "splits": {"train": f"0:{count}"}, "data_path": DATA, "video_path": None,
        "features": features,
    }  # fmt: skip
    write_json(info, folder / "meta/info.json")


def _episodes_of(
    folder: Path, file: int, features: Features, task: str, before: dict[str, Any] | None
) -> list[dict[str, Any]]:
    """What is told of the episodes of a file."""
    path = folder / place(file)
    episode = _column(path, "episode_index")[:, 0]
    starts = np.flatnonzero(np.diff(episode, prepend=-1))
    columns = {name: np.split(_column(path, name), starts[1:]) for name in features}
    first = 0 if before is None else before["dataset_to_index"]
    chunk, index = divmod(file, CHUNK)
    rows = []
    for k, number in enumerate(episode[starts].tolist()):
        length = len(columns["index"][k])
        rows.append({
            "episode_index": number, "tasks": [task], "length": length,
            "dataset_from_index": first, "dataset_to_index": first + length,
            "data/chunk_index": chunk, "data/file_index": index,
            **{f"stats/{name}/{what}": value for name, parts in columns.items()
               for what, value in _statistics(parts[k]).items()},
        })  # fmt: skip
        first += length
    return rows


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
