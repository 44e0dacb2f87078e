"""Conducting sheets, bare faces of dielectrics and walls of a design, cut into panels.

Charge piles up at the rims of a sheet like 1/√distance. Every facet is therefore split into bands
of geometrically growing distance from its rims, and each band into cells whose size follows the
band's distance. Panels are the intersections: planar polygons that fill the facet exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import nnls
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense.design.geometry import Facet, box_facets, ring_vertices, to_plane
from capsense.design.model import Design, Layer
from capsense.field.bem_kernels import Panels

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

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


def concatenate(parts: list[Panels]) -> Panels:
    """Join panel sets, in order."""
    counts = np.concatenate([np.diff(p.first) for p in parts])
    columns = dict(zip(Panels._fields, zip(*parts, strict=True), strict=True))
    joined = {name: _joined(arrays) for name, arrays in columns.items()}
    return Panels(**{**joined, "first": np.concatenate([[0], np.cumsum(counts)])})


def _joined(arrays: Sequence[Array]) -> Array:
    """Arrays one after another; the second axis is filled up with zeros where others are longer."""
    if arrays[0].ndim == 1:
        return np.concatenate(arrays)
    width = max(a.shape[1] for a in arrays)
    out = np.zeros((sum(map(len, arrays)), width, *arrays[0].shape[2:]))
    ends = np.cumsum([len(a) for a in arrays])
    for array, end in zip(arrays, ends, strict=True):
        out[end - len(array) : end, : array.shape[1]] = array
    return out


_MITRE = 5.5
"""Corners of a buffer with mitred corners lie within so many times its width of the line."""


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
        near = shapely.box(*facet.polygon.bounds).buffer(_MITRE * distance)
        seen = lines[(heights <= 8 * distance + 1e-6) & shapely.intersects(near, lines)]
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


_MANY = 36
"""Panels with more points of a quadrature, as those along arcs, get one of fifteen at most."""
_SPIKE = 1e-6
"""Corners that stand out by less than this, over the root of their panel's area, are left out: cuts
along an outline that they touch leave spikes."""


def make_panels(facet: Facet, polygons: list[Polygon]) -> Panels:
    """Turn pieces of a facet into panels."""
    edges: list[Array] = []
    counts: list[int] = []
    centers, diameters, quads, weights = [], [], [], []
    for polygon in polygons:
        polygon = orient(polygon)
        rings = _rings(polygon)
        points, w = _quadrature(polygon, rings)
        if w.min() < _SPIKE**1.5 * polygon.area:
            polygon = orient(polygon.simplify(_SPIKE * math.sqrt(polygon.area)))
            rings = _rings(polygon)
            points, w = _quadrature(polygon, rings)
        if len(w) > _MANY:
            points, w = _fewer(points, w)
        flat = np.concatenate([np.stack([r[:-1], r[1:]], axis=1) for r in rings])
        edges.append(facet.to_sensor(flat))
        counts.append(len(flat))
        center = w @ points / w.sum()
        centers.append(facet.to_sensor(center))
        diameters.append(2 * np.sqrt(((flat[:, 0] - center) ** 2).sum(axis=1)).max())
        quads.append(facet.to_sensor(points))
        weights.append(w)
    return Panels(
        edges=np.concatenate(edges),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        normals=np.tile(facet.axes[2], (len(polygons), 1)),
        centers=np.array(centers),
        diameters=np.array(diameters),
        quad=_joined([points[None] for points in quads]),
        weights=_joined([w[None] for w in weights]),
    )


def _rings(polygon: Polygon) -> list[Array]:
    """Corners of the outline and of each hole, the first one again at the end."""
    return [np.asarray(r.coords) for r in (polygon.exterior, *polygon.interiors)]


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


def _fewer(points: Array, weights: Array) -> tuple[Array, Array]:
    """Some of the points of a quadrature, with other weights and the same moments to fourth order.

    Non-negative least squares keep no more points than there are moments (Tchakaloff's theorem;
    Davis, *A construction of nonnegative approximate quadratures*, Math. Comp. 21, 1967).
    """
    middle = weights @ points / weights.sum()
    x, y = (points - middle).T / np.abs(points - middle).max()
    moments = np.array([x**i * y**j for i in range(5) for j in range(5 - i)])
    found, _ = nnls(moments, moments @ weights)
    kept = found > 0.0
    return points[kept], found[kept] * (weights.sum() / found.sum())


PLANE_TOL = 1e-6
"""What is nearer to a plane than this [m] lies in it."""
FAR_PLANE = 0.01
"""Parallel sheets farther apart than this [m] need no panels of their distance."""


def smallest_gaps(sheets: list[tuple[Facet, int]]) -> list[float]:
    """Distance of each facet to the nearest other facet [m], from their outlines."""
    outlines = [np.concatenate(ring_vertices(facet)) for facet, _ in sheets]
    gaps = []
    for k, (facet, owner) in enumerate(sheets):
        gap = math.inf
        for other, (mate, mate_owner) in enumerate(sheets):
            if other == k or (mate_owner == owner and owner >= 0):
                continue
            local = (outlines[other] - facet.origin) @ facet.axes.T
            if np.abs(local[:, 2]).max() < PLANE_TOL:
                gap = min(gap, float(facet.polygon.boundary.distance(to_plane(mate, facet))))
        gaps.append(max(gap, 1e-5))
    return gaps


def plane_spacings(sheets: list[tuple[Facet, int]]) -> list[float]:
    """Distance of each facet to the nearest parallel facet that faces it [m], at most 10 mm."""
    out = []
    for k, (facet, _) in enumerate(sheets):
        spacing = FAR_PLANE
        for other, (mate, _) in enumerate(sheets):
            height = abs((mate.origin - facet.origin) @ facet.axes[2])
            parallel = abs(mate.axes[2] @ facet.axes[2]) > 1 - 1e-6
            nearer = other != k and parallel and PLANE_TOL < height < spacing
            if nearer and facet.polygon.intersects(to_plane(mate, facet)):
                spacing = height
        out.append(spacing)
    return out


def interfaces(design: Design, sheets: list[Facet]) -> list[tuple[Facet, float]]:
    """Faces of dielectrics that no sheet covers, each once, with the thickness of the part [m]."""
    out: list[tuple[Facet, float]] = []
    covers = list(sheets)
    for number, layer in enumerate(design.layers):
        later = [f for other in design.layers[number + 1 :] for f in other.facets]
        thickness = float((layer.upper - layer.lower).min())
        if layer.facets:
            thickness = thickness_of(layer)
        for face in layer.surface.facets:
            if _on_wall(face, design):
                continue
            region = face.polygon
            for cover in _coplanar(face, covers):
                region = region.difference(cover)
            pieces = [region]
            for mate in _coplanar(face, later):
                pieces = [p for r in pieces for p in (r.intersection(mate), r.difference(mate))]
            for piece in shapely.get_parts(pieces):
                if piece.area > 1e-12 and piece.geom_type == "Polygon":
                    out.append((Facet(piece, face.origin, face.axes), thickness))
        covers += layer.surface.facets
    return out


def thickness_of(layer: Layer) -> float:
    """Thickness of a part [m]; that of a box is its height."""
    if layer.facets:
        from capsense.design.solid import thickness

        return thickness(layer.facets)
    return float((layer.upper - layer.lower)[2])


def _coplanar(face: Facet, others: list[Facet]) -> Iterator[shapely.Polygon]:
    """Outlines of the facets that lie in a facet's plane, in that plane."""
    if not others:
        return
    normals, origins = np.array([(f.axes[2], f.origin) for f in others]).swapaxes(0, 1)
    parallel = np.abs(normals @ face.axes[2]) > 1 - 1e-9
    apart = np.abs(((face.origin - origins) * normals).sum(axis=1))
    for k in np.flatnonzero(parallel & (apart < PLANE_TOL)):
        yield to_plane(others[k], face)


