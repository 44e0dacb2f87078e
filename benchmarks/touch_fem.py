"""Readings of a disc electrode below a soft cover that a rigid conductor presses in.

    python benchmarks/touch_fem.py                     # CapSense against tests/data/touch_fem.json
    python benchmarks/touch_fem.py --hard              # a layer for the cover: gaps and touch only
    python benchmarks/touch_fem.py --cases ball punch --presets standard fine -o out/touch.json
    python benchmarks/touch_fem.py --laws              # laws of local capacitance, without a solver
    python benchmarks/touch_fem.py --write             # the references anew; needs NGSolve

References are finite elements with an axis of rotation (``touch_reference.py``), of the body
grounded and floating: far away, 5 to 0.1 mm above the cover, in touch with it, and pressed into it
by 10 to 70 % of its thickness. "ΔC" is the change of the electrode's self-capacitance against the
far body. The cover gives way as an elastic foundation: its outer face is at height min(t, underside
of the body). The references have a round box, cover and board, of the areas of the square ones;
"round" in the file is by how much ΔC differs, in touch and 5 mm above, if all are the circles
inside, or around, the squares.

Laws: ΔC in touch plus, over the electrode, the change of eps0 / length from touch on, lengths
through the cover divided by its permittivity. Lengths "up" to the body; of the "nearest" way; and
the "arc" d α / sin α of that distance d and its angle α from the normal. "Pressed" laws leave out
the air beside the place of contact: lengths end at the face of the cover before it was pressed in.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine, on_one_core
from numpy.typing import NDArray

import capsense as cs
from capsense.constants import EPS0
from capsense.design import parse_design

Array = NDArray[np.float64]
Row = dict[str, Any]
OUTPUT = Path(__file__).parents[1] / "tests" / "data" / "touch_fem.json"
FEMTO = 1e-15
SIDE = 0.08
"""Of the cover, the board and its ground plane [m]."""
BOX = 0.2
"""Edges of the domain [m]."""
BACKPLANE = 0.02
GAPS = (5e-3, 2e-3, 1e-3, 0.5e-3, 0.2e-3, 0.1e-3)
"""Distances of the body from the cover [m]."""
STRAINS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
"""Depths of the body, over the thickness of the cover."""
MODULUS = 60e3
"""Of covers [Pa]; depths are given, so that readings do not depend on it."""
TARGETS = ((0.5, 5.0), (0.7, 10.0))
"""Largest error [%] of ΔC in touch, up to a strain."""
GROUNDINGS = ("grounded", "floating")


@dataclass(frozen=True)
class Case:
    """An electrode, a cover and a body on its axis; lengths in metres."""

    name: str
    radius: float
    """Of the electrode."""
    thickness: float
    """Of the cover."""
    eps_r: float
    body_radius: float
    """Of a ball; of an upright cylinder, if it has an edge."""
    edge: float = 0.0
    """Radius of the cylinder's edges; 0 is a ball."""
    length: float = 0.0
    """Of the cylinder."""
    fabric: bool = False
    """Whether a grounded fabric lies on the cover."""
    guard: tuple[float, float] | None = None
    """Inner and outer radius of a grounded ring in the electrode's plane."""
    board: tuple[float, float] | None = None
    """Thickness and permittivity of a board over a ground plane."""


CASES = (
    Case("ball", 2.5e-3, 2e-3, 3.0, 10e-3),
    Case("large ball", 5e-3, 1e-3, 1.6, 20e-3),
    Case("punch", 5e-3, 3e-3, 2.5, 8e-3, edge=0.5e-3, length=20e-3),
    Case("small ball", 10e-3, 0.5e-3, 3.5, 5e-3),
    Case("fabric", 2.5e-3, 2e-3, 3.0, 10e-3, fabric=True),
    Case("guard", 4e-3, 2e-3, 2.0, 10e-3, guard=(4.3e-3, 8e-3)),
    Case("board", 5e-3, 1.5e-3, 2.8, 8e-3, board=(1e-3, 4.5)),
)


# -- scenes ---------------------------------------------------------------------------------------


def depths(case: Case) -> list[float]:
    """Depths of the body below the cover's undeformed face [m]; gaps are negative."""
    gaps = [] if case.fabric else [-gap for gap in GAPS]
    return [*gaps, 0.0, *(strain * case.thickness for strain in STRAINS)]


