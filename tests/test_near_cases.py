"""End to end: cases that people tried near contact, against values that they had from elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import capsense as cs

DESIGNS = Path(__file__).parent / "data" / "near_designs"
WATER = cs.Material("water without losses", eps_r=78.4)
TANK = {0.0: (36.7, 44.8), 0.5e-3: (27.0, 30.8), 1e-3: (21.7, 24.0), 2e-3: (16.1, 17.2)}
"""-C_12 of a pair of strips on a 3 mm wall in front of water, and of floating steel, by gap [pF]:
finite volumes in 2-D times the strips' length, which leave out the ends, a few per cent."""


@pytest.fixture(scope="module")
def tank(field_cache: Path) -> cs.Simulator:
    return cs.Simulator(DESIGNS / "tank.toml", cache_dir=field_cache)


def mutual(sim: cs.Simulator, level: float, gap: float, material: cs.Material | str) -> float:
    shape, pose = cs.Box((0.1, level, 0.1)), cs.Pose((0, -0.165 + 0.5 * level, 0.053 + gap))
    body = cs.Body(shape, pose, material, grounding="floating")
    return -1e12 * float(sim.step(cs.Scene([body])).capacitance[0, 1])


@pytest.mark.e2e
@pytest.mark.parametrize("gap", TANK)
def test_tank_by_gap(tank: cs.Simulator, gap: float) -> None:
    """Reference: finite volumes."""
    water, steel = TANK[gap]
    assert mutual(tank, 0.33, gap, WATER) == pytest.approx(water, rel=0.2)
    assert mutual(tank, 0.33, gap, "steel") == pytest.approx(steel, rel=0.12)


@pytest.mark.e2e
@pytest.mark.parametrize("material", [WATER, "water"], ids=["lossless", "tap"])
def test_tank_by_level(tank: cs.Simulator, material: cs.Material | str) -> None:
    """Invariant: rises with the level, about linearly, from the empty tank."""
    empty = -1e12 * float(tank.baseline[0, 1])
    levels = np.array([0.11, 0.22, 0.33])
    rise = np.array([mutual(tank, level, 0.0, material) for level in levels]) - empty
    np.testing.assert_allclose(rise / levels, rise[-1] / levels[-1], rtol=0.15)
    assert empty == pytest.approx(5.7, rel=0.02)
