"""A table of results at many points, kept in a file row by row as they finish."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from queue import Empty
from typing import Any, Protocol

from capsense._thread_pool import processors
from capsense._workers import process_pool
from capsense.errors import (
    CapSenseError,
    DesignError,
    FieldError,
    MeshError,
    ReadoutError,
    ScenarioError,
    SceneError,
    SolveError,
    require_package,
)
from capsense.field.cache import write_whole
from capsense.studies.template import Point

WRONG_POINT = (DesignError, ScenarioError, SceneError, MeshError, ReadoutError)
"""Raised where values of parameters make no design, no bodies or no chip."""
PARQUET = ".parquet"
_POLL = 0.2
"""Time between two looks at whether processes are still alive [s]."""
_Found = tuple[tuple[float, ...], str]
"""Results, and the error in place of them."""


class Evaluation(Protocol):
    """What is computed at a point. With several processes it must be picklable."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the results."""
        ...

    def key(self, point: Point) -> str:
        """A text that differs wherever results may differ.

        Raises:
            CapSenseError: One of :data:`WRONG_POINT`: nothing can be made of this point.
        """
        ...

    def group(self, point: Point) -> str:
        """The same text for points that share costly work, such as a field.

        They are evaluated one after another by one process; with ``""``, by any.
        """
        ...

    def __call__(self, point: Point) -> Sequence[float]:
        """The results, one for each output.

        Raises:
            FieldError: The field cannot be built.
            SolveError: A scene was not solved.
        """
        ...


@dataclass(frozen=True)
class StudyRow:
    """One point of a table."""

    point: Point
    results: tuple[float, ...]
    """One number for each output; NaN if there is an error."""
    error: str = ""
    """Why there are no results; empty if there are."""


def planned(points: Sequence[Point], evaluation: Evaluation) -> list[str | CapSenseError]:
    """The key of each point, or why nothing can be made of it.

    Raises:
        CapSenseError: Nothing can be made of any point; the first error is raised.
    """
    plan: list[str | CapSenseError] = []
    for point in points:
        try:
            plan.append(evaluation.key(point))
        except WRONG_POINT as error:
            plan.append(error)
    wrong = [p for p in plan if isinstance(p, CapSenseError)]
    if wrong and len(wrong) == len(plan):
        raise wrong[0]
    return plan


def journal_of(path: Path) -> Path:
    """Where rows are appended as they finish: the table itself, or a CSV file beside Parquet."""
    return path.with_name(f"{path.name}.csv") if path.suffix.lower() == PARQUET else path


def kept(path: Path, names: Sequence[str], outputs: Sequence[str]) -> dict[str, _Found]:
    """The results that a table's files hold, by key. An incomplete last line is left out.

    Raises:
        ScenarioError: It cannot be read, or is no table of these parameters and outputs.
        MissingDependencyError: Parquet needs pyarrow.
    """
    header, journal = _header(names, outputs), journal_of(path)
    found = _results(journal, _csv_lines(journal), header, len(names))
    if journal != path:
        found |= _results(path, _parquet_lines(path), header, len(names))
    return found


def _results(
    path: Path, lines: list[list[str]], header: list[str], parameters: int
) -> dict[str, _Found]:
    """Results by key of the lines of a table, of which the first is its header."""
    if not lines:
        return {}
    if lines[0] != header:
        raise ScenarioError(
            f"{path} is a table of other columns, {', '.join(lines[0])}; give another -o"
        )
    found: dict[str, _Found] = {}
    for number, line in enumerate(lines[1:], start=2):
        try:
            if len(line) != len(header):
                raise ValueError
            *cells, why, key = line
            results = tuple(math.nan if c == "" else float(c) for c in cells[parameters:])
        except ValueError:
            raise ScenarioError(f"{path}: line {number} is damaged; remove it") from None
        if key:
            found[key] = results, why
    return found


def _csv_lines(path: Path) -> list[list[str]]:
    """The complete lines of a CSV file; none if there is no file."""
    try:
        text = path.read_bytes().decode()
    except FileNotFoundError:
        return []
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path} cannot be read: {error}; give another -o") from None
    return list(csv.reader(io.StringIO(text[: text.rfind("\n") + 1])))


