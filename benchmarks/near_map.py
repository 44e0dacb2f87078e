"""Errors of ΔC of conductors in the first millimetres, over many designs.

    python benchmarks/near_map.py                               # preset "standard"
    python benchmarks/near_map.py --presets fast standard fine -o out/near.json --worst 20
    python benchmarks/near_map.py --designs pad10 comb --limit 10
    python benchmarks/near_map.py --data tests/data/near_held_out.json
    python benchmarks/near_map.py --love                        # exact discs in the open, alone
    python benchmarks/near_map.py --make 40 --seed 7 -o file.json   # new references
    python benchmarks/near_map.py --check                       # these references against others

Scenes and references are those of ``tests/data/near_map.json``, over the designs of
``tests/data/near_designs`` or those that the file holds itself (``--data``). A reference has an
error of its own: the file's, but at least 2 % over a design with a layer and 1 % over others
(or the file's ``least_error``), and 3 % where the file gives none. "Beyond" is what of an error
exceeds it.

Diagonal: relative errors of the entries above 10 % of the scene's largest. Mutual: relative errors
of the entries off the diagonal above 3 % of the scene's largest entry, and whether the sign is
right. Estimate: whether the largest diagonal's error beyond that of the reference is below three
times ``solver_error``. A scene's gap is the smallest height of a body above the highest sheet or
layer of the design. Targets are for scenes between 0.05 and 5 mm. A step that fails counts as an
error of 100 %. Times are the median of steps 0.1 mm apart that follow the reading, on one core.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from machine import Times, describe_machine, on_one_core
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ellipk

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from reference_scenes import DATA, FEMTO, body_of_json

import capsense as cs
from capsense.constants import EPS0
from capsense.design import parse_design

Array = NDArray[np.float64]
Row = dict[str, Any]
TARGETS = {"fast": (6.0, 12.0, 25.0), "standard": (3.0, 6.0, 12.0), "fine": (3.0, 6.0, 12.0)}
"""rms, 95 % and worst error of the diagonal beyond the reference's own [%]."""
NEAR = (0.05e-3, 5e-3)
"""Gaps that count for the targets [m]."""
CLASSES = (0.1e-3, 0.3e-3, 1e-3, 2e-3, 5e-3, math.inf)
"""Upper ends of the classes of gaps [m]."""
DIAGONAL_SHARE, MUTUAL_SHARE = 0.1, 0.03
"""Entries that count, as a share of the scene's largest diagonal and largest entry."""
LAYERED, BARE, UNKNOWN = 0.02, 0.01, 0.03
"""Least errors of references: of designs with layers, of others, and where none is given."""
COVERED = 3.0
"""Times ``solver_error`` that an error may be large."""
TIMED, NUDGE = 5, 1e-4
"""Steps of which a scene's time is the median, and how far bodies move between them [m]."""


# -- designs and scenes ---------------------------------------------------------------------------


def load_design(name: str, inside: dict[str, str]) -> cs.Design:
    """A design by its name: of the data file, of ``near_designs``, or packaged."""
    if name in inside:
        return parse_design(tomllib.loads(inside[name]))
    path = DATA / "near_designs" / f"{name}.toml"
    return cs.load_design(path if path.exists() else name)


def top(design: cs.Design) -> float:
    """Height of the highest sheet or layer [m]."""
    heights = [float(s.surface.bounds[1][2]) for s in design.sheets]
    return max(heights + [float(k.upper[2]) for k in design.layers])


def lowest(body: Row) -> float:
    """Height of a body's lowest point [m]."""
    down = np.abs(Rotation.from_quat(body["quaternion"]).as_matrix()[2])
    shape, size = body["shape"], np.array(body["size"])
    if shape == "box":
        reach = down @ size / 2
    elif shape == "ellipsoid":
        reach = np.linalg.norm(down * size)
    elif shape == "cylinder":
        reach = down[2] * size[1] / 2 + size[0] * math.sqrt(max(0.0, 1 - down[2] ** 2))
    else:
        reach = size[0] + (down[2] * size[1] / 2 if shape == "capsule" else 0.0)
    return float(body["position"][2] - reach)


