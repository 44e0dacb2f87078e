"""Depth frames and deforming surfaces: agreement with the geometry path, times.

``python benchmarks/depth_path.py`` prints the tables of ``docs/depth.md``. Times are of this
machine, one process, as found.
"""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

import capsense as cs

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from layered_views import view
from sheet_theory import first_order

BODIES = {
    "bar": (cs.Box((0.15, 0.15, 0.02)), (0, 0, 0), 0.01),
    "turned bar": (cs.Box((0.15, 0.1, 0.02)), (0, 0, 0.4), 0.01),
    "forearm": (cs.Capsule(0.045, 0.2), (0, np.pi / 2, 0.3), 0.045),
    "ball": (cs.Sphere(0.04), (0, 0, 0), 0.04),
}


def mesh_of(shape: cs.Shape) -> trimesh.Trimesh:
    """A mesh of a shape: twelve triangles of a box, about 1000 of others."""
    if isinstance(shape, cs.Sphere):
        return trimesh.creation.icosphere(3, shape.radius)
    if isinstance(shape, cs.Capsule):
        mesh = trimesh.creation.capsule(shape.length, shape.radius, count=(24, 24))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
        return mesh
    return shape.to_trimesh()


def sheet(n: int, width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of n × n quads at z = 0, two triangles each."""
    u, v = (np.linspace(-0.5, 0.5, n + 1) * side for side in (width, height))
    x, y = np.meshgrid(u, v)
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([
        np.column_stack([first, first + 1, first + n + 2]),
        np.column_stack([first, first + n + 2, first + n + 1]),
    ])  # fmt: skip
    return np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces


def agreement() -> None:
    """Depth path against geometry path: six_patch, bodies of steel at random places."""
    sim = cs.Simulator("six_patch")
    print("\nlargest error of delta, % of the largest entry, over six places: front filled; front")
    print("and back; each at 64, 128, 256 pixels over 0.5 m; a deforming surface of its triangles")
    rng = np.random.default_rng(0)
    for name, (shape, angles, low) in BODIES.items():
        for gap in (0.002, 0.005, 0.01, 0.02, 0.05):
            worst = np.zeros(7)
            for _ in range(6):
                place = (*rng.uniform(-0.03, 0.03, 2), low + gap)
                pose = cs.Pose.from_euler(place, angles)
                body = cs.Body(shape, pose, "steel")
                exact = sim.step(cs.Scene([body])).delta
                found = []
                for n in (64, 128, 256):
                    front, back = view(shape, pose, n, 0.5)
                    found.append(sim.step(cs.DepthFrame(front)).delta)
                    found.append(sim.step(cs.DepthFrame(front, back=back)).delta)
                mesh = mesh_of(shape)
                surface = cs.DeformableSurface(
                    pose.apply(mesh.vertices), mesh.faces, material="steel"
                )
                found.append(sim.step(cs.Scene([surface.body()])).delta)
                error = [np.abs(f - exact).max() / np.abs(exact).max() for f in found]
                worst = np.maximum(worst, error)
            w = 100 * worst
            print(f"  {name:10s} {1e3 * gap:3.0f} mm   {w[0]:5.2f} {w[2]:5.2f} {w[4]:5.2f}   "
                  f"{w[1]:5.2f} {w[3]:5.2f} {w[5]:5.2f}   {w[6]:5.2f}")  # fmt: skip


def foils() -> None:
    """Conducting sheets at ground against thin boxes of fine panels."""
    sim, fine = (cs.Simulator("six_patch_bare", preset=p) for p in ("standard", "fine"))
    print("\nsheet of 0.12 x 0.1 m against a box of 0.2 mm with the fine preset, largest error of")
    print("delta, % of the largest entry: quads 4 x 4, 8 x 8, 20 x 20, 40 x 40; box of 0.2 mm")
    for z in (0.005, 0.01, 0.02, 0.03, 0.05, 0.08):
        pose = cs.Pose((0.007, -0.004, z))
        plate = cs.Scene([cs.Body(cs.Box((0.12, 0.1, 0.0002)), pose, "steel")])
        exact = fine.step(plate).delta
        found = []
        for n in (4, 8, 20, 40):
            vertices, faces = sheet(n, 0.12, 0.1)
            foil = cs.DeformableSurface(pose.apply(vertices), faces, material="steel")
            found.append(sim.step(cs.Scene([foil.body()])).delta)
        found.append(sim.step(plate).delta)
        error = [100 * np.abs(f - exact).max() / np.abs(exact).max() for f in found]
        print(f"  {1e3 * z:3.0f} mm   {'  '.join(f'{e:.2f}' for e in error)}")


def sheets() -> None:
    """Thin dielectrics against first-order theory."""
    sim, size = cs.Simulator("six_patch"), 0.2
    eps_r = cs.MATERIALS["cotton"].eps_r
    print("\nchange of E2 by a level sheet of cotton, 0.2 m square, over first-order theory, at")
    print("thicknesses of 0.5, 1, 2, 4 mm")
    for z in (0.030, 0.033, 0.036, 0.040, 0.060):
        ratios = []
        for thickness in (0.0005, 0.001, 0.002, 0.004):
            sheet = cs.Body(cs.Box((size, size, thickness)), cs.Pose((0, 0, z)), "cotton")
            sim.reset()
            found = sim.step(cs.Scene([sheet])).delta[1, 1]
            ratios.append(found / first_order(sim, z, thickness, size, eps_r, 1))
        print(f"  {1e3 * z:3.0f} mm: {' '.join(f'{r:.2f}' for r in ratios)}")


def median(run: Callable[[], object], n: int = 200) -> float:
    """Median time that the processor spends on a call [ms]."""
    run()
    times = []
    for _ in range(n):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


def times() -> None:
    """Median times of the processor; other programs may run too."""
    print("\nmedian times [ms]")
    for n in (64, 128):
        c = (np.arange(n) + 0.5) / n * 0.5 - 0.25
        x, y = np.meshgrid(c, c)
        full = 0.1 + 0.2 * x**2
        arm = np.where(np.abs(y) < 0.045, 0.1 - np.sqrt(np.maximum(0.045**2 - y**2, 0)), -1.0)
        for name, depth in (("full", full), ("arm", arm)):
            frame = cs.DepthFrame(depth)
            scene = frame.scene()
            print(f"  {n} x {n}, {name}: frame {median(lambda d=depth: cs.DepthFrame(d)):.3f}, "
                  f"scene {median(frame.scene):.3f}, pack {median(scene.pack):.3f}")  # fmt: skip
    for faces in (1280, 5120, 20480):
        level = {1280: 3, 5120: 4, 20480: 5}[faces]
        mesh = trimesh.creation.icosphere(level, 0.1)
        vertices, f = mesh.vertices + np.array([0, 0, 0.2]), np.array(mesh.faces)
        for n in (64, 128):
            raster = cs.render_depth(vertices, f, (0.21, 0.21), (n, n))
            run = median(lambda v=vertices, f=f, n=n: cs.render_depth(v, f, (0.21, 0.21), (n, n)))
            layers = median(raster.layers)
            print(f"  {faces} triangles at {n} x {n}: render_depth {run:.3f}, layers {layers:.3f}")
    sim = cs.Simulator("six_patch")
    capsule = cs.Capsule(0.045, 0.2)
    frames = {}
    for n in (64, 128):
        for k in range(100):
            pose = cs.Pose.from_euler((-0.1 + 0.002 * k, 0, 0.075), (0, np.pi / 2, 0.3))
            frames[n, k] = view(capsule, pose, n, 0.5)[0]
    for n in (64, 128):
        for back in ("fill", 0.09):
            sim.reset()
            spent = []
            for k in range(100):
                start = time.process_time()
                sim.step(cs.DepthFrame(frames[n, k], back=back))
                spent.append(time.process_time() - start)
            print(f"  step, forearm at 0.2 m/s and 100 Hz, {n} x {n}, back {back}: "
                  f"{1e3 * np.median(spent[5:]):.2f}")  # fmt: skip
    for quads in (8, 20, 28):
        vertices, faces = sheet(quads, 0.2, 0.1)
        foil = cs.DeformableSurface(vertices, faces, material="steel")
        spent = []
        for k in range(100):
            pose = cs.Pose.from_euler((-0.1 + 0.002 * k, 0, 0.03), (0, 0, 0.3))
            moved = pose.apply(vertices) + np.array([0, 0, 0.005 * np.sin(0.1 * k)])
            start = time.process_time()
            foil.vertices = moved
            sim.step(cs.Scene([foil.body()]))
            spent.append(time.process_time() - start)
        print(f"  step, sheet of {2 * quads**2} triangles: {1e3 * np.median(spent[5:]):.2f}")
    sim.reset()
    spent = []
    for k in range(100):
        pose = cs.Pose.from_euler((-0.1 + 0.002 * k, 0, 0.075), (0, np.pi / 2, 0.3))
        start = time.process_time()
        sim.step(cs.Scene([cs.Body(capsule, pose, "steel")]))
        spent.append(time.process_time() - start)
    print(f"  the same, geometry path: {1e3 * np.median(spent[5:]):.2f}")


if __name__ == "__main__":
    print(f"{platform.platform()}, Python {platform.python_version()}, numpy {np.__version__}")
    agreement()
    foils()
    sheets()
    times()
