"""Reference ΔC of what sensor designers ask for, sensor and object solved as one.

    python benchmarks/reference_designs.py              # writes tests/data/reference_designs.json
    python benchmarks/reference_designs.py --method surface     # errors against that file

A guarded pad, on air and on FR4, bare and under a plastic cover, with a grounded plate before it;
and a pair of pads with a block of plastic before them. The object is put into the design, as a
grounded conductor or a layer, and the package's boundary elements (``capsense.field.boundary``)
solve it, every boundary seeing every other. ΔC is −∮ φ⁰_i σ_j over the object, with the potential
of the design without it and the object's charge with it; where it lies on a layer it is the
difference of the terminals' charges. Two panel sizes are extrapolated. The stated error is what
that adds, or what the terminals' charges say otherwise, whichever is more.

"self" is what a self-mode channel reads, shields driven with the pad; "pad" the diagonal of the
Maxwell matrix, shields at ground; "mutual" the largest entry off the diagonal.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from machine import on_one_core
from numpy.typing import NDArray

import capsense as cs
from capsense.design import parse_design
from capsense.design.model import Role
from capsense.field.boundary import GROUND, Accuracy, BoundarySolution, terminals

Array = NDArray[np.float64]
OUTPUT = Path(__file__).parents[1] / "tests" / "data" / "reference_designs.json"
SCALES, FINE = (1.0, 0.7), (0.7, 0.5)
"""Panel sizes; the second pair for the pair of pads, which has few."""
ORDER = 1.5
"""Power of the panel size that errors go with: between rims, first, and faces, second."""
FEMTO = 1e-15

GUARDED = """name = "guarded_pad"
[domain]
size = [0.5, 0.5, 0.5]
backplane = 0.1
[[electrode]]
name = "pad"
shape = "rectangle"
size = [0.020, 0.020]
[[conductor]]
name = "ring"
role = "shield"
shape = "polygon"
points = [[-0.0153, -0.0153], [0.0153, -0.0153], [0.0153, 0.0153], [-0.0153, 0.0153]]
holes = [[[-0.0103, -0.0103], [0.0103, -0.0103], [0.0103, 0.0103], [-0.0103, 0.0103]]]
[[conductor]]
name = "back"
role = "shield"
shape = "rectangle"
size = [0.0306, 0.0306]
center = [0.0, 0.0, -0.0016]
"""
BOARD = """[[layer]]
name = "board"
eps_r = 4.4
size = [0.040, 0.040]
z = [-0.0016, 0.0]
"""
COVER = """[[layer]]
name = "cover"
eps_r = 3.0
size = [0.060, 0.060]
z = [0.0, 0.003]
"""
PAIR = """name = "pair"
[domain]
size = [0.5, 0.5, 0.5]
backplane = 0.1
[[electrode]]
name = "TX"
shape = "rectangle"
size = [0.020, 0.020]
center = [-0.015, 0.0]
[[electrode]]
name = "RX"
shape = "rectangle"
size = [0.020, 0.020]
center = [0.015, 0.0]
"""
PLATE = (0.060, 0.060, 0.002)
BLOCK = (0.060, 0.040, 0.020)


def plate(gap: float, size: tuple[float, float, float] = PLATE) -> dict[str, Any]:
    """A grounded plate, ``gap`` [m] above the electrodes."""
    return {"shape": "box", "size": list(size), "position": [0.0, 0.0, gap + size[2] / 2],
            "quaternion": [0.0, 0.0, 0.0, 1.0], "kind": "grounded", "eps_r": 1.0}  # fmt: skip


def cases() -> list[dict[str, Any]]:
    """Name, design and body of each, without figures."""
    out = []
    for name, design in (("guarded pad on air", GUARDED), ("guarded pad on FR4", GUARDED + BOARD)):
        for gap in (2, 3, 5):
            out.append((f"{name}, plate at {gap} mm", design, plate(1e-3 * gap)))
    design = GUARDED + BOARD + COVER
    for gap in (3, 4, 5, 8):
        out.append(
            (f"guarded pad on FR4, 3 mm cover, plate at {gap} mm", design, plate(1e-3 * gap))
        )
    block = {**plate(0.005, BLOCK), "kind": "diel", "eps_r": 3.0}
    out.append(("pair, block of eps 3 at 5 mm", PAIR, block))
    return [{"name": n, "design": d, "bodies": [b]} for n, d, b in out]


def with_body(data: dict[str, Any], body: dict[str, Any]) -> dict[str, Any]:
    """The design as a dictionary, the body one of its parts."""
    data = copy.deepcopy(data)
    (sx, sy, sz), (x, y, z) = body["size"], body["position"]
    if body["kind"] == "diel":
        layer = {"name": "object", "eps_r": body["eps_r"], "size": [sx, sy], "center": [x, y],
                 "z": [z - sz / 2, z + sz / 2]}  # fmt: skip
        data.setdefault("layer", []).append(layer)
    else:
        conductor = {"name": "object", "role": "ground", "shape": "box", "size": [sx, sy, sz],
                     "center": [x, y, z]}  # fmt: skip
        data.setdefault("conductor", []).append(conductor)
    return data


def charged(design: cs.Design, scale: float) -> tuple[BoundarySolution, Array]:
    """A design's solution, and charge densities for one volt on each terminal in turn."""
    solution = BoundarySolution(design, Accuracy(scale, fitted=False))
    return solution, solution.densities(np.eye(len(terminals(design))))


