"""Reference ΔC of many more scenes over ``six_patch_bare``, by ``bem_reference.py``.

    python benchmarks/reference_more.py                 # writes tests/data/reference_more.json
    python benchmarks/reference_more.py --only wall     # only names with this in them
    python benchmarks/reference_more.py --check         # scenes that others have computed, too

Every scene is solved on two meshes, cells of sensor and bodies 0.7 times as large in the second,
and extrapolated; what that adds to the finer result, the largest of it over the diagonal, is the
stated error. With scenes that others have computed, what is left is about half of it.
Scenes already in the file are kept unless ``--again``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from bem_reference import Part, Sensor, Size, box_panels, ends, revolved, sizes, spread
from machine import on_one_core
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from field_cases import delta_reference
from reference_scenes import DESIGN, FEMTO, MAP, MORE

import capsense as cs

Array = NDArray[np.float64]
SCALES, ORDER = (1.0, 0.7), 2.25
"""Meshes, and the power of the scale that errors go with: 2.5 of flat bodies, 2 of round ones."""
WALL_GAP = 0.5e-3
"""Panels nearer than this to the box, or beyond it, are left out [m]."""
PATCHES = (0.053, 0.040)
"""Half of the region of the electrodes [m]."""
MOST = 6000
"""Panels of a scene's bodies."""
PLATES = {
    (0.25, 0.25, 0.06): (0.02, 0.01), (0.14, 0.04, 0.01): (0.0, 0.026),
    (0.1, 0.27, 0.02): (-0.01, 0.02), (0.3, 0.21, 0.03): (0.03, -0.02),
    (0.15, 0.15, 0.02): (0.0, 0.0),
}  # fmt: skip
"""Boxes that lie on electrodes, all but touching them, and where [m]."""


# -- meshes ---------------------------------------------------------------------------------------


def profile(shape: str, size: list[float]) -> tuple[Any, list[float]]:
    """Radius and height over the arc length of a shape's outline, and its corners."""
    r, length = size[0], (size[1] if len(size) > 1 else 0.0)
    if shape == "cylinder":
        s = np.array([0, r, r + length, 2 * r + length])
        reach, height = np.array([0, r, r, 0]), np.array([-1, -1, 1, 1]) * length / 2
        return lambda x: (np.interp(x, s, reach), np.interp(x, s, height)), [r, r + length]
    length = length if shape == "capsule" else 0.0
    quarter = r * math.pi / 2

    def outline(x: Array) -> tuple[Array, Array]:
        along = np.clip(x - quarter, 0, length)
        angle = (x - along) / r
        return r * np.sin(angle), along - length / 2 - r * np.cos(angle)

    return outline, [quarter, quarter + length] if length else []


def mesh(body: dict[str, Any], points: Array, scale: float, finest: float, share: float) -> Part:
    """Panels of a body, as small as the distance to ``points`` (sensor frame) asks for."""
    turn, at = Rotation.from_quat(body["quaternion"]).as_matrix(), np.array(body["position"])
    local = (points - at) @ turn
    curved, shape, dims = None, body["shape"], body["size"]
    fine = 0.65 if body["kind"] == "diel" else 1.0
    scale = fine * scale
    if shape == "box":
        half = np.array(dims) / 2
        rims = None
        if finest < 1e-3:
            edges = [np.array([-53, -23, -15, 15, 23, 53]), np.array([-40, -10, 10, 40])]
            rims = (*(1e-3 * e - a for e, a in zip(edges, at[:2], strict=True)), scale * finest)
            wanted: Size = lambda x: np.full(len(x), scale * 0.006)  # noqa: E731
        else:
            wanted = sizes(local, scale, 0.03, finest, max(share, 0.5))
        corners = box_panels(half, wanted, (7 if body["kind"] == "diel" else 12) / scale, rims)
    elif shape == "ellipsoid":
        r = min(dims)
        outline, _ = profile("sphere", [1.0])
        wanted = sizes(local, scale, r / 2.5, finest, share)
        stops = np.array([0, math.pi / 2, math.pi])
        corners, curved = revolved(outline, stops, wanted, np.array(dims),
                                   lambda x: wanted(x) / max(dims))  # fmt: skip
    else:
        outline, corners_at = profile(shape, dims)
        total = math.pi * dims[0] + dims[1] if shape == "capsule" else (
            math.pi * dims[0] if shape == "sphere" else 2 * dims[0] + dims[1])  # fmt: skip
        wanted = sizes(local, scale, dims[0] / 3, finest, share)
        if shape == "cylinder":
            rim = dims[0] * np.stack([np.cos(t := np.linspace(0, 2 * math.pi, 97)), np.sin(t)], 1)
            rims = np.concatenate([np.c_[rim, np.full(97, z * dims[1] / 2)] for z in (-1, 1)])
            rim_size = sizes(rims, scale, dims[0] / 3, 0.04 * dims[0], 0.5)
            stops = np.array([0, *corners_at, total])
            free = wanted
            corners, curved = revolved(outline, stops, free, meridian=lambda x: np.minimum(
                free(x), rim_size(x)))  # fmt: skip
        else:
            corners, curved = revolved(outline, np.array([0, *corners_at, total]), wanted)
    corners = corners @ turn.T + at
    if curved is not None:
        curved.points, curved.normals = curved.points @ turn.T + at, curved.normals @ turn.T
    if body["kind"] != "diel":
        room = np.array([0.25, 0.25, 0.49]) - WALL_GAP
        corners = corners[(np.abs(corners[..., :2]) < room[:2]).all(axis=(1, 2))
                          & (corners[..., 2] < room[2]).all(axis=1)]  # fmt: skip
    return Part(corners, body["kind"], body.get("eps_r", 1.0), curved)


