"""Results that must stay as they are: seeded scenes, designs, chips, and what they give.

``python tests/helpers/kept_cases.py`` writes ``tests/data/kept_results.json`` anew. Do so where a
change of results is wanted, and say in the CHANGELOG what changes by how much: the file's
difference shows it. Other tests tell whether results are right; this file tells that they changed.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from field_cases import COARSE, patches, rectangle
from numpy.typing import ArrayLike
from random_scenes import KINDS, random_body, random_pose, random_scene, random_shape, wedge
from tiny_field import few_sources, tiny_data

import capsense as cs
from capsense.design import parse_design
from capsense.field.background import BuildSettings, build_background
from capsense.field.boundary import Accuracy, BoundarySolution, terminals
from capsense.humans import Build, arm

FILE = Path(__file__).parents[1] / "data" / "kept_results.json"
SLACK = {"delta": 3e-4, "conductance": 3e-4, "jacobian": 5e-3, "error": 1e-2}
"""How far results may be off, of the largest number of an array, where it is not 1e-5. Near parts
are summed in single precision, and processors round differently: some random scenes then read up
to 1.2e-4 differently, the estimate of the error by 1.5e-3."""
Results = dict[str, Any]
Make = Callable[..., cs.Simulator]
Array = np.ndarray

SENSORS = (
    ("six_patch", "standard", 250e3),
    ("stripe", "standard", 1e6),
    ("arm_segment", "standard", 250e3),
    ("meander", "learning", 250e3),
    ("patch", "learning", 30e3),
    ("six_patch_bare", "fine", 250e3),
)


def rounded(values: ArrayLike) -> list[float]:
    """Flat, with nine digits; of a symmetric matrix the lower triangle."""
    x = np.asarray(values, dtype=float)
    if x.ndim == 2 and x.shape[0] == x.shape[1] > 1:
        x = x[np.tril_indices(len(x))]
    return [float(f"{v:.9g}") for v in x.ravel()]


def _changes(sim: cs.Simulator, scenes: list[Any], *, slopes: bool = False) -> Results:
    """What a simulator reads of each scene, from rest."""
    out: Results = {}
    for k, scene in enumerate(scenes):
        sim.reset()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that an electrode lies in a body
            reading = sim.step(scene, jacobian=True) if slopes else sim.step(scene)
        row: dict[str, ArrayLike] = {"error": reading.stats.solver_error}
        if not reading.in_contact:
            row["delta"] = reading.delta
        if reading.conductance is not None:
            row["conductance"] = reading.conductance
        if reading.jacobian is not None:
            row["jacobian"] = reading.jacobian
        out[str(k)] = {name: rounded(values) for name, values in row.items()}
    return out


def readings(make: Make, design: str, preset: str, frequency: float) -> Results:
    """Readings of random scenes."""
    sim = make(design, preset=preset, excitation_frequency=frequency)
    rng = np.random.default_rng(sum(map(ord, design)))
    return _changes(sim, [random_scene(rng) for _ in range(5 if preset == "fine" else 30)])


def slopes(make: Make) -> Results:
    """Readings with their Jacobians, of scenes in front of the sensor."""
    rng = np.random.default_rng(5)
    scenes = [
        cs.Scene([random_body(rng, ("space", "near")) for _ in range(1 + k % 2)]) for k in range(10)
    ]
    return _changes(make("six_patch"), scenes, slopes=True)


def _waves(n: int = 12) -> tuple[Array, Array]:
    """Vertices and triangles of a wavy sheet."""
    u, v = np.meshgrid(np.linspace(-0.06, 0.06, n), np.linspace(-0.05, 0.05, n), indexing="ij")
    points = np.stack([u, v, 0.03 + 0.008 * np.sin(60 * u) * np.cos(40 * v)], axis=-1)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel(), k[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return points.reshape(-1, 3), faces


def surfaces(make: Make) -> Results:
    """Meshes, cloth, clouds and depth frames."""
    points, faces = _waves()
    cloud = points + np.random.default_rng(6).normal(scale=1e-3, size=points.shape)
    frames = np.random.default_rng(2).uniform(0.05, 0.2, (2, 16, 16))
    frames[0, :5] = np.nan
    eps = np.where(frames > 0.12, np.inf, 4.0)
    turned = cs.Pose.from_euler((0.01, -0.02, 0.05), (20, 35, 50), degrees=True)
    camera = cs.OrthographicCamera()
    cloth = cs.Material("cloth", 2.5)
    scenes: list[Any] = [
        cs.Scene([cs.DeformableSurface(points, faces, material=m, grounding=g, thickness=t).body()])
        for m, g, t in (("steel", "grounded", 1e-3), ("steel", "floating", 1e-3),
                        (cloth, "floating", 5e-4), ("human", 2e-12, 1e-3))
    ]  # fmt: skip
    scenes += [
        cs.Scene([cs.Body(wedge(), turned, material)]) for material in ("steel", "human", "pla")
    ]
    scenes += [cs.Scene([cs.Body(cs.point_surface(cloud[::2]), material="steel")])]
    scenes += [
        cs.DepthFrame(frames, eps, camera, back=0.01),
        cs.DepthFrame(frames, eps, camera, grounding="floating"),
        cs.DepthFrame(frames[0], "human", camera),
    ]
    return _changes(make("six_patch"), scenes)


def masked(make: Make) -> Results:
    """The paper's scheme."""
    rng = np.random.default_rng(8)
    sim = make("patch", method="fem_masked", settings=COARSE)
    scenes = []
    for k in range(4):
        size = 0.06 - 0.005 * k
        material, grounding = (("steel", "grounded"), ("steel", "floating"), ("pla", "floating"))[
            k % 3
        ]
        shape = random_shape(rng, KINDS[k], size)
        scenes.append(
            cs.Scene([cs.Body(shape, random_pose(rng, "space", size), material, grounding)])
        )
    return _changes(sim, scenes)


