"""Compiled kernels: mutual potentials and fluxes of flat panels that carry even charge, and the
edges of large triangle meshes collapsed until few enough panels are left.

Lengths in metres, 4π eps0 = 1. A panel is a row of ``frames``: its centre, the two axes of its
plane and its normal (twelve numbers), then for each of its four edges the start (u, v) in its
plane, the unit direction and the length (twenty), then twice the areas of the triangles (0, 1, 2)
and (0, 2, 3) of its corners. ``flat`` (10, n) holds centre, second moments xx, yy, zz, xy, xz, yz
and reach of all panels, ``coarse`` and ``fine`` (n, q, 4) points and weights on them.
"""

from __future__ import annotations

import math
from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, inlined, kernel

NEAR = 2.2
"""Pairs nearer than this many sums of their reaches are integrated in closed form."""
TOUCHING = 1.25
"""Pairs nearer than this many sums of their reaches take the fine points."""
_TINY = 1e-300


@kernel
def polygon_potential(frame, x, y, z):
    """Return ∫ dS' / |r − r'| [m] over one panel.

    Sum over edges of distance times logarithm, less height times solid angle (Wilton et al.,
    *Potential integrals for uniform and linear source distributions on polygonal and polyhedral
    domains*, IEEE Trans. Antennas Propag. 32, 1984). The solid angle is that of two triangles
    (van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30, 1983).
    """
    x -= frame[0]
    y -= frame[1]
    z -= frame[2]
    u = x * frame[3] + y * frame[4] + z * frame[5]
    v = x * frame[6] + y * frame[7] + z * frame[8]
    w = abs(x * frame[9] + y * frame[10] + z * frame[11])
    w2 = w * w
    ax, ay = frame[12] - u, frame[13] - v
    bx, by = frame[17] - u, frame[18] - v
    cx, cy = frame[22] - u, frame[23] - v
    dx, dy = frame[27] - u, frame[28] - v
    a = math.sqrt(ax * ax + ay * ay + w2)
    b = math.sqrt(bx * bx + by * by + w2)
    c = math.sqrt(cx * cx + cy * cy + w2)
    d = math.sqrt(dx * dx + dy * dy + w2)
    total = _edge(ax, ay, frame[14], frame[15], frame[16], a + b)
    total += _edge(bx, by, frame[19], frame[20], frame[21], b + c)
    total += _edge(cx, cy, frame[24], frame[25], frame[26], c + d)
    total += _edge(dx, dy, frame[29], frame[30], frame[31], d + a)
    ac = ax * cx + ay * cy + w2
    p = c * (a * b + ax * bx + ay * by + w2) + a * (bx * cx + by * cy + w2) + ac * b
    q = d * (a * c + ac) + a * (cx * dx + cy * dy + w2) + c * (ax * dx + ay * dy + w2)
    s, t = w * frame[32], w * frame[33]
    return total - 2.0 * w * math.atan2(s * q + t * p, p * q - s * t)


@inlined
def _edge(x, y, ex, ey, length, ends):
    """Distance of an edge in the plane times ∫ dl / r along it; (x, y) is its start."""
    return (x * ey - y * ex) * math.log((ends + length + _TINY) / (abs(ends - length) + _TINY))


@kernel
def solid_angle(frame, x, y, z):
    """Return the angle [sr] under which a point sees one panel, positive from its normal's side."""
    x -= frame[0]
    y -= frame[1]
    z -= frame[2]
    u = x * frame[3] + y * frame[4] + z * frame[5]
    v = x * frame[6] + y * frame[7] + z * frame[8]
    w = x * frame[9] + y * frame[10] + z * frame[11]
    w2 = w * w
    ax, ay = frame[12] - u, frame[13] - v
    bx, by = frame[17] - u, frame[18] - v
    cx, cy = frame[22] - u, frame[23] - v
    dx, dy = frame[27] - u, frame[28] - v
    a = math.sqrt(ax * ax + ay * ay + w2)
    b = math.sqrt(bx * bx + by * by + w2)
    c = math.sqrt(cx * cx + cy * cy + w2)
    d = math.sqrt(dx * dx + dy * dy + w2)
    ac = ax * cx + ay * cy + w2
    p = c * (a * b + ax * bx + ay * by + w2) + a * (bx * cx + by * cy + w2) + ac * b
    q = d * (a * c + ac) + a * (cx * dx + cy * dy + w2) + c * (ax * dx + ay * dy + w2)
    s, t = w * frame[32], w * frame[33]
    return 2.0 * math.atan2(s * q + t * p, p * q - s * t)


