"""Converged reference capacitances of objects in front of a sensor, by boundary elements.

    python benchmarks/references.py            # write the figures of a capsule over six_patch_bare
    python benchmarks/references.py --curved   # write those of balls and a limb over arm_segment
    python benchmarks/references.py --check    # re-derive figures carried over from elsewhere

The object is one more grounded conductor in the design's box. Its effect follows from reciprocity,

    ΔC_ij = −∮ φ⁰_i σ_j dS,

with φ⁰_i the empty domain's potential at 1 V on electrode i and σ_j the charge density on the
object at 1 V on electrode j: no difference of two large numbers is taken. Every case is solved at
several panel densities and extrapolated; what the extrapolation adds is the error estimate.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import scipy.linalg
import shapely
from numpy.typing import NDArray

import capsense as cs
from capsense.constants import EPS0
from capsense.design.geometry import Facet, Surface, boundary_segments
from capsense.design.model import Design
from capsense.field import bem_kernels as kernels
from capsense.field.boundary import terminals
from capsense.field.panels import Grading, concatenate, cut_facet, make_panels, walls

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
CARRIED = DATA / "reference_capacitances.json"
OUTPUT = DATA / "reference_capsule.json"

OBJECT, WALLS = -1, -2
"""Owners of panels that are no terminal's."""
SCALES = (1.4, 1.0, 0.75)
"""Panel sizes, as multiples of the ones in this file ..."""
CURVED_SCALES = (2.0, 1.4, 1.05)
"""... and for the curved design, which has more surface."""
GAPS = (5, 10, 20, 50, 100)
"""Gaps [mm] between the capsule's lowest point and the electrode plane."""
RADIUS, LENGTH = 0.040, 0.200
"""The capsule [m]; its length is without the caps."""
AZIMUTH, TILT = math.radians(30.0), math.radians(12.0)
"""Direction of its axis: in the plane from x towards y, and upward."""
LOWEST = np.array([-0.045, -0.045 * math.tan(AZIMUTH)])
"""Where in the plane [m] the lowest point lies: over E1; the axis passes over the origin."""

CURVED_OUTPUT = DATA / "reference_arm_segment.json"
BALL_RADIUS, BALL_GAPS = 0.040, (5, 10, 20, 50, 100)
"""The ball over the curved design [m], and its gaps to the shell [mm]."""
BALL_ANGLE, BALL_ALONG = math.radians(12.0), 0.005
"""Where it stands: about the shell's axis, from z towards x, and along the axis [m]."""
LIMB_GAPS = (10, 50)
LIMB_AXIS = np.array([math.cos(math.radians(40.0)), math.sin(math.radians(40.0)), 0.0])
"""Direction of a capsule that crosses the shell above its crest; sizes as over the flat design."""

AXIS = np.array(
    [math.cos(TILT) * math.cos(AZIMUTH), math.cos(TILT) * math.sin(AZIMUTH), math.sin(TILT)]
)


# -- objects ------------------------------------------------------------------------------------


def box(center: Array, size: Array) -> Surface:
    """The faces of a box; its edges are rims."""
    facets = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n, u = np.zeros(3), np.zeros(3)
            n[axis], u[(axis + 1) % 3] = sign, 1.0
            v = np.cross(n, u)
            a, b = size[(axis + 1) % 3] / 2, size[(axis + 2) % 3] / 2
            polygon = shapely.box(-a, -b, a, b)
            facets.append(Facet(polygon, center + n * size[axis] / 2, np.array([u, v, n])))
    segments = np.concatenate([boundary_segments(f) for f in facets])
    middles = np.round(segments.mean(axis=1), 9)
    _, first = np.unique(middles, axis=0, return_index=True)
    return Surface(tuple(facets), segments[first])


