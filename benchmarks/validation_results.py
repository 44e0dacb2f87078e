"""Tables of ``validation.py`` from what other commands have left in files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from capsense.reproduce import STUDIES

BOARDS = "python benchmarks/boards.py stripe patch"
SMOOTHNESS = "python benchmarks/smoothness.py -o out/smoothness.json"
ELEMENTS = "python benchmarks/peers_bem.py -o out/peers_bem.json"
Cells = Sequence[object]


def table(header: Cells, lines: Sequence[Cells]) -> str:
    """A table in Markdown."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join(f"| {' | '.join(str(c) for c in row)} |" for row in rows)


def _load(path: Path, command: str) -> Any:
    """The file's content, or the sentence that it was not made."""
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    return f"Not measured in this edition: `{command}`."


def boards(path: Path) -> str:
    """What ``benchmarks/boards.py`` printed."""
    if not path.exists():
        return f"Not measured in this edition: `{BOARDS}`; half an hour."
    return f"`{BOARDS}`:\n\n```\n{path.read_text(encoding='utf-8').strip()}\n```"


def smoothness(path: Path) -> str:
    """What ``benchmarks/smoothness.py`` found, a line a body."""
    found = _load(path, SMOOTHNESS)
    if isinstance(found, str):
        return found
    lines = []
    for name, f in next(iter(found.values())).items():
        contact = ", ".join(f"{100 * v:.2f}" for v in f["contact"])
        ways = [f"{f[w]:.1e}" for w in ("approach", "slide", "wall", "turn z", "turn y")]
        lines.append((name, *ways, f["falls"][1], contact, sum(f["wrong"]), f"{f['memory']:g}"))
    head = ("body", "approach", "slide", "through a wall", "turn about z", "about y",
            "steps in which C falls", "jump, %: 8–2, 2–1, 1–0.5, 0.5–0.05 mm", "wrong",
            "memory")  # fmt: skip
    return table(head, lines)


def elements(path: Path) -> str:
    """Time and error beside other boundary elements."""
    found = _load(path, ELEMENTS)
    if isinstance(found, str):
        return found
    rows: dict[str, list[Any]] = {}
    scenes = list(dict.fromkeys(r["scene"] for r in found["results"]))
    for r in found["results"]:
        ms = f"{r['ms']:.0f}" if r["ms"] >= 100 else f"{r['ms']:.2g}"
        rows.setdefault(r["label"], [r["label"]]).append(f"{ms}, {r['worst']:+.2f} %")
    return table(("step, ms, and worst error of the diagonal", *scenes), list(rows.values()))


def studies(folder: Path) -> str:
    """The rows of every study of ``capsense reproduce``."""
    blocks = []
    for name in STUDIES:
        path = folder / name / "rows.json"
        if not path.exists():
            blocks.append(f"### {name}\n\nNot run in this edition: `capsense reproduce {name}`.")
            continue
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["reduced"]:
            raise SystemExit(f"{path} is of the reduced form; run: capsense reproduce {name}")
        lines = [
            (r["what"], f"{r['value']:.4g} {r['unit']}".strip(), r["target"], r["verdict"])
            for r in found["rows"]
        ]
        grid = table(("what", "value", "target", "verdict"), lines)
        blocks.append(f"### {found['title']}\n\n`capsense reproduce {name}`\n\n{grid}")
    return "\n\n".join(blocks)
