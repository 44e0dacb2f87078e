"""Equilibrium charges of small blocks of panels, against dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense.errors import SolveError
from capsense.solver.bodies.blocks import free_block
from capsense.solver.bodies.panels import panels_of
from capsense.solver.tree import rigid

Array = np.ndarray


def definite(seed: int, n: int) -> Array:
    """A symmetric positive definite matrix whose rows differ much in size."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n))
    size = 10.0 ** rng.uniform(-3, 3, n)
    return size[:, None] * (half @ half.T + n * np.eye(n)) * size


@pytest.mark.parametrize("n", [1, 2, 3, 17, 40])
def test_conjugate_gradients_solve(n: int) -> None:
    """Differential: to the eighth digit, in units of the diagonal."""
    for seed in range(5):
        matrix, x = definite(seed, n), np.zeros(n)
        assert rigid._conjugate_gradients(matrix, np.ones(n), x, 1e-8)
        scale = np.sqrt(np.diag(matrix))
        np.testing.assert_allclose(
            scale * x,
            scale * np.linalg.solve(matrix, np.ones(n)),
            rtol=1e-6,
            atol=1e-8 / scale.min(),
        )


def test_the_inside_of_an_open_surface() -> None:
    """Unit: 2.5 times the energies of functions without net charge."""
    square = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.1, 0.02], [0.0, 0.1, 0.02]])
    shape = rigid.rigid_shape(panels_of(square[[[0, 1, 2], [0, 2, 3]]], 30))
    assert not shape.panels.closed
    np.testing.assert_allclose(
        shape.neumann_to_dirichlet[1:, 1:], 2.5 * shape.potential_coefficients[1:, 1:], rtol=1e-6
    )
    assert not shape.neumann_to_dirichlet[0].any()
    assert not shape.neumann_to_dirichlet[:, 0].any()


def test_rigid_shape_with_screened_panels() -> None:
    """Limits: a ball in a ball has no charge, yet its panels have a tenth of the mean density."""
    balls = [trimesh.creation.icosphere(2, radius).triangles for radius in (0.02, 0.008)]
    shape = rigid.rigid_shape(panels_of(np.concatenate(balls), 60))
    assert shape.capacitance == approx(0.02, rel=0.01)
    single = shape.tree.panel >= 0
    areas = shape.panels.areas[shape.tree.panel[single]]
    density = shape.tree.charge[single] / areas
    near = np.linalg.norm(shape.tree.center[single], axis=1) < 0.01
    assert np.ptp(density[near]) < 1e-9 * density[near].max()
    least = density[near].mean() / density[~near].mean()
    assert 0.5 * rigid._LEAST_DENSITY < least < 2.0 * rigid._LEAST_DENSITY
    for values in (shape.tree.points, shape.potential_coefficients, shape.own):
        assert np.isfinite(values).all()


def test_what_does_not_converge_is_told() -> None:
    assert not rigid._conjugate_gradients(np.full((2, 2), np.nan), np.ones(2), np.zeros(2), 1e-8)
    with pytest.raises(SolveError, match="the charges of 2 panels do not converge"):
        rigid.equilibrium(np.full((2, 2), np.nan))


@pytest.mark.parametrize(
    ("near", "extra"), [(0.5, 0.0), (0.9999, 0.0), (1.0005, 1e-3), (1.005, 1e-2), (1.05, 0.1)]
)
def test_panels_that_nearly_coincide(near: float, extra: float) -> None:
    """Analytic: their own energies are raised by as little as makes the block definite."""
    free = np.array([[2.0, 2.0 * near, 0.3], [2.0 * near, 2.0, 0.3], [0.3, 0.3, 5.0]])
    wanted = free + np.diag(extra * np.diag(free))
    charge = rigid._made_definite(free)
    np.testing.assert_allclose(free, wanted, rtol=1e-12)
    np.testing.assert_allclose(charge, np.linalg.solve(wanted, np.ones(3)), rtol=1e-9)


def test_a_surface_that_meets_itself_is_refused() -> None:
    with pytest.raises(SolveError, match="the surface of 2 panels intersects itself"):
        rigid._made_definite(np.array([[1.0, 1.2], [1.2, 1.0]]))


@pytest.mark.parametrize("shape", [cs.Sphere(0.02), cs.Box((0.03, 0.02, 0.01))])
def test_both_ways_to_the_charge_agree(shape: cs.Shape) -> None:
    """Differential: iterations against a factorisation, and the capacitance of a ball."""
    panels = panels_of(shape, 30)
    one, other = (rigid.rigid_shape(panels, apart=apart) for apart in (True, False))
    np.testing.assert_allclose(one.tree.charge, other.tree.charge, rtol=1e-6)
    np.testing.assert_allclose(
        one.potential_coefficients,
        other.potential_coefficients,
        rtol=1e-4,
        atol=1e-5 * one.own.max(),
    )
    total = np.linalg.solve(free_block(panels), np.ones(len(panels))).sum()
    assert one.capacitance == approx(total, rel=1e-7)
    if isinstance(shape, cs.Sphere):
        assert one.capacitance == approx(0.02, rel=0.02)
