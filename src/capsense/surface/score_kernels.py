"""The step, compiled: what each charge function of a scene is worth."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled
from capsense._simd import SIMD_WIDTH, doubles, integers
from capsense.field.green_kernels import (
    NEAR_FACE,
    SHORE,
    least_gap,
    lift,
    point_potentials,
    smooth,
)

_LINEAR = 0.45, 0.58
"""Clusters smaller than the first part of their distance from the design see a linear potential,
those larger than the second do not; in between they come to do."""
_COARSE = 31
"""So many clusters, the coarsest of a body, are looked into wherever they are."""
DECAY = 0.35
"""Score of a part over that of the whole, 2 ** -1.5, in a linear potential."""
INHERITED = -1.0
"""Score of what has :data:`DECAY` times that of the cluster above."""
POWER = 3.0
_LONG = 0.03, 0.06
"""Clusters that cross a wall come to be looked into where they are longer than this [m]."""
_CROSSED = 0.3
"""Least score of large clusters that cross a wall: so much that functions are fully faded in. Their
points lie among the sources that stand for the wall, 40 mm behind it, and would attract themselves
so much that no definite matrix were left."""
_SEEN = 0.1
"""Part of a cluster that does not see a linear potential from which on what crosses a wall within
it counts in full."""
_SCREENED, _TOUCHING = 2.0 * math.pi, 0.8e-3
"""A grounded plane at a distance d leaves charges of wavelength 2 l, as the function of a cluster
of size l has, 1 - exp(-2π d / l) of their energy; and what is added to d [m]."""
_FREE = 0.1
"""Panels are not looked into where the design takes so much or less of the square of that energy,
and more and more as it takes more."""
_WIDE = 0.08, 0.12
"""Clusters come to be large between these extents [m]."""


class Looks(NamedTuple):
    """What was found out of the clusters of a body that were looked at; shapes (n,)."""

    met: NDArray[Any]
    """Which these are."""
    means: NDArray[Any]
    """Mean of φ⁰ [V], shape (n, lead)."""
    linear: NDArray[Any]
    """How linear φ⁰ is there, 0 to 1."""
    told: NDArray[Any]
    """How much it is not in all clusters above."""
    crossing: NDArray[Any]
    """How much it crosses a wall."""
    stiff: NDArray[Any]
    """Energy of its charge function in front of a grounded design, over that in free space."""


@compiled
def _looks(looks, start, stop):
    """Those of some clusters."""
    return Looks(
        looks.met[start:stop], looks.means[start:stop], looks.linear[start:stop],
        looks.told[start:stop], looks.crossing[start:stop], looks.stiff[start:stop],
    )  # fmt: skip


@compiled
def score(bodies, first, green, threshold, weight, scores, entry):
    """Share of the electrodes' energies that each charge function takes up alone.

    Writes the weights 1/energy of the terminals, and into ``scores`` the score of every cluster,
    raised by those of its parts; ``first`` (b + 1,) has each body's first cluster. Clusters that
    are small against their distance from the design, and cross no wall, are not looked into: φ⁰ is
    linear there. Where nothing was looked at the score is :data:`INHERITED`.

    Panels are looked into where functions above them count: see :func:`_score_parts`.

    Returns:
        How many of a body's first clusters hold all that were looked at but parts of panels, shape
        (b,); scores of others, which are inherited too, are not written.
    """
    terminals, total = green.terminals, first[-1]
    all_looks = Looks(
        np.zeros(total, np.bool_), np.empty((total, green.lead), np.float32), np.empty(total),
        np.empty(total), np.empty(total), np.empty(total),
    )  # fmt: skip
    energy, seen = np.zeros(terminals), np.empty(bodies.shape[0], np.int64)
    for b in range(bodies.shape[0]):
        body, looks = bodies[b], _looks(all_looks, first[b], first[b + 1])
        kids, means = integers(body.kids), looks.means
        seen[b] = _look(body, green, looks)
        for k in range(seen[b] - 1, -1, -1):
            x, y = kids[2 * k], kids[2 * k + 1]
            if looks.met[k] and 0 <= x < seen[b] and looks.met[x]:
                stiffness = (
                    looks.told[k]
                    * (1.0 - looks.linear[k])
                    / _energy(body, looks, k)
                    * looks.stiff[k]
                )
                for i in range(terminals):
                    d = float(means[x, i] - means[y, i])
                    energy[i] += d * d * stiffness
        if not body.neutral:
            for i in range(terminals):
                energy[i] += float(means[0, i]) ** 2 / _net_energy(body)
    whole = 0.0
    for i in range(terminals):
        whole += energy[i] ** 2
    for i in range(terminals):
        weight[i] = 1.0 / (energy[i] + 0.01 * math.sqrt(whole) + 1e-300)
    for b in range(bodies.shape[0]):
        looks = _looks(all_looks, first[b], first[b + 1])
        of, enter = scores[first[b] : first[b + 1]], entry[first[b] : first[b + 1]]
        _score_panels(bodies[b], green, seen[b], looks, weight, of)
        _raise_scores(bodies[b], _looks(looks, 0, seen[b]), weight, of[: seen[b]])
        _score_parts(bodies[b], green, seen[b], looks, (threshold, weight), of, enter)
    return seen


@compiled
def _energy(body, looks, k):
    """Energy of the function of a cluster [1/m]."""
    own = doubles(body.own)[integers(body.function)[k]]
    return looks.stiff[k] * own / body.scale


@compiled
def _net_energy(body):
    """Energy of a body's net charge [1/m]."""
    return doubles(body.own)[0] / body.scale + body.tie


