"""Data sets as Parquet files: each shard made on its own, anywhere, and whole or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from capsense._thread_pool import processors
from capsense.errors import (
    AdapterError,
    MissingDependencyError,
    ScenarioError,
    SceneError,
    SolveError,
)
from capsense.learning.settle import settled, settling
from capsense.learning.spec import Spec
from capsense.readout.readout import Readout
from capsense.recording.session import versions
from capsense.recording.tables import replacing
from capsense.simulator import Simulator, make_readout

MANIFEST = "manifest.json"
COLUMNS = {
    "scene": "number of the scene",
    "capacitance": "Maxwell capacitance matrix, row by row, M × M, F",
    "delta": "its change from the empty scene, row by row, M × M, F",
    "self_delta": "change of the self capacitances, the design's shields driven along, M, F",
    "code": "what the converter of each channel holds, K, codes",
    "code_delta": "what its user makes of it, change from the empty scene, K, F",
    "distance": "from the nearest electrode to the nearest body, m",
    "closest_point": "the point of that body's surface nearest to the electrodes, x, y, z, m",
    "normal": "unit normal of its surface there, out of the body, x, y, z",
    "axis": "unit vector along it, where it is a capsule or a cylinder, x, y, z",
    "body": "its name",
    "material": "its material",
    "eps_r": "relative permittivity of that",
    "sigma": "conductivity of that, S/m",
    "bodies": "how many bodies the scene holds",
}
"""Columns, and what they are; those of a readout only where one is given."""
_KEY = b"capsense"
"""Of what a shard says of itself, in its file's metadata."""


def require_pyarrow() -> None:
    """Raise a MissingDependencyError where pyarrow is not installed."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "data sets need pyarrow; pip install 'capsense[dataset]'"
        ) from None


def shard_path(spec: Spec, folder: Path, shard: int) -> Path:
    """Where a shard lies: the names that Hugging Face's ``datasets`` knows."""
    return folder / "data" / f"train-{shard:05d}-of-{spec.shards:05d}.parquet"


def make_shard(spec: Spec, folder: Path, shard: int) -> int:
    """Make a shard, and rename it into its place once it is complete.

    Returns:
        Its number.

    Raises:
        ScenarioError: A scene cannot be drawn.
        SceneError: A scene is none that can be solved; the message names it.
        SolveError: A scene was not solved; the message names it.
    """
    import pyarrow.parquet as pq

    path = shard_path(spec, folder, shard)
    simulator = Simulator(spec.design, preset=spec.preset)
    readout = make_spec_readout(spec, simulator)
    rows = [_row(spec, number, simulator, readout) for number in spec.numbers(shard)]
    with replacing(path) as part:
        pq.write_table(_table(spec, rows, readout, len(simulator.electrode_names)), part)
    return shard


def make_spec_readout(spec: Spec, simulator: Simulator) -> Readout | None:
    """The readout of a data set, if it has one.

    Raises:
        ReadoutError: There is no such chip or file, or the file is wrong.
    """
    choice = spec.readout
    if isinstance(choice, str) and choice.endswith(".toml"):
        choice = spec.folder / choice
    return make_readout(choice, simulator)


def _row(spec: Spec, number: int, simulator: Simulator, readout: Readout | None) -> dict[str, Any]:
    scene, near, rng = spec.scene(number)
    try:
        reading = simulator.step(scene)
    except (SceneError, SolveError) as error:
        raise type(error)(f"scene {number}: {error}") from None
    row: dict[str, Any] = {
        "scene": number,
        "capacitance": reading.capacitance.ravel(),
        "delta": reading.delta.ravel(),
        "self_delta": reading.self_capacitance - simulator.empty.self_capacitance,
        "bodies": len(scene),
    }
    if readout is not None:
        readout.reset(seed=int(rng.integers(2**63)))
        empty = settled(readout, simulator.empty, 0.0)
        held = settled(readout, reading, settling(readout))
        row |= {"code": held.code, "code_delta": held.capacitance - empty.capacitance}
    if near is not None:
        row |= {
            "distance": near.distance, "closest_point": near.point, "normal": near.normal,
            "axis": near.axis, "body": near.body.name, "material": near.body.material.name,
            "eps_r": near.body.material.eps_r, "sigma": near.body.material.sigma,
        }  # fmt: skip
    return row