def _parquet_lines(path: Path) -> list[list[str]]:
    """The rows of a Parquet file as those of a CSV file; none if there is no file."""
    require_package("pyarrow.parquet", "pyarrow, which Parquet needs,", "record")
    import pyarrow as pa
    import pyarrow.parquet as pq

    if not path.exists():
        return []
    try:
        table = pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise ScenarioError(f"{path} cannot be read: {error}; give another -o") from None
    columns = [column.to_pylist() for column in table.columns]
    rows = [[_cell(value) for value in row] for row in zip(*columns, strict=True)]
    return [table.column_names, *rows]


def _cell(value: float | str | None) -> str:
    """A value in a table: numbers as they are read back to the last bit, none for NaN."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return value if isinstance(value, str) else repr(float(value))


def missing(points: Sequence[Point], evaluation: Evaluation, path: Path) -> list[Point]:
    """The points whose results a table's file does not hold, but for those without a design.

    Raises:
        CapSenseError: Nothing can be made of any point.
        ScenarioError: The file is of another study.
    """
    of_key, found = _known(points, planned(points, evaluation), evaluation.outputs, path)
    return [p for k, p in of_key.items() if k not in found]


def _known(
    points: Sequence[Point], plan: Sequence[str | CapSenseError], outputs: Sequence[str], path: Path
) -> tuple[dict[str, Point], dict[str, _Found]]:
    """Point and, where they are kept, results of each key."""
    of_key = {k: p for k, p in zip(plan, points, strict=True) if isinstance(k, str)}
    found = kept(path, list(points[0]), outputs)
    if other := len(found.keys() - of_key.keys()):
        raise ScenarioError(
            f"{path} holds {other} results of another study; give another -o, or remove the file"
        )
    return of_key, found


def fill_table(
    points: Sequence[Point],
    evaluation: Evaluation,
    path: Path,
    *,
    jobs: int = 1,
    each: Callable[[int], object] = lambda count: None,
) -> list[StudyRow]:
    """Evaluate points and keep the results in a CSV or Parquet file.

    Each result is appended as it finishes, to a CSV file beside a Parquet one. Results that the
    files hold already are not computed again. In the end the rows are put in the order of the
    points, so that the file is the same however often the work was interrupted, and with any number
    of processes.

    Args:
        points: Values of the parameters; all have the same names.
        evaluation: What is computed.
        path: The file; of Parquet if its name ends in ``.parquet``.
        jobs: Processes.
        each: Called with 1 for each result as it is appended.

    Returns:
        A row for each point, in order.

    Raises:
        CapSenseError: Nothing can be made of any point.
        ScenarioError: The file is of another study, or cannot be written.
        MissingDependencyError: Parquet needs pyarrow.
        ChildProcessError: A process was killed.
    """
    names, outputs = list(points[0]), evaluation.outputs
    plan = planned(points, evaluation)
    of_key, found = _known(points, plan, outputs, path)
    todo = {k: p for k, p in of_key.items() if k not in found}
    nothing = (math.nan,) * len(outputs)

    def line(key: str, point: Point, results: Sequence[float], error: str) -> list[str]:
        return [*map(_cell, (*(point[n] for n in names), *results)), error, key]

    journal = journal_of(path)
    header = _header(names, outputs)
    try:
        begun = [line(k, of_key[k], *f) for k, f in found.items()]
        write_whole(journal, _csv([header, *begun]).encode())
        with journal.open("a", encoding="utf-8", newline="") as file:
            for key, results, error in _evaluated(evaluation, todo, jobs):
                found[key] = results or nothing, error
                file.write(_csv([line(key, todo[key], *found[key])]))
                file.flush()
                each(1)
        keys, rows = [], []
        for key_or_error, point in zip(plan, points, strict=True):
            if isinstance(key_or_error, str):
                keys.append(key_or_error)
                rows.append(StudyRow(point, *found[key_or_error]))
            else:
                keys.append("")
                rows.append(StudyRow(point, nothing, _one_line(key_or_error)))
        if journal == path:
            lines = [line(k, r.point, r.results, r.error) for k, r in zip(keys, rows, strict=True)]
            write_whole(path, _csv([header, *lines]).encode())
        else:
            write_whole(path, _parquet(header, rows, keys))
            journal.unlink()
    except OSError as error:
        if isinstance(error, ChildProcessError):
            raise
        raise ScenarioError(f"{path} cannot be written: {error.strerror}") from None
    return rows


def _parquet(header: list[str], rows: Sequence[StudyRow], keys: list[str]) -> bytes:
    """A table as the content of a Parquet file; results that are missing are null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: list[Any] = []
    for name in rows[0].point:
        values = [row.point[name] for row in rows]
        texts = any(isinstance(v, str) for v in values)
        columns.append(pa.array([_cell(v) if texts else v for v in values]))
    for results in zip(*(row.results for row in rows), strict=True):
        columns.append(pa.array(results, pa.float64(), from_pandas=True))
    columns += [pa.array([row.error for row in rows]), pa.array(keys)]
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(columns, names=header), buffer)
    return buffer.getvalue()


