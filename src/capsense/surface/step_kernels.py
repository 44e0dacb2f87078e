"""The step, compiled: which charge functions a scene needs, their matrix, their charges.

Lengths in metres, 4π eps0 = 1; symbols as in ``docs/theory.md``. A *row* is a cluster's mean of
the terminals' potentials φ⁰ (first ``Green.lead`` columns) and of the modes ψ of g.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.surface.vector_kernels import (
    doubles,
    fast,
    integers,
    multiply,
    multiply_lanes,
    point_potentials,
    source_potentials,
)

BODY = np.dtype(
    [
        ("n", np.int64),  # panels; there are 2 n - 1 clusters
        ("kids", np.int64), ("function", np.int64), ("charge", np.int64), ("center", np.int64),
        ("points", np.int64), ("extent", np.int64), ("own", np.int64), ("energy", np.int64),
        ("impedance", np.int64),  # all of these: where the arrays of a RigidShape stand
        ("spread", np.int64),  # second moments of a changing surface, else 0: it has no energies
        ("scale", np.float64),  # the body is so many times as large as the shape
        ("rotation", np.float64, (3, 3)), ("position", np.float64, 3),
        ("neutral", np.int64),  # whether it carries no net charge
        ("group", np.int64),  # bodies that touch are one conductor, named by its first body
        ("tie", np.float64),  # energy of a group's net charge beyond that of its field [1/m]
        ("softness", np.float64),  # 1 / (eps - 1), 0 for a conductor
    ]
)  # fmt: skip
"""One body, as the kernels take it."""

_NEAR_LEAST, _FAR_LEAST = 1e-3, 3e-3
"""Distances from near and far sources [m] below which their potential grows no more. They lie
deeper than that under the surfaces of the design."""
_LINEAR = 0.3
"""Clusters smaller than this part of their distance from the design see a linear potential."""
_COARSE = 31
"""So many clusters, the coarsest of a body, are looked into wherever they are."""
_DECAY = 0.35
"""Score of a part over that of the whole, 2 ** -1.5, in a linear potential."""
_SHORE = 5e-3
"""Bodies fade out over this distance beyond the room, and behind the face of a flat design [m]."""
BARRIER = 1e6
"""Energy of charge that is farther out than that [1/m]."""
_DEEP, _STEEP = 3e-3, 4.0
"""What is deeper behind the face of a flat design [m] comes to be screened by it; depth from the
sides counts so many times."""
_LONG = 0.03, 0.06
"""Clusters that cross a wall come to be split where they are longer than this [m]."""
_GAP = 1.5e-4, 7e-4, 0.18, 2e-5
"""Least gap to a flat design [m]: the square of a cluster's extent over the third, at least the
first, at most the second; less by the thickness of a cover, but not less than the fourth."""
_NEAR_FACE = 2e-3
"""Clusters farther from the design [m] keep their gap to it."""
USED, FRONTIER, LEAF = 2, 1, 0
"""State of a cluster: its function is used; it is split for an estimate only; it is not split."""


class Green(NamedTuple):
    """A design's Green's function, as the kernels take it; single precision."""

    near: NDArray[Any]
    """Sources for points near the sensor [m], shape (3, s)."""
    near_table: NDArray[Any]
    """What each source adds to φ⁰ and ψ, shape (s, w)."""
    far: NDArray[Any]
    """Sources for points far from it [m], shape (3, f)."""
    far_table: NDArray[Any]
    """The same of these, shape (f, v), v <= w."""
    score_table: NDArray[Any]
    """φ⁰ alone, from the far sources, shape (f, lead)."""
    lead: int
    """Columns of φ⁰, padded."""
    terminals: int
    """How many of them are terminals."""
    floor: float
    """Height of the floor [m]."""
    box: NDArray[Any]
    """Corners of the design [m], shape (2, 3)."""
    blend: NDArray[Any]
    """Distances [m] from ``box`` between which near sources give way to far ones, shape (2,)."""
    room: NDArray[Any]
    """Corners of the part of the domain where bodies count [m], shape (2, 3)."""
    cover: float
    """Thickness of what covers the electrodes of a flat design [m]; infinite for other designs."""


class Cut(NamedTuple):
    """The clusters that a scene needs, parts behind wholes, body after body."""

    body: NDArray[Any]
    """Body of a cluster, shape (k,)."""
    node: NDArray[Any]
    """Its place in the body's tree, shape (k,)."""
    kids: NDArray[Any]
    """Its parts in this list, -1 for a leaf, shape (k, 2)."""
    share: NDArray[Any]
    """Share of the first part in its charge, shape (k,)."""
    leaf: NDArray[Any]
    """Its number among the leaves, else -1, shape (k,)."""
    fade: NDArray[Any]
    """How far its function is faded in, 0 to 1, shape (k,)."""
    above: NDArray[Any]
    """The same of the cluster above, 1 at the top, shape (k,)."""
    leaves: NDArray[Any]
    """The leaves in this list, shape (l,)."""


