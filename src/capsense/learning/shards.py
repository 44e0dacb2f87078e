"""Data sets as Parquet files: each shard made on its own, anywhere, and whole or not at all."""

from __future__ import annotations

import hashlib
import json
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from secrets import token_hex
from typing import Any, ClassVar

from capsense._thread_pool import processors
from capsense._workers import process_pool
from capsense.errors import AdapterError, ScenarioError, require_package
from capsense.recording import versions
from capsense.recording.tables import replacing

MANIFEST = "manifest.json"
KEY = b"capsense"
"""Of what a shard says of itself, in its file's metadata."""


@dataclass(frozen=True, eq=False)
class DataSet(ABC):
    """A data set as its file describes it: numbered items, each the same wherever it is made."""

    unit: ClassVar[str]
    """What its items are called."""
    name: str
    count: int
    """How many items there are."""
    shard_size: int
    """Items of a shard; the last one may hold fewer."""
    seed: int
    source: str
    """Name of the file, for messages."""
    folder: Path
    """Files are named relative to this folder."""

    @property
    def shards(self) -> int:
        """How many shards there are."""
        return math.ceil(self.count / self.shard_size)

    def numbers(self, shard: int) -> range:
        """The items of a shard."""
        return range(shard * self.shard_size, min(self.count, (shard + 1) * self.shard_size))

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All that the numbers depend on, but for versions; contents of files by their SHA-256."""

    @cached_property
    def identity(self) -> str:
        """SHA-256 (hex) of :attr:`settings`."""
        text = json.dumps(self.settings, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    @abstractmethod
    def file(self, shard: int) -> str:
        """Where a shard lies in the folder of the data set."""

    @abstractmethod
    def table(self, shard: int) -> Any:
        """The rows of a shard, a table of pyarrow."""

    @abstractmethod
    def about(self) -> dict[str, Any]:
        """What the manifest says beside settings, versions and shards."""

    def finish(self, folder: Path) -> None:  # noqa: B027, most have nothing to add
        """Write what else there is, once all shards are there."""


def files_named(texts: Iterable[str], folder: Path) -> dict[str, str]:
    """SHA-256 (hex) of the files among some texts, relative to a folder."""
    return {
        text: hashlib.sha256((folder / text).read_bytes()).hexdigest()
        for text in sorted({t for t in texts if t})
        if (folder / text).is_file()
    }


def require_pyarrow() -> None:
    """Raise a MissingDependencyError where pyarrow is not installed."""
    require_package("pyarrow.parquet", "pyarrow, which data sets need,", "dataset")


def make_shard(spec: DataSet, folder: Path, shard: int) -> int:
    """Make a shard, and rename it into its place once it is complete.

    Returns:
        Its number.

    Raises:
        CapSenseError: What :meth:`DataSet.table` raises.
    """
    table = spec.table(shard)
    said = json.dumps({"identity": spec.identity, "versions": versions()})
    write_table(table.replace_schema_metadata({KEY: said}), folder / spec.file(shard))
    return shard


def write_table(table: Any, path: Path) -> None:
    """Write a table as a Parquet file, whole or not at all."""
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        pq.write_table(table, part)


def write_json(data: Mapping[str, Any], path: Path) -> None:
    """Write a JSON file, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        part.write_text(json.dumps(data, indent=1), encoding="utf-8")


def run(
    spec: DataSet,
    folder: Path,
    *,
    part: tuple[int, int] = (0, 1),
    workers: int | None = None,
    scheduler: str | None = None,
    each: Callable[[int], object] = lambda _: None,
) -> int:
    """Make the shards of a data set that are missing, and its manifest.

    Args:
        spec: The data set.
        folder: Where it lies; made if it is not there. A cluster's workers see it by this path.
        part: ``(k, n)``: every n-th shard only, from shard k on.
        workers: Processes on this machine, by default as many as the process may use processors.
        scheduler: Address of a Dask scheduler, whose workers make the shards instead.
        each: Called with the number of items of every shard that is complete.

    Returns:
        How many items were made.

    Raises:
        ScenarioError: The folder holds another data set, or an item cannot be made.
        AdapterError: The scheduler does not answer.
        ChildProcessError: Worker processes were killed.
        SolveError: A scene was not solved.
        MissingDependencyError: pyarrow or Dask is not installed.
    """
    require_pyarrow()
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    _begin_manifest(spec, folder)
    todo = missing(spec, folder, part)
    count, job = 0, partial(make_shard, spec, folder)
    for shard in _made(job, todo, min(workers or processors(), len(todo)), scheduler):
        size = len(spec.numbers(shard))
        count += size
        each(size)
    if not missing(spec, folder):
        spec.finish(folder)
        _end_manifest(spec, folder)
    return count


