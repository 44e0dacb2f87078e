"""Iterative solvers of ``peers.py``, started from the last step's solution.

Capacitances come from the energy, C = C_fixed − bᵀx − xᵀ(b − Kx), whose error is quadratic in that
of x. The tolerance leaves about as much of ΔC as CapSense's default does, 1e-5 of it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse.linalg as spla
from numpy.typing import NDArray
from peers_task import Array, System

TOLERANCE = 3e-4
"""Residual, relative to the load, in the norm of the preconditioner."""
Apply = Callable[[Array], Array]


def conjugate_gradients(matrix: Apply, precondition: Apply, loads: Array, start: Array) -> Array:
    """Preconditioned CG on all columns together; each goes on until the last has converged."""
    solution = start.copy()
    residual = loads - matrix(solution)
    scaled = precondition(residual)
    direction = scaled.copy()
    norm = _dots(residual, scaled)
    goal = TOLERANCE**2 * _dots(loads, precondition(loads))
    for _ in range(2000):
        if (norm <= goal).all():
            return solution
        image = matrix(direction)
        step = norm / np.maximum(_dots(direction, image), 1e-300)
        solution += step * direction
        residual -= step * image
        scaled = precondition(residual)
        last, norm = norm, _dots(residual, scaled)
        direction *= norm / np.maximum(last, 1e-300)
        direction += scaled
    raise RuntimeError("CG did not converge in 2000 iterations")


def _dots(left: Array, right: Array) -> Array:
    return np.einsum("ij,ij->j", left, right)


class JacobiCg:
    """SciPy's sparse products and the diagonal as preconditioner."""

    name = "SciPy Jacobi-CG"
    settings = f"six columns together, warm start, tolerance {TOLERANCE:g}, energy form"

    def __init__(self, system: System) -> None:
        self._system = system
        self.n_tets, self.unknowns = system.n_tets, len(system.loads)
        self._inverse = 1.0 / system.matrix.diagonal()[:, None]
        self._last = np.zeros_like(system.loads)

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        system = self._system
        free = (~system.held(x, gap)).astype(float)[:, None]
        loads, inverse = system.loads * free, self._inverse * free

        def matrix(p: Array) -> Array:
            out = system.matrix @ p
            out *= free
            return out

        solution = conjugate_gradients(matrix, self._pick(inverse, free), loads, self._last * free)
        self._last = solution
        rest = loads - matrix(solution)
        return system.fixed_energy - loads.T @ solution - solution.T @ rest

    def _pick(self, inverse: Array, free: Array) -> Apply:
        return lambda r: inverse * r


class PlainCg:
    """SciPy's own CG as its manual has it: for one electrode after the other, from zero."""

    name = "SciPy cg, plain"
    settings = "scipy.sparse.linalg.cg with the diagonal, from zero, rtol 1e-5, charges from loads"

    def __init__(self, system: System) -> None:
        self._system = system
        self.n_tets, self.unknowns = system.n_tets, len(system.loads)

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        system = self._system
        inside = np.flatnonzero(~system.held(x, gap))
        matrix, loads = system.matrix[inside][:, inside], system.loads[inside]
        scale = spla.LinearOperator(matrix.shape, (1.0 / matrix.diagonal()).__mul__, dtype=float)
        solution = np.column_stack([spla.cg(matrix, b, rtol=1e-5, M=scale)[0] for b in loads.T])
        return system.fixed_energy - loads.T @ solution


class AmgCg(JacobiCg):
    """Smoothed aggregation of the empty domain as preconditioner, made once."""

    name = "pyamg-CG"
    settings = (
        "smoothed aggregation of the empty domain made once, restricted to the free nodes, one "
        f"V-cycle, warm start, tolerance {TOLERANCE:g}, energy form"
    )

    def __init__(self, system: System) -> None:
        import pyamg

        super().__init__(system)
        hierarchy = pyamg.smoothed_aggregation_solver(system.matrix)
        self._cycle = hierarchy.aspreconditioner(cycle="V")

    def _pick(self, inverse: Array, free: Array) -> Apply:
        return lambda r: np.column_stack([self._cycle @ column for column in r.T]) * free


class AmgRebuiltCg(AmgCg):
    """Smoothed aggregation of the current operator, made at every step."""

    name = "pyamg-CG, rebuilt"
    settings = (
        "smoothed aggregation of the free nodes' operator made at every step, one V-cycle, warm "
        f"start, tolerance {TOLERANCE:g}, energy form"
    )

    def __init__(self, system: System) -> None:
        JacobiCg.__init__(self, system)

    def _pick(self, inverse: Array, free: Array) -> Apply:
        import pyamg

        inside = np.flatnonzero(free[:, 0])
        operator = self._system.matrix[inside][:, inside]
        cycle = pyamg.smoothed_aggregation_solver(operator).aspreconditioner(cycle="V")

        def apply(r: Array) -> Array:
            out = np.zeros_like(r)
            out[inside] = np.column_stack([cycle @ column for column in r[inside].T])
            return out

        return apply


class ScikitFem:
    """scikit-fem's own way: condense, then its preconditioned CG for each right-hand side."""

    name = "scikit-fem"
    settings = (
        "condense and solver_iter_pcg (Jacobi), one right-hand side after the other, warm start, "
        f"rtol {TOLERANCE:g}, energy form"
    )

    def __init__(self, system: System) -> None:
        from skfem import condense

        self._system, self._condense = system, condense
        self.n_tets, self.unknowns = system.n_tets, len(system.loads)
        self._last = np.zeros_like(system.loads)

    def step(self, x: float, gap: float) -> Array:
        """C [F] with the bar at x [m], gap [m]."""
        from skfem.utils import solver_iter_pcg

        system = self._system
        held: NDArray[np.int64] = np.flatnonzero(system.held(x, gap))
        matrix, _, _, inside = self._condense(system.matrix, system.loads[:, 0], D=held)
        loads, solution = system.loads[inside], self._last[inside]
        for k in range(loads.shape[1]):
            solve = solver_iter_pcg(x0=solution[:, k], rtol=TOLERANCE)
            solution[:, k] = solve(matrix, loads[:, k])
        self._last = np.zeros_like(system.loads)
        self._last[inside] = solution
        rest = loads - matrix @ solution
        return system.fixed_energy - loads.T @ solution - solution.T @ rest
