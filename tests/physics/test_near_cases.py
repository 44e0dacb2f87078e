"""End to end: cases that people tried near contact, against values that they had from elsewhere."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense.constants import EPS0
from capsense.design import parse_design

DESIGNS = Path(__file__).parents[1] / "data" / "near_designs"
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
    assert mutual(tank, 0.33, gap, WATER) == approx(water, rel=0.2)
    assert mutual(tank, 0.33, gap, "steel") == approx(steel, rel=0.12)


@pytest.mark.e2e
@pytest.mark.parametrize("material", [WATER, "water"], ids=["lossless", "tap"])
def test_tank_by_level(tank: cs.Simulator, material: cs.Material | str) -> None:
    """Invariant: rises with the level, about linearly, from the empty tank."""
    empty = -1e12 * float(tank.baseline[0, 1])
    levels = np.array([0.11, 0.22, 0.33])
    rise = np.array([mutual(tank, level, 0.0, material) for level in levels]) - empty
    np.testing.assert_allclose(rise / levels, rise[-1] / levels[-1], rtol=0.15)
    assert empty == approx(5.7, rel=0.02)


def two_balls(a: float, b: float, d: float) -> np.ndarray:
    """Maxwell matrix [F] of two balls with centres d apart, by images (Smythe, section 5.08)."""
    u = math.acosh((d * d - a * a - b * b) / (2 * a * b))
    n = np.arange(1, 60) * u
    first = (1.0 / (b * np.sinh(n) + a * np.sinh(n - u))).sum()
    second = (1.0 / (a * np.sinh(n) + b * np.sinh(n - u))).sum()
    both = -(1.0 / np.sinh(n)).sum() / d
    scale = 4 * math.pi * EPS0 * a * b * math.sinh(u)
    return scale * np.array([[first, both], [both, second]])


@pytest.mark.e2e
def test_electrodes_without_rims(tmp_path: Path, field_cache: Path) -> None:
    """Analytic: the two balls that examples of FreeCAD and Palace have."""
    radii = {"A": 0.01, "B": 0.02}
    for name, radius in radii.items():
        volume = trimesh.creation.icosphere(2).volume
        radius *= (4 / 3 * math.pi / volume) ** (1 / 3)  # of the ball's volume
        trimesh.creation.icosphere(2, radius).export(tmp_path / f"{name}.stl")
    balls = [
        {"name": name, "shape": "stl", "file": f"{name}.stl", "unit": "m", "center": [x, 0.0, 0.0]}
        for name, x in zip(radii, (-0.025, 0.025), strict=True)
    ]
    design = parse_design(
        {"name": "balls", "domain": {"size": [2.0] * 3, "backplane": 1.0, "open": True},
         "electrode": balls},
        folder=tmp_path,
    )  # fmt: skip
    sim = cs.Simulator(design, cache_dir=field_cache)
    exact = two_balls(0.01, 0.02, 0.05)
    np.testing.assert_allclose(sim.baseline, exact, atol=0.005 * exact.max())


ROUND = {0.5e-3: 1237.0, 1e-3: 529.8, 2e-3: 197.7, 5e-3: 36.45, 10e-3: 6.99}
"""Change [fF] of a disc pad of 5 mm radius by a grounded cylinder of 50 mm radius, 1 mm thick, by
gap: axisymmetric finite elements with a round board of the same area."""


@pytest.mark.slow
def test_thin_cylinder_over_a_pad_on_a_board(field_cache: Path) -> None:
    design = parse_design({
        "name": "pad on a board",
        "domain": {"size": [0.5] * 3, "backplane": 0.01},
        "electrode": [{"name": "E", "shape": "disc", "radius": 0.005}],
        "layer": [{"name": "board", "eps_r": 4.5, "size": [0.0266] * 2, "z": [-0.001, 0.0]}],
        "conductor": [{"name": "plane", "role": "ground", "shape": "rectangle",
                       "size": [0.0266] * 2, "center": [0.0, 0.0, -0.001]}],
    })  # fmt: skip
    sim = cs.Simulator(design, cache_dir=field_cache)
    for gap, wanted in ROUND.items():
        body = cs.Body(cs.Cylinder(0.05, 0.001), cs.Pose((0, 0, gap + 5e-4)), "steel")
        assert 1e15 * sim.step(cs.Scene([body])).delta[0, 0] == approx(wanted, rel=0.06)


@pytest.mark.e2e
def test_a_thin_plate_over_a_plate(field_cache: Path) -> None:
    """Reference: boundary elements of both, 7.941 pF beside 8.107 in all, on the electrode."""
    side = [0.1, 0.1]
    design = parse_design({
        "name": "plate", "domain": {"size": [1.0] * 3, "backplane": 0.5, "open": True},
        "electrode": [{"name": "E", "shape": "rectangle", "size": side}],
    })  # fmt: skip
    sim = cs.Simulator(design, cache_dir=field_cache)
    plate = cs.Body(cs.Box((*side, 1e-4)), cs.Pose((0, 0, 0.02 + 5e-5)), "steel")
    assert 1e12 * sim.step(cs.Scene([plate])).capacitance[0, 0] == approx(8.107, rel=0.03)


@pytest.mark.parametrize("design", ["gripper_pad", "patch"])
def test_a_cup_in_a_gripper(simulators, design: str) -> None:
    """Invariant: physics engines let a cup sink into a finger; what it reads never falls."""
    sim = simulators(design)
    top, lying = 1e-4 if design == "gripper_pad" else 0.0, (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    found = []
    for gap in (20e-3, 5e-3, 1e-3, 3e-4, 1e-4, 0.0, -1e-4, -5e-4, -1e-3, -2e-3, -5e-3):
        pose = cs.Pose((0.0, 0.0, top + gap + 0.035), lying)
        body = cs.Body(cs.Cylinder(0.035, 0.1), pose, "steel", grounding="floating")
        found.append(np.diag(sim.step(cs.Scene([body])).delta))
    found = np.array(found)
    assert (np.diff(found, axis=0) > -1e-4 * found.max()).all()
    assert (found[-1] > 0.0).all()
