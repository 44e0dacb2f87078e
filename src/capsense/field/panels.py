"""Cut conducting sheets and dielectric interfaces into panels, graded towards charged rims.

Charge piles up at the rims of a sheet like 1/√distance. Every facet is therefore split into bands
of geometrically growing distance from its rims, and each band into cells whose size follows the
band's distance. Panels are the intersections: planar polygons that fill the facet exactly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from capsense.design.geometry import Facet
from capsense.field.bem_kernels import Polygons

Array = NDArray[np.float64]

# Degree-2 rule on a triangle: three points of weight 1/3.
_TRIANGLE_RULE = np.array([[2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])


@dataclass(frozen=True)
class Grading:
    """How finely a facet is cut."""

    edge: float
    """Width of the band along a rim [m]."""
    growth: float = 2.0
    """Ratio of the distances of successive bands."""
    aspect: float = 6.0
    """Cell size in a band over the band's distance."""
    smallest: float = 0.0
    """No cell is smaller than this [m]."""
    largest: float = 0.005
    """No cell is larger than this [m]."""


@dataclass(frozen=True, eq=False)
class Panels:
    """A set of planar polygonal panels as flat arrays."""

    edges: Array
    """Edges of all panels, shape (k, 2, 3)."""
    first: NDArray[np.int64]
    """Edges of panel p are ``first[p]:first[p + 1]``, shape (n + 1,)."""
    normals: Array
    """Unit normals, shape (n, 3)."""
    centers: Array
    """Centroids [m], shape (n, 3)."""
    diameters: Array
    """Largest distance from the centroid to a vertex, doubled [m], shape (n,)."""
    quad: Array
    """Quadrature points [m], shape (n, q, 3)."""
    weights: Array
    """Quadrature weights [m²], zero where unused, shape (n, q)."""

    def __len__(self) -> int:
        return len(self.centers)

    @property
    def areas(self) -> Array:
        """Panel areas [m²], shape (n,)."""
        return self.weights.sum(axis=1)

    @property
    def polygons(self) -> Polygons:
        """The arrays as the compiled kernels take them."""
        return Polygons(*(getattr(self, name) for name in Polygons._fields))


def concatenate(parts: list[Panels]) -> Panels:
    """Join panel sets, in order."""
    q = max(p.quad.shape[1] for p in parts)

    def pad(a: Array) -> Array:
        widths = [(0, 0), (0, q - a.shape[1])] + [(0, 0)] * (a.ndim - 2)
        return np.pad(a, widths)

    counts = np.concatenate([np.diff(p.first) for p in parts])
    return Panels(
        edges=np.concatenate([p.edges for p in parts]),
        first=np.concatenate([[0], np.cumsum(counts)]),
        normals=np.concatenate([p.normals for p in parts]),
        centers=np.concatenate([p.centers for p in parts]),
        diameters=np.concatenate([p.diameters for p in parts]),
        quad=np.concatenate([pad(p.quad) for p in parts]),
        weights=np.concatenate([pad(p.weights) for p in parts]),
    )


def cut_facet(facet: Facet, rims: Array, grading: Grading, reach: float = 0.0) -> list[Polygon]:
    """Split a facet's polygon into graded pieces.

    ``rims`` are 3-D segments, shape (k, 2, 3); those within ``reach`` (at least 1 µm) of the
    facet's plane are projected onto it and graded to, from an eighth of their height on: what they
    induce varies over their height.
    """
    pieces: list[Polygon] = []
    lines, heights = _project_rims(facet, rims, reach)
    rest = facet.polygon
    distance = grading.edge
    size = max(grading.smallest, grading.aspect * distance)
    while len(lines) and size < grading.largest and not rest.is_empty:
        seen = lines[heights <= 8 * distance + 1e-6]
        if len(seen):
            merged = shapely.line_merge(shapely.union_all(seen))
            near = merged.buffer(distance, cap_style="square", join_style="mitre")
            pieces += _cells(rest.intersection(near), size)
            rest = rest.difference(near)
        distance *= grading.growth
        size = max(grading.smallest, grading.aspect * (grading.growth - 1) / 2 * distance)
    pieces += _cells(rest, grading.largest)
    return pieces


