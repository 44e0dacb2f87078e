"""CapSense and boundary elements of others at three scenes: time and error of a step.

    pip install ".[peers]"
    python benchmarks/peers_bem.py [--presets standard] [--peers fastcap] [-o out/peers_bem.json]

Scenes over ``six_patch_bare``: the grounded bar at 20 mm, a finger and a limb of
``tests/data/reference_map.json`` at 10 mm. The task is a step: a body at a new pose in, the 6 × 6
change of the Maxwell matrix out. One core; times are the processor's, medians. Errors are those of
the diagonal of ΔC against references good to 0.3 %.

- "fastcap": FastCap2 (multipole boundary elements), electrodes, walls and body at once, as it has
  to; the empty scene is solved beforehand. ΔC is a difference of two solutions on like meshes.
- "object only": what one would write with NumPy and SciPy: charges on the body alone, in the
  design's own field. Triangles' centroids, 1/r between them, a disc's mean on the diagonal; the
  potentials of the empty domain from a table (cubic, 4 mm), the floor by images. It leaves out that
  the sensor answers the body's charge.
- "object and sensor": the same, with that answer, from the sensor's factorised matrix.

Meshes are made once in the body's frame; that is not timed for anyone. A peer that is not installed
is left out, and the table says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from bem_reference import FARADS, Sensor, box_panels, revolved
from machine import Times, describe_machine, on_one_core
from numpy.typing import NDArray
from reference_more import profile
from scipy.ndimage import map_coordinates, spline_filter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from field_cases import bar, delta_reference
from reference_scenes import DESIGN, diagonal_errors, reference_scenes

import capsense as cs

try:
    import fastcap2
except ImportError:
    fastcap2 = None

Array = NDArray[np.float64]
STEPS = 5
PEERS = ("plain", "fastcap")
"""Those in NumPy and SciPy, and FastCap2."""
CELLS = (0.7, 0.5, 0.35)
"""Panel sizes of the peers, over a body's smaller half width."""
TABLE_STEP = 4e-3
TOLERANCE = 1e-4
"""Of FastCap's iterations; with its default, 1e-2, ΔC drowns in what they leave."""
NUDGE = 1e-4


def scenes() -> dict[str, tuple[cs.Body, Array]]:
    """Body and reference ΔC [F]."""
    known = {c.name: c for c in reference_scenes()}
    out = {"bar 20 mm": (bar(0.020), delta_reference(DESIGN, "bar 20"))}
    for name, title in (("finger grounded 10 mm", "finger 10 mm"),
                        ("limb grounded 10 mm", "limb 10 mm")):  # fmt: skip
        out[title] = (known[name].scene.bodies[0], known[name].delta)
    return out


def surface(body: cs.Body, cell: float) -> Array:
    """Corners of a body's panels in its frame, (n, 4, 3)."""
    shape = body.shape
    if isinstance(shape, cs.Box):
        half = np.array(shape.size) / 2
        size = 1.5 * cell * half.min() + 0.004
        return box_panels(half, lambda x: np.full(len(x), size), 4 / cell)
    assert isinstance(shape, cs.Capsule)
    outline, corners = profile("capsule", [shape.radius, shape.length])
    stops = np.array([0, *corners, np.pi * shape.radius + shape.length])
    return revolved(outline, stops, lambda x: np.full(len(x), cell * shape.radius))[0]


# -- the plain solver -----------------------------------------------------------------------------


