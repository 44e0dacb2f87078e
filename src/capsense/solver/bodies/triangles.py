"""Triangle meshes brought to a wanted number of triangles of even size."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.errors import SceneError
from capsense.scene.surface import clean_surface, connected_parts
from capsense.solver.bodies.simplify import collapse, fitted

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

_WELD = 1e-6
"""Corners nearer than this part of the longest extent are one."""
_WELD_MOST = 0.03
"""How far welding may go where a mesh falls into very many parts."""
_LEAST = 100
"""Triangles that every connected part gets, where there are not too many parts."""
_EVENLY = 0.7
"""Share of the triangles that goes to the parts evenly at most."""
_POWER = 0.35
"""Triangles of a part go with this power of its area."""
_LEAST_OF_MANY = 12
"""No part is reduced to fewer triangles."""
_SPARE = 1.25
"""Halving slivers may make this many times as many triangles as wanted."""
_SLIVER = 12.0
"""Square of the longest edge over the area (2.3 if equilateral) above which it is halved."""

_LONGEST = 1.5
"""Edges are halved before the collapse where they are longer than so many of those wanted."""
_ROUNDS, _CROWD = 12, 200_000
"""At most so many times, and while there are fewer triangles."""

_STIFF = 30.0
"""How much rims and sharp edges keep their place, as charge gathers there."""

_BASE = 0.6
"""Part of the triangles before those at sharp edges are halved."""
_FEW_SHARP = 0.1
"""Share of triangles at sharp edges up to which none is heeded."""
_BENT = 0.77
"""Cosine of the angle between normals below which an edge is sharp, 40 degrees."""
_AT_EDGE = 3.0
"""How much longer triangles at sharp edges count."""


class Triangles(NamedTuple):
    """Triangles of a surface."""

    corners: Array
    """Corners [m], shape (m, 3, 3)."""
    parts: Index
    """Connected part that each belongs to, shape (m,)."""
    closed: bool
    """Whether the surface bounds a volume; then normals point out of it."""


def reduced_triangles(triangles: Array, count: int, *, merge: bool = True) -> Triangles:
    """Reduce a mesh, or halve its triangles, until it has about ``count``.

    Connected parts are reduced one by one by quadric error (Garland and Heckbert, *Surface
    simplification using quadric error metrics*, SIGGRAPH 1997), each to its share.
    Triangles that coincide count once, those without area not at all.

    Args:
        triangles: Corners [m], shape (m, 3, 3); any winding, open or closed.
        count: Number of triangles to aim at.
        merge: Whether triangles are merged, which takes half a minute for 80,000. Else there are
            ``count`` more than were given.

    Raises:
        SceneError: A wrong shape, a number that is not finite, or no triangle with an area.
    """
    _check(triangles)
    vertices, faces = _welded(triangles, count)
    extent = float(np.ptp(vertices, axis=0).max())
    unit, faces, flaw = clean_surface(vertices / extent, faces)
    vertices, closed = extent * unit, not flaw
    label = connected_parts(faces, len(vertices))
    corners, parts = [], []
    areas = np.zeros(label.max() + 1)
    np.add.at(areas, label, _areas(vertices[faces]))
    for k, wanted in enumerate(_shares(areas, count)):
        part = faces[label == k]
        if merge:
            own = _covered(vertices, part, int(wanted))
        else:
            own = _halved(vertices[part], np.zeros(part.shape, bool), len(part) + int(wanted))
        corners.append(own)
        parts.append(np.full(len(own), k))
    out, which = np.concatenate(corners), np.concatenate(parts)
    keep = _apart(out)
    out, which = out[keep], which[keep]
    _, which = np.unique(which, return_inverse=True)
    if closed:
        normal = np.cross(out[:, 1] - out[:, 0], out[:, 2] - out[:, 0])
        closed = bool(
            np.linalg.norm(normal.sum(axis=0)) < 1e-3 * np.linalg.norm(normal, axis=1).sum()
        )
    return Triangles(out, which.reshape(-1).astype(np.int64), closed)


def _check(triangles: Array) -> None:
    if triangles.ndim != 3 or triangles.shape[1:] != (3, 3):
        raise SceneError(f"triangles have shape {triangles.shape}; give (m, 3, 3), metres")
    bad = np.flatnonzero(~np.isfinite(triangles).all(axis=(1, 2)))
    if len(bad):
        raise SceneError(f"triangle {bad[0]} holds a number that is not finite")
    if not len(triangles) or not _areas(triangles).max() > 0:
        raise SceneError("the surface has no triangle of an area above zero")


def _areas(triangles: Array) -> Array:
    a, b, c = np.moveaxis(triangles, 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _welded(triangles: Array, count: int) -> tuple[Array, Index]:
    """Vertices and faces with corners that coincide made one, and every face once.

    A heap of very many loose triangles is welded more and more coarsely.
    """
    points = triangles.reshape(-1, 3)
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    tolerance = _WELD
    found: tuple[Array, Index] | None = None
    while True:
        keys = np.round((points - low) / (tolerance * extent)).astype(np.int64)
        _, first, face = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        vertices, faces = points[first], face.reshape(-1, 3)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        faces = faces[np.sort(once)]
        if len(faces) and _areas(vertices[faces]).max() > 0:
            found = vertices, faces
        elif found is not None:
            return found
        else:
            raise SceneError("the surface has no triangle of an area above zero")
        many = len(faces) > 2 * count and (
            _LEAST_OF_MANY * (1 + connected_parts(faces, len(vertices)).max()) > 2 * count
        )
        if not many or tolerance > _WELD_MOST:
            return found
        tolerance *= 4


def _as_met(vertices: Array, faces: Index) -> tuple[Array, Index]:
    """Number vertices as faces meet them, which does not depend on how a mesh is turned."""
    used, first, which = np.unique(faces, return_index=True, return_inverse=True)
    order = np.argsort(first)
    place = np.empty(len(used), np.int64)
    place[order] = np.arange(len(used))
    return vertices[used[order]], place[which.reshape(-1)].reshape(-1, 3)


def _shares(areas: Array, count: int) -> Index:
    """Triangles for parts of these areas [m²]: the smaller a part, the more for its area.

    Sensors move along bodies, so that each part may be the one that counts.
    """
    least = min(_LEAST, _EVENLY * count / len(areas))
    weight = areas**_POWER
    low, high = 0.0, count / weight.sum()
    for _ in range(60):
        middle = 0.5 * (low + high)
        if np.maximum(least, middle * weight).sum() > count:
            high = middle
        else:
            low = middle
    return np.rint(np.maximum(least, low * weight)).astype(np.int64)


def _covered(vertices: Array, faces: Index, count: int) -> Array:
    """Corners of about ``count`` triangles that cover one part [m], shape (m, 3, 3)."""
    edges = _sharp(vertices, faces)
    surface = vertices[faces]
    length = np.linalg.norm(np.roll(surface, -1, axis=1) - surface, axis=2)
    reach = np.sqrt(_areas(surface).sum() / count)  # of a triangle from an edge
    if reach * length[edges].sum() < _FEW_SHARP * reach**2 * count:
        return _halved(*_simplified(vertices, faces, count, edges & False), count)
    return _halved(*_simplified(vertices, faces, round(_BASE * count), edges), count)


def _simplified(vertices: Array, faces: Index, count: int, sharp: Flags) -> tuple[Array, Flags]:
    """Corners of one part [m], reduced to ``count`` triangles where it has more, and sharp edges.

    Returns:
        Shapes (m, 3, 3) and (m, 3); edge k runs from corner k to the next.
    """
    count = max(count, _LEAST_OF_MANY)
    if len(faces) <= _LEAST_OF_MANY == count:
        return vertices[faces], sharp
    surface = vertices[faces]
    longest = _LONGEST * np.sqrt(2.3 * _areas(surface).sum() / count)
    used, local = np.unique(faces, return_inverse=True)
    points, local = _divided(vertices[used], local.reshape(-1, 3), longest)
    if len(local) <= count:
        return points[local], _sharp(points, local) & sharp.any()
    moved, reduced = _collapsed(points, local, count)
    if not len(reduced) or not _areas(moved[reduced]).max() > 0:
        return surface, sharp
    return fitted(moved, reduced, points[local])[reduced], _sharp(moved, reduced) & sharp.any()


def _divided(vertices: Array, faces: Index, longest: float) -> tuple[Array, Index]:
    """Halve edges longer than ``longest`` [m], on both sides, until there are none.

    Collapses of edges can only make triangles longer.
    """
    for _ in range(_ROUNDS):
        start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
        low, high = np.minimum(start, end), np.maximum(start, end)
        key, edge = np.unique(low * len(vertices) + high, return_inverse=True)
        pairs = np.stack([key // len(vertices), key % len(vertices)], axis=1)
        long = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1) > longest
        if not long.any() or len(faces) > _CROWD:
            break
        middle = np.where(long, len(vertices) + np.cumsum(long) - 1, -1)
        vertices = np.concatenate([vertices, vertices[pairs[long]].mean(axis=1)])
        cut = middle[edge.reshape(-1)].reshape(-1, 3)
        number = (cut >= 0).sum(axis=1)
        parts = [faces[number == 0]]
        for k, first in ((1, (cut >= 0).argmax(axis=1)), (2, (cut < 0).argmax(axis=1))):
            which = np.flatnonzero(number == k)
            turn = (first[which, None] + np.arange(3)) % 3
            (a, b, c), (p, q, r) = (
                np.take_along_axis(x[which], turn, axis=1).T for x in (faces, cut)
            )
            if k == 1:  # p halves ab
                parts += [np.stack([a, p, c], axis=1), np.stack([p, b, c], axis=1)]
            else:  # q halves bc, r halves ca
                parts += [np.stack(t, axis=1) for t in ((a, b, q), (a, q, r), (r, q, c))]
        (a, b, c), (p, q, r) = faces[number == 3].T, cut[number == 3].T
        parts += [np.stack(t, axis=1) for t in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
        faces = np.concatenate(parts)
    return vertices, faces


def _collapsed(vertices: Array, faces: Index, count: int) -> tuple[Array, Index]:
    """Vertices and faces after collapses of edges until there are ``count`` triangles."""
    middle, extent = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    points = (vertices - middle) / extent
    reduced = np.ascontiguousarray(faces, dtype=np.int64).copy()
    left = collapse(points, reduced, *_quadrics(points, reduced, _sharp(points, reduced)), count)
    used, local = np.unique(reduced[left], return_inverse=True)
    return middle + extent * points[used], local.reshape(-1, 3)


def _quadrics(vertices: Array, faces: Index, sharp: Flags) -> tuple[Array, Index]:
    """Quadric errors of the vertices, (n, 10), and edges, (e, 2), for the collapse.

    Planes are those of the triangles round a vertex, weighted with their areas; upright ones along
    rims, and those on both sides of sharp edges, weighted with the squares of their lengths.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(double, 1e-300)[:, None]
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    low, high = np.minimum(start, end), np.maximum(start, end)
    key, first, number = np.unique(
        low * len(vertices) + high, return_index=True, return_counts=True
    )
    rim = first[number == 1]
    way = vertices[end[rim]] - vertices[start[rim]]
    length = np.linalg.norm(way, axis=1)
    upright = np.cross(way, normal[rim // 3]) / np.maximum(length, 1e-300)[:, None]
    bend = np.flatnonzero(sharp.reshape(-1))
    bend_length = np.linalg.norm(vertices[end[bend]] - vertices[start[bend]], axis=1)

    ends = [np.stack([start[some], end[some]], axis=1).reshape(-1) for some in (rim, bend)]
    planes = np.concatenate(
        [np.repeat(x, k, axis=0) for x, k in ((normal, 3), (upright, 2), (normal[bend // 3], 2))]
    )
    owner = np.concatenate([start, *ends])
    weight = np.concatenate(
        [np.repeat(double / 2, 3)] + [np.repeat(_STIFF * x**2, 2) for x in (length, bend_length)]
    )
    d = -np.einsum("ij,ij->i", planes, vertices[owner])
    x, y, z = planes.T
    terms = (x * x, x * y, x * z, y * y, y * z, z * z, x * d, y * d, z * d, d * d)
    sums = [np.bincount(owner, weight * term, len(vertices)) for term in terms]
    return np.stack(sums, axis=1), np.stack([key // len(vertices), key % len(vertices)], axis=1)


def _sharp(vertices: Array, faces: Index) -> Flags:
    """Which edges are rims or bend by more than _BENT, shape (m, 3)."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
    _, edge, number = np.unique(key, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    first = order[np.cumsum(number) - number]
    last = order[np.cumsum(number) - 1]
    way = np.where(start[first] == start[last], -1.0, 1.0)  # windings that disagree
    cosine = way * np.einsum("ij,ij->i", normal[first // 3], normal[last // 3])
    return ((number != 2) | (cosine < _BENT))[edge].reshape(-1, 3)


def _halved(corners: Array, sharp: Flags, count: int) -> Array:
    """Cut triangles in two across their longest edge: the longest first, then slivers.

    Triangles at sharp edges count as longer, as charge gathers there. Neighbours may stay whole:
    panels need not meet corner to corner.
    """
    most = round(_SPARE * count)
    for _ in range(40):
        edge = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        edge = edge.astype(np.float32)  # so that turning the mesh leaves the order as it is
        longest, area = edge.max(axis=1), _areas(corners)
        if len(corners) < count:
            wanted = longest * np.where(sharp.any(axis=1), _AT_EDGE, 1.0)
            order = np.argsort(-wanted, kind="stable")
            chosen = order[: count - len(corners)]
            chosen = chosen[wanted[chosen] > 0.7 * wanted[order[0]]]
        else:
            usual = np.sqrt(2.3 * area.sum() / count)
            ratio = np.where(longest > usual, longest**2 / np.maximum(area, 1e-300), 0.0)
            order = np.argsort(-ratio, kind="stable")
            chosen = order[: max(0, most - len(corners))]
            chosen = chosen[ratio[chosen] > _SLIVER]
        if not len(chosen):
            break
        first = edge[chosen].argmax(axis=1)
        a, b, c = (corners[chosen, (first + k) % 3] for k in range(3))
        cut, next_, last = (sharp[chosen, (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        inner = np.zeros(len(chosen), dtype=bool)
        corners = np.concatenate([corners, np.stack([middle, b, c], axis=1)])
        corners[chosen] = np.stack([a, middle, c], axis=1)
        sharp = np.concatenate([sharp, np.stack([cut, next_, inner], axis=1)])
        sharp[chosen] = np.stack([cut, inner, last], axis=1)
    return corners


def _apart(corners: Array) -> NDArray[np.bool_]:
    """Which triangles to keep: those with an area that coincide with no earlier one."""
    from scipy.spatial import cKDTree

    area = _areas(corners)
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    keep = (area > 1e-6 * longest**2) & (longest > 1e-9 * longest.max())
    center = corners.mean(axis=1)
    size = np.sqrt(area)
    pairs = cKDTree(center).query_pairs(1e-3 * float(size.max()), output_type="ndarray")
    if len(pairs):
        i, j = pairs.min(axis=1), pairs.max(axis=1)
        near = np.linalg.norm(center[i] - center[j], axis=1) < 1e-3 * np.minimum(size[i], size[j])
        same = np.abs(area[i] - area[j]) < 1e-2 * area[i]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        cosine = np.einsum("ij,ij->i", cross[i], cross[j])
        keep[j[near & same & (np.abs(cosine) > 0.999 * 4 * area[i] * area[j])]] = False
    return keep
