"""Errors of ΔC against boundary elements over a map of scenes, and what a step costs.

    python benchmarks/accuracy_map.py                           # the default method and preset
    python benchmarks/accuracy_map.py --presets fast standard fine -o out/accuracy_time.png
    python benchmarks/accuracy_map.py --method fem_masked --worst 0
    python benchmarks/accuracy_map.py --settings refine=1.5

Every method is run with every preset and all settings, a point each of a curve of error against
time, which is printed last and drawn by ``-o FILE.png``. Settings are arguments of ``Simulator``;
besides, ``refine=1.5`` makes panels and the masked scheme's mesh finer by that along each axis.

Scenes are those of ``tests/data/reference_map.json`` and ``reference_more.json``, over
``six_patch_bare``; the references' own error is about 0.3 % (the files say how it is known).
"diagonal": (ΔC_ii − reference) over the reference, or over 1 % of the scene's largest entry where
that is more. "others": entries off the diagonal, over the scene's largest. A reading is made from
rest; a time is the median of steps that follow it, 0.1 mm apart, on one core, and the table's time
is the median over scenes.
"""

from __future__ import annotations

import argparse
import ast
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine, on_one_core
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from reference_scenes import (
    DESIGN,
    MAP,
    MORE,
    ReferenceScene,
    diagonal_errors,
    other_errors,
    reference_scenes,
)

import capsense as cs

Array = NDArray[np.float64]
TIMED = 5
"""Steps of which a scene's time is the median."""
NUDGE = 1e-4
"""How far bodies move from one of them to the next [m], along x."""
Configuration = tuple[str, dict[str, Any]]
"""A label, and arguments of ``Simulator``."""


def parse_settings(text: str) -> dict[str, Any]:
    """Arguments of ``Simulator`` from ``name=value,name=value``."""
    out: dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        try:
            out[name.strip()] = ast.literal_eval(value)
        except (SyntaxError, ValueError):
            out[name.strip()] = value
    if "refine" in out:
        from capsense.field.background import BuildSettings

        out["settings"] = BuildSettings().refined(float(out.pop("refine")))
    return out


def configurations(
    methods: list[str], presets: list[str], settings: list[str]
) -> list[Configuration]:
    """Every method, or the default one, with every preset and all settings."""
    out = []
    for method in methods or ["surface"]:
        for preset in presets or [""]:
            for text in settings or [""]:
                label = " ".join(filter(None, (method, preset, text)))
                named = {"preset": preset} if preset else {}
                out.append((label, {"method": method, **named, **parse_settings(text)}))
    return out


def moved(scene: cs.Scene, x: float) -> cs.Scene:
    """The scene with all bodies shifted along x [m]."""
    bodies = []
    for body in scene.bodies:
        (a, b, c), turn = body.pose.position, body.pose.quaternion
        bodies.append(body.moved(cs.Pose((a + x, b, c), turn)))
    return cs.Scene(bodies)


def measure(sim: cs.Simulator, case: ReferenceScene) -> dict[str, Any]:
    """Errors and time of one scene; a step that fails says why instead."""
    try:
        sim.reset()
        delta = sim.step(case.scene).delta
        if not np.isfinite(delta).all():
            return {"name": case.name, "failed": "not finite"}
        times = Times()
        for k in range(TIMED):
            scene = moved(case.scene, NUDGE * (k + 1))
            times.take(partial(sim.step, scene))
    except (cs.CapSenseError, np.linalg.LinAlgError, FloatingPointError) as error:
        return {"name": case.name, "failed": f"{type(error).__name__}: {error}"}
    return {
        "name": case.name, "category": case.category, "gap": case.gap, "reference": case.error,
        "diagonal": diagonal_errors(delta, case.delta),
        "others": other_errors(delta, case.delta),
        "ms": float(np.median(times.processor)),
    }  # fmt: skip


