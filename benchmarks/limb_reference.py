"""Slopes of the limb approach against the independent boundary elements of ``bem_reference.py``.

``python benchmarks/limb_reference.py`` takes a minute and a half.
"""

from __future__ import annotations

import numpy as np
from bem_reference import Sensor
from reference_more import body, mesh
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.reproduce.limb_curves import (
    ACROSS,
    GROUNDINGS,
    LIMB_LENGTH,
    MAIN,
    RANGES,
    LimbSetup,
    slopes,
)

PERSON = "100 pF"


def main() -> None:
    """Print the slopes of four electrodes, by the reference and by two presets."""
    z = np.unique(np.concatenate([np.geomspace(a, b, 4) for a, b in RANGES]))
    turn = Rotation.from_quat(ACROSS)
    for setup in (
        LimbSetup(0.03),
        LimbSetup(0.06),
        LimbSetup(0.10),
        LimbSetup(0.06, "ground plane"),
    ):
        sensor = Sensor(setup.design, 1.0)
        line = np.linspace(-setup.size / 2, setup.size / 2, 13)
        points = np.stack([*np.meshgrid(line, line), np.zeros((13, 13))], axis=-1).reshape(-1, 3)
        limb = [body("capsule", [MAIN, LIMB_LENGTH], GROUNDINGS[PERSON], (0, 0, d + MAIN), turn)
                for d in z]  # fmt: skip
        found = {
            "reference": np.array(
                [sensor.change([mesh(one, points, 1.0, 0.004, 0.5)])[0, 0] for one in limb]
            )
        }
        for preset in ("fine", "standard"):
            sim = cs.Simulator(setup.design, settings=setup.settings, preset=preset)
            found[preset] = np.array([
                sim.step(cs.Scene([cs.Body(
                    cs.Capsule(MAIN, LIMB_LENGTH), cs.Pose((0, 0, d + MAIN), ACROSS), "human",
                    GROUNDINGS[PERSON],
                )])).delta[0, 0] for d in z
            ])  # fmt: skip
        print(f"{setup.size * 1e3:.0f} mm, {setup.backing}; person on {PERSON}, limb away as tare")
        for name, change in found.items():
            print(f"  {name:10}", *(f"{slope:7.3f}" for slope in slopes(z, change)))


if __name__ == "__main__":
    main()
