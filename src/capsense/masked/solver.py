"""The paper's own scheme: centroid masking on a fixed mesh, residual update, full solve.

A tetrahedron belongs to an object if its centroid lies inside it (a staircase of the surface),
and the P1 problem of the whole domain is solved anew for every electrode at every step. It is
kept for comparison and reproduction.

An object is either a dielectric, which gives its tetrahedra their permittivity, or a conductor
at 0 V, which fixes every node of its tetrahedra at 0 V; `GROUNDED` (infinite eps_r) marks the
latter. A conductor can also be imitated by a large finite eps_r, as far as it touches nothing:
it is then floating, and CG needs more iterations the larger the contrast.

With ∇λ_a the constant gradient of node a's hat function on an element e of volume V_e, the P1
stiffness matrix is K_ab = Σ_e ε0 ε_e V_e ∇λ_a·∇λ_b [F].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import ArrayLike, NDArray

from capsense.constants import EPS0
from capsense.errors import FieldError, SolveError
from capsense.masked.mesh_sensor import MeshSensor
from capsense.mesh.tetmesh import TetMesh

Array = NDArray[np.float64]
IntArray = NDArray[np.integer]

GROUNDED = math.inf
"""The eps_r that marks a conductor held at 0 V."""

_REFRESH = 1000
"""Residual updates after which the matrix is assembled afresh, so that rounding cannot pile up."""
_UPDATE_SHARE = 0.25
"""Share of changed elements above which assembling afresh is cheaper than updating."""


def gradients(points: Array, tets: IntArray) -> tuple[Array, Array]:
    """Gradients of the hat functions, and the volumes, of linear tetrahedra.

    Args:
        points: Node positions [m], shape (n, 3).
        tets: Corner nodes, shape (k, 4).

    Returns:
        grads: Gradient [1/m] of each corner's hat function, shape (k, 4, 3); they sum to zero.
        volumes: Volume of each tetrahedron [m³], shape (k,), negative if it is inverted.
    """
    corners = points[tets]
    sides = corners[:, 1:] - corners[:, :1]
    volumes = np.linalg.det(sides) / 6.0
    grads = np.empty((len(tets), 4, 3))
    grads[:, 1:] = np.linalg.inv(sides).transpose(0, 2, 1)
    grads[:, 0] = -grads[:, 1:].sum(axis=1)
    return grads, volumes


def check_eps_r(mesh: TetMesh, eps_r: ArrayLike) -> Array:
    """Relative permittivity per element, shape (k,), from one number or k of them.

    Raises:
        FieldError: If the shape does not fit or a value is not positive and finite.
    """
    values = np.asarray(eps_r, dtype=np.float64)
    if values.shape not in ((), (mesh.n_tets,)):
        raise FieldError(f"eps_r must be a number or have shape ({mesh.n_tets},): {values.shape}")
    if not (np.isfinite(values) & (values > 0)).all():
        raise FieldError("every eps_r must be positive and finite")
    return np.broadcast_to(values, (mesh.n_tets,)).copy()


@dataclass(frozen=True, eq=False)
class StiffnessMap:
    """The linear map from element permittivities to CSR values, ``data = csr_map @ eps_r``.

    The sparsity pattern of K is fixed: `indptr` and `indices` are those of every matrix made
    here.
    """

    mesh: TetMesh

    @cached_property
    def pattern(self) -> sp.csr_matrix:
        """K's sparsity pattern, shape (n, n), with the values 0, 1, 2… in order of storage."""
        n, (a, b) = self.mesh.n_points, self.mesh.edges.T
        nodes = np.arange(n)
        rows, columns = np.concatenate([a, b, nodes]), np.concatenate([b, a, nodes])
        pattern = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
        pattern.sort_indices()
        pattern.data = np.arange(pattern.nnz, dtype=np.float64)
        return pattern

    @cached_property
    def element_entries(self) -> tuple[NDArray[np.int64], Array]:
        """Where an element's 4×4 matrix goes in the CSR values, and the matrix at eps_r = 1.

        Both have shape (k, 16); the positions index `data`, the matrices are in farads.
        """
        mesh = self.mesh
        grads, volumes = gradients(mesh.points, mesh.tets)
        local = EPS0 * volumes[:, None, None] * np.einsum("kad,kbd->kab", grads, grads)
        rows = np.repeat(mesh.tets, 4, axis=1).astype(np.int64)
        columns = np.tile(mesh.tets, (1, 4)).astype(np.int64)
        pattern = self.pattern
        stored_rows = np.repeat(np.arange(mesh.n_points), np.diff(pattern.indptr))
        keys = stored_rows * mesh.n_points + pattern.indices
        return np.searchsorted(keys, rows * mesh.n_points + columns), local.reshape(-1, 16)

    @cached_property
    def csr_map(self) -> sp.csc_matrix:
        """Maps eps_r, shape (k,), to the CSR values of K [F], shape (nnz, k)."""
        where, local = self.element_entries
        columns = np.repeat(np.arange(self.mesh.n_tets), 16)
        shape = (self.pattern.nnz, self.mesh.n_tets)
        return sp.csc_matrix((local.ravel(), (where.ravel(), columns)), shape=shape)

    def matrix(self, data: Array) -> sp.csr_matrix:
        """K with these CSR values [F], shape (nnz,); the values are shared, not copied."""
        pattern = self.pattern
        return sp.csr_matrix((data, pattern.indices, pattern.indptr), shape=pattern.shape)

    def assemble(self, eps_r: Array) -> Array:
        """CSR values [F], shape (nnz,), for permittivities of shape (k,)."""
        return self.csr_map @ eps_r

    def update(self, data: Array, cells: IntArray, change: Array) -> None:
        """Add to the CSR values, in place, what a change of eps_r in some cells makes of them.

        Args:
            data: CSR values [F], shape (nnz,).
            cells: Distinct elements whose permittivity changed, shape (c,).
            change: Change of their eps_r, shape (c,).
        """
        where, local = self.element_entries
        np.add.at(data, where[cells].ravel(), (local[cells] * change[:, None]).ravel())