def shape(case: Case) -> cs.Sphere | cs.TriMesh:
    """The body, its centre at the origin."""
    if not case.edge:
        return cs.Sphere(case.body_radius)
    import trimesh

    turn = np.linspace(0.0, np.pi / 2, 7)
    up = np.stack([np.sin(turn), -np.cos(turn)], axis=1) * case.edge
    corner = np.array([case.body_radius - case.edge, case.edge - case.length / 2])
    low = corner + up
    outline = np.concatenate([[[0.0, -case.length / 2]], low, low[::-1] * [1, -1],
                              [[0.0, case.length / 2]]])  # fmt: skip
    turned = trimesh.creation.revolve(outline, sections=64)
    return cs.TriMesh(turned.vertices, turned.faces)


def scene(
    case: Case, depth: float | None, grounding: str = "grounded", hard: bool = False
) -> tuple[Row, list[cs.Body]]:
    """Design, as of a TOML file, and bodies.

    Args:
        case: One of ``CASES``.
        depth: Of the body below the cover's undeformed face [m]; None is no body.
        grounding: Of the body, "grounded" or "floating".
        hard: Put an ordinary layer in place of the cover.
    """
    conductors: list[Row] = []
    layers: list[Row] = []
    t = case.thickness
    if case.guard:
        inner, outer = case.guard
        conductors.append({"name": "guard", "role": "ground", "shape": "ring",
                           "inner_radius": inner, "outer_radius": outer})  # fmt: skip
    if case.board:
        deep, eps_r = case.board
        conductors.append({"name": "plane", "role": "ground", "shape": "rectangle",
                           "size": [SIDE, SIDE], "z": -deep})  # fmt: skip
        layers.append({"name": "board", "eps_r": eps_r, "size": [SIDE, SIDE], "z": [-deep, 0.0]})
    design: Row = {
        "name": f"touch_{case.name.replace(' ', '_')}",
        "domain": {"size": [BOX] * 3, "backplane": BACKPLANE},
        "electrode": [{"name": "E", "shape": "disc", "radius": case.radius}],
    }
    if hard:
        layers.append({"name": "cover", "eps_r": case.eps_r, "size": [SIDE, SIDE], "z": [0.0, t]})
    else:
        top = "ground" if case.fabric else "none"
        design["cover"] = [{"name": "cover", "thickness": t, "eps_r": case.eps_r,
                            "size": [SIDE, SIDE], "modulus": MODULUS, "top": top}]  # fmt: skip
    design |= {"conductor": conductors} if conductors else {}
    design |= {"layer": layers} if layers else {}
    if depth is None:
        return design, []
    half = case.length / 2 if case.edge else case.body_radius
    pose = cs.Pose((0.0, 0.0, t - depth + half))
    return design, [cs.Body(shape(case), pose, "steel", grounding=grounding)]


# -- references -----------------------------------------------------------------------------------


def references(case: Case) -> Row:
    """Capacitances of a case by finite elements [fF], and what their errors are."""
    import touch_reference as reference

    disc = 1.0 / math.sqrt(math.pi)

    def solved(depth: float | None, scale: float = disc) -> reference.Values:
        outline = []
        if depth is not None:
            low = case.thickness - depth
            outline = reference.ball(case.body_radius, low)
            if case.edge:
                outline = reference.punch(case.body_radius, case.length, case.edge, low)
        section = reference.Section(
            case.radius, case.thickness, case.eps_r, outline, case.fabric, case.guard, case.board,
            extent=scale * SIDE, domain=(scale * BOX, -BACKPLANE, BOX - BACKPLANE),
        )  # fmt: skip
        return reference.solve(section)

    far = solved(None)
    out: Row = {**asdict(case), "far_fF": round(far.own / FEMTO, 4),
                "far_error_fF": round(far.error / FEMTO, 4), "states": []}  # fmt: skip
    found = {depth: solved(depth) for depth in depths(case)}
    for depth, v in found.items():
        errors = [v.error, v.floating_error]
        values = [v.own, v.floating]
        if case.fabric:  # nothing above it counts
            values, errors = values[:1] * 2, errors[:1] * 2
        out["states"].append({
            "depth": round(depth, 9),
            **{f"{g}_fF": round(c / FEMTO, 4) for g, c in zip(GROUNDINGS, values, strict=True)},
            "error_fF": round(max(errors) / FEMTO, 4),
        })  # fmt: skip
    shares = []
    for scale in (0.5, math.sqrt(0.5)):
        base = solved(None, scale)
        for depth in (-GAPS[0], 0.0) if not case.fabric else (max(found),):
            v, known = solved(depth, scale), found[depth]
            pairs = [(v.own, known.own)] + [(v.floating, known.floating)] * (not case.fabric)
            shares += [abs((a - base.own) / (b - far.own) - 1) for a, b in pairs]
    out["round"] = float(f"{max(shares):.2g}")
    return out