@kernel
def _mean_potential(points, frame):
    """Mean of the potential of one panel over weighted points (q, 4), times the panel's area."""
    total = 0.0
    for k in range(points.shape[0]):
        if points[k, 3] != 0.0:
            total += points[k, 3] * polygon_potential(
                frame, points[k, 0], points[k, 1], points[k, 2]
            )
    return total


@kernel
def fill_free(panels, out):
    """Write the free-space block: F_kl [1/m], mean over panel k of the potential of panel l.

    Far pairs: point charges and second moments. Near pairs: closed form of one panel, averaged
    over points of the other, both ways, weighted with the fourth power of the other's reach. The
    diagonal stays as it is.
    """
    flat, frames, areas = panels.flat, panels.frames, panels.areas
    coarse, fine, rim = panels.coarse, panels.fine, panels.rim
    n = areas.shape[0]
    for i in range(n):
        x0, y0, z0 = flat[0, i], flat[1, i], flat[2, i]
        xx, yy, zz = flat[3, i], flat[4, i], flat[5, i]
        xy, xz, yz = flat[6, i], flat[7, i], flat[8, i]
        for j in range(i):
            x, y, z = flat[0, j] - x0, flat[1, j] - y0, flat[2, j] - z0
            r2 = x * x + y * y + z * z + _TINY
            axx, ayy, azz = flat[3, j] + xx, flat[4, j] + yy, flat[5, j] + zz
            mix = x * y * (flat[6, j] + xy) + x * z * (flat[7, j] + xz) + y * z * (flat[8, j] + yz)
            second = 3.0 * (x * x * axx + y * y * ayy + z * z * azz + 2.0 * mix) / r2
            out[i, j] = (1.0 + (second - axx - ayy - azz) / (2.0 * r2)) / math.sqrt(r2)
        reach = flat[9, i]
        for j in range(i):
            x, y, z = flat[0, j] - x0, flat[1, j] - y0, flat[2, j] - z0
            span = reach + flat[9, j]
            r2 = x * x + y * y + z * z
            if r2 < NEAR * NEAR * span * span:
                small, large = (i, j) if reach < (1.0 + 1e-6) * flat[9, j] else (j, i)
                rule = fine if r2 < TOUCHING * TOUCHING * span * span else coarse
                out[i, j] = _mean_potential(rule[small], frames[large]) / areas[large]
        out[i, i] = _mean_potential(rim[i], frames[i]) / areas[i]
        for j in range(i):
            out[j, i] = out[i, j]


@kernel
def fill_flux(panels, out):
    """Write the flux block: flux through panel k from unit charge spread evenly on panel l.

    The flux from a point is the solid angle under which it sees the panel, so that the fluxes
    through a closed surface add up to 2π for every point on it. Near pairs average that over
    points of l, far pairs take the field of point charges and second moments.
    """
    flat, frames, areas = panels.flat, panels.frames, panels.areas
    coarse, fine = panels.coarse, panels.fine
    n = areas.shape[0]
    for k in range(n):
        x0, y0, z0 = flat[0, k], flat[1, k], flat[2, k]
        xx, yy, zz = flat[3, k], flat[4, k], flat[5, k]
        xy, xz, yz = flat[6, k], flat[7, k], flat[8, k]
        nx, ny, nz = frames[k, 9], frames[k, 10], frames[k, 11]
        area = areas[k]
        for j in range(n):
            x, y, z = x0 - flat[0, j], y0 - flat[1, j], z0 - flat[2, j]
            r2 = x * x + y * y + z * z + _TINY
            axx, ayy, azz = flat[3, j] + xx, flat[4, j] + yy, flat[5, j] + zz
            axy, axz, ayz = flat[6, j] + xy, flat[7, j] + xz, flat[8, j] + yz
            mx, my, mz = (
                axx * x + axy * y + axz * z,
                axy * x + ayy * y + ayz * z,
                axz * x + ayz * y + azz * z,
            )
            along = nx * x + ny * y + nz * z
            second = 7.5 * (mx * x + my * y + mz * z) / r2 - 1.5 * (axx + ayy + azz)
            value = along * (1.0 + second / r2) - 3.0 * (nx * mx + ny * my + nz * mz) / r2
            out[k, j] = area * value / (r2 * math.sqrt(r2))
        for j in range(n):
            x, y, z = x0 - flat[0, j], y0 - flat[1, j], z0 - flat[2, j]
            span = flat[9, k] + flat[9, j]
            r2 = x * x + y * y + z * z
            if r2 < NEAR * NEAR * span * span:
                rule = fine if r2 < TOUCHING * TOUCHING * span * span else coarse
                value = 0.0
                for q in range(rule.shape[1]):
                    p = rule[j, q]
                    value -= p[3] * solid_angle(frames[k], p[0], p[1], p[2])
                out[k, j] = value
        out[k, k] = 0.0


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