@dataclass(frozen=True)
class MaskedStats:
    """What a step cost."""

    changed_cells: int
    """Tetrahedra whose permittivity differs from the step before."""
    grounded_nodes: int
    """Nodes held at 0 V by conductors in the scene."""
    iterations: int
    """CG iterations, summed over the electrodes; 0 with a direct solver."""
    residual: float
    """Largest relative residual over the electrodes, in the norm of the stopping rule."""


class MaskedSolver:
    """Capacitances by centroid masking and a full solve at every step.

    With solver "cg", each of the M problems is solved by conjugate gradients with the diagonal
    preconditioner D, from the potentials of the step before unless told otherwise, until
    ‖b − Kφ‖ ≤ tolerance·‖b‖ in the norm of D⁻¹, where b is the load of the electrode.
    Capacitances are energies, so their error goes with the square of the tolerance: below 1e-9 of
    the largest entry at 1e-5. With "lu" the free part of K is factorised at every step, which is
    exact but slower: some three times at 30,000 tetrahedra, ten times at 95,000.
    """

    def __init__(
        self,
        sensor: MeshSensor,
        *,
        solver: Literal["cg", "lu"] = "cg",
        tolerance: float = 1e-5,
        max_iterations: int = 5000,
        warm_start: bool = True,
    ) -> None:
        """Assemble the empty domain.

        Args:
            sensor: The fixed mesh, its M electrodes and what else is held.
            solver: "cg" or "lu".
            tolerance: Relative residual that ends CG.
            max_iterations: CG iterations after which a step fails.
            warm_start: Whether CG starts from the potentials of the step before, or from zero.

        Raises:
            MeshError: If a group is unknown or empty, electrodes share nodes, or a profile does not
                fit.
            FieldError: If the permittivity of the empty domain does not fit the mesh.
            SolveError: If a setting is out of range.
        """
        if solver not in ("cg", "lu"):
            raise SolveError(f"unknown solver {solver!r}; known: cg, lu")
        if not 0 < tolerance < 1:
            raise SolveError(f"tolerance must lie between 0 and 1, not {tolerance}")
        if max_iterations < 1:
            raise SolveError(f"max_iterations must be positive, not {max_iterations}")
        self.mesh = mesh = sensor.mesh
        self.solver = solver
        self.tolerance = tolerance
        self.max_iterations = max_iterations
        self.warm_start = warm_start
        self._dirichlet, self._free = sensor.unit_potentials()
        self._background = check_eps_r(mesh, sensor.eps_r)
        self._map = StiffnessMap(mesh)
        self._stats = MaskedStats(0, 0, 0, 0.0)
        self.reset()

    def reset(self) -> None:
        """Forget the last step: empty domain, freshly assembled, cold start."""
        self._eps = self._background.copy()
        self._data = self._map.assemble(self._eps)
        self._matrix = self._map.matrix(self._data)
        self._updates = 0
        self._potentials = self._dirichlet.copy()

    @property
    def stats(self) -> MaskedStats:
        """Cost of the last step."""
        return self._stats

    @property
    def potentials(self) -> Array:
        """Node potentials [V] of the last step, column j for 1 V on electrode j, shape (n, M)."""
        return self._potentials.copy()

    def step(self, inside: ArrayLike, body_eps_r: Sequence[float]) -> Array:
        """Capacitances with objects in the domain.

        Args:
            inside: Index of the body that holds each tetrahedron's centroid, −1 for none, shape
                (k,).
            body_eps_r: Relative permittivity of each body, or `GROUNDED`, shape (B,).

        Returns:
            Maxwell capacitance matrix [F], shape (M, M), symmetric.

        Raises:
            SolveError: If the arrays do not fit, or CG does not reach its tolerance.
        """
        bodies = np.asarray(inside)
        if bodies.shape != (self.mesh.n_tets,) or not np.issubdtype(bodies.dtype, np.integer):
            raise SolveError(f"inside must hold {self.mesh.n_tets} integers, one per tetrahedron")
        if bodies.min() < -1 or bodies.max() >= len(body_eps_r):
            raise SolveError(f"inside must lie between -1 and {len(body_eps_r) - 1}")
        table = np.append(np.asarray(body_eps_r, dtype=np.float64), np.nan)
        if not (table[:-1] > 0).all():
            raise SolveError("every body's eps_r must be positive, or GROUNDED")
        values = table[bodies]
        grounded = np.isinf(values)
        eps = np.where(np.isnan(values) | grounded, self._background, values)
        return self.step_cells(eps, grounded)

    def step_cells(self, eps_r: ArrayLike, grounded: ArrayLike | None = None) -> Array:
        """Capacitances for given permittivities of all tetrahedra.

        Args:
            eps_r: Relative permittivities, objects included, shape (k,).
            grounded: Tetrahedra that belong to conductors at 0 V, booleans of shape (k,). Electrode
                nodes in them keep the electrode's potential.

        Returns:
            Maxwell capacitance matrix [F], shape (M, M), symmetric.

        Raises:
            FieldError: If `eps_r` does not fit the mesh.
            SolveError: If `grounded` does not fit, or CG does not reach its tolerance.
        """
        changed = self._update(check_eps_r(self.mesh, eps_r))
        free = self._free
        if grounded is not None:
            cells = np.asarray(grounded)
            if cells.shape != (self.mesh.n_tets,) or cells.dtype != bool:
                raise SolveError(f"grounded must hold {self.mesh.n_tets} booleans")
            free = free.copy()
            free[self.mesh.tets[cells].ravel()] = False
        last = self._potentials if self.warm_start else 0.0
        potentials = np.where(free[:, None], last, self._dirichlet)
        iterations, residual = self._solve(potentials, np.flatnonzero(free))
        self._potentials = potentials
        capacitance = potentials.T @ (self._matrix @ potentials)
        self._stats = MaskedStats(
            changed_cells=changed,
            grounded_nodes=int(self._free.sum() - free.sum()),
            iterations=iterations,
            residual=residual,
        )
        return 0.5 * (capacitance + capacitance.T)

    def _update(self, eps: Array) -> int:
        """Bring the matrix to these permittivities; the number of elements that changed."""
        cells = np.flatnonzero(eps != self._eps)
        if len(cells) == 0:
            return 0
        if self._updates >= _REFRESH or len(cells) > _UPDATE_SHARE * len(eps):
            self._data[:] = self._map.assemble(eps)
            self._updates = 0
        else:
            self._map.update(self._data, cells, eps[cells] - self._eps[cells])
            self._updates += 1
        self._eps = eps
        return len(cells)

    def _solve(self, potentials: Array, free: NDArray[np.integer]) -> tuple[int, float]:
        """Solve K φ = 0 at the free nodes, in place; iterations and largest residual."""
        if len(free) == 0:
            return 0, 0.0
        fixed = potentials.copy()
        fixed[free] = 0.0
        loads = -(self._matrix @ fixed)[free]
        system = self._matrix[free][:, free]
        if self.solver == "lu":
            factors = spla.splu(
                system.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}
            )
            potentials[free] = factors.solve(loads)
            return 0, 0.0
        inverse = 1.0 / system.diagonal()
        outcomes = []
        for column in range(loads.shape[1]):
            load, start = np.ascontiguousarray(loads[:, column]), potentials[free, column]
            solution, steps, residual = conjugate_gradients(
                system, inverse, load, start, self.tolerance, self.max_iterations
            )
            potentials[free, column] = solution
            outcomes.append((steps, residual))
        return sum(steps for steps, _ in outcomes), max(residual for _, residual in outcomes)


