"""How well images tell where something is: ``python benchmarks/imaging.py``.

Grounded balls of 15 mm radius, at random over ``six_patch``, 35 to 80 mm above it; all 21 self and
mutual capacitances, without noise and with as much as a good chip leaves. Voxels measure 10 mm.
"""

from __future__ import annotations

import numpy as np

import capsense as cs
from capsense.readout.imaging import (
    back_projection,
    electrode_pairs,
    grounded_sensitivity,
    landweber,
    tikhonov,
    voxel_centres,
)

GRID = (np.linspace(-0.08, 0.08, 17), np.linspace(-0.07, 0.07, 15), np.linspace(0.005, 0.105, 11))
NOISES = (0.0, 0.2e-15, 1e-15)
COUNT = 100
CENTRES = voxel_centres(GRID)


def brightest(images: np.ndarray) -> np.ndarray:
    """The brightest voxel of each image [m], shape (n, 3)."""
    return CENTRES[np.argmax(images, axis=1)]


def middle(images: np.ndarray) -> np.ndarray:
    """The centre of the brighter half of each image [m], shape (n, 3)."""
    bright = np.where(images > 0.5 * images.max(axis=1, keepdims=True), images, 0.0)
    return bright @ CENTRES / bright.sum(axis=1, keepdims=True)


def main() -> None:
    """Print one row for each method and noise."""
    sim = cs.Simulator("six_patch")
    count = len(sim.electrode_names)
    pairs = electrode_pairs(count, diagonal=True)
    nodes = np.stack(np.meshgrid(*GRID, indexing="ij"), axis=-1)
    potentials = sim.step(cs.Scene(), keep_field=True).potentials(nodes.reshape(-1, 3))[:, :count]
    j = grounded_sensitivity(potentials.reshape(*nodes.shape[:3], count), GRID, pairs)
    rng = np.random.default_rng(1)
    places = rng.uniform((-0.045, -0.035, 0.035), (0.045, 0.035, 0.08), (COUNT, 3))
    changes = []
    for place in places:
        delta = sim.step(cs.Scene([cs.Body(cs.Sphere(0.015), cs.Pose(place), "human")])).delta
        changes.append([delta[p] for p in pairs])
    back, regular, positive = back_projection(j), tikhonov(j), landweber(j, unit_voxels=True)
    methods = {
        "back-projection": lambda d: brightest(d @ back.T),
        "Tikhonov": lambda d: brightest(d @ regular.T),
        "Landweber": lambda d: middle(positive(d)),
    }
    print(f"{'':16} {'noise':>6} {'sideways [mm]':>16} {'depth [mm]':>16}")
    print(f"{'':16} {'[fF]':>6} {'median':>8} {'90 %':>7} {'median':>8} {'90 %':>7}")
    for noise in NOISES:
        seen = np.array(changes) + noise * rng.standard_normal((COUNT, len(pairs)))
        for name, method in methods.items():
            off = 1e3 * (method(seen) - places)
            sideways, depth = np.hypot(off[:, 0], off[:, 1]), np.abs(off[:, 2])
            figures = [np.percentile(e, q) for e in (sideways, depth) for q in (50, 90)]
            row = " ".join(f"{f:8.0f}" for f in figures)
            print(f"{name:16} {1e15 * noise:6.1f} {row}")


if __name__ == "__main__":
    main()
