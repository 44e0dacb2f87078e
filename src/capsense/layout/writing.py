"""Designs of layouts as readable TOML."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

WIDTH = 100
"""Columns of a line."""


def design_text(
    head: Sequence[str], content: Mapping[str, Any], layers: Mapping[str, Iterable[str]]
) -> str:
    """A design file: comments, the design's content, and the copper layers of each net."""
    lines = [f"# {line}" for line in head] + [""]
    lines += [f"{key} = {value_text(content[key])}" for key in ("name", "description")]
    lines += ["", "[domain]", *_keys(content["domain"])]
    for key in ("electrode", "layer", "conductor"):
        for row in content.get(key, []):
            remark = f"  # {', '.join(layers[row['name']])}" if key != "layer" else ""
            lines += ["", f"[[{key}]]{remark}", *_keys(row)]
    return "\n".join(lines) + "\n"


def _keys(table: Mapping[str, Any]) -> list[str]:
    out = []
    for key, value in table.items():
        if key == "polygons":
            out.append("polygons = [")
            for row in value:
                out += _polygon(row)
            out.append("]")
        elif key in ("points", "holes"):
            out += _wrapped(f"{key} = ", value, "")
        else:
            out.append(f"{key} = {value_text(value)}")
    return out


def _polygon(row: Mapping[str, Any]) -> list[str]:
    """One outline as an inline table, which ends where its last line does."""
    start = "  { " + (f"z = {value_text(row['z'])}, " if "z" in row else "") + "points = "
    lines = _wrapped(start, row["points"], "    ")
    if "holes" in row:
        lines[-1] += ", holes = ["
        for hole in row["holes"]:
            lines += _wrapped("      ", hole, "      ")
            lines[-1] += ","
        lines.append("    ]")
    lines[-1] += " },"
    return lines


def _wrapped(start: str, values: Sequence[Any], indent: str) -> list[str]:
    """A list on as few lines as fit; line breaks are allowed within brackets."""
    cells = [value_text(v) for v in values]
    if len(start) + sum(map(len, cells)) + 2 * len(cells) < WIDTH - 4:
        return [f"{start}[{', '.join(cells)}]"]
    lines = [start + "["]
    line = f"{indent}   "
    for cell in cells:
        if len(line) + len(cell) + 2 > WIDTH:
            lines.append(line)
            line = f"{indent}   "
        line += f" {cell},"
    return [*lines, line, f"{indent}]"]


def value_text(value: Any) -> str:
    """A value of TOML."""
    if isinstance(value, list):
        return f"[{', '.join(value_text(v) for v in value)}]"
    if isinstance(value, float):
        text = f"{value:.7f}".rstrip("0")
        return text + "0" if text.endswith(".") else text
    return json.dumps(value, ensure_ascii=False)
