"""Deforming meshes in front of sensors, against boundary elements.

    python benchmarks/deforming.py --reference   # computes tests/data/reference_deforming.json
    python benchmarks/deforming.py --poses fist  # only these
    python benchmarks/deforming.py --random 6    # poses at random, with their references

A person of 10,688 vertices and a hand of 812, open at the wrist, follow their bones
(``tests/helpers/rigged.py``), as meshes of SMPL-X and MANO do. Each is one connected mesh,
posed and put over ``six_patch_bare`` and two other designs, 5 mm to 0.2 m away, grounded or on
100 pF. That charge functions are weighted with areas, and how far opposite normals count apart, was
decided on them; those at random were drawn afterwards.

References are boundary elements of the posed triangles (``bem_reference.py``), those near the
sensor divided, on two meshes; what the extrapolation adds is the stated error.

"own": the largest error of the electrodes' own entries of ΔC above 3 % of the largest, relative
to the entry; "all": of all entries. "set-up": time until the first reading, "step": median time
of a reading after every vertex has moved, both processor times. "jump": by how much an entry
changes, over the largest entry, where all joints turn by another 1e-6 rad, beyond what the
largest slope explains; the worst of 31 poses up to 0.06 rad on.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bem_reference import Part, Sensor, sizes, triangles
from machine import on_one_core
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from rigged import Rig, rig

import capsense as cs
from capsense.design import parse_design

Array = NDArray[np.float64]
DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "reference_deforming.json"
SCALES, ORDER = (1.0, 0.7), 2.0
"""Meshes, and the power of the scale that errors go with."""
WALL_GAP = 0.5e-3
"""Triangles nearer to the box than this, or beyond it, are left out [m]."""
SHOWN = 0.03
"""Entries above this fraction of the largest are judged."""
TURN = 1e-6
"""A small turn of all joints [rad]."""
Turns = dict[str, tuple[float, float, float]]

FIST: Turns = {
    f"right_{f}_{k}": (0, a, 0)
    for f in ("index", "middle", "ring", "little") for k, a in enumerate((-75, -85, -40))
}  # fmt: skip
POINT: Turns = {k: v for k, v in FIST.items() if "index" not in k} | {"right_index_0": (0, -12, 0)}
PINCH: Turns = {
    "right_index_0": (0, -50, 0), "right_index_1": (0, -35, 0), "right_middle_0": (0, -18, 0),
    "right_thumb_0": (35, -20, 0), "right_ring_1": (0, -20, 0), "wrist": (0, 0, 0),
}  # fmt: skip
REACH: Turns = {
    "right_arm": (0, -25, 30), "right_forearm": (0, 30, 45), "right_hand": (0, -20, 0),
    "right_index_0": (0, -25, 5), "right_middle_1": (0, -30, 0), "right_ring_0": (0, -40, 0),
    "chest": (10, 5, 15), "head": (20, 0, 0),
}  # fmt: skip
LEAN: Turns = {
    "belly": (15, 0, 0), "chest": (15, 0, 10), "left_arm": (0, 60, 0), "right_arm": (0, -65, 0),
    "left_forearm": (0, 0, -70), "right_forearm": (0, 0, 80), "left_thigh": (-40, 0, 0),
    "left_shank": (60, 0, 0),
}  # fmt: skip


class Case(NamedTuple):
    """A posed mesh over a design."""

    design: str
    mesh: str
    turns: Turns
    part: str
    """Bones whose names begin so stand over the sensor."""
    angles: tuple[float, float, float]
    """Turn of the whole about z, then the new y, then the new x [°]."""
    place: tuple[float, float]
    """Of its lowest point [m]."""
    gap: float
    grounding: float | str = "grounded"


DOWN, UP = (0.0, -90.0, 0.0), (0.0, 90.0, 0.0)
"""Right and left fingers downwards."""
CASES: dict[str, Case] = {
    "hand flat": Case("six_patch_bare", "hand", {}, "right", (20, 0, 8), (0.03, 0.01), 0.01),
    "hand pinching": Case("pad_60", "hand", PINCH, "right", (70, 15, 0), (0.0, 0.01), 0.005),
    "hand pointing": Case("six_patch_bare", "hand", POINT, "right", (0, -65, 10), (-0.02, 0.02),
                          0.008, 1e-10),
    "fist": Case("two_pads", "hand", FIST, "right", (-30, -10, 5), (0.02, 0.0), 0.02),
    "fist, far": Case("six_patch_bare", "hand", FIST, "right", (0, -80, 0), (0, 0), 0.08, 1e-10),
    "reach": Case("six_patch_bare", "person", REACH, "right", (10, -35, 0), (0.01, 0.02), 0.006,
                  1e-10),
    "reach, palm": Case("two_pads", "person", {}, "right", (0, -12, 5), (0.01, 0.0), 0.02),
    "forearm": Case("six_patch_bare", "person", {"right_hand": (10, 50, 0)}, "right_forearm",
                    (40, -6, 20), (0, 0.01), 0.015),
    "belly": Case("pad_60", "person", LEAN, "belly", (15, 0, 88), (0.0, 0.0), 0.03, 1e-10),
    "chest, far": Case("two_pads", "person", LEAN, "chest", (0, 5, 80), (0, 0), 0.15),
    "foot": Case("six_patch_bare", "person", LEAN, "right_foot", (0, 0, 0), (0, 0.01), 0.01, 1e-10),
    "fingers from above": Case("pad_60", "person", {}, "right", DOWN, (0.01, 0), 0.2),
}  # fmt: skip


def random_cases(count: int, seed: int = 0) -> dict[str, Case]:
    """Hands and persons whose joints are all turned at random, in any position over a sensor."""
    rng, out = np.random.default_rng(seed), {}
    for k in range(count):
        mesh = ("hand", "person")[k % 2]
        turns = {b.name: tuple(rng.normal(0.0, 20.0, 3)) for b in rig(mesh == "hand").bones}
        angles = tuple(rng.uniform(-180.0, 180.0, 3))
        gap = float(np.exp(rng.uniform(np.log(0.005), np.log(0.08))))
        out[f"random {k}"] = Case(
            ("six_patch_bare", "pad_60", "two_pads")[k % 3], mesh, turns, "", angles,
            tuple(rng.uniform(-0.03, 0.03, 2)), gap, ("grounded", 1e-10)[k // 2 % 2],
        )  # fmt: skip
    return out


def design_of(name: str) -> cs.Design:
    """A packaged design, or one of free pads in the same box."""
    if name == "six_patch_bare":
        return cs.load_design(name)
    pads = {"pad_60": [(0.06, 0.0)], "two_pads": [(0.04, -0.03), (0.04, 0.03)]}[name]
    return parse_design({
        "name": name,
        "domain": {"size": [0.5] * 3, "backplane": 0.02},
        "electrode": [
            {"name": f"E{k}", "shape": "rectangle", "size": [side] * 2, "center": [x, 0.0]}
            for k, (side, x) in enumerate(pads, 1)
        ],
    })  # fmt: skip


def placed(case: Case, body: Rig, more: float = 0.0) -> Array:
    """Vertices over the sensor [m]; all joints turned by ``more`` [rad] beyond the pose."""
    turns = {b.name: tuple(np.array(case.turns.get(b.name, (0, 0, 0))) + np.degrees(more))
             for b in body.bones}  # fmt: skip
    turn = Rotation.from_euler("ZYX", case.angles, degrees=True).as_matrix()
    still, vertices = (body.posed(t) @ turn.T for t in (case.turns, turns))
    owner = np.array([b.name for b in body.bones])[body.weights.argmax(axis=1)]
    mine = np.flatnonzero([name.startswith(case.part) for name in owner])
    low = still[mine[still[mine, 2].argmin()]].copy()
    low[2] = vertices[mine, 2].min()  # joints that turn leave the gap as it is
    return vertices + np.append(case.place, case.gap) - low


def _divided(corners: Array, size: Any) -> Array:
    """Triangles halved at their longest edges until these are no longer than wanted."""
    done = []
    while len(corners):
        edges = np.roll(corners, -1, axis=1) - corners
        length = np.linalg.norm(edges, axis=2)
        long = length.max(axis=1) > size(corners.mean(axis=1))
        done.append(corners[~long])
        corners, length = corners[long], length[long]
        turn = (length.argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners, turn[..., None], axis=1).transpose(1, 0, 2)
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done)


def reference(case: Case, sensors: dict[tuple[str, float], Sensor]) -> tuple[Array, float, int]:
    """ΔC [F], its error, the largest over the diagonal, and the panels of the finer mesh."""
    body, design = rig(case.mesh == "hand"), design_of(case.design)
    corners = placed(case, body)[body.faces]
    low, high = design.domain.lower + WALL_GAP, design.domain.upper - WALL_GAP
    corners = corners[((corners > low) & (corners < high)).all(axis=(1, 2))]
    line = np.linspace(-1, 1, 9)
    points = np.concatenate([
        np.stack(np.meshgrid(*(m + h * line for m, h in zip(b.mean(0)[:2], np.ptp(b, 0)[:2] / 2,
                 strict=True)), [0.0]), axis=-1).reshape(-1, 3)
        for b in (e.surface.bounds for e in design.electrodes)
    ])  # fmt: skip
    found = []
    for scale in SCALES:
        parts = _divided(corners, sizes(points, scale, 1.0, 0.003, 0.5))
        key = case.design, scale
        if key not in sensors:
            sensors[key] = Sensor(design, scale)
        kind = case.grounding
        found.append(sensors[key].change([Part(triangles(parts), kind)]))
    power = SCALES[1] ** ORDER
    out = (found[1] - power * found[0]) / (1 - power)
    error = np.abs(out - found[1]).max() / np.abs(np.diag(out)).max()
    return out, float(error), len(parts)


def surface_of(case: Case, body: Rig) -> cs.DeformableSurface:
    """The mesh at rest, as a user makes it."""
    return cs.DeformableSurface(body.vertices, body.faces, grounding=case.grounding)


def error_of(found: Array, truth: Array) -> float:
    """Largest relative error of the entries that are judged."""
    shown = np.abs(truth) > SHOWN * np.abs(truth).max()
    return float((np.abs(found - truth)[shown] / np.abs(truth)[shown]).max())


def main() -> None:
    """Print the table, or compute the references."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reference", action="store_true", help="compute what is missing")
    parser.add_argument("--poses", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--preset", default="standard")
    parser.add_argument("--random", type=int, default=0, help="so many poses at random instead")
    args = parser.parse_args()
    known: dict[str, Any] = json.loads(DATA.read_text()) if DATA.exists() else {}
    if args.reference:
        sensors: dict[tuple[str, float], Sensor] = {}
        for name in sorted(args.poses, key=lambda n: CASES[n].design):
            if name in known:
                continue
            start = time.perf_counter()
            delta, error, panels = reference(CASES[name], sensors)
            known[name] = {"delta_fF": np.round(1e15 * delta, 5).tolist(),
                           "error": round(error, 5), "panels": panels}  # fmt: skip
            print(name, known[name]["error"], panels, f"{time.perf_counter() - start:.0f} s",
                  np.round(1e15 * np.diag(delta), 3), flush=True)  # fmt: skip
            DATA.write_text(json.dumps({n: known[n] for n in CASES if n in known}, indent=1) + "\n")
        return
    cases = random_cases(args.random) if args.random else {n: CASES[n] for n in args.poses}
    if args.random:
        held: dict[tuple[str, float], Sensor] = {}
        for name, case in cases.items():
            delta, error, _ = reference(case, held)
            known[name] = {"delta_fF": (1e15 * delta).tolist(), "error": error}
    on_one_core()
    print(f"preset {args.preset}")
    print(f"{'pose':18s} {'design':18s} gap   own     all  reference  set-up      step     jump"
          "   largest  functions")  # fmt: skip
    for name, case in cases.items():
        print(row(name, case, known[name], args.preset), flush=True)


def row(name: str, case: Case, known: dict[str, Any], preset: Any) -> str:
    """A line of the table."""
    body, sim = rig(case.mesh == "hand"), cs.Simulator(design_of(case.design), preset=preset)
    sim.step(cs.Scene([cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, 0.05)))]))  # what is compiled
    start = time.process_time()
    surface = surface_of(case, body)
    surface.vertices = placed(case, body)
    reading = sim.step(cs.Scene([surface.body()]))
    first = time.process_time() - start
    truth = 1e-15 * np.array(known["delta_fF"])
    spent, read = [], []
    angles = np.linspace(0.0, 0.06, 31)
    for angle in angles:
        for more in (0.0, TURN):
            moved = placed(case, body, angle + more)
            start = time.process_time()
            surface.vertices = moved
            read.append(sim.step(cs.Scene([surface.body()])).delta)
            spent.append(time.process_time() - start)
    values = np.array(read).reshape(31, 2, *truth.shape) / np.abs(truth).max()
    slope = np.abs(np.gradient(values[:, 0], angles, axis=0)).max()
    jump = max(0.0, np.abs(values[:, 1] - values[:, 0]).max() - slope * TURN)
    own = error_of(np.diag(reading.delta), np.diag(truth))
    return (
        f"{name:18s} {case.design:15s} {1e3 * case.gap:4.0f} mm {1e2 * own:5.2f} %"
        f" {1e2 * error_of(reading.delta, truth):5.2f} % {1e2 * known['error']:6.2f} %"
        f" {first:6.2f} s {1e3 * np.median(spent):6.2f} ms {jump:8.1e}"
        f" {1e15 * truth.max():7.1f} fF {reading.stats.unknowns:4d}"
    )


if __name__ == "__main__":
    main()