@fast
def smooth(x):
    """Smoothstep: 0 up to 0, 1 from 1 on."""
    x = min(1.0, max(0.0, x))
    return x * x * (3.0 - 2.0 * x)


@fast
def score(bodies, first, green, enough, weight, scores):
    """Share of the electrodes' energies that each charge function takes up alone.

    Writes the weights 1/energy of the terminals, and into ``scores`` the score of every cluster,
    raised by those of its parts; ``first`` (b + 1,) has each body's first cluster. A score of
    ``enough`` has a cluster split for certain, as those that cross a wall must be. Clusters that
    are small against their distance from the design are not looked into: φ⁰ is linear there, and
    the scores of their parts follow from their own.
    """
    terminals, lead, total = green.terminals, green.lead, first[-1]
    means, energy = np.empty((total, lead), np.float32), np.zeros(terminals)
    met, crossing = np.zeros(total, np.bool_), np.zeros(total)
    for b in range(bodies.shape[0]):
        body, o = bodies[b], first[b]
        kids, function = integers(body.kids), integers(body.function)
        charge, own = doubles(body.charge), doubles(body.own)
        span = slice(o, first[b + 1])
        _mean_potentials(body, green, means[span], met[span], crossing[span])
        for k in range(2 * body.n - 2, -1, -1):
            x, y = kids[2 * k], kids[2 * k + 1]
            if x >= 0 and met[o + x]:
                p = np.float32(charge[x] / charge[k])
                stiffness = body.scale / own[function[k]]
                for i in range(lead):
                    means[o + k, i] = p * means[o + x, i] + (np.float32(1.0) - p) * means[o + y, i]
                for i in range(terminals):
                    d = float(means[o + x, i] - means[o + y, i])
                    energy[i] += d * d * stiffness
        if not body.neutral:
            for i in range(terminals):
                energy[i] += float(means[o, i]) ** 2 / (own[0] / body.scale + body.tie)
    whole = 0.0
    for i in range(terminals):
        whole += energy[i] ** 2
    for i in range(terminals):
        weight[i] = 1.0 / (energy[i] + 0.01 * math.sqrt(whole) + 1e-300)
    for b in range(bodies.shape[0]):
        span = slice(first[b], first[b + 1])
        scores[span] = enough * crossing[span]
        _raise_scores(bodies[b], means[span], met[span], weight, scores[span])