@compiled
def _placed(body, green, k, points, found, looks):
    """Place the middle of cluster k in row ``found`` of ``points`` (n, 3).

    Returns:
        Square of its distance from the design [m²], how far it is from the next wall, negative
        beyond it, and how far it is beyond all of them [m].
    """
    center, size = doubles(body.center), body.scale * doubles(body.extent)[k]
    square = out = 0.0
    room = 1.0
    for i in range(3):
        x = body.position[i]
        for q in range(3):
            x += body.scale * body.rotation[i, q] * center[3 * k + q]
        points[found, i] = x
        off = max(green.box[0, i] - x, x - green.box[1, i], 0.0)
        square += off * off
        room = min(room, x - green.room[0, i], green.room[1, i] - x)
        out += max(green.room[0, i] - x, x - green.room[1, i], 0.0) ** 2
    looks.stiff[k] = 1.0 - math.exp(-_SCREENED * math.sqrt(square + _TOUCHING * _TOUCHING) / size)
    if square < NEAR_FACE * NEAR_FACE and green.cover < 1.0:
        lift(points[found : found + 1], least_gap(size, green.cover), green.box)
    return square, room, math.sqrt(out)


@compiled
def _look(body, green, looks):
    """Look at a body's clusters, and into those that do not see a linear potential.

    φ⁰ is that in their middle, from the far sources, or is made up from their parts. Panels are not
    looked into.

    Args:
        body: The body.
        green: Green's function of the design.
        looks: Filled.

    Returns:
        The cluster behind the last one that was looked at.
    """
    kids, extent, stop = integers(body.kids), doubles(body.extent), body.stored
    places, inner = np.empty(stop, np.int64), np.empty(stop)
    points, found = np.empty((stop, 3), np.float32), 0
    looks.met[0], looks.told[0], k, seen = True, 1.0, -1, 1
    while k + 1 < seen:
        k += 1
        if not looks.met[k]:
            continue
        square, room, out = _placed(body, green, k, points, found, looks)
        size, share = body.scale * extent[k], 1.0 - smooth(out / SHORE)
        looks.crossing[k] = smooth(2.0 - 4.0 * abs(room) / (size + 1e-9)) * smooth(
            (size - _LONG[0]) / (_LONG[1] - _LONG[0])
        )
        looks.linear[k] = 0.0
        if k >= _COARSE:
            part = size / math.sqrt(square + 1e-12)
            even = smooth((_LINEAR[1] - part) / (_LINEAR[1] - _LINEAR[0]))
            looks.linear[k] = (1.0 - share * (1.0 - even)) * (1.0 - looks.crossing[k])
        for i in range(green.lead):
            looks.means[k, i] = 0.0
        whole = not 0 <= kids[2 * k] < stop
        if share > 0.0 and (looks.linear[k] > 0.0 or whole):
            places[found], inner[found] = k, share
            found += 1
        if looks.linear[k] < 1.0 and not whole:
            for c in range(2):
                part = kids[2 * k + c]
                looks.met[part], looks.told[part] = True, looks.told[k] * (1.0 - looks.linear[k])
            seen = max(seen, kids[2 * k + 1] + 1)
    _far_potentials(points[:found], places, inner, green, looks.means)
    _make_up(body, seen, looks)
    return seen


