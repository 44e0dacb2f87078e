"""The compiled online solver against its slow, readable twin."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from field_cases import COARSE, ball, bar, patches, rectangle, sheet
from random_scenes import random_scene, wedge

import capsense as cs
from capsense.design.geometry import Facet, Surface
from capsense.design.model import Conductor, Design, Electrode, Layer, Role
from capsense.solve.reference import reference_delta

Array = np.ndarray

TIGHT = {"relative_tolerance": 1e-8, "tolerance": 1e-21}
WITHIN = 1e-4
"""Part of the largest entry; the kernels run in single precision."""


def crooked() -> Design:
    """A design with all there is: a tilted electrode that cuts links, a layer, all roles."""
    c, s = np.cos(0.4), np.sin(0.4)
    square = shapely.box(-0.015, -0.02, 0.015, 0.02)
    axes = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    facet = Facet(square, np.array([0.04, 0.0, 0.01]), axes)
    corners = facet.to_sensor(np.asarray(square.exterior.coords))
    rims = np.stack([corners[:-1], corners[1:]], axis=1)
    tilted = Electrode("tilted", Surface((facet,), rims))
    flat = patches(rectangle((-0.03, 0), (0.03, 0.04)), size=0.3, backplane=0.02)
    layer = Layer("plate", "glass", 5.0, np.array([-0.05, -0.03, -0.004]), np.array([0, 0.03, 0]))
    conductors = (
        Conductor("pour", Role.GROUND, sheet(rectangle((-0.03, 0.045), (0.06, 0.03)))),
        Conductor("guard", Role.SHIELD, sheet(rectangle((-0.03, 0), (0.05, 0.05)), -0.004)),
        Conductor("island", Role.FLOATING, sheet(rectangle((-0.03, -0.045), (0.03, 0.02)))),
    )
    return Design(
        "crooked", flat.domain, (*flat.electrodes, tilted), (layer,), conductors
    )  # fmt: skip


@pytest.fixture(scope="module", params=["three_stripes", "crooked"])
def sim(request, simulators) -> cs.Simulator:
    design = crooked() if request.param == "crooked" else request.param
    return simulators(design, settings=COARSE, **TIGHT)


def random_turn(rng: np.random.Generator) -> tuple[float, ...]:
    turn = rng.normal(size=4)
    return tuple(turn / np.linalg.norm(turn))


def assert_agree(sim: cs.Simulator, scene: cs.Scene) -> None:
    """All terminals, before the design's own floating conductors are eliminated."""
    expected = reference_delta(sim.background, scene)
    got, _, _, _ = sim._solver.solve(scene)
    largest = np.abs(expected).max()
    np.testing.assert_allclose(got, expected, rtol=0, atol=WITHIN * largest + 2e-21)


@pytest.mark.parametrize(
    "body",
    [
        bar(0.02), bar(0.001), bar(0.0), bar(0.03, grounding="floating"),
        bar(0.03, grounding=1e-12), bar(0.01, material="glass"),
        ball(), ball(grounding="floating"), ball(material="glass"), ball(z=0.0), ball(radius=1.0),
        cs.Body(cs.Box((0.2, 0.2, 1e-5)), cs.Pose((0, 0, 0.03))),
        cs.Body(cs.Box((0.2, 1e-5, 0.2)), cs.Pose((0, 0.001, 0.03)), grounding="floating"),
        cs.Body(wedge(), cs.Pose((0.01, 0.0, 0.02), (0.3, 0.1, 0.2, 0.9))),
        cs.Body(wedge(), cs.Pose((0.01, 0.0, 0.02), (0.3, 0.1, 0.2, 0.9)), "glass"),
    ],
    ids=lambda b: f"{type(b.shape).__name__}-{b.material.name}-{b.grounding}",
)  # fmt: skip
def test_single_bodies(sim, body):
    """Differential: far, touching, covering, thin, dielectric, floating."""
    sim.reset()
    assert_agree(sim, cs.Scene([body]))


def test_layers_of_matter(sim):
    """Differential: dielectrics in front of, behind, between and around conductors."""
    sheets = [
        cs.Body(cs.Box((0.1, 0.1, 0.004)), cs.Pose((0, 0, z)), material, grounding)
        for z, material, grounding in (
            (0.010, "glass", "grounded"), (0.014, "steel", "floating"),
            (0.018, "glass", "grounded"), (0.0225, "steel", 1e-12), (0.03, "steel", "grounded"),
        )
    ]  # fmt: skip
    around = cs.Body(cs.Box((0.14, 0.14, 0.05)), cs.Pose((0, 0, 0.03)), "glass")
    sim.reset()
    for count in range(1, len(sheets) + 1):
        assert_agree(sim, cs.Scene(sheets[:count]))
        assert_agree(sim, cs.Scene([around, *sheets[:count]]))


@pytest.mark.parametrize("seed", range(3))
def test_matter_around_what_conducts_through_the_sheets(sim, seed):
    """Differential: where matter fills more of a column than the conductor at a node in it."""
    rng = np.random.default_rng(seed)
    place = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(-0.01, 0.01)])
    grounding = ("grounded", "floating", 1e-12)[seed]
    metal = cs.Body(wedge(), cs.Pose(tuple(place), random_turn(rng)), "steel", grounding)
    matter = cs.Body(cs.Box((0.04, 0.06, 0.1)), cs.Pose(tuple(place), random_turn(rng)), "glass")
    sim.reset()
    assert_agree(sim, cs.Scene([matter, metal]))


@pytest.mark.parametrize("seed", range(8))
def test_random_scenes(sim, seed):
    """Differential: random scenes, warm-started ones included."""
    rng = np.random.default_rng(seed)
    sim.reset()
    for _ in range(2):
        assert_agree(sim, random_scene(rng))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 120))
def test_hundreds_of_random_scenes(sim, seed):
    """Differential: as above."""
    rng = np.random.default_rng(seed)
    for _ in range(10):
        assert_agree(sim, random_scene(rng))


def test_an_empty_scene_changes_nothing(sim):
    """Invariant: the twin agrees that nothing is nothing."""
    np.testing.assert_allclose(reference_delta(sim.background, cs.Scene()), 0.0, atol=1e-24)