@fast
def _mean_potentials(body, green, means, met, crossing):
    """φ⁰ in the middle of clusters that are not looked into, from the far sources.

    ``crossing`` is filled with how much each cluster crosses a wall, 0 to 1.
    """
    kids, center, extent = integers(body.kids), doubles(body.center), doubles(body.extent)
    places, points = np.empty(body.n, np.int64), np.empty((body.n + 3, 3), np.float32)
    inner = np.empty(body.n)
    found = 0
    met[0] = True
    for k in range(2 * body.n - 1):
        if not met[k]:
            continue
        square = out = 0.0
        room = 1.0
        for i in range(3):
            x = body.position[i] + body.scale * (
                body.rotation[i, 0] * center[3 * k]
                + body.rotation[i, 1] * center[3 * k + 1]
                + body.rotation[i, 2] * center[3 * k + 2]
            )
            points[found, i] = x
            off = max(green.box[0, i] - x, x - green.box[1, i], 0.0)
            square += off * off
            room = min(room, x - green.room[0, i], green.room[1, i] - x)
            out += max(green.room[0, i] - x, x - green.room[1, i], 0.0) ** 2
        size = body.scale * extent[k]
        crossing[k] = smooth(2.0 - 4.0 * abs(room) / (size + 1e-9)) * smooth(
            (size - _LONG[0]) / (_LONG[1] - _LONG[0])
        )
        small = k >= _COARSE and size * size < _LINEAR * _LINEAR * square
        if square < _NEAR_FACE * _NEAR_FACE and green.cover < 1.0:
            _lift(points[found : found + 1], _gap(size, green.cover), green.box)
        if small or kids[2 * k] < 0:
            places[found], inner[found] = k, 1.0 - smooth(math.sqrt(out) / _SHORE)
            found += 1
        else:
            met[kids[2 * k]] = met[kids[2 * k + 1]] = True
    rounded = 4 * ((found + 3) // 4)
    for j in range(found, rounded):
        for i in range(3):
            points[j, i] = points[0, i]
    values = np.empty((rounded, green.far.shape[1]), np.float32)
    point_potentials(
        points[:rounded], green.far, np.float32(green.floor), np.float32(_FAR_LEAST), values
    )
    phi = np.empty((rounded, green.lead), np.float32)
    multiply_lanes(values, green.score_table, phi)
    for j in range(found):
        for i in range(green.lead):
            means[places[j], i] = inner[j] * phi[j, i]


@fast
def _raise_scores(body, mean, met, weight, scores):
    kids, function, own = integers(body.kids), integers(body.function), doubles(body.own)
    count = 2 * body.n - 1
    for k in range(count - 1, -1, -1):
        a = kids[2 * k]
        if a >= 0 and met[a]:
            value = 0.0
            for i in range(weight.shape[0]):
                d = float(mean[a, i] - mean[kids[2 * k + 1], i])
                value += weight[i] * d * d
            value *= body.scale / own[function[k]]
            for c in range(2):
                below = scores[kids[2 * k + c]]
                value = max(value, below) + 0.5 * min(value, below)
            scores[k] = max(scores[k], value)
    for k in range(count):
        a = kids[2 * k]
        if a >= 0:
            for c in range(2):
                part = kids[2 * k + c]
                if kids[2 * part] >= 0 and not met[kids[2 * part]]:
                    scores[part] = _DECAY * scores[k]


@fast
def choose(bodies, first, scores, threshold, width):
    """Return the clusters whose score is above a threshold, and those directly below them.

    A function fades in while its score grows from ``threshold`` to ``width`` times that.
    """
    total = first[-1]
    state, place = np.empty(total, np.int64), np.empty(total, np.int64)
    fades, above = np.zeros(total), np.zeros(total)
    for k in range(total):
        state[k] = place[k] = -1
    count = leaves = 0
    for b in range(bodies.shape[0]):
        kids = integers(bodies[b].kids)
        o = first[b]
        state[o], above[o] = FRONTIER, 1.0
        for k in range(2 * bodies[b].n - 1):
            if state[o + k] < 0:
                continue
            place[o + k] = count
            count += 1
            if state[o + k] == LEAF or kids[2 * k + 0] < 0:
                state[o + k] = LEAF
                leaves += 1
                continue
            x = math.log(max(scores[o + k], 1e-300) / threshold) / math.log(width)
            fades[o + k] = min(smooth(x), above[o + k])
            state[o + k] = USED if fades[o + k] > 0.0 else FRONTIER
            for c in range(2):
                state[o + kids[2 * k + c]] = LEAF if state[o + k] == FRONTIER else FRONTIER
                above[o + kids[2 * k + c]] = fades[o + k]
    return _collect(bodies, first, state, place, fades, above, count, leaves)


@fast
def _collect(bodies, first, state, place, fades, above, count, leaves):
    cut = Cut(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, 2), np.int64),
        np.zeros(count), np.empty(count, np.int64), np.empty(count), np.empty(count),
        np.empty(leaves, np.int64),
    )  # fmt: skip
    leaf = 0
    for b in range(bodies.shape[0]):
        nodes = 2 * bodies[b].n - 1
        kids = integers(bodies[b].kids)
        charge = doubles(bodies[b].charge)
        o = first[b]
        for k in range(nodes):
            a = place[o + k]
            if a < 0:
                continue
            cut.body[a], cut.node[a] = b, k
            cut.fade[a], cut.above[a] = fades[o + k], above[o + k]
            cut.leaf[a] = cut.kids[a, 0] = cut.kids[a, 1] = -1
            if state[o + k] == LEAF:
                cut.leaf[a], cut.leaves[leaf] = leaf, a
                leaf += 1
            else:
                cut.kids[a, 0], cut.kids[a, 1] = (
                    place[o + kids[2 * k + 0]],
                    place[o + kids[2 * k + 1]],
                )
                cut.share[a] = charge[kids[2 * k + 0]] / charge[k]
    return cut