@compiled
def _far_potentials(points, places, share, green, means):
    """Fill rows ``places`` of ``means`` with φ⁰ at points (k, 3), times a share of each."""
    found = points.shape[0]
    if found == 0:
        return
    columns = np.empty((3, SIMD_WIDTH * ((found + SIMD_WIDTH - 1) // SIMD_WIDTH)), np.float32)
    for j in range(columns.shape[1]):
        for i in range(3):
            columns[i, j] = points[min(j, found - 1), i]
    phi = np.empty((green.lead, columns.shape[1]), np.float32)
    far = green.levels[-1]
    limits = np.float32(green.floor), np.float32(far.least)
    point_potentials(columns, far.sources, green.score_table, limits, phi)
    for j in range(found):
        for i in range(green.lead):
            means[places[j], i] = share[j] * phi[i, j]


@compiled
def _make_up(body, seen, looks):
    """Mean potentials of clusters from those of their parts, where they do not see a linear one."""
    kids, charge, one = integers(body.kids), doubles(body.charge), np.float32(1.0)
    means = looks.means
    for k in range(seen - 1, -1, -1):
        if not looks.met[k]:
            continue
        x, y = kids[2 * k], kids[2 * k + 1]
        if 0 <= x < seen and looks.met[x]:
            p, t = np.float32(charge[x] / charge[k]), np.float32(looks.linear[k])
            q, r = (one - t) * p, (one - t) * (one - p)
            for i in range(means.shape[1]):
                whole = t * means[k, i] if t > 0.0 else np.float32(0.0)
                means[k, i] = whole + q * means[x, i] + r * means[y, i]


@compiled
def _own_score(body, looks, k, weight):
    """Score of the function of a cluster, from the potentials of its two parts."""
    x, value = integers(body.kids)[2 * k], 0.0
    for i in range(weight.shape[0]):
        d = float(looks.means[x, i] - looks.means[x + 1, i])
        value += weight[i] * d * d
    return value / (_energy(body, looks, k) * looks.stiff[k])


@compiled
def _raised(value, first, second):
    """A score, raised by those of the two parts."""
    for below in (first, second):
        value = max(value, below) + 0.5 * min(value, below)
    return value


@compiled
def _pass_on(part, above, looks, scores):
    """Let a cluster have a part of the score above it as far as that sees a linear potential."""
    rest = 1.0 - looks.told[part] * (1.0 - looks.linear[part])
    scores[part] = looks.told[part] * scores[part] + rest * DECAY * above


@compiled
def _share(looks, k):
    """What the score of a panel or a part counts."""
    return max(0.0, 1.0 - looks.stiff[k] * looks.stiff[k] - _FREE) / (1.0 - _FREE)


@compiled
def _score_panels(body, green, seen, looks, weight, scores):
    """Score panels that were met and have parts, if near; others have no score of their own."""
    kids, nodes, count = integers(body.kids), np.empty(seen, np.int64), 0
    for k in range(seen):
        scores[k] = 0.0
        if looks.met[k] and kids[2 * k] >= body.stored and _share(looks, k) > 0.0:
            nodes[count] = k
            count += 1
    _score_nodes(body, green, nodes[:count], looks, weight, scores)
    _raise_nodes(body, green, nodes[:count], looks, weight, scores)


@compiled
def _raise_scores(body, looks, weight, scores):
    """Score a body's first clusters from the mean potentials of those that were met.

    What was met below a cluster that sees a linear potential does not count.

    No charge is beyond a wall. A part that crosses one can carry charge where it is inside only if
    it is split too, which its own score does not tell. So that is at least the score of the body,
    times the part's share of its length.
    """
    kids, extent, count = integers(body.kids), doubles(body.extent), scores.shape[0]
    met, crossing = looks.met, looks.crossing
    for k in range(count - 1, -1, -1):
        if not met[k]:
            scores[k] = INHERITED
            continue
        a = kids[2 * k]
        if 0 <= a < count and met[a]:
            own = _own_score(body, looks, k, weight)
            scores[k] = (1.0 - looks.linear[k]) * _raised(own, scores[a], scores[a + 1])
    if not body.neutral:
        net = 0.0
        for i in range(weight.shape[0]):
            net += weight[i] * float(looks.means[0, i]) ** 2
        scores[0] = max(scores[0], crossing[0] * net / _net_energy(body))
    seen = np.ones(count)
    for k in range(count):
        if not met[k]:
            continue
        for c in range(2):
            part = kids[2 * k + c]
            if 0 <= part < count and met[part] and 0 <= kids[2 * part] < body.stored:
                _pass_on(part, scores[k], looks, scores)
                seen[part] = seen[k] * smooth((1.0 - looks.linear[k]) / _SEEN)
    whole = scores[0]
    for k in range(count - 1, -1, -1):
        if not met[k]:
            continue
        wide = smooth((body.scale * extent[k] - _WIDE[0]) / (_WIDE[1] - _WIDE[0]))
        least = max(_CROSSED * wide, whole * extent[k] / extent[0])
        scores[k] = max(scores[k], seen[k] * crossing[k] * least)
        if 0 <= kids[2 * k] < count:
            scores[k] = max(scores[k], scores[kids[2 * k]], scores[kids[2 * k + 1]])


@compiled
def _score_parts(body, green, seen, looks, limits, scores, entry):
    """Score the parts of panels where the cluster above the panel needs them.

    Scores of panels and parts are raised by those directly below them alone, so that parts are
    looked at only where the whole is split.

    Args:
        body: The body.
        green: Green's function of the design.
        seen: How many of its first clusters hold all that were looked at.
        looks: What was found of these; extended.
        limits: The threshold, and the weights of the terminals.
        scores: Of all its clusters; those of parts are filled, those of their panels raised.
        entry: Filled for panels: score from which on they have parts.
    """
    kids, stored, (threshold, weight) = integers(body.kids), body.stored, limits
    if stored == 2 * body.n - 1:
        return
    nodes, count = np.empty(seen, np.int64), 0
    for k in range(seen):
        if not looks.met[k] or not 0 <= kids[2 * k] < seen:
            continue
        for c in range(2):
            panel = kids[2 * k + c]
            if looks.met[panel] and kids[2 * panel] >= stored:
                entry[panel] = _share(looks, panel) * scores[k]
                if entry[panel] > threshold:
                    nodes[count] = panel
                    count += 1
    while count > 0:
        below, many = np.empty(2 * count, np.int64), 0
        for k in nodes[:count]:
            for c in range(2):
                part = kids[2 * k] + c
                if scores[k] > threshold and kids[2 * part] >= 0:
                    below[many] = part
                    many += 1
        _raise_nodes(body, green, below[:many], looks, weight, scores)
        nodes, count = below, many


@compiled
def _raise_nodes(body, green, nodes, looks, weight, scores):
    """Raise the scores of panels or parts, which are known, by those of their parts."""
    kids, below, count = integers(body.kids), np.empty(2 * nodes.shape[0], np.int64), 0
    for k in nodes:
        for c in range(2):
            part = kids[2 * k] + c
            scores[part] = 0.0
            if kids[2 * part] >= 0:
                below[count] = part
                count += 1
    _score_nodes(body, green, below[:count], looks, weight, scores)
    for k in nodes:
        a = kids[2 * k]
        scores[k] = _raised(scores[k], scores[a], scores[a + 1])


@compiled
def _score_nodes(body, green, nodes, looks, weight, scores):
    """Score panels and parts by themselves, whatever the potential is like.

    Where a cluster is far from the design, charge within its panels does nothing: scores count in
    as much as the design leaves these less energy than they have in free space.
    """
    kids, many = integers(body.kids), 2 * nodes.shape[0]
    points, places, inner = np.empty((many, 3), np.float32), np.empty(many, np.int64), np.ones(many)
    for j in range(many):
        places[j] = kids[2 * nodes[j // 2]] + j % 2
        out = _placed(body, green, places[j], points, j, looks)[2]
        inner[j] = 1.0 - smooth(out / SHORE)
    _far_potentials(points, places, inner, green, looks.means)
    for k in nodes:
        scores[k] = _share(looks, k) * _own_score(body, looks, k, weight)
