"""Capacitance of a person to ground, by posture and footwear.

It is a stray part and that of two soles, as plate capacitors: ``C + 2 ε₀ ε A / d``.

- Stray part: computed by boundary elements of the capsules of :func:`~capsense.humans.person` over
  a grounded floor, less the air under the soles (``benchmarks/person_to_ground.py``). It agrees
  with 70 pF from H. Saito, "Electric potential of the body of man walking on carpet", Oyo Buturi
  32(5), 1963: 110 pF on both legs, 90 pF on one, soles of 150 cm² each.
- Soles: thickness ``d`` by kind of footwear, relative permittivity ε of rubber and polyurethane;
  both are estimates. ``"barefoot"`` is on 3 mm of floor covering; on a conducting floor, a barefoot
  person is ``"grounded"``.

N. Jonassen, "Human body capacitance: static or dynamic concept?", EOS/ESD Symposium, 1998, measured
100 to 150 pF of standing people with an AC bridge, and 200 to 400 pF by sharing static charge.
Models of electrostatic discharge have 100 pF (ANSI/ESDA/JEDEC JS-001) and 150 pF (IEC 61000-4-2).
Expect an error of a third: metal of chairs and beds, and walls nearby, are left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from capsense._validate import as_number, suggest
from capsense.constants import EPS0
from capsense.errors import SceneError
from capsense.humans.build import DATA, STATURE, Build

STRAY: Mapping[str, float] = MappingProxyType(DATA["ground"]["stray"])
"""Capacitance to ground without soles [F], by posture, of a man of mean stature."""
FOOTWEAR: Mapping[str, float] = MappingProxyType(DATA["ground"]["soles"])
"""Thickness of what is under the feet [m], by footwear."""
PERMITTIVITY: float = DATA["ground"]["permittivity"]
"""Relative permittivity of soles."""
SOLE_AREA: float = DATA["ground"]["area"]
"""Area of one sole [m²], of a man of mean stature."""


def capacitance_to_ground(
    posture: str = "standing",
    footwear: str | float = "shoes",
    build: Build = Build(),  # noqa: B008, a build is immutable
) -> float:
    """Capacitance of a person to ground [F], to be given as ``grounding``.

    Its sources are in :mod:`capsense.humans.ground`.

    Args:
        posture: ``"standing"``, ``"sitting"`` (feet on the floor, the chair an insulator) or
            ``"lying"`` (0.5 m above the floor; the soles do not count).
        footwear: ``"barefoot"``, ``"thin soles"``, ``"shoes"``, ``"thick soles"``, or the thickness
            of the soles [m].
        build: Size of the person. The stray part follows stature, that of the soles its square.

    Raises:
        SceneError: Another posture or footwear, or a thickness out of range.
    """
    if posture not in STRAY:
        raise SceneError(f"there is no posture {posture!r}; {suggest(posture, STRAY)}")
    if isinstance(footwear, str):
        if footwear not in FOOTWEAR:
            raise SceneError(
                f"there is no footwear {footwear!r}; {suggest(footwear, FOOTWEAR)}, or give the "
                "thickness of the soles in metres"
            )
        thickness = FOOTWEAR[footwear]
    else:
        thickness = as_number(footwear)
        if not 1e-4 <= thickness <= 0.2:
            raise SceneError(
                f"footwear is {footwear!r}; give the thickness of the soles, 0.0001 to 0.2 m"
            )
    size = build.height / STATURE["male"][0]
    soles = 0.0 if posture == "lying" else 2 * EPS0 * PERMITTIVITY * SOLE_AREA / thickness
    return STRAY[posture] * size + soles * size**2