def missing(spec: DataSet, folder: Path, part: tuple[int, int] = (0, 1)) -> list[int]:
    """The shards of a part, as of :func:`run`, that are not there.

    Raises:
        ScenarioError: One that is there is of another data set.
    """
    first, step = part
    return [k for k in range(first, spec.shards, step) if _about(spec, folder, k) is None]


def _made(
    job: Callable[[int], int], todo: list[int], workers: int, scheduler: str | None
) -> Iterator[int]:
    """Do the job for all shards, wherever; yield each that is done, in any order."""
    if scheduler is not None:
        yield from _on_cluster(job, todo, scheduler)
    elif workers <= 1:
        yield from map(job, todo)
    else:
        with process_pool(workers) as pool:
            try:
                for future in as_completed([pool.submit(job, shard) for shard in todo]):
                    yield future.result()
            except BrokenProcessPool:
                raise _killed("a worker process was") from None
            finally:
                pool.shutdown(cancel_futures=True)


def _on_cluster(job: Callable[[int], int], todo: Iterable[int], scheduler: str) -> Iterator[int]:
    """The same on Dask's workers; the scheduler gives the shards of one that died to another."""
    require_package("distributed", "Dask, which --scheduler needs,", "cluster")
    from distributed import Client, KilledWorker
    from distributed import as_completed as completed

    try:
        client = Client(scheduler)
    except (OSError, TimeoutError, ValueError) as error:
        raise AdapterError(
            f"no Dask scheduler answers at {scheduler}: {error}; start one with dask scheduler"
        ) from None
    with client:
        try:
            for future in completed(client.map(job, list(todo), pure=False)):
                yield future.result()
        except KilledWorker:
            raise _killed("several of Dask's workers were") from None


def _killed(who: str) -> ChildProcessError:
    return ChildProcessError(
        f"{who} killed, perhaps for want of memory; what is complete is kept: run it again, "
        "perhaps with fewer workers"
    )


def _about(spec: DataSet, folder: Path, shard: int) -> dict[str, Any] | None:
    """What a shard says of itself; None where it is missing or cut off.

    Raises:
        ScenarioError: It belongs to another data set.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / spec.file(shard)
    try:
        about = json.loads((pq.read_schema(path).metadata or {}).get(KEY, b"{}"))
    except (FileNotFoundError, pa.ArrowInvalid):
        return None
    _check(spec, path, about.get("identity"))
    return about


def _check(spec: DataSet, path: Path, identity: object) -> None:
    """Raise a ScenarioError where a file belongs to another data set."""
    if identity != spec.identity:
        raise ScenarioError(
            f"{path} is of other settings than {spec.source} has now; give another folder (-o), "
            "or remove this one"
        )


def _begin_manifest(spec: DataSet, folder: Path) -> None:
    """Say what the folder will hold, unless somebody has said it already.

    It never takes the place of another manifest: that may be complete by now.

    Raises:
        ScenarioError: The folder holds another data set.
    """
    path = folder / MANIFEST
    if path.exists():
        told = json.loads(path.read_text(encoding="utf-8"))
        _check(spec, path, told["identity"])
        if not told["complete"] or not missing(spec, folder):
            return
        path.unlink(missing_ok=True)  # shards have been removed since
    missing(spec, folder)  # raises where a shard is of another data set
    first = path.with_name(f".{path.name}.{token_hex(4)}.part")
    try:
        first.write_text(json.dumps(_manifest(spec, [versions()], []), indent=1), encoding="utf-8")
        with suppress(OSError):  # somebody was first, or there are no links on this file system
            os.link(first, path)
    finally:
        first.unlink(missing_ok=True)


def _end_manifest(spec: DataSet, folder: Path) -> None:
    """Write the manifest of a data set whose shards are all there, with their hashes."""
    said = [_about(spec, folder, k) or {} for k in range(spec.shards)]
    made_by = {json.dumps(a["versions"], sort_keys=True) for a in said}
    shards = [
        {"file": spec.file(k), spec.unit: len(spec.numbers(k)),
         "sha256": hashlib.sha256((folder / spec.file(k)).read_bytes()).hexdigest()}
        for k in range(spec.shards)
    ]  # fmt: skip
    data = _manifest(spec, [json.loads(v) for v in sorted(made_by)], shards)
    write_json(data, folder / MANIFEST)


def _manifest(spec: DataSet, made_by: list[Any], shards: list[Any]) -> dict[str, Any]:
    return {
        "name": spec.name, "complete": bool(shards), "identity": spec.identity,
        **spec.about(), "settings": spec.settings, "versions": made_by, "shards": shards,
    }  # fmt: skip
