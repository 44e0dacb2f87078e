"""Writes an outcome: a report to read, and the same as data."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import asdict
from pathlib import Path

from capsense.reproduce.study import Cell, Outcome, Row

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
