"""The ``[[cover]]`` table of a design file: a soft layer on the face of a flat design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from capsense._validate import shorten
from capsense.cover import GROUND, NONE, TOPS, Cover, StressStrain
from capsense.design.geometry import TOUCH, DesignTable, level_rectangle
from capsense.design.model import Conductor, Domain, Electrode, Layer, Role
from capsense.errors import DesignError

COVER_KEYS = (
    "name",
    "material",
    "eps_r",
    "thickness",
    "size",
    "center",
    "modulus",
    "stress_strain",
    "relaxation",
    "hysteresis",
    "top",
    "bending_length",
)
_SOFTEST, _STIFFEST = 10.0, 1e12
"""Moduli [Pa] that are taken for one: from air-like foams to diamond."""


def read_cover(
    table: DesignTable,
    material: tuple[str, float],
    domain: Domain,
    sheets: Sequence[Electrode | Conductor],
    layers: Sequence[Layer],
) -> tuple[Cover, Layer, Conductor | None]:
    """Read a cover that lies on the highest sheet or layer below it, in a flat design.

    Args:
        table: The ``[[cover]]`` table.
        material: Name and relative permittivity of the cover.
        domain: Domain of the design.
        sheets: Electrodes and other conductors below it.
        layers: Dielectric layers below it.

    Returns:
        The cover, the dielectric layer that it is in the field, and the fabric on it, if any.

    Raises:
        DesignError: A key is wrong; the design is not flat; or the cover does not fit.
    """
    table.only(COVER_KEYS)
    bounds = np.array(
        [s.surface.bounds for s in sheets] + [[la.lower, la.upper] for la in layers]
    ).reshape(-1, 2, 3)
    if any(np.ptp(s.surface.bounds[:, 2]) > 1e-6 for s in sheets if isinstance(s, Electrode)):
        raise table.error(
            "a cover lies on flat, level electrodes, and some of this design are not; describe it "
            "as a rigid [[layer]] instead"
        )
    thickness = table.length("thickness")
    low, high = bounds[:, 0, :2].min(axis=0), bounds[:, 1, :2].max(axis=0)
    if "size" in table:
        sx, sy = table.sizes("size", 2, "[x, y] in metres")
        middle = np.array(table.coordinates("center", (2,), (0.0, 0.0)))
        half = 0.5 * np.array([sx, sy])
        low, high = middle - half, middle + half
    elif "center" in table:
        raise table.error(
            "center needs size = [x, y] in metres; without both it lies on everything"
        )
    low = np.maximum(low, domain.lower[:2])
    high = np.minimum(high, domain.upper[:2])
    below = ((bounds[:, 0, :2] < high - TOUCH) & (bounds[:, 1, :2] > low + TOUCH)).all(axis=1)
    if not below.any():
        raise table.error(
            "nothing lies below it; move it over the electrodes (size, center); lengths are metres"
        )
    top = float(bounds[below, 1, 2].max())
    if bounds[:, 1, 2].max() > top + thickness + TOUCH:
        raise table.error(
            f"its face is at z = {top + thickness:g} m, and something beside it reaches "
            f"z = {bounds[:, 1, 2].max():g} m; nothing may be higher than a cover that gives way"
        )
    lower, upper = np.array([*low, top]), np.array([*high, top + thickness])
    kind = table.choice("top", TOPS, NONE)
    bending = table.length("bending_length", 0.0, zero=True)
    if bending > 0.0 and kind == NONE:
        raise table.error(
            f'bending_length = {bending:g} is that of a fabric on top; give top = "ground" or '
            '"floating", or leave it out'
        )
    name, eps_r = table.string("name"), material[1]
    cover = Cover(
        name, eps_r, lower, upper, _law(table), _relaxation(table),
        table.number("hysteresis", 0.0, 0.99, 0.0), kind, bending,
    )  # fmt: skip
    layer = Layer(name, material[0], eps_r, lower, upper)
    if kind == NONE:
        return cover, layer, None
    role = Role.GROUND if kind == GROUND else Role.FLOATING
    return cover, layer, Conductor(f"{name} top", role, level_rectangle(low, high, upper[2]))


def _law(table: DesignTable) -> StressStrain:
    if ("modulus" in table) == ("stress_strain" in table):
        raise table.error(
            "give either modulus = a number in Pa or stress_strain = [[0, 0], [strain, pressure in "
            "Pa], …]; what does not give way is a [[layer]]"
        )
    if "modulus" in table:
        return StressStrain.linear(table.number("modulus", _SOFTEST, _STIFFEST, unit="Pa"))
    rows = table.vectors("stress_strain", 2, "[strain, pressure in Pa]")
    try:
        return StressStrain(*np.array(rows, float).T)
    except DesignError as error:
        raise table.error(str(error).removeprefix("cover: ")) from None


def _relaxation(table: DesignTable) -> tuple[tuple[float, float], ...]:
    if "relaxation" not in table:
        return ()
    out = []
    for share, time in table.vectors("relaxation", 2, "[share, time in s]"):
        if not (0.0 < share < 1.0 and time > 0.0):
            raise table.error(
                f"relaxation has [{share:g}, {time:g}]; give pairs of a share between 0 and 1 and "
                "a time in s above 0"
            )
        out.append((share, time))
    if sum(share for share, _ in out) >= 1.0:
        raise table.error(
            f"relaxation = {shorten(out)} takes all of the pressure; the shares must add to less "
            "than 1"
        )
    return tuple(out)
