"""Fig. 8 of the paper: time of a step against the size of the problem; and the error at each size.

A grounded bar of 150 × 150 × 20 mm moves over six electrodes, twice the paper's number, at
0.116 m/s and 100 steps a second. Beside CapSense's presets runs the paper's own scheme on meshes of
several sizes.
"""

from __future__ import annotations

import csv
import os
import platform
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense._style import COLOURS, INK, LEGEND, dress
from capsense.bench import moving_bar, reference_bar, time_steps
from capsense.field.background import BuildSettings
from capsense.masked import plan_axes
from capsense.reproduce.harness import Cell, Outcome, Report, ReportTable, Row, Store, judged, notes
from capsense.simulator import Method, PresetName

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DESIGN = "six_patch_bare"
PRESETS: tuple[PresetName, ...] = ("fast", "standard", "fine")
REFINEMENTS = (0.43, 0.65, 0.8, 1.0)
"""Meshes of the paper's scheme, as multiples of the default's nodes along an axis."""
REDUCED = (0.43, 0.65)
SIZE = 30_000
"""Tetrahedra at which times are compared: "107 ms" in the paper's abstract."""
REFERENCE = {
    5: (1.28217, 1.251612),
    10: (0.480042, 0.457199),
    20: (0.139413, 0.12749),
    50: (0.016555, 0.014443),
    100: (0.002284, 0.002031),
}
"""By gap [mm]: change [pF] of the diagonal by the bar at x = 0, corner and middle electrodes.

Galerkin boundary elements, two panel densities extrapolated, good to 4.4e-4 pF and, as differences
of cases that share their discretisation, better than that."""
MIDDLE = (1, 4)
"""Indices of the middle electrodes."""
_LABELS: dict[Method, str] = {"surface": "CapSense", "fem_masked": "paper's scheme, this machine"}


@dataclass(frozen=True, eq=False)
class Point:
    """What one method does at one size."""

    method: Method
    setting: str
    """The preset, or how many times as many nodes an axis has as by default."""
    tetrahedra: int
    """Of the paper's scheme; 0 for CapSense, which has no mesh."""
    unknowns: float
    """Charge functions or free nodes, median over the steps."""
    median: float
    """Processor's time of a step [ms], and …"""
    p95: float
    p99: float
    errors: tuple[float, ...]
    """Largest relative error of the diagonal at each gap of :data:`REFERENCE`."""


def paper_figure() -> tuple[Array, Array]:
    """The paper's Fig. 8: elements, and time of a step [ms], each of shape (n,)."""
    text = (resources.files("capsense.reproduce") / "data" / "fig8_step_time.csv").read_text()
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    return (
        np.array([float(row["elements"]) for row in rows]),
        np.array([float(row["time_ms"]) for row in rows]),
    )


def at_size(elements: Array, times: Array, size: float) -> float:
    """Time at a mesh size, by interpolation on log scales.

    Raises:
        ValueError: The size lies outside the sizes given.
    """
    order = np.argsort(elements)
    n, t = elements[order], times[order]
    if not n[0] <= size <= n[-1]:
        raise ValueError(f"size is {size}; it lies outside {n[0]:g} to {n[-1]:g}")
    return float(np.exp(np.interp(np.log(size), np.log(n), np.log(t))))


def exponent(elements: Array, times: Array) -> float:
    """b of the fit times ~ elements^b, by least squares on log scales."""
    return float(np.polyfit(np.log(elements), np.log(times), 1)[0])


def measure(store: Store, method: Method, setting: str, steps: int) -> Point:
    """Times and errors of a method at a preset, or at a refinement of its mesh.

    They come from disk if this machine has measured them.
    """

    def compute() -> dict[str, Array]:
        sim, cells = _simulator(method, setting)
        found = time_steps(sim, lambda k: moving_bar(145 + k), steps)
        errors = [_error(sim, gap) for gap in REFERENCE]
        times = [found[key] for key in ("unknowns", "median_ms", "p95_ms", "p99_ms")]
        return {"figures": np.array([cells, *times]), "errors": np.array(errors)}

    inputs = {
        "setting": setting, "method": method, "steps": steps,
        "machine": [platform.node(), platform.machine(), os.cpu_count()],
    }  # fmt: skip
    arrays = store.get(f"{method}-{setting}", inputs, compute)
    cells, unknowns, median, p95, p99 = arrays["figures"].tolist()
    errors = tuple(arrays["errors"].tolist())
    return Point(method, setting, int(cells), unknowns, median, p95, p99, errors)


def _simulator(method: Method, setting: str) -> tuple[cs.Simulator, float]:
    """The simulator, and the number of its tetrahedra."""
    if method == "surface":
        return cs.Simulator(DESIGN, preset=cast("PresetName", setting)), 0.0
    mesh = BuildSettings().mesh.refined(float(setting))
    sim = cs.Simulator(DESIGN, settings=BuildSettings(mesh=mesh), method=method)
    return sim, 6.0 * float(np.prod([len(c) - 1 for c in plan_axes(sim.design, mesh)]))


