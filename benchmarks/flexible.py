"""Cloth, cables and soft bodies that are bent, folded and pressed, against boundary elements.

    python benchmarks/flexible.py                 # errors of the scenes, and times of steps
    python benchmarks/flexible.py --only cloth
    python benchmarks/flexible.py --only soft --formed   # the form of use is given first
    python benchmarks/flexible.py --make          # references of scenes that have none

References are written apart from the package, with all of the sensor's boundary elements
(``near_reference.py``), and extrapolated from two meshes. Soft bodies and cables of a dielectric
are closed surfaces with the flux condition on each panel. Cloth of a dielectric has charges on both
faces of a fine even grid; what polarises it along the sheet is by finite volumes, and across it by
cells. A conducting cloth is one sheet of charge at its middle. The package is given what a
simulator gives: some hundred vertices of a surface, made first in its flat or unloaded form.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from flexible_scenes import (
    COVER,
    COVERED,
    MATTER,
    Cloth,
    ball,
    block,
    cable_points,
    grid_faces,
    scenes,
    soft_map,
)
from numpy.typing import NDArray

import capsense as cs

Array = NDArray[np.float64]
Row = dict[str, Any]

FILE = Path(__file__).parents[1] / "tests" / "data" / "flexible.json"
FEMTO = 1e-15
SCALES = 1.5, 1.0
"""Panels of the two meshes."""
ORDER = 1.5
COUNTS = 0.03
"""Channels count from so much of the largest change on."""
SIDES = 10
"""Sides of a cable in the reference."""


# -- what the package is given ---------------------------------------------------------------------


def design_of(name: str, *, hard: bool = False) -> cs.Design:
    """A design; ``hard`` makes its cover a layer, as references take it."""
    if name != COVERED:
        return cs.load_design(name)
    text = (Path(__file__).parent / "flexible_covered.toml").read_text(encoding="utf-8")
    if hard:
        head, _ = text.split("[[cover]]")
        head = head.replace("z = [-0.001, 0.0]", f"z = [-0.001, {COVER}]")
        text = head.replace('name = "covered"', 'name = "hard"')
    file = Path(__file__).parent / ("_hard.toml" if hard else "flexible_covered.toml")
    if hard:
        file.write_text(text, encoding="utf-8")
    try:
        return cs.load_design(file)
    finally:
        if hard:
            file.unlink()


def material_of(row: Row) -> cs.Material | str:
    """What a body is made of."""
    if row["kind"] == "dielectric" or (row["matter"] in MATTER and row["kind"] == "dielectric"):
        return cs.Material(row["matter"], MATTER[row["matter"]])
    return "steel"


def surface_of(row: Row, *, formed: bool = False) -> cs.DeformableSurface:
    """The scene's surface, as a simulator gives it: in its first form, then bent.

    With ``formed``, its first form is that of the scene.
    """
    options: Row = {
        "material": material_of(row),
        "grounding": "grounded" if row["kind"] == "grounded" else "floating",
    }
    if row["what"] == "cloth":
        vertices, faces = Cloth(row).mesh()
        out = cs.DeformableSurface(Cloth(row).flat(), faces, thickness=row["thickness"], **options)
    elif row["what"] == "cable":
        from capsense.adapters.meshes import tube, tube_faces

        line = cable_points(row, 40)
        straight = np.linspace([-0.5, 0, 0], [0.5, 0, 0], 41) * row["length"] + [0, 0, 0.2]
        faces = tube_faces(len(line))
        out = cs.DeformableSurface(tube(straight, row["radius"]), faces, **options)
        vertices = tube(line, row["radius"])
    else:
        v, faces = ball(8) if row["shape"] == "ball" else block(8)
        out = cs.DeformableSurface(v * row["size"] + [0, 0, 0.2], faces, **options)
        vertices = soft_map(row)(v)
    if formed:
        given = {"thickness": row["thickness"]} if row["what"] == "cloth" else {}
        return cs.DeformableSurface(vertices, faces, **given, **options)
    out.vertices = vertices
    return out


# -- references -----------------------------------------------------------------------------------


class Empty:
    """The matrix of a design's panels, factorised."""

    def __init__(self, name: str, scale: float) -> None:
        import scipy.linalg
        from bem_reference import Panels
        from difficult_reference import EDGE, square
        from near_reference import Feature, Layout, sensor_panels, stops

        design = design_of(name, hard=True)
        layout = Layout(design)
        features = []
        for z, ends, width in layout.edges():
            axis = int(abs(ends[1, 0] - ends[0, 0]) > 1e-9)
            reach = np.sort(ends[:, 1 - axis])
            features.append(Feature(axis, float(ends[0, axis]), *reach.tolist(), z, EDGE * width))
        for layer in design.layers:
            for axis in (0, 1):
                for at in (layer.lower[axis], layer.upper[axis]):
                    low, high = float(layer.lower[1 - axis]), float(layer.upper[1 - axis])
                    least = 0.6 * float(layer.upper[2] - layer.lower[2])
                    features.append(
                        Feature(axis, float(at), low, high, float(layer.upper[2]), least)
                    )
        corners, owner, eps = sensor_panels(layout, features, stops(layout, None), scale)
        self.floor = np.array([0, 0, design.domain.floor])
        self.panels = Panels(corners - self.floor)
        self.held = owner > -2
        matrix = square(self.panels, self.held)
        front, back = eps.T
        at = np.flatnonzero(~self.held)
        ratio = (front + back)[at] / (front - back)[at]
        matrix[at, at] += 2 * math.pi * ratio * self.panels.area[at]
        self.factor = scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)
        unit = np.zeros((len(self.panels), int(owner.max()) + 1))
        driven = np.flatnonzero(owner >= 0)
        unit[driven, owner[driven]] = self.panels.area[driven]
        self.answer = scipy.linalg.lu_solve(self.factor, unit, check_finite=False)

    def change_sheet(self, cloth: Cloth, size: float, eps: float) -> Array:
        """ΔC [F] by a cloth of a dielectric, of cells about so large [m]."""
        import scipy.linalg
        from bem_reference import FARADS, Panels
        from difficult_reference import filled
        from near_integrals import potentials

        row, t = cloth.row, cloth.row["thickness"]
        n, m = (math.ceil(row[k] / size) for k in ("length", "width"))
        faces = []
        for off in (t / 2, -t / 2):
            g = cloth.grid(n, m, off)
            quads = np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]], axis=2)
            faces.append(quads.reshape(-1, 4, 3))
        body = Panels(np.concatenate(faces) - self.floor)
        held = np.ones(len(body), bool)
        right = filled(self.panels, self.held, body)
        answer = scipy.linalg.lu_solve(self.factor, right, check_finite=False)
        rows = filled(body, held, self.panels)
        own, phi = potentials(body, body) - rows @ answer, rows @ self.answer
        own = own / body.area[:, None] / body.area  # of charges, means
        phi = phi / body.area[:, None]
        k, area = n * m, row["length"] / n * row["width"] / m
        half = np.eye(k)
        even, odd = np.vstack([half, half]) / 2, np.vstack([half, -half])
        both = np.hstack([even, odd])
        a, right = both.T @ own @ both, both.T @ phi
        a = 0.5 * (a + a.T)
        # along: charges are the divergence of (eps - 1) t / 4π times the gradient of what is left
        number = np.arange(k).reshape(n, m)
        flow = np.zeros((k, k))
        ratio = row["length"] / n / (row["width"] / m)
        for first, second, g in ((number[:-1], number[1:], 1 / ratio),
                                 (number[:, :-1], number[:, 1:], ratio)):  # fmt: skip
            for i, j in ((first, second), (second, first)):
                np.add.at(flow, (i.ravel(), i.ravel()), g)
                np.add.at(flow, (i.ravel(), j.ravel()), -g)
        flow *= (eps - 1) * t / (4 * math.pi)
        whole = np.eye(2 * k)
        whole[:k] += flow @ a[:k]
        given = right.copy()
        given[:k] = flow @ right[:k]
        # across: a cell's own matter, in series with the gap between its faces
        whole[k:] = a[k:]
        whole[k:, k:] += 4 * math.pi * t / (area * (eps - 1)) * np.eye(k)
        delta = FARADS * right.T @ np.linalg.solve(whole, given)
        return (delta + delta.T) / 2

    def change(self, corners: Array, kind: str, eps: float) -> Array:
        """ΔC [F] by one body; of a dielectric the panels close it, and face out."""
        import scipy.linalg
        from bem_reference import Panels
        from difficult_reference import filled, square
        from near_integrals import potentials
        from near_reference import induced

        body = Panels(corners - self.floor)
        conducts = np.full(len(body), kind != "dielectric")
        own = square(body, conducts)
        if kind == "dielectric":
            lost = 2 * math.pi * body.area - own.sum(axis=0)
            worst = float(np.abs(lost / body.area).max())
            if worst > 1.0:
                raise ValueError(f"the surface is not closed: {worst:.2g}")
            at = np.arange(len(body))
            own[at, at] += lost + 2 * math.pi * (1 + eps) / (1 - eps) * body.area
        right = filled(self.panels, self.held, body)
        answer = scipy.linalg.lu_solve(self.factor, right, check_finite=False)
        rows = filled(body, conducts, self.panels)
        phi = rows @ self.answer
        potential = phi
        if kind == "dielectric":
            potential = potentials(body, self.panels) @ self.answer
        free = [body.area] if kind == "floating" else []
        return induced(own - rows @ answer, phi, potential, free)