def own_error(case: Row, design: cs.Design) -> float:
    """Relative error of a reference."""
    if case.get("error") is None:
        return UNKNOWN
    least = case.get("least_error", LAYERED if design.layers else BARE)
    return max(float(case["error"]), least)


def moved(scene: cs.Scene, x: float) -> cs.Scene:
    """The scene with all bodies shifted along x [m]."""
    bodies = []
    for body in scene.bodies:
        (a, b, c), turn = body.pose.position, body.pose.quaternion
        bodies.append(body.moved(cs.Pose((a + x, b, c), turn)))
    return cs.Scene(bodies)


# -- measuring ------------------------------------------------------------------------------------


def beyond(errors: Array, reference: float) -> Array:
    """What of relative errors exceeds that of the reference, with their signs."""
    return np.sign(errors) * np.maximum(np.abs(errors) - reference, 0.0)


def compare(delta: Array, truth: Array, reference: float) -> Row:
    """Relative errors of the entries that count; ``truth`` and ``delta`` in the same unit."""
    diagonal = np.diag(truth)
    counts = np.flatnonzero(np.abs(diagonal) > DIAGONAL_SHARE * np.abs(diagonal).max())
    errors = (np.diag(delta)[counts] - diagonal[counts]) / diagonal[counts]
    i, j = np.triu_indices(len(truth), 1)
    kept = np.abs(truth[i, j]) > MUTUAL_SHARE * np.abs(truth).max()
    i, j = i[kept], j[kept]
    mutual = (delta[i, j] - truth[i, j]) / np.abs(truth[i, j])
    wrong = (np.sign(delta[i, j]) != np.sign(truth[i, j])) & (delta[i, j] != 0)
    return {
        "entries": counts.tolist(), "diagonal": errors.tolist(),
        "beyond": beyond(errors, reference).tolist(),
        "pairs": np.stack([i, j], axis=1).tolist(), "mutual": mutual.tolist(),
        "mutual_beyond": beyond(mutual, reference).tolist(), "wrong_signs": int(wrong.sum()),
    }  # fmt: skip


def measure(sim: cs.Simulator, case: Row) -> Row:
    """One scene's row."""
    design = sim.design
    truth = FEMTO * np.array(case["delta_fF"])
    reference = own_error(case, design)
    gap = min(lowest(b) for b in case["bodies"]) - top(design)
    row: Row = {"design": case["design"], "name": case["category"], "gap": round(gap, 8),
                "reference_error": reference}  # fmt: skip
    try:
        scene = cs.Scene([body_of_json(b) for b in case["bodies"]])
        sim.reset()
        reading = sim.step(scene)
        if not np.isfinite(reading.delta).all():
            raise FloatingPointError("the reading is not finite")
        times = Times()
        for k in range(TIMED):
            times.take(partial(sim.step, moved(scene, NUDGE * (k + 1))))
    except Exception as error:  # whatever it is, the scene has no reading
        return {**row, **failed(truth), "failed": f"{type(error).__name__}: {error}"}
    delta = reading.delta
    k = int(np.abs(np.diag(truth)).argmax())
    off = abs(float(beyond(np.array(delta[k, k] / truth[k, k] - 1), reference)) * truth[k, k])
    estimate = reading.stats.solver_error
    ratio = 0.0 if off == 0 else (off / estimate if estimate > 0 else math.inf)
    return {
        **row, **compare(delta, truth, reference), "delta_fF": (delta / FEMTO).tolist(),
        "largest_fF": truth[k, k] / FEMTO, "solver_error_fF": estimate / FEMTO,
        "estimate_ratio": ratio if math.isfinite(ratio) else 1e9,
        "ms": float(np.median(times.processor)),
    }  # fmt: skip