def _error(sim: cs.Simulator, gap: int) -> float:
    corner, middle = REFERENCE[gap]
    truth = np.full(6, corner)
    truth[list(MIDDLE)] = middle
    found = np.diag(sim.step(reference_bar(gap=1e-3 * gap)).delta)
    return float(np.abs(1e12 * found / truth - 1).max())


def run(folder: Path, *, reduced: bool, report: Report) -> Outcome:
    """Carry the study out; see :class:`capsense.reproduce.harness.Study`."""
    store = Store(folder)
    meshes = REDUCED if reduced else REFINEMENTS
    todo: list[tuple[Method, str]] = [("surface", preset) for preset in PRESETS]
    todo += [("fem_masked", f"{refinement:g}") for refinement in meshes]
    counts = {"surface": 30 if reduced else 600, "fem_masked": 5 if reduced else 25}
    points = []
    for k, (method, setting) in enumerate(todo):
        report(f"{_LABELS[method]}, {setting}", k / len(todo))
        points.append(measure(store, method, setting, counts[method]))
    report("done", 1.0)
    return Outcome(
        "Fig. 8: time of a step against the size of the mesh",
        tuple(_rows(points)),
        {"fig8": _table(points), "fig8_paper": _paper_table()},
        {"fig8": _plot(points)},
        notes("fig8"),
        store.told(),
    )


def _curve(points: list[Point]) -> tuple[Array, Array]:
    """Tetrahedra and times [ms] of the paper's scheme."""
    mine = [p for p in points if p.method == "fem_masked"]
    return np.array([p.tetrahedra for p in mine], float), np.array([p.median for p in mine])


def _rows(points: list[Point]) -> list[Row]:
    paper, masked = paper_figure(), _curve(points)
    there, again = at_size(*paper, SIZE), at_size(*masked, SIZE)
    at = f"at {SIZE:,d} tetrahedra"
    usual = next(p for p in points if p.setting == "standard")
    return [
        Row(f"time of a step {at}, the paper, three electrodes", there, "ms"),
        Row(f"time of a step {at}, the paper's scheme here, six electrodes", again, "ms"),
        judged("time of a step, CapSense, six electrodes", usual.median, "ms", below=1.0,
               source="our aim"),
        Row("unknowns of CapSense", usual.unknowns),
        judged("the paper's time over ours", there / usual.median, "", above=100.0,
               source="our aim"),
        Row("time of the paper's scheme over CapSense's, this machine", again / usual.median),
        judged(
            "largest error of ΔC, CapSense, gaps 5 to 100 mm", 100 * max(usual.errors),
            "%", below=3.0, source="our aim",
        ),
        Row("growth: exponent of the time, the paper", exponent(*paper)),
        Row("growth: exponent of the time, the paper's scheme here", exponent(*masked)),
    ]  # fmt: skip


def _table(points: list[Point]) -> ReportTable:
    columns = ("method", "preset or refinement", "tetrahedra", "unknowns", "median [ms]",
               "95 % [ms]", "99 % [ms]",
               *(f"error at {gap} mm [%]" for gap in REFERENCE))  # fmt: skip
    rows: list[tuple[Cell, ...]] = [
        (_LABELS[p.method], p.setting, p.tetrahedra or "–", p.unknowns, p.median, p.p95, p.p99,
         *(100 * e for e in p.errors))
        for p in points
    ]  # fmt: skip
    return ReportTable(columns, tuple(rows))


def _paper_table() -> ReportTable:
    rows: list[tuple[Cell, ...]] = [(int(n), t) for n, t in zip(*paper_figure(), strict=True)]
    return ReportTable(("elements", "time [ms]"), tuple(rows))


def _plot(points: list[Point]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 4.5), layout="constrained")
    times, errors = figure.subplots(1, 2, sharex=True)
    times.loglog(*paper_figure(), "s-", color=INK, label="the paper, i7 3.4 GHz, 3 electrodes")
    for method, colour, marker in (("fem_masked", COLOURS[1], "^"), ("surface", COLOURS[0], "o")):
        mine = [p for p in points if p.method == method]
        sizes = [p.tetrahedra or p.unknowns for p in mine]
        label = f"{_LABELS[mine[0].method]}, 6 electrodes"
        times.loglog(sizes, [p.median for p in mine], f"{marker}-", color=colour, label=label)
        worst = [100 * max(p.errors) for p in mine]
        errors.loglog(sizes, worst, f"{marker}-", color=colour)
    size = "tetrahedra; for CapSense, charge functions"
    dress(times, size, "time of a step, median [ms]")
    dress(errors, size, "largest error of ΔC$_{ii}$,\ngaps 5 to 100 mm [%]")
    figure.legend(loc="outside lower center", ncols=3, **LEGEND)
    return figure