def _project_rims(facet: Facet, rims: Array, reach: float) -> tuple[NDArray[np.object_], Array]:
    """Rims near a facet's plane as lines in it, with their heights above it [m]."""
    local = (rims.reshape(-1, 2, 3) - facet.origin) @ facet.axes.T
    height = np.abs(local[..., 2]).max(axis=1)
    close = height <= max(reach, 1e-6)
    lines = shapely.linestrings(local[close][..., :2])
    real = shapely.length(lines) > 1e-9
    return lines[real], height[close][real]


def _cells(region: shapely.Geometry, size: float) -> list[Polygon]:
    """Cut a region by a grid of cells no larger than ``size``, aligned with its bounds."""
    if region.is_empty or region.area < 1e-14:
        return []
    x0, y0, x1, y1 = region.bounds
    nx, ny = max(1, round((x1 - x0) / size)), max(1, round((y1 - y0) / size))
    xs, ys = np.linspace(x0, x1, nx + 1), np.linspace(y0, y1, ny + 1)
    gx, gy = np.repeat(np.arange(nx), ny), np.tile(np.arange(ny), nx)
    boxes = shapely.box(xs[gx], ys[gy], xs[gx + 1], ys[gy + 1])
    shapely.prepare(region)
    boxes = boxes[shapely.intersects(region, boxes)]
    cut = shapely.get_parts(shapely.intersection(boxes, region))
    cut = cut[shapely.get_type_id(cut) == 3]
    return list(cut[shapely.area(cut) > 1e-6 * size * size * 1e-3])


def make_panels(facet: Facet, polygons: list[Polygon]) -> Panels:
    """Turn pieces of a facet into panels."""
    edges: list[Array] = []
    counts: list[int] = []
    centers, diameters, quads, weights = [], [], [], []
    for polygon in polygons:
        polygon = shapely.geometry.polygon.orient(polygon)
        rings = [np.asarray(polygon.exterior.coords)] + [
            np.asarray(ring.coords) for ring in polygon.interiors
        ]
        loops = [np.stack([r[:-1], r[1:]], axis=1) for r in rings]
        flat = np.concatenate(loops)
        edges.append(facet.to_sensor(flat))
        counts.append(len(flat))
        points, w = _quadrature(polygon, rings)
        center = w @ points / w.sum()
        centers.append(facet.to_sensor(center))
        diameters.append(2 * np.sqrt(((flat[:, 0] - center) ** 2).sum(axis=1)).max())
        quads.append(facet.to_sensor(points))
        weights.append(w)
    n, q = len(polygons), max(len(w) for w in weights)
    quad, weight = np.zeros((n, q, 3)), np.zeros((n, q))
    for p in range(n):
        quad[p, : len(quads[p])] = quads[p]
        weight[p, : len(weights[p])] = weights[p]
    return Panels(
        edges=np.concatenate(edges),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        normals=np.tile(facet.axes[2], (n, 1)),
        centers=np.array(centers),
        diameters=np.array(diameters),
        quad=quad,
        weights=weight,
    )


def _quadrature(polygon: Polygon, rings: list[Array]) -> tuple[Array, Array]:
    """Quadrature points (q, 2) and weights (q,) [m²], exact for quadratics."""
    outline = rings[0][:-1]
    if len(rings) == 1 and len(outline) == 3:
        triangles = outline[None]
    elif len(rings) == 1 and len(outline) == 4 and polygon.convex_hull.equals(polygon):
        triangles = outline[[[0, 1, 2], [0, 2, 3]]]
    else:
        parts = shapely.constrained_delaunay_triangles(polygon).geoms
        triangles = np.array([np.asarray(t.exterior.coords)[:3] for t in parts])
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    points = np.einsum("qk,tkd->tqd", _TRIANGLE_RULE, triangles).reshape(-1, 2)
    return points, np.repeat(area / 3, 3)
