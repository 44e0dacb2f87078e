"""The packaged materials, as the table of the docs.

python benchmarks/materials.py                              # print the table
python benchmarks/materials.py --write docs/materials.md    # replace the one of the page
"""

from __future__ import annotations

import argparse
from pathlib import Path

from pages import write_between

from capsense.scene.materials import DATA, MATERIALS

MARKERS = ("<!-- materials -->", "<!-- end of materials -->")


def table() -> str:
    """Materials and paths to ground of ``materials.toml``, in Markdown."""
    lines = ["| material | ε<sub>r</sub> | σ (S/m) | source |", "| --- | --- | --- | --- |"]
    for name, m in MATERIALS.items():
        sigma = f"{m.sigma:.3g}" if m.sigma else "–"
        lines.append(f"| {name} | {m.eps_r:g} | {sigma} | {m.source} |")
    conductors = [name for name, m in MATERIALS.items() if m.is_conductor()]
    lost = [name for name in conductors if not MATERIALS[name].is_conductor(1e6)]
    lines += [
        "",
        f"Conductors at 250 kHz: {', '.join(conductors)}; at 1 MHz not: {', '.join(lost)}.",
    ]
    other = ", ".join(f"{new} = {old}" for new, old in DATA["aliases"].items())
    lines += ["", f"Other names: {other}.", ""]
    lines += [
        "| path to ground | C (pF) | in series (Ω) | source |",
        "| --- | --- | --- | --- |",
    ]
    for name, path in DATA["ground_paths"].items():
        series = f"{path['series']:g}" if "series" in path else "–"
        farads = f"{path['capacitance'] * 1e12:g}"
        lines.append(f"| {name} | {farads} | {series} | {path['source']} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", type=Path, metavar="PAGE", help="page to put the table into")
    page: Path | None = parser.parse_args().write
    if page is None:
        print(table())
    else:
        write_between(page, MARKERS, table())


if __name__ == "__main__":
    main()
