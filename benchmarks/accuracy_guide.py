"""Error of ΔC by body, distance and preset, for the accuracy guide.

    python benchmarks/accuracy_guide.py [-o out/errors.json]

Scenes and errors are those of ``accuracy_map.py --scenes all``. A cell is the error of the self
capacitances' change that 95 % of a group's electrodes stay below, in per cent.
``headline.py`` puts the table into the page.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from accuracy_map import DESIGN, MAP, MORE, diagonal_errors, reference_scenes
from machine import on_one_core

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


def column(gap: float) -> str:
    """The column of a gap [m]."""
    return next(name for name, most in GAPS.items() if gap <= most)


def row(category: str) -> str | None:
    """The row of a category of scenes, if it has one."""
    fits = (name for name, words in GROUPS.items() if any(word in category for word in words))
    return next(fits, None)


def errors(preset: str) -> dict[str, float]:
    """Row, column and preset → what 95 % of the errors stay below [%]."""
    sim = cs.Simulator(DESIGN, preset=preset)
    found: dict[tuple[str, str], list[float]] = {}
    for case in (*reference_scenes(MAP), *reference_scenes(MORE)):
        name = row(case.category)
        if name is not None:
            off = np.abs(diagonal_errors(sim.step(case.scene).delta, case.delta))
            found.setdefault((name, column(case.gap)), []).extend(off)
    return {
        f"{name}/{gap}/{preset}": float(100 * np.percentile(found[name, gap], 95))
        for name in GROUPS for gap in GAPS if (name, gap) in found
    }  # fmt: skip


def main() -> None:
    """Print the errors, a line each, or write them to a file."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json")
    options = parser.parse_args()
    on_one_core()
    found = {key: value for preset in PRESETS for key, value in errors(preset).items()}
    for key, value in found.items():
        print(f"{key:50s} {value:6.2f} %")
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"p95": found}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
