"""Two small electrodes below a cover, for tests of what is pressed into it."""

from __future__ import annotations

import capsense as cs
from capsense.design import parse_design

THICKNESS, EPS, MODULUS = 2e-3, 3.0, 60e3


def covered_discs(**keys: object) -> cs.Design:
    """Two discs of 3 mm, 8 mm apart, below a cover with these keys of a design file."""
    discs = [
        {"name": name, "shape": "disc", "radius": 3e-3, "center": [x, 0.0]}
        for name, x in (("A", -4e-3), ("B", 4e-3))
    ]
    cover = {"name": "foam", "thickness": THICKNESS, "eps_r": EPS, "size": [0.04, 0.03]}
    if "stress_strain" not in keys:
        cover["modulus"] = MODULUS
    return parse_design({
        "name": "two_discs",
        "domain": {"size": [0.2, 0.2, 0.2], "backplane": 0.02},
        "build": {"resolution": 0.25},
        "electrode": discs,
        "cover": [cover | keys],
    })  # fmt: skip