def potentials(make: Make) -> Results:
    """Potentials around a bar and a floating ball."""
    sim = make("six_patch")
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.05, 0, 0.1)), "steel", "floating")
    bar = cs.Body(cs.Box((0.1, 0.02, 0.02)), cs.Pose((0, 0.02, 0.04)), "steel")
    reading = sim.step(cs.Scene([bar, ball]), keep_field=True)
    at = np.random.default_rng(4).uniform((-0.1, -0.1, 0.005), (0.1, 0.1, 0.2), (30, 3))
    return {"all": {"potentials": rounded(reading.potentials(at))}}


def _designs() -> dict[str, Any]:
    """Small designs with what a design may have."""
    board = {"name": "board", "eps_r": 4.3, "size": [0.07, 0.05], "z": [-0.0016, 0.0]}
    cover = {"name": "cover", "eps_r": 3.0, "shape": "cylinder", "radius": 0.012, "length": 0.003,
             "center": [0.0, 0.0, 0.012], "tilt": [20, 10, 0]}  # fmt: skip
    ring = {"name": "ring", "role": "shield", "shape": "ring", "inner_radius": 0.011,
            "outer_radius": 0.013, "center": [0.015, 0.0]}  # fmt: skip
    plate = {"name": "plate", "role": "shield", "shape": "rectangle", "size": [0.06, 0.04],
             "z": -0.0016}  # fmt: skip
    strip = {"name": "strip", "role": "floating", "shape": "rectangle", "size": [0.008, 0.04],
             "center": [-0.035, 0.0]}  # fmt: skip
    pour = {"name": "pour", "role": "ground", "shape": "rectangle", "size": [0.064, 0.044],
            "clearance": 0.001}  # fmt: skip
    return {
        "bare": tiny_data(),
        "open": tiny_data(domain={"size": [0.1, 0.1, 0.1], "backplane": 0.01, "open": True}),
        "board": tiny_data(layer=[board], conductor=[pour]),
        "guarded": tiny_data(layer=[board], conductor=[ring, plate]),
        "floating": tiny_data(conductor=[strip]),
        "part": tiny_data(layer=[cover]),
        "bent": tiny_data(bend={"radius": 0.05}),
    }