def write(cases: list[Case]) -> None:
    """Compute references of some cases and write them to the file, in which the others stay."""
    from importlib.metadata import version

    rows = known() if OUTPUT.exists() else {}
    for case in cases:
        rows[case.name] = references(case)
        print(f"{case.name}: far {rows[case.name]['far_fF']} fF, "
              f"round {rows[case.name]['round']:.1e}", file=sys.stderr, flush=True)  # fmt: skip
        note = (
            "Self-capacitances [fF] of a disc electrode below a cover; benchmarks/touch_fem.py "
            f"--write, finite elements with an axis of rotation, NGSolve {version('ngsolve')}. "
            "depth [m]: of the body below the cover's undeformed face. error_fF: difference "
            "between orders of the elements. round: relative change of dC by circles inside or "
            "around the squares."
        )
        ordered = [rows[c.name] for c in CASES if c.name in rows]
        text = json.dumps({"note": note, "cases": ordered}, indent=1)
        OUTPUT.write_text(text + "\n", encoding="utf-8")


def known(path: Path = OUTPUT) -> dict[str, Row]:
    """The file's rows by the name of their case."""
    return {row["name"]: row for row in json.loads(path.read_text(encoding="utf-8"))["cases"]}


# -- laws of local capacitance --------------------------------------------------------------------

POINTS = 4000
"""Rings of the electrode."""


@dataclass(frozen=True)
class Ways:
    """From points of the electrode to the body [m], shape (points,)."""

    up: Array
    """Height of its underside; infinite beside it."""
    nearest: Array
    """Distance of its nearest point."""
    angle: Array
    """Of that, from the normal [rad]."""


def ways(case: Case, r: Array, depth: float) -> Ways:
    """Ways to the body from points at radii ``r`` [m], shape (n,)."""
    low = case.thickness - depth
    curve = case.edge or case.body_radius
    flat = case.body_radius - curve
    beside = np.maximum(r - flat, 0.0)
    under = beside < curve
    arch = np.sqrt(np.where(under, curve**2 - beside**2, 0.0))
    return Ways(
        np.where(under, low + curve - arch, np.inf),
        np.hypot(beside, low + curve) - curve,
        np.arctan2(beside, low + curve),
    )


def densities(case: Case, r: Array, depth: float) -> dict[str, Array]:
    """Capacitance per area [F/m²] of each law at radii ``r`` [m]."""
    w, t, eps_r = ways(case, r, depth), case.thickness, case.eps_r
    height = w.nearest * np.cos(w.angle)
    inside = np.minimum(1.0, t / height)
    divided = inside / eps_r + 1.0 - inside
    arc = w.nearest / np.sinc(w.angle / np.pi)
    pressed = {"pressed up": w.up, "pressed nearest": w.nearest, "pressed arc": arc}
    out = {name: EPS0 * eps_r / np.minimum(length, t) for name, length in pressed.items()}
    return out | {
        "up": EPS0 / (np.minimum(w.up, t) / eps_r + np.maximum(w.up - t, 0.0)),
        "nearest": EPS0 / (w.nearest * divided),
        "arc": EPS0 / (arc * divided),
    }


def local_changes(case: Case, depth: float) -> dict[str, float]:
    """Change of self-capacitance from touch to a depth [F], by law."""
    edges = case.radius * np.linspace(0.0, 1.0, POINTS + 1)
    r, area = (edges[1:] + edges[:-1]) / 2, math.pi * np.diff(edges**2)
    touch = densities(case, r, 0.0)
    return {name: float(area @ (density - touch[name]))
            for name, density in densities(case, r, depth).items()}  # fmt: skip