def _table(spec: Spec, rows: list[dict[str, Any]], readout: Readout | None, electrodes: int) -> Any:
    """The rows as a table of plain columns and lists of fixed size."""
    import pyarrow as pa

    channels = 0 if readout is None else len(readout.channel_names)
    number, three = pa.float64(), pa.list_(pa.float64(), 3)
    matrix = pa.list_(number, electrodes**2)
    kinds = {
        "scene": pa.int64(), "capacitance": matrix, "delta": matrix,
        "self_delta": pa.list_(number, electrodes),
        "code": pa.list_(pa.int64(), channels), "code_delta": pa.list_(number, channels),
        "distance": number, "closest_point": three, "normal": three, "axis": three,
        "body": pa.string(), "material": pa.string(), "eps_r": number, "sigma": number,
        "bodies": pa.int64(),
    }  # fmt: skip
    names = [name for name in COLUMNS if channels or not name.startswith("code")]
    fields = [pa.field(n, kinds[n], metadata={"meaning": COLUMNS[n]}) for n in names]
    about = json.dumps({"identity": spec.identity, "versions": versions()})
    return pa.Table.from_arrays(
        [pa.array([row.get(n) for row in rows], kinds[n]) for n in names],
        schema=pa.schema(fields, metadata={_KEY: about}),
    )


def run(
    spec: Spec,
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
        each: Called with the number of scenes of every shard that is complete.

    Returns:
        How many scenes were made.

    Raises:
        ScenarioError: The folder holds another data set, or a scene cannot be drawn.
        AdapterError: The scheduler does not answer.
        ChildProcessError: Worker processes were killed.
        SolveError: A scene was not solved.
        MissingDependencyError: pyarrow or Dask is not installed.
    """
    require_pyarrow()
    folder = folder.resolve()
    (folder / "data").mkdir(parents=True, exist_ok=True)
    _write_manifest(spec, folder)
    todo = missing(spec, folder, part)
    count, job = 0, partial(make_shard, spec, folder)
    for shard in _made(job, todo, min(workers or processors(), len(todo)), scheduler):
        size = len(spec.numbers(shard))
        count += size
        each(size)
    _write_manifest(spec, folder)
    return count


def missing(spec: Spec, folder: Path, part: tuple[int, int] = (0, 1)) -> list[int]:
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
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            try:
                for future in as_completed([pool.submit(job, shard) for shard in todo]):
                    yield future.result()
            except BrokenProcessPool:
                raise _killed("a worker process was") from None
            finally:
                pool.shutdown(cancel_futures=True)


def _on_cluster(job: Callable[[int], int], todo: Iterable[int], scheduler: str) -> Iterator[int]:
    """The same on Dask's workers; the scheduler gives the shards of one that died to another."""
    try:
        from distributed import Client, KilledWorker
        from distributed import as_completed as completed
    except ImportError:
        raise MissingDependencyError(
            "--scheduler needs Dask; pip install 'capsense[cluster]'"
        ) from None
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


def _about(spec: Spec, folder: Path, shard: int) -> dict[str, Any] | None:
    """What a shard says of itself; None where it is missing or cut off.

    Raises:
        ScenarioError: It belongs to another data set.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = shard_path(spec, folder, shard)
    try:
        about = json.loads((pq.read_schema(path).metadata or {}).get(_KEY, b"{}"))
    except (FileNotFoundError, pa.ArrowInvalid):
        return None
    if about.get("identity") != spec.identity:
        raise _other(spec, path)
    return about


def _other(spec: Spec, path: Path) -> ScenarioError:
    return ScenarioError(
        f"{path} is of other settings than {spec.source} has now; give another folder (-o), or "
        "remove this one"
    )


def _write_manifest(spec: Spec, folder: Path) -> None:
    """Write ``manifest.json``; once all shards are there, with their hashes.

    Raises:
        ScenarioError: The one that is there is of another data set.
    """
    path = folder / MANIFEST
    told = json.loads(path.read_text()) if path.exists() else None
    if told is not None and told["identity"] != spec.identity:
        raise _other(spec, path)
    paths = [shard_path(spec, folder, k) for k in range(spec.shards)]
    about = [_about(spec, folder, k) for k in range(spec.shards) if paths[k].exists()]
    complete = None not in about and len(about) == spec.shards
    if told is not None and not complete and not told["complete"]:
        return  # so that it never takes the place of one that somebody else has just completed
    simulator = Simulator(spec.design, preset=spec.preset)
    readout = make_spec_readout(spec, simulator)
    made_by = {json.dumps(a["versions"], sort_keys=True) for a in about if a is not None}
    data = {
        "name": spec.name, "complete": complete, "identity": spec.identity,
        "design": spec.design.name, "electrodes": simulator.electrode_names,
        "baseline_F": simulator.baseline.tolist(),
        "channels": () if readout is None else readout.channel_names,
        "columns": COLUMNS, "settings": spec.settings,
        "versions": [json.loads(v) for v in sorted(made_by)] or [versions()],
        "shards": [
            {"file": str(p.relative_to(folder)), "scenes": len(spec.numbers(k)),
             "sha256": hashlib.sha256(p.read_bytes()).hexdigest()}
            for k, p in enumerate(paths)
        ] if complete else [],
    }  # fmt: skip
    with replacing(path) as part, part.open("w", encoding="utf-8") as file:
        json.dump(data, file, indent=1)