@lru_cache(maxsize=1)
def empty(name: str, scale: float) -> Empty:
    """The empty sensor of a design; the last one is kept."""
    return Empty(name, scale)


def reference_panels(row: Row, scale: float) -> Array:
    """Panels of a scene's body, (n, 4, 3) [m]."""
    if row["what"] == "cloth":
        cloth, t = Cloth(row), row["thickness"]
        size = scale * min(max(row["gap"], 5e-3), 7e-3)
        n, m = (math.ceil(row[k] / size) for k in ("length", "width"))
        if row["kind"] != "dielectric":
            n, m = 2 * n, 2 * m
            return triangles_of(cloth.grid(n, m).reshape(-1, 3), grid_faces(n, m))
        top, bottom = (cloth.grid(n, m, off) for off in (t / 2, -t / 2))
        faces = grid_faces(n, m)
        parts = [triangles_of(top.reshape(-1, 3), faces),
                 triangles_of(bottom.reshape(-1, 3), faces[:, ::-1])]  # fmt: skip
        for up, low in ((top[0, ::-1], bottom[0, ::-1]), (top[-1], bottom[-1]),
                        (top[:, 0], bottom[:, 0]), (top[::-1, -1], bottom[::-1, -1])):  # fmt: skip
            parts.append(np.stack([low[:-1], low[1:], up[1:], up[:-1]], axis=1))
        return np.concatenate(parts)
    if row["what"] == "cable":
        n = math.ceil(row["length"] / (scale * min(max(1.2 * row["radius"], 3e-3), 5e-3)))
        sides = round(SIDES / scale)
        ring = 2 * math.pi / sides
        grown = math.sqrt(ring / math.sin(ring))  # of equal area across
        from capsense.adapters.meshes import tube, tube_faces

        points = tube(cable_points(row, n), grown * row["radius"], sides)
        return triangles_of(points, tube_faces(n + 1, sides))
    parts = round(9 / scale)
    v, f = ball(parts) if row["shape"] == "ball" else block(parts)
    return triangles_of(soft_map(row)(v), f)


