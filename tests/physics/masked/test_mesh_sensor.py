"""A simulator on a mesh of the user's own: the published mesh, layers, boundary values."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
from approximate import approx
from p1_twin import capacitance_p1
from scipy.spatial import Delaunay

import capsense as cs
from capsense.constants import EPS0
from capsense.errors import FieldError, MeshError, RecordingError
from capsense.masked import MeshSensor
from capsense.mesh import TetMesh, kuhn_tets, load_mesh

PUBLISHED = Path(__file__).parents[2] / "data/published_meshes/mesh_data_3stripe_electrodes.mat"
BAR = cs.Scene([cs.Body(cs.Box((0.15, 0.15, 0.02)), cs.Pose((0, 0, 0.06)))])


def plates(n: int = 5) -> TetMesh:
    """A block of 40 × 40 × 20 mm with a plate below and one above; its sides are free."""
    line = np.linspace(-0.02, 0.02, n)
    mesh = kuhn_tets(line, line, np.linspace(0, 0.02, n))
    z = mesh.points[:, 2]
    groups = {"low": np.flatnonzero(z == 0), "high": np.flatnonzero(z == 0.02)}
    lower = {"lower half": np.flatnonzero(mesh.centroids[:, 2] < 0.01)}
    return TetMesh(mesh.points, mesh.tets, groups, lower)


def test_the_published_mesh() -> None:
    """As published, once it is moved to the sensor frame; a bar is seen as by the solver itself."""
    mesh = load_mesh(PUBLISHED)
    with pytest.raises(MeshError, match=r"use mesh\.moved\(\(-0\.25, -0\.25, -0\.0025\)\)"):
        cs.Simulator(mesh=mesh)
    mesh = mesh.moved((-0.25, -0.25, -0.0025))
    sim = cs.Simulator(mesh=mesh, method="fem_masked")
    assert sim.electrode_names == ("E1", "E2", "E3")
    np.testing.assert_allclose(
        sim.baseline, capacitance_p1(mesh, 1.0, sim.electrode_names), rtol=1e-6, atol=1e-18
    )
    delta = sim.step(BAR).delta
    assert (np.diag(delta) > 0).all()
    np.testing.assert_array_equal(sim.copy().step(BAR).delta, delta)
    for twin in (pickle.loads(pickle.dumps(sim.mesh)), copy.deepcopy(sim.mesh)):
        np.testing.assert_array_equal(cs.Simulator(mesh=twin).step(BAR).delta, delta)
    assert sim.describe()["tetrahedra"] == mesh.n_tets


def test_electrodes_of_a_mesh_as_a_design() -> None:
    """Analytic: the stripes of the published mesh are rectangles of 100 × 20 mm at z = 0."""
    design = MeshSensor(load_mesh(PUBLISHED).moved((-0.25, -0.25, -0.0025))).design
    for electrode, y in zip(design.electrodes, (-0.03, 0.0, 0.03), strict=True):
        expected = [[-0.05, y - 0.01, 0], [0.05, y + 0.01, 0]]
        np.testing.assert_allclose(electrode.surface.bounds, expected, atol=1e-12)
        assert electrode.surface.area == approx(2e-3)
    np.testing.assert_allclose(design.domain.lower, (-0.25, -0.25, -0.0025))
    np.testing.assert_allclose(design.domain.upper, (0.25, 0.25, 0.4975))


def test_plate_capacitor() -> None:
    """Analytic: eps A / d; two layers in series; both plates driven, nothing at ground."""
    mesh = plates()
    ideal = EPS0 * 0.04**2 / 0.02
    one = cs.Simulator(mesh=MeshSensor(mesh, ["high"], ["low"]))
    assert one.baseline[0, 0] == approx(ideal, rel=1e-9)
    eps = mesh.cell_values({"lower half": 3.0})
    two = cs.Simulator(mesh=MeshSensor(mesh, ["high"], ["low"], eps))
    assert two.baseline[0, 0] == approx(1.5 * ideal, rel=1e-6)
    both = cs.Simulator(mesh=MeshSensor(mesh, ground=()))
    assert both.electrode_names == ("low", "high")
    np.testing.assert_allclose(both.baseline, ideal * np.array([[1, -1], [-1, 1]]), rtol=1e-9)


def test_own_boundary_values() -> None:
    """Analytic: the whole boundary at φ = x + 1 has the energy ε0 V |∇φ|² of that field."""
    mesh = plates()
    at = mesh.points
    rim = np.flatnonzero((np.abs(at[:, :2]).max(axis=1) > 0.0199) | (at[:, 2] % 0.02 == 0))
    mesh = mesh.with_groups(node_groups={"wall": rim})
    x = 100 * at[mesh.node_groups["wall"], 0]
    sim = cs.Simulator(mesh=MeshSensor(mesh, ["wall"], (), profiles={"wall": x + 2}))
    assert sim.baseline[0, 0] == approx(EPS0 * 0.04**2 * 0.02 * 100**2, rel=1e-9)


def test_an_empty_scene_changes_nothing_on_a_poor_mesh() -> None:
    """Invariant: links of negative weight may turn the sign of a coupling; it stays as it is."""
    rng = np.random.default_rng(5)
    corners = np.array(np.meshgrid(*[[-0.1, 0.1]] * 3)).reshape(3, 8).T
    points = np.concatenate([corners, rng.uniform(-0.1, 0.1, (60, 3))])
    tets = Delaunay(points).simplices
    sides = points[tets[:, 1:]] - points[tets[:, :1]]
    tets = tets[np.abs(np.linalg.det(sides)) > 1e-9]
    groups = {"ground": np.arange(8), "a": [10], "b": [20], "c": [30]}
    sim = cs.Simulator(mesh=TetMesh(points, tets, groups))
    assert sim.baseline[0, 1] > 1e-14
    np.testing.assert_allclose(sim.step(cs.Scene()).delta, 0.0, atol=1e-18)


@pytest.mark.parametrize(
    ("profiles", "message"),
    [
        ({"high": [1.0, 2.0]}, r"has shape \(2,\); give one potential for each of the group's 25"),
        ({"high": -1.0}, "drive the electrode with a negative voltage"),
        ({"high": np.nan}, "must be finite"),
        ({"top": 1.0}, r"'top' is of no electrode; there are \['high'\]"),
    ],
)
def test_wrong_profiles(profiles: dict, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        cs.Simulator(mesh=MeshSensor(plates(), ["high"], ["low"], profiles=profiles))


def test_refusals(tmp_path: Path) -> None:
    """What does not go together is said, with what does."""
    mesh = plates()
    with pytest.raises(MeshError, match="no node group 'ground'; it has: low, high"):
        cs.Simulator(mesh=mesh)
    with pytest.raises(ValueError, match='"fem_masked"'):
        cs.Simulator(mesh=mesh, method="surface")
    with pytest.raises(ValueError, match="either a design or mesh"):
        cs.Simulator("six_patch", mesh=mesh)
    with pytest.raises(MeshError, match="give a TetMesh, as load_mesh returns"):
        cs.Simulator(mesh="stripes.mat")
    sim = cs.Simulator(mesh=MeshSensor(mesh, ["high"], ["low"]))
    with pytest.raises(FieldError, match="see its baseline"):
        _ = sim.background
    with pytest.raises(RecordingError, match="on a mesh cannot be recorded"):
        cs.record(tmp_path / "a.mcap", sim)


def test_groups_that_make_no_sheet() -> None:
    """A lone node, and a block of nodes, are electrodes as well; only sheets have a surface."""
    mesh = plates()
    at = mesh.points
    block = np.flatnonzero((np.abs(at) < 0.0101).all(axis=1) & (at[:, 2] > 0.001))
    mesh = mesh.with_groups(node_groups={"pin": [0], "block": block})
    sim = cs.Simulator(mesh=MeshSensor(mesh, ["pin", "block"], ["high"]))
    assert (np.diag(sim.baseline) > 0).all()
    pin, solid = (e.surface for e in sim.design.electrodes)
    assert not pin.facets
    assert solid.facets