def bodies_of(case: dict[str, Any]) -> list[dict[str, Any]]:
    """What is solved: bodies that make one conductor are given as such."""
    return case.get("solved_as", case["bodies"])


_SENSORS: dict[float, Sensor] = {}


def solve(case: dict[str, Any], scale: float) -> tuple[Array, int, int]:
    """ΔC [F], and how many panels the sensor and the bodies have."""
    bodies, gap = bodies_of(case), 1e-3 * case["gap_mm"]
    near = gap < 0.0025
    grid = np.meshgrid(spread(ends(PATCHES[0]), lambda x: 0 * x + 2e-3),
                       spread(ends(PATCHES[1]), lambda x: 0 * x + 2e-3))  # fmt: skip
    plane = np.stack([*(g.ravel() for g in grid), np.zeros(grid[0].size)], axis=1)
    rough = [mesh(b, plane, 1.5, 0.004, 0.5).corners.mean(axis=1) for b in bodies]
    finest = 0.45 * gap if near else 0.0015
    while True:
        parts = []
        for k, body in enumerate(bodies):
            points = np.concatenate([plane, *(r for j, r in enumerate(rough) if j != k)])
            parts.append(mesh(body, points, scale, finest, 0.45))
        count = sum(len(p.corners) for p in parts)
        if count < MOST or finest > 0.02:
            break
        finest *= 1.25
    if near and bodies[0]["shape"] != "box":
        low = np.concatenate([p.corners.mean(axis=1) for p in parts])
        sensor = Sensor(cs.load_design(DESIGN), scale, sizes(low, scale, 1.0, 0.45 * gap, 0.6))
    else:
        if scale not in _SENSORS:
            _SENSORS[scale] = Sensor(cs.load_design(DESIGN), scale)
        sensor = _SENSORS[scale]
    return sensor.change(parts), len(sensor.panels), count


def converged(case: dict[str, Any]) -> dict[str, Any]:
    """The case with its figures."""
    started = time.perf_counter()
    (coarse, *_), (fine, *panels) = (solve(case, s) for s in SCALES)
    best = fine + (fine - coarse) / ((SCALES[0] / SCALES[1]) ** ORDER - 1)
    floor = np.maximum(np.abs(np.diag(best)), 0.01 * np.abs(best).max())
    error = float((np.abs(np.diag(best - fine)) / floor).max())
    case = {**case, "delta_fF": [[float(f"{v:.5g}") for v in row] for row in best / FEMTO],
            "error": float(f"{error:.2g}"), "panels": panels}  # fmt: skip
    print(f"{case['category']:30s} {case['gap_mm']:5g} mm  sensor {panels[0]}, bodies {panels[1]}; "
          f"largest {best.max() / FEMTO:9.4f} fF, error {100 * error:.2f} %, "
          f"{time.perf_counter() - started:.0f} s", flush=True)  # fmt: skip
    return case


