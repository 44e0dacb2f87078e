"""Relative permittivities of the substrates and covers that sensors are made of.

Values are those that vendors' tables and handbooks give between 100 kHz and 10 MHz; the middle
of the published range where there is one. A design may state ``eps_r`` instead of a name.
"""

from __future__ import annotations

LAYER_EPS_R: dict[str, float] = {
    "abs": 3.0,
    "acrylic": 3.0,
    "air": 1.0,
    "alumina": 9.8,
    "borosilicate glass": 4.6,
    "fr4": 4.5,
    "pet": 3.2,
    "petg": 3.0,
    "pla": 3.0,
    "polycarbonate": 2.9,
    "polyimide": 3.4,
    "ptfe": 2.1,
    "silicone": 3.2,
    "soda-lime glass": 7.0,
}
"""Relative permittivity by material name (lower case)."""