def triangles_of(vertices: Array, faces: NDArray[np.int64]) -> Array:
    """Triangles as panels of four corners."""
    return vertices[faces][:, [0, 1, 2, 2]]


def referenced(row: Row) -> Row:
    """A scene with ΔC [fF], extrapolated from two meshes, and what that adds as its error."""
    started, found, count = time.perf_counter(), [], 0
    eps = MATTER.get(row["matter"], 1.0)
    for scale in SCALES:
        sensor = empty(row["design"], 1.6)
        if row["what"] == "cloth" and row["kind"] == "dielectric":
            size = (
                scale * min(max(row["gap"], 4e-3), 5e-3) * (0.8 if row["design"] == "patch" else 1)
            )
            found.append(sensor.change_sheet(Cloth(row), size, eps))
            continue
        panels = reference_panels(row, scale)
        found.append(sensor.change(panels, row["kind"], eps))
        count = len(panels)
    coarse, fine = found
    best = fine + (fine - coarse) / ((SCALES[0] / SCALES[1]) ** ORDER - 1)
    largest = float(np.abs(best).max())
    error = float(np.abs(best - fine).max()) / largest
    return {**row, "delta_fF": [[float(f"{v:.5g}") for v in r] for r in best / FEMTO],
            "error": round(error, 4), "panels": count,
            "seconds": round(time.perf_counter() - started)}  # fmt: skip


