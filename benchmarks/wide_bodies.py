"""Wide bodies in fleets on Warp, beside a fleet on the CPU with the preset ``"fine"``.

    python benchmarks/wide_bodies.py                  # budget 64, scenes of both halves
    python benchmarks/wide_bodies.py --half tuned --budget 128

Scenes are drawn at random: a table, a wall, a trunk or a person of ten capsules that are joined, of
random sizes and matter, whose lowest point within 0.2 m of the design's axis is 15 to 150 mm above
its top (even in the logarithm), half of them face on to 15 degrees, half turned in any way. Designs
are grids of random pads, but for the first one of each half. Nothing was chosen by the scenes of
the half ``held``.
The error of a scene is the largest difference of an entry of ΔC over the largest entry of the
CPU's. Scenes count where that is above a thousandth of the largest entry of the empty sensor's.
"""

from __future__ import annotations

import argparse
import tomllib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.design import load_design, parse_design

Array = NDArray[np.float64]
Random = np.random.Generator
HALVES = {"tuned": (1, "six_patch_bare"), "held": (101, "six_patch")}
"""Seed of each half, and its first design."""
DESIGNS, EACH = 4, 6
"""Designs of a half, and scenes of each kind over each."""
SEEN = 1e-3
"""Least of the largest entry of ΔC over that of the empty sensor's matrix."""
TILT, GAPS, ABOVE = 15.0, (0.015, 0.15), 0.2
"""Largest tilt of bodies that face the design [degrees]; gaps [m]; and half the width of what is
above the design [m]."""
MATTER = [("steel", "grounded"), ("human", "grounded"), ("human", 100e-12), ("steel", "floating")]
"""Conductors and their groundings; every third table or wall is of wood."""


class WideScene(NamedTuple):
    """Bodies that are one conductor if there are more of them, and their poses, shape (b, 7)."""

    kind: str
    bodies: list[cs.Body]
    poses: Array


def random_grid(name: str, rng: Random) -> cs.Design:
    """A grid of pads of 12 to 40 mm, every second one on a board with a ground plane."""
    w, h = np.round(rng.uniform(0.012, 0.04, 2), 3).tolist()
    gap, back = np.round(rng.uniform([0.003, 0.006], [0.012, 0.02]), 3).tolist()
    nx, ny = rng.integers(1, 4, 2).tolist()
    side = round(float(rng.uniform(0.4, 0.6)), 2)
    out = [f'name="{name}"\n[domain]\nsize=[{side},{side},{side}]\nbackplane={back}']
    xs, ys = ((np.arange(n) - (n - 1) / 2) * (a + gap) for n, a in ((nx, w), (ny, h)))
    out += [
        f'[[electrode]]\nname="E{i}{j}"\nshape="rectangle"\nsize=[{w},{h}]\n'
        f"center=[{x:.6f},{y:.6f},0.0]"
        for i, x in enumerate(xs)
        for j, y in enumerate(ys)
    ]
    if rng.random() < 0.5:
        area = f"size=[{nx * (w + gap) + 0.01:.6f},{ny * (h + gap) + 0.01:.6f}]"
        out.append(f'[[layer]]\nname="board"\neps_r=4.5\n{area}\nz=[-0.0016,0.0]')
        out.append(
            f'[[conductor]]\nname="gnd"\nrole="ground"\nshape="rectangle"\n{area}\n'
            "center=[0.0,0.0,-0.0016]"
        )
    return parse_design(tomllib.loads("\n".join(out)))


def _person(rng: Random) -> tuple[list[cs.Shape], Array]:
    """Ten capsules: trunk, head, arms and legs of two each; offsets and turns, shape (10, 7)."""
    r, reach = rng.uniform(0.11, 0.16), rng.uniform(0.9, 1.1)
    parts = [((0, 0, 0), r, 0.42 * reach, 0.0), ((0, 0, 0.43 * reach), 0.09, 0.08, 0.0)]
    for side in (-1, 1):
        out = np.radians(rng.uniform(10, 80))
        for k, (radius, length) in enumerate(((0.05, 0.26), (0.04, 0.25))):
            along = reach * (0.13 + 0.28 * k)
            x, z = r + 0.03 + along * np.sin(out), 0.2 * reach - along * np.cos(out)
            parts.append(((side * x, 0, z), radius, length, -side * out))
        for k, (radius, length) in enumerate(((0.08, 0.34), (0.055, 0.34))):
            parts.append(((side * 0.1, 0, -(0.42 + 0.42 * k) * reach), radius, length, 0.0))
    where = [
        [*at, *Rotation.from_euler("y", turn).as_quat()] for at, _, _, turn in parts
    ]  # fmt: skip
    return [cs.Capsule(radius, length) for _, radius, length, _ in parts], np.array(where)


def _shapes(kind: str, rng: Random) -> tuple[list[cs.Shape], Array]:
    """Shapes of a scene's body, whose widest side faces z, and their poses in its frame."""
    if kind == "person":
        shapes, where = _person(rng)
        turn = Rotation.from_euler("x", 90, degrees=True)
        where[:, :3] = turn.apply(where[:, :3])
        where[:, 3:] = (turn * Rotation.from_quat(where[:, 3:])).as_quat()
        return shapes, where
    shape: cs.Shape
    turn = Rotation.identity()
    if kind == "table":
        shape = cs.Box(tuple(rng.uniform([0.5, 0.4, 0.015], [1.6, 1.0, 0.05])))
    elif kind == "wall":
        shape = cs.Box(tuple(rng.uniform([1.0, 1.0, 0.06], [3.0, 3.0, 0.2])))
    else:
        r, length = rng.uniform([0.1, 0.3], [0.2, 0.7])
        turn = Rotation.from_euler("y", 90, degrees=True)
        shape = [cs.Capsule(r, length), cs.Cylinder(r, length), cs.Ellipsoid((r, 1.3 * r, length))][
            int(rng.integers(3))
        ]
    return [shape], np.array([[0.0, 0.0, 0.0, *turn.as_quat()]])


