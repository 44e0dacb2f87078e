"""A graded rectilinear lattice split into Kuhn tetrahedra, and its spacings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import MeshError
from capsense.mesh.tetmesh import GROUND, TetMesh


@dataclass(frozen=True)
class MeshSettings:
    """Spacings of the planes whose cells are split into tetrahedra; all lengths in metres."""

    edge: float = 0.0036
    """Largest spacing beside an electrode's edge, in the plane."""
    growth: float = 0.53
    """Growth of the in-plane spacing per unit distance from the nearest edge."""
    far: float = 0.06
    """Largest in-plane spacing."""
    face: float = 0.0024
    """Spacing beside an electrode's face, across the plane."""
    growth_z: float = 0.207
    """Growth of the spacing across the plane per unit distance from the nearest face."""
    far_z: float = 0.013
    """Largest spacing across the plane …"""
    tall: float = 0.074
    """… or, where that is more, this fraction of the distance from the nearest face."""
    merge: float = 0.0008
    """Edges closer to each other than this share one plane."""

    def refined(self, factor: float) -> MeshSettings:
        """Return settings with ``factor`` times as many nodes along each axis."""
        return MeshSettings(
            self.edge / factor, self.growth / factor, self.far / factor, self.face / factor,
            self.growth_z / factor, self.far_z / factor, self.tall / factor,
            self.merge / max(1.0, factor),
        )  # fmt: skip


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


def _coordinates(values: ArrayLike, name: str) -> NDArray[np.float64]:
    axis = np.asarray(values, dtype=np.float64)
    if axis.ndim != 1 or len(axis) < 2:
        raise MeshError(f"{name} must be a vector of two coordinates at least, not {axis.shape}")
    if not np.isfinite(axis).all() or not (np.diff(axis) > 0).all():
        raise MeshError(f"{name} must be finite and strictly increasing")
    return axis
