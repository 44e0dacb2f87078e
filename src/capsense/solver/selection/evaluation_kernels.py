"""The step, compiled: what the clusters of a body see of the design, as far as scores need it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._dense import padded
from capsense._jit import compiled, kernel
from capsense._simd import WIDE, doubles, integers
from capsense.field.face_kernels import keep_off, off_walls, on_face, smooth
from capsense.field.green_kernels import point_potentials
from capsense.field.grid_kernels import grid_values, to_grid

_LINEAR = 0.45, 0.58
"""Clusters smaller than the first part of their distance from the design see a linear potential,
those larger than the second do not; in between they come to do."""
_COARSE = 31
"""So many clusters, the coarsest of a body, are looked into wherever they are."""
LONG = 0.06, 0.12
"""Clusters that cross a wall come to be looked into where they are longer than this, over the
domain's shortest side."""
_SCREENED = 2.0 * math.pi
"""A grounded plane at a distance d leaves charges of wavelength 2 l, as the function of a cluster
of size l has, 1 - exp(-2π d / l) of their energy."""
_LEAST_LEFT = 1e-3
"""Least part of its energy that a cluster counts as left with."""
_FREED = 20.0
"""Exponent from which on that is not looked at: it is 2e-9."""
_BEHIND = 4e-3
"""So far behind its face [m] a flat design leaves functions all of their energy: many of them among
its sources would leave no definite matrix."""
_ARM = 0.2
"""Faces of a layer of dipoles count as at least so far apart, over the extent of a cluster, where
its functions are scored."""
_CLOSE = 8e-3, 12e-3
"""Within the first distance from a flat design [m] potentials are those of its charges, beyond the
second those of the table."""


class ClusterEvaluation(NamedTuple):
    """The clusters that were looked at: those of each body, wholes first; then parts of panels.

    The capacity is n; the rows of evaluated clusters are filled.
    """

    node: NDArray[Any]
    """Place of each in its body's tree, shape (n,)."""
    children: NDArray[Any]
    """Row of its first part, which the second follows; -1 where none was looked at, (n,)."""
    means: NDArray[Any]
    """Mean of φ⁰ [V], shape (n, lead)."""
    linearity: NDArray[Any]
    """How linear φ⁰ is there, 0 to 1, shape (n,)."""
    ancestor_weight: NDArray[Any]
    """How much it is not in all clusters above, shape (n,)."""
    wall_crossing_weight: NDArray[Any]
    """How much it crosses a wall, shape (n,)."""
    screening_factor: NDArray[Any]
    """Energy of its charge function in front of a flat design, over that in free space, (n,); not
    filled where that is not looked into."""
    score: NDArray[Any]
    """Share of the electrodes' energies that its function takes up alone, raised by those of its
    parts, shape (n,)."""
    refinement_score: NDArray[Any]
    """Of panels, the score from which on they have parts, shape (n,)."""


@compiled
def room_for(count, phi_columns):
    """Room for so many clusters."""
    return ClusterEvaluation(
        np.empty(count, np.int64),
        np.empty(count, np.int64),
        np.empty((count, phi_columns), np.float32),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty(count),
    )


@compiled
def with_room(looks, filled, more):
    """A copy with capacity for more rows behind the filled ones.

    Room for all clusters of a scene may take a hundred megabytes, which the system would hand out
    anew at each step.
    """
    if filled + more <= looks.node.shape[0]:
        return looks
    out = room_for(2 * filled + more, looks.means.shape[1])
    for k in range(filled):
        out.node[k], out.children[k] = looks.node[k], looks.children[k]
        for i in range(looks.means.shape[1]):
            out.means[k, i] = looks.means[k, i]
        out.linearity[k], out.ancestor_weight[k] = looks.linearity[k], looks.ancestor_weight[k]
        out.wall_crossing_weight[k], out.screening_factor[k] = (
            looks.wall_crossing_weight[k],
            looks.screening_factor[k],
        )
        out.score[k], out.refinement_score[k] = looks.score[k], looks.refinement_score[k]
    return out


@kernel
def face_distance(point, space):
    """Square of a point's distance from the design [m²], and how high above its face it is [m]."""
    x, y, z = on_face(point[0], point[1], point[2], space.curvature)
    low, high = space.face[0], space.face[1]
    square = max(low[0] - x, x - high[0], 0.0) ** 2 + max(low[1] - y, y - high[1], 0.0) ** 2
    return square + max(low[2] - z, z - high[2], 0.0) ** 2, z - high[2]