def _on_wall(face: Facet, design: Design) -> bool:
    if design.domain.open or np.abs(face.axes[2]).max() < 1 - 1e-9:
        return False
    corners = np.array([design.domain.lower, design.domain.upper])
    return bool(np.abs((face.origin - corners) @ face.axes[2]).min() < PLANE_TOL)


def walls(design: Design) -> list[Facet]:
    """Ceiling and side walls of the box; the floor is met by images. An open domain has none."""
    if design.domain.open:
        return []
    return [f for f in box_facets(design.domain.lower, design.domain.upper) if f.axes[2, 2] > -0.5]


def samples(panels: Panels, count: int, size: float) -> tuple[Ints, Array, Array]:
    """Points no farther apart than ``size`` [m] all over the first panels, and their areas.

    Returns:
        Panel, position [m] and area [m²] of each, shapes (s,), (s, 3), (s,).
    """
    of, points, areas = [], [], []
    for p in range(count):
        ends = panels.edges[panels.first[p] : panels.first[p + 1]]
        corners = np.concatenate([np.repeat(panels.centers[p][None, None], len(ends), 0), ends], 1)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * cross @ panels.normals[p]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        for triangle, a, longest in zip(corners, area, sides.max(axis=1), strict=True):
            n = max(1, math.ceil(longest / size))
            points.append(_split_points(n) @ triangle)
            areas.append(np.full(n * n, a / (n * n)))
            of.append(np.full(n * n, p))
    return np.concatenate(of), np.concatenate(points), np.concatenate(areas)


@cache
def _split_points(n: int) -> Array:
    """Barycentric coordinates of the centroids of n² equal parts of a triangle, (n², 3)."""
    out = []
    for i in range(n):
        for j in range(n - i):
            k = n - 1 - i - j
            out.append([i + 1 / 3, j + 1 / 3, k + 1 / 3])
            if k > 0:
                out.append([i + 2 / 3, j + 2 / 3, k - 1 / 3])
    return np.array(out) / n
