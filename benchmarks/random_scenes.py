"""Accuracy over random scenes: ``python benchmarks/random_scenes.py [--refine 1.7]``.

Limb-like capsules, balls and tilted boxes, 5 to 80 mm above bare patches, at random places, so that
no figure owes anything to how a body happens to lie against the lattice. The reference is the same
solver on a lattice refined throughout (built once and cached, a minute or two), whose own error is
about a third of the default's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from capsense.field.lattice import LatticeSettings

import capsense as cs
from capsense.field.background import BuildSettings

GAPS = (0.005, 0.01, 0.02, 0.04, 0.08)
COUNT = 40


def capsule(rng: np.random.Generator, gap: float, place: np.ndarray) -> cs.Body:
    """A limb of random size, nearly level, at any azimuth."""
    azimuth, tilt = rng.uniform(0, np.pi), rng.uniform(-0.15, 0.15)
    radius, length = rng.uniform(0.03, 0.05), rng.uniform(0.1, 0.25)
    axis = np.array([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), np.sin(tilt)])
    side = np.cross((0.0, 0.0, 1.0), axis)
    side /= np.linalg.norm(side)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([side, np.cross(axis, side), axis], axis=1)
    frame[:3, 3] = (*place, gap + radius + abs(axis[2]) * length / 2)
    return cs.Body(cs.Capsule(radius, length), cs.Pose.from_matrix(frame))


def box(rng: np.random.Generator, gap: float, place: np.ndarray) -> cs.Body:
    """A box of random size, tilted."""
    body = cs.Body(
        cs.Box(tuple(rng.uniform(0.04, 0.15, 3))), cs.Pose((0, 0, 0), (*rng.normal(0, 0.1, 3), 1.0))
    )
    low = cs.Scene([body]).pack().bounds[0, 0, 2]
    return body.moved(cs.Pose((*place, gap - low), body.pose.quaternion))


def scenes() -> list[tuple[float, cs.Scene]]:
    """Gap and scene; the same at every call."""
    rng = np.random.default_rng(5)
    out = []
    for k in range(COUNT):
        gap, place = GAPS[k % len(GAPS)], rng.uniform(-0.03, 0.03, 2)
        kind = (k // len(GAPS)) % 4
        if kind < 2:
            body = capsule(rng, gap, place)
        elif kind == 2:
            radius = rng.uniform(0.02, 0.05)
            body = cs.Body(cs.Sphere(radius), cs.Pose((*place, gap + radius)))
        else:
            body = box(rng, gap, place)
        out.append((gap, cs.Scene([body])))
    return out


def diagonals(sim: cs.Simulator) -> np.ndarray:
    """ΔC_ii of every scene [F], shape (scenes, electrodes)."""
    out = []
    for _, scene in scenes():
        sim.reset()
        out.append(np.diag(sim.step(scene).delta))
    return np.array(out)


def main() -> None:
    """Print errors of diagonal entries above a tenth of the scene's largest."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--refine", type=float, default=1.7, help="of the reference's lattice")
    args = parser.parse_args()
    fine = BuildSettings(lattice=replace(LatticeSettings(), thinning=0.0).refined(args.refine))
    reference = cs.Simulator("six_patch_bare", settings=fine)
    sim = cs.Simulator("six_patch_bare")
    truth, got = diagonals(reference), diagonals(sim)
    large = np.abs(truth) > 0.1 * np.abs(truth).max(axis=1, keepdims=True)
    error = np.where(large, got / truth - 1, np.nan) * 100
    print(f"{sim.describe()['nodes']} nodes against {reference.describe()['nodes']}")
    gap = np.array([g for g, _ in scenes()])
    for g in GAPS:
        part = error[gap == g]
        print(f"  gap {1e3 * g:3.0f} mm: mean {np.nanmean(part):+.1f} %, "
              f"deviation {np.nanstd(part):.1f} %")  # fmt: skip
    size = np.abs(error[large])
    print(f"  all: rms {np.sqrt((size**2).mean()):.2f} %, 95 % below "
          f"{np.percentile(size, 95):.1f} %, largest {size.max():.1f} %")  # fmt: skip


if __name__ == "__main__":
    main()
