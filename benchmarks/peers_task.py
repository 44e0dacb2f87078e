"""The task of ``peers.py``: a grounded bar moves over ``six_patch_bare``; the peers' meshes.

Every peer gets the same linear systems. The bar (150 × 150 × 20 mm, parallel to the sensor) holds
the nodes inside it at 0 V. The staircase of the paper, where every node of a tetrahedron whose
centroid lies in the bar is held, grows the bar by half an element; nodes inside shrink it, by less,
which the too large P1 field partly makes up for. The peers get the rule with the smaller errors.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

import capsense as cs
from capsense.masked import MeshSensor
from capsense.masked.solver import StiffnessMap
from capsense.mesh import TetMesh, mesh_design

Array = NDArray[np.float64]
Nodes = NDArray[np.int64]

DESIGN = "six_patch_bare"
SIZE = np.array([0.15, 0.15, 0.02])
"""The bar [m]."""
GAPS = (5, 10, 20, 50, 100)
"""Gaps [mm] at which errors are taken, bar centred."""
GAP = 0.03
"""Gap [m] of the timed steps."""
SPEED, RATE = 0.116, 100.0
"""Speed of the bar [m/s] and samples a second [Hz] of the timed steps."""
SAMPLES = 300
"""Timed samples of one way across the sensor."""
REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "reference_capacitances.json"
"""Boundary-element figures, good to about 0.1 %."""


def timed_place(k: int) -> tuple[float, float]:
    """x [m] and gap [m] of sample k."""
    return -0.174 + (k % SAMPLES) * SPEED / RATE, GAP


def reference(gap: int) -> Array:
    """Reference ΔC [F] at a gap [mm], shape (6, 6)."""
    table = json.loads(REFERENCE.read_text())[DESIGN]
    return 1e-12 * (np.array(table[f"bar {gap}"]) - np.array(table["none"]))


def baseline() -> Array:
    """Reference C⁰ [F], shape (6, 6)."""
    return 1e-12 * np.array(json.loads(REFERENCE.read_text())[DESIGN]["none"])


def diagonal_error(delta: Array, gap: int) -> float:
    """The relative error of a diagonal entry of ΔC that is largest in size, with its sign."""
    error = np.diag(delta) / np.diag(reference(gap)) - 1
    return float(error[np.abs(error).argmax()])


def bar_corners(x: float, gap: float) -> tuple[Array, Array]:
    """Lower and upper corner [m] of the bar."""
    lower = np.array([x - SIZE[0] / 2, -SIZE[1] / 2, gap])
    return lower, lower + SIZE


def within(points: tuple[Array, Array, Array], lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Which points, given by coordinates, lie in a box."""
    inside = (points[2] >= lower[2]) & (points[2] <= upper[2])
    for axis in (0, 1):
        inside &= (points[axis] >= lower[axis]) & (points[axis] <= upper[axis])
    return inside


@dataclass(frozen=True, eq=False)
class System:
    """K x = b at the free nodes, without the bar; six right-hand sides."""

    matrix: sp.csr_matrix
    """Stiffness of the free nodes [F], shape (n, n)."""
    loads: Array
    """Right-hand sides [F V], shape (n, 6)."""
    fixed_energy: Array
    """C = fixed_energy − bᵀ x [F], shape (6, 6)."""
    points: tuple[Array, Array, Array]
    """Coordinates of the free nodes [m]."""
    n_tets: int
    order: int

    def held(self, x: float, gap: float) -> NDArray[np.bool_]:
        """Which free nodes lie in the bar."""
        return within(self.points, *bar_corners(x, gap))


def make_system(
    matrix: sp.csr_matrix, values: Array, free: Nodes, points: Array, n_tets: int, order: int
) -> System:
    """Split the stiffness of all nodes [F] into free ones and given potentials ``values`` [V]."""
    image = matrix @ values
    inner = matrix[free][:, free].tocsr()
    inner.sort_indices()
    x, y, z = np.ascontiguousarray(points[free].T)
    return System(inner, -image[free], values.T @ image, (x, y, z), n_tets, order)


def p1_system(mesh: TetMesh) -> System:
    """The P1 system of a mesh."""
    values, free = MeshSensor(mesh, design().electrode_names).unit_potentials()
    stiffness = StiffnessMap(mesh)
    matrix = stiffness.matrix(stiffness.assemble(np.ones(mesh.n_tets)))
    return make_system(matrix, values, np.flatnonzero(free), mesh.points, mesh.n_tets, 1)


def p2_system(mesh: TetMesh) -> System:
    """The P2 system of a mesh, assembled by scikit-fem.

    Raises:
        ImportError: scikit-fem is not installed.
    """
    import skfem
    from skfem.models.poisson import laplace

    from capsense.constants import EPS0

    basis = skfem.Basis(
        skfem.MeshTet(np.ascontiguousarray(mesh.points.T), np.ascontiguousarray(mesh.tets.T)),
        skfem.ElementTetP2(),
    )
    points = basis.doflocs.T
    owner = np.full(len(points), -1)
    lower, upper = design().domain.lower, design().domain.upper
    owner[((np.abs(points - lower) < 1e-9) | (np.abs(points - upper) < 1e-9)).any(axis=1)] = 6
    for k, electrode in enumerate(design().electrodes):
        low, high = electrode.surface.bounds
        owner[((points > low - 1e-9) & (points < high + 1e-9)).all(axis=1)] = k
    values = (owner[:, None] == np.arange(6)).astype(float)
    matrix = (EPS0 * laplace.assemble(basis)).tocsr()
    return make_system(matrix, values, np.flatnonzero(owner < 0), points, mesh.n_tets, 2)


@cache
def design() -> cs.Design:
    """The sensor."""
    return cs.load_design(DESIGN)


def conforming_mesh(scale: float, folder: Path) -> TetMesh:
    """A mesh that conforms to the electrodes, all element sizes times ``scale``; kept in a folder.

    The family is the one with the smallest errors among those tried at 30,000 and 100,000
    tetrahedra: 2 mm at the rims, growing by 0.15 a unit of distance, up to 30 mm.
    """
    path = folder / f"six_patch_bare_{scale:g}.npz"
    if path.exists():
        with np.load(path) as data:
            groups = {k: data[k] for k in data.files if k not in ("points", "tets")}
            return TetMesh(data["points"], data["tets"], node_groups=groups)
    mesh = mesh_design(
        design(), size_at_edges=2e-3 * scale, growth=0.15 * scale, size_far=0.03 * scale
    )
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(path, points=mesh.points, tets=mesh.tets, **mesh.node_groups)
    return mesh
