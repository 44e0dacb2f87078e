"""What a study is, which there are, and what it leaves behind: rows, tables, plots, a report."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, cast

from capsense.errors import MissingDependencyError

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
    notes: tuple[str, ...] = ()
    """Paragraphs in Markdown: what it does and does not show."""
    parts: str = ""
    """How much was computed and how much reused, of :meth:`capsense.reproduce.store.Store.told`."""

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
                :class:`capsense.reproduce.store.Store`.
            reduced: In little time, at less resolution or with fewer cases.
            report: To be told how far it is.
        """


STUDIES: dict[str, str] = {
    "scenario1": "capsense.reproduce.scenario1:run",
    "scenario2": "capsense.reproduce.scenario2:run",
    "limb-approach": "capsense.reproduce.limb_approach:run",
    "fig8": "capsense.reproduce.fig8:run",
}
"""``"module:function"`` of each study, in the order of ``capsense reproduce all``."""
NEEDS: dict[str, tuple[str, ...]] = {"scenario2": ("mujoco", "pybullet")}
"""Optional packages of a study, which are named like the extras that bring them."""


def load_study(name: str) -> Study:
    """Import the study of that name.

    Raises:
        KeyError: There is no such study.
        MissingDependencyError: It needs an optional package.
    """
    missing = [package for package in NEEDS.get(name, ()) if find_spec(package) is None]
    if missing:
        raise MissingDependencyError(
            f"study {name} needs {' and '.join(missing)}, not installed here; "
            f"pip install 'capsense[{','.join(missing)}]'"
        )
    module, function = STUDIES[name].split(":")
    return cast(Study, getattr(import_module(module), function))


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
            writer.writerows([[_exact(cell) for cell in row] for row in table.rows])
        names.append(f"{name}.csv")
    for name, figure in outcome.plots.items():
        figure.savefig(folder / f"{name}.png", dpi=110)
        names.append(f"{name}.png")
    rows = [asdict(row) for row in outcome.rows]
    found = {"title": outcome.title, "reduced": reduced, "rows": rows}
    _write(folder / "rows.json", json.dumps(found, indent=1, ensure_ascii=False, allow_nan=False))
    _write(folder / "report.md", markdown(outcome, reduced=reduced))
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
        cells = [tuple(_short(cell) for cell in row) for row in table.rows]
        blocks.append(f"## {name.replace('_', ' ')}\n\n{_grid(table.columns, cells)}")
    long = [f"- [{n}.csv]({n}.csv), {len(t.rows)} rows" for n, t in outcome.tables.items()
            if n not in short]  # fmt: skip
    if long:
        blocks.append("## Longer tables\n\n" + "\n".join(long))
    if outcome.notes:
        blocks.append("## Notes\n\n" + "\n\n".join(outcome.notes))
    return "\n\n".join(blocks) + "\n"


def _grid(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _short(cell: Cell) -> str:
    return f"{cell:.5g}" if isinstance(cell, float) else str(cell)


def _exact(cell: Cell) -> str:
    return f"{cell:.10g}" if isinstance(cell, float) else str(cell)


def _write(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text + ("" if text.endswith("\n") else "\n"), encoding="utf-8")
    os.replace(part, path)