# -- scenes ---------------------------------------------------------------------------------------


def lowest(body: dict[str, Any]) -> float:
    """How far a body reaches below its centre [m]."""
    down = np.abs(Rotation.from_quat(body["quaternion"]).as_matrix()[2])
    shape, size = body["shape"], body["size"]
    if shape == "box":
        return float(down @ size / 2)
    if shape == "ellipsoid":
        return float(np.linalg.norm(down * size))
    if shape == "cylinder":
        return down[2] * size[1] / 2 + size[0] * math.sqrt(max(0.0, 1 - down[2] ** 2))
    return size[0] + (down[2] * size[1] / 2 if shape == "capsule" else 0.0)


def body(shape: str, size: list[float], kind: str | float = "grounded", at: Any = (0, 0, 0),
         turn: Rotation | None = None, eps: float = 1.0) -> dict[str, Any]:  # fmt: skip
    """One body, centre ``at`` [m]."""
    turn = turn or Rotation.identity()
    return {"shape": shape, "size": [round(float(v), 6) for v in size],
            "position": [round(float(v), 7) for v in at],
            "quaternion": [round(float(v), 9) for v in turn.as_quat()],
            "kind": kind, "eps_r": eps}  # fmt: skip


def placed(item: dict[str, Any], gap: float, x: float, y: float) -> dict[str, Any]:
    """The body with its lowest point ``gap`` [mm] above (about) x, y [m]."""
    z = 1e-3 * gap + lowest(item)
    return {**item, "position": [round(x, 6), round(y, 6), round(z, 7)]}


