"""Designs as people draw them: ``python benchmarks/designer_cases.py [case ...]``.

``pair`` and ``grid``: mutual capacitances on an FR4 board with the default panels beside those with
panels half as large, which takes some minutes. ``array``: 4 x 4 pads over 1 m in a box of 3 m, what
building it takes, and a cube of 0.1 m over it beside boundary elements. ``parts``: a pad under
covers of several shapes, and a plate over them beside boundary elements.
"""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import boards
import numpy as np
import trimesh

import capsense as cs
from capsense.design import parse_design
from capsense.field.background import build_background
from capsense.field.boundary import Accuracy, BoundarySolution, terminals

FEMTO = 1e-15


def pads(places: list[tuple[float, float]], side: float) -> list[dict[str, Any]]:
    """Square electrodes."""
    return [
        {"name": f"E{k + 1}", "shape": "rectangle", "size": [side, side], "center": list(place)}
        for k, place in enumerate(places)
    ]


def grid(count: int, pitch: float) -> list[tuple[float, float]]:
    """Middles of count x count pads [m], row by row."""
    at = [round((k - 0.5 * (count - 1)) * pitch, 9) for k in range(count)]
    return [(x, y) for y in at for x in at]


def board(width: float, height: float) -> dict[str, Any]:
    return {"name": "board", "eps_r": 4.4, "size": [width, height], "z": [-0.0016, 0.0]}


DOMAIN = {"size": [0.4, 0.4, 0.4], "backplane": 0.1}
PAIR = {
    "name": "pair with a ground strip, FR4",
    "domain": DOMAIN,
    "electrode": pads([(-0.0115, 0.0), (0.0115, 0.0)], 0.020),
    "conductor": [
        {"name": "strip", "role": "ground", "shape": "rectangle", "size": [0.001, 0.020]}
    ],
    "layer": [board(0.050, 0.030)],
}
GRID = {
    "name": "4 x 4 pads of 8 mm, gaps of 1 mm, FR4",
    "domain": DOMAIN,
    "electrode": pads(grid(4, 0.009), 0.008),
    "layer": [board(0.040, 0.040)],
}
ARRAY = {
    "name": "4 x 4 pads over 1 m",
    "domain": {"size": [3.0, 3.0, 3.0], "backplane": 0.2},
    "electrode": pads(grid(4, 0.25), 0.225),
}
COVERED = {
    "name": "a pad under a cover",
    "domain": {"size": [0.3, 0.3, 0.3], "backplane": 0.05},
    "electrode": [{"name": "E", "shape": "disc", "radius": 0.012}],
    "conductor": [{"name": "g", "role": "ground", "shape": "disc", "radius": 0.025, "z": -0.002}],
}
COVER = {"name": "cover", "eps_r": 3.0}
COVERS: dict[str, dict[str, Any]] = {
    "slab": {"size": [0.036, 0.036], "z": [0.0, 0.004]},
    "box": {"shape": "box", "size": [0.036, 0.036, 0.004], "z": 0.002},
    "disc": {"shape": "cylinder", "radius": 0.020, "length": 0.004, "z": 0.002},
    "dome": {"shape": "stl", "file": "dome.stl", "unit": "mm"},
}
FINER = {"pair": 0.35, "grid": 0.5}
"""Size of the finer panels over that of the default: what memory allows."""
ENTRIES = {"pair": [(0, 0), (0, 1)], "grid": [(0, 0), (5, 5), (0, 1), (5, 6), (0, 2), (5, 10)]}


def matrix(design: cs.Design, scale: float) -> tuple[np.ndarray, int]:
    """Maxwell matrix [F], and how many panels it took."""
    solution = BoundarySolution(design, Accuracy(scale))
    charges = solution.terminal_charges(solution.densities(np.eye(len(terminals(design)))))
    return 0.5 * (charges + charges.T), solution.model.panels.size


