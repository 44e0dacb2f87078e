"""A rigid shape as the step takes it: charge functions, and their energies in free space.

The functions are the equilibrium charge of the shape and, for every split of a binary tree of its
panels, one part's share of it minus the other's: Haar functions, weighted with the equilibrium
charge. All but the first are without net charge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from capsense._dense import cholesky, substitute, whole_lines
from capsense._frozen import Frozen
from capsense._jit import compiled
from capsense.errors import SolveError
from capsense.solver.bodies.blocks import free_block, impedance
from capsense.solver.bodies.panels import Mirrors, SurfacePanels
from capsense.solver.tree import tree_kernels

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

INSIDE = 2.5
"""Interior impedance of a surface that is open or changes, over its energy in free space: it is 3
for a ball in an even field, and 2 for the face of a half-space."""
HALF_SPACE = 2.0
"""The same where a surface is flat and thick."""
SOFT, ROUND = 0.15, 0.82
"""1/r from the four points of a cluster is bounded below a distance whose square is that of its
extent times the first, squared, and its least second moment times the second. Two flat squares, or
two balls, that coincide then have no more energy between them than each has alone."""
_NORMALS, _ACROSS = 0.6, 1.25
"""How far apart opposite normals count in splitting, twice the smaller one of: the first times the
shape's extent, the second times its second-largest one. So limbs are cut across first."""
_GRAIN = 1e-9
"""Coordinates closer than this part of the extent are the same: cuts do not hang on rounding."""
_EXTRA = 0.0, 1e-3, 1e-2, 0.1
"""What is added to the panels' own energies, relative, where some nearly coincide."""
_LEFT, _MOST_STEPS = 1e-8, 1000
"""Conjugate gradients end when so little of the residual is left, or after so many steps."""
_LEAST_DENSITY = 0.1
"""Smallest charge density of a panel over the mean one. Panels of convex bodies have more; those
within a cavity have next to none, by many orders, and functions weighted with that would leave most
of its surface without charge."""
BODY = np.dtype(
    [
        ("n", np.int64),  # panels, or parts of them; there are 2 n - 1 clusters
        ("n_panel_clusters", np.int64),  # the first so many of these are no parts of panels
        ("children", np.int64), ("function", np.int64), ("charge", np.int64), ("center", np.int64),
        ("points", np.int64), ("extent", np.int64), ("own", np.int64),
        ("softening_length", np.int64),
        ("potential_coefficients", np.int64),
        ("neumann_to_dirichlet", np.int64),  # all of these: where the arrays of a RigidShape stand
        # functions that have energies and impedances there, the first ones
        ("n_tabulated", np.int64),
        ("spread", np.int64),  # second moments of a changing surface, which has no points, else 0
        ("means", np.int64), ("top", np.int64),  # means of 1/r within its first so many clusters
        ("outline", np.int64), ("closed", np.int64),  # code of the outline; whether it is closed
        ("sizes", np.float64, 3),  # of a primitive, as its ``params``
        ("triangles", np.int64), ("boxes", np.int64),  # of a mesh: addresses of its tree
        ("triangle_count", np.int64), ("levels", np.int64),
        ("capacitance", np.float64),  # of the shape in free space [m]
        ("scale", np.float64),  # the body is so many times as large as the shape
        ("rotation", np.float64, (3, 3)), ("position", np.float64, 3),
        ("sunk", np.float64),  # how far below that it stands in a cover [m], once it is pressed out
        ("neutral", np.int64),  # whether it carries no net charge
        ("free", np.float64),  # how little a conductor is tied to ground, see ``looseness``
        ("group", np.int64),  # bodies that touch are one conductor, named by its first body
        # energy of a group's net charge beyond that of its field [1/m]
        ("ground_elastance", np.float64),
        ("local_tie", np.float64),  # its capacitance to the local ground [m]; 0 for none
        ("inside", np.float64),  # impedance of its inside, over its energy; 0 for a sheet
        ("sheet", np.float64),  # thickness of a changing sheet of a dielectric [m]; else 0
        ("faces", np.int64),  # by how much energies are less as its charge is on both faces [1/m]
        # thickness of a layer of dipoles [m], 0 for charges; mean normals of its clusters; and of
        # each of its pieces three points, normal and area
        ("layer", np.float64), ("normals", np.int64), ("pieces", np.int64),
        ("inverse_susceptibility", np.float64),  # 1 / (eps - 1), 0 for a conductor
        # about what its inside adds to energies, over them, as it scores
        ("polarization_stiffness", np.float64),
        ("demand", np.float64),  # functions count from a threshold on that is 1 plus this lower
    ]
)  # fmt: skip
"""One body, as the kernels take it."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """A binary tree of clusters, breadth first; n panels make 2 n - 1 of them."""

    children: Ints
    """The two parts of each cluster, -1 for a single panel, shape (2 n - 1, 2)."""
    function: Ints
    """Charge function that splits a cluster, -1 for a single panel, shape (2 n - 1,)."""
    panel: Ints
    """Panel of a cluster without parts, else -1, shape (2 n - 1,)."""


@dataclass(frozen=True, eq=False)
class Tree(Clusters):
    """Clusters of panels, with the equilibrium charge on them."""

    charge: Array
    """Share of each cluster in the equilibrium charge, shape (2 n - 1,)."""
    center: Array
    """Centres of charge [m], shape (2 n - 1, 3)."""
    points: Array
    """Four points with the centre and the two largest second moments of a cluster's charge [m],
    shape (2 n - 1, 4, 3)."""
    extent: Array
    """Length of a uniform rod with the cluster's largest second moment [m], shape (2 n - 1,)."""
    softening_length: Array
    """Distance below which 1/r from the points is bounded [m], shape (2 n - 1,)."""