def on_object(solution: BoundarySolution, body: dict[str, Any]) -> NDArray[np.int64]:
    """Panels of the object: those of no terminal that lie on its box."""
    model = solution.model
    half, at = np.array(body["size"]) / 2, np.array(body["position"])
    out = np.abs(model.panels.centers - at) - half
    return np.flatnonzero((model.owner < 0) & (np.abs(out.max(axis=1)) < 1e-7))


_EMPTY: dict[tuple[str, float], tuple[BoundarySolution, Array]] = {}


def change(case: dict[str, Any], scale: float) -> tuple[Array, Array, int]:
    """ΔC of the electrodes' matrix with that of the self readings as its last row; the same from
    the terminals' charges; and panels.
    """
    data, body = tomllib.loads(case["design"]), case["bodies"][0]
    design = parse_design(data)
    key = case["design"], scale
    if key not in _EMPTY:
        _EMPTY[key] = charged(design, scale)
    empty, before = _EMPTY[key]
    full, after = charged(parse_design(with_body(data, body)), scale)
    mine = on_object(full, body)
    model, panels = full.model, full.model.panels
    between = (model.eps_front != model.eps_back)[mine] & (model.owner[mine] == GROUND)
    apart = full.terminal_charges(after) - empty.terminal_charges(before)
    delta = apart
    if not between.any():  # else the object lies on a layer, and its free charge is not at hand
        weights = panels.weights[mine]
        panel, _ = np.nonzero(weights)
        phi = empty.potential(panels.quad[mine][weights > 0], before)
        delta = -phi.T @ (weights[weights > 0][:, None] * after[mine][panel])
    n, names = len(design.electrodes), terminals(design)
    shields = [names.index(c.name) for c in design.conductors if c.role == Role.SHIELD]

    def rows(matrix: Array) -> Array:
        matrix = (matrix + matrix.T) / 2
        own = np.diag(matrix)[:n] + matrix[:n, shields].sum(axis=1)
        return np.vstack([matrix[:n, :n], own])

    return rows(delta), rows(apart), panels.size


