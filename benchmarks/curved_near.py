"""Balls in the first millimetres over an electrode of ``arm_segment``, against boundary elements.

    python benchmarks/curved_near.py                 # 16,000 panels, about four minutes
    python benchmarks/curved_near.py --panels 1.0    # coarser ones, to see how far they converged

The balls' panels are graded towards the electrode. Design and ball are solved as one system, by a
Schur complement of the design's own. Errors are those of the self capacitance of the electrode.
"""

from __future__ import annotations

import argparse
import math
import warnings

import numpy as np
from machine import describe_machine
from numpy.typing import NDArray

import capsense as cs
from capsense.design import film, shapes
from capsense.design.model import Design
from capsense.field.boundary import Accuracy, BoundarySolution
from capsense.field.gap_table import PlaneResponse
from capsense.field.panels import Panels

Array = NDArray[np.float64]
DESIGN, PLACE = "arm_segment", (0.0, -0.021)
"""The second electrode is the highest, and this its middle [m]."""
RADII, GAPS = (0.020, 0.006), (0.3e-3, 0.5e-3, 1e-3, 2e-3, 3e-3, 5e-3, 10e-3)
PRESETS = "learning", "standard", "fine"
ROUND = 1 / 4000
"""Flat strips of the reference leave its round surfaces by this part of the radius."""
AROUND, GROWTH, WIDEST = 28, 1.35, 0.28
"""Triangles around a ball; growth of its rings, and the widest of them [rad]."""
RULE = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6
"""Points of a quadrature of a triangle, exact to the second order."""


def ball(radius: float, gap: float) -> Array:
    """Triangles of a ball over the electrode, shape (m, 3, 3) [m]; small where it is nearest."""
    angles = [0.25 * math.sqrt(2 * gap / radius)]
    while angles[-1] < math.pi - 0.25:
        angles.append(min(GROWTH * angles[-1], angles[-1] + WIDEST))
    polar = np.array([0.0, *angles[:-1], math.pi])[:, None]
    turn = 2 * math.pi * np.arange(AROUND + 1) / AROUND
    unit = np.sin(polar)[..., None] * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    unit[..., 2] -= np.cos(polar)
    a, b, c, d = unit[:-1, :-1], unit[:-1, 1:], unit[1:, 1:], unit[1:, :-1]
    both = np.concatenate([np.stack([a, b, c], 2)[1:], np.stack([a, c, d], 2)[:-1]])
    return radius * both.reshape(-1, 3, 3) + [*PLACE, radius + gap]


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


def round_design() -> Design:
    """The design with so many strips that its face is round where gaps are small."""
    usual = film.STRIP_ERROR, shapes.STRIP_ERROR, shapes.MAX_SEGMENTS
    film.STRIP_ERROR = shapes.STRIP_ERROR = ROUND
    shapes.MAX_SEGMENTS = 1000
    out = cs.load_design(DESIGN)
    film.STRIP_ERROR, shapes.STRIP_ERROR, shapes.MAX_SEGMENTS = usual
    return out


def main() -> None:
    """Print errors of the presets."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panels", type=float, default=1.0, help="size of the design's panels")
    options = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # near contact
    machine = describe_machine(("numpy", "numba"))
    solution = BoundarySolution(round_design(), Accuracy(options.panels, fitted=False))
    model = solution.model
    print(f"{machine['processor']}; {DESIGN}, {model.panels.size} panels")
    densities, response = solution.densities(np.eye(model.n_terminals)), PlaneResponse(solution)
    sims = {preset: cs.Simulator(DESIGN, preset=preset) for preset in PRESETS}
    print("radius [mm]  gap [mm]  change [fF]  " + "  ".join(f"{p:>8} [%]" for p in PRESETS))
    for radius in RADII:
        for gap in GAPS:
            found = response.at(panels(ball(radius, gap)), densities)
            gained = model.panels.areas @ (found.change[:, 1] * (model.owner == 1))
            body = cs.Body(cs.Sphere(radius), cs.Pose((*PLACE, radius + gap)))
            errors = []
            for sim in sims.values():
                sim.reset()
                errors.append(100 * (sim.step(cs.Scene([body])).delta[1, 1] / gained - 1))
            numbers = f"{1e3 * radius:11.0f}  {1e3 * gap:8.1f}  {1e15 * gained:11.1f}"
            print(numbers, *(f"{x:+12.1f}" for x in errors), sep="  ", flush=True)


if __name__ == "__main__":
    main()
