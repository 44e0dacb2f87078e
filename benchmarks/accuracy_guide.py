"""Error of ΔC by body, distance and preset, for the accuracy guide.

    python benchmarks/accuracy_guide.py [--write docs/accuracy.md]

Scenes and errors are those of ``accuracy_map.py --scenes all``. A cell is the error of the self
capacitances' change that 95 % of a group's electrodes stay below, in per cent.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from accuracy_map import DESIGN, MAP, MORE, diagonal_errors, reference_scenes
from sizes import write_between

import capsense as cs

GROUPS = {
    "several bodies": ("two ", "three ", "balls ", " + ", "stacked", "overlapping"),
    "wide body, 0.2 to 0.4 m": ("wide",),
    "hand before a body": ("hand",),
    "finger": ("finger",),
    "limb": ("limb", "arm"),
    "ball": ("ball",),
    "box, cylinder, ellipsoid": ("box", "cube", "cylinder", "ellipsoid"),
    "plate, bar": ("plate", "bar"),
}
"""Row → words in the categories of the scenes, the first that fits."""
GAPS = {
    "0.5 to 2 mm": 2e-3, "3 to 8 mm": 9e-3, "10 to 15 mm": 16e-3, "20 to 40 mm": 45e-3,
    "50 to 150 mm": 9.0,
}  # fmt: skip
"""Column → largest gap [m]."""
PRESETS = ("fast", "standard", "fine")
MARKERS = ("<!-- errors -->", "<!-- end of errors -->")


def column(gap: float) -> str:
    """The column of a gap [m]."""
    return next(name for name, most in GAPS.items() if gap <= most)


def row(category: str) -> str | None:
    """The row of a category of scenes, if it has one."""
    fits = (name for name, words in GROUPS.items() if any(word in category for word in words))
    return next(fits, None)


def table(preset: str) -> str:
    """The table of a preset in Markdown."""
    sim = cs.Simulator(DESIGN, preset=preset)
    found: dict[tuple[str, str], list[float]] = {}
    for case in (*reference_scenes(MAP), *reference_scenes(MORE)):
        name = row(case.category)
        if name is not None:
            errors = np.abs(diagonal_errors(sim.step(case.scene).delta, case.delta))
            found.setdefault((name, column(case.gap)), []).extend(errors)
    lines = [f'| `"{preset}"` | ' + " | ".join(GAPS) + " |", "|---" * (1 + len(GAPS)) + "|"]
    for name in GROUPS:
        cells = [found.get((name, gap)) for gap in GAPS]
        shown = ["–" if c is None else f"{100 * np.percentile(c, 95):.1f} %" for c in cells]
        lines.append(f"| {name} | " + " | ".join(shown) + " |")
    return "\n".join(lines)


def main() -> None:
    """Print the tables, or write them into a page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--write", type=Path, metavar="PAGE")
    options = parser.parse_args()
    text = "\n\n".join(map(table, PRESETS))
    if options.write is None:
        print(text)
        return
    write_between(options.write, MARKERS, f"\n{text}\n")


if __name__ == "__main__":
    main()
