"""The tetrahedral mesh {P, E, T} that fields are solved on, its quality, and Kuhn lattices."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import MeshError

Array = NDArray[np.float64]
IntArray = NDArray[np.int32]

GROUND = "ground"
"""Name of the node group of the grounded outer box."""

LOCAL_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
"""The six links of a tetrahedron as pairs of its local nodes, in the order of `tet_edges`."""

_FLATTEST = 1e-12
"""A tetrahedron whose 6·volume / (longest link)³ is below this counts as degenerate."""


@dataclass(frozen=True, eq=False)
class TetMesh:
    """A conforming mesh of linear tetrahedra in the sensor frame.

    Indices count from 0. Tetrahedra given with negative volume are reoriented. The arrays are
    copied and made read-only.

    Raises:
        MeshError: If a coordinate is not finite, an index is out of range, a tetrahedron is
            degenerate, two cell groups share a cell, or an array has the wrong shape.
    """

    points: Array
    """Node positions [m], shape (n, 3)."""
    tets: IntArray
    """Corner nodes of each tetrahedron, positively oriented, shape (k, 4)."""
    node_groups: Mapping[str, IntArray] = field(default_factory=dict)
    """Sorted nodes of each named conductor; "ground" is the outer box. Groups may overlap."""
    cell_groups: Mapping[str, IntArray] = field(default_factory=dict)
    """Sorted tetrahedra of each named region. A cell is in one group at most."""

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise MeshError(f"points must have shape (n, 3), not {points.shape}")
        if not_finite := int((~np.isfinite(points).all(axis=1)).sum()):
            raise MeshError(f"{not_finite} of {len(points)} points have a NaN or infinite entry")
        tets = _indices(self.tets, len(points), "tets", "points")
        if tets.ndim != 2 or tets.shape[1] != 4 or len(tets) == 0:
            raise MeshError(f"tets must have shape (k, 4) with k > 0, not {tets.shape}")
        with np.errstate(over="ignore", invalid="ignore"):
            six_volumes = _six_volumes(points, tets)
            sides = points[tets[:, LOCAL_EDGES[:, 0]]] - points[tets[:, LOCAL_EDGES[:, 1]]]
            longest = np.linalg.norm(sides, axis=2).max(axis=1)
            degenerate = ~(np.abs(six_volumes) > _FLATTEST * longest**3)
        if degenerate.any():
            raise MeshError(
                f"{int(degenerate.sum())} of {len(tets)} tetrahedra are degenerate (no volume); "
                f"the first is number {int(np.argmax(degenerate))}"
            )
        inverted = six_volumes < 0
        tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]

        node_groups = {
            name: _group(members, len(points), f"node group {name!r}", "points")
            for name, members in self.node_groups.items()
        }
        cell_groups = {
            name: _group(members, len(tets), f"cell group {name!r}", "tets")
            for name, members in self.cell_groups.items()
        }
        owners = np.zeros(len(tets), dtype=np.int32)
        for members in cell_groups.values():
            owners[members] += 1
        if shared := int((owners > 1).sum()):
            raise MeshError(f"{shared} tetrahedra are in more than one cell group")
        for array in (points, tets):
            array.flags.writeable = False
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "tets", tets)
        object.__setattr__(self, "node_groups", MappingProxyType(node_groups))
        object.__setattr__(self, "cell_groups", MappingProxyType(cell_groups))

    def __reduce__(self) -> tuple[Any, ...]:
        groups = dict(self.node_groups), dict(self.cell_groups)
        return TetMesh, (self.points, self.tets, *groups)

    @property
    def n_points(self) -> int:
        """Number of nodes n."""
        return len(self.points)

    @property
    def n_tets(self) -> int:
        """Number of tetrahedra k."""
        return len(self.tets)

    @cached_property
    def edges(self) -> IntArray:
        """The unique links as node pairs a < b in lexicographic order, shape (m, 2)."""
        return self._links[0]

    @cached_property
    def tet_edges(self) -> IntArray:
        """Link index of each tetrahedron's links, in the order of `LOCAL_EDGES`, shape (k, 6)."""
        return self._links[1]

    @cached_property
    def _links(self) -> tuple[IntArray, IntArray]:
        pairs = np.sort(self.tets[:, LOCAL_EDGES], axis=2).astype(np.int64)
        keys, inverse = np.unique(
            pairs[..., 0] * self.n_points + pairs[..., 1], return_inverse=True
        )
        edges = np.stack([keys // self.n_points, keys % self.n_points], axis=1).astype(np.int32)
        tet_edges = inverse.reshape(self.n_tets, 6).astype(np.int32)
        edges.flags.writeable = tet_edges.flags.writeable = False
        return edges, tet_edges

    @cached_property
    def volumes(self) -> Array:
        """Volume of each tetrahedron [m³], positive, shape (k,)."""
        return _six_volumes(self.points, self.tets) / 6.0

    @cached_property
    def centroids(self) -> Array:
        """Centroid of each tetrahedron [m], shape (k, 3)."""
        return self.points[self.tets].mean(axis=1)

    def group_nodes(self, names: Iterable[str]) -> IntArray:
        """The sorted union of node groups, shape (g,).

        Raises:
            MeshError: If a name is not a node group of this mesh.
        """
        names = tuple(names)
        for name in names:
            if name not in self.node_groups:
                known = ", ".join(self.node_groups) or "none"
                raise MeshError(f"the mesh has no node group {name!r}; it has: {known}")
        members = [self.node_groups[name] for name in names]
        return np.unique(np.concatenate([np.empty(0, np.int32), *members])).astype(np.int32)

    def cell_values(self, values: Mapping[str, float], default: float = 1.0) -> Array:
        """One number per tetrahedron, shape (k,): `values` of its cell group, else `default`.

        Raises:
            MeshError: If a name is not a cell group of this mesh.
        """
        out = np.full(self.n_tets, default, dtype=np.float64)
        for name, value in values.items():
            if name not in self.cell_groups:
                known = ", ".join(self.cell_groups) or "none"
                raise MeshError(f"the mesh has no cell group {name!r}; it has: {known}")
            out[self.cell_groups[name]] = value
        return out

    def with_groups(
        self,
        *,
        node_groups: Mapping[str, ArrayLike] | None = None,
        cell_groups: Mapping[str, ArrayLike] | None = None,
    ) -> TetMesh:
        """A copy with these groups added, or put in place of those of the same name."""
        return replace(
            self,
            node_groups={**self.node_groups, **(node_groups or {})},  # type: ignore[dict-item]
            cell_groups={**self.cell_groups, **(cell_groups or {})},  # type: ignore[dict-item]
        )

    def moved(self, offset: ArrayLike) -> TetMesh:
        """A copy shifted by `offset` [m], shape (3,), for instance into the sensor frame."""
        return replace(self, points=self.points + np.asarray(offset, dtype=np.float64))

    def quality(self) -> MeshQuality:
        """Figures of merit of the mesh; printable."""
        return mesh_quality(self)


def _six_volumes(points: Array, tets: IntArray) -> Array:
    p0, p1, p2, p3 = (points[tets[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(p1 - p0, p2 - p0), p3 - p0)


def _indices(values: ArrayLike, count: int, what: str, of: str) -> IntArray:
    """Copy integer indices below `count` into an int32 array."""
    array = np.asarray(values)
    if array.size == 0:
        return np.empty(array.shape, dtype=np.int32)
    if not np.issubdtype(array.dtype, np.integer):
        raise MeshError(f"{what} must hold integers, not {array.dtype}")
    if outside := int(((array < 0) | (array >= count)).sum()):
        raise MeshError(f"{what}: {outside} indices outside 0…{count - 1} (there are {count} {of})")
    return array.astype(np.int32)


def _group(values: ArrayLike, count: int, what: str, of: str) -> IntArray:
    members = np.unique(_indices(values, count, what, of))
    members.flags.writeable = False
    return members


def kuhn_tets(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> TetMesh:
    """Split every cell of a rectilinear lattice into six Kuhn tetrahedra.

    Each tetrahedron walks from a cell's lower corner to its upper one along the three axes, in
    one of the six orders, so neighbours conform. Its P1 stiffness couples a node only to its six
    axis neighbours, with positive weights: the diagonal links carry none. On a uniform lattice
    this is the 7-point difference stencil; on a graded one the weight of an axis link averages
    the cross-sections of the four cells around it as (2, 1, 1, 2)/6.

    Args:
        x: Strictly increasing coordinates [m] of the lattice planes, at least two, shape (nx,).
        y: The same, shape (ny,).
        z: The same, shape (nz,).

    Returns:
        Node (i, j, k) has number ``(i * ny + j) * nz + k``; cell (i, j, k) owns the tetrahedra
        ``6 * ((i * (ny - 1) + j) * (nz - 1) + k) + (0…5)``. Node group "ground" holds the six
        outer faces.

    Raises:
        MeshError: If coordinates are not finite, one-dimensional and strictly increasing.
    """
    axes = [_coordinates(values, name) for values, name in ((x, "x"), (y, "y"), (z, "z"))]
    shape = tuple(len(axis) for axis in axes)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(shape)

    corner = number[:-1, :-1, :-1].ravel()
    stride = (shape[1] * shape[2], shape[2], 1)
    tets = np.empty((len(corner), 6, 4), dtype=np.int64)
    for path, order in enumerate(permutations(range(3))):
        steps = np.cumsum([0] + [stride[axis] for axis in order])
        tets[:, path] = corner[:, None] + steps

    inner = np.zeros(shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    return TetMesh(
        points=points,
        tets=tets.reshape(-1, 4).astype(np.int32),
        node_groups={GROUND: number[~inner].astype(np.int32)},
    )


def _coordinates(values: ArrayLike, name: str) -> Array:
    axis = np.asarray(values, dtype=np.float64)
    if axis.ndim != 1 or len(axis) < 2:
        raise MeshError(f"{name} must be a vector of two coordinates at least, not {axis.shape}")
    if not np.isfinite(axis).all() or not (np.diff(axis) > 0).all():
        raise MeshError(f"{name} must be finite and strictly increasing")
    return axis


@dataclass(frozen=True)
class MeshQuality:
    """Figures of merit of a mesh. A regular tetrahedron has ratio and aspect 1, angles 70.5°."""

    n_points: int
    n_edges: int
    n_tets: int
    volume: float
    """Total volume [m³]."""
    min_volume: float
    """Smallest tetrahedron [m³]."""
    median_volume: float
    """Median tetrahedron [m³]."""
    max_volume: float
    """Largest tetrahedron [m³]."""
    min_dihedral: float
    """Smallest dihedral angle of the mesh [degrees]."""
    median_dihedral: float
    """Median over tetrahedra of their smallest dihedral angle [degrees]."""
    max_dihedral: float
    """Largest dihedral angle of the mesh [degrees]."""
    min_radius_ratio: float
    """Smallest 3·(inscribed radius)/(circumscribed radius); 1 is best, 0 is flat."""
    median_radius_ratio: float
    max_aspect: float
    """Largest (longest link)/(shortest altitude), scaled to 1 for a regular tetrahedron."""
    median_aspect: float
    negative_links: int
    """Links whose P1 weight is negative at uniform permittivity: with any, the discrete maximum
    principle and hence the sign of the off-diagonal capacitances is no longer certain."""

    def __str__(self) -> str:
        share = self.negative_links / self.n_edges
        return "\n".join(
            [
                f"nodes {self.n_points}, links {self.n_edges}, tetrahedra {self.n_tets}",
                f"volume {self.volume:.6g} m³; of a tetrahedron {self.min_volume:.3g} to "
                f"{self.max_volume:.3g} m³, median {self.median_volume:.3g} m³",
                f"dihedral angles {self.min_dihedral:.2f}° to {self.max_dihedral:.2f}°, "
                f"median of the smallest {self.median_dihedral:.2f}°",
                f"radius ratio min {self.min_radius_ratio:.3g}, "
                f"median {self.median_radius_ratio:.3g}",
                f"aspect max {self.max_aspect:.3g}, median {self.median_aspect:.3g}",
                f"negative link weights {self.negative_links} ({share:.1%})",
            ]
        )


def dihedral_angles(points: Array, tets: NDArray[np.int32]) -> Array:
    """Dihedral angle [rad] along each link of each tetrahedron, in link order, shape (k, 6)."""
    corners = points[tets]
    out = np.empty((len(tets), 6))
    for link, (a, b) in enumerate(LOCAL_EDGES):
        c, d = (i for i in range(4) if i not in (a, b))
        along = corners[:, b] - corners[:, a]
        left = np.cross(along, corners[:, c] - corners[:, a])
        right = np.cross(along, corners[:, d] - corners[:, a])
        sine = np.linalg.norm(np.cross(left, right), axis=1)
        out[:, link] = np.arctan2(sine, np.einsum("ij,ij->i", left, right))
    return out


def negative_links(mesh: TetMesh, angles: Array, lengths: Array) -> int:
    """Number of links with a negative P1 weight at uniform permittivity.

    The weight of a link is Σ l·cot(θ)/6 over its tetrahedra, where l and θ are the length and
    dihedral angle of the opposite link. Zero up to rounding does not count as negative.
    """
    opposite = [5, 4, 3, 2, 1, 0]
    shares = (lengths / np.tan(angles) / 6.0)[:, opposite]
    n_edges = len(mesh.edges)
    flat = mesh.tet_edges.ravel()
    weights = np.bincount(flat, weights=shares.ravel(), minlength=n_edges)
    scale = np.bincount(flat, weights=(lengths / 6.0)[:, opposite].ravel(), minlength=n_edges)
    return int((weights < -1e-9 * scale).sum())


def mesh_quality(mesh: TetMesh) -> MeshQuality:
    """Compute the figures of merit of `mesh`."""
    corners = mesh.points[mesh.tets]
    lengths = np.linalg.norm(corners[:, LOCAL_EDGES[:, 1]] - corners[:, LOCAL_EDGES[:, 0]], axis=2)
    faces = corners[:, [(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)]]
    areas = 0.5 * np.linalg.norm(
        np.cross(faces[:, :, 1] - faces[:, :, 0], faces[:, :, 2] - faces[:, :, 0]), axis=2
    )
    volumes = mesh.volumes
    inradius = 3.0 * volumes / areas.sum(axis=1)
    # Crelle: 24·R·V = sqrt(s (s−p)(s−q)(s−r)·16) of the products of opposite link lengths.
    p, q, r = (lengths[:, i] * lengths[:, 5 - i] for i in range(3))
    product = (p + q + r) * (p + q - r) * (p - q + r) * (q + r - p)
    circumradius = np.sqrt(np.maximum(product, 0.0)) / (24.0 * volumes)
    ratio = 3.0 * inradius / circumradius
    shortest_altitude = 3.0 * volumes / areas.max(axis=1)
    aspect = lengths.max(axis=1) / shortest_altitude * np.sqrt(2.0 / 3.0)
    angles = dihedral_angles(mesh.points, mesh.tets)
    degrees = np.degrees(angles)
    return MeshQuality(
        n_points=mesh.n_points,
        n_edges=len(mesh.edges),
        n_tets=mesh.n_tets,
        volume=float(volumes.sum()),
        min_volume=float(volumes.min()),
        median_volume=float(np.median(volumes)),
        max_volume=float(volumes.max()),
        min_dihedral=float(degrees.min()),
        median_dihedral=float(np.median(degrees.min(axis=1))),
        max_dihedral=float(degrees.max()),
        min_radius_ratio=float(ratio.min()),
        median_radius_ratio=float(np.median(ratio)),
        max_aspect=float(aspect.max()),
        median_aspect=float(np.median(aspect)),
        negative_links=negative_links(mesh, angles, lengths),
    )
