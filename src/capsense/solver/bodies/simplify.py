"""Large triangle meshes with fewer triangles: edges collapsed, the cheapest first, and what is left
moved to the mean place of the surface that it stands for."""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.scene.geometry_kernels import triangle_distance2

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_EVEN = 1e-2
"""How much short edges go first, over the quadric error of a plane: keeps triangles alike."""
_STAY = 1e-3
"""How much a joined vertex stays at the middle of its edge, over the same."""
_SLENDER = 1e-4
"""Square of the height over the longest side below which no triangle may get more slender."""
_WORSE = 0.25
"""What counts as more slender, as a ratio of such squares."""
_MORE = 2
"""More than so many times the triangles wanted are not left."""
_TURN = 0.25
"""Least cosine between the normals of a triangle before and after."""


class _Corners(NamedTuple):
    """Which corners of triangles are at a vertex, as lists; corner c is that of face c // 3."""

    head: Index
    """The first corner at each vertex, shape (n,)."""
    tail: Index
    """The last, shape (n,)."""
    follow: Index
    """The corner after each, -1 after the last, shape (3 m,)."""
    alive: NDArray[np.bool_]
    """Which faces are left, shape (m,)."""
    mark: Index
    """Numbers that say whether a vertex has been met, shape (n,)."""


@compiled
def collapse(vertices: Array, faces: Index, quadrics: Array, edges: Index, count: int) -> Index:
    """Collapse edges, the cheapest first, until ``count`` triangles are left.

    None turns a triangle over or pinches the surface, so that somewhat more may be left. Where very
    many would be, as in meshes with cracks, slivers and edges of many triangles, those that turn
    triangles over are next, and all others last.

    Args:
        vertices: Vertices [m], shape (n, 3); overwritten.
        faces: Triangles, shape (m, 3); overwritten.
        quadrics: Sums of w (p·x + d)² over planes, shape (n, 10): w times xx, xy, xz, yy, yz, zz
            of p, p d, and d².
        edges: Pairs of vertices, shape (e, 2).
        count: Triangles wanted.

    Returns:
        Which rows of ``faces`` are left.
    """
    n, m = vertices.shape[0], faces.shape[0]
    head, tail, follow = np.full(n, -1), np.full(n, -1), np.full(3 * m, -1)
    for c in range(3 * m):
        v = faces[c // 3, c % 3]
        if head[v] < 0:
            head[v] = c
        else:
            follow[tail[v]] = c
        tail[v] = c
    alive, gone = np.ones(m, np.bool_), np.zeros(n, np.bool_)
    version, mark = np.zeros(n, np.int64), np.full(n, -1)
    corners = _Corners(head, tail, follow, alive, mark)
    place, number, left = np.empty(3), 0, m
    care, before_pass = 2, m + 1
    while True:
        if care < 2 or left == before_pass:  # nothing more can be done with so much care
            care -= 1
        before_pass = left
        goal = count if care == 2 else _MORE * count
        if care < 0 or left <= goal:
            break
        heap = [(np.inf, -1, -1, -1)]
        if left == m:
            for e in range(edges.shape[0]):
                u, v = edges[e]
                heap.append((_cost(vertices, quadrics, u, v, place), u, v, 0))
        else:
            for f in range(m):
                if alive[f]:
                    for k in range(3):
                        u, v = faces[f, k], faces[f, (k + 1) % 3]
                        stamp = version[u] + version[v]
                        heap.append((_cost(vertices, quadrics, u, v, place), u, v, stamp))
        heapify(heap)
        while left > goal:
            _, u, v, stamp = heappop(heap)
            if u < 0:
                break
            if gone[u] or gone[v] or stamp != version[u] + version[v]:
                continue
            _cost(vertices, quadrics, u, v, place)
            number += 2
            facing = care == 2
            if care > 0 and not _allowed(vertices, faces, corners, number, (u, v), place, facing):
                continue
            vertices[u] = place
            quadrics[u] += quadrics[v]
            gone[v] = True
            follow[tail[u]], tail[u] = head[v], tail[v]
            c = head[v]
            while c >= 0:
                faces[c // 3, c % 3] = u
                c = follow[c]
            before, c = -1, head[u]
            while c >= 0:  # drop faces that have become edges, and their corners from the list
                f = c // 3
                if alive[f] and (faces[f, 0] == faces[f, 1] or faces[f, 1] == faces[f, 2]
                                 or faces[f, 2] == faces[f, 0]):  # fmt: skip
                    alive[f] = False
                    left -= 1
                if not alive[f] and before >= 0:
                    follow[before] = follow[c]
                    if tail[u] == c:
                        tail[u] = before
                else:
                    before = c
                c = follow[c]
            version[u] += 1
            number += 2
            c = head[u]
            while c >= 0:
                f = c // 3
                for k in range(3):
                    w = faces[f, k]
                    if alive[f] and w != u and mark[w] != number:
                        mark[w] = number
                        stamp = version[u] + version[w]
                        heappush(heap, (_cost(vertices, quadrics, u, w, place), u, w, stamp))
                c = follow[c]
    return np.flatnonzero(alive)


@compiled
def _cost(vertices: Array, quadrics: Array, u: int, v: int, place: Array) -> float:
    """What it costs to join two vertices, and the place where that is least."""
    q = quadrics[u] + quadrics[v]
    whole = q[0] + q[3] + q[5]
    x = 0.5 * (vertices[u] + vertices[v])
    square = 0.0
    for i in range(3):
        square += (vertices[u, i] - vertices[v, i]) ** 2
    stay = _STAY * whole + 1e-300
    a, b, c, d, e, f = q[0] + stay, q[1], q[2], q[3] + stay, q[4], q[5] + stay
    r0 = -(q[0] * x[0] + q[1] * x[1] + q[2] * x[2] + q[6])
    r1 = -(q[1] * x[0] + q[3] * x[1] + q[4] * x[2] + q[7])
    r2 = -(q[2] * x[0] + q[4] * x[1] + q[5] * x[2] + q[8])
    m0, m1, m2 = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * m0 + b * m1 + c * m2
    s0 = s1 = s2 = 0.0
    if determinant > 0.0:
        s0 = (m0 * r0 + m1 * r1 + m2 * r2) / determinant
        s1 = (m1 * r0 + (a * f - c * c) * r1 + (b * c - a * e) * r2) / determinant
        s2 = (m2 * r0 + (b * c - a * e) * r1 + (a * d - b * b) * r2) / determinant
        if s0 * s0 + s1 * s1 + s2 * s2 > square:
            s0 = s1 = s2 = 0.0
    place[0], place[1], place[2] = x[0] + s0, x[1] + s1, x[2] + s2
    x0, x1, x2 = place[0], place[1], place[2]
    error = (
        q[0] * x0 * x0 + q[3] * x1 * x1 + q[5] * x2 * x2
        + 2.0 * (q[1] * x0 * x1 + q[2] * x0 * x2 + q[4] * x1 * x2)
        + 2.0 * (q[6] * x0 + q[7] * x1 + q[8] * x2) + q[9]
    )  # fmt: skip
    # so that equal costs stay equal where the mesh is turned
    return np.float64(np.float32(max(error, 0.0) + _EVEN * whole * square))


@compiled
def _allowed(
    vertices: Array, faces: Index, corners: _Corners, number: int, pair: tuple[int, int],
    place: Array, facing: bool,
) -> bool:  # fmt: skip
    """Whether joining two vertices leaves the surface as connected, and triangles facing alike."""
    u, v = pair
    head, _, follow, alive, mark = corners
    shared = common = 0
    for side in range(2):
        own, other = (u, v) if side == 0 else (v, u)
        c = head[own]
        while c >= 0:
            f = c // 3
            if alive[f]:
                i, j = faces[f, (c + 1) % 3], faces[f, (c + 2) % 3]
                # within a face the corner's number modulo 3 is its place
                if i == other or j == other:
                    shared += side
                elif facing and not _keeps_facing(vertices, own, i, j, place):
                    return False
                for w in (i, j):
                    if side == 0:
                        mark[w] = number
                    elif mark[w] == number:
                        mark[w] = number + 1
                        if w != u:
                            common += 1
            c = follow[c]
    return common <= shared


@compiled
def _keeps_facing(vertices: Array, own: int, i: int, j: int, place: Array) -> bool:
    """Whether a triangle faces alike with a corner elsewhere, and does not become a sliver."""
    edge, to, old = vertices[j] - vertices[i], place - vertices[i], vertices[own] - vertices[i]
    before, after = np.cross(edge, old), np.cross(edge, to)
    first, second = np.dot(before, before), np.dot(after, after)
    base = np.dot(edge, edge)
    long = max(base, max(np.dot(to, to), np.dot(to - edge, to - edge)))
    was_long = max(base, max(np.dot(old, old), np.dot(old - edge, old - edge)))
    slender = second < _SLENDER * long * long
    if slender and second * was_long * was_long < _WORSE * first * long * long:
        return False
    along = np.dot(before, after)
    return first == 0.0 or (along > 0.0 and along * along > _TURN * _TURN * first * second)


_ROUNDS = 2
_SWEEPS = 8
_FARTHEST = 0.3
"""A triangle is not moved by more than this part of its size."""
_FINE = 20
"""Of surfaces of so many times as many triangles, centroids tell enough."""
_INNER = np.array([[4.0, 1.0, 1.0], [1.0, 4.0, 1.0], [1.0, 1.0, 4.0]]) / 6
"""Barycentric coordinates of three points that integrate quadratic functions."""


def fitted(vertices: Array, faces: Index, triangles: Array) -> Array:
    """Move vertices along their normals until every triangle lies at its surface's mean height.

    Triangles with corners on a curved surface lie within it, so that a round body comes out too
    small. To first order a conductor's capacitance depends on the mean height alone.

    Args:
        vertices: Vertices of the reduced surface [m], shape (n, 3).
        faces: Its triangles, wound like those of the surface, shape (m, 3).
        triangles: Corners of the surface [m], shape (k, 3, 3).

    Returns:
        Vertices [m], shape (n, 3).
    """
    inner = _INNER if len(triangles) < _FINE * len(faces) else np.full((1, 3), 1 / 3)
    points = (inner @ triangles).reshape(-1, 3)
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    double = np.linalg.norm(cross, axis=1)
    weights = np.repeat(double, len(inner))
    normals = np.repeat(cross / np.maximum(double, 1e-300)[:, None], len(inner), axis=0)
    moved = np.array(vertices)
    for _ in range(_ROUNDS):
        moved += _step(moved, faces, points, normals, weights)
    return moved


def _step(vertices: Array, faces: Index, points: Array, normals: Array, weights: Array) -> Array:
    corners = np.ascontiguousarray(vertices[faces])
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    planes = cross / np.maximum(double, 1e-300)[:, None]
    centers = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    sums = np.zeros((len(faces), 2))
    add_offsets(points, normals, weights, corners, planes, centers, reach, sums)
    height = sums[:, 1] / np.maximum(sums[:, 0], 1e-300)
    limit = _FARTHEST * np.sqrt(0.5 * double)
    height = np.clip(height, -limit, limit)

    n, corner = len(vertices), faces.reshape(-1)
    average = np.stack([np.bincount(corner, np.repeat(cross[:, k], 3), n) for k in range(3)], 1)
    average = average / np.maximum(np.linalg.norm(average, axis=1), 1e-300)[:, None]
    along = np.einsum("mki,mi->mk", average[faces], planes)
    share = double[:, None] * along
    norm = np.maximum(np.bincount(corner, np.repeat(double, 3), n), 1e-300)
    move = np.zeros(n)
    for _ in range(_SWEEPS):
        lack = height - (move[faces] * along).mean(axis=1)
        move += np.bincount(corner, (share * lack[:, None]).reshape(-1), n) / norm
    return move[:, None] * average


_FACING = 0.5
"""Least cosine between normals of a surface and of a triangle that replaces it."""


@kernel
def add_offsets(
    points: Array, normals: Array, weights: Array,
    corners: Array, planes: Array, centers: Array, reach: Array, out: Array,
) -> None:  # fmt: skip
    """Add the weights of points, and their heights times weights, to the nearest triangles.

    Args:
        points: Points on the surface [m], shape (p, 3).
        normals: The surface's unit normals there, shape (p, 3).
        weights: Weights, shape (p,).
        corners: Triangles [m], shape (n, 3, 3).
        planes: Their unit normals, shape (n, 3). Triangles that face unlike a point's surface
            are passed over.
        centers: Centroids [m], shape (n, 3).
        reach: Distances from centroid to the farthest corner [m], shape (n,).
        out: Sums of weights and of heights [m] times weights, shape (n, 2).
    """
    for p in range(points.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, where = 1e300, -1
        for k in range(corners.shape[0]):
            dx, dy, dz = x - centers[k, 0], y - centers[k, 1], z - centers[k, 2]
            square = dx * dx + dy * dy + dz * dz
            if best < 1e300:
                least = reach[k] + best
                if square >= least * least:
                    continue
            along = (
                normals[p, 0] * planes[k, 0] + normals[p, 1] * planes[k, 1]
                + normals[p, 2] * planes[k, 2]
            )  # fmt: skip
            if along <= _FACING:
                continue
            distance = np.sqrt(triangle_distance2(corners[k], x, y, z))
            if distance < best:
                best, where = distance, k
        if where >= 0:
            height = (
                planes[where, 0] * (x - centers[where, 0])
                + planes[where, 1] * (y - centers[where, 1])
                + planes[where, 2] * (z - centers[where, 2])
            )
            out[where, 0] += weights[p]
            out[where, 1] += weights[p] * height
