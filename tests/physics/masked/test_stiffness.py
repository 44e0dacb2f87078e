"""P1 stiffness and the capacitances of the masked scheme, against analytic solutions."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from numpy.typing import ArrayLike, NDArray
from p1_twin import capacitance_p1, link_weights, stiffness

from capsense.constants import EPS0
from capsense.errors import FieldError, MeshError
from capsense.masked import MeshSensor
from capsense.masked.solver import MaskedSolver, StiffnessMap, gradients
from capsense.mesh import TetMesh, kuhn_tets


def crooked(seed: int = 1) -> TetMesh:
    """A lattice with shifted inner nodes."""
    rng = np.random.default_rng(seed)
    mesh = kuhn_tets(np.linspace(0, 1, 5), np.linspace(0, 0.8, 4), np.linspace(0, 1.2, 6))
    points = mesh.points.copy()
    inner = np.setdiff1d(np.arange(mesh.n_points), mesh.node_groups["ground"])
    points[inner] += rng.uniform(-0.05, 0.05, (len(inner), 3))
    return TetMesh(points, mesh.tets)


def faces(mesh: TetMesh, axis: int, low: str, high: str) -> TetMesh:
    """The mesh with the two outer faces across an axis as its only node groups."""
    at = mesh.points[:, axis]
    ends = {low: np.flatnonzero(at == at.min()), high: np.flatnonzero(at == at.max())}
    return TetMesh(mesh.points, mesh.tets, ends)


def solved(
    mesh: TetMesh, eps_r: ArrayLike, electrodes: list[str], ground: list[str], solver: str = "lu"
) -> NDArray[np.float64]:
    """Maxwell matrix [F] of a mesh without bodies, by the masked scheme."""
    sensor = MeshSensor(mesh, electrodes, ground, eps_r)
    masked = MaskedSolver(sensor, solver=solver, tolerance=1e-10)  # type: ignore[arg-type]
    return masked.step(np.full(mesh.n_tets, -1), [])


def test_gradients_reproduce_linear_functions():
    mesh = crooked()
    slope = np.array([2.0, -3.0, 0.5])
    values = mesh.points @ slope + 4.0
    grads, volumes = gradients(mesh.points, mesh.tets)
    np.testing.assert_allclose(
        np.einsum("kad,ka->kd", grads, values[mesh.tets]), np.tile(slope, (mesh.n_tets, 1))
    )
    np.testing.assert_allclose(volumes, mesh.volumes, rtol=1e-12)
    np.testing.assert_allclose(grads.sum(axis=1), 0.0, atol=1e-12)


def test_stiffness_is_a_laplacian_with_the_dirichlet_energy():
    mesh = crooked()
    eps_r = np.random.default_rng(0).uniform(1.0, 80.0, mesh.n_tets)
    matrix = stiffness(mesh, eps_r)
    scale = abs(matrix).max()
    assert abs(matrix - matrix.T).max() < 1e-14 * scale
    assert np.abs(matrix.sum(axis=1)).max() < 1e-13 * scale
    slope = np.array([2.0, -3.0, 0.5])
    phi = mesh.points @ slope
    energy = EPS0 * float(eps_r @ mesh.volumes) * float(slope @ slope)
    assert phi @ (matrix @ phi) == approx(energy, rel=1e-12)
    weights = link_weights(mesh, eps_r)
    a, b = mesh.edges.T
    np.testing.assert_allclose(weights, -np.asarray(matrix[a, b]).ravel(), atol=1e-14 * scale)


def test_stiffness_scales_with_length_and_permittivity():
    mesh = crooked()
    double = TetMesh(2 * mesh.points, mesh.tets)
    twice = 2 * link_weights(mesh)
    np.testing.assert_allclose(link_weights(double), twice, atol=1e-14 * twice.max())
    triple = 3 * link_weights(mesh)
    np.testing.assert_allclose(link_weights(mesh, 3.0), triple, atol=1e-14 * triple.max())


def test_maps_agree_with_assembly():
    mesh = crooked()
    eps_r = np.random.default_rng(2).uniform(1.0, 80.0, mesh.n_tets)
    maps = StiffnessMap(mesh)
    reference = stiffness(mesh, eps_r)
    scale = abs(reference).max()
    assert abs(maps.matrix(maps.assemble(eps_r)) - reference).max() < 1e-14 * scale


def test_residual_update_equals_fresh_assembly():
    mesh = crooked()
    rng = np.random.default_rng(3)
    maps = StiffnessMap(mesh)
    eps_r = np.ones(mesh.n_tets)
    data = maps.assemble(eps_r)
    for _ in range(20):
        cells = rng.choice(mesh.n_tets, 30, replace=False)
        new = rng.uniform(1.0, 80.0, 30)
        maps.update(data, cells, new - eps_r[cells])
        eps_r[cells] = new
    np.testing.assert_allclose(data, maps.assemble(eps_r), atol=1e-13 * np.abs(data).max())


@pytest.mark.parametrize("solver", ["lu", "cg"])
def test_parallel_plates_with_two_layers_are_exact(solver):
    """Analytic: layers in series. P1 holds the exact solution, so only rounding is left."""
    mesh = faces(kuhn_tets([0, 0.1, 0.3], [0, 0.2, 0.4], [0, 0.01, 0.02, 0.05]), 2, "low", "high")
    eps_r = np.where(mesh.centroids[:, 2] < 0.02, 4.0, 1.0)
    exact = EPS0 * 0.3 * 0.4 / (0.02 / 4.0 + 0.03)
    matrix = solved(mesh, eps_r, ["low", "high"], [], solver)
    np.testing.assert_allclose(matrix, exact * np.array([[1, -1], [-1, 1]]), rtol=1e-9)
    grounded = solved(mesh, eps_r, ["high"], ["low"], solver)
    assert grounded.item() == approx(exact, rel=1e-9)


def sphere_sector(n: int, inner: float = 0.04, outer: float = 0.1) -> TetMesh:
    """A sixth of a spherical shell: a lattice in two angles and the logarithm of the radius."""
    angle = np.linspace(-np.pi / 4, np.pi / 4, n + 1)
    lattice = kuhn_tets(angle, angle, np.linspace(np.log(inner), np.log(outer), n + 1))
    a, b, log_r = lattice.points.T
    direction = np.stack([np.tan(a), np.tan(b), np.ones_like(a)], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ends = faces(lattice, 2, "inner", "outer").node_groups
    return TetMesh(direction * np.exp(log_r)[:, None], lattice.tets, ends)


def coax_sector(n: int, inner: float = 0.01, outer: float = 0.03) -> TetMesh:
    """A quarter of a coaxial line, 50 mm long."""
    lattice = kuhn_tets(
        np.linspace(0, np.pi / 2, n + 1),
        np.linspace(0, 0.05, 3),
        np.linspace(np.log(inner), np.log(outer), n + 1),
    )
    angle, along, log_r = lattice.points.T
    points = np.stack([np.exp(log_r) * np.cos(angle), np.exp(log_r) * np.sin(angle), along], 1)
    return TetMesh(points, lattice.tets, faces(lattice, 2, "inner", "outer").node_groups)


@pytest.mark.parametrize(
    ("sector", "exact"),
    [
        # Analytic: 4π ε0 ab/(b − a), a sixth of it; and 2π ε0 l / ln(b/a), a quarter of it.
        (sphere_sector, 4 * np.pi * EPS0 * 0.04 * 0.1 / 0.06 / 6),
        (coax_sector, 2 * np.pi * EPS0 * 0.05 / np.log(3) / 4),
    ],
)
def test_capacitance_converges_with_the_square_of_the_element_size(sector, exact):
    sizes = np.array([4, 8, 16])
    errors = []
    for n in sizes:
        mesh = sector(int(n))
        errors.append(solved(mesh, 1.0, ["inner"], ["outer"]).item() / exact - 1)
    rates = np.diff(np.log(np.abs(errors))) / np.diff(np.log(1 / sizes))
    assert ((rates > 1.8) & (rates < 2.2)).all(), rates
    # Energies bound it from above; measured 1.21e-3 and 1.15e-3 at n = 16.
    assert 0.0009 < errors[-1] < 0.0016, errors


def test_dielectric_shell_of_a_sphere():
    """Analytic: an eps_r = 4 shell from 40 to 60 mm, air to 100 mm, in series."""
    mesh = sphere_sector(12)
    # Lattice planes are logarithmic: the shell ends at the plane nearest to 60 mm.
    radii = np.exp(np.linspace(np.log(0.04), np.log(0.1), 13))
    edge = radii[np.argmin(np.abs(radii - 0.06))]
    layer = np.arange(mesh.n_tets) // 6 % 12
    eps_r = np.where(radii[layer + 1] <= edge * (1 + 1e-9), 4.0, 1.0)
    series = (1 / 0.04 - 1 / edge) / 4.0 + (1 / edge - 1 / 0.1)
    exact = 4 * np.pi * EPS0 / series / 6
    got = solved(mesh, eps_r, ["inner"], ["outer"]).item()
    # Measured 2.1e-3.
    assert 0.001 < got / exact - 1 < 0.004


def test_three_electrodes_make_a_maxwell_matrix():
    lattice = kuhn_tets(*(np.linspace(0, 1, 9),) * 3)
    at = lattice.points
    inside = ((at > 0.2) & (at < 0.8)).all(axis=1) & (np.abs(at[:, 2] - 0.25) < 1e-9)
    strips = {
        f"E{i}": np.flatnonzero(inside & (np.abs(at[:, 0] - x) < 0.01))
        for i, x in enumerate((0.25, 0.5, 0.75))
    }
    mesh = lattice.with_groups(node_groups=strips)
    eps_r = np.random.default_rng(5).uniform(1.0, 20.0, mesh.n_tets)
    matrix = solved(mesh, eps_r, list(strips), ["ground"])
    np.testing.assert_allclose(matrix, capacitance_p1(mesh, eps_r, list(strips)), rtol=1e-9)
    iterated = solved(mesh, eps_r, list(strips), ["ground"], "cg")
    np.testing.assert_allclose(iterated, matrix, rtol=1e-9)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert (matrix[~np.eye(3, dtype=bool)] < 0).all()
    assert (matrix.sum(axis=1) > 0).all()
    swapped = solved(mesh, eps_r, ["E2", "E0", "E1"], ["ground"])
    np.testing.assert_allclose(swapped, matrix[np.ix_([2, 0, 1], [2, 0, 1])], rtol=1e-9)
    more = solved(mesh, 1.5 * eps_r, list(strips), ["ground"])
    np.testing.assert_allclose(more, 1.5 * matrix, rtol=1e-9)


def test_wrong_input_is_refused():
    mesh = faces(crooked(), 0, "low", "high").with_groups(node_groups={"none": []})
    with pytest.raises(FieldError, match="eps_r must be a number or have shape"):
        solved(mesh, np.ones(3), ["low"], ["high"])
    for eps_r in (0.0, -1.0, np.nan, np.inf, np.where(np.arange(mesh.n_tets) == 7, -2.0, 1.0)):
        with pytest.raises(FieldError, match="positive and finite"):
            solved(mesh, eps_r, ["low"], ["high"])
    with pytest.raises(MeshError, match="no node group 'E1'"):
        solved(mesh, 1.0, ["E1"], ["high"])
    with pytest.raises(MeshError, match="'none' is empty"):
        solved(mesh, 1.0, ["none"], ["high"])
    with pytest.raises(MeshError, match="'high' shares 24 nodes"):
        solved(mesh, 1.0, ["low", "high"], ["high"])
    with pytest.raises(MeshError, match="at least one electrode"):
        solved(mesh, 1.0, [], ["high"])