def conjugate_gradients(
    matrix: sp.csr_matrix,
    inverse_diagonal: Array,
    load: Array,
    start: Array,
    tolerance: float,
    max_iterations: int,
) -> tuple[Array, int, float]:
    """Diagonally preconditioned CG for K x = b from a start.

    Ends when sqrt(rᵀ D⁻¹ r) ≤ tolerance · sqrt(bᵀ D⁻¹ b) with r = b − K x.

    Returns:
        solution: x, shape (n,).
        iterations: Iterations made.
        residual: sqrt(rᵀ D⁻¹ r / bᵀ D⁻¹ b) at the end.

    Raises:
        SolveError: If the tolerance is not reached in `max_iterations`.
    """
    scale = math.sqrt(_dot(load, inverse_diagonal * load))
    if scale == 0.0:
        return np.zeros_like(load), 0, 0.0
    solution = start.copy()
    residual = load - matrix @ solution
    direction = inverse_diagonal * residual
    norm = _dot(residual, direction)
    iterations = 0
    while math.sqrt(norm) > tolerance * scale:
        if iterations == max_iterations:
            raise SolveError(
                f"CG stopped after {iterations} iterations at a relative residual of "
                f"{math.sqrt(norm) / scale:.1e}; wanted {tolerance:.1e}"
            )
        image = matrix @ direction
        alpha = norm / _dot(direction, image)
        solution += alpha * direction
        residual -= alpha * image
        scaled = inverse_diagonal * residual
        previous, norm = norm, _dot(residual, scaled)
        direction *= norm / previous
        direction += scaled
        iterations += 1
    return solution, iterations, math.sqrt(norm) / scale


def _dot(left: Array, right: Array) -> float:
    """Inner product on this thread: BLAS wakes others from some 10k entries, and waits for them."""
    return float(np.einsum("i,i->", left, right))
