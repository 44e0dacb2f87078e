"""Converged reference capacitances of objects in front of a sensor, by boundary elements.

    python benchmarks/references.py            # write the capsule's figures
    python benchmarks/references.py --check    # re-derive figures carried over from elsewhere

The object enters a design as one more grounded conductor. Its effect follows from reciprocity,

    ΔC_ij = −∮ φ⁰_i σ_j dS,

with φ⁰_i the empty domain's potential at 1 V on electrode i and σ_j the charge density on the
object at 1 V on electrode j: no difference of two large numbers is taken. Every case is solved at
several panel densities and extrapolated; what the extrapolation adds is the error estimate.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

import capsense as cs
from capsense.design.geometry import Facet, Surface, boundary_segments
from capsense.design.model import Conductor, Design, Role
from capsense.field.boundary import GROUND, Accuracy, BoundarySolution

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[1] / "tests" / "data"
CARRIED = DATA / "reference_capacitances.json"
OUTPUT = DATA / "reference_capsule.json"

SCALES = (1.4, 1.0, 0.7)
"""Panel sizes, as multiples of the solver's default."""
GAPS = (5, 10, 20, 50, 100)
"""Gaps [mm] between the capsule's lowest point and the electrode plane."""
RADIUS, LENGTH = 0.040, 0.200
"""The capsule [m]; its length is without the caps."""
AZIMUTH, TILT = math.radians(30.0), math.radians(12.0)
"""Direction of its axis: in the plane from x towards y, and upward."""
LOWEST = np.array([-0.045, -0.045 * math.tan(AZIMUTH)])
"""Where in the plane [m] the lowest point lies: over E1; the axis passes over the origin."""

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
        return scale * np.clip(0.3 * points[..., 2], 0.002, 0.007)

    return revolved(lower, AXIS, RADIUS, LENGTH, size)


def sphere(center: Array, radius: float, scale: float) -> Surface:
    """A sphere; panels a tenth of the radius."""
    return revolved(
        center, np.array([0.0, 0.0, 1.0]), radius, 0.0,
        lambda p: np.full(p.shape[:-1], 0.1 * radius * scale),
    )  # fmt: skip


# -- solution -----------------------------------------------------------------------------------


def change(
    design: Design, empty: BoundarySolution, surface: Surface, scale: float
) -> tuple[Array, int]:
    """ΔC [F] by a grounded object, and the number of panels."""
    name = "object"
    conductors = (*design.conductors, Conductor(name, Role.GROUND, surface))
    full = BoundarySolution(dataclasses.replace(design, conductors=conductors), Accuracy(scale))
    panels = full.model.panels
    lower, upper = surface.bounds
    inside = ((panels.centers > lower - 1e-6) & (panels.centers < upper + 1e-6)).all(axis=1)
    mine = np.flatnonzero(inside & (full.model.owner == GROUND))
    unit = np.eye(full.model.n_terminals)
    sigma = full.densities(unit)[mine]
    weights = panels.weights[mine]
    points = panels.quad[mine][weights > 0]
    phi = empty.potential(points, empty.densities(unit))
    panel_of = np.nonzero(weights > 0)[0]
    charge = weights[weights > 0][:, None] * sigma[panel_of]
    delta = -phi.T @ charge
    return 0.5 * (delta + delta.T), len(panels)


def converged(
    design: Design, make: Callable[[float], Surface], say: Callable[[str], None]
) -> tuple[Array, Array, list[Array]]:
    """Extrapolated ΔC [F], its estimated error [F], and the results at the panel densities."""
    results = []
    for scale in SCALES:
        started = time.perf_counter()
        delta, n = change(design, _empty(design, scale), make(scale), scale)
        results.append(delta)
        say(f"  scale {scale}: {n} panels, ΔC_11 {delta[0, 0] * 1e12:.7f} pF, "
            f"{time.perf_counter() - started:.0f} s")  # fmt: skip
    *_, before, finest = results
    # first order in the panel size at worst, second at best: the middle is taken
    best = finest + (finest - before) / ((SCALES[-2] / SCALES[-1]) ** 1.5 - 1)
    return best, np.abs(best - finest), results


_EMPTY: dict[float, BoundarySolution] = {}


def _empty(design: Design, scale: float) -> BoundarySolution:
    if scale not in _EMPTY:
        _EMPTY[scale] = BoundarySolution(design, Accuracy(scale))
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
        best, error, _ = converged(design, lambda s, at=at, size=size: box(at, size), print)
        report(f"bar {gap}", best, error, 1e-12 * np.array(table[f"bar {gap}"]) - empty)
    best, error, _ = converged(design, lambda s: sphere(np.array([0.0, 0.0, 0.08]), 0.04, s), print)
    report("sphere", best, error, 1e-12 * np.array(table["sphere grounded 1.0"]) - empty)


def write(design: Design) -> None:
    """Solve the capsule at all gaps and write the file that the tests read."""
    center = np.array([*LOWEST, RADIUS]) + AXIS * LENGTH / 2
    cases = {}
    for gap in GAPS:
        best, error, _ = converged(design, lambda s, gap=gap: capsule(gap / 1e3, s), print)
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


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--check", action="store_true", help="re-derive known figures")
    arguments = parser.parse_args()
    design = cs.load_design("six_patch_bare")
    if arguments.check:
        check(design)
    else:
        write(design)


if __name__ == "__main__":
    main()
