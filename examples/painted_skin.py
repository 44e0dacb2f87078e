"""A skin of 60 electrodes on a robot's forearm, and two that are painted on it.

The forearm's mesh is made here. A hand passes along it; a table of the largest changes is printed.
Run it: ``python examples/painted_skin.py``. It needs no simulator and no display.
"""

from __future__ import annotations

import time

import numpy as np

import capsense as cs

LENGTH, RADII = 0.26, (0.055, 0.040)
"""Length of the forearm [m], and its radii at the elbow and at the wrist [m]."""
AROUND, ALONG = 96, 40
"""Vertices of the mesh around and along the forearm."""


def forearm() -> cs.TriMesh:
    """A tapered link along z, closed by two lids."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    z = np.linspace(-LENGTH / 2, LENGTH / 2, ALONG)
    radius = np.interp(z, z[[0, -1]], RADII)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wall = np.concatenate(
        [radius[:, None, None] * ring, np.tile(z[:, None, None], (1, AROUND, 1))], 2
    )
    lids = [(0.0, 0.0, z[0]), (0.0, 0.0, z[-1])]
    first, last, n = ALONG * AROUND, ALONG * AROUND + 1, np.arange(AROUND)
    turned = (n + 1) % AROUND
    faces = [np.stack([turned, n, np.full(AROUND, first)], 1)]
    for k in range(ALONG - 1):
        a, b = k * AROUND + n, k * AROUND + turned
        faces += [np.stack([a, b, b + AROUND], 1), np.stack([a, b + AROUND, a + AROUND], 1)]
    top = (ALONG - 1) * AROUND
    faces.append(np.stack([top + n, top + turned, np.full(AROUND, last)], 1))
    return cs.TriMesh(np.concatenate([wall.reshape(-1, 3), lids]), np.concatenate(faces))


def main() -> None:
    """Lay both skins out, and read them while a hand passes."""
    link = forearm()
    wall = ((-1.0, -1.0, -0.11), (1.0, 1.0, 0.11))
    spread = cs.skin.from_mesh(link, count=60, region=wall)
    middle = link.vertices[link.faces].mean(axis=1)
    angle = np.arctan2(middle[:, 1], middle[:, 0])
    bands = (np.abs(angle) < 0.5) & (np.abs(np.abs(middle[:, 2]) - 0.05) < 0.03)
    painted = cs.skin.paint(link, bands)
    for layout in (spread, painted):
        print(f"{layout}\n")
        started = time.perf_counter()
        skin = cs.Skin(layout)
        for height in np.linspace(-0.1, 0.1, 5):
            hand = cs.Body(
                cs.Ellipsoid((0.02, 0.045, 0.09)), cs.Pose((0.10, 0.0, height)), material="human"
            )
            gains = {n: r.delta[0, 0] for n, r in skin.step(cs.Scene([hand])).items()}
            name = max(gains, key=gains.__getitem__)
            print(f"hand at {1e3 * height:4.0f} mm: {name} +{1e15 * gains[name]:.1f} fF")
        print(f"built and read in {time.perf_counter() - started:.1f} s\n")


if __name__ == "__main__":
    main()
