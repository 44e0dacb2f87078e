"""The field around dielectric parts that are no upright boxes, held against closed forms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from approximate import approx
from scipy.special import eval_legendre

import capsense as cs
from capsense.constants import EPS0
from capsense.design import parse_design
from capsense.field.background import build_background
from capsense.field.boundary import INTERFACE, Accuracy, BoundarySolution, build_model
from capsense.field.green_points import GreenSettings, Surroundings, reachable_points

Array = np.ndarray
OPEN = {"size": [0.5, 0.5, 0.5], "backplane": 0.25, "open": True}
DISC = {"name": "E", "shape": "disc", "radius": 0.01}
INNER, OUTER = 0.010, 0.016


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Polyhedra of 320 faces with the volume of balls of the two radii [mm]."""
    folder = tmp_path_factory.mktemp("balls")
    for name, radius in (("inner", INNER), ("outer", OUTER)):
        ball = trimesh.creation.icosphere(2, 1.0)
        ball.apply_scale(1e3 * radius * (4 / 3 * math.pi / ball.volume) ** (1 / 3))
        ball.export(folder / f"{name}.stl")
    return folder


def solved(
    data: dict[str, Any], folder: Path | None = None, scale: float = 1.0
) -> BoundarySolution:
    design = parse_design({"name": "part", "domain": OPEN, **data}, folder=folder)
    return BoundarySolution(design, Accuracy(scale, fitted=False))


def capacitance(solution: BoundarySolution) -> Array:
    """Maxwell matrix [F]."""
    return solution.terminal_charges(solution.densities(np.eye(solution.model.n_terminals)))


@pytest.mark.parametrize("eps_r", [3.0, 80.0])
def test_coated_ball(balls, eps_r):
    """Two shells in series: 4π eps0 / (1/(ε a) − 1/(ε b) + 1/b); measured: within 0.01 %.

    Matter of a high permittivity must not gain a charge: with fluxes by quadrature it did, and
    the capacitance was 1 % too large with eps_r 3, 71 % with 80.
    """
    ball = {"shape": "stl", "unit": "mm"}
    solution = solved(
        {
            "electrode": [{"name": "E", **ball, "file": "inner.stl"}],
            "layer": [{"name": "coat", **ball, "file": "outer.stl", "eps_r": eps_r}],
        },
        balls,
    )
    series = (1 / INNER - 1 / OUTER) / eps_r + 1 / OUTER
    assert capacitance(solution)[0, 0] == approx(4 * math.pi * EPS0 / series, rel=1e-3)


def test_charge_beside_a_dielectric_ball(balls):
    """Böttcher, Theory of Electric Polarization I (1973), section 21: the ball's potential

    −Σ n (ε−1) / (n (ε+1) + 1) R^(2n+1) / (r d)^(n+1) P_n(cos θ) with 4π eps0 = 1.
    """
    eps_r, gap = 5.0, 0.012
    solution = solved(
        {
            "electrode": [{**DISC, "radius": 1e-5, "center": [0.2, 0.2, 0.2]}],
            "layer": [
                {"name": "b", "shape": "stl", "unit": "mm", "file": "outer.stl", "eps_r": eps_r}
            ],
        },
        balls,
    )
    d = OUTER + gap
    points = d * np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.0, 0.0, -1.0]])
    found = solution.potential(points, solution.densities(np.zeros((1, 1)), points[:1]))[:, 0]
    n = np.arange(200)[:, None]
    terms = n * (eps_r - 1) / (n * (eps_r + 1) + 1) * np.exp((2 * n + 1) * np.log(OUTER / d)) / d
    wanted = -(terms * eval_legendre(n, points[:, 2] / d)).sum(axis=0)
    assert found == approx(wanted, abs=0.02 * abs(wanted).max())


def pads_on_box(quaternion: tuple[float, ...], slab: bool = False) -> dict[str, Any]:
    """Two pads on a box of 50 x 30 x 3 mm, all turned together about the origin."""
    pose = cs.Pose((0, 0, 0), quaternion)

    def put(*place: float) -> dict[str, Any]:
        return {"center": pose.apply(np.array([place]))[0].tolist(), "quaternion": list(quaternion)}

    pad = {"shape": "rectangle", "size": [0.02, 0.02]}
    box: dict[str, Any] = {"shape": "box", "size": [0.05, 0.03, 0.003], **put(0, 0, -0.0015)}
    if slab:
        box = {"size": [0.05, 0.03], "z": [-0.003, 0.0]}
    return {
        "electrode": [
            {"name": name, **pad, **put(x, 0, 0)} for name, x in (("A", -0.012), ("B", 0.012))
        ],
        "layer": [{"name": "box", "eps_r": 4.0, **box}],
    }


UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TURNED = tuple(np.array([0.3, -0.5, 0.2, 0.7]) / np.linalg.norm([0.3, -0.5, 0.2, 0.7]))


def test_turned_box_reads_as_the_upright_one():
    upright, turned, slab = (
        capacitance(solved(pads_on_box(*args))) for args in ((UPRIGHT,), (TURNED,), (UPRIGHT, True))
    )
    assert turned == approx(upright, rel=1e-5)
    assert slab == approx(upright, rel=0.01)


def test_faces_under_pads_are_no_interfaces():
    """What pads cover is the pads'; the rest of the box's surface is there once."""
    for turn in (UPRIGHT, TURNED):
        data = {"name": "part", "domain": OPEN, **pads_on_box(turn)}
        model = build_model(parse_design(data), Accuracy(2.0, fitted=False))
        bare = model.panels.areas[model.owner == INTERFACE].sum()
        assert bare == approx(2 * (0.05 * 0.03 + 0.003 * 0.08) - 2 * 0.02**2, rel=1e-6)
        below = model.owner >= 0
        assert model.eps_front[below] + model.eps_back[below] == approx(5.0)


def test_stacked_parts_share_one_face():
    """A disc on a box: where they touch there is one interface, from the one to the other."""
    disc = {"z": 0.0015, "eps_r": 2.0}
    data = {
        "electrode": [{**DISC, "z": -0.01}],
        "layer": [
            {"name": "a", "shape": "box", "size": [0.04, 0.04, 0.002], "z": -0.001, "eps_r": 4.0},
            {**disc, "name": "b", "shape": "cylinder", "radius": 0.01, "length": 0.003},
        ],
    }
    model = build_model(parse_design({"name": "p", "domain": OPEN, **data}), Accuracy(2.0, False))
    areas = model.panels.areas
    both = model.eps_front + model.eps_back
    assert areas[np.isclose(both, 6.0)].sum() == approx(math.pi * 1e-4, rel=6e-3)
    assert set(np.unique(both[model.owner == INTERFACE])) == {3.0, 5.0, 6.0}


def test_no_body_is_sought_in_a_part():
    """The points that the Green's function is fitted at: some in the box around it, none in it."""
    disc = {"name": "disc", "eps_r": 3.0, "shape": "cylinder", "radius": 0.02, "length": 0.02}
    tilted = {**disc, "z": 0.02, "tilt": [40, 0, 0]}
    solution = solved({"electrode": [{**DISC, "z": -0.01}], "layer": [tilted]}, scale=4.0)
    design, settings = solution.design, GreenSettings()
    surface = Surroundings(design, solution.model)
    sources = surface.sources(100, settings.near_spacing, settings.depth)
    points = reachable_points(surface, sources, surface.clearance(settings), 400)
    part = design.layers[0]
    assert ((points > part.lower) & (points < part.upper)).all(axis=1).any()
    assert not part.contains(points).any()


@pytest.mark.slow
def test_a_body_over_a_cover_that_is_a_part_reads_as_over_a_slab():
    """The Green's function: charges lie in the part, and no body is sought in it."""
    cover = {"shape": "box", "size": [0.03, 0.03, 0.004], "center": [0, 0, 0.002]}
    changes = []
    for layer in (cover, {"size": [0.03, 0.03], "z": [0.0, 0.004]}):
        data = {
            "name": "cover",
            "domain": {"size": [0.2, 0.2, 0.2], "backplane": 0.03},
            "electrode": [{"name": "E", "shape": "rectangle", "size": [0.02, 0.02]}],
            "layer": [{"name": "cover", "eps_r": 3.0, **layer}],
            "build": {"resolution": 0.25},
        }
        design = parse_design(data)
        sim = cs.Simulator(design, background=build_background(design))
        ball = cs.Body(cs.Sphere(0.01), cs.Pose((0.003, 0, 0.019)), "steel")
        changes.append(sim.step(cs.Scene([ball])).delta[0, 0])
    assert changes[0] == approx(changes[1], rel=0.01)
