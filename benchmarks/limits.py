"""Where readings are least certain, over ``six_patch_bare``: ``python benchmarks/limits.py``.

- contact: grounded bodies 2 to 0.5 mm above an electrode, each preset, and one with 2,800 panels,
  against boundary elements (``tests/data``). The largest error of the diagonal. Finer panels help
  little more at 0.5 mm: Green's function is fitted from 1.3 mm on.
- wide boxes in parallel with the sensor, from 2 mm on, against 80,000 pieces, and what their
  readings tell of it.
- a forearm and a palm near the sensor, against the same.
- a ball, a limb and a box over the narrow electrodes of ``stripe``, against as many.
- boxes that come down in steps of 0.02 mm: by how much a large entry falls in a step, at most.
- a person's arm whose hand leaves the domain, against the preset fine.
- a figure as one mesh of one skin, against 5,600 panels with their energies.
- dielectrics in depth images of 128 × 128 pixels with front and back, against the shapes.
- sheets of a dielectric as deforming surfaces of 800 triangles, against boxes as thick.
- bodies that reach into the sensor: error estimates over the largest entry.

Errors are the largest of any entry over the largest entry, but where said otherwise.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from step_scenes import PIXELS, WIDE, low

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from field_cases import arm_scenes
from layered_views import view
from one_skin import person as one_skin
from reference_scenes import MORE, diagonal_errors, reference_scenes

import capsense as cs
from capsense.simulator import PresetName
from capsense.solver.surface_solver import Preset, SurfaceSolver
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.shape_cache import in_pieces

DESIGN = "six_patch_bare"
AT = (0.003, 0.026)
"""Over the middle of an electrode's edge [m]."""
NEAR = 0.002
"""Gaps up to this are near contact [m]."""
STEP = 5e-5
"""A step towards the sensor [m]."""
PRESETS: tuple[PresetName, ...] = ("fast", "standard", "fine")
BODIES: dict[str, tuple[cs.Shape, tuple[float, float, float]]] = {
    "ball of 20 mm radius": (cs.Sphere(0.02), (0, 0, 0)),
    "finger": (cs.Capsule(0.008, 0.06), (0.4, 0.6, 0)),
    "box 40 x 40 x 20 mm": (cs.Box((0.04, 0.04, 0.02)), (0, 0, 0)),
    "box, tilted": (cs.Box((0.1, 0.08, 0.05)), (0.3, 0.25, 0.15)),
    "bar 150 x 150 x 20 mm": (cs.Box((0.15, 0.15, 0.02)), (0, 0, 0)),
}
FINER = Preset(panels=2800, threshold=1e-3)
"""Finer than any preset that has a name."""


class InPieces(SurfaceSolver):
    """A solver that takes all bodies for wide ones, on 80,000 pieces."""

    def functions_of(
        self, shape: cs.Shape, conducting: bool, share: float = 1.0
    ) -> tuple[DynamicBody, float]:
        return in_pieces(shape, 80_000, conducting)