def failed(truth: Array) -> Row:
    """The figures of a scene without a reading: 100 % in all that counts."""
    return {
        **compare(np.zeros_like(truth), truth, 0.0), "delta_fF": None,
        "largest_fF": float(np.abs(np.diag(truth)).max()) / FEMTO, "solver_error_fF": None,
        "estimate_ratio": 1e9, "ms": None,
    }  # fmt: skip


def run(preset: str, cases: list[Row], designs: dict[str, cs.Design]) -> list[Row]:
    """A row a scene, design by design."""
    rows: list[Row] = []
    for name in dict.fromkeys(c["design"] for c in cases):
        mine = [c for c in cases if c["design"] == name]
        try:
            sim = cs.Simulator(designs[name], preset=preset)
        except cs.CapSenseError as error:
            for case in mine:
                gap = min(lowest(b) for b in case["bodies"]) - top(designs[name])
                rows.append({"design": name, "name": case["category"], "gap": round(gap, 8),
                             "reference_error": own_error(case, designs[name]),
                             **failed(FEMTO * np.array(case["delta_fF"])),
                             "failed": f"no simulator: {error}"})  # fmt: skip
            continue
        if not rows:  # compiles
            for case in mine[:2]:
                measure(sim, case)
        rows += [measure(sim, case) for case in mine]
        print(f"  {preset}: {name}, {len(mine)} scenes", file=sys.stderr, flush=True)
    return rows


# -- tables ---------------------------------------------------------------------------------------


def is_near(row: Row) -> bool:
    """Whether a scene counts for the targets."""
    return NEAR[0] - 1e-8 <= row["gap"] <= NEAR[1] + 1e-8


def spread_of(errors: list[float]) -> Row:
    """rms, 95 %, worst and mean of some errors [%]."""
    if not errors:
        return {}
    e = 100 * np.array(errors)
    return {"rms": float(np.sqrt((e**2).mean())), "p95": float(np.percentile(np.abs(e), 95)),
            "worst": float(np.abs(e).max()), "mean": float(e.mean())}  # fmt: skip


def summary(rows: list[Row]) -> Row:
    """Figures of some scenes."""
    times = [r["ms"] for r in rows if r["ms"] is not None]
    return {
        "scenes": len(rows), "failed": sum("failed" in r for r in rows),
        "diagonal": spread_of([e for r in rows for e in r["diagonal"]]),
        "beyond": spread_of([e for r in rows for e in r["beyond"]]),
        "mutuals": sum(len(r["mutual"]) for r in rows),
        "mutual": spread_of([e for r in rows for e in r["mutual"]]),
        "mutual_beyond": spread_of([e for r in rows for e in r["mutual_beyond"]]),
        "wrong_signs": sum(r["wrong_signs"] for r in rows),
        "covered": float(np.mean([r["estimate_ratio"] < COVERED for r in rows])) if rows else None,
        "worst_ratio": max((r["estimate_ratio"] for r in rows), default=None),
        "ms": float(np.median(times)) if times else None,
        "slowest_ms": max(times) if times else None,
    }  # fmt: skip


HEADER = (
    f"{'':22s} {'':>3s}  {'diagonal, %':>21s}  {'beyond reference, %':>28s}  "
    f"{'mutual, %':>21s} {'wrong':>5s}  {'estimate':>14s}  {'step':>6s}\n"
    f"{'':22s} {'n':>3s}  {'rms':>6s} {'p95':>7s} {'worst':>6s}  {'rms':>6s} {'p95':>7s} "
    f"{'worst':>6s} {'mean':>6s}  {'n':>4s} {'rms':>8s} {'worst':>7s} {'signs':>5s}  "
    f"{'held':>5s} {'worst':>8s}  {'ms':>6s}"
)


