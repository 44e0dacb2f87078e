"""Where sheets meet: contact between two surfaces, and between a surface and a box."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon, box

from capsense.design.geometry import Facet, Surface, boundary_segments, ring_vertices

Array = NDArray[np.float64]

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