@kernel
def place(body, space, k, points, found, middle):
    """Place the middle of cluster k in row ``found`` of ``points`` (n, 3).

    ``middle`` is workspace for a point, shape (3,).

    Returns:
        Square of its distance from the design [m²]; how high above its box it is [m]; how far it is
        from the next wall, negative beyond it [m]; and :func:`off_walls`.
    """
    center, room = doubles(body.center), math.inf
    for i in range(3):
        x = body.position[i]
        for q in range(3):
            x += body.scale * body.rotation[i, q] * center[3 * k + q]
        middle[i] = points[found, i] = x
        room = min(room, x - space.active_bounds[0, i], space.active_bounds[1, i] - x)
    out, _ = off_walls(middle[0], middle[1], middle[2], body.free, space)
    square, height = face_distance(middle, space)
    if square < 4.0 * space.validity * space.validity and space.has_face:
        keep_off(points[found : found + 1], space)
        square, height = face_distance(points[found], space)
    return square, height, room, out


@kernel
def screening(has_face, size, square, height):
    """:attr:`ClusterEvaluation.screening_factor` of a cluster of some size [m], from what
    :func:`place` returns.

    ``has_face`` is :attr:`Space.has_face`.
    """
    if not has_face:  # the box of such designs is no surface
        return 1.0
    far = _SCREENED * math.sqrt(square)
    if far >= _FREED * size:
        return 1.0
    return max(1.0 - smooth(1.0 + height / _BEHIND) * math.exp(-far / size), _LEAST_LEFT)


@compiled
def look(body, green, coarser, looks, start):
    """Look at a body's clusters, and into those that do not see a linear potential.

    φ⁰ is that in their middle, from the far sources, or is made up from their parts. Panels are not
    looked into.

    Args:
        body: The body.
        green: Green's function of the design.
        coarser: Clusters may be so many times as large as they usually are. Functions count for
            less by the third power of their size.
        looks: Filled from a row on.
        start: That row.

    Returns:
        The row behind the last one that was filled.
    """
    places, inner = np.empty(body.n_panel_clusters, np.int64), np.empty(body.n_panel_clusters)
    points = np.empty((body.n_panel_clusters, 3), np.float32)
    stop, found = _look_into(
        body, green, coarser, looks, start, (points, places, inner, np.empty(3))
    )
    if body.layer > 0.0:
        _layer_potentials(body, green, looks, points[:found], places[:found], inner)
    else:
        far_potentials(points[:found], places[:found], inner, green, looks.means)
    _make_up(body, start, stop, looks)
    return stop


@kernel
def put_offset(body, k, thickness, out):
    """Half of a thickness [m] along the mean normal of cluster k of a layer, shape (3,)."""
    normals, half = doubles(body.normals), 0.5 * body.scale * thickness
    for i in range(3):
        out[i] = 0.0
        for q in range(3):
            out[i] += half * body.rotation[i, q] * normals[3 * k + q]


@compiled
def _layer_potentials(body, green, looks, points, places, share):
    """As :func:`far_potentials`, of a layer of dipoles: the difference across it."""
    extent, off, count = doubles(body.extent), np.empty(3), points.shape[0]
    front, back, factor = points.copy(), points.copy(), np.empty(count, np.float32)
    for j in range(count):
        k = looks.node[places[j]]
        arm = max(body.layer, _ARM * extent[k])  # the table does not resolve thin layers
        factor[j] = body.layer / arm
        put_offset(body, k, arm, off)
        for i in range(3):
            front[j, i] += off[i]
            back[j, i] -= off[i]
    other = np.zeros_like(looks.means)
    far_potentials(front, places, share, green, looks.means)
    far_potentials(back, places, share, green, other)
    for j in range(count):
        row = places[j]
        for i in range(looks.means.shape[1]):
            looks.means[row, i] = factor[j] * (looks.means[row, i] - other[row, i])


