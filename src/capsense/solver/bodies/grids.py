"""Flat polygons that cover boxes and bodies of revolution, finer where charge gathers.

All shapes are convex and centred on the origin of their own frame. Rings of nodes are moved out
so far that the mean square distance of the flat panels is that of the curved surface; with few
panels this leaves the least error of the capacitance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel

Array = NDArray[np.float64]
Profile = tuple[Array, Array, NDArray[np.int64]]
"""Rings from the lower to the upper pole: radii, heights, and numbers of nodes (1 at a pole)."""

_EDGE = 1.8
"""Power of the distance to an edge by which the cells of a flat face shrink."""
_GROWTH, _INNER = 0.8, 0.4
"""Tiles grow by so much of their distance from an edge, and so many of all would cover a face
evenly."""
_LONGEST = 1.42
"""Tiles longer than so many times their side are halved."""
_LEAST = 12
"""Fewest panels round the widest ring."""
_LEAST_INNER = 5
"""Fewest panels round any ring."""


def box_polygons(size: tuple[float, float, float], count: int) -> Array:
    """About ``count`` rectangles on a box of full edge lengths ``size`` [m], shape (n, 4, 3)."""

    thin, middle, _ = sorted(size)
    least = 2 if 2 * thin < middle else 3  # of a rod, both widths matter

    def cells(cell: float) -> list[int]:
        return [max(least, round(s / cell)) for s in size]

    def total(k: list[int]) -> int:
        return 2 * (k[0] * k[1] + k[1] * k[2] + k[0] * k[2])

    k = cells(_best_cell(max(size), count, lambda cell: total(cells(cell))))
    lines = [0.5 * s * _graded(n) for s, n in zip(size, k, strict=True)]

    def rectangles(axis: int) -> Array:
        u, v = lines[(axis + 1) % 3], lines[(axis + 2) % 3]
        return np.stack([_corners(u[:-1], v[:-1]), _corners(u[1:], v[1:])], axis=1)

    return _on_faces(size, rectangles)


class Tiles(NamedTuple):
    """How large tiles of a box are: the smaller, the nearer they are to an edge."""

    size: tuple[float, float, float]
    """Full edge lengths of the box [m]."""
    least: float
    """Side of those at an edge [m], about."""
    most: float
    """Side of those far from all edges [m]."""

    def side(self, points: Array) -> Array:
        """Sides of tiles at points on the box [m], shape (n, 3) -> (n,)."""
        off = np.sort(0.5 * np.array(self.size) - np.abs(points), axis=1)[:, 1]
        return self._side(off)

    def _side(self, off: Array) -> Array:
        """Sides at distances from the nearest edge [m], shape (n,) -> (n,)."""
        return np.minimum(self.least + _GROWTH * off, self.most)

    def polygons(self) -> Array:
        """The tiles, shape (n, 4, 3)."""
        return _on_faces(self.size, self._rectangles)

    def _rectangles(self, axis: int) -> Array:
        """Lower and upper corner of tiles of a face, shape (n, 2, 2)."""
        size = np.array([self.size[(axis + k) % 3] for k in (1, 2)])
        u, v = (np.linspace(-0.5, 0.5, max(1, round(s / self.most)) + 1) * s for s in size.tolist())
        out, left = [], np.stack([_corners(u[:-1], v[:-1]), _corners(u[1:], v[1:])], axis=1)
        while len(left):
            off = (0.5 * size - np.abs(left.mean(axis=1))).min(axis=1)
            sides = left[:, 1] - left[:, 0]
            large = sides.max(axis=1) > _LONGEST * self._side(off)
            out.append(left[~large])
            left, sides = left[large], sides[large]
            along = np.eye(2)[sides.argmax(axis=1)] * sides / 2
            left = np.concatenate(
                [np.stack([left[:, 0] + k * along, left[:, 1] - (1 - k) * along], axis=1)
                 for k in (0, 1)]
            )  # fmt: skip
        return np.concatenate(out)


def box_tiles(size: tuple[float, float, float], count: int) -> Tiles:
    """About ``count`` tiles of a box of full edge lengths ``size`` [m]."""
    x, y, z = size
    most = math.sqrt(2 * (x * y + y * z + x * z) / (_INNER * count))

    def total(least: float) -> int:
        return len(Tiles(size, least, most).polygons())

    low, high = 0.05 * most, most
    for _ in range(12):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if total(middle) > count else (low, middle)
    return Tiles(size, high, most)


def _corners(u: Array, v: Array) -> Array:
    return np.stack([x.ravel() for x in np.meshgrid(u, v)], axis=1)


def _on_faces(size: tuple[float, float, float], rectangles: Callable[[int], Array]) -> Array:
    """Rectangles on all faces of a box, from those of the face across an axis, (n, 4, 3)."""
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        (low_u, low_v), (top_u, top_v) = rectangles(axis).transpose(1, 2, 0)
        for side in (-0.5, 0.5):
            face = np.empty((len(low_u), 4, 3))
            face[..., axis] = side * size[axis]
            face[..., u] = np.stack([low_u, top_u, top_u, low_u], axis=1)
            face[..., v] = np.stack([low_v, low_v, top_v, top_v], axis=1)
            faces.append(face if side > 0 else face[:, ::-1])
    return np.concatenate(faces)


def ellipsoid_polygons(radii: tuple[float, float, float], count: int) -> Array:
    """About ``count`` polygons on an ellipsoid of half axes ``radii`` [m], shape (n, 4, 3).

    Affine images of the panels of a ball: the charge of a lone conducting ellipsoid is the image
    of the even charge of a ball. The poles lie on the axis that differs most from the others.
    """
    short, middle, long = (int(k) for k in np.argsort(radii, kind="stable"))
    pole = long if radii[long] * radii[short] > radii[middle] ** 2 else short
    order = [(pole + 1) % 3, (pole + 2) % 3, pole]
    a = 0.5 * (radii[order[0]] + radii[order[1]])
    c = radii[pole]

    def profile(cell: float) -> Profile:
        arc = math.pi * math.sqrt(0.5 * (a * a + c * c))
        n = max(4, round(arc / cell))
        angle = np.linspace(0.0, math.pi, n + 1)
        rho, z = np.sin(angle), -np.cos(angle)
        rho[[0, -1]] = 0.0
        step = (math.pi / n) * np.hypot(a * z, c * rho)
        return rho, z, ring_counts(a * rho, np.maximum(step, 0.3 * cell), 2 * math.pi * a / cell)

    rho, z, nodes = profile(_best_cell(max(a, c), count, lambda h: panel_count(profile(h)[2])))
    factor = _ring_factors(rho, z, nodes, 0.0, 1.0)
    ball = revolve(rho * factor, z * factor, nodes)
    out = np.empty_like(ball)
    for k, axis in enumerate(order):
        out[..., axis] = radii[axis] * ball[..., k]
    return out


def capsule_polygons(radius: float, length: float, count: int) -> Array:
    """About ``count`` polygons on a capsule of ``length`` [m] without caps, shape (n, 4, 3)."""
    half = 0.5 * length

    def profile(cell: float) -> Profile:
        n = max(3, round(0.5 * math.pi * radius / cell))
        k = max(1, round(length / cell))
        angle = np.linspace(0.0, 0.5 * math.pi, n + 1)
        tube = np.linspace(-half, half, k + 1)[1:-1]
        rho = radius * np.concatenate([np.sin(angle), np.ones(k - 1), np.cos(angle)])
        z = np.concatenate([-half - radius * np.cos(angle), tube, half + radius * np.sin(angle)])
        rho[[0, -1]] = 0.0
        step = np.full(len(rho), 0.5 * math.pi * radius / n)
        return rho, z, ring_counts(rho, step, 2 * math.pi * radius / cell)

    rho, z, nodes = profile(_best_cell(half + radius, count, lambda h: panel_count(profile(h)[2])))
    factor = _ring_factors(rho, z, nodes, half, radius)
    axis = np.clip(z, -half, half)
    return revolve(rho * factor, axis + (z - axis) * factor, nodes)


def cylinder_polygons(radius: float, length: float, count: int) -> Array:
    """About ``count`` polygons on a cylinder of full ``length`` [m] along z, shape (n, 4, 3)."""

    def profile(cell: float) -> Profile:
        n = max(3, round(1.4 * radius / cell))
        k = max(2, round(length / cell))
        end = np.sin(np.linspace(0.0, 0.5 * math.pi, n + 1))
        rho = radius * np.concatenate([end, np.ones(k - 1), end[::-1]])
        side = 0.5 * length * _graded(k)
        z = np.concatenate([np.full(n, side[0]), side, np.full(n, side[-1])])
        step = np.full(len(rho), 0.7 * cell)
        return rho, z, ring_counts(rho, step, 2 * math.pi * radius / cell)

    size = max(radius, 0.5 * length)
    rho, z, nodes = profile(_best_cell(size, count, lambda h: panel_count(profile(h)[2])))
    chord = math.sin(math.pi / nodes.max())
    return revolve(rho / math.sqrt(1 - 2 / 3 * chord * chord), z, nodes)


def _graded(n: int) -> Array:
    """Ends of n cells on [−1, 1] that shrink towards both ends."""
    t = np.linspace(-1.0, 1.0, n + 1)
    return np.sign(t) * (1 - (1 - np.abs(t)) ** _EDGE)


def _best_cell(size: float, count: int, panels: Callable[[float], int]) -> float:
    """The cell size [m] that makes nearest to ``count`` panels."""
    low, high = 0.5 * size / count, 4.0 * size
    best = (count, high)
    for _ in range(14):
        cell = math.sqrt(low * high)
        found = panels(cell)
        best = min(best, (abs(found - count), cell))
        low, high = (cell, high) if found > count else (low, cell)
    return best[1]


@compiled
def ring_counts(rho: Array, step: Array, widest: float) -> NDArray[np.int64]:
    """Nodes on every ring of radius ``rho`` [m]: ``widest`` on the widest, halved towards poles.

    Neighbours have equal numbers or twice as many. ``step`` [m] is the height of the cells.
    """
    most = max(_LEAST, 4 * round(widest / 4))
    count, largest = len(rho), rho.max()
    out = np.empty(count, np.int64)
    middle = last = int(np.argmax(rho))
    for i in range(middle, count):
        if rho[i] == largest:
            last = i
    out[middle : last + 1] = most
    for first, stop, way in ((middle - 1, -1, -1), (last + 1, count, 1)):
        nodes = most
        for i in range(first, stop, way):
            inner = i + way != stop
            least = 0.7 * min(step[i], 2 * math.pi * largest / most)
            fewer = nodes % 2 == 0 and nodes // 2 >= _LEAST_INNER
            if inner and fewer and 2 * math.pi * rho[i] / nodes < least:
                nodes //= 2
            out[i] = nodes if inner else 1
    return out


@compiled
def panel_count(nodes: NDArray[np.int64]) -> int:
    """How many panels :func:`revolve` makes."""
    out = 0
    for k in range(len(nodes) - 1):
        low, high = min(nodes[k], nodes[k + 1]), max(nodes[k], nodes[k + 1])
        out += low if low == high else (high if low == 1 else 3 * low)
    return out


@compiled
def revolve(rho: Array, z: Array, nodes: NDArray[np.int64]) -> Array:
    """Polygons between rings of nodes, corners of shape (n, 4, 3), counter-clockwise from outside.

    Trapezoids between rings of equal numbers, else triangles, which repeat their last corner.
    """
    out, at = np.empty((panel_count(nodes), 4, 3)), 0
    rings = np.empty((2, nodes.max() + 1, 3))  # that of a band with fewer nodes first
    for k in range(len(nodes) - 1):
        less = 0 if nodes[k] <= nodes[k + 1] else 1
        for side in range(2):
            ring, n = rings[side], nodes[k + abs(side - less)]
            radius, height = rho[k + abs(side - less)], z[k + abs(side - less)]
            for i in range(n):
                turn = 2 * math.pi * i / n
                ring[i, 0], ring[i, 1] = radius * math.cos(turn), radius * math.sin(turn)
                ring[i, 2] = height
            ring[n] = ring[0]
        few, many = rings[0], rings[1]
        low, high = min(nodes[k], nodes[k + 1]), max(nodes[k], nodes[k + 1])
        if low == high or low == 1:
            for i in range(high):
                a, b = (few[i], few[i + 1]) if low == high else (many[i], many[i + 1])
                c, d = (many[i + 1], many[i]) if low == high else (few[0], few[0])
                out[at, 0], out[at, 1], out[at, 2], out[at, 3] = a, b, c, d
                at += 1
            continue
        for fan in range(3):
            for i in range(low):
                a = few[i] if fan < 2 else few[i + 1]
                b = many[2 * i] if fan == 0 else many[2 * i + 1]
                c = many[2 * i + 1] if fan == 0 else (few[i + 1] if fan == 1 else many[2 * i + 2])
                out[at, 0], out[at, 1], out[at, 2], out[at, 3] = a, b, c, c
                at += 1
    for k in range(at):
        _outwards(out[k])
    return out


@kernel
def _outwards(corners: Array) -> None:
    """Turn a polygon (4, 3) whose normal points to the origin; repeated corners stay last."""
    along = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        normal = (corners[1, j] - corners[0, j]) * (corners[2, k] - corners[0, k])
        normal -= (corners[1, k] - corners[0, k]) * (corners[2, j] - corners[0, j])
        along += normal * (corners[0, i] + corners[1, i] + corners[2, i] + corners[3, i])
    if along >= 0.0:
        return
    same = True
    for i in range(3):
        same = same and corners[2, i] == corners[3, i]
    for i in range(3):
        if same:
            corners[0, i], corners[1, i] = corners[1, i], corners[0, i]
        else:
            corners[0, i], corners[3, i] = corners[3, i], corners[0, i]
            corners[1, i], corners[2, i] = corners[2, i], corners[1, i]


def _ring_factors(
    rho: Array, z: Array, nodes: NDArray[np.int64], half: float, radius: float
) -> Array:
    """How far out each ring moves from the stretch −half <= z <= half of the axis.

    Each panel asks for the factor that makes the mean of its squared distance from that stretch
    ``radius`` squared; a ring takes the mean over its panels, weighted with area.
    """
    polygons = revolve(rho, z, nodes)
    p = polygons.copy()
    p[..., 2] -= np.clip(p[..., 2], -half, half)
    area, square = np.zeros(len(p)), np.zeros(len(p))
    for a, b, c in ((0, 1, 2), (0, 2, 3)):
        cross = np.cross(polygons[:, b] - polygons[:, a], polygons[:, c] - polygons[:, a])
        part = np.linalg.norm(cross, axis=1)
        corner = (p[:, a] ** 2 + p[:, b] ** 2 + p[:, c] ** 2).sum(axis=1)
        total = ((p[:, a] + p[:, b] + p[:, c]) ** 2).sum(axis=1)
        area += part
        square += part * (corner + total) / 12
    wanted = radius / np.sqrt(square / area)
    heights = np.sort(polygons[..., 2], axis=1)
    weight, sums = np.zeros(len(z)), np.zeros(len(z))
    for end in (heights[:, 0], heights[:, -1]):
        ring = np.searchsorted(0.5 * (z[1:] + z[:-1]), end)
        weight += np.bincount(ring, area, len(z))
        sums += np.bincount(ring, area * wanted, len(z))
    return sums / weight
