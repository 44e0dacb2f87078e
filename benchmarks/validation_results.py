"""Tables of ``validation.py`` from what other commands have left in files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from headline_tables import table as markdown_table

from capsense.reproduce import STUDIES

SMOOTHNESS = "python benchmarks/smoothness.py -o out/smoothness.json"
Cells = Sequence[object]


def table(header: Cells, lines: Sequence[Cells]) -> str:
    """A table in Markdown."""
    return markdown_table([str(c) for c in header], [[str(c) for c in line] for line in lines])


def smoothness(path: Path) -> str:
    """What ``benchmarks/smoothness.py`` found, a line a body."""
    if not path.exists():
        return f"Not measured in this edition: `{SMOOTHNESS}`."
    found = json.loads(path.read_text(encoding="utf-8"))
    bodies = next(iter(found.values()))
    lines = []
    for name, f in bodies.items():
        inside = max(f[way] for way in ("approach", "slide", "turn z", "turn y"))
        lines.append((name, f"{inside:.1e}", f"{f['wall']:.1e}", f"{100 * max(f['contact']):.2f}"))
    head = ("body", "second difference", "through a wall", "change in a step, %")
    falls = sum(f["falls"][1] for f in bodies.values())
    wrong = sum(sum(f["wrong"]) for f in bodies.values())
    return (
        f"{table(head, lines)}\n\n"
        f"Steps towards contact in which an entry falls: {falls}.\n"
        f"Matrices that are not finite, symmetric and positive semidefinite: {wrong}.\n"
        "Largest dependence of a reading on those before it: "
        f"{max(f['memory'] for f in bodies.values()):g}."
    )


def studies(folder: Path) -> str:
    """How many figures of every study meet their targets, and those that do not."""
    lines = []
    for name in STUDIES:
        path = folder / name / "rows.json"
        if not path.exists():
            lines.append((name, f"not run in this edition: `capsense reproduce {name}`", ""))
            continue
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["reduced"]:
            raise SystemExit(f"{path} is of the reduced form; run: capsense reproduce {name}")
        judged = [r for r in found["rows"] if r["verdict"] in ("met", "missed")]
        missed = [
            f"{r['what']}: {r['value']:.4g} {r['unit']}".strip() + f", target {r['target']}"
            for r in judged
            if r["verdict"] == "missed"
        ]
        counts = f"{len(judged) - len(missed)} of {len(judged)}"
        lines.append((name, counts, "; ".join(missed) or "–"))
    return table(("study", "targets met", "missed"), lines)
