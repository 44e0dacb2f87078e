"""Which distances models of a sensor tell of other bodies than the one they were fitted to.

Run it: ``python examples/distance_models.py``. Six electrodes read bodies with the field solver;
ε₀A/d and a curve, both fitted to a hand, tell distances from the mean change.
"""

from __future__ import annotations

import numpy as np

import capsense as cs
from capsense.constants import EPS0

ALONG_X = (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5))
PALM = cs.Ellipsoid((0.05, 0.09, 0.02))


def person(shape: cs.Ellipsoid | cs.Capsule, pose: cs.Pose | None = None) -> cs.Body:
    """A part of a person, on 100 pF."""
    return cs.Body(shape, pose or cs.Pose(), "human", grounding=100e-12)


BODIES = {
    "hand": (person(PALM), 0.02),
    "hand, 40 mm aside": (person(PALM, cs.Pose((0.04, 0.0, 0.0))), 0.02),
    "forearm": (person(cs.Capsule(0.04, 0.2), cs.Pose((0.0, 0.0, 0.0), ALONG_X)), 0.04),
    "finger": (person(cs.Capsule(0.008, 0.06)), 0.038),
    "steel ball, 40 mm": (cs.Body(cs.Sphere(0.02), cs.Pose(), "steel"), 0.02),
    "the same, floating": (
        cs.Body(cs.Sphere(0.02), cs.Pose(), "steel", grounding="floating"),
        0.02,
    ),
    "wooden block, 60 mm": (cs.Body(cs.Box((0.06, 0.06, 0.06)), cs.Pose(), "wood"), 0.03),
}
"""Bodies with their middle at the origin, and their half height [m]."""
GAPS = np.geomspace(0.003, 0.3, 40)
"""At which the curve is fitted [m]."""


def rise(sim: cs.Simulator, name: str, gap: float) -> float:
    """Mean change of the self capacitances [F], with a body's lowest point at a height [m]."""
    body, half = BODIES[name]
    x, y, z = body.pose.position
    pose = cs.Pose((x, y, z + gap + half), body.pose.quaternion)
    return float(np.diag(sim.step(cs.Scene([body.moved(pose)])).delta).mean())


def main() -> None:
    """Print the distances that both models tell."""
    sim = cs.Simulator("six_patch")
    curve = np.array([rise(sim, "hand", gap) for gap in GAPS])
    area = np.mean([e.surface.area for e in sim.design.electrodes])
    scale = np.interp(0.05, GAPS, curve) * 0.05 / (EPS0 * area)
    print("distance [mm] that eps0 A/d | the fitted curve tell at 20, 50, 100 mm")
    for name in BODIES:
        found = np.array([rise(sim, name, gap) for gap in (0.02, 0.05, 0.10)])
        plates = 1e3 * scale * EPS0 * area / found
        fitted = 1e3 * np.exp(np.interp(-np.log(found), -np.log(curve), np.log(GAPS)))
        print(f"{name:20}", *(f"{d:5.0f}" for d in plates), " |", *(f"{d:5.0f}" for d in fitted))


if __name__ == "__main__":
    main()