class Plain:
    """Point collocation on the body's triangles, in NumPy and SciPy."""

    def __init__(self, design: cs.Design) -> None:
        sensor = Sensor(design, 1.4)
        self.floor = sensor.floor
        self.points = sensor.panels.center + np.array([0, 0, self.floor])
        self.areas = sensor.panels.area
        self.factor = sensor.factor
        self.density = scipy.linalg.solve_triangular(
            sensor.factor, sensor.half_way, lower=True, trans="T"
        )
        self.low = np.array([-0.2, -0.2, 0.0])
        count = np.round((np.array([0.2, 0.2, 0.25]) - self.low) / TABLE_STEP).astype(int) + 1
        axes = [a + TABLE_STEP * np.arange(n) for a, n in zip(self.low, count, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = np.concatenate(
            [self._sensor_potential(part) @ self.density for part in np.array_split(grid, 600)]
        )
        tables = values.reshape(*count, -1)
        self.tables = [spline_filter(tables[..., k]) for k in range(tables.shape[-1])]

    def _kernel(self, a: Array, b: Array) -> Array:
        """1/r less the image in the floor."""
        flat = ((a[:, None, :2] - b[None, :, :2]) ** 2).sum(axis=2)
        up = a[:, 2, None] - b[None, :, 2]
        down = a[:, 2, None] + b[None, :, 2] - 2 * self.floor
        with np.errstate(divide="ignore"):
            return 1 / np.sqrt(flat + up**2) - 1 / np.sqrt(flat + down**2)

    def _sensor_potential(self, points: Array) -> Array:
        """Of unit densities on the sensor's panels."""
        return self._kernel(points, self.points) * self.areas

    def mesh(self, body: cs.Body, cell: float) -> tuple[Array, Array]:
        """Centroids and areas in the body's frame."""
        corners = surface(body, cell)
        triangles = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0],
                                       triangles[:, 2] - triangles[:, 0]), axis=1) / 2  # fmt: skip
        real = area > 1e-3 * area.mean()
        return triangles[real].mean(axis=1), area[real]

    def step(self, mesh: tuple[Array, Array], pose: cs.Pose, with_sensor: bool) -> Array:
        """ΔC [F]."""
        centers, area = pose.apply(mesh[0]), mesh[1]
        matrix = self._kernel(centers, centers)
        image = 1 / (2 * (centers[:, 2] - self.floor))
        np.fill_diagonal(matrix, 16 / (3 * np.pi) * np.sqrt(np.pi / area) - image)
        where = ((centers - self.low) / TABLE_STEP).T
        phi = np.stack([map_coordinates(t, where, prefilter=False) for t in self.tables], axis=1)
        if with_sensor:
            across = self._sensor_potential(centers)  # a panel's mean times its area
            half = scipy.linalg.solve_triangular(self.factor, across.T, lower=True)
            matrix -= half.T @ half
        return FARADS * phi.T @ scipy.linalg.solve(matrix, phi, assume_a="pos")


# -- FastCap --------------------------------------------------------------------------------------


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps FastCap's warnings, written past Python, off the table."""
    sys.stdout.flush()
    kept = [os.dup(n) for n in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        try:
            for n in (1, 2):
                os.dup2(nowhere.fileno(), n)
            yield
        finally:
            for n, old in zip((1, 2), kept, strict=True):
                os.dup2(old, n)
                os.close(old)


class FastCap:
    """The whole scene in FastCap2; the sensor's mesh is that of the references, coarser."""

    def __init__(self, design: cs.Design, scale: float) -> None:
        self.electrodes = len(design.electrodes)
        self.sensor: list[tuple[str, Array]] = []
        sensor = Sensor(design, scale)
        corners = sensor.panels.corners + np.array([0, 0, sensor.floor])
        rest = corners
        for k, electrode in enumerate(design.electrodes):
            low, high = electrode.surface.bounds
            middle = rest.mean(axis=1)
            inside = ((middle > low - 1e-6) & (middle < high + 1e-6)).all(axis=1)
            self.sensor.append((f"E{k + 1}", rest[inside]))
            rest = rest[~inside]
        low, high = design.domain.lower, design.domain.upper
        lines = np.linspace(-1, 1, 24)
        x, y = (np.sign(lines) * np.abs(lines) ** 1.3 * high[k] for k in (0, 1))
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        floor = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=2)
        floor = np.concatenate([floor, np.full((*floor.shape[:3], 1), low[2])], axis=3)
        self.sensor.append(("walls", np.concatenate([rest, floor.reshape(-1, 4, 3)])))
        self.empty = self._solve([])
        self.panels = sum(len(c) for _, c in self.sensor)

    def _solve(self, bodies: list[Array]) -> Array:
        problem = fastcap2.Problem(title="scene")
        problem.iter_tol = TOLERANCE
        problem.skip_conductors = ["walls", "body"] if bodies else ["walls"]
        for name, corners in [*self.sensor, *(("body", b) for b in bodies)]:
            sheet = fastcap2.Surface(name=name)
            for quad in corners:
                a, b, c, d = (tuple(map(float, p)) for p in quad)
                if np.allclose(a, b):
                    sheet._add_tri(b, c, d)  # add_tri of 2.1 calls the wrong one
                elif np.allclose(c, d):
                    sheet._add_tri(a, b, c)
                else:
                    sheet.add_quad(a, b, c, d)
            problem.add(sheet)
        with quiet():
            matrix = np.array(problem.solve())
        names = [n.split("%")[0] for n in problem.conductors()]
        order = [names.index(f"E{k + 1}") for k in range(self.electrodes)]
        out = matrix[np.ix_(order, order)]
        return (out + out.T) / 2

    def step(self, corners: Array, pose: cs.Pose) -> Array:
        """ΔC [F]."""
        moved = pose.apply(corners.reshape(-1, 3)).reshape(corners.shape)
        return self._solve([moved]) - self.empty