def line(name: str, s: Row) -> str:
    """A row of a table."""
    d, b, m = s["diagonal"], s["beyond"], s["mutual"]
    mutual = f"{m['rms']:8.1f} {m['worst']:7.0f} {s['wrong_signs']:5d}" if m else f"{'–':>22s}"
    ms = "–" if s["ms"] is None else f"{s['ms']:.3f}"
    return (
        f"{name:22s} {s['scenes']:3d}  {d['rms']:6.1f} {d['p95']:7.1f} {d['worst']:6.0f}  "
        f"{b['rms']:6.1f} {b['p95']:7.1f} {b['worst']:6.0f} {b['mean']:+6.1f}  "
        f"{s['mutuals']:4d} {mutual}  {100 * s['covered']:4.0f}% {s['worst_ratio']:8.3g}  {ms:>6s}"
    )


def classes(rows: list[Row]) -> dict[str, list[Row]]:
    """Scenes by their gaps."""
    out: dict[str, list[Row]] = {}
    low = -math.inf
    for high in CLASSES:
        words = f"{1e3 * low:g} to {1e3 * high:g} mm"
        if low == -math.inf:
            words = f"to {1e3 * high:g} mm"
        elif high == math.inf:
            words = f"above {1e3 * low:g} mm"
        out[words] = [r for r in rows if low + 1e-8 < r["gap"] <= high + 1e-8]
        low = high
    return {k: v for k, v in out.items() if v}


def report(preset: str, rows: list[Row], worst: int) -> Row:
    """Print a preset's tables and return their figures."""
    out: Row = {"preset": preset, "designs": {}, "gaps": {}, "scenes": rows}
    print(f"\npreset {preset!r}, all scenes by design\n{HEADER}")
    for name in dict.fromkeys(r["design"] for r in rows):
        out["designs"][name] = summary([r for r in rows if r["design"] == name])
        print(line(name, out["designs"][name]))
    print("by gap")
    for name, some in classes(rows).items():
        out["gaps"][name] = summary(some)
        print(line(name, out["gaps"][name]))
    print("together")
    out["all"] = summary(rows)
    print(line("all", out["all"]))
    near = [r for r in rows if is_near(r)]
    if near:
        out["near"] = summary(near)
        print(line("0.05 to 5 mm (targets)", out["near"]))
        print("targets, beyond the reference:", end="")
        out["met"] = {}
        for key, target in zip(("rms", "p95", "worst"), TARGETS[preset], strict=True):
            value = out["near"]["beyond"][key]
            out["met"][key] = bool(value <= target)
            print(f"  {key} {value:.1f} of {target:g} %: {'met' if value <= target else 'MISSED'}",
                  end="")  # fmt: skip
        print()
    for row in rows:
        if "failed" in row:
            print(f"FAILED: {row['design']}, {row['name']}: {row['failed']}")
    if worst:
        print("largest errors of the diagonal beyond the reference")
    for r in sorted(rows, key=lambda r: -np.abs(r["beyond"]).max())[:worst]:
        k = int(np.abs(r["beyond"]).argmax())
        print(f"  {r['name']:38s} gap {1e3 * r['gap']:7.3g} mm  entry {r['entries'][k]} "
              f"{100 * r['diagonal'][k]:+8.1f} %, beyond {100 * r['beyond'][k]:+8.1f} %, "
              f"estimate's ratio {r['estimate_ratio']:.3g}")  # fmt: skip
    return out


# -- Love's discs ---------------------------------------------------------------------------------

RADIUS = 0.0401
"""Of both discs [m]."""
THICKNESSES = (5e-3, 0.5e-3)
"""Of the disc that is a body [m]."""
DISC = '[[electrode]]\nname="{0}"\nshape="disc"\nradius={1}\ncenter=[0,0,{2}]\n'
OPEN = "[domain]\nsize=[0.5,0.5,0.5]\nbackplane=0.25\nopen=true\n"


