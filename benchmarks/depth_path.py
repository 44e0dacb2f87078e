"""Depth frames: convergence, agreement with the geometry path, times.

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

from sheet_theory import first_order

SIZES = (32, 64, 128, 256)
SOLIDS = {
    "sphere": (cs.Sphere(0.06), cs.Pose((0.004, 0.003, 0.15))),
    "capsule": (
        cs.Capsule(0.04, 0.1), cs.Pose.from_euler((0.004, 0.003, 0.15), (0.4, 1.2, 0.3)),
    ),
    "box, upright": (cs.Box((0.12, 0.1, 0.06)), cs.Pose((0.004, 0.003, 0.15))),
    "box, tilted": (
        cs.Box((0.12, 0.1, 0.06)), cs.Pose.from_euler((0.004, 0.003, 0.15), (0.5, 0.4, 0.3)),
    ),
}  # fmt: skip
BODIES = {
    "bar": (cs.Box((0.15, 0.15, 0.02)), (0, 0, 0), 0.01),
    "turned bar": (cs.Box((0.15, 0.1, 0.02)), (0, 0, 0.4), 0.01),
    "forearm": (cs.Capsule(0.045, 0.2), (0, np.pi / 2, 0.3), 0.045),
    "ball": (cs.Sphere(0.04), (0, 0, 0), 0.04),
}


def view(shape: cs.Box, pose: cs.Pose, n: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Front and back [m] of a convex solid along z at the middles of n × n pixels."""
    c = (np.arange(n) + 0.5) / n * size - size / 2
    x, y = np.meshgrid(c, c)
    o = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    inverse = pose.inverse()
    t = shape.line_intervals(inverse.apply(o), inverse.rotation @ (0.0, 0.0, 1.0))
    t = np.where(t[:, 1:] > t[:, :1], t, np.nan).reshape(n, n, 2)
    return t[..., 0], t[..., 1]


def chords(shape: cs.Box, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Length of lines inside a shape."""
    t = shape.line_intervals(o, d).reshape(len(o), -1, 2)
    return np.where(t[..., 1] > t[..., 0], t[..., 1] - t[..., 0], 0.0).sum(axis=1)


def mesh_of(name: str, shape: cs.Box) -> trimesh.Trimesh:
    """A fine mesh of a shape."""
    return trimesh.creation.icosphere(5, shape.radius) if name == "sphere" else shape.to_trimesh()


def convergence() -> None:
    """Mean error of chords of random lines against the exact shape."""
    print("\nmean error of chords [mm] at 32, 64, 128, 256 pixels over 0.3 m, mean order")
    rng = np.random.default_rng(1)
    for name, (shape, pose) in SOLIDS.items():
        o = np.array(pose.position) + rng.uniform(-0.08, 0.08, (6000, 3))
        d = rng.normal(size=(6000, 3))
        d[:2000], d[2000:4000] = (0, 0, 1), (1, 0, 0)
        d /= np.linalg.norm(d, axis=1)[:, None]
        inverse = pose.inverse()
        exact = chords(shape, inverse.apply(o), d @ inverse.rotation.T)
        mesh = mesh_of(name, shape)
        for kind in ("faces by rays", "own rasteriser"):
            errors = []
            for n in SIZES:
                if kind == "faces by rays":
                    layers = cs.Layers(*view(shape, pose, n, 0.3), (0.3, 0.3))
                else:
                    vertices = pose.apply(mesh.vertices)
                    layers = cs.rasterise(vertices, mesh.faces, (0.3, 0.3), (n, n)).layers()
                errors.append(1e3 * np.abs(chords(layers, o, d) - exact).mean())
            order = np.log2(errors[0] / errors[-1]) / 3
            figures = "  ".join(f"{e:.3f}" for e in errors)
            print(f"  {name:13s} {kind:15s} {figures}   {order:.1f}")


def agreement() -> None:
    """Depth path against geometry path: six_patch, bodies of steel at random places."""
    sim = cs.Simulator("six_patch")
    print("\nlargest error of delta, % of the largest entry, over six places: front filled; front")
    print("and back; each at 64, 128, 256 pixels over 0.5 m; own rasteriser at 64")
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
                mesh = mesh_of("sphere" if name == "ball" else name, shape)
                surface = cs.DeformableSurface(
                    pose.apply(mesh.vertices), mesh.faces, material="steel"
                )
                found.append(sim.step(cs.Scene([surface.body()])).delta)
                error = [np.abs(f - exact).max() / np.abs(exact).max() for f in found]
                worst = np.maximum(worst, error)
            w = 100 * worst
            print(f"  {name:10s} {1e3 * gap:3.0f} mm   {w[0]:5.2f} {w[2]:5.2f} {w[4]:5.2f}   "
                  f"{w[1]:5.2f} {w[3]:5.2f} {w[5]:5.2f}   {w[6]:5.2f}")  # fmt: skip


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
            raster = cs.rasterise(vertices, f, (0.21, 0.21), (n, n))
            surface = cs.DeformableSurface(vertices, f, resolution=n)
            run = median(lambda v=vertices, f=f, n=n: cs.rasterise(v, f, (0.21, 0.21), (n, n)))
            layers, body = median(raster.layers), median(surface.body)
            print(f"  {faces} triangles at {n} x {n}: rasterise {run:.3f}, layers {layers:.3f}, "
                  f"deformable body {body:.3f}")  # fmt: skip
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
    convergence()
    agreement()
    sheets()
    times()
