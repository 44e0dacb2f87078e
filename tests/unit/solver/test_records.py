"""Records of the bodies of a scene: ties to ground, matter, and what is joined."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from approximate import approx
from solver_scenes import Array, apart, coarse_solver, cube, reading, shape_of

import capsense as cs
from capsense.constants import UNIT
from capsense.solver.bodies.panels import panels_of
from capsense.solver.tree.rigid import rigid_shape


def packed(*bodies: cs.Body) -> Array:
    """Records of a scene, by the solver."""
    solver = coarse_solver()
    return solver.pack(solver.look(cs.Scene(list(bodies)))).records


def test_ties_of_conductors() -> None:
    """Analytic: none at ground, no net charge if floating, 4π eps0 / C on a capacitance."""
    found = packed(cube(-2, "grounded"), cube(0, "floating"), cube(2, 5e-12))
    assert found["neutral"].tolist() == [0, 1, 0]
    np.testing.assert_allclose(found["ground_elastance"], [0.0, 0.0, UNIT / 5e-12])
    assert found["group"].tolist() == [0, 1, 2]
    assert (found["inverse_susceptibility"] == 0).all()


def test_matter_of_dielectrics() -> None:
    """Analytic: 1 / (eps - 1); net charge only where displacement current brings it."""
    found = packed(
        *(cube(3 * k, "grounded", cs.Material(f"m{k}", eps)) for k, eps in ((-1, 3), (0, 200))),
        cube(3, "floating", cs.Material("m", 5000)),
    )
    assert found["neutral"].tolist() == [1, 1, 1]
    np.testing.assert_allclose(found["inverse_susceptibility"], [1 / 2, 1 / 199, 1 / 4999])
    assert (found["neumann_to_dirichlet"] != 0).all()
    tied = packed(cube(0, "grounded", cs.Material("m", 5000)))
    size = shape_of(cs.Box((0.02, 0.03, 0.03)), 300).capacitance
    assert tied["neutral"][0] == 0
    assert tied["ground_elastance"][0] == approx(5.0 / (5000 * size), rel=1e-6)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 1, 0), (1, 0, 2)])
def test_three_in_a_row_are_one_conductor(order: tuple[int, ...]) -> None:
    """Invariant: whatever the order, on the sum of the capacitances; apart, each by itself."""
    states = ("floating", 2e-12, 3e-12)
    found = packed(*(cube(k - 1, states[k]) for k in order))
    assert found["group"].tolist() == [0, 0, 0]
    assert found["neutral"].tolist() == [0, 0, 0]
    np.testing.assert_allclose(found["ground_elastance"], UNIT / 5e-12)
    found = packed(*(cube(1.1 * (k - 1), states[k]) for k in order))
    assert found["group"].tolist() == [0, 1, 2]
    assert sorted(found["neutral"].tolist()) == [0, 0, 1]


def test_one_grounded_conductor_grounds_all_that_touch() -> None:
    """Invariant: the first of three in a row is at ground, and so is the last."""
    found = packed(cube(-1, "grounded"), cube(0, "floating"), cube(1, 1e-12))
    assert found["neutral"].tolist() == [0, 0, 0]
    assert (found["ground_elastance"] == 0).all()
    mixed = reading(cube(-1, "grounded"), cube(0, "floating"), cube(1, 1e-12))
    assert apart(mixed, reading(*(cube(k, "grounded") for k in (-1, 0, 1)))) < 1e-9


def test_dielectrics_join_nothing() -> None:
    """Invariant: matter between two conductors keeps them apart."""
    plastic = cs.Material("plastic", 3.0)
    found = packed(cube(-1, "floating"), cube(0, "floating", plastic), cube(1, "floating"))
    assert found["group"].tolist() == [0, 1, 2]
    assert found["neutral"].tolist() == [1, 1, 1]


def test_threads_that_meet_a_shape_share_its_arrays() -> None:
    """Invariant: records hold addresses, so no thread may replace what another points to."""
    shape = rigid_shape(panels_of(cs.Box((0.02, 0.03, 0.04)), 100), apart=True)
    start = threading.Barrier(4)

    def met(_: int) -> tuple[int, int]:
        start.wait()
        return shape.neumann_to_dirichlet.ctypes.data, shape.own.ctypes.data

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(met, range(4)))) == 1