def scenes() -> list[dict[str, Any]]:
    """All scenes, without figures; the same at every call."""
    rng = np.random.default_rng(20)
    out: list[dict[str, Any]] = []

    def add(category: str, gap: float, *bodies: dict[str, Any], solved_as: Any = None) -> None:
        case = {"category": category, "gap_mm": gap, "bodies": list(bodies)}
        out.append({**case, "solved_as": solved_as} if solved_as else case)

    def turn(tilt: float = 1.0) -> Rotation:
        return Rotation.from_euler("ZYX", (rng.uniform(0, 6), *(tilt * rng.uniform(-0.7, 0.7, 2))))

    def spot(reach: float = 0.03) -> tuple[float, float]:
        return float(rng.uniform(-reach, reach)), float(rng.uniform(-reach, reach))

    def finger(kind: str | float) -> dict[str, Any]:
        return body("capsule", [rng.uniform(0.007, 0.009), rng.uniform(0.05, 0.07)], kind,
                    turn=turn())  # fmt: skip

    for kind, name in (("floating", "finger floating"), (100e-12, "finger on 100 pF")):
        for gap in (3, 10, 30, 60, 100):
            add(name, gap, placed(finger(kind), gap, *spot()))
    for gap, kind, eps in ((5, "grounded", 1.0), (15, "grounded", 1.0), (40, "grounded", 1.0),
                           (10, "floating", 1.0), (30, "floating", 1.0), (10, "diel", 4.0),
                           (30, "diel", 4.0)):  # fmt: skip
        word = f"eps {eps:g}" if kind == "diel" else kind
        r, h = rng.uniform(0.01, 0.03), rng.uniform(0.04, 0.12)
        item = body("cylinder", [r, h], kind, turn=turn(1.5), eps=eps)
        add(f"cylinder {word}", gap, placed(item, gap, *spot()))
        item = body("ellipsoid", list(rng.uniform(0.015, 0.045, 3)), kind, turn=turn(), eps=eps)
        add(f"ellipsoid {word}", gap, placed(item, gap, *spot()))
    for edges in ((0.04, 0.04, 0.02), (0.02, 0.02, 0.02)):
        name = "x".join(f"{1e3 * e:g}" for e in edges)
        for gap in (20, 40, 80):
            add(f"box {name}", gap, placed(body("box", edges), gap, *spot(0.01)))
    for gap in (10, 30):
        item = body("box", (0.04, 0.04, 0.04), "diel", turn=turn(0.5), eps=3.0)
        add("cube eps 3", gap, placed(item, gap, *spot()))

    def limb(kind: str = "grounded") -> dict[str, Any]:
        level = Rotation.from_euler("ZY", (rng.uniform(0, 6), math.pi / 2 + rng.uniform(-0.2, 0.2)))
        return body("capsule", [rng.uniform(0.03, 0.04), 0.15], kind, turn=level)

    def ball(kind: str, eps: float = 1.0) -> dict[str, Any]:
        return body("sphere", [rng.uniform(0.015, 0.025)], kind, eps=eps)

    for gap in (8, 25):
        low = {"x": -0.03, "y": 0.01}
        add("limb + floating ball", gap, placed(limb(), gap + 50, 0.0, 0.0),
            placed(ball("floating"), gap, **low))  # fmt: skip
        add("finger + ball eps 5", gap, placed(finger("grounded"), gap, 0.03, 0.0),
            placed(ball("diel", 5.0), gap, **low))  # fmt: skip
        add("floating box + finger", gap, placed(finger("grounded"), gap, 0.035, -0.02),
            placed(body("box", (0.05, 0.04, 0.03), "floating"), gap, **low))  # fmt: skip
        add("three mixed", gap, placed(finger("grounded"), gap, 0.04, 0.0),
            placed(ball("floating"), gap + 5, **low),
            placed(body("box", (0.2, 0.15, 0.05)), gap + 90, 0.0, 0.0))  # fmt: skip
        three = [body("capsule", [0.008, 0.05], turn=turn(0.3)) for _ in range(3)]
        add(
            "three fingers",
            gap,
            *(placed(one, gap, 0.03 * k - 0.03, 0.01 * k) for k, one in enumerate(three)),
        )
    for gap in (8, 25):
        z = 0.02 + 1e-3 * gap
        r = [0.02]
        add("balls touching", gap, body("sphere", r, at=(-0.02, 0.01, z)),
            body("sphere", r, at=(0.02, 0.01, z)))  # fmt: skip
        add("balls 1 mm apart, floating", gap, body("sphere", r, "floating", (-0.0205, 0.01, z)),
            body("sphere", r, "floating", (0.0205, 0.01, z)))  # fmt: skip
        add("ball and finger overlapping", gap, body("sphere", r, at=(-0.01, 0.01, z)),
            body("capsule", [0.008, 0.06], at=(0.0, 0.01, z + 0.03)))  # fmt: skip
        one = body("sphere", r, at=(0.01, 0.01, z))
        add("balls coinciding", gap, one, one, solved_as=[one])
        aside = {**one, "position": [0.0101, 0.01, z]}
        axis = Rotation.from_euler("Y", math.pi / 2)
        add("balls 0.1 mm apart", gap, one, aside, solved_as=[
            body("capsule", [0.02, 1e-4], at=(0.01005, 0.01, z), turn=axis)])  # fmt: skip
        half = [0.06, 0.06, 0.02]
        add("boxes stacked", gap, body("box", half, at=(0.01, 0.0, z - 0.01)),
            body("box", half, at=(0.01, 0.0, z + 0.01)),
            solved_as=[body("box", [0.06, 0.06, 0.04], at=(0.01, 0.0, z))])  # fmt: skip
    for gap, yaw in ((10, 0.3), (30, 2.5)):
        level = Rotation.from_euler("ZY", (yaw, math.pi / 2))
        x, y = math.cos(yaw), math.sin(yaw)
        add(
            "limb through the wall",
            gap,
            placed(body("capsule", [0.035, 0.35], turn=level), gap, 0.15 * x, 0.15 * y),
        )
        tilted, far = Rotation.from_euler("ZY", (yaw, 0.9)), 0.3 * math.sin(0.9)
        add(
            "arm through the ceiling",
            gap,
            placed(body("capsule", [0.04, 0.6], turn=tilted), gap, far * x, far * y),
        )
        add("plate through the wall", gap, placed(body("box", (0.3, 0.1, 0.02)), gap, 0.16, 0.01))
    for gap in (0.5, 1, 2):
        x, y = 0.003, 0.026
        add("near ball", gap, placed(body("sphere", [0.02]), gap, x, y))
        add("near box", gap, placed(body("box", (0.04, 0.04, 0.02)), gap, 0.001, 0.0255))
        slant = Rotation.from_euler("ZY", (0.4, 0.6))
        add("near finger", gap, placed(body("capsule", [0.008, 0.06], turn=slant), gap, x, y))
        for size, (x, y) in PLATES.items():
            add("near plate", gap, placed(body("box", size), gap, x, y))
    over = Rotation.from_euler("ZY", (0.3, math.pi / 2))
    for gap in (5, 10, 20, 50):
        add("wide box", gap, placed(body("box", (0.3, 0.26, 0.1)), gap, 0.01, -0.005))
        add("wide ball", gap, placed(body("sphere", [0.15], "floating"), gap, 0.01, -0.005))
        trunk = body("capsule", [0.11, 0.15], turn=over)
        add("wide capsule", gap, placed(trunk, gap, 0.01, -0.005))
    for eps in (4.0, 40.0):
        for gap in (5, 10, 20, 50):
            for name, height in (("slab", 0.03), ("box", 0.12)):
                item = body("box", (0.3, 0.26, height), "diel", eps=eps)
                add(f"wide {name} eps {eps:g}", gap, placed(item, gap, 0.01, -0.005))
            item = body("sphere", [0.15], "diel", eps=eps)
            add(f"wide ball eps {eps:g}", gap, placed(item, gap, 0.01, -0.005))
    return out


