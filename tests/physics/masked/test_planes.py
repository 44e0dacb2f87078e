"""The mesh of the paper's scheme: its planes, and the nodes that the sheets hold."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from field_cases import patches, rectangle, sheet

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Conductor, Design, Electrode, Layer, Role
from capsense.errors import SceneError
from capsense.field.background import MeshSettings
from capsense.masked import FREE, WALL, hold_nodes, lattice_sensor, plan_axes

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


def test_planes_follow_inner_edges_and_not_arcs() -> None:
    """An L has planes at its inner corner, also of divided edges; one of a short edge has none."""
    corner = rectangle((0.0, 0.0), (0.06, 0.06)).difference(rectangle((0.02, 0.02), (0.026, 0.026)))
    divided = shapely.segmentize(corner, 0.0015)
    notched = corner.difference(rectangle((-0.03, -0.02), (0.0016, 0.0016)))
    for shape in (corner, divided, notched):
        x, y, _ = plan_axes(patches(shape, size=0.3, backplane=0.02), MeshSettings())
        for line in (x, y):
            assert np.abs(line[:, None] - [-0.03, 0.007, 0.03]).min(axis=0).max() < 1e-9
        assert np.abs(x + 0.0292).min() > 1e-5


@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0])
def test_refined_planes_are_as_many_times_as_many(factor: float) -> None:
    plain, fine = (plan_axes(DESIGN, s) for s in (MeshSettings(), MeshSettings().refined(factor)))
    for a, b in zip(plain, fine, strict=True):
        assert 0.7 * factor < len(b) / len(a) < 1.4 * factor


def test_sheets_hold_the_nodes_on_them() -> None:
    axes = plan_axes(DESIGN, MeshSettings())
    owner = hold_nodes(DESIGN, axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    assert max(FREE, WALL) < 0, "terminals are numbered from 0 on"
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


def tilted(angle: float, center: tuple[float, float, float]) -> Electrode:
    """A sheet of 28 × 40 mm, turned about y."""
    c, s = np.cos(angle), np.sin(angle)
    axes = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    facet = Facet(rectangle((0.0, 0.0), (0.02 * 2**0.5, 0.04)), np.array(center), axes)
    corners = facet.to_sensor(np.asarray(facet.polygon.exterior.coords))
    return Electrode("T", Surface((facet,), np.stack([corners[:-1], corners[1:]], axis=1)))


def test_a_tilted_sheet_holds_the_nodes_it_goes_through() -> None:
    """One at 45° goes through nodes (k, j, k) of a cubic grid."""
    line = np.linspace(-0.03, 0.03, 13)
    design = Design("tilted", DESIGN.domain, (tilted(np.pi / 4, (0.0, 0.0, 0.0)),))
    i, _, k = np.nonzero(hold_nodes(design, (line, line, line)) == 0)
    np.testing.assert_array_equal(i, k)
    assert (np.abs(line[i]) < 0.0101).all()
    assert len(i) == 5 * 9


def test_an_electrode_without_nodes_is_named() -> None:
    """Edges that share a plane leave narrow strips beside it; a finer mesh has nodes on both."""
    strips = (rectangle((5e-5, 0.0), (1e-4, 0.02)), rectangle((6.75e-4, 0.0), (1.5e-4, 0.02)))
    design = patches(*strips, size=0.1, backplane=0.02)
    with pytest.raises(SceneError, match=r"'E1' has none: raise \[build\] resolution"):
        lattice_sensor(design, ("E1", "E2"), MeshSettings())
    owner = hold_nodes(design, plan_axes(design, MeshSettings().refined(2.0)))
    assert {0, 1} <= set(owner.ravel().tolist())