def revolved(
    lower: Array, axis: Array, radius: float, length: float, size: Callable[[Array], Array]
) -> Surface:
    """A capsule (or, with no length, a sphere) as planar quadrilaterals.

    ``lower`` is the centre of the lower cap. ``size`` gives the wanted panel size [m] at points of
    the surface, (n, 3) -> (n,). Corners lie outside the round surface by as much as makes the
    panels' mean distance right: h² / 12 R for each curved direction.
    """
    down = -np.array([0.0, 0.0, 1.0]) + axis[2] * axis
    u = down / np.linalg.norm(down) if np.linalg.norm(down) > 1e-9 else np.array([1.0, 0.0, 0.0])
    v = np.cross(axis, u)
    quarter = radius * math.pi / 2
    total = 2 * quarter + length

    def meridian(s: Array) -> tuple[Array, Array]:
        """Distance along and from the axis at an arc length from the lower pole."""
        inside = np.clip(s - quarter, 0.0, length)
        psi = (s - inside) / radius
        return inside - radius * np.cos(psi), radius * np.sin(psi)

    def place(s: Array, theta: Array, extra: Array | float = 0.0) -> Array:
        along, out = meridian(s)
        ring = np.cos(theta)[..., None] * u + np.sin(theta)[..., None] * v
        base = np.clip(along, 0.0, length)
        normal = ((along - base)[..., None] * axis + out[..., None] * ring) / radius
        return lower + base[..., None] * axis + normal * (radius + np.asarray(extra)[..., None])

    fine = np.linspace(0.0, total, 4001)
    stops = _graded(fine, size(place(fine, np.zeros_like(fine))), (quarter, quarter + length))
    turn = np.linspace(-math.pi, math.pi, 2001)
    ring_size = np.min([size(place(np.full_like(turn, s), turn)) for s in stops], axis=0)
    angles = _graded(turn, ring_size / radius, (0.0,))[:-1]

    ds, da = np.diff(stops), np.diff(np.append(angles, angles[0] + 2 * math.pi))
    curved = np.diff(np.clip(stops, quarter, quarter + length)) < 1e-9
    ds2 = np.where(curved, ds, 0.0) ** 2
    mean_s = np.concatenate([[ds2[0]], (ds2[1:] + ds2[:-1]) / 2, [ds2[-1]]])
    mean_a = (da**2 + np.roll(da, 1) ** 2) / 2
    _, out = meridian(stops)
    extra = (mean_s[:, None] + (out[:, None] ** 2) * mean_a[None]) / (12 * radius)
    grid = place(*np.meshgrid(stops, angles, indexing="ij"), extra)
    grid[0], grid[-1] = grid[0].mean(axis=0), grid[-1].mean(axis=0)
    facets = []
    for i in range(len(stops) - 1):
        for j in range(len(angles)):
            k = (j + 1) % len(angles)
            corners = [grid[i, j], grid[i, k], grid[i + 1, k], grid[i + 1, j]]
            if i == 0:
                del corners[0]
            elif i == len(stops) - 2:
                del corners[2]
            facets.append(_facet(np.array(corners)))
    return Surface(tuple(facets), np.zeros((0, 2, 3)))


def _graded(t: Array, size: Array, stops: tuple[float, ...]) -> Array:
    """Split t[0]…t[-1] into steps of about ``size``, with nodes at ``stops``."""
    edges = [t[0], *stops, t[-1]]
    rate = 1.0 / size
    count = np.concatenate([[0.0], np.cumsum(np.diff(t) * (rate[1:] + rate[:-1]) / 2)])
    out = [t[0]]
    for a, b in pairwise(edges):
        if b - a < 1e-12:
            continue
        ca, cb = np.interp([a, b], t, count)
        n = max(2, math.ceil(cb - ca))
        out += [*np.interp(ca + (cb - ca) * np.arange(1, n) / n, count, t), b]
    return np.array(out)


def _facet(corners: Array) -> Facet:
    """A planar polygon through corners [m]; those of a quadrilateral are flattened into a plane."""
    origin = corners.mean(axis=0)
    _, _, axes = np.linalg.svd(corners - origin)
    if np.linalg.det(axes) < 0:
        axes[2] *= -1
    uv = (corners - origin) @ axes[:2].T
    return Facet(shapely.geometry.polygon.orient(shapely.Polygon(uv)), origin, axes)


def capsule(gap: float, scale: float) -> Surface:
    """The limb-like capsule with its lowest point ``gap`` [m] above the electrode plane."""
    lower = np.array([*LOWEST, gap + RADIUS])

    def size(points: Array) -> Array:
        return scale * np.clip(0.2 * points[..., 2], 0.0015, 0.005)

    return revolved(lower, AXIS, RADIUS, LENGTH, size)


def sphere(center: Array, radius: float, scale: float) -> Surface:
    """A sphere; panels a twelfth of the radius."""
    return revolved(
        center, np.array([0.0, 0.0, 1.0]), radius, 0.0,
        lambda p: np.full(p.shape[:-1], 0.08 * radius * scale),
    )  # fmt: skip


# -- solution -----------------------------------------------------------------------------------