# -- the comparison -------------------------------------------------------------------------------


def timed(step: Callable[[cs.Pose], Array], body: cs.Body, steps: int) -> tuple[Array, float]:
    """ΔC at the body's pose, and the median processor time [ms] of steps beside it."""
    delta = step(body.pose)
    times = Times()
    (x, y, z), turn = body.pose.position, body.pose.quaternion
    for k in range(steps):
        pose = cs.Pose((x + NUDGE * (k + 1), y, z), turn)
        times.take(lambda pose=pose: step(pose))
    return delta, float(np.median(times.processor))


def runs(presets: list[str], peers: list[str]) -> Any:
    """Label, stepper-maker and steps of everything that takes part, one by one."""
    for preset in presets:
        sim = cs.Simulator(DESIGN, preset=preset)  # type: ignore[arg-type]

        def ours(body: cs.Body, sim: cs.Simulator = sim) -> Callable[[cs.Pose], Array]:
            for _ in range(2):  # compiles
                sim.step(cs.Scene([body]))
            sim.reset()
            return lambda pose: sim.step(cs.Scene([body.moved(pose)])).delta

        yield f"capsense, {preset}", ours, 30
    design = cs.load_design(DESIGN)
    plain = Plain(design) if "plain" in peers else None
    for with_sensor, label in ((False, "object only"), (True, "object and sensor")):
        for cell in CELLS if plain else ():

            def theirs(body: cs.Body, answered: bool = with_sensor, cell: float = cell) -> Any:
                assert plain
                mesh = plain.mesh(body, cell)
                return lambda pose: plain.step(mesh, pose, answered)

            yield f"{label}, cells of {cell:g}", theirs, STEPS
    if "fastcap" not in peers:
        return
    if fastcap2 is None:
        print("fastcap: not installed")
        return
    for scale, cell in ((2.0, 0.5), (1.4, 0.35)):
        fastcap = FastCap(design, scale)

        def whole(body: cs.Body, fastcap: FastCap = fastcap, cell: float = cell) -> Any:
            corners = surface(body, cell)
            return lambda pose: fastcap.step(corners, pose)

        yield f"fastcap, {fastcap.panels} + cells of {cell:g}", whole, 1


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", default=["fast", "standard", "fine"])
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="figures as JSON")
    args = parser.parse_args()
    on_one_core()
    machine = describe_machine(("capsense", "numpy", "scipy", "numba", "FastCap2"))
    print(f"{machine['processor']}, one core, load {machine['load']:.1f}")
    worlds = scenes()
    print(f"{'':34s}" + "".join(f"{name:^30s}" for name in worlds))
    print(f"{'':34s}" + f"{'ms':>10s} {'rms %':>9s} {'worst %':>9s}" * len(worlds))
    rows = []
    for label, maker, steps in runs(args.presets, args.peers):
        cells = []
        for name, (body, truth) in worlds.items():
            delta, ms = timed(maker(body), body, steps)
            off = 100 * diagonal_errors(delta, truth)
            worst = off[np.abs(off).argmax()]
            rows.append({"label": label, "scene": name, "ms": ms, "worst": worst,
                         "rms": float(np.sqrt((off**2).mean()))})  # fmt: skip
            cells.append(f"{ms:10.2f} {rows[-1]['rms']:9.2f} {worst:+9.2f}")
        print(f"{label:34s}" + "".join(cells), flush=True)
    if args.output:
        args.output.parent.mkdir(parents=True, exist_ok=True)
        args.output.write_text(json.dumps({**machine, "results": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