def compare(name: str, data: dict[str, Any]) -> None:
    """Default panels beside finer ones."""
    design = parse_design(data)
    (default, few), (finer, many) = matrix(design, 1.0), matrix(design, FINER[name])
    print(f"{data['name']}: {few} and {many} panels")
    for i, j in ENTRIES[name]:
        a, b = default[i, j], finer[i, j]
        print(
            f"  C{i + 1},{j + 1} {a / FEMTO:9.2f} {b / FEMTO:9.2f} fF {100 * (a / b - 1):+6.2f} %"
        )


def array() -> None:
    """Time and memory of a large array, and a body over it."""
    design = parse_design(ARRAY)
    start, busy = time.perf_counter(), time.process_time()
    field = build_background(design)
    took, busy = time.perf_counter() - start, time.process_time() - busy
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    took_text = f"{took:.0f} s, of processors {busy:.0f} s"
    print(f"{design.name}: {field.n_panels} panels, {took_text}, {memory / 1e6:.2f} GB")
    solution = BoundarySolution(design)
    empty = solution, solution.densities(np.eye(len(terminals(design))))
    sim = cs.Simulator(design, background=field)
    boards.SIZE = (0.1, 0.1, 0.1)
    for gap in (0.03, 0.1, 0.2):
        centre = np.array([0.125, 0.125, gap + 0.05])
        wanted = np.diag(boards.reference(design, centre, empty, 1.0))
        body = cs.Body(cs.Box(boards.SIZE), cs.Pose(tuple(centre)), "steel")
        error = np.diag(sim.step(cs.Scene([body])).delta) - wanted
        worst = 100 * np.abs(error).max() / wanted.max()
        below = 100 * error[wanted.argmax()] / wanted.max()
        place = f"cube {1e3 * gap:3.0f} mm above a pad"
        print(f"  {place}: {below:+.1f} % there, worst of all {worst:.1f} % of it")


def dome(folder: Path) -> None:
    """Write half a ball of 20 mm radius, flat below, in millimetres."""
    ball = trimesh.creation.icosphere(3, 20.0).vertices
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    foot = 20.0 * np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    points = np.concatenate([ball[ball[:, 2] > 1e-6], foot])
    trimesh.convex.convex_hull(points).export(folder / "dome.stl")


def parts() -> None:
    """A pad of 12 mm radius over a ground of 25 mm, under covers of permittivity 3."""
    with TemporaryDirectory() as folder:
        dome(Path(folder))
        for name, cover in COVERS.items():
            design = parse_design({**COVERED, "layer": [{**cover, **COVER}]}, folder=Path(folder))
            solution = BoundarySolution(design)
            empty = solution, solution.densities(np.eye(len(terminals(design))))
            baseline = solution.terminal_charges(empty[1])[0, 0]
            print(f"{name}: {solution.model.panels.size} panels, C {baseline / FEMTO:.1f} fF")
            sim = cs.Simulator(design, background=build_background(design))
            boards.SIZE = (0.06, 0.06, 0.02)
            for gap in (0.003, 0.005, 0.02, 0.05):
                centre = np.array([0.0, 0.0, design.layers[0].upper[2] + gap + 0.01])
                wanted = boards.reference(design, centre, empty, 1.0)[0, 0]
                body = cs.Body(cs.Box(boards.SIZE), cs.Pose(tuple(centre)), "steel")
                error = 100 * (sim.step(cs.Scene([body])).delta[0, 0] / wanted - 1)
                print(f"  plate {1e3 * gap:.0f} mm above: {wanted / FEMTO:.2f} fF, {error:+.1f} %")


def main() -> None:
    """Run the cases that are named, or all."""
    chosen = sys.argv[1:] or ["pair", "grid", "array", "parts"]
    for name in chosen:
        if name == "array":
            array()
        elif name == "parts":
            parts()
        else:
            compare(name, {"pair": PAIR, "grid": GRID}[name])


if __name__ == "__main__":
    main()