def converged(case: dict[str, Any]) -> dict[str, Any]:
    """The case with its figures."""
    started = time.perf_counter()
    scales = FINE if case["design"] == PAIR else SCALES
    (coarse, *_), (fine, apart, panels) = (change(case, s) for s in scales)
    best = fine + (fine - coarse) / ((scales[0] / scales[1]) ** ORDER - 1)
    off = np.maximum(np.abs(best - fine), np.abs(apart - fine))
    error = off[[0, -1], [0, 0]] / np.abs(best[[0, -1], [0, 0]])
    rounded = [[float(f"{v:.6g}") for v in row] for row in best / FEMTO]
    print(f"{case['name']:50s} pad {rounded[0][0]:9.3f} fF, error {100 * error[0]:.2f} %; self "
          f"{rounded[-1][0]:9.3f} fF, error {100 * error[1]:.2f} %; {panels} panels, "
          f"{time.perf_counter() - started:.0f} s", flush=True)  # fmt: skip
    return {**case, "delta_fF": rounded[:-1], "self_delta_fF": rounded[-1],
            "error": [float(f"{e:.2g}") for e in error], "panels": panels}  # fmt: skip


def write(found: list[dict[str, Any]]) -> None:
    """The file."""
    text = {
        "about": "A sensor designer's cases; written by benchmarks/reference_designs.py",
        "note": "delta_fF: change of the electrodes' Maxwell matrix, shields at ground; "
        "self_delta_fF: change of what self-mode channels read, shields driven with the electrode; "
        "error: what the extrapolation over two panel sizes adds, or what the terminals' charges "
        "say otherwise, if that is more; relative, of the first entry of each; panels: of sensor "
        "and object in the finer one. Bodies as in reference_map.json.",
        "cases": found,
    }
    OUTPUT.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n")


def compared(method: str, only: str = "") -> Iterator[dict[str, Any]]:
    """Name, the reference's own error, and pairs of reference and reading [fF] of each case: pad,
    mutual (NaN where there is none), self.
    """
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))
    from reference_scenes import body_of_json

    for case in json.loads(OUTPUT.read_text())["cases"]:
        if only not in case["name"]:
            continue
        sim = cs.Simulator(parse_design(tomllib.loads(case["design"])), method=method)
        rest = sim.step(cs.Scene([])).self_capacitance
        reading = sim.step(cs.Scene([body_of_json(b) for b in case["bodies"]]))
        truth, got = np.array(case["delta_fF"]), reading.delta / FEMTO
        mutual = (truth[0, 1], got[0, 1]) if len(truth) > 1 else (np.nan, np.nan)
        own = (case["self_delta_fF"][0], (reading.self_capacitance - rest)[0] / FEMTO)
        yield {"name": case["name"], "error": max(case["error"]),
               "pairs": ((truth[0, 0], got[0, 0]), mutual, own)}  # fmt: skip


def compare(method: str, only: str) -> None:
    """Print errors of a method of the simulator."""
    print(f"{'':50s} {'pad, fF':>10s} {'off %':>7s} {'mutual':>10s} {'off %':>7s} "
          f"{'self, fF':>10s} {'off %':>7s} {'ref. %':>7s}")  # fmt: skip
    for case in compared(method, only):
        cells = "".join(
            f"{'–':>11s} {'–':>7s}" if np.isnan(t) else f" {t:10.3f} {100 * (g / t - 1):+7.2f}"
            for t, g in case["pairs"]
        )
        print(f"{case['name']:50s}{cells} {100 * case['error']:7.2f}", flush=True)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", help="measure a method of Simulator instead of writing")
    parser.add_argument("--only", default="", help="names with this in them")
    args = parser.parse_args()
    if args.method:
        on_one_core()
        compare(args.method, args.only)
        return
    have = {c["name"]: c for c in json.loads(OUTPUT.read_text())["cases"]} if (
        OUTPUT.exists()) else {}  # fmt: skip
    for case in cases():
        if args.only in case["name"]:
            have[case["name"]] = converged(case)
            write([have[c["name"]] for c in cases() if c["name"] in have])


if __name__ == "__main__":
    main()