def fields(_make: Make) -> Results:
    """Matrices of empty domains, and Green's functions of few sources at random points."""
    rng = np.random.default_rng(3)
    large = patches(rectangle((0, 0), (0.1, 0.2)), rectangle((0.2, 0), (0.1, 0.2)), size=0.8)
    out: Results = {}
    for name, design in (
        {n: parse_design(d) for n, d in _designs().items()} | {"large": large}
    ).items():
        solution = BoundarySolution(design, Accuracy(3.0, fitted=False))
        charges = solution.terminal_charges(solution.densities(np.eye(len(terminals(design)))))
        out[name] = {"capacitance": rounded(charges)}
        if name in ("bare", "guarded", "open"):
            with few_sources():
                green = build_background(design, BuildSettings(panel_scale=6.0)).green
            p, q = rng.uniform((-0.04, -0.04, 0.005), (0.04, 0.04, 0.08), (2, 12, 3))
            out[name] |= {"phi0": rounded(green.phi0(p)), "g": rounded(green.g(p, q))}
    return out


def counts(make: Make) -> Results:
    """What each chip reports of a limb that comes and goes within two seconds."""
    out: Results = {}
    sim = make("six_patch")
    for chip in cs.available_chips():
        sim.use_readout(chip)
        sim.reset(seed=7)
        found = []
        for k in range(20):
            ball = cs.Body(cs.Sphere(0.03), cs.Pose((0.0, 0.01 * k - 0.1, 0.05)), "human")
            found.append(sim.step(cs.Scene([ball]), time=0.1 * k).counts)
        got = found[-1].held()
        few = found[7][:8]
        out[chip] = {
            "code": rounded(got.code), "capacitance": rounded(got.capacitance),
            "early": rounded(few.code), "flags": rounded(few.flags), "time": rounded(few.time),
        }  # fmt: skip
    sim.use_readout(None)
    return out


def outlines(_make: Make) -> Results:
    """Areas, middles and rims of the packaged designs' conductors, people's parts."""
    out: Results = {}
    for name in cs.available_designs():
        design = cs.load_design(name)
        row = {}
        for part in (*design.electrodes, *design.conductors):
            surface = part.surface
            area = np.array([f.polygon.area for f in surface.facets])
            rims = surface.rims.reshape(-1, 3)
            sizes = len(area), area.sum(), area.max()
            row[part.name] = rounded([*sizes, *np.ptp(rims, axis=0), *rims.mean(axis=0)])
        out[name] = row
    for sex, side in (("male", "right"), ("female", "left")):
        bodies = arm(Build(sex, percentile=30), side).bodies(cs.Pose(), {})
        out[f"arm {sex}"] = {b.name: rounded([*b.shape.params, *b.pose.position]) for b in bodies}
    return out


def groups() -> dict[str, Callable[[Make], Results]]:
    """Everything that is kept, by name."""

    def of(design: str, preset: str, frequency: float) -> Callable[[Make], Results]:
        return lambda make: readings(make, design, preset, frequency)

    some = {f"{design} {preset}": of(design, preset, f) for design, preset, f in SENSORS}
    return some | {
        each.__name__: each
        for each in (slopes, surfaces, masked, potentials, fields, counts, outlines)
    }  # fmt: skip


def main() -> None:
    """Write the file."""
    made: dict[Any, cs.Simulator] = {}

    def make(design: str, **options: Any) -> cs.Simulator:
        key = (design, *sorted(options.items()))
        made.setdefault(key, cs.Simulator(design, **options)).reset()
        return made[key]

    found = {}
    for name, group in groups().items():
        sys.stderr.write(f"{name}\n")
        found[name] = group(make)
    FILE.write_text(json.dumps(found, indent=0) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
