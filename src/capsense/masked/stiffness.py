"""The P1 stiffness matrix, its link weights, and a conforming reference capacitance.

With ∇λ_a the constant gradient of node a's hat function on an element e of volume V_e,

    K_ab = Σ_e ε0 ε_e V_e ∇λ_a·∇λ_b,        w_ab = −K_ab for a link ab.

K's rows sum to zero, so it is the Laplacian of a graph whose links carry the weights w [F].
Everything here is written to be read and compared against, not to be run at every step.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import ArrayLike, NDArray

from capsense.constants import EPS0
from capsense.errors import FieldError, MeshError
from capsense.mesh.tetmesh import LOCAL_EDGES, TetMesh

Array = NDArray[np.float64]
IntArray = NDArray[np.integer]

Solver = Literal["direct", "cg"]


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


def element_weights(mesh: TetMesh) -> Array:
    """Share of each element in the weight of its six links at eps_r = 1 [F], shape (k, 6)."""
    grads, volumes = gradients(mesh.points, mesh.tets)
    a, b = LOCAL_EDGES.T
    products: Array = np.einsum("kld,kld->kl", grads[:, a], grads[:, b])
    return -EPS0 * volumes[:, None] * products


def link_weights(mesh: TetMesh, eps_r: ArrayLike = 1.0) -> Array:
    """Weight of every link, w_ab = −Σ_e ε0 ε_e V_e ∇λ_a·∇λ_b [F], shape (m,).

    Raises:
        FieldError: If `eps_r` is neither a positive number nor k of them.
    """
    shares = element_weights(mesh) * check_eps_r(mesh, eps_r)[:, None]
    links = mesh.tet_edges.ravel()
    weights = np.bincount(links, weights=shares.ravel(), minlength=len(mesh.edges))
    return weights.astype(np.float64)


def laplacian(edges: IntArray, weights: ArrayLike, n_points: int) -> sp.csr_matrix:
    """Graph Laplacian of weighted links, shape (n, n): K = Σ w_ab (e_a − e_b)(e_a − e_b)ᵀ."""
    w = np.asarray(weights, dtype=np.float64)
    a, b = edges[:, 0], edges[:, 1]
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([b, a, a, b])
    entries = np.concatenate([-w, -w, w, w])
    return sp.csr_matrix((entries, (rows, columns)), shape=(n_points, n_points))


def stiffness(mesh: TetMesh, eps_r: ArrayLike = 1.0) -> sp.csr_matrix:
    """P1 stiffness matrix K_ab = Σ_e ε0 ε_e V_e ∇λ_a·∇λ_b [F], shape (n, n).

    Raises:
        FieldError: If `eps_r` is neither a positive number nor k of them.
    """
    return laplacian(mesh.edges, link_weights(mesh, eps_r), mesh.n_points)


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
        pattern = laplacian(self.mesh.edges, np.ones(len(self.mesh.edges)), self.mesh.n_points)
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


def unit_potentials(
    mesh: TetMesh,
    electrode_groups: Sequence[str],
    ground_groups: Iterable[str],
    profiles: Mapping[str, ArrayLike] | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Dirichlet values of the M unit problems, and which nodes are free.

    Returns:
        values: 1 V, or the profile given, on electrode j in column j and 0 V elsewhere, shape (n,
            M).
        free: Nodes on no electrode and not on ground, shape (n,).

    Raises:
        MeshError: If a group is unknown or empty, an electrode shares nodes with another or ground,
            or a profile is of no electrode, of another shape, negative or not finite.
    """
    electrodes, shapes = list(electrode_groups), dict(profiles or {})
    if not electrodes:
        raise MeshError("at least one electrode group is needed")
    if strange := sorted(set(shapes) - set(electrodes)):
        raise MeshError(f"profile {strange[0]!r} is of no electrode; there are {electrodes}")
    owner = np.full(mesh.n_points, -1)
    values = np.zeros((mesh.n_points, len(electrodes)))
    owner[mesh.group_nodes(ground_groups)] = len(electrodes)
    for column, name in enumerate(electrodes):
        members = mesh.group_nodes([name])
        if len(members) == 0:
            raise MeshError(f"electrode group {name!r} is empty")
        if shared := int((owner[members] >= 0).sum()):
            raise MeshError(f"electrode group {name!r} shares {shared} nodes with another group")
        owner[members] = column
        values[members, column] = _profile(name, shapes.get(name, 1.0), len(members))
    return values, owner < 0


def _profile(name: str, given: ArrayLike, count: int) -> Array:
    potential = np.asarray(given, dtype=np.float64)
    if potential.shape not in ((), (count,)):
        raise MeshError(
            f"profile {name!r} has shape {potential.shape}; give one potential for each of the "
            f"group's {count} nodes"
        )
    if not (np.isfinite(potential) & (potential >= 0)).all() or not potential.any():
        raise MeshError(
            f"profile {name!r} must be finite, from 0 V on and not zero everywhere; drive the "
            "electrode with a negative voltage instead, or split its group in two"
        )
    return potential


def capacitance_p1(
    mesh: TetMesh,
    eps_r: ArrayLike,
    electrode_groups: Sequence[str],
    ground_groups: Iterable[str] = ("ground",),
    solver: Solver = "direct",
) -> Array:
    """Maxwell capacitance matrix [F] by conforming P1 elements, shape (M, M), symmetric.

    Solves K φ_j = 0 at the free nodes with 1 V on electrode j, 0 V on the others and on ground,
    and returns the energies C_ij = φ_iᵀ K φ_j. They bound the self terms from above, and
    an error δ of the potentials enters squared. What is in no group has a free surface (∂φ/∂n = 0).

    Args:
        mesh: The mesh.
        eps_r: Relative permittivity, one number or one for each tetrahedron, shape (k,).
        electrode_groups: Node groups in matrix order, shape (M,).
        ground_groups: Node groups held at 0 V; may be empty.
        solver: "direct" factorises (sparse LU; to some 50k nodes), "cg" iterates to a relative
            residual of 1e-10 with a diagonal preconditioner.

    Raises:
        MeshError: If a group is unknown or empty, or electrodes share nodes.
        FieldError: If `eps_r` does not fit, the solver is unknown, the system is singular, or CG
            does not converge.
    """
    if solver not in ("direct", "cg"):
        raise FieldError(f"unknown solver {solver!r}; known: direct, cg")
    potentials, free = unit_potentials(mesh, electrode_groups, ground_groups)
    matrix = stiffness(mesh, eps_r)
    inside = np.flatnonzero(free)
    if inside.size:
        system = matrix[inside][:, inside].tocsc()
        loads = -(matrix @ potentials)[inside]
        potentials[inside] = _solve(system, loads, solver)
    capacitance = potentials.T @ (matrix @ potentials)
    return 0.5 * (capacitance + capacitance.T)


def _solve(system: sp.csc_matrix, loads: Array, solver: Solver) -> Array:
    if solver == "direct":
        try:
            factors = spla.splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        except RuntimeError as error:
            raise FieldError(f"the stiffness matrix cannot be factorised: {error}") from error
        return factors.solve(loads)
    jacobi = sp.diags_array(1.0 / system.diagonal())
    out = np.empty_like(loads)
    for column in range(loads.shape[1]):
        out[:, column], status = spla.cg(
            system, loads[:, column], rtol=1e-10, maxiter=20 * len(loads), M=jacobi
        )
        if status != 0:
            raise FieldError(f"CG did not converge in {status} iterations")
    return out