@kernel
def _look_into(body, green, coarser, looks, start, wanted):
    """Evaluate clusters but for potentials, which are wanted at points, in rows, times a part of
    each.

    Returns:
        The row behind the last one that was filled, and how many points there are.
    """
    children, extent, (points, rows, inner, middle) = (
        integers(body.children),
        doubles(body.extent),
        wanted,
    )
    space = green.space
    looks.node[start], looks.ancestor_weight[start] = 0, 1.0
    row, stop, found = start - 1, start + 1, np.int64(0)
    while row + 1 < stop:
        row += 1
        k = looks.node[row]
        size, (square, height, room, out) = (
            body.scale * extent[k], place(body, space, k, points, found, middle),
        )  # fmt: skip
        share = 1.0 - smooth(out)
        looks.wall_crossing_weight[row] = looks.linearity[row] = 0.0
        if size > max(LONG[0] * space.extent, 2.0 * abs(room)):
            looks.wall_crossing_weight[row] = smooth(2.0 - 4.0 * abs(room) / size) * smooth(
                (size / space.extent - LONG[0]) / (LONG[1] - LONG[0])
            )
        if k >= _COARSE:
            part = size / (coarser * math.sqrt(square + 1e-12))
            even = smooth((_LINEAR[1] - part) / (_LINEAR[1] - _LINEAR[0]))
            looks.linearity[row] = (1.0 - share * (1.0 - even)) * (
                1.0 - looks.wall_crossing_weight[row]
            )
        for i in range(green.phi_columns):
            looks.means[row, i] = 0.0
        whole = not 0 <= children[2 * k] < body.n_panel_clusters
        if share > 0.0 and (looks.linearity[row] > 0.0 or whole):
            rows[found], inner[found] = row, share
            found += 1
        looks.children[row] = -1
        if whole or looks.linearity[row] < 1.0:
            looks.screening_factor[row] = screening(space.has_face, size, square, height)
        if looks.linearity[row] < 1.0 and not whole:
            looks.children[row] = stop
            for c in range(2):
                looks.node[stop] = children[2 * k + c]
                looks.ancestor_weight[stop] = looks.ancestor_weight[row] * (
                    1.0 - looks.linearity[row]
                )
                stop += 1
    return stop, found


@compiled
def far_potentials(points, places, share, green, means):
    """Fill rows ``places`` of ``means`` with φ⁰ at points (k, 3), times a share of each.

    That is from a table, and close to the face of a flat design from its charges.
    """
    found = points.shape[0]
    near, close, rest = np.arange(found), np.empty(found), np.empty(found)
    columns = _columns(points, near)
    to_grid(columns, green.grid)
    count = _close(points, share, green, near, close, rest)
    grid_values(columns, green.grid, rest, places, means)
    if count == 0:
        return
    columns = _columns(points, near[:count])
    phi = np.empty((green.phi_columns, columns.shape[1]), np.float32)
    limits = np.float32(green.floor), np.float32(green.levels[-1].least)
    point_potentials(columns, green.levels[-1].sources, green.score_table, limits, phi)
    for j in range(count):
        for i in range(green.phi_columns):
            means[places[near[j]], i] += np.float32(close[j]) * phi[i, j]


@kernel
def _close(points, share, green, near, close, rest):
    """Split shares of points (k, 3) into those close to the face of a design and the rest.

    Args:
        points, share, green: As of :func:`far_potentials`.
        near: Filled with the points that are close, shape (k,).
        close: Filled with these parts of theirs, shape (k,).
        rest: Filled with what is left of each share, shape (k,).

    Returns:
        How many are close.
    """
    count, space = 0, green.space
    for j in range(points.shape[0]):
        part = 0.0
        square, _ = face_distance(points[j], space)
        if space.has_face and square < _CLOSE[1] * _CLOSE[1]:
            part = share[j] * smooth((_CLOSE[1] - math.sqrt(square)) / (_CLOSE[1] - _CLOSE[0]))
            near[count], close[count] = j, part
            count += 1
        rest[j] = share[j] - part
    return count


@compiled
def _columns(points, some):
    """Some of the points (k, 3) as (3, p), p a multiple of 16; the last one of them is repeated."""
    out = np.empty((3, padded(some.shape[0], WIDE)), np.float32)
    for j in range(out.shape[1]):
        k = some[min(j, some.shape[0] - 1)]
        for i in range(3):
            out[i, j] = points[k, i]
    return out


@kernel
def _make_up(body, start, stop, looks):
    """Mean potentials of clusters from those of their parts, where they do not see a linear one."""
    charge, means, one = doubles(body.charge), looks.means, np.float32(1.0)
    for row in range(stop - 1, start - 1, -1):
        x = looks.children[row]
        if x >= 0:
            p = np.float32(charge[looks.node[x]] / charge[looks.node[row]])
            t = np.float32(looks.linearity[row])
            q, r = (one - t) * p, (one - t) * (one - p)
            for i in range(means.shape[1]):
                whole = t * means[row, i] if t > 0.0 else np.float32(0.0)
                means[row, i] = whole + q * means[x, i] + r * means[x + 1, i]
