"""Deforming meshes, compiled: where their clusters are at this instant, and finer ones below them.

The tree of a mesh is that of the form it had first. At every step, charge, centre and second
moments of all clusters follow from the vertices. Triangles that are wide against their distance
from the design are halved, again and again; what lies below a triangle is thus there only where it
may count.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.field.face_kernels import on_face

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

WIDE_PIECE = 0.2
"""Triangles are halved whose longest edge, at rest, is more than so much of their distance from the
design. Clusters of that size see a linear potential, so that what lies below does not count yet:
readings do not jump where a triangle comes to be halved."""
_NEAR = 2.0
"""Those whose first vertex is so many times as far away are not looked into."""
_MOST = 12
"""Triangles are halved at most so often."""


class Refit(NamedTuple):
    """Clusters of a mesh at one instant; k of them, and f functions."""

    children: Ints
    """Parts of each, -1 for none, shape (k, 2)."""
    function: Ints
    """Charge function that splits each, -1 for none, shape (k,)."""
    charge: Array
    """Shape (k,)."""
    center: Array
    """Centres of charge [m], shape (k, 3)."""
    spread: Array
    """Second central moments of charge over the charge [m²], shape (k, 3, 3)."""
    extent: Array
    """[m], shape (k,)."""
    own: Array
    """Energy of each function, as far as scores need it [1/m], shape (f,)."""


@kernel
def _corners(vertices: Array, corner: Ints, shares: Array, i: int, out: Array) -> None:
    """Fill in the corners (3, 3) of piece i; arguments as of :func:`refit`."""
    for q in range(3):
        for k in range(3):
            if shares.shape[0] == 0:
                out[q, k] = vertices[corner[i, q], k]
            else:
                out[q, k] = (
                    shares[i, q, 0] * vertices[corner[i, 0], k]
                    + shares[i, q, 1] * vertices[corner[i, 1], k]
                    + shares[i, q, 2] * vertices[corner[i, 2], k]
                )


@compiled
def pieces_of(
    vertices: Array, corner: Ints, shares: Array, centers: Array, areas: Array, moments: Array,
    corners: Array,
) -> None:  # fmt: skip
    """Fill in centres, areas, second moments and corners of n pieces of triangles.

    Args:
        vertices, corner, shares: As of :func:`refit`.
        centers, areas, moments, corners: Filled [m, m², m², m], shapes (n, 3), (n,), (n, 3, 3),
            (n, 3, 3).
    """
    for i in range(corner.shape[0]):
        _corners(vertices, corner, shares, i, corners[i])
        areas[i] = _triangle(corners[i], centers[i], moments[i])


@compiled
def pieces_within(at: Array, corner: Ints, order: Ints, walls: Array, high: float) -> Ints:
    """The pieces whose triangles reach between walls and below a height [m], in their order.

    Args:
        at: Where the vertices stand [m], shape (v, 3).
        corner: Vertices of the triangle that each piece lies in, shape (n, 3).
        order: The pieces, shape (n,).
        walls: Along x and y [m], shape (2, 2).
        high: The height [m].
    """
    out, count = np.empty(order.shape[0], np.int64), 0
    for i in order:
        a, b, c = at[corner[i, 0]], at[corner[i, 1]], at[corner[i, 2]]
        near = min(a[2], b[2], c[2]) <= high
        for k in range(2):
            near = near and min(a[k], b[k], c[k]) <= walls[1, k]
            near = near and max(a[k], b[k], c[k]) >= walls[0, k]
        if near:
            out[count] = i
            count += 1
    return out[:count]


@kernel
def _triangle(corners: Array, center: Array, moments: Array) -> float:
    """Area of a triangle (3, 3); its centre (3,) and second moments (3, 3) are filled in."""
    for k in range(3):
        center[k] = (corners[0, k] + corners[1, k] + corners[2, k]) / 3.0
    for i in range(3):
        for k in range(i + 1):
            total = 0.0
            for q in range(3):
                total += (corners[q, i] - center[i]) * (corners[q, k] - center[k])
            moments[i, k] = moments[k, i] = total / 12.0
    square = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        part = (corners[1, j] - corners[0, j]) * (corners[2, k] - corners[0, k])
        part -= (corners[1, k] - corners[0, k]) * (corners[2, j] - corners[0, j])
        square += part * part
    return 0.5 * math.sqrt(square)


@compiled
def count_halves(
    vertices: Array, pieces: tuple[Ints, Array, Array, Array], place: tuple[Array, Array],
    space: Any, finest: float,
) -> Ints:  # fmt: skip
    """How often each piece is divided, shape (n,); arguments as of :func:`refit`."""
    corner, shares, first, longest = pieces
    n = corner.shape[0]
    out, room = np.zeros(n, np.int64), np.empty((_MOST + 2, 2, 3, 3))
    depth, middle = np.empty(_MOST + 2, np.int64), np.empty(3)
    for i in range(n):
        if longest[i] <= finest:
            continue
        for q in range(3):  # its first corner is no farther from its centre than that
            for k in range(3):
                room[0, 0, q, k] = vertices[corner[i, 0], k]
        far = not _is_wide(room[0, 0], longest[i], place, space, middle, WIDE_PIECE / _NEAR)
        if far and shares.shape[0] == 0:
            continue
        _corners(vertices, corner, shares, i, room[0, 0])
        if not _is_wide(room[0, 0], longest[i], place, space, middle, WIDE_PIECE):
            continue
        for q in range(3):
            for k in range(3):
                room[0, 1, q, k] = first[i, q, k]
        depth[0], top = 0, 1
        while top > 0:
            top -= 1
            if not _is_divided(room[top], depth[top], place, space, finest, middle):
                continue
            out[i] += 1
            _halve(room, top)
            depth[top] += 1
            depth[top + 1] = depth[top]
            top += 2
    return out


@kernel
def _longest(corners: Array) -> tuple[int, float]:
    """The corner from which the longest edge of a triangle (3, 3) starts, and its length."""
    best, long = 0, -1.0
    for q in range(3):
        square = 0.0
        for k in range(3):
            square += (corners[(q + 1) % 3, k] - corners[q, k]) ** 2
        if square > long * (1.0 + 1e-9):
            best, long = q, square
    return best, math.sqrt(long)


@kernel
def _is_divided(
    both: Array, depth: int, place: tuple[Array, Array], space: Any, finest: float, middle: Array
) -> bool:
    """Whether a triangle, now and at rest (2, 3, 3), is to be halved."""
    _, long = _longest(both[1])
    return (
        depth < _MOST
        and long > finest
        and _is_wide(both[0], long, place, space, middle, WIDE_PIECE)
    )


@kernel
def _is_wide(
    corners: Array, long: float, place: tuple[Array, Array], space: Any, middle: Array, part: float
) -> bool:
    """Whether a triangle (3, 3) of such a longest edge is longer than a part of its distance from
    the design."""
    turn, position = place
    for i in range(3):
        x = position[i]
        for k in range(3):
            x += turn[i, k] * (corners[0, k] + corners[1, k] + corners[2, k]) / 3.0
        middle[i] = x
    x, y, z = on_face(middle[0], middle[1], middle[2], space.curvature)
    low, high = space.face[0], space.face[1]
    square = max(low[0] - x, x - high[0], 0.0) ** 2 + max(low[1] - y, y - high[1], 0.0) ** 2
    square += max(low[2] - z, z - high[2], 0.0) ** 2
    return long * long > part * part * square


@kernel
def _halve(room: Array, at: int) -> None:
    """Replace triangle ``at`` of a stack by its halves, across the longest edge at rest."""
    start, _ = _longest(room[at, 1])
    end, other = (start + 1) % 3, (start + 2) % 3
    for b in range(2):
        for k in range(3):
            x, y, z = room[at, b, start, k], room[at, b, end, k], room[at, b, other, k]
            room[at + 1, b, 0, k], room[at + 1, b, 1, k] = 0.5 * (x + y), y
            room[at + 1, b, 2, k] = z
            room[at, b, 0, k], room[at, b, 1, k], room[at, b, 2, k] = x, 0.5 * (x + y), z


@compiled
def refit(
    vertices: Array,
    pieces: tuple[Ints, Array, Array, Array],
    tree: tuple[Ints, Ints, Ints],
    halves: Ints,
    place: tuple[Array, Array],
    space: Any,
    limits: tuple[float, float, float],
) -> Refit:  # fmt: skip
    """Clusters of a mesh at this instant; those below single pieces come last.

    Args:
        vertices: Of the mesh [m], shape (v, 3).
        pieces: Of n pieces: vertices of the triangle that each lies in, (n, 3); its corners as
            shares of the triangle's, (n, 3, 3), or (0, 3, 3) where all are undivided; its corners
            [m], (n, 3, 3), and longest edge [m], (n,), as they were first.
        tree: Parts, functions and pieces of the clusters, as in ``Clusters``.
        halves: As of :func:`count_halves`.
        place: Where the mesh stands in the sensor frame: rotation, times its size, and position.
        space: Surroundings of the design.
        limits: Smallest area of a piece [m²]; triangles with no edge longer than the second [m] at
            rest are not halved; energy of a function times the extent of its cluster.
    """
    children, function, panel = tree
    least, finest, energy = limits
    corner, shares, first, _ = pieces
    own_corners = np.empty((3, 3))
    nodes, more = panel.shape[0], 0
    for i in range(halves.shape[0]):
        more += halves[i]
    count = nodes + 2 * more
    out = Refit(
        np.empty((count, 2), np.int64), np.empty(count, np.int64), np.empty(count),
        np.empty((count, 3)),
        np.empty((count, 3, 3)), np.empty(count), np.empty((count + 1) // 2),
    )  # fmt: skip
    made, functions = nodes, (nodes + 1) // 2
    room, middle = np.empty((_MOST + 2, 2, 3, 3)), np.empty(3)
    depth, number = np.empty(_MOST + 2, np.int64), np.empty(_MOST + 2, np.int64)
    for k in range(nodes - 1, -1, -1):
        i = panel[k]
        if i < 0:
            a, b = children[k, 0], children[k, 1]
            out.children[k, 0], out.children[k, 1], out.function[k] = a, b, function[k]
            _join(out, k, a, b)
        else:
            out.children[k, 0] = out.children[k, 1] = out.function[k] = -1
            _corners(vertices, corner, shares, i, own_corners)
            area = max(_triangle(own_corners, out.center[k], out.spread[k]), least)
            out.charge[k] = area
        out.extent[k] = _extent(out.spread[k])
        if i < 0:
            out.own[function[k]] = energy / out.extent[k]
        elif more > 0 and halves[i] > 0:
            for q in range(3):
                for p in range(3):
                    room[0, 0, q, p], room[0, 1, q, p] = own_corners[q, p], first[i, q, p]
            depth[0], number[0], top = 0, k, 1
            while top > 0:
                top -= 1
                if not _is_divided(room[top], depth[top], place, space, finest, middle):
                    continue
                whole = number[top]
                out.function[whole], out.own[functions] = functions, energy / out.extent[whole]
                functions += 1
                _halve(room, top)
                for c in range(2):
                    out.children[whole, c] = made
                    out.children[made, 0] = out.children[made, 1] = out.function[made] = -1
                    _triangle(room[top + c, 0], out.center[made], out.spread[made])
                    out.charge[made] = 0.5 * out.charge[whole]
                    out.extent[made] = _extent(out.spread[made])
                    depth[top + c], number[top + c] = depth[top] + 1 - c, made
                    made += 1
                top += 2
    out.own[0] = 0.5 * energy / out.extent[0]
    return out


@kernel
def _extent(spread: Array) -> float:
    """Extent of a cluster [m] from its second moments (3, 3)."""
    return math.sqrt(6.0 * (spread[0, 0] + spread[1, 1] + spread[2, 2])) + 1e-9


@kernel
def _join(out: Refit, k: int, a: int, b: int) -> None:
    """Charge, centre and second moments of cluster k from its parts a and b."""
    whole = out.charge[a] + out.charge[b]
    p, q = out.charge[a] / whole, out.charge[b] / whole
    out.charge[k] = whole
    for i in range(3):
        out.center[k, i] = p * out.center[a, i] + q * out.center[b, i]
    for i in range(3):
        x = out.center[a, i] - out.center[b, i]
        for j in range(i + 1):
            y = out.center[a, j] - out.center[b, j]
            both = p * out.spread[a, i, j] + q * out.spread[b, i, j] + p * q * x * y
            out.spread[k, i, j] = out.spread[k, j, i] = both