def rings(r: Array, z: Array, ends: Array, count: int = 12) -> Array:
    """Potentials at (r, z) of bands of unit charge density, 4π eps0 = 1; bands (n, 2, 2) [r, z]."""
    x, w = np.polynomial.legendre.leggauss(count)
    u, w = (x + 1) / 2, w / 2
    power = 4  # of the distance from the nearest place: the kernel is logarithmic there
    graded, weight = u**power, power * u ** (power - 1) * w
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    point = np.stack([r, z], axis=1)[:, None]
    middle = np.clip(((point - start) * along).sum(axis=2) / length**2, 0, 1)
    out = np.zeros((len(r), len(ends)))
    for side in (-1, 1):
        reach = middle if side < 0 else 1 - middle
        for g, h in zip(graded, weight, strict=True):
            at = start + (middle + side * g * reach)[..., None] * along
            a, dz = at[..., 0], point[..., 1] - at[..., 1]
            square = (point[..., 0] + a) ** 2 + dz**2
            m = np.clip(4 * point[..., 0] * a / square, 0, 1 - 1e-15)
            out += h * reach * length * 4 * a * ellipk(m) / np.sqrt(square)
    return out


def disc_and_body(k: float, thickness: float, count: int = 160) -> float:
    """C11 over 8 eps0 R of a thin disc at 1 V, a grounded one of some thickness [R] at k R.

    Rotationally symmetric boundary elements in open space; Love's figures at thickness 0.
    """
    cut = (1 - np.cos(np.linspace(0, math.pi, count + 1)[count // 2 :] * 1.0)) - 1
    lines = [np.stack([cut, 0 * cut], axis=1), np.stack([cut, 0 * cut + k], axis=1)]
    if thickness:
        up = (1 - np.cos(np.linspace(0, math.pi, count // 2 + 1))) / 2 * thickness
        lines += [np.stack([0 * up + 1, k + up], axis=1),
                  np.stack([cut, 0 * cut + k + thickness], axis=1)]  # fmt: skip
    ends = np.concatenate([np.stack([p[:-1], p[1:]], axis=1) for p in lines])
    middle = ends.mean(axis=1)
    disc = np.arange(len(ends)) < len(cut) - 1
    density = np.linalg.solve(rings(*middle.T, ends), disc.astype(float))
    area = 2 * math.pi * middle[:, 0] * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return float((density * area)[disc].sum() * math.pi / 2)


def love_table() -> list[tuple[float, float, float]]:
    """k, C11 and −C12 over 8 eps0 R of ``love_discs.csv``."""
    rows = []
    for text in (DATA / "love_discs.csv").read_text().splitlines():
        if text.strip() and text.lstrip()[0].isdigit():
            k, own, mutual, *_ = (float(v) for v in text.split(","))
            rows.append((k, own, mutual))
    return rows


def love(preset: str) -> list[Row]:
    """Two equal discs in the open, and one of them as a body: print and return errors.

    Love's figures are of open space, so the domain is open (its box of 0.5 m only says where bodies
    are looked for), and nothing is left to a wall. As a body the disc has a thickness, which adds
    up to some per cent; the reference of these is by rotationally symmetric boundary elements that
    agree with Love's at thickness 0 to the figure in the column "check".
    """
    unit = 8 * EPS0 * RADIUS
    lone = cs.Simulator(parse_design(tomllib.loads('name="disc"\n' + OPEN
                                                   + DISC.format("A", RADIUS, 0))),
                        preset=preset)  # fmt: skip
    alone = float(lone.baseline[0, 0])
    print(f"\nLove's discs, radius {1e3 * RADIUS:g} mm, open domain, preset {preset!r}; one disc "
          f"alone {100 * (alone / unit - 1):+.2f} %; errors in %")  # fmt: skip
    words = "".join(f"{f'body of {1e3 * t:g} mm: ΔC, C11, ratio':>34s}" for t in THICKNESSES)
    print(f"{'k':>6s} {'gap, mm':>8s}  {'electrodes: C11':>15s} {'C12':>7s} {words} {'check':>7s}")
    out = []
    for k, own, mutual in love_table():
        text = 'name="discs"\n' + OPEN + DISC.format("A", RADIUS, 0)
        row: Row = {"k": k, "gap": k * RADIUS, "check": disc_and_body(k, 0.0) / own - 1}
        try:
            two = (
                cs.Simulator(
                    parse_design(tomllib.loads(text + DISC.format("B", RADIUS, -k * RADIUS))),
                    preset=preset,
                ).baseline
                / unit
            )
            row |= {"c11": two[0, 0] / own - 1, "c12": -two[0, 1] / mutual - 1}
            shown = f"{100 * row['c11']:15.2f} {100 * row['c12']:7.2f} "
        except cs.CapSenseError as error:
            row["failed"] = str(error)
            shown = f"{'failed':>15s} {'':>7s} "
        row["bodies"] = []
        for thickness in THICKNESSES:
            place = cs.Pose((0, 0, k * RADIUS + thickness / 2))
            scene = cs.Scene([cs.Body(cs.Cylinder(RADIUS, thickness), place, "steel")])
            truth = disc_and_body(k, thickness / RADIUS)
            try:
                lone.reset()
                reading = lone.step(scene)
                delta = float(reading.delta[0, 0]) / unit
                estimate = reading.stats.solver_error / unit
            except Exception as error:
                row.setdefault("failures", []).append(f"{type(error).__name__}: {error}")
                delta, estimate = 0.0, 0.0
            off = delta - (truth - 1)
            one = {"thickness": thickness, "delta": off / (truth - 1),
                   "c11": (alone / unit + delta) / truth - 1,
                   "ratio": abs(off) / estimate if estimate else 1e9}  # fmt: skip
            row["bodies"].append(one)
            shown += f"{100 * one['delta']:16.2f} {100 * one['c11']:8.2f} {one['ratio']:8.2g}"
        print(f"{k:6.3f} {1e3 * k * RADIUS:8.2f}  {shown} {100 * row['check']:7.3f}")
        out.append(row)
    return out


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", choices=tuple(TARGETS), default=["standard"])
    parser.add_argument("--designs", nargs="+", default=[], help="only these designs")
    parser.add_argument("--data", type=Path, default=DATA / "near_map.json", help="scenes")
    parser.add_argument("--limit", type=int, default=0, help="only the first scenes of each design")
    parser.add_argument("--worst", type=int, default=15, metavar="K", help="scenes to name")
    parser.add_argument("--love", action="store_true", help="Love's discs in place of scenes")
    parser.add_argument("--make", type=int, metavar="N", help="compute N references for -o")
    parser.add_argument("--seed", type=int, default=0, help="of --make")
    parser.add_argument(
        "--first", type=int, default=0, help="of --make: number of its first design"
    )
    parser.add_argument("--check", action="store_true", help="check what --make computes")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="all figures")
    args = parser.parse_args()
    if args.make and not args.output:
        parser.error("--make needs -o FILE.json")
    on_one_core()
    if args.make or args.check:
        import near_reference

        if args.check:
            known = json.loads(args.data.read_text())["cases"]
            near_reference.check(known, lambda name: load_design(name, {}), love_table())
        if args.make:
            near_reference.make(args.make, args.seed, args.output, args.first)
        return
    out = describe_machine(("capsense", "numpy", "scipy", "numba"))
    if args.love:
        out["love"] = {preset: love(preset) for preset in args.presets}
    else:
        data = json.loads(args.data.read_text())
        shared = {"least_error": data["least_error"]} if "least_error" in data else {}
        cases = [{**shared, **c} for c in data["cases"]]
        if unknown := set(args.designs) - {c["design"] for c in cases}:
            parser.error(f"no scene of {args.data} is over {', '.join(sorted(unknown))}")
        names = args.designs or list(dict.fromkeys(c["design"] for c in cases))
        cases = [c for n in names for c in
                 [c for c in cases if c["design"] == n][: args.limit or None]]  # fmt: skip
        designs = {n: load_design(n, data.get("designs", {})) for n in names}
        print(f"{len(cases)} scenes of {args.data.name}; {out['processor']}, one core, load "
              f"{out['load']:.1f}")  # fmt: skip
        out["data"] = args.data.name
        out["results"] = [report(p, run(p, cases, designs), args.worst) for p in args.presets]
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(out, indent=1) + "\n")


if __name__ == "__main__":
    main()
