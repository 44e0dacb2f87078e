"""Conducting sheets: surfaces made of planar facets, with the rims where charge piles up."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Facet:
    """A planar polygon, possibly with holes, placed in the sensor frame.

    A point (u, v) of the polygon lies at ``origin + u * axes[0] + v * axes[1]``; ``axes[2]`` is
    the facet's normal. Lengths in metres. Flat horizontal sheets of a loaded design have the sensor
    frame's axes and the origin (0, 0, z), so that (u, v) are sensor coordinates (x, y).
    """

    polygon: Polygon
    """Outline in the facet's own plane, (u, v) [m], counterclockwise; holes run clockwise."""
    origin: Array
    """Origin of the facet's plane [m] in the sensor frame, shape (3,)."""
    axes: Array
    """Orthonormal right-handed axes u, v, n as rows, in the sensor frame, shape (3, 3)."""

    def to_sensor(self, uv: Array) -> Array:
        """Map plane coordinates, shape (..., 2), to the sensor frame, shape (..., 3)."""
        uv = np.asarray(uv, dtype=float)
        return self.origin + uv @ self.axes[:2]


@dataclass(frozen=True, eq=False)
class Surface:
    """A conducting sheet of zero thickness: an electrode, a pour, a shield or a housing.

    ``rims`` are the line segments along which the charge density is singular: free boundaries
    and sharp creases. The offline field solver grades its panels towards them.
    """

    facets: tuple[Facet, ...]
    rims: Array
    """Singular line segments [m] in the sensor frame, shape (k, 2, 3)."""

    @cached_property
    def triangles(self) -> Array:
        """A triangulation of the sheet [m] in the sensor frame, shape (n, 3, 3)."""
        out: list[Array] = []
        for facet in self.facets:
            for tri in shapely.constrained_delaunay_triangles(facet.polygon).geoms:
                out.append(facet.to_sensor(np.asarray(tri.exterior.coords)[:3]))
        return np.array(out).reshape(-1, 3, 3)

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m], shape (2, 3)."""
        points = np.concatenate(
            [f.to_sensor(shapely.get_coordinates(f.polygon.exterior)) for f in self.facets]
        )
        return np.array([points.min(axis=0), points.max(axis=0)])

    @cached_property
    def area(self) -> float:
        """Area [m²] of one side of the sheet."""
        return float(sum(f.polygon.area for f in self.facets))


def ring_vertices(facet: Facet) -> list[Array]:
    """Vertices [m] of a facet's outline and of each hole in the sensor frame, each (k, 3)."""
    rings = (facet.polygon.exterior, *facet.polygon.interiors)
    return [facet.to_sensor(shapely.get_coordinates(ring)[:-1]) for ring in rings]


def boundary_segments(facet: Facet) -> Array:
    """Edges [m] of a facet's outline and holes in the sensor frame, shape (k, 2, 3)."""
    rings = ring_vertices(facet)
    return np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings])