@fast
def leaf_points(bodies, cut, green):
    """Where the leaves are in the sensor frame.

    Returns:
        Four points of each [m], shape (l, 4, 3); the same before they were lifted off the design;
        its extent [m], shape (l,); how far it is out of reach, 0 to 1 (see :func:`beyond`), (l,).
    """
    n = cut.leaves.shape[0]
    points, extent, corners = np.empty((n, 4, 3)), np.empty(n), np.empty((4, 3))
    true, out = np.empty((n, 4, 3)), np.empty(n)
    moments, turn, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for j in range(n):
        a = cut.leaves[j]
        body = bodies[cut.body[a]]
        k = cut.node[a]
        if body.spread != 0:
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
            _lift(points[j], _gap(extent[j], green.cover), green.box)
    return points, true, extent, out


@fast
def beyond(points, green):
    """How far a leaf is out of reach: 0 in the room, 1 beyond the walls or far behind the face."""
    out, depth = 0.0, 1.0
    for i in range(3):
        c = 0.5 * (points[0, i] + points[3, i])
        off = max(green.room[0, i] - c, c - green.room[1, i], 0.0)
        out += off * off
        if i < 2:
            depth = min(depth, _STEEP * (c - green.box[0, i]), _STEEP * (green.box[1, i] - c))
        else:
            depth = min(depth, green.box[1, 2] - c)
    deep = depth - _DEEP if green.cover < 1.0 else 0.0
    return smooth(max(math.sqrt(out), deep) / _SHORE)


@fast
def _gap(extent, cover):
    """Least gap [m] between a cluster and a flat design, see :data:`_GAP`."""
    return max(_GAP[3], min(_GAP[1], max(_GAP[0], extent * extent / _GAP[2])) - cover)


@fast
def _lift(points, gap, box):
    """Keep points (k, 3) off a flat design: a distance d < 2 gap becomes gap + d² / (4 gap).

    The space between the design and the floor counts as within it.
    """
    for q in range(points.shape[0]):
        square, depth, axis, side = 0.0, 1.0, 2, 1
        for i in range(3):
            for k in range(2):
                if i == 2 and k == 0:
                    continue
                off = points[q, i] - box[1, i] if k == 1 else box[0, i] - points[q, i]
                square += max(off, 0.0) ** 2
                if -off < depth:
                    depth, axis, side = -off, i, k
        way = math.sqrt(square)
        if way >= 2.0 * gap:
            continue
        if way == 0.0:
            points[q, axis] = box[1, axis] + gap if side == 1 else box[0, axis] - gap
            continue
        ratio = (gap + way * way / (4.0 * gap)) / way
        for i in range(3):
            edge = min(points[q, i], box[1, i])
            if i < 2:
                edge = max(edge, box[0, i])
            points[q, i] = edge + ratio * (points[q, i] - edge)


@fast
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


@fast
def distances(points, green):
    """Distance [m] of each leaf's centre from the design's box, shape (l,)."""
    out = np.empty(points.shape[0])
    for j in range(points.shape[0]):
        d = 0.0
        for i in range(3):
            c = 0.5 * (points[j, 0, i] + points[j, 3, i])
            off = max(green.box[0, i] - c, c - green.box[1, i], 0.0)
            d += off * off
        out[j] = math.sqrt(d)
    return out


@fast
def _share(distance, blend):
    """One below the first distance of a blend, zero above the second, smooth in between."""
    return smooth((blend[1] - distance) / (blend[1] - blend[0]))


@fast
def leaf_rows(points, out_of_reach, green):
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
            part = _share(distance[j], green.blend)
            part = (1.0 - part if far == 1 else part) * (1.0 - out_of_reach[j])
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
                _FAR_LEAST,
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
                _NEAR_LEAST,
                out,
            )
    return out


@fast
def _add_rows(points, chosen, share, sources, table, floor, least, out):
    values = np.empty((points.shape[0], sources.shape[1]), np.float32)
    source_potentials(points, sources, np.float32(floor), np.float32(least), values)
    rows = np.empty((points.shape[0], table.shape[1]), np.float32)
    multiply(values, table, rows)
    for c in range(points.shape[0]):
        part, line, to = np.float32(share[c]), rows[c], out[chosen[c]]
        for i in range(table.shape[1]):
            to[i] += part * line[i]


@fast
def climb(cut, values):
    """Fill the means (k, m) of all clusters of a cut from those of its leaves."""
    for a in range(cut.node.shape[0] - 1, -1, -1):
        if cut.kids[a, 0] >= 0:
            p = np.float32(cut.share[a])
            q = np.float32(1.0) - p
            x, y = values[cut.kids[a, 0]], values[cut.kids[a, 1]]
            row = values[a]
            for i in range(values.shape[1]):
                row[i] = p * x[i] + q * y[i]
