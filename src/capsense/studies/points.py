"""A table of results at many points, kept in a file row by row as they finish."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

from capsense.errors import CapSenseError, DesignError, FieldError, ScenarioError, SolveError
from capsense.field.cache import write_whole

Point = Mapping[str, float]
"""Values of the parameters by their names."""
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
            DesignError: There is no design for this point.
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


def planned(points: Sequence[Point], evaluation: Evaluation) -> list[str | DesignError]:
    """The key of each point, or why it has no design.

    Raises:
        DesignError: No point has a design.
    """
    plan: list[str | DesignError] = []
    for point in points:
        try:
            plan.append(evaluation.key(point))
        except DesignError as error:
            plan.append(error)
    wrong = [p for p in plan if isinstance(p, DesignError)]
    if wrong and len(wrong) == len(plan):
        raise wrong[0]
    return plan


def kept(path: Path, names: Sequence[str], outputs: Sequence[str]) -> dict[str, _Found]:
    """The results that a table's file holds, by key. An incomplete last line is left out.

    Raises:
        ScenarioError: It cannot be read, or is no table of these parameters and outputs.
    """
    try:
        text = path.read_bytes().decode()
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ScenarioError(f"{path} cannot be read: {error}; give another -o") from None
    whole = text[: text.rfind("\n") + 1]
    lines = list(csv.reader(io.StringIO(whole)))
    if not lines:
        return {}
    header = _header(names, outputs)
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
            results = tuple(math.nan if c == "" else float(c) for c in cells[len(names) :])
        except ValueError:
            raise ScenarioError(f"{path}: line {number} is damaged; remove it") from None
        if key:
            found[key] = results, why
    return found


def missing(points: Sequence[Point], evaluation: Evaluation, path: Path) -> list[Point]:
    """The points whose results a table's file does not hold, but for those without a design.

    Raises:
        DesignError: No point has a design.
        ScenarioError: The file is of another study.
    """
    of_key, found = _known(points, planned(points, evaluation), evaluation.outputs, path)
    return [p for k, p in of_key.items() if k not in found]


def _known(
    points: Sequence[Point], plan: Sequence[str | DesignError], outputs: Sequence[str], path: Path
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
    """Evaluate points and keep the results in a CSV file.

    Each result is appended as it finishes. Results that the file holds already are not computed
    again. In the end the rows are put in the order of the points, so that the file is the same
    however often the work was interrupted, and with any number of processes.

    Args:
        points: Values of the parameters; all have the same names.
        evaluation: What is computed.
        path: The file.
        jobs: Processes.
        each: Called with 1 for each result as it is appended.

    Returns:
        A row for each point, in order.

    Raises:
        DesignError: No point has a design.
        ScenarioError: The file is of another study, or cannot be written.
        ChildProcessError: A process was killed.
    """
    names, outputs = list(points[0]), evaluation.outputs
    plan = planned(points, evaluation)
    of_key, found = _known(points, plan, outputs, path)
    todo = {k: p for k, p in of_key.items() if k not in found}
    nothing = (math.nan,) * len(outputs)

    def line(key: str, point: Point, results: Sequence[float], error: str) -> list[str]:
        numbers = ["" if math.isnan(r) else repr(float(r)) for r in results]
        return [*(repr(float(point[n])) for n in names), *numbers, error, key]

    def table(rows: list[list[str]]) -> bytes:
        return _csv([_header(names, outputs), *rows]).encode()

    try:
        write_whole(path, table([line(k, of_key[k], *f) for k, f in found.items()]))
        with path.open("a", encoding="utf-8", newline="") as file:
            for key, results, error in _evaluated(evaluation, todo, jobs):
                found[key] = results or nothing, error
                file.write(_csv([line(key, todo[key], *found[key])]))
                file.flush()
                each(1)
        lines, rows = [], []
        for key_or_error, point in zip(plan, points, strict=True):
            if isinstance(key_or_error, str):
                key, (results, error) = key_or_error, found[key_or_error]
            else:
                key, results, error = "", nothing, _one_line(key_or_error)
            lines.append(line(key, point, results, error))
            rows.append(StudyRow(point, results, error))
        write_whole(path, table(lines))
    except OSError as error:
        if isinstance(error, ChildProcessError):
            raise
        raise ScenarioError(f"{path} cannot be written: {error.strerror}") from None
    return rows


def _evaluated(
    evaluation: Evaluation, todo: Mapping[str, Point], jobs: int
) -> Iterator[tuple[str, tuple[float, ...], str]]:
    """Key, results and error of each point, in any order."""
    if min(jobs, len(todo)) <= 1:
        for key, point in todo.items():
            yield key, *_evaluate(evaluation, point)
        return
    with ProcessPoolExecutor(min(jobs, len(todo)), mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(_evaluate, evaluation, p): key for key, p in todo.items()}
        try:
            for future in as_completed(futures):
                yield futures[future], *future.result()
        except BrokenProcessPool:
            raise ChildProcessError(
                "a process was killed, perhaps for want of memory; run it again to go on, "
                "with fewer --jobs"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def _evaluate(evaluation: Evaluation, point: Point) -> _Found:
    try:
        return tuple(map(float, evaluation(point))), ""
    except (DesignError, FieldError, SolveError) as error:
        return (), _one_line(error)


def _one_line(error: CapSenseError) -> str:
    return " ".join(str(error).split())


def _header(names: Sequence[str], outputs: Sequence[str]) -> list[str]:
    return [*names, *outputs, "error", "key"]


def _csv(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
