"""Figures that tell whether a mesh is fit for P1 finite elements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.mesh.tetmesh import LOCAL_EDGES, TetMesh

Array = NDArray[np.float64]


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
