"""Errors of ΔC of difficult bodies, for the accuracy guide.

    python benchmarks/difficult.py                          # errors by kind and preset
    python benchmarks/difficult.py -o out/difficult.json    # the same into a file
    python benchmarks/difficult.py --scenes                 # a line a scene
    python benchmarks/difficult.py --make --only wire       # references of scenes with this name

Scenes and references are those of ``tests/data/difficult.json``, which ``--make`` writes by
``difficult_reference.py``: over a packaged design, and over designs that are drawn at random. An
error is that of a diagonal entry above 10 % of the scene's largest.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine, on_one_core
from near_map import FEMTO, compare
from near_reference import random_design
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from difficult_scenes import DIFFICULT, design_of, difficult, scene_of

import capsense as cs

Row = dict[str, Any]
PRESETS = ("fast", "standard", "fine")
KINDS = {
    "wire": "wires of 0.1 mm",
    "needle": "needles",
    "foil": "foils of 10 µm",
    "plate": "plates as bodies, 0.1 and 1 mm thick",
    "large": "bodies larger than the domain",
    "cup": "a finger inside a hollow cup",
    "water": "water in a glass",
    "room": "a room of 10 m",
}
"""Word that names of scenes start with → row."""
BARE = "six_patch_bare"
SEED = 2031
"""Of the random designs."""
ROOM = (
    'name="six patches in a room"\n[domain]\nsize=[10.0,10.0,10.0]\nbackplane=1.0\n'
    + "".join(
        f'[[electrode]]\nname="E{k + 1}"\nshape="rectangle"\nsize=[0.03,0.03]\ncenter=[{x},{y}]\n'
        for k, (y, x) in enumerate((y, x) for y in (-0.025, 0.025) for x in (-0.038, 0.0, 0.038))
    )
)  # fmt: skip


def designs() -> dict[str, str]:
    """Texts of designs that are not packaged."""
    rng = np.random.default_rng(SEED)
    board, array = random_design("board", "board", rng), random_design("array", "array", rng)
    _, _, rest = array.partition("[[electrode]]")
    room = 'name="array in a room"\n[domain]\nsize=[10.0,10.0,10.0]\nbackplane=0.5\n'
    small = 'name="open array"\n[domain]\nsize=[0.3,0.3,0.3]\nbackplane=0.15\nopen=true\n'
    square = '[[electrode]]\nname="E1"\nshape="rectangle"\nsize=[0.1,0.1]\ncenter=[0.0,0.0]\n'
    lone = 'name="square"\n[domain]\nsize=[1.0,1.0,1.0]\nbackplane=0.5\nopen=true\n' + square
    return {"board": board, "array": array, "room": ROOM, "array in a room":
            room + "[[electrode]]" + rest, "open array": small + "[[electrode]]" + rest,
            "square": lone}  # fmt: skip


def turn(axis: str = "x", degrees: float = 0.0) -> list[float]:
    """A quaternion."""
    return [round(float(v), 9) for v in Rotation.from_euler(axis, degrees, degrees=True).as_quat()]


LEVEL = turn("y", 90)


def item(shape: str, size: list[float], at: tuple[float, float, float], kind: str = "grounded",
         way: list[float] | None = None, eps: float = 1.0, solved_as: str = "") -> Row:  # fmt: skip
    """A body of a case."""
    extra = {"solved_as": solved_as} if solved_as else {}
    return {"shape": shape, "size": size, "position": list(at), "quaternion": way or turn(),
            "kind": kind, "eps_r": eps} | extra  # fmt: skip


def scenes(texts: dict[str, str]) -> list[Row]:
    """All scenes, without figures."""
    out: list[Row] = []

    def add(name: str, design: str, *bodies: Row) -> None:
        out.append({"name": name, "design": design, "bodies": list(bodies)})

    def pad(design: str, number: int = 0) -> tuple[float, float, float]:
        """Middle and width of an electrode."""
        low, high = design_of(design, texts).electrodes[number].surface.bounds
        return (*((low + high) / 2)[:2].round(6).tolist(), float((high - low)[:2].min()))

    def cup(design: str, number: int, gap: float, radius: float, kind: str, eps: float = 1.0,
            wall: float = 0.0) -> Row:  # fmt: skip
        x, y, _ = pad(design, number)
        wall = wall or 0.08 * radius
        size = [round(v, 6) for v in (radius, 2.5 * radius, wall, 1.5 * wall)]
        return item("cup", size, (x, y, gap), kind, eps=eps)

    def inside(body: Row, up: float) -> Row:
        """A finger in a cup, its end ``up`` above the base, and a little off the axis."""
        x, y, z = body["position"]
        r = round(0.3 * body["size"][0], 6)
        length = round(3 * body["size"][0], 6)
        height = z + body["size"][3] + up + r + length / 2
        return item("capsule", [r, length], (x + 0.3 * r, y, round(height, 7)))

    def water(body: Row, full: float) -> Row:
        x, y, z = body["position"]
        radius, height, wall, base = body["size"]
        size = [round(radius - wall, 7), round(full * (height - base), 7)]
        return item("prism", size, (x, y, round(z + base, 7)), "diel", eps=78.0)

    both = ((BARE, 4), ("board", 0))
    thin = 5e-5
    for design, number in both:
        x, y, width = pad(design, number)
        for gap, kind in ((0.005, "grounded"), (0.002, "floating"), (0.001, "grounded")):
            body = item("capsule", [thin, 0.04], (x, y + 0.1 * width, gap + thin), kind, LEVEL)
            add(f"wire {kind} {1e3 * gap:g} mm", design, body)
        add(
            "wire tilted 2 mm",
            design,
            item("capsule", [thin, 0.04], (x, y, 0.002 + thin + 0.01), way=turn("y", 60)),
        )
        add("wire of 0.3 m, 10 mm", design,
            item("capsule", [thin, 0.3], (x, y, 0.01 + thin), way=LEVEL))  # fmt: skip
        r, length = 3e-4, 0.04
        for gap in (0.0005, 0.002):
            add(f"needle upright {1e3 * gap:g} mm", design,
                item("capsule", [r, length], (x, y, gap + r + length / 2)))  # fmt: skip
        add("needle ellipsoid 2 mm", design, item("ellipsoid", [r, r, 0.02], (x, y, 0.022)))
        up = round(0.5 * length * math.cos(math.radians(50)), 7)
        add("needle tilted floating 1 mm", design, item(
            "capsule", [r, length], (x, y, 0.001 + r + up), "floating", turn("y", 50)))  # fmt: skip
        foil = [0.1, 0.1, 1e-5]
        for gap, kind in ((0.02, "grounded"), (0.005, "grounded"), (0.005, "floating"),
                          (0.002, "grounded")):  # fmt: skip
            add(f"foil {kind} {1e3 * gap:g} mm", design, item(
                "box", foil, (x, y, gap + 5e-6), kind, solved_as="foil"))  # fmt: skip
        add("foil tilted 10 mm", design, item("box", [0.06, 0.06, 1e-5], (x, y, 0.01 + 0.015),
                                              way=turn("y", 30), solved_as="foil"))  # fmt: skip
        for thick in (1e-4, 1e-3):
            add(f"plate {1e3 * thick:g} mm, 10 mm", design,
                item("box", [0.08, 0.08, thick], (x, y, 0.01 + thick / 2)))  # fmt: skip
        add("plate 1 mm, 3 mm", design, item("box", [0.08, 0.08, 1e-3], (x, y, 0.0035)))
        add("large block 30 mm", design,
            item("box", [1.0, 1.0, 0.6], (0.0, 0.0, 0.33), solved_as="wall"))  # fmt: skip
        add("large ball 20 mm", design,
            item("sphere", [1.0], (0.0, 0.0, 1.02), solved_as="cap"))  # fmt: skip
        add("large pipe 20 mm", design, item("cylinder", [0.05, 2.0], (0.0, 0.0, 0.07), way=LEVEL,
                                             solved_as="pipe"))  # fmt: skip
    add("plate 0.1 mm, 20 mm", "square", item("box", [0.1, 0.1, 1e-4], (0, 0, 0.02005)))
    add("large block in the open 20 mm", "open array",
        item("box", [0.6, 0.6, 0.05], (0, 0, 0.045)))  # fmt: skip
    for design, number, radius, gap in ((BARE, 4, 0.03, 0.005), ("board", 0, 0.02, 0.002)):
        for kind, eps in (("floating", 1.0), ("diel", 3.0), ("grounded", 1.0)):
            name = {"floating": "floating", "diel": "of plastic", "grounded": "grounded"}[kind]
            body = cup(design, number, gap, radius, kind, eps)
            add(f"cup {name}", design, body, inside(body, 0.004))
        body = cup(design, number, gap, radius, "diel", 3.0)
        add("cup of plastic, no finger", design, body)
        add("cup of plastic, finger low", design, body, inside(body, 0.001))
        for full in (0.3, 0.8) if design == BARE else (0.8,):
            glass = cup(design, number, gap, radius, "diel", 6.0)
            add(f"water {100 * full:g} % full", design, glass, water(glass, full))
    for design in ("room", "array in a room"):
        number = 4 if design == "room" else 0
        x, y, _ = pad(design, number)
        add("room, hand at 30 mm", design, item("box", [0.08, 0.09, 0.025], (x, y, 0.0425)))
        add("room, ball at 0.2 m", design, item("sphere", [0.05], (x, y, 0.25)))
        add("room, person at 0.5 m", design, item("capsule", [0.15, 1.4], (x, y, 1.35)))
        add("room, limb at 10 mm", design,
            item("capsule", [0.04, 0.25], (x, y, 0.05), way=LEVEL))  # fmt: skip
    return out


def write(path: Path, cases: list[Row], texts: dict[str, str]) -> None:
    """The file, a design and a case a line."""
    note = ("Difficult bodies; written by benchmarks/difficult.py --make. ΔC [fF], Maxwell form, "
            "by boundary elements (difficult_reference.py), extrapolated from two meshes; error: "
            "what that adds, over the largest entry.")  # fmt: skip
    rows = ",\n".join(f"  {json.dumps(c)}" for c in cases)
    lines = ",\n".join(f"  {json.dumps(n)}: {json.dumps(t)}" for n, t in texts.items())
    path.write_text(
        f'{{\n "note": {json.dumps(note, ensure_ascii=False)},\n "designs": '
        f'{{\n{lines}\n }},\n "cases": [\n{rows}\n ]\n}}\n',
        encoding="utf-8",
    )


def make(only: str, again: bool) -> None:
    """Compute references of scenes that have none, or of all."""
    import difficult_reference

    texts = designs()
    old = difficult()[0] if DIFFICULT.exists() else []
    known = {(c["name"], c["design"]): c for c in old}
    cases = []
    for case in scenes(texts):
        found = known.get((case["name"], case["design"]))
        same = found is not None and found["bodies"] == case["bodies"]
        wanted = only in case["name"]
        if same and not (again and wanted):
            cases.append(found)
        elif wanted:
            case = difficult_reference.referenced(design_of(case["design"], texts), case)
            print(f"{case['name']:32s} {case['design']:16s} {np.max(case['delta_fF']):9.3f} fF, "
                  f"adds {case['error']:.2%}, panels {case['panels']}, {case['seconds']} s",
                  flush=True)  # fmt: skip
            cases.append(case)
        write(
            DIFFICULT,
            [
                *cases,
                *(
                    c
                    for c in old
                    if not any((c["name"], c["design"]) == (k["name"], k["design"]) for k in cases)
                ),
            ],
            texts,
        )


def measure(sim: cs.Simulator, case: Row) -> Row:
    """Errors of a scene, the estimate over the largest entry, and warnings."""
    truth = FEMTO * np.array(case["delta_fF"])
    sim.reset()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        reading = sim.step(scene_of(case))
    own = max(case["error"], 0.005)
    k = int(np.abs(np.diag(truth)).argmax())
    off = abs(reading.delta[k, k] - truth[k, k]) - own * abs(truth[k, k])
    return {
        **compare(reading.delta, truth, own), "case": case, "largest": truth[k, k],
        "off": float(reading.delta[k, k] / truth[k, k] - 1),
        "estimate": reading.stats.solver_error / abs(truth[k, k]),
        "ratio": max(0.0, off) / reading.stats.solver_error if off > 0 else 0.0,
        "said": [str(w.message) for w in said],
    }  # fmt: skip


def results(only: str) -> dict[str, list[Row]]:
    """Rows of all scenes by preset."""
    cases, texts = difficult()
    out: dict[str, list[Row]] = {}
    for preset in PRESETS:
        sims: dict[str, cs.Simulator] = {}
        for case in (c for c in cases if only in c["name"]):
            name = case["design"]
            if name not in sims:
                sims[name] = cs.Simulator(design_of(name, texts), preset=preset)
            out.setdefault(preset, []).append(measure(sims[name], case))
    return out


def kinds(found: dict[str, list[Row]]) -> dict[str, float]:
    """Errors of each kind of body by preset [%], their scenes, and the reference's own error."""
    out: dict[str, float] = {}
    for word, title in KINDS.items():
        for preset in PRESETS:
            rows = [r for r in found[preset] if r["case"]["name"].startswith(word)]
            errors = 100 * np.array([e for r in rows for e in r["diagonal"]])
            out[f"{title}/{preset}/rms"] = math.sqrt((errors**2).mean())
            out[f"{title}/{preset}/worst"] = float(np.abs(errors).max())
        out[f"{title}/scenes"] = len(rows)
        out[f"{title}/reference"] = 100 * max(r["case"]["error"] for r in rows)
    return out


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--make", action="store_true", help="compute references")
    parser.add_argument("--again", action="store_true", help="also those that are known")
    parser.add_argument("--only", default="", metavar="WORD", help="scenes with this in the name")
    parser.add_argument("--scenes", action="store_true", help="a line a scene")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.json", help="errors by kind")
    options = parser.parse_args()
    if options.make:
        make(options.only, options.again)
        return
    on_one_core()
    print(describe_machine(("numpy", "numba"))["processor"])
    found = results(options.only)
    if options.scenes or options.only:
        for rows in zip(*found.values(), strict=True):
            case = rows[0]["case"]
            text = "  ".join(
                f"{100 * r['off']:+6.1f} ({100 * np.abs(r['diagonal']).max():4.1f}; est "
                f"{100 * r['estimate']:4.1f}, {r['ratio']:3.1f}){'!' if r['said'] else ' '}"
                for r in rows
            )
            print(f"{case['name']:32s} {case['design']:16s} {1e15 * rows[0]['largest']:9.3f} fF ± "
                  f"{100 * case['error']:.2f} % {text}")  # fmt: skip
        return
    by_kind = kinds(found)
    for key, value in by_kind.items():
        print(f"{key:60s} {value:6.2f}")
    if options.output is not None:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps({"kinds": by_kind}, indent=1) + "\n")


if __name__ == "__main__":
    main()
