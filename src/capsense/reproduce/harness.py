"""What the studies share: parts kept on disk, measures, rows, tables, and the report."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

import capsense
from capsense.recording import version_of
from capsense.recording.tables import replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Verdict = Literal["met", "missed", "for information"]
Cell = str | int | float
Report = Callable[[str, float], None]
"""Told what is being done, and the fraction of the whole study that is done, from 0 to 1."""


@dataclass(frozen=True)
class Row:
    """One figure of a study, and how it stands against its target.

    Raises:
        ValueError: The value is not finite; a figure that could not be computed is no figure.
    """

    what: str
    value: float
    unit: str = ""
    target: str = ""
    """In words, like ``"> 0.976 (the paper's simulation)"``; empty without one."""
    verdict: Verdict = "for information"

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise ValueError(f"{self.what}: the value is {self.value}; give a finite number")


def judged(
    what: str,
    value: float,
    unit: str = "",
    *,
    above: float | None = None,
    below: float | None = None,
    source: str = "",
) -> Row:
    """A row whose target is met strictly above or strictly below a limit.

    Args:
        what: What the figure is.
        value: The figure.
        unit: Its unit.
        above: Limit that the value must exceed, or …
        below: … stay under; exactly one of the two.
        source: Where the limit comes from, for the target's text.

    Raises:
        ValueError: Not exactly one limit is given, or the value is not finite.
    """
    if (above is None) == (below is None):
        raise ValueError(f"{what}: give one of above and below")
    limit, sign = (above, ">") if above is not None else (below, "<")
    assert limit is not None
    met = value > limit if sign == ">" else value < limit
    target = f"{sign} {limit:.5g}" + (f" ({source})" if source else "")
    return Row(what, value, unit, target, "met" if met else "missed")


@dataclass(frozen=True)
class ReportTable:
    """Columns with a heading each; written as csv, and shown in the report where it is short."""

    columns: tuple[str, ...]
    """Headings, with units in square brackets."""
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row has {len(row)} cells for {len(self.columns)} columns")


@dataclass(frozen=True)
class Outcome:
    """What a study found."""

    title: str
    rows: tuple[Row, ...]
    tables: Mapping[str, ReportTable] = field(default_factory=dict)
    """By file name without ending."""
    plots: Mapping[str, Figure] = field(default_factory=dict)
    """By file name without ending."""
    notes: str = ""
    """In Markdown: what it does and does not show."""
    parts: str = ""
    """How much was computed and how much reused, see :meth:`Store.told`."""

    @property
    def missed(self) -> tuple[Row, ...]:
        """The rows that missed their target."""
        return tuple(row for row in self.rows if row.verdict == "missed")


class Study(Protocol):
    """A module-level function that carries a study out."""

    def __call__(self, folder: Path, *, reduced: bool, report: Report) -> Outcome:
        """Carry it out.

        Args:
            folder: Its output folder, which exists; parts are kept there, see
                :class:`capsense.reproduce.harness.Store`.
            reduced: In little time, at less resolution or with fewer cases.
            report: To be told how far it is.
        """


MAX_ROWS = 40
"""Longer tables are not shown in the report, only named."""
REDUCED = "Reduced form: fewer cases, less resolution. The figures are no results, but a check."


def write_outcome(outcome: Outcome, folder: Path, *, reduced: bool = False) -> list[str]:
    """Write ``report.md``, ``rows.json``, a csv per table and a png per plot.

    The report is written last, so that where there is one, the rest is there.

    Args:
        outcome: What to write.
        folder: Where; it exists.
        reduced: Whether the study was carried out in its reduced form, which is told.

    Returns:
        Names of the files.
    """
    names = []
    for name, table in outcome.tables.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table.columns)
            writer.writerows([[_text(cell, 10) for cell in row] for row in table.rows])
        names.append(f"{name}.csv")
    for name, figure in outcome.plots.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
        names.append(f"{name}.png")
    rows = [asdict(row) for row in outcome.rows]
    found = {"title": outcome.title, "reduced": reduced, "rows": rows}
    told = json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    for name, text in (("rows.json", told), ("report.md", markdown(outcome, reduced=reduced))):
        with replacing(folder / name) as part:
            part.write_text(text, encoding="utf-8")
    return [*names, "rows.json", "report.md"]


def row_cells(row: Row) -> tuple[str, str, str, str, str]:
    """A row as text: what, value, unit, target, verdict."""
    return row.what, f"{row.value:.5g}", row.unit, row.target, row.verdict


ROW_HEADER = ("what", "value", "unit", "target", "verdict")


def markdown(outcome: Outcome, *, reduced: bool = False) -> str:
    """The outcome as a page in Markdown; it refers to tables and plots in its own folder."""
    blocks = [f"# {outcome.title}"] + ([REDUCED] if reduced else [])
    blocks.append(_grid(ROW_HEADER, [row_cells(row) for row in outcome.rows]))
    blocks += [f"![{name.replace('_', ' ')}]({name}.png)" for name in outcome.plots]
    short = {n: t for n, t in outcome.tables.items() if len(t.rows) <= MAX_ROWS}
    for name, table in short.items():
        cells = [tuple(_text(cell, 5) for cell in row) for row in table.rows]
        blocks.append(f"## {name.replace('_', ' ')}\n\n{_grid(table.columns, cells)}")
    long = [f"- [{n}.csv]({n}.csv), {len(t.rows)} rows" for n, t in outcome.tables.items()
            if n not in short]  # fmt: skip
    if long:
        blocks.append("## Longer tables\n\n" + "\n".join(long))
    if outcome.notes:
        blocks.append(f"## Notes\n\n{outcome.notes}")
    return "\n\n".join(blocks) + "\n"


def _grid(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _text(cell: Cell, digits: int) -> str:
    return f"{cell:.{digits}g}" if isinstance(cell, float) else str(cell)


Arrays = dict[str, NDArray[Any]]
PARTS = "parts"
"""Subfolder of the output folder that parts lie in."""


class Store:
    """Keeps each unit of work as one ``.npz``, under a hash of what it depends on.

    That is its inputs, the source files of CapSense beneath the studies, the source file of the
    function that computes it, and the versions of the packages that compute: after a change of
    any of them it is computed anew.

    Args:
        folder: The study's output folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / PARTS
        self.computed = 0
        """Units computed so far."""
        self.reused = 0
        """Units found on disk so far."""

    def told(self) -> str:
        """How much was computed and how much reused, in words."""
        return f"{self.computed} parts computed, {self.reused} reused from {self.folder}"

    def get(
        self, name: str, inputs: Mapping[str, Any], compute: Callable[[], Mapping[str, Any]]
    ) -> Arrays:
        """Return a unit of work, from disk if it is there.

        Args:
            name: Name of the unit, for its file.
            inputs: All that it depends on: numbers, texts, booleans, None, arrays, and lists and
                dicts of these. A design enters as ``design.content_hash()``.
            compute: Does the work; returns arrays (or what becomes one) by name. A function or
                lambda of the study's module, whose file enters the hash.

        Raises:
            TypeError: An input is of another type.
        """
        path = self.folder / f"{name}-{_digest(inputs, compute.__module__)}.npz"
        found = _load(path)
        if found is not None:
            self.reused += 1
            return found
        arrays = {key: np.asarray(value) for key, value in compute().items()}
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
        self.computed += 1
        return arrays


