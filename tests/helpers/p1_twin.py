"""P1 finite elements on tetrahedra, written to be read: what the masked scheme must agree with.

With ∇λ_a the constant gradient of node a's hat function on an element e of volume V_e,

    K_ab = Σ_e ε0 ε_e V_e ∇λ_a·∇λ_b,        w_ab = −K_ab for a link ab.

K's rows sum to zero, so it is the Laplacian of a graph whose links carry the weights w [F].
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from capsense.constants import EPS0
from capsense.mesh import TetMesh

Array = NDArray[np.float64]


def stiffness(mesh: TetMesh, eps_r: ArrayLike = 1.0) -> sp.csr_matrix:
    """K [F], shape (n, n), for one relative permittivity or one for each tetrahedron."""
    corners = mesh.points[mesh.tets]
    # λ_a falls from 1 to 0 along the normal of the face across from a, of area |n_a| / 2.
    normals = np.empty_like(corners)
    for a, face in enumerate(((1, 3, 2), (0, 2, 3), (0, 3, 1), (0, 1, 2))):
        p, q, r = (corners[:, k] for k in face)
        normals[:, a] = np.cross(q - p, r - p)
    grads = normals / (6 * mesh.volumes)[:, None, None]
    local = np.einsum("kad,kbd->kab", grads, grads)
    local *= EPS0 * (np.broadcast_to(eps_r, mesh.n_tets) * mesh.volumes)[:, None, None]
    rows, columns = np.repeat(mesh.tets, 4, axis=1), np.tile(mesh.tets, (1, 4))
    shape = (mesh.n_points, mesh.n_points)
    return sp.csr_matrix((local.ravel(), (rows.ravel(), columns.ravel())), shape=shape)


def link_weights(mesh: TetMesh, eps_r: ArrayLike = 1.0) -> Array:
    """Weight of every link of the mesh [F], shape (m,)."""
    a, b = mesh.edges.T
    return -np.asarray(stiffness(mesh, eps_r)[a, b]).ravel()


def capacitance_p1(
    mesh: TetMesh,
    eps_r: ArrayLike,
    electrodes: Sequence[str],
    ground: Iterable[str] = ("ground",),
) -> Array:
    """Maxwell matrix [F] of node groups, C_ij = φ_iᵀ K φ_j, shape (M, M).

    K φ_j = 0 at the free nodes, with 1 V on electrode j, 0 V on the others and on ground. What is
    in no group has a free surface (∂φ/∂n = 0).
    """
    matrix = stiffness(mesh, eps_r)
    phi = np.zeros((mesh.n_points, len(electrodes)))
    free = np.ones(mesh.n_points, dtype=bool)
    for column, name in enumerate(electrodes):
        phi[mesh.node_groups[name], column] = 1.0
    for name in (*electrodes, *ground):
        free[mesh.node_groups[name]] = False
    if free.any():
        phi[free] = splu(matrix[free][:, free].tocsc()).solve(-(matrix @ phi)[free])
    return phi.T @ (matrix @ phi)


def boundary_faces(mesh: TetMesh) -> NDArray[np.int32]:
    """Triangles that belong to one tetrahedron only, shape (b, 3), unordered."""
    faces = np.sort(mesh.tets[:, [(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)]].reshape(-1, 3))
    unique, counts = np.unique(faces, axis=0, return_counts=True)
    return unique[counts == 1]
