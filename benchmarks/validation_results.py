"""Tables of ``validation.py`` from what other commands have left in files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from capsense.reproduce import STUDIES

SMOOTHNESS = "python benchmarks/smoothness.py -o out/smoothness.json"
Cells = Sequence[object]


def table(header: Cells, lines: Sequence[Cells]) -> str:
    """A table in Markdown."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join(f"| {' | '.join(str(c) for c in row)} |" for row in rows)


def smoothness(path: Path) -> str:
    """What ``benchmarks/smoothness.py`` found, a line a body."""
    if not path.exists():
        return f"Not measured in this edition: `{SMOOTHNESS}`."
    found = json.loads(path.read_text(encoding="utf-8"))
    lines = []
    for name, f in next(iter(found.values())).items():
        inside = max(f[way] for way in ("approach", "slide", "turn z", "turn y"))
        jumps = ", ".join(f"{100 * v:.2f}" for v in f["contact"])
        counts = f"{f['falls'][1]}, {sum(f['wrong'])}, {f['memory']:g}"
        lines.append((name, f"{inside:.1e}", f"{f['wall']:.1e}", jumps, counts))
    head = ("body", "second difference", "through a wall", "jump, %", "falls, wrong, memory")
    return table(head, lines)


def studies(folder: Path) -> str:
    """What every study of ``capsense reproduce`` judges."""
    lines = []
    for name in STUDIES:
        path = folder / name / "rows.json"
        if not path.exists():
            lines.append(
                (name, f"not run in this edition: `capsense reproduce {name}`", "", "", "")
            )
            continue
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["reduced"]:
            raise SystemExit(f"{path} is of the reduced form; run: capsense reproduce {name}")
        lines += [
            (name, r["what"], f"{r['value']:.4g} {r['unit']}".strip(), r["target"], r["verdict"])
            for r in found["rows"]
            if r["verdict"] in ("met", "missed")
        ]
    return table(("study", "what", "value", "target", "verdict"), lines)