def apart(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest difference over the largest entry."""
    return float(np.abs(found - truth).max() / np.abs(truth).max())


def contact(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Errors with each preset."""
    sims = [cs.Simulator(DESIGN, preset=p, background=sim.background) for p in PRESETS]
    finer = SurfaceSolver(sim.background.green, sim.design, preset=FINER)
    for case in (c for c in reference_scenes(MORE) if c.gap <= NEAR):
        found = [s.step(case.scene).delta for s in sims]
        found.append(finer.solve(case.scene).matrix[:6, :6])
        name = case.name
        if case.category == "near plate":
            name += f", {case.scene[0].shape!r}"
        yield name, [float(np.abs(diagonal_errors(f, case.delta)).max()) for f in found]


def wide(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Median and largest difference from many pieces, and the median estimate, each preset.

    Both are of the scene's largest diagonal, for boxes of 0.03 to 0.3 m, parallel to the sensor.
    """
    sims = [cs.Simulator(DESIGN, preset=p, background=sim.background) for p in PRESETS]
    finer = InPieces(sim.background.green, sim.design, preset=FINER)
    random = np.random.default_rng(5)
    sizes = np.round(random.uniform([0.03, 0.03, 0.01], [0.3, 0.3, 0.1], (8, 3)), 2)
    for gap in (0.002, 0.004, 0.008):
        off, told = [], []
        for size in sizes:
            place = (*random.uniform(-0.06, 0.06, 2), gap + size[2] / 2)
            pose = cs.Pose.from_euler(place, (0, 0, random.uniform(0, 3)))
            scene = cs.Scene([cs.Body(cs.Box(tuple(size)), pose)])
            truth = np.diag(finer.solve(scene).matrix)
            readings = [s.step(scene) for s in sims]
            off.append([np.abs(np.diag(r.delta) - truth).max() / truth.max() for r in readings])
            told.append([r.stats.solver_error / truth.max() for r in readings])
        middle, most = np.median(off, axis=0), np.max(off, axis=0)
        table = np.stack([middle, most, np.median(told, axis=0)], axis=1)
        yield f"gap {1e3 * gap:g} mm", table.ravel().tolist()


def limbs(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Largest difference from many pieces, of each preset, at several gaps."""
    finer = InPieces(sim.background.green, sim.design, preset=FINER)
    sims = [cs.Simulator(DESIGN, preset=p, background=sim.background) for p in PRESETS]
    lying = (0.0, np.pi / 2, 0.0)
    for name, shape, half, turn in (
        ("forearm, a capsule of 40 mm radius", cs.Capsule(0.04, 0.25), 0.04, lying),
        ("palm, 80 x 90 x 25 mm", cs.Box((0.08, 0.09, 0.025)), 0.0125, (0.0, 0.0, 0.3)),
    ):
        out = []
        for gap in (0.001, 0.002, 0.005, 0.01):
            pose = cs.Pose.from_euler((0.01, 0.005, half + gap), turn)
            scene = cs.Scene([cs.Body(shape, pose)])
            truth = finer.solve(scene).matrix[:6, :6]
            out += [apart(s.step(scene).delta, truth) for s in sims]
        yield name, out


def narrow(_: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Largest error of the diagonal at gaps of 2, 5, 10 and 30 mm, each preset."""
    sim = cs.Simulator("stripe")
    sims = [cs.Simulator("stripe", preset=p, background=sim.background) for p in PRESETS]
    finer = InPieces(sim.background.green, sim.design, preset=FINER)
    for shape, height, turn in (
        (cs.Sphere(0.05), 0.05, 0.0), (cs.Capsule(0.04, 0.2), 0.04, np.pi / 2),
        (cs.Box((0.14, 0.13, 0.1)), 0.05, 0.0),
    ):  # fmt: skip
        off = []
        for gap in (0.002, 0.005, 0.01, 0.03):
            pose = cs.Pose.from_euler((0.01, 0.0, gap + height), (turn, 0.0, 0.3))
            scene = cs.Scene([cs.Body(shape, pose)])
            truth = np.diag(finer.solve(scene).matrix)
            found = [np.diag(each.step(scene).delta) for each in sims]
            off.append([float(np.abs(f - truth).max() / truth.max()) for f in found])
        for preset, errors in zip(PRESETS, zip(*off, strict=True), strict=True):
            yield f"{shape!r}, {preset}", list(errors)


def falls(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Largest fall in a step from 3 to 1, 1 to 0.3, 0.3 to 0.02 mm, each preset.

    Of entries above a tenth of the scene's largest, relative.
    """
    sims = [cs.Simulator(DESIGN, preset=p, background=sim.background) for p in PRESETS]
    gaps = np.arange(3e-3, 0.0, -2e-5)
    for size in ((0.04, 0.04, 0.02), (0.15, 0.04, 0.02), (0.15, 0.15, 0.02), (0.15, 0.15, 0.01)):
        out = []
        for each in sims:
            scenes = [low(cs.Box(size), gap, (0.004, 0.003)) for gap in gaps]
            read = np.array([np.diag(each.step(cs.Scene([body])).delta) for body in scenes])
            large = (read > 0.1 * read.max(axis=1, keepdims=True))[1:]
            fall = np.where(large, -np.diff(np.log(read), axis=0), 0.0).clip(0.0).max(axis=1)
            out += [
                part.max() for part in np.split(fall, np.searchsorted(-gaps[1:], (-1e-3, -3e-4)))
            ]
        yield "box " + " x ".join(f"{1e3 * s:g}" for s in size) + " mm", out


def growth(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Growth of the largest entry in a step of 0.05 mm, and of the same from many pieces."""
    finer = InPieces(sim.background.green, sim.design, preset=FINER)
    for name, shape, turn in (
        ("ball of 30 mm radius", cs.Sphere(0.03), (0, 0, 0)),
        ("forearm, a capsule of 40 mm radius", cs.Capsule(0.04, 0.25), (0, np.pi / 2, 0)),
    ):
        out = []
        for gap in (0.005, 0.002, 0.001, 0.0005):
            scenes = [cs.Scene([low(shape, g, AT, turn)]) for g in (gap, gap - STEP)]
            for solve in (lambda scene: sim.step(scene).delta, lambda s: finer.solve(s).matrix):
                before, after = (np.diag(solve(scene))[:6] for scene in scenes)
                out.append(float(np.log(after / before)[before.argmax()]))
        yield name, out


def images(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Errors of depth images of dielectrics at 5, 10, 20, 50 mm."""
    for name, shape in (("ball", cs.Sphere(0.03)), ("box", cs.Box((0.08, 0.06, 0.04)))):
        for eps in (3.0, 10.0, 80.0):
            material, out = cs.Material("dielectric", eps_r=eps), []
            for gap in (0.005, 0.01, 0.02, 0.05):
                body = cs.Body(shape, low(shape, gap, AT).pose, material, "floating")
                front, back = view(shape, body.pose, 2 * PIXELS, WIDE)
                seen = sim.step(cs.DepthFrame(front, eps_r=material, back=back)).delta
                out.append(apart(seen, sim.step(cs.Scene([body])).delta))
            yield f"{name}, eps_r {eps:g}", out


def inside(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Error estimates over the largest entry, lowest points at 1, 0, -1, -5 mm."""
    for name, (shape, turn) in BODIES.items():
        out = []
        for gap in (0.001, 0.0, -0.001, -0.005):
            reading = sim.step(cs.Scene([low(shape, gap, AT, turn)]))
            out.append(reading.stats.solver_error / float(np.abs(reading.delta).max()))
        yield name, out


def person(sim: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Root of the mean square and largest error of the diagonal against the preset fine.

    An arm of ten capsules with its forearm along x, in three places; the hand leaves the domain.
    """
    *sims, fine = (cs.Simulator(DESIGN, preset=p, background=sim.background) for p in PRESETS)
    for gap in (0.01, 0.03, 0.1):
        off = []
        for scene in arm_scenes(gap):
            truth = fine.step(scene).delta
            off.append([diagonal_errors(s.step(scene).delta, truth) for s in sims])
        rms = np.sqrt(np.mean(np.square(off), axis=(0, 2)))
        worst = np.abs(off).max(axis=(0, 2))
        yield f"gap {1e3 * gap:g} mm", np.stack([rms, worst], axis=1).ravel().tolist()


def skin(_: cs.Simulator) -> Iterator[tuple[str, list[float]]]:
    """Largest difference from many panels, each preset; the fingertips' gap."""
    sim = cs.Simulator("six_patch")
    many = Preset(panels=3500, threshold=1e-3, coarsest=None)
    truth = SurfaceSolver(sim.background.green, sim.design, preset=many)
    sims = [cs.Simulator("six_patch", preset=p, background=sim.background) for p in PRESETS]
    for height in (-0.012, 0.0, 0.02, 0.05, 0.1):
        scene = one_skin(at=(0.005, 0.003, height))
        wanted = truth.solve(scene).matrix
        off = [np.abs(s.step(scene).delta - wanted).max() / wanted.max() for s in sims]
        yield f"gap {21 + 1e3 * height:g} mm", list(map(float, off))


PARTS = {
    "contact, presets fast, standard, fine, and 2,800 panels": contact,
    "near limbs: gaps of 1, 2, 5, 10 mm, each preset": limbs,
    "wide boxes: median and largest error, and median estimate, of each preset": wide,
    "narrow electrodes: gaps of 2, 5, 10, 30 mm": narrow,
    "falls in a step: 3 to 1, 1 to 0.3, 0.3 to 0.02 mm, of each preset": falls,
    "growth in a step of 0.05 mm at 5, 2, 1, 0.5 mm, standard and many pieces": growth,
    "a person's arm: rms and largest error, presets fast and standard": person,
    "a figure of one skin: presets fast, standard, fine": skin,
    "depth images of dielectrics, gaps of 5, 10, 20, 50 mm": images,
    "in the sensor: error estimate with lowest points at 1, 0, -1, -5 mm": inside,
}


def main() -> None:
    """Print the tables, in per cent."""
    sim = cs.Simulator(DESIGN)
    for title, part in PARTS.items():
        print(f"\n{title}, %")
        for name, errors in part(sim):
            print(f"  {name:54s}" + "".join(f"{100 * e:8.2f}" for e in errors), flush=True)


if __name__ == "__main__":
    main()