def once(shape: object, name: str, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """An array of a shape that threads that meet here share: records point to it."""
    found = shape.__dict__.get(name)
    return shape.__dict__.setdefault(name, make()) if found is None else found


@dataclass(frozen=True, eq=False)
class RigidShape(Frozen):
    """Charge functions of a shape in its own frame; 4π eps0 = 1 in all energies.

    A record is good only where its arrays stand, so that no copy takes it along.
    """

    panels: SurfacePanels
    tree: Tree
    potential_coefficients: Array32
    """Mean potential of one charge function on another, free space [1/m], shape (n, n)."""
    capacitance: float
    """Capacitance in free space over 4π eps0 [m]."""

    @property
    def radius(self) -> float:
        """Radius of a ball about the origin that holds the shape [m]."""
        return float(np.linalg.norm(self.panels.corners, axis=2).max())

    @property
    def own(self) -> Array:
        """Diagonal of ``energy`` [1/m], shape (n,)."""
        return once(self, "_own", lambda: np.diag(self.potential_coefficients).astype(float))

    @cached_property
    def record(self) -> np.void:
        """The fields of a body's record that follow from its shape; points to arrays held here."""
        record = np.zeros(1, BODY)[0]
        record["n"] = record["n_tabulated"] = len(self.panels)
        record["n_panel_clusters"] = 2 * len(self.panels) - 1
        record["capacitance"] = self.capacitance
        record["potential_coefficients"], record["own"] = (
            self.potential_coefficients.ctypes.data,
            self.own.ctypes.data,
        )
        for name in (
            "children",
            "function",
            "charge",
            "center",
            "points",
            "extent",
            "softening_length",
        ):
            record[name] = getattr(self.tree, name).ctypes.data
        return record

    @property
    def neumann_to_dirichlet(self) -> Array32:
        """Interior impedance Z of the charge functions [1/m], shape (n, n).

        A body of permittivity eps adds ``Z / (eps - 1)`` to ``energy``. That of an open surface is
        not known; it is taken for :data:`INSIDE` times ``energy``.
        """
        return once(self, "_impedance", self._inside)

    def _inside(self) -> Array32:
        if not self.panels.closed:
            z = np.float32(INSIDE) * self.potential_coefficients
            z[0] = z[:, 0] = 0.0
            return z
        with threadpool_limits(1, "blas"):  # bits depend on how many threads a BLAS has
            z = impedance(self.panels, free_block(self.panels))
        return _of_functions(self.tree, z)

    @property
    def nbytes(self) -> int:
        """Room that the matrices take up [bytes]."""
        z = self.__dict__.get("_impedance")
        return self.potential_coefficients.nbytes + (0 if z is None else z.nbytes)


def rigid_shape(panels: SurfacePanels, *, apart: bool = False, most: float = np.inf) -> RigidShape:
    """Work out charge functions and energies.

    Args:
        panels: The surface.
        apart: Whether it is known that no two panels lie within each other, as on a primitive. Of
            others it is looked into, at some cost.
        most: Opposite normals count as twice so much apart at most [m], in telling faces apart.

    Raises:
        SolveError: The panels lie within each other, so that their block is not definite.
    """
    free = free_block(panels)
    charge = equilibrium(free, panels.mirrors) if apart else _made_definite(free)
    tree = build_tree(panels, spread_out(charge, panels.areas), most)
    return RigidShape(panels, tree, _of_functions(tree, free), float(charge.sum()))


def spread_out(charge: Array, areas: Array) -> Array:
    """Charges (n,) of panels, raised to a least density, see :data:`_LEAST_DENSITY`."""
    return np.asarray(np.maximum(charge, _LEAST_DENSITY * charge.sum() / areas.sum() * areas))


def equilibrium(free: Array, mirrors: Mirrors | None = None, left: float = _LEFT) -> Array:
    """Charges that put all panels at 1 V, by conjugate gradients, free (n, n) -> (n,).

    Mirror images carry the same charge, so that only the first of them is an unknown. The energy
    of what the potentials lack falls to ``left`` squared of the whole.
    """
    matrix, sides, number = free, np.ones(len(free)), np.arange(len(free))
    if mirrors is not None:
        firsts, number = np.unique(mirrors.first, return_inverse=True)
        sides = np.bincount(number).astype(float)
        matrix = _folded(free, firsts, number, sides)
    charge = np.zeros(len(matrix))
    if not _conjugate_gradients(matrix, sides, charge, left):
        raise SolveError(
            f"the charges of {len(free)} panels do not converge; make bodies thicker that are less "
            "than 1/20,000 as thick as they are wide, or leave out dielectric films"
        )
    return charge[number]


@compiled
def _folded(free: Array, firsts: Ints, number: Ints, sides: Array) -> Array:
    """The rows of the first images, summed over mirror images and times their number, (k, k)."""
    out = np.zeros((len(firsts), len(firsts)))
    for k in range(len(firsts)):
        for j in range(free.shape[1]):
            out[k, number[j]] += free[firsts[k], j]
        for j in range(len(firsts)):
            out[k, j] *= sides[k]
    return out


@compiled
def _conjugate_gradients(matrix: Array, residual: Array, x: Array, left: float) -> bool:
    """Solve ``matrix @ x = residual``, the latter lost; False without convergence.

    The diagonal is the preconditioner. Compiled, so that bits do not depend on where arrays lie, as
    those of a BLAS may.
    """
    n = x.shape[0]
    way, product = np.empty(n), np.empty(n)
    first = before = 0.0
    for step in range(_MOST_STEPS):
        energy = 0.0
        for i in range(n):
            energy += residual[i] * residual[i] / matrix[i, i]
        if step == 0:
            first = energy
        elif energy <= left * left * first:
            return True
        share = energy / before if step > 0 else 0.0
        for i in range(n):
            way[i] = residual[i] / matrix[i, i] + (share * way[i] if step > 0 else 0.0)
        product[:] = 0.0
        for j in range(n):  # the matrix is symmetric: row by row many sums go on at once
            for i in range(n):
                product[i] += matrix[j, i] * way[j]
        curvature = 0.0
        for i in range(n):
            curvature += way[i] * product[i]
        length = energy / curvature
        for i in range(n):
            x[i] += length * way[i]
            residual[i] -= length * product[i]
        before = energy
    return False


def _made_definite(free: Array) -> Array:
    """Solve where the diagonal may have to be raised first, in place."""
    own = np.diag(free).copy()
    for extra in _EXTRA:
        np.fill_diagonal(free, (1.0 + extra) * own)
        factor = np.zeros((len(free), whole_lines(len(free))))
        factor[:, : len(free)] = free
        if cholesky(factor):  # several threads of LAPACK hinder each other on busy machines
            break
    else:
        raise SolveError(
            f"the surface of {len(free)} panels intersects itself: the matrix of its panels is not "
            "positive definite; remove doubled faces"
        )
    sides = np.ones((len(free), 8))
    substitute(factor, sides)
    return sides[:, 0].copy()


def build_tree(panels: SurfacePanels, charge: Array, most: float = np.inf) -> Tree:
    """Split panels into clusters; ``charge`` (n,) is their equilibrium charge, above zero.

    Opposite normals count as twice ``most`` [m] apart at most.
    """
    at = features(panels.centers, panels.normals, most)
    return charged_tree(panels, split(at, charge), charge)


def features(centers: Array, normals: Array, most: float = np.inf) -> Array:
    """Centres and scaled normals (n, 3) of panels, as :func:`split` takes them [m], (n, 6).

    Opposite normals count as twice ``most`` [m] apart at most.
    """
    _, width, extent = np.sort(np.ptp(centers, axis=0)).tolist()
    apart = min(_NORMALS * extent, _ACROSS * width, most)
    return np.concatenate([centers, apart * normals], axis=1)


def charged_tree(panels: SurfacePanels, clusters: Clusters, charge: Array) -> Tree:
    """Clusters of panels with their charges (n,) entered."""
    n, children, panel = len(panels), clusters.children, clusters.panel
    single = panel >= 0
    share, center = np.empty(2 * n - 1), np.empty((2 * n - 1, 3))
    spread = np.empty((2 * n - 1, 3, 3))
    share[single] = charge[panel[single]] / charge.sum()
    center[single], spread[single] = panels.centers[panel[single]], panels.moments[panel[single]]
    tree_kernels.moments(children, panel, share, center, spread)
    points, extent, soft = four_points_of(center, spread)
    return Tree(children, clusters.function, panel, share, center, points, extent, soft)


def four_points_of(center: Array, spread: Array) -> tuple[Array, Array, Array]:
    """Four points (k, 4, 3), extents and least distances (k,) of clusters, see :class:`Tree`.

    Args:
        center: Centres of charge [m], shape (k, 3).
        spread: Second central moments of the charge over the charge [m²], shape (k, 3, 3).
    """
    size, axes = np.linalg.eigh(spread)
    size = np.maximum(size, 0.0)
    arms = (axes * np.sqrt(size)[:, None]).transpose(0, 2, 1)
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    points = center[:, None] + signs @ arms[:, 1:]
    extent = np.sqrt(12.0 * size[:, 2])
    return points, extent, np.sqrt((SOFT * extent) ** 2 + ROUND * size[:, 0])


def split(features: Array, charge: Array) -> Clusters:
    """Split panels into clusters by their centres and scaled normals (n, 6) and charges (n,)."""
    n = len(features)
    order, first, last = np.empty(n, np.int64), *np.empty((2, 2 * n - 1), np.int64)
    children = np.empty((2 * n - 1, 2), np.int64)
    grain = _GRAIN * float(np.ptp(features[:, :3], axis=0).max())
    tree_kernels.split(np.round(features / grain), charge, order, first, last, children)
    single = children[:, 0] < 0
    panel = np.where(single, order[first], -1)
    return Clusters(children, np.where(single, -1, np.cumsum(~single)), panel)


def _of_functions(tree: Tree, block: Array) -> Array32:
    """Change a symmetric block of panels to one of charge functions."""
    return tree_kernels.table_of_functions(
        block, tree.children, tree.panel, tree.charge, tree.function
    )