def laws() -> list[Row]:
    """Errors of ΔC [%] by the laws, grounded body: print and return."""
    rows = []
    for case in CASES:
        row = known()[case.name]
        states = {s["depth"]: s["grounded_fF"] - row["far_fF"] for s in row["states"]}
        names = list(local_changes(case, 0.0))
        print(f"\n{case.name}: ΔC in touch {states[0.0]:.1f} fF\n{'strain':>7s} {'ΔC, fF':>9s} "
              + "".join(f"{n:>17s}" for n in names))  # fmt: skip
        for depth, truth in states.items():
            if depth > 0:
                change = local_changes(case, depth)
                errors = {n: 100 * ((states[0.0] + c / FEMTO) / truth - 1)
                          for n, c in change.items()}  # fmt: skip
                rows.append({"case": case.name, "strain": depth / case.thickness, **errors})
                print(f"{depth / case.thickness:7.1f} {truth:9.1f} "
                      + "".join(f"{errors[n]:+17.1f}" for n in names))  # fmt: skip
    return rows


# -- readings -------------------------------------------------------------------------------------


def measure(case: Case, preset: str, hard: bool) -> list[Row]:
    """Errors of CapSense in the states of a case."""
    row = known()[case.name]
    sim = cs.Simulator(parse_design(scene(case, None, hard=hard)[0]), preset=preset)
    rows: list[Row] = []
    for grounding in GROUNDINGS[: 1 if case.fabric else 2]:
        for state in row["states"]:
            if hard and state["depth"] > 0:
                continue
            truth = state[f"{grounding}_fF"] - row["far_fF"]
            sim.reset()
            reading = sim.step(cs.Scene(scene(case, state["depth"], grounding)[1]))
            delta = float(reading.delta[0, 0]) / FEMTO
            own = (state["error_fF"] + row["far_error_fF"]) / truth + row["round"]
            rows.append({
                "case": case.name, "grounding": grounding, "depth": state["depth"],
                "strain": state["depth"] / case.thickness, "truth_fF": truth, "delta_fF": delta,
                "error": 100 * (delta / truth - 1), "reference_error": 100 * own,
                "solver_error_fF": reading.stats.solver_error / FEMTO,
                "baseline_error": 100 * (float(sim.baseline[0, 0]) / FEMTO / row["far_fF"] - 1),
            })  # fmt: skip
    return rows


def show(rows: list[Row]) -> None:
    """Print the errors of a case."""
    print(f"\n{rows[0]['case']}: baseline {rows[0]['baseline_error']:+.2f} %")
    print(f"{'':9s} {'gap, mm':>13s} {'strain':>7s} {'ΔC, fF':>9s} {'CapSense':>9s} "
          f"{'error, %':>9s} {'estimate, %':>11s} {'reference, %':>12s}")  # fmt: skip
    for r in rows:
        print(f"{r['grounding']:9s} {-1e3 * r['depth']:13.2f} {max(r['strain'], 0):7.1f} "
              f"{r['truth_fF']:9.1f} {r['delta_fF']:9.1f} {r['error']:+9.1f} "
              f"{100 * r['solver_error_fF'] / r['truth_fF']:11.1f} "
              f"{r['reference_error']:12.2f}", flush=True)  # fmt: skip


def report(rows: list[Row]) -> None:
    """Print what became of the targets."""
    errors = np.array([r["error"] for r in rows])
    print(f"\nall: rms {np.sqrt((errors**2).mean()):.1f}, worst {np.abs(errors).max():.1f} %")
    for strain, target in TARGETS:
        held = [abs(r["error"]) for r in rows if 0 <= r["strain"] <= strain + 1e-9]
        if held and max(r["strain"] for r in rows) > 0:
            met = "met" if max(held) <= target else "MISSED"
            print(f"up to {100 * strain:g} %: worst {max(held):.1f} of {target:g} %: {met}")


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [case.name for case in CASES]
    parser.add_argument("--cases", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--presets", nargs="+", default=["standard"], metavar="PRESET")
    parser.add_argument("--hard", action="store_true", help="a layer for the cover; no fabric")
    parser.add_argument("--laws", action="store_true", help="laws of local capacitance")
    parser.add_argument("--write", action="store_true", help="compute the references")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="all figures")
    args = parser.parse_args()
    on_one_core()
    if args.write:
        write([case for case in CASES if case.name in args.cases])
        return
    out = describe_machine(("capsense", "numpy", "scipy", "numba"))
    if args.laws:
        out["laws"] = laws()
    for preset in [] if args.laws else args.presets:
        cases = [c for c in CASES if c.name in args.cases and not (args.hard and c.fabric)]
        print(f"preset {preset!r}")
        rows = []
        for case in cases:
            rows += measure(case, preset, args.hard)
            show([row for row in rows if row["case"] == case.name])
        out[preset] = rows
        report(rows)
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps(out, indent=1) + "\n")


if __name__ == "__main__":
    main()
