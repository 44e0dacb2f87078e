"""The solver of scenes with losses."""

from __future__ import annotations

import numpy as np
import pytest
import surface_twin as twin
from solver_scenes import (
    ALL,
    BALL,
    BOX,
    FINGER,
    NAMES,
    NONE,
    TIED,
    TILTED,
    WIDTH,
    Scene,
    apart,
    body,
    exact,
    packed_green,
    scenes,
)

import capsense as cs
from capsense._dense import eliminate
from capsense.solver.system.lossy import solve_lossy
from capsense.solver.system.step import Solution


def lossily(scene: Scene, threshold: float) -> Solution:
    """Solve with complex energies."""
    ties = np.array([complex(p.ground_elastance) for p in scene.pieces])
    soft = np.array([1 / (p.eps_r - 1) if np.isfinite(p.eps_r) else 0.0 for p in scene.pieces])
    return solve_lossy(scene.packed(), ties, soft.astype(complex), packed_green(), threshold, WIDTH)


@pytest.mark.parametrize(
    ("name", "threshold"),
    [(n, t) for n in NAMES for t in (0.2, 0.015, ALL) if t == ALL or n not in TIED],
)
def test_lossy_without_losses(name: str, threshold: float) -> None:
    """Differential: the same scene by both; scores know nothing of ties where there are losses."""
    scene = scenes()[name]
    found, wanted = lossily(scene, threshold), scene.solved(threshold)
    assert apart(found.delta, wanted.delta) < 1e-6
    left = np.abs(found.residual_correction - wanted.residual_correction).max()
    assert left < 1e-6 * np.abs(wanted.delta).max()
    assert apart(found.charge, wanted.charge[:, : found.charge.shape[1]]) < 1e-5


@pytest.mark.parametrize("height", [0.002, -0.008])
def test_lossy_energies_that_are_not_definite_are_raised_too(height: float) -> None:
    """Differential: a box that reaches into the sensor, where both raise the diagonal alike."""
    scene = Scene([body(BOX, (0.02, 0.0, height))])
    found, wanted = lossily(scene, 0.015), scene.solved(0.015)
    assert found.shift == wanted.shift >= 0.0
    assert apart(found.delta, wanted.delta) < 1e-9


@pytest.mark.parametrize("shape", [BALL, BOX, FINGER], ids=repr)
@pytest.mark.parametrize("eps", [3 - 2j, 60 - 300j, 1 - 40j])
@pytest.mark.e2e
def test_lossy_functions_together_are_the_panels(shape: cs.Shape, eps: complex) -> None:
    """Differential: complex energies, one unknown a panel, with and without a tie."""
    for tie in (NONE, 8.0 - 20.0j):
        scene = Scene(
            [body(shape, (0.01, 0.0, 0.05), TILTED, ground_elastance=tie, eps_r=eps),
             body(FINGER, (0.0, 0.08, 0.05))]
        )  # fmt: skip
        wanted = twin.galerkin(scene.pieces, exact(), packed_green().active_bounds)
        assert apart(lossily(scene, ALL).delta, wanted) < 3e-5


def test_elimination_without_pivots():
    """Differential: against LAPACK, for energies that are positive and losses of one sign."""
    rng = np.random.default_rng(9)
    for n, m in ((1, 1), (7, 3), (120, 6)):
        real, loss = (x @ x.T + 0.1 * np.eye(n) for x in rng.normal(size=(2, n, n)))
        matrix = real - 1j * 3.0 * loss
        sides = rng.normal(size=(n, m)) + 1j * rng.normal(size=(n, m))
        found = sides.copy()
        eliminate(matrix.copy(), found)
        np.testing.assert_allclose(matrix @ found, sides, rtol=0, atol=1e-8)