def _load(path: Path) -> Arrays | None:
    """What a file holds; None where it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except Exception:  # of damage, zip, inflate and numpy's reader each complain differently
        return None


def _digest(inputs: Mapping[str, Any], module: str) -> str:
    own = Path(sys.modules[module].__file__ or "").read_bytes()
    code = [code_version(), hashlib.sha256(own).hexdigest()]
    text = json.dumps([inputs, code], sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _plain(value: object) -> Any:
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value)
        return [str(data.dtype), list(data.shape), hashlib.sha256(data.tobytes()).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a part's input is a {type(value).__name__}; give numbers, texts or arrays")


ABOVE = ("__main__.py", "cli", "plotting", "reproduce", "viewer")
"""What a part does not depend on, but for the module that computes it."""


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of the source files beneath the studies, and of the versions beneath them."""
    root = Path(capsense.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        place = path.relative_to(root)
        if place.parts[0] not in ABOVE:
            digest.update(str(place).encode() + b"\0" + path.read_bytes() + b"\0")
    for package in ("numpy", "scipy", "numba", "mujoco", "pybullet"):
        digest.update(f"{package} {version_of(package)}\n".encode())
    return digest.hexdigest()


def raw_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """``Σ ab / √(Σ a² Σ b²)``: Eq. 12 at lag zero, of values as they are.

    Raises:
        ValueError: The curves differ in shape, or one is zero throughout.
    """
    a, b = _pair(one, other)
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    if size == 0:
        raise ValueError("a curve is zero throughout and correlates with nothing")
    return float((a * b).sum()) / size


def correlation_of_change(one: ArrayLike, other: ArrayLike) -> float:
    """Eq. 12 of each curve's change from its own level, the mean of its highest tenth."""
    a, b = _pair(one, other)
    return raw_correlation(a - _level(a), b - _level(b))


def rmse(one: ArrayLike, other: ArrayLike) -> float:
    """Root of the mean squared difference."""
    a, b = _pair(one, other)
    return math.sqrt(float(((a - b) ** 2).mean()))


def _level(curve: np.ndarray) -> float:
    count = max(1, len(curve) // 10)
    return float(np.sort(curve)[-count:].mean())


def _pair(one: ArrayLike, other: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if a.shape != b.shape or not a.size:
        raise ValueError(f"curves have shapes {a.shape} and {b.shape}; make them the same")
    return a, b


def correlations(table: int) -> dict[str, Any]:
    """Eq. 12 of the paper's simulation against its hardware.

    Args:
        table: 1, by speed [m/s, as text] and board; or 2, a list over electrodes by participant.
    """
    found: dict[str, Any] = json.loads(_data(f"table_{table}.json"))["normalised cross-correlation"]
    return found


def notes(study: str) -> str:
    """What a report says of what its study does and does not show, in Markdown."""
    return _data(f"notes_{study}.md").rstrip()


def _data(name: str) -> str:
    return (files("capsense.reproduce") / "data" / name).read_text("utf-8")
