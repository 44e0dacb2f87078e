"""The paper's scheme: masks, residual update, full solve."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from p1_twin import capacitance_p1

from capsense.errors import FieldError, SolveError
from capsense.masked import MeshSensor
from capsense.masked.solver import GROUNDED, MaskedSolver, MaskedStats
from capsense.mesh import TetMesh, kuhn_tets

STRIPES = ("E1", "E2", "E3")


def box(mesh: TetMesh, low: tuple[float, ...], high: tuple[float, ...]) -> NDArray[np.bool_]:
    """Tetrahedra whose centroid lies in a box [m]."""
    return ((mesh.centroids > low) & (mesh.centroids < high)).all(axis=1)


@pytest.fixture(scope="module")
def mesh() -> TetMesh:
    """Three stripes of 100 mm × 20 mm, 10 mm over the floor of a 200 mm box."""
    lattice = kuhn_tets(
        np.linspace(-0.1, 0.1, 9), np.linspace(-0.1, 0.1, 21), np.linspace(-0.01, 0.19, 21)
    )
    x, y, z = lattice.points.T
    in_plane = (np.abs(z) < 1e-9) & (np.abs(x) < 0.0501)
    stripes = {
        name: np.flatnonzero(in_plane & (np.abs(y - at) < 0.0101))
        for name, at in zip(STRIPES, (-0.03, 0.0, 0.03), strict=True)
    }
    return lattice.with_groups(node_groups=stripes)


@pytest.fixture(scope="module")
def bar(mesh) -> NDArray[np.int64]:
    """A bar 30 mm above the stripes: 0 inside, −1 outside."""
    return np.where(box(mesh, (-0.075, -0.05, 0.03), (0.075, 0.05, 0.05)), 0, -1)


def assert_physical(matrix: NDArray[np.float64]) -> None:
    np.testing.assert_array_equal(matrix, matrix.T)
    rounding = 1e-14 * matrix.max()
    assert (matrix[~np.eye(len(matrix), dtype=bool)] <= rounding).all()
    assert (matrix.sum(axis=1) >= -rounding).all()


@pytest.mark.parametrize("solver", ["cg", "lu"])
def test_domain_without_a_free_node(mesh, solver):
    """Limits: with a conductor everywhere there is nothing to solve, and nothing is left."""
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), solver=solver)
    assert_physical(masked.step(np.zeros(mesh.n_tets, int), [GROUNDED]))
    assert (masked.stats.iterations, masked.stats.residual) == (0, 0.0)
    assert set(np.unique(masked.potentials)) == {0.0, 1.0}


@pytest.mark.parametrize("solver", ["cg", "lu"])
def test_empty_domain_is_the_reference(mesh, solver):
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), solver=solver)
    got = masked.step(np.full(mesh.n_tets, -1), [])
    reference = capacitance_p1(mesh, 1.0, STRIPES)
    np.testing.assert_allclose(got, reference, atol=1e-8 * reference.max())
    assert masked.stats.changed_cells == 0


@pytest.mark.parametrize("solver", ["cg", "lu"])
def test_grounded_bar_shields(mesh, bar, solver):
    """Differential: the same mask solved by the reference with the bar's nodes on ground."""
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), solver=solver)
    empty = masked.step(np.full(mesh.n_tets, -1), [])
    near = masked.step(bar, [GROUNDED])
    assert_physical(near)
    assert (np.diag(near) > 1.01 * np.diag(empty)).all()
    off = ~np.eye(3, dtype=bool)
    assert (np.abs(near[off]) < 0.99 * np.abs(empty[off])).all()
    with_bar = mesh.with_groups(node_groups={"bar": np.unique(mesh.tets[bar == 0])})
    reference = capacitance_p1(with_bar, 1.0, STRIPES, ("ground", "bar"))
    np.testing.assert_allclose(near, reference, atol=1e-8 * reference.max())
    expected = len(with_bar.node_groups["bar"])
    assert masked.stats.grounded_nodes == expected
    assert (masked.potentials[with_bar.node_groups["bar"]] == 0).all()


@pytest.mark.parametrize("eps_r", [3.0, 80.0, 1e4])
def test_dielectric_bar_matches_the_reference(mesh, bar, eps_r):
    masked = MaskedSolver(MeshSensor(mesh, STRIPES))
    got = masked.step(bar, [eps_r])
    assert_physical(got)
    reference = capacitance_p1(mesh, np.where(bar == 0, eps_r, 1.0), STRIPES)
    np.testing.assert_allclose(got, reference, atol=1e-8 * reference.max())
    assert masked.stats.changed_cells == (bar == 0).sum()
    assert masked.stats.residual <= 1e-5
    empty = masked.step(np.full(mesh.n_tets, -1), [])
    assert (np.linalg.eigvalsh(got - empty) > 0).all(), "more permittivity, more energy"