def _surface(shape: cs.Shape, rng: Random) -> Array:
    """Random points of a shape's surface, shape (n, 3)."""
    mesh = shape.to_trimesh()
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), 20000, p=area / area.sum())
    u = np.sqrt(rng.random((20000, 1)))
    v = rng.random((20000, 1))
    inside: Array = (1 - u) * a[face] + u * (1 - v) * b[face] + u * v * c[face]
    return np.concatenate([inside, mesh.vertices])


def random_scene(kind: str, number: int, top: float, rng: Random) -> WideScene:
    """A scene over a design whose top is at z = ``top``."""
    shapes, where = _shapes(kind, rng)
    if number % 2:
        turn = Rotation.random(random_state=rng)
    else:
        turn = Rotation.from_euler("ZYX", rng.uniform([0, -TILT, -TILT], [360, TILT, TILT]), True)
    where[:, :3] = turn.apply(where[:, :3])
    where[:, 3:] = (turn * Rotation.from_quat(where[:, 3:])).as_quat()
    points = np.concatenate(
        [
            Rotation.from_quat(p[3:]).apply(_surface(shape, rng)) + p[:3]
            for shape, p in zip(shapes, where, strict=True)
        ]
    )
    share = rng.uniform(0, 0.9)  # from the lowest point to the middle, one of them is in front
    shift = rng.uniform(-0.05, 0.05, 2) - share * points[points[:, 2].argmin(), :2]
    above = (np.abs(points[:, :2] + shift) < ABOVE).all(axis=1)
    lowest = points[above if above.any() else ..., 2].min()
    where[:, :2] += shift
    where[:, 2] += top + np.exp(rng.uniform(*np.log(GAPS))) - lowest
    material, grounding = MATTER[int(rng.integers(len(MATTER)))]
    if kind in ("table", "wall") and number % 3 == 2:
        material, grounding = "wood", "floating"
    bodies = [cs.Body(shape, material=material, grounding=grounding) for shape in shapes]
    return WideScene(kind, bodies, where)


def scenes_of(half: str) -> list[tuple[cs.Design, list[WideScene]]]:
    """The scenes of each design of a half."""
    seed, first = HALVES[half]
    rng = np.random.default_rng(seed)
    out = []
    for d in range(DESIGNS):
        design = load_design(first) if d == 0 else random_grid(f"grid_{half}_{d}", rng)
        top = max([0.0, *(float(layer.upper[2]) for layer in design.layers)])
        kinds = ("table", "wall", "trunk", "person")
        out.append(
            (design, [random_scene(kind, n, top, rng) for kind in kinds for n in range(EACH)])
        )
    return out


def deltas(
    design: cs.Design, scenes: list[WideScene], **options: object
) -> tuple[Array, Array, float]:
    """ΔC of scenes of equally many bodies, what the fleet says of its error, and the largest entry
    of the empty sensor's matrix [F]."""
    places = len(scenes[0].bodies)
    fleet = cs.Fleet(design, scenes[0].bodies, len(scenes), **options)
    for place in range(places):
        fleet.change(place, [scene.bodies[place] for scene in scenes])
    if places > 1:
        fleet.join(list(range(places)))
    reading = fleet.step(np.array([scene.poses for scene in scenes]))
    host = [x if isinstance(x, np.ndarray) else x.numpy() for x in (reading.delta, reading.error)]
    empty = float(np.abs(fleet.baseline).max())
    return host[0][:, 0].astype(float), host[1][:, 0].astype(float), empty


def errors(half: str, budget: int, device: str) -> dict[str, Array]:
    """Of each kind, errors and what the fleet says of them [%], shape (scenes, 2)."""
    out: dict[str, list[Array]] = {}
    for design, scenes in scenes_of(half):
        for kind in dict.fromkeys(scene.kind for scene in scenes):
            some = [scene for scene in scenes if scene.kind == kind]
            truth, _, empty = deltas(design, some, preset="fine")
            found, said, _ = deltas(design, some, device=device, budget=budget)
            largest = np.abs(truth).max(axis=(1, 2))
            seen = largest > SEEN * empty
            off = np.abs(found - truth).max(axis=(1, 2))
            rows = 100 * np.stack([off, said], axis=1)[seen] / largest[seen, None]
            out.setdefault(kind, []).append(rows)
    return {kind: np.concatenate(parts) for kind, parts in out.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--half", choices=[*HALVES], nargs="+", default=list(HALVES))
    parser.add_argument("--budget", type=int, nargs="+", default=[64])
    parser.add_argument("--device", default="warp:cpu")
    options = parser.parse_args()
    for half in options.half:
        for budget in options.budget:
            found = errors(half, budget, options.device)
            for kind, rows in {**found, "all": np.concatenate(list(found.values()))}.items():
                off, said = rows.T
                print(
                    f"{half} {budget} {kind:7} {len(off):3} scenes: median {np.median(off):.2f} %, "
                    f"90 % {np.quantile(off, 0.9):.2f} %, worst {off.max():.2f} %; "
                    f"said, median {np.median(said):.2f} %",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
