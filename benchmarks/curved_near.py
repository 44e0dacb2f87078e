"""Balls in the first millimetres over bent films, against boundary elements.

    python benchmarks/curved_near.py                # arm_segment, two minutes
    python benchmarks/curved_near.py --random 6     # random films, a minute or two each
    python benchmarks/curved_near.py --panels 0.8   # finer ones, to see how far they converged

Panels of the balls and of the design are graded to where they are nearest. Design and ball are
solved as one system, by a Schur complement of the design's own. Errors are those of the self
capacitance of the electrode.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import shapely
from machine import describe_machine
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from shapely.geometry import Point, Polygon, box

import capsense as cs
from capsense.design import film, parse_design, shapes
from capsense.design.geometry import Facet
from capsense.design.model import Design
from capsense.field import boundary
from capsense.field.boundary import Accuracy, BoundarySolution
from capsense.field.gap_table import PlaneResponse
from capsense.field.panels import Panels

Array = NDArray[np.float64]
DESIGN, ELECTRODE = "arm_segment", 1
RADII, GAPS = (0.020, 0.006), (0.1e-3, 0.3e-3, 0.5e-3, 1e-3, 2e-3, 3e-3, 5e-3, 10e-3)
PRESETS = "fast", "standard", "fine"
FINEST, COARSE = 2.5e-4, 0.4
"""Panels near where a ball is nearest: least size [m], and size over their distance from it."""
ROUND = 1 / 8000
"""Flat strips of the reference leave its round surfaces by this part of the radius."""
AROUND, GROWTH, WIDEST = 28, 1.35, 0.28
"""Triangles around a ball; growth of its rings, and the widest of them [rad]."""
RULE = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6
"""Points of a quadrature of a triangle, exact to the second order."""


def ball(radius: float, gap: float) -> Array:
    """Triangles of a ball over the origin, shape (m, 3, 3) [m]; small where it is nearest."""
    angles = [0.25 * math.sqrt(2 * gap / radius)]
    while angles[-1] < math.pi - 0.25:
        angles.append(min(GROWTH * angles[-1], angles[-1] + WIDEST))
    polar = np.array([0.0, *angles[:-1], math.pi])[:, None]
    turn = 2 * math.pi * np.arange(AROUND + 1) / AROUND
    unit = np.sin(polar)[..., None] * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    unit[..., 2] -= np.cos(polar)
    a, b, c, d = unit[:-1, :-1], unit[:-1, 1:], unit[1:, 1:], unit[1:, :-1]
    both = np.concatenate([np.stack([a, b, c], 2)[1:], np.stack([a, c, d], 2)[:-1]])
    return radius * both.reshape(-1, 3, 3) + [0.0, 0.0, radius + gap]


def panels(corners: Array) -> Panels:
    """Panels of triangles, each with a quadrature of 12 points."""
    a, b, c = corners.transpose(1, 0, 2)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = np.stack([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]).transpose(2, 0, 1, 3)
    normals = np.cross(b - a, c - a)
    size, sides = np.linalg.norm(normals, axis=1), np.stack([a - b, b - c, c - a])
    return Panels(
        np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3),
        np.arange(0, 3 * len(a) + 1, 3), normals / size[:, None], corners.mean(axis=1),
        np.linalg.norm(sides, axis=2).max(axis=0),
        np.einsum("qk,mpkd->mpqd", RULE, quarters).reshape(-1, 12, 3),
        np.repeat(size / 24, 12).reshape(-1, 12),
    )  # fmt: skip


def random_film(seed: int) -> dict[str, Any]:
    """A bent film of a few electrodes, alone, over a shield or over a driven housing."""
    rng = np.random.default_rng(seed)
    radius, (nx, ny) = rng.uniform(0.02, 0.12), rng.integers(1, 4, 2)
    size, apart = rng.uniform(0.006, 0.03, 2), rng.uniform(0.001, 0.004)
    size[0] = min(size[0], 2.0 * radius / nx - apart)
    center = [
        (np.arange(n) - (n - 1) / 2) * (s + apart) for n, s in zip((nx, ny), size, strict=True)
    ]
    electrodes = [
        {"name": f"E{i}{j}", "shape": "rectangle", "size": size.tolist(), "center": [x, y]}
        for i, x in enumerate(center[0].tolist())
        for j, y in enumerate(center[1].tolist())
    ]
    behind = rng.choice(["nothing", "shield", "housing"])
    depth, whole = rng.uniform(3e-4, 3e-3), [nx * (size[0] + apart), ny * (size[1] + apart)]
    conductors: list[dict[str, Any]] = []
    if behind == "shield":
        conductors = [{"shape": "rectangle", "size": whole, "center": [0.0, 0.0, -depth]}]
    if behind == "housing":
        conductors = [{"shape": "cylinder", "radius": radius - depth, "length": whole[1],
                       "center": [0.0, 0.0, -radius], "tilt": [90, 0, 0]}]  # fmt: skip
    return {
        "name": f"film {seed}",
        "description": f"{nx} x {ny} of {1e3 * size[0]:.0f} x {1e3 * size[1]:.0f} mm, radius "
        f"{1e3 * radius:.0f} mm, {behind}",
        "domain": {"size": [0.6, 0.6, 0.6], "backplane": 0.28},
        "bend": {"radius": radius},
        "electrode": electrodes,
        "conductor": [{"name": "back", "role": "shield"} | c for c in conductors],
    }


def round_design(load: Callable[[], Design]) -> Design:
    """A design with so many strips that its face is round where gaps are small."""
    usual = film.STRIP_ERROR, shapes.STRIP_ERROR, shapes.MAX_SEGMENTS
    film.STRIP_ERROR = shapes.STRIP_ERROR = ROUND
    shapes.MAX_SEGMENTS = 1000
    try:
        return load()
    finally:
        film.STRIP_ERROR, shapes.STRIP_ERROR, shapes.MAX_SEGMENTS = usual


@contextmanager
def graded_to(point: Array) -> Iterator[None]:
    """Cut panels finer near a point [m], as finely as balls over it need."""
    usual = boundary._pieces

    def finer(design: Design, scale: float) -> list[Any]:
        return [
            part._replace(pieces=list(halved(part.pieces, part.facet, point)))
            for part in usual(design, scale)
        ]

    boundary._pieces = finer
    try:
        yield
    finally:
        boundary._pieces = usual


def halved(pieces: list[Polygon], facet: Facet, point: Array) -> Iterator[Polygon]:
    """Pieces of a facet, halved while they are larger than FINEST and COARSE times their distance
    from a point."""
    u, v, height = facet.axes @ (point - facet.origin)
    foot, todo = Point(u, v), list(pieces)
    while todo:
        piece = todo.pop()
        x0, y0, x1, y1 = piece.bounds
        size = max(x1 - x0, y1 - y0)
        if size <= max(FINEST, COARSE * math.hypot(piece.distance(foot), height)):
            yield piece
            continue
        wide = x1 - x0 > y1 - y0
        x, y = (0.5 * (x0 + x1), y1) if wide else (x1, 0.5 * (y0 + y1))
        window = box(x0, y0, x, y)
        for part in (piece.intersection(window), piece.difference(window)):
            todo += [p for p in shapely.get_parts(part) if p.geom_type == "Polygon" and p.area > 0]


def measure(load: Callable[[], Design], electrode: int, scale: float, rng: Any) -> list[Array]:
    """Print and return errors of the presets over an electrode, in its middle unless ``rng``."""
    design = load()
    low, high = design.film.sheets[design.electrodes[electrode].name].bounds
    at = 0.5 * (low + high)
    if rng is not None:
        at[:2] = rng.uniform(low[:2], high[:2])
    turn, place = (
        Rotation.from_rotvec([0.0, at[0] / design.film.radius, 0.0]),
        design.film.placed(at),
    )
    with graded_to(place):
        solution = BoundarySolution(round_design(load), Accuracy(scale, fitted=False))
    model, response = solution.model, PlaneResponse(solution)
    densities = solution.densities(np.eye(model.n_terminals))
    sims = {preset: cs.Simulator(design, preset=preset) for preset in PRESETS}
    print(f"{design.name}: {design.description}; {model.panels.size} panels")
    print("radius [mm]  gap [mm]  change [fF]  " + "  ".join(f"{p:>8} [%]" for p in PRESETS))
    out = []
    for radius in RADII:
        for gap in GAPS:
            corners = turn.apply(ball(radius, gap).reshape(-1, 3)).reshape(-1, 3, 3) + place
            found = response.at(panels(corners), densities)
            gained = model.panels.areas @ (found.change[:, electrode] * (model.owner == electrode))
            center = design.film.placed(at + np.array([0.0, 0.0, radius + gap]))
            body = cs.Body(cs.Sphere(radius), cs.Pose(tuple(center)))
            errors = []
            for sim in sims.values():
                sim.reset()
                delta = sim.step(cs.Scene([body])).delta
                errors.append(100 * (delta[electrode, electrode] / gained - 1))
            numbers = f"{1e3 * radius:11.0f}  {1e3 * gap:8.1f}  {1e15 * gained:11.1f}"
            print(numbers, *(f"{x:+12.1f}" for x in errors), sep="  ", flush=True)
            out.append(np.array(errors))
    return out


def main() -> None:
    """Print errors of the presets."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panels", type=float, default=1.0, help="size of the designs' panels")
    parser.add_argument("--random", type=int, default=0, help="so many random films instead")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first of them")
    options = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # near contact
    print(describe_machine(("numpy", "numba"))["processor"])
    if not options.random:
        measure(lambda: cs.load_design(DESIGN), ELECTRODE, options.panels, None)
        return
    errors: list[Array] = []
    for seed in range(options.seed, options.seed + options.random):
        rng, table = np.random.default_rng(1000 + seed), random_film(seed)
        count = len(table["electrode"])
        errors += measure(
            lambda table=table: parse_design(table), int(rng.integers(count)), options.panels, rng
        )
    every = np.abs(np.array(errors)).T
    for preset, one in zip(PRESETS, every, strict=True):
        rms, worst = math.sqrt((one**2).mean()), one.max()
        print(f"{preset}: {rms:.1f} % rms, 95 % below {np.percentile(one, 95):.1f}, {worst:.1f}")


if __name__ == "__main__":
    main()
