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
    """The worst that ``benchmarks/smoothness.py`` found, and the body that it is of."""
    if not path.exists():
        return f"Not measured in this edition: `{SMOOTHNESS}`."
    bodies = next(iter(json.loads(path.read_text(encoding="utf-8")).values()))
    ways = ("approach", "slide", "turn z", "turn y")
    within = {name: max(f[way] for way in ways) for name, f in bodies.items()}
    wall = {name: f["wall"] for name, f in bodies.items()}
    steps = {name: 100 * max(f["contact"]) for name, f in bodies.items()}
    found = (
        ("second difference", within, ".1e"), ("the same through a wall", wall, ".1e"),
        ("change of an entry in a step from 8 to 0.05 mm, %", steps, ".2f"),
    )  # fmt: skip
    lines: list[Cells] = []
    for what, values, form in found:
        body = max(values, key=lambda name: values[name])
        lines.append((what, f"{values[body]:{form}}", body))
    falls = sum(f["falls"][1] for f in bodies.values())
    wrong = sum(sum(f["wrong"]) for f in bodies.values())
    memory = max(f["memory"] for f in bodies.values())
    lines += [
        ("steps towards contact in which an entry falls", falls, ""),
        ("matrices that are not finite, symmetric and positive semidefinite", wrong, ""),
        ("dependence of a reading on those before it", f"{memory:g}", ""),
    ]
    return table((f"worst of {len(bodies)} bodies", "", "body"), lines)


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
