"""Planar facets and sheets made of them; where sheets meet each other and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon, box

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


def box_facets(lower: Array, upper: Array) -> tuple[Facet, ...]:
    """The six faces of an upright box, normals outwards."""
    faces = []
    size, center = upper - lower, (lower + upper) / 2
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n = np.zeros(3)
            n[axis] = sign
            u = np.zeros(3)
            u[(axis + 1) % 3] = 1.0
            half_u, half_v = size[(axis + 1) % 3] / 2, size[(axis + 2) % 3] / 2
            outline = box(-half_u, -half_v, half_u, half_v)
            faces.append(
                Facet(outline, center + n * size[axis] / 2, np.array([u, np.cross(n, u), n]))
            )
    return tuple(faces)


def ring_vertices(facet: Facet) -> list[Array]:
    """Vertices [m] of a facet's outline and of each hole in the sensor frame, each (k, 3)."""
    rings = (facet.polygon.exterior, *facet.polygon.interiors)
    return [facet.to_sensor(shapely.get_coordinates(ring)[:-1]) for ring in rings]


def boundary_segments(facet: Facet) -> Array:
    """Edges [m] of a facet's outline and holes in the sensor frame, shape (k, 2, 3)."""
    rings = ring_vertices(facet)
    return np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings])


TOUCH = 1e-6
"""Sheets closer than this [m] touch; a sheet this close to a face lies on it."""


def find_contact(a: Surface, b: Surface) -> Array | None:
    """A point [m] in the sensor frame, shape (3,), where two surfaces meet, or None.

    Two planar facets meet if, and only if, an edge of one meets the other; so every edge is cut
    to the part that lies within :data:`TOUCH` of the other's plane and measured there.
    """
    bounds_a, bounds_b = facet_bounds(a), facet_bounds(b)
    near_a = np.flatnonzero(_overlap(bounds_a, b.bounds[None]))
    near_b = np.flatnonzero(_overlap(bounds_b, a.bounds[None]))
    for i in near_a:
        for j in near_b[_overlap(bounds_b[near_b], bounds_a[i : i + 1])]:
            for one, other in ((a.facets[i], b.facets[j]), (b.facets[j], a.facets[i])):
                point = _edge_contact(boundary_segments(one), other)
                if point is not None:
                    return point
    return None


def facet_bounds(surface: Surface) -> Array:
    """Bounding boxes [m] of the facets, shape (n, 2, 3)."""
    out = []
    for facet in surface.facets:
        points = ring_vertices(facet)[0]
        out.append([points.min(axis=0), points.max(axis=0)])
    return np.array(out)


def _overlap(boxes: Array, other: Array) -> NDArray[np.bool_]:
    low, high = boxes[:, 0] - TOUCH, boxes[:, 1] + TOUCH
    return np.all((low <= other[:, 1]) & (high >= other[:, 0]), axis=1)


def _edge_contact(segments: Array, facet: Facet) -> Array | None:
    local = (segments - facet.origin) @ facet.axes.T
    n0, n1 = local[:, 0, 2], local[:, 1, 2]
    slope = n1 - n0
    flat = np.abs(slope) < 1e-15
    safe = np.where(flat, 1.0, slope)
    ends = np.sort(np.stack([(-TOUCH - n0) / safe, (TOUCH - n0) / safe]), axis=0)
    t0 = np.where(flat, np.where(np.abs(n0) <= TOUCH, 0.0, 2.0), np.maximum(ends[0], 0.0))
    t1 = np.where(flat, 1.0, np.minimum(ends[1], 1.0))
    keep = t0 <= t1
    if not keep.any():
        return None
    start, way = local[keep, 0, :2], local[keep, 1, :2] - local[keep, 0, :2]
    uv = np.stack([start + t0[keep, None] * way, start + t1[keep, None] * way], axis=1)
    lines = shapely.linestrings(uv)
    distance = shapely.distance(lines, facet.polygon)
    best = int(np.argmin(distance))
    if distance[best] > TOUCH:
        return None
    on_facet = shapely.get_coordinates(shapely.shortest_line(lines[best], facet.polygon))[-1]
    return facet.to_sensor(on_facet)


def coplanar_overlap(a: Surface, b: Surface) -> float:
    """Area [m²] over which two surfaces lie on each other."""
    total = 0.0
    for facet in a.facets:
        for other in b.facets:
            outline = in_plane_of(facet, other)
            if outline is not None:
                total += float(facet.polygon.intersection(outline).area)
    return total


def in_plane_of(facet: Facet, other: Facet) -> Polygon | None:
    """The outline of ``other`` in the (u, v) of ``facet`` [m], or None if not in its plane."""
    rings = [r - facet.origin for r in ring_vertices(other)]
    if np.abs(rings[0] @ facet.axes[2]).max() > TOUCH:
        return None
    flat = [r @ facet.axes[:2].T for r in rings]
    return Polygon(flat[0], flat[1:])


def enters_box(surface: Surface, lower: Array, upper: Array) -> bool:
    """Whether any part of the surface lies inside a box by more than :data:`TOUCH`."""
    low, high = lower + TOUCH, upper - TOUCH
    bounds = facet_bounds(surface)
    near = np.all((bounds[:, 0] <= high) & (bounds[:, 1] >= low), axis=1)
    return any(_facet_in_box(surface.facets[i], low, high) for i in np.flatnonzero(near))


def _facet_in_box(facet: Facet, low: Array, high: Array) -> bool:
    """Clip the facet's bounding rectangle to the box, then intersect in the facet's plane."""
    corners = shapely.get_coordinates(box(*facet.polygon.bounds))[:-1]
    points = list(facet.to_sensor(corners))
    for axis in range(3):
        for sign, level in ((1.0, low[axis]), (-1.0, high[axis])):
            clipped: list[Array] = []
            for p, q in zip(points, points[1:] + points[:1], strict=True):
                dp, dq = sign * (p[axis] - level), sign * (q[axis] - level)
                if dp >= 0.0:
                    clipped.append(p)
                if (dp < 0.0) != (dq < 0.0):
                    clipped.append(p + (q - p) * (dp / (dp - dq)))
            points = clipped
            if len(points) < 3:
                return False
    part = Polygon((np.array(points) - facet.origin) @ facet.axes[:2].T)
    return bool(part.buffer(0).intersects(facet.polygon))
