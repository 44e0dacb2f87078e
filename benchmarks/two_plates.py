"""Pairs of equal conductors in the open, from exact solutions and from a laboratory.

``python benchmarks/two_plates.py`` prints both; ``--step N`` takes every N-th gap of the star.

- Two coaxial discs (Love 1949, ``tests/data/love_discs.csv``).
- Two stars of twelve blades whose distance a screw sets, measured with a capacitance meter
  (``tests/data/star.csv``, which names the source). The stray capacitance of the leads is not
  known: one number is fitted to each series. Gaps of 0.15 to 0.53 mm; below, the screw's zero and
  the flatness of the plates decide.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.design import parse_design
from capsense.field.background import empty_capacitance
from capsense.field.cache import default_settings

Array = NDArray[np.float64]

DATA = Path(__file__).parents[1] / "tests" / "data"
RADIUS, ROOT, HUB, BLADES, WIDTH, TURNED = 0.020, 0.0075, 0.0065, 12, 12.0, 6.0
"""Of the stars: radius of tips, of blades' roots, and within the ring [m]; how many blades, their
width and how far one star is turned against the other [degrees]."""
TWELFTH = 350e-6 / 12
"""What the screw moves in a twelfth of a turn [m]."""
FITTED = range(5, 19)
"""Twelfths of a turn that the stray is fitted to."""


def pair(outline: dict[str, Any], other: dict[str, Any], gap: float) -> Array:
    """Maxwell matrix [F], shape (2, 2), of two shapes a distance apart [m], in the open."""
    design = parse_design(
        {
            "name": "pair",
            "domain": {"size": [0.5, 0.5, 0.5], "backplane": 0.25, "open": True},
            "electrode": [
                {"name": "A", "z": -gap / 2, **outline},
                {"name": "B", "z": gap / 2, **other},
            ],
        }
    )
    return empty_capacitance(design, default_settings(design))


def two_terminals(matrix: Array) -> float:
    """Capacitance [F] between two conductors whose charges add up to nothing."""
    return float((np.linalg.det(matrix)) / matrix.sum())


def love_table() -> Array:
    """Distance over radius, C11, −C12 and the capacitance between them over 8 ε0 R, (n, 4)."""
    rows = (DATA / "love_discs.csv").read_text(encoding="utf-8").splitlines()
    return np.array([r.split(",") for r in rows if r[0].isdigit()], dtype=float)


def discs(ratio: float, radius: float = 0.04) -> Array:
    """C11, −C12 and the capacitance between two discs over 8 ε0 R, shape (3,)."""
    shape = {"shape": "disc", "radius": radius}
    found = pair(shape, shape, ratio * radius)
    return np.array([found[0, 0], -found[0, 1], two_terminals(found)]) / (8 * EPS0 * radius)


def star(turned: float) -> dict[str, Any]:
    """Outline of a star turned by an angle [degrees]; arcs are of chords of two degrees."""
    angles, radii = [], []
    for k in range(BLADES):
        middle = 360.0 / BLADES * k + turned
        edges = middle + np.linspace(-WIDTH / 2, WIDTH / 2, 7)
        between = middle + np.linspace(WIDTH / 2, 360.0 / BLADES - WIDTH / 2, 10)[1:-1]
        angles += [edges[0], *edges, edges[-1], *between]
        radii += [ROOT, *[RADIUS] * len(edges), ROOT, *[ROOT] * len(between)]
    hole = np.radians(np.arange(0.0, 360.0, 6.0))
    around = np.radians(angles)
    return {
        "shape": "polygon",
        "points": np.transpose([radii * np.cos(around), radii * np.sin(around)]).tolist(),
        "holes": [(HUB * np.transpose([np.cos(hole), np.sin(hole)])).tolist()],
    }


def star_table() -> tuple[Array, Array]:
    """Gaps [m], (n,), and what the meter read in two series [F], (n, 2)."""
    with (DATA / "star.csv").open(encoding="utf-8") as file:
        rows = list(csv.reader(line for line in file if line[0].isdigit()))
    table = np.array(rows, dtype=float)
    return TWELFTH * table[:, 0], 1e-12 * table[:, 1:]


def stars(gap: float) -> float:
    """Capacitance between the two stars [F]."""
    return two_terminals(pair(star(0.0), star(TURNED), gap))


def stray(found: Array, read: Array) -> tuple[float, Array]:
    """The stray [F] that makes relative differences least, and what is left of them."""
    weight = 1.0 / read
    fitted = float(np.sum(weight**2 * (read - found)) / np.sum(weight**2))
    return fitted, (found + fitted) / read - 1.0


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=int, default=1, help="every N-th gap of the star")
    args = parser.parse_args()
    print("two discs in the open, against Love: d/R, then C11, C12 and C between them")
    worst = 0.0
    for ratio, *exact in love_table():
        apart = 100.0 * (discs(ratio) / exact - 1.0)
        worst = max(worst, float(np.abs(apart).max()))
        print(f"{ratio:8g}", *(f"{p:+8.3f} %" for p in apart), flush=True)
    print(f"worst {worst:.2f} %\n\nstars: gap [mm], simulated [pF], read [pF] in two series")
    gaps, read = star_table()
    chosen = np.array(FITTED)[:: args.step] - 1
    found = []
    for k in chosen:
        found.append(stars(gaps[k]))
        print(f"{1e3 * gaps[k]:8.3f}", *(f"{1e12 * c:8.3f}" for c in (found[-1], *read[k])),
              flush=True)  # fmt: skip
    for series, column in zip(("first", "second"), read[chosen].T, strict=True):
        fitted, left = stray(np.array(found), column)
        rms = math.sqrt(np.mean(left**2))
        print(f"{series} series: stray {1e12 * fitted:.3f} pF, "
              f"{100 * rms:.2f} % rms, {100 * np.abs(left).max():.2f} % at most")  # fmt: skip


if __name__ == "__main__":
    main()
