"""Compiled kernel: a triangle mesh reduced by collapsing its edges."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled

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
            if care > 0 and not _allowed(
                vertices, faces, alive, head, follow, mark, number, u, v, place, care == 2
            ):
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
    vertices: Array, faces: Index, alive: NDArray[np.bool_], head: Index, follow: Index,
    mark: Index, number: int, u: int, v: int, place: Array, facing: bool,
) -> bool:  # fmt: skip
    """Whether joining two vertices leaves the surface as connected, and triangles facing alike."""
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