def key(case: dict[str, Any]) -> str:
    """A scene's identity: everything but its figures."""
    return json.dumps([case["category"], case["gap_mm"], case["bodies"], case.get("solved_as")])


def write(cases: list[dict[str, Any]]) -> None:
    """The file, a case a line."""
    head = {
        "about": "scenes over six_patch_bare; written by benchmarks/reference_more.py",
        "note": "ΔC [fF], Maxwell form, rows E1..E6, extrapolated from two meshes; error: what "
        "that adds, the largest of the diagonal, relative (entries below 1 % of the largest: to "
        "that); "
        "panels: of the sensor and the bodies in the finer one. Shapes as in reference_map.json; "
        "besides cylinder (radius, length), ellipsoid (half axes); kind may be a capacitance to "
        "ground [F]. solved_as: the single conductor that touching bodies make, where that is what "
        "was solved; other touching or overlapping conductors were solved with all their surfaces.",
        "error": 0.003,
    }
    lines = [f" {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)},\n" for k, v in head.items()]
    rows = ",\n".join(f"  {json.dumps(c, ensure_ascii=False)}" for c in cases)
    MORE.write_text("{\n" + "".join(lines) + ' "cases": [\n' + rows + "\n ]\n}\n")


def check() -> None:
    """Scenes that others have computed."""
    map_cases = json.loads(MAP.read_text())["cases"]
    picked = {c["category"]: c for c in map_cases if c["gap_mm"] in (10, 20)}.values()
    bar = placed(body("box", (0.15, 0.15, 0.02)), 20, 0.0, 0.0)
    cases = [{"category": "bar", "gap_mm": 20, "bodies": [bar]}, *picked]
    for case in cases:
        known = case.get("delta_fF")
        found = FEMTO * np.array(converged(case)["delta_fF"])
        truth = FEMTO * np.array(known) if known else delta_reference(DESIGN, "bar 20")
        off = (found - truth) / np.maximum(np.abs(truth), 0.01 * truth.max())
        print(f"    diagonal off by {np.round(100 * np.diag(off), 2)} %", flush=True)


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="categories with this in their name")
    parser.add_argument("--again", action="store_true", help="solve what the file has, too")
    parser.add_argument("--list", action="store_true", help="name the scenes and stop")
    parser.add_argument("--check", action="store_true", help="against figures of others")
    args = parser.parse_args()
    on_one_core()
    if args.check:
        check()
        return
    wanted = scenes()
    if args.list:
        for case in wanted:
            print(f"{case['category']} {case['gap_mm']:g} mm, {len(case['bodies'])} bodies")
        print(len(wanted), "scenes")
        return
    kept = json.loads(MORE.read_text())["cases"] if MORE.exists() else []
    have = {key(c): c for c in kept}
    for case in wanted:
        if args.only in case["category"] and (args.again or key(case) not in have):
            have[key(case)] = converged(case)
            write([have[key(c)] for c in wanted if key(c) in have])


if __name__ == "__main__":
    main()
