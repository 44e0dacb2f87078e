"""The step, compiled: the clusters that are not split further, and what the design does to them.

A *row* is a cluster's mean of the terminals' potentials φ⁰ (first ``Green.lead`` columns) and of
the modes ψ of g.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled
from capsense.surface.place_kernels import (
    FAR_LEAST,
    NEAR_LEAST,
    beyond,
    distances,
    least_gap,
    lift,
    near_share,
)
from capsense.surface.vector_kernels import doubles, multiply, source_potentials


class Leaves(NamedTuple):
    """The clusters that are not split further."""

    points: NDArray[Any]
    """Four points of each [m], shape (l, 4, 3)."""
    true: NDArray[Any]
    """The same before they were lifted off the design."""
    extent: NDArray[Any]
    """Extents [m], shape (l,)."""
    beyond: NDArray[Any]
    """How far each is out of reach, 0 to 1, see ``place_kernels.beyond``, shape (l,)."""
    owner: NDArray[Any]
    """Body of each, ascending, shape (l,)."""
    within: NDArray[Any]
    """How much a changing body's clusters meet each other, 1 for a conductor; 0 for rigid bodies,
    which have energies of their own; shape (l,)."""


@compiled
def placed(bodies, cut, green, inside):
    """Place the leaves of a cut in the sensor frame.

    ``inside`` is the impedance of the inside of surfaces that change, over their energy.
    """
    n = cut.leaves.shape[0]
    points, extent, corners = np.empty((n, 4, 3)), np.empty(n), np.empty((4, 3))
    true, out = np.empty((n, 4, 3)), np.empty(n)
    owner, within = np.empty(n, np.int64), np.zeros(n)
    moments, turn, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for j in range(n):
        a = cut.leaves[j]
        body = bodies[cut.body[a]]
        owner[j], k = cut.body[a], cut.node[a]
        if body.spread != 0:
            within[j] = 1.0 if body.sheet > 0.0 else 1.0 + inside * body.softness
            spread, center = doubles(body.spread), doubles(body.center)
            for i in range(3):
                middle[i] = center[3 * k + i]
                for q in range(3):
                    moments[i, q] = spread[9 * k + 3 * i + q]
            extent[j] = body.scale * four_points(moments, middle, turn, corners)
        else:
            extent[j] = body.scale * doubles(body.extent)[k]
            local = doubles(body.points)
            for q in range(4):
                for i in range(3):
                    corners[q, i] = local[12 * k + 3 * q + i]
        for q in range(4):
            for i in range(3):
                points[j, q, i] = body.position[i] + body.scale * (
                    body.rotation[i, 0] * corners[q, 0] + body.rotation[i, 1] * corners[q, 1]
                    + body.rotation[i, 2] * corners[q, 2])  # fmt: skip
        for q in range(4):
            for i in range(3):
                true[j, q, i] = points[j, q, i]
        out[j] = beyond(points[j], green)
        if green.cover < 1.0:
            lift(points[j], least_gap(extent[j], green.cover), green.box)
    return Leaves(points, true, extent, out, owner, within)


@compiled
def four_points(a, center, v, out):
    """Four points of equal weight with a centre and the two largest of its second moments.

    Args:
        a: Second central moments [m²], shape (3, 3); lost.
        center: [m], shape (3,).
        v: Room to work in, shape (3, 3).
        out: Filled [m], shape (4, 3).

    Returns:
        Length of a uniform rod with the largest second moment [m].
    """
    for i in range(3):
        for k in range(3):
            v[i, k] = 1.0 if i == k else 0.0
    for _ in range(6):  # Jacobi's rotations
        for p in range(2):
            for q in range(p + 1, 3):
                if abs(a[p, q]) < 1e-12 * (abs(a[p, p]) + abs(a[q, q])) + 1e-300:
                    continue
                angle = 0.5 * math.atan2(2.0 * a[p, q], a[q, q] - a[p, p])
                c, s = math.cos(angle), math.sin(angle)
                for k in range(3):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
    least = 0
    for i in range(1, 3):
        if a[i, i] < a[least, least]:
            least = i
    first, second = (least + 1) % 3, (least + 2) % 3
    if a[first, first] < a[second, second]:
        first, second = second, first
    long = math.sqrt(max(a[first, first], 0.0))
    short = math.sqrt(max(a[second, second], 0.0))
    for i in range(3):
        x, y = long * v[i, first], short * v[i, second]
        out[0, i], out[1, i] = center[i] + x + y, center[i] + x - y
        out[2, i], out[3, i] = center[i] - x + y, center[i] - x - y
    return math.sqrt(12.0) * long


@compiled
def leaf_rows(points, beyond, green):
    """Rows of the leaves, shape (l, w); no wider than those of far points where none is near."""
    distance = distances(points, green)
    n = points.shape[0]
    near = False
    for j in range(n):
        near = near or distance[j] < green.blend[1]
    out = np.zeros((n, green.near_table.shape[1] if near else green.far_table.shape[1]), np.float32)
    chosen, share = np.empty(n, np.int64), np.empty(n)
    some = np.empty((n, 4, 3), np.float32)
    for far in range(2):
        count = 0
        for j in range(n):
            part = near_share(distance[j], green.blend)
            part = (1.0 - part if far == 1 else part) * (1.0 - beyond[j])
            if part > 0.0:
                chosen[count], share[count] = j, part
                for q in range(4):
                    for i in range(3):
                        some[count, q, i] = points[j, q, i]
                count += 1
        if count == 0:
            continue
        if far == 1:
            _add_rows(
                some[:count],
                chosen,
                share,
                green.far,
                green.far_table,
                green.floor,
                FAR_LEAST,
                out,
            )
        else:
            _add_rows(
                some[:count],
                chosen,
                share,
                green.near,
                green.near_table,
                green.floor,
                NEAR_LEAST,
                out,
            )
    return out


@compiled
def _add_rows(points, chosen, share, sources, table, floor, least, out):
    values = np.empty((points.shape[0], sources.shape[1]), np.float32)
    source_potentials(points, sources, np.float32(floor), np.float32(least), values)
    rows = np.empty((points.shape[0], table.shape[1]), np.float32)
    multiply(values, table, rows)
    for c in range(points.shape[0]):
        part, line, to = np.float32(share[c]), rows[c], out[chosen[c]]
        for i in range(table.shape[1]):
            to[i] += part * line[i]