def make(only: str) -> None:
    """Compute references of scenes that have none."""
    old = json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else []
    known = {r["name"]: r for r in old}
    rows = scenes()
    for row in sorted(rows, key=lambda r: (str(r["design"]), r["kind"])):
        found = known.get(row["name"])
        if found is not None and all(json.dumps(found[k]) == json.dumps(v) for k, v in row.items()):
            continue
        known.pop(row["name"], None)
        if only in row["name"]:
            known[row["name"]] = done = referenced(row)
            print(f"{row['name']:52s} {np.max(np.abs(done['delta_fF'])):9.3f} fF, adds "
                  f"{done['error']:.2%}, {done['panels']} panels, {done['seconds']} s",
                  flush=True)  # fmt: skip
        kept = [known[r["name"]] for r in rows if r["name"] in known]
        FILE.write_text("[\n" + ",\n".join(map(json.dumps, kept)) + "\n]\n", encoding="utf-8")


# -- measuring ------------------------------------------------------------------------------------


def errors(found: Array, row: Row) -> tuple[float, float]:
    """Largest relative error of the channels that count, and of any entry over the largest.

    Channels are the electrodes in self mode, the diagonal.
    """
    truth = FEMTO * np.array(row["delta_fF"])
    m = len(truth)
    largest, own = np.abs(truth).max(), np.diag(truth)
    counts = own >= COUNTS * own.max()
    off = np.abs(np.diag(found)[:m] / np.where(counts, own, 1.0) - 1.0)[counts]
    return float(off.max()), float(np.abs(found[:m, :m] - truth).max() / largest)


def measure(
    only: str = "", preset: str = "standard", *, formed: bool = False
) -> Iterator[tuple[Row, float, float, float, int]]:
    """Scenes, their errors, processor time of a step [s] and unknowns."""
    sims: dict[str, cs.Simulator] = {}
    for row in json.loads(FILE.read_text(encoding="utf-8")):
        if only not in row["name"]:
            continue
        name = row["design"]
        if name not in sims:
            sims[name] = cs.Simulator(design_of(name), preset=preset)
        sim, surface, times = sims[name], surface_of(row, formed=formed), []
        vertices = surface.vertices
        for _ in range(5):
            surface.vertices = vertices + 0.0
            start = time.process_time()
            reading = sim.step(cs.Scene([surface.body()]))
            times.append(time.process_time() - start)
        yield row, *errors(reading.delta, row), min(times), reading.stats.unknowns


def main() -> None:
    """Print the table, or make references."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--make", action="store_true")
    parser.add_argument("--only", default="", help="part of a name")
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--formed", action="store_true", help="give the form of use first")
    given = parser.parse_args()
    if given.make:
        make(given.only)
        return
    print(f"error of channels above {COUNTS:.0%} of the largest, of entries over it; a step")
    for row, error, other, seconds, unknowns in measure(
        given.only, given.preset, formed=given.formed
    ):
        print(f"{row['name']:44s} {1e3 * row['gap']:5.1f} mm {100 * error:6.1f} %"
              f" {100 * other:6.1f} %"
              f"   {1e3 * seconds:5.2f} ms  {unknowns:4d}   (reference {row['error']:.1%})",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
