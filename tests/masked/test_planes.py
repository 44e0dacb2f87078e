"""The mesh of the paper's scheme: its planes, and the nodes that the sheets hold."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import patches, rectangle, sheet

import capsense as cs
from capsense.design.model import Conductor, Layer, Role
from capsense.errors import SceneError
from capsense.field.background import BuildSettings
from capsense.masked.held_nodes import FREE, WALL, hold_nodes
from capsense.masked.planes import plan_axes
from capsense.masked.scenes import MaskedScenes
from capsense.mesh.settings import MeshSettings

DESIGN = patches(
    rectangle((-0.03, 0.0), (0.04, 0.05)), rectangle((0.03, 0.0), (0.03, 0.03)),
    size=0.3, backplane=0.02,
    layers=(
        Layer("plate", "glass", 5.0, np.array([-0.06, -0.04, -0.004]), np.array([0.06, 0.04, 0])),
    ),
    conductors=(
        Conductor("pour", Role.GROUND, sheet(rectangle((0.0, 0.06), (0.1, 0.02)))),
        Conductor("guard", Role.SHIELD, sheet(rectangle((0.0, 0.0), (0.1, 0.06)), -0.004)),
    ),
)  # fmt: skip


def test_planes_follow_edges_and_faces() -> None:
    x, y, z = plan_axes(DESIGN, MeshSettings())
    for line, wanted in (
        (x, (-0.15, -0.06, -0.05, -0.01, 0.015, 0.045, 0.06, 0.15)),
        (y, (-0.15, -0.04, -0.025, -0.015, 0.015, 0.025, 0.05, 0.07, 0.15)),
        (z, (-0.02, -0.004, 0.0, 0.28)),
    ):
        assert (np.diff(line) > 0).all()
        assert np.abs(line[:, None] - wanted).min(axis=0).max() < 1e-9


@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0])
def test_refined_planes_are_as_many_times_as_many(factor: float) -> None:
    plain, fine = (plan_axes(DESIGN, s) for s in (MeshSettings(), MeshSettings().refined(factor)))
    for a, b in zip(plain, fine, strict=True):
        assert 0.7 * factor < len(b) / len(a) < 1.4 * factor


def test_sheets_hold_the_nodes_on_them() -> None:
    axes = plan_axes(DESIGN, MeshSettings())
    owner = hold_nodes(DESIGN, axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    expected = np.full(owner.shape, FREE)
    for who, (body, level) in enumerate(
        [*((e, 0.0) for e in DESIGN.electrodes), (DESIGN.conductors[1], -0.004)]
    ):
        low, high = body.surface.bounds[:, :2]
        on = ((points[..., :2] > low - 1e-7) & (points[..., :2] < high + 1e-7)).all(axis=-1)
        expected[on & (np.abs(points[..., 2] - level) < 1e-9)] = who
    pour = DESIGN.conductors[0].surface.bounds[:, :2]
    on = ((points[..., :2] > pour[0] - 1e-7) & (points[..., :2] < pour[1] + 1e-7)).all(axis=-1)
    expected[on & (np.abs(points[..., 2]) < 1e-9)] = WALL
    for axis in range(3):
        for end in (0, -1):
            np.moveaxis(expected, axis, 0)[end] = WALL
    np.testing.assert_array_equal(owner, expected)


def test_a_tilted_sheet_holds_the_nodes_it_goes_through() -> None:
    """A plane at 45° goes through nodes (k, j, k) of a cubic grid."""
    from capsense.design.geometry import Facet, Surface
    from capsense.design.model import Design, Electrode

    half = np.sqrt(0.5)
    turn = np.array([[half, 0, half], [0, 1, 0], [-half, 0, half]])
    facet = Facet(rectangle((0.0, 0.0), (0.02 / half, 0.04)), np.zeros(3), turn)
    tilted = Electrode("T", Surface((facet,), np.zeros((0, 2, 3))))
    line = np.linspace(-0.03, 0.03, 13)
    owner = hold_nodes(Design("tilted", DESIGN.domain, (tilted,)), (line, line, line))
    i, _, k = np.nonzero(owner == 0)
    np.testing.assert_array_equal(i, k)
    assert (np.abs(line[i]) < 0.0101).all()
    assert len(i) == 5 * 9


def test_an_electrode_without_nodes_is_named() -> None:
    """The sheets of a bent design meet no nodes but by chance."""
    sim = cs.Simulator("arm_segment")
    with pytest.raises(SceneError, match=r"'.+' has none: raise \[build\] resolution"):
        MaskedScenes(sim.design, sim.background, BuildSettings(), 250e3)