class Solution:
    """Charges on terminals, walls and an object (or none), panels graded to every rim.

    Electrodes are cut more finely than the package does it: their own error enters ΔC twice.
    """

    def __init__(self, design: Design, scale: float, surface: Surface | None = None) -> None:
        fine = Grading(3e-5 * scale, smallest=0.0012 * scale, largest=0.003 * scale)
        coarse = Grading(0.01, largest=0.04 * scale)
        parts, owners = [], []
        shield = Grading(3e-4 * scale, smallest=0.0025 * scale, largest=0.0035 * scale)
        names = terminals(design)
        self.electrodes = len(design.electrodes)
        sheets = [(f, e.surface.rims, fine, k) for k, e in enumerate(design.electrodes)
                  for f in e.surface.facets]  # fmt: skip
        sheets += [(f, c.surface.rims, shield, names.index(c.name)) for c in design.conductors
                   for f in c.surface.facets]  # fmt: skip
        sheets += [(f, np.zeros((0, 2, 3)), coarse, WALLS) for f in walls(design)]
        if surface is not None:
            grading = Grading(3e-4 * scale, smallest=0.004 * scale, largest=0.006 * scale)
            sheets += [(f, surface.rims, grading, OBJECT) for f in surface.facets]
        for facet, rims, grading, owner in sheets:
            parts.append(make_panels(facet, cut_facet(facet, rims, grading)))
            owners.append(np.full(len(parts[-1]), owner))
        self.panels, self.owner = concatenate(parts), np.concatenate(owners)
        self._floor = float(design.domain.lower[2])
        n = len(self.owner)
        matrix = kernels.system_matrix(
            np.zeros(n, dtype=bool), np.zeros(n), self._floor, self.panels
        )
        unit = np.zeros((n, len(names)))
        driven = self.owner >= 0
        unit[driven, self.owner[driven]] = 1.0
        self.scaled = scipy.linalg.solve(matrix, unit, overwrite_a=True)
        """Charge densities over 4π eps0 [V/m], shape (n, terminals)."""

    def potential(self, points: Array) -> Array:
        """Potentials [V] at points [m], shape (n, 3) -> (n, terminals)."""
        return np.concatenate(
            [
                kernels.potential_matrix(part, self._floor, self.panels) @ self.scaled
                for part in np.array_split(points, 1 + len(points) // 2000)
            ]
        )


def change(empty: Solution, full: Solution) -> Array:
    """ΔC [F] by the object of ``full``, by reciprocity."""
    mine = np.flatnonzero(full.owner == OBJECT)
    weights = full.panels.weights[mine]
    panel, _ = np.nonzero(weights)
    phi = empty.potential(full.panels.quad[mine][weights > 0])
    charge = weights[weights > 0][:, None] * 4 * math.pi * EPS0 * full.scaled[mine][panel]
    delta = (-phi.T @ charge)[: full.electrodes, : full.electrodes]
    return 0.5 * (delta + delta.T)


def converged(
    design: Design, make: Callable[[float], Surface], scales: tuple[float, ...] = SCALES
) -> tuple[Array, Array]:
    """Extrapolated ΔC [F] and its estimated error [F]."""
    results = []
    for scale in scales:
        started = time.perf_counter()
        full = Solution(design, scale, make(scale))
        results.append(change(_empty(design, scale), full))
        print(
            f"  scale {scale}: {len(full.owner)} panels, ΔC_11 {results[-1][0, 0] * 1e12:.7f} pF, "
            f"{time.perf_counter() - started:.0f} s",
            flush=True,
        )
    *_, before, finest = results
    # first order in the panel size beside rims, second elsewhere: the middle is taken
    best = finest + (finest - before) / ((scales[-2] / scales[-1]) ** 1.5 - 1)
    return best, np.abs(best - finest)


_EMPTY: dict[float, Solution] = {}


def _empty(design: Design, scale: float) -> Solution:
    if scale not in _EMPTY:
        _EMPTY[scale] = Solution(design, scale)
    return _EMPTY[scale]


def report(title: str, delta: Array, error: Array, reference: Array | None = None) -> None:
    """Print a case's largest relative figures."""
    diagonal = np.diag(delta)
    line = f"{title}: ΔC_ii {np.round(diagonal * 1e12, 6)} pF"
    line += f"; estimated error {100 * np.max(np.diag(error) / np.abs(diagonal)):.3f} %"
    if reference is not None:
        off = (diagonal / np.diag(reference) - 1) * 100
        largest = np.abs(reference).max()
        line += f"; diagonal against the carried-over figures {np.round(off, 3)} %"
        line += (
            f"; any entry {100 * np.abs(delta - reference).max() / largest:.3f} % of the largest"
        )
    print(line, flush=True)


def check(design: Design) -> None:
    """Re-derive figures that were carried over from elsewhere."""
    table = json.loads(CARRIED.read_text())["six_patch_bare"]
    empty = 1e-12 * np.array(table["none"])
    for gap in (10, 20, 50):
        at, size = np.array([0.0, 0.0, gap / 1e3 + 0.01]), np.array([0.15, 0.15, 0.02])
        best, error = converged(design, lambda s, at=at, size=size: box(at, size))
        report(f"bar {gap}", best, error, 1e-12 * np.array(table[f"bar {gap}"]) - empty)
    best, error = converged(design, lambda s: sphere(np.array([0.0, 0.0, 0.08]), 0.04, s))
    report("sphere", best, error, 1e-12 * np.array(table["sphere grounded 1.0"]) - empty)


def write(design: Design) -> None:
    """Solve the capsule at all gaps and write the file that the tests read."""
    center = np.array([*LOWEST, RADIUS]) + AXIS * LENGTH / 2
    cases = {}
    for gap in GAPS:
        best, error = converged(design, lambda s, gap=gap: capsule(gap / 1e3, s))
        report(f"capsule {gap}", best, error)
        cases[str(gap)] = {
            "delta": np.round(best * 1e12, 8).tolist(),
            "error": np.round(error * 1e12, 8).tolist(),
        }
    text = {
        "about": "Change of the Maxwell matrix by a grounded limb-like capsule over "
        "six_patch_bare; written by benchmarks/references.py",
        "method": __doc__.split("\n\n", 2)[2].strip(),
        "units": "delta and error (estimated) in pF, lengths in m; cases by gap in mm",
        "radius": RADIUS,
        "length": LENGTH,
        "axis": AXIS.round(12).tolist(),
        "center_at_gap_zero": center.round(12).tolist(),
        "cases": cases,
    }
    OUTPUT.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n")
    print("wrote", OUTPUT.relative_to(DATA.parents[1]))


def write_curved(design: Design) -> None:
    """Solve a ball and a limb over the curved design and write the file that the tests read."""
    radius = -float(design.conductors[0].surface.bounds[:, 2].mean())
    up = np.array([math.sin(BALL_ANGLE), 0.0, math.cos(BALL_ANGLE)])
    cases = {}

    def keep(name: str, position: Array, make: Callable[[float], Surface]) -> None:
        best, error = converged(design, make, CURVED_SCALES)
        report(name, best, error)
        cases[name] = {
            "position": position.round(12).tolist(),
            "delta": np.round(best * 1e12, 8).tolist(),
            "error": np.round(error * 1e12, 8).tolist(),
        }

    for gap in BALL_GAPS:
        center = up * (radius + BALL_RADIUS + gap / 1e3) + [0.0, BALL_ALONG, -radius]
        keep(f"ball {gap}", center, lambda s, c=center: sphere(c, BALL_RADIUS, s))
    for gap in LIMB_GAPS:
        center = np.array([0.0, 0.0, RADIUS + gap / 1e3])
        lower = center - LIMB_AXIS * LENGTH / 2

        def limb(scale: float, lower: Array = lower) -> Surface:
            return revolved(
                lower, LIMB_AXIS, RADIUS, LENGTH,
                lambda p: scale * np.clip(0.15 * np.linalg.norm(p, axis=-1), 0.002, 0.008),
            )  # fmt: skip

        keep(f"limb {gap}", center, limb)
    text = {
        "about": "Change of the Maxwell matrix by a grounded ball, or limb, over arm_segment; "
        "written by benchmarks/references.py --curved",
        "method": __doc__.split("\n\n", 2)[2].strip(),
        "units": "delta and error (estimated) in pF, lengths in m; cases by gap in mm",
        "ball_radius": BALL_RADIUS,
        "limb_radius": RADIUS,
        "limb_length": LENGTH,
        "limb_axis": LIMB_AXIS.round(12).tolist(),
        "cases": cases,
    }
    CURVED_OUTPUT.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n")
    print("wrote", CURVED_OUTPUT.relative_to(DATA.parents[1]))


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--check", action="store_true", help="re-derive known figures")
    parser.add_argument("--curved", action="store_true", help="the curved design instead")
    arguments = parser.parse_args()
    if arguments.curved:
        write_curved(cs.load_design("arm_segment"))
        return
    design = cs.load_design("six_patch_bare")
    if arguments.check:
        check(design)
    else:
        write(design)


if __name__ == "__main__":
    main()