def test_bodies_are_told_apart_and_background_layers_kept(mesh):
    plate = box(mesh, (-0.2, -0.2, -0.02), (0.2, 0.2, 0.0))
    background = np.where(plate, 2.9, 1.0)
    inside = np.full(mesh.n_tets, -1)
    left = box(mesh, (-0.08, -0.06, 0.02), (0.0, 0.06, 0.06))
    right = box(mesh, (0.0, -0.06, 0.02), (0.08, 0.06, 0.06))
    inside[left], inside[right] = 1, 0
    masked = MaskedSolver(MeshSensor(mesh, STRIPES, eps_r=background))
    got = masked.step(inside, [5.0, 50.0])
    eps_r = background.copy()
    eps_r[left], eps_r[right] = 50.0, 5.0
    reference = capacitance_p1(mesh, eps_r, STRIPES)
    np.testing.assert_allclose(got, reference, atol=1e-8 * reference.max())


def test_a_step_equals_a_fresh_solve_of_the_same_scene(mesh):
    """A random walk of two bodies, conductors and dielectrics, never drifts."""
    rng = np.random.default_rng(7)
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), tolerance=1e-6)
    for _ in range(25):
        inside = np.full(mesh.n_tets, -1)
        for body in (0, 1):
            low = rng.uniform((-0.08, -0.08, 0.01), (0.04, 0.04, 0.1))
            inside[box(mesh, tuple(low), tuple(low + 0.04))] = body
        properties = [float(rng.choice([2.0, 80.0, GROUNDED])), 1e3]
        walked = masked.step(inside, properties)
    fresh = MaskedSolver(MeshSensor(mesh, STRIPES), tolerance=1e-6).step(inside, properties)
    np.testing.assert_allclose(walked, fresh, atol=1e-10 * fresh.max())
    masked.reset()
    np.testing.assert_array_equal(masked.step(inside, properties), fresh)


def test_warm_start_saves_iterations(mesh, bar):
    masked = MaskedSolver(MeshSensor(mesh, STRIPES))
    masked.step(bar, [80.0])
    cold = masked.stats.iterations
    masked.step(bar, [80.0])
    assert masked.stats.iterations <= 3
    assert masked.stats.changed_cells == 0
    assert cold > 20


def test_without_a_warm_start_every_step_is_the_first(mesh, bar):
    """Invariant: same iterations and result, whatever was solved before."""
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), warm_start=False)
    first, iterations = masked.step(bar, [80.0]), masked.stats.iterations
    masked.step(np.full(mesh.n_tets, -1), [])
    np.testing.assert_allclose(masked.step(bar, [80.0]), first, rtol=1e-12)
    assert abs(masked.stats.iterations - iterations) <= 1
    np.testing.assert_allclose(
        first, MaskedSolver(MeshSensor(mesh, STRIPES)).step(bar, [80.0]), rtol=1e-7
    )


def test_an_electrode_inside_a_conductor_keeps_its_potential(mesh):
    inside = np.where(box(mesh, (-0.06, -0.045, -0.01), (0.06, -0.015, 0.01)), 0, -1)
    got = MaskedSolver(MeshSensor(mesh, STRIPES)).step(inside, [GROUNDED])
    assert_physical(got)
    assert got[0, 0] > 1.2 * got[2, 2]


def test_wrong_input_is_refused(mesh, bar):
    masked = MaskedSolver(MeshSensor(mesh, STRIPES))
    with pytest.raises(SolveError, match="inside must hold"):
        masked.step(bar[:-1], [2.0])
    with pytest.raises(SolveError, match="inside must hold"):
        masked.step(bar.astype(float), [2.0])
    with pytest.raises(SolveError, match="between -1 and -1"):
        masked.step(bar, [])
    with pytest.raises(SolveError, match="eps_r must be positive"):
        masked.step(bar, [-2.0])
    with pytest.raises(SolveError, match="booleans"):
        masked.step_cells(1.0, bar)
    with pytest.raises(FieldError, match="eps_r"):
        masked.step_cells(np.ones(3))
    with pytest.raises(SolveError, match="unknown solver 'qr'"):
        MaskedSolver(MeshSensor(mesh, STRIPES), solver="qr")  # type: ignore[arg-type]
    with pytest.raises(SolveError, match="tolerance"):
        MaskedSolver(MeshSensor(mesh, STRIPES), tolerance=0.0)
    with pytest.raises(SolveError, match="max_iterations"):
        MaskedSolver(MeshSensor(mesh, STRIPES), max_iterations=0)
    MaskedSolver(MeshSensor(mesh, STRIPES), max_iterations=1)


def test_no_convergence_is_an_error(mesh, bar):
    masked = MaskedSolver(MeshSensor(mesh, STRIPES), max_iterations=3)
    with pytest.raises(SolveError, match="CG stopped after 3 iterations") as caught:
        masked.step(bar, [80.0])
    left, wanted = map(float, re.findall(r"\d\.\de[+-]\d\d", str(caught.value)))
    assert wanted == 1e-5
    assert 1e-3 < left < 100


def test_before_the_first_step_nothing_was_spent(mesh):
    assert MaskedSolver(MeshSensor(mesh, STRIPES)).stats == MaskedStats(0, 0, 0, 0.0)