def jobs_within(memory: float) -> int:
    """How many processes run at a time: one a processor, or fewer where memory is short.

    Args:
        memory: What one of them needs [byte].
    """
    free = _free_memory()
    return max(1, min(processors(), processors() if free is None else int(free / memory)))


def _free_memory() -> float | None:
    """Memory that programs may still take [byte]; None where the system does not tell."""
    with suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024.0 * next(int(x.split()[1]) for x in lines if x.startswith("MemAvailable:"))
    with suppress(AttributeError, OSError, ValueError):
        return 0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _evaluated(
    evaluation: Evaluation, todo: Mapping[str, Point], jobs: int
) -> Iterator[tuple[str, tuple[float, ...], str]]:
    """Key, results and error of each point, in any order."""
    tasks = _tasks(evaluation, todo, jobs)
    if min(jobs, len(tasks)) <= 1:
        for key, point in (item for task in tasks for item in task):
            yield key, *_evaluate(evaluation, point)
        return
    context = get_context("spawn")
    queue, stop = context.Queue(), context.Event()
    with process_pool(min(jobs, len(tasks)), _begin, queue, stop) as pool:
        futures: list[Future[None]] = [pool.submit(_carry_out, evaluation, t) for t in tasks]
        left = len(todo)
        try:
            while left:
                try:
                    found = queue.get(timeout=_POLL)
                except Empty:
                    for future in futures:
                        if future.done():
                            future.result()
                    continue
                left -= 1
                yield found
        except BrokenProcessPool:
            raise ChildProcessError(
                "a process was killed, perhaps for want of memory; run it again to go on, "
                "with fewer --jobs"
            ) from None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _tasks(
    evaluation: Evaluation, todo: Mapping[str, Point], jobs: int
) -> list[list[tuple[str, Point]]]:
    """Points by group, each group a task; those of no group, one or more tasks a process."""
    groups: dict[str, list[tuple[str, Point]]] = {}
    for key, point in todo.items():
        groups.setdefault(evaluation.group(point), []).append((key, point))
    free = groups.pop("", [])
    parts = min(len(free), 4 * jobs) if jobs > 1 else 1
    return [*groups.values(), *(free[k::parts] for k in range(parts) if free)]


_parent: list[Any] = []
"""In a process: the queue for what it has found, and an event that tells it to stop."""


def _begin(queue: Any, stop: Any) -> None:
    queue.cancel_join_thread()  # who is stopped leaves results that nobody waits for
    _parent[:] = queue, stop


def _carry_out(evaluation: Evaluation, task: list[tuple[str, Point]]) -> None:
    queue, stop = _parent
    for key, point in task:
        if stop.is_set():
            return
        queue.put((key, *_evaluate(evaluation, point)))


def _evaluate(evaluation: Evaluation, point: Point) -> _Found:
    try:
        return tuple(map(float, evaluation(point))), ""
    except (*WRONG_POINT, FieldError, SolveError) as error:
        return (), _one_line(error)


def _one_line(error: CapSenseError) -> str:
    return " ".join(str(error).split())


def _header(names: Sequence[str], outputs: Sequence[str]) -> list[str]:
    return [*names, *outputs, "error", "key"]


def _csv(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