def run(configuration: Configuration, cases: list[ReferenceScene]) -> list[dict[str, Any]]:
    """One row a scene."""
    sim = cs.Simulator(DESIGN, **configuration[1])
    for case in cases[:3]:  # compiles
        measure(sim, case)
    return [measure(sim, case) for case in cases]


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Figures of some scenes, errors in per cent."""
    diagonal = 100 * np.concatenate([r["diagonal"] for r in rows])
    others = 100 * np.concatenate([r["others"] for r in rows])
    return {
        "scenes": len(rows),
        "rms": float(np.sqrt((diagonal**2).mean())),
        "p95": float(np.percentile(np.abs(diagonal), 95)),
        "worst": float(np.abs(diagonal).max()),
        "mean": float(diagonal.mean()),
        "others_rms": float(np.sqrt((others**2).mean())),
        "others_p95": float(np.percentile(np.abs(others), 95)),
        "others_worst": float(np.abs(others).max()),
        "ms": float(np.median([r["ms"] for r in rows])),
        "slowest_ms": float(np.max([r["ms"] for r in rows])),
    }


HEADER = (
    f"{'':38s} {'':>3s}  {'diagonal, %':>27s}  {'others, %':>20s}  {'step, ms':>14s}\n"
    f"{'category':38s} {'n':>3s}  {'rms':>6s} {'p95':>6s} {'worst':>6s} {'mean':>6s}  "
    f"{'rms':>6s} {'p95':>6s} {'worst':>6s}  {'median':>7s} {'slowest':>7s}"
)


def line(name: str, s: dict[str, float]) -> str:
    """A row of the table."""
    return (
        f"{name:38s} {s['scenes']:3.0f}  {s['rms']:6.2f} {s['p95']:6.2f} {s['worst']:6.2f} "
        f"{s['mean']:+6.2f}  {s['others_rms']:6.2f} {s['others_p95']:6.2f} "
        f"{s['others_worst']:6.2f}  {s['ms']:7.3f} {s['slowest_ms']:7.3f}"
    )


def report(label: str, rows: list[dict[str, Any]], worst: int) -> dict[str, Any]:
    """Print a configuration's table and return its figures."""
    good = [r for r in rows if "failed" not in r]
    out: dict[str, Any] = {"label": label, "failed": len(rows) - len(good), "categories": {}}
    print(f"\n{label}\n{HEADER}")
    for category in sorted({r["category"] for r in good}):
        out["categories"][category] = summary([r for r in good if r["category"] == category])
        print(line(category, out["categories"][category]))
    if good:
        out["all"] = summary(good)
        print(line("all", out["all"]))
    for row in rows:
        if "failed" in row:
            print(f"FAILED: {row['name']}: {row['failed']}")
    good.sort(key=lambda r: -np.abs(r["diagonal"]).max())
    if worst:
        print("largest errors of the diagonal:")
    for r in good[:worst]:
        k = int(np.abs(r["diagonal"]).argmax())
        print(f"  {r['name']:42s} E{k + 1} {100 * r['diagonal'][k]:+7.2f} %; rms "
              f"{100 * np.sqrt((r['diagonal'] ** 2).mean()):5.2f} %; reference good to "
              f"{100 * r['reference']:.2f} %")  # fmt: skip
    return out


def curve(results: list[dict[str, Any]]) -> None:
    """Print error against time, the fastest first."""
    print("\nerror against time: median step, ms; diagonal's rms, 95 %, worst, %")
    for r in sorted((r for r in results if "all" in r), key=lambda r: r["all"]["ms"]):
        s = r["all"]
        print(f"{r['label']:38s} {s['ms']:8.3f}  {s['rms']:6.2f} {s['p95']:6.2f} {s['worst']:6.2f}")


def plot(results: list[dict[str, Any]], path: Path) -> None:
    """Error against time, lines for each method, points its presets and settings."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullFormatter

    plt.style.use("capsense.plotting.capsense")
    figure, axes = plt.subplots(figsize=(6.4, 4), layout="constrained")
    for method in dict.fromkeys(r["label"].split()[0] for r in results):
        mine = [r for r in results if r["label"].split()[0] == method and "all" in r]
        mine.sort(key=lambda r: r["all"]["ms"])
        ms, colour = [r["all"]["ms"] for r in mine], None
        for key, word, style in (("worst", "worst", "v:"), ("p95", "95 % below", "s--"),
                                 ("rms", "rms", "o-")):  # fmt: skip
            errors = [r["all"][key] for r in mine]
            (drawn,) = axes.loglog(ms, errors, style, color=colour, label=f"{method}, {word}")
            colour = drawn.get_color()
        for r in mine:
            text = r["label"].removeprefix(method).strip()
            axes.annotate(text, (r["all"]["ms"], r["all"]["rms"]), (0, -14), fontsize=9,
                          textcoords="offset points", ha="center")  # fmt: skip
    axes.set(xlabel="median step, one core [ms]", ylabel="error of self capacitances ΔC_ii [%]")
    axes.margins(0.15)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.legend()
    figure.savefig(path)
    plt.close(figure)


def load(which: str, category: str) -> list[ReferenceScene]:
    """The scenes asked for."""
    files = {"map": [MAP], "more": [MORE], "all": [MAP, MORE]}[which]
    cases = [c for path in files if path.exists() for c in reference_scenes(path)]
    return [c for c in cases if category in c.category]


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--method", nargs="+", default=[], help="methods of Simulator")
    parser.add_argument("--presets", nargs="+", default=[], help="presets of Simulator")
    parser.add_argument("--settings", nargs="+", default=[], metavar="NAME=VALUE,…")
    parser.add_argument("--scenes", choices=("map", "more", "all"), default="all")
    parser.add_argument("--category", default="", help="only categories with this in their name")
    parser.add_argument("--worst", type=int, default=10, help="scenes to name")
    parser.add_argument("-o", "--output", nargs="+", type=Path, default=[], metavar="FILE",
                        help="FILE.json gets the figures, FILE.png error against time")  # fmt: skip
    args = parser.parse_args()
    if wrong := [str(p) for p in args.output if p.suffix not in (".png", ".json")]:
        parser.error(f"{', '.join(wrong)}: give names that end in .json or .png")
    on_one_core()
    cases = load(args.scenes, args.category)
    if not cases:
        parser.error(f"no scene of {args.scenes!r} has {args.category!r} in its category")
    machine = describe_machine(("capsense", "numpy", "scipy", "numba"))
    print(f"{len(cases)} scenes; {machine['processor']}, one core, load {machine['load']:.1f}")
    results = []
    for configuration in configurations(args.method, args.presets, args.settings):
        results.append(report(configuration[0], run(configuration, cases), args.worst))
    curve(results)
    for path in args.output:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            plot(results, path)
        else:
            path.write_text(json.dumps({**machine, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
