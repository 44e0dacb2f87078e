"""The step, compiled: what each charge function of a scene is worth."""

from __future__ import annotations

import math

import numpy as np

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
PARTS = 1.0
"""What the scores of parts of panels count, over those of whole ones: the means that their energies
are taken from cost more time."""
_LONG = 0.03, 0.06
"""Clusters that cross a wall come to be looked into where they are longer than this [m]."""
_CROSSED = 0.3
"""Least score of large clusters that cross a wall: so much that functions are fully faded in. Their
points lie among the sources that stand for the wall, 40 mm behind it, and would attract themselves
so much that no definite matrix were left."""
_SEEN = 0.1
"""Part of a cluster that does not see a linear potential from which on what crosses a wall within
it counts in full."""
_WIDE = 0.08, 0.12
"""Clusters come to be large between these extents [m]."""


@compiled
def score(bodies, first, green, threshold, weight, scores):
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
    terminals, lead, total = green.terminals, green.lead, first[-1]
    means, energy = np.empty((total, lead), np.float32), np.zeros(terminals)
    met, crossing, linear = np.zeros(total, np.bool_), np.empty(total), np.empty(total)
    told = np.empty(total)
    seen = np.empty(bodies.shape[0], np.int64)
    for b in range(bodies.shape[0]):
        body, o = bodies[b], first[b]
        kids, function, own = integers(body.kids), integers(body.function), doubles(body.own)
        span = slice(o, first[b + 1])
        met[o], told[o] = True, 1.0
        seen[b] = _mean_potentials(
            body, green, (0, 1, body.stored),
            means[span], met[span], crossing[span], linear[span], told[span],
        )  # fmt: skip
        _make_up(body, (0, seen[b]), means[span], met[span], linear[span])
        for k in range(seen[b] - 1, -1, -1):
            x, y = kids[2 * k], kids[2 * k + 1]
            if met[o + k] and x >= 0 and met[o + x]:
                stiffness = told[o + k] * (1.0 - linear[o + k]) * body.scale / own[function[k]]
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
        span = slice(first[b], first[b] + seen[b])
        _raise_scores(
            bodies[b],
            means[span],
            met[span],
            (linear[span], told[span]),
            crossing[span],
            weight,
            scores[span],
        )
        span = slice(first[b], first[b + 1])
        _score_parts(
            bodies[b], green, seen[b], means[span], met[span],
            (linear[span], told[span], crossing[span]), (threshold, weight), scores[span],
        )  # fmt: skip
    return seen


@compiled
def _mean_potentials(body, green, span, means, met, crossing, linear, told):
    """φ⁰ in the middle of clusters that see it as linear or have no parts, from the far sources.

    Args:
        body: The body.
        green: Green's function of the design.
        span: First cluster, the one behind the last that was ``met`` before, and the one behind all
            that are.
        means: Filled [V], shape (n, lead).
        met: Which clusters are looked at, shape (n,); extended.
        crossing: Filled with how much each cluster crosses a wall, 0 to 1.
        linear: Filled with how linear φ⁰ is there.
        told: Filled with how much it is not in all clusters above.

    Returns:
        The cluster behind the last one that was looked at.
    """
    kids, center, extent = integers(body.kids), doubles(body.center), doubles(body.extent)
    start, seen, stop = span
    places, inner = np.empty(stop - start, np.int64), np.empty(stop - start)
    points, found = np.empty((stop - start, 3), np.float32), 0
    k = start - 1
    while k + 1 < seen:
        k += 1
        if not met[k]:
            continue
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
        size, share, linear[k] = body.scale * extent[k], 1.0 - smooth(math.sqrt(out) / SHORE), 0.0
        crossing[k] = smooth(2.0 - 4.0 * abs(room) / (size + 1e-9)) * smooth(
            (size - _LONG[0]) / (_LONG[1] - _LONG[0])
        )
        if k >= _COARSE:
            part = size / math.sqrt(square + 1e-12)
            even = smooth((_LINEAR[1] - part) / (_LINEAR[1] - _LINEAR[0]))
            linear[k] = (1.0 - share * (1.0 - even)) * (1.0 - crossing[k])
        if square < NEAR_FACE * NEAR_FACE and green.cover < 1.0:
            lift(points[found : found + 1], least_gap(size, green.cover), green.box)
        for i in range(green.lead):
            means[k, i] = 0.0
        whole = not 0 <= kids[2 * k] < stop
        if share > 0.0 and (linear[k] > 0.0 or whole):
            places[found], inner[found] = k, share
            found += 1
        if linear[k] < 1.0 and not whole:
            for c in range(2):
                met[kids[2 * k + c]], told[kids[2 * k + c]] = True, told[k] * (1.0 - linear[k])
            seen = max(seen, kids[2 * k + 1] + 1)
    if found == 0:
        return seen
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
            means[places[j], i] = inner[j] * phi[i, j]
    return seen


@compiled
def _make_up(body, span, means, met, linear):
    """Mean potentials of clusters from those of their parts, where they do not see a linear one."""
    kids, charge, one = integers(body.kids), doubles(body.charge), np.float32(1.0)
    for k in range(span[1] - 1, span[0] - 1, -1):
        if not met[k]:
            continue
        x, y = kids[2 * k], kids[2 * k + 1]
        if x >= 0 and met[x]:
            p, t = np.float32(charge[x] / charge[k]), np.float32(linear[k])
            q, r = (one - t) * p, (one - t) * (one - p)
            for i in range(means.shape[1]):
                whole = t * means[k, i] if t > 0.0 else np.float32(0.0)
                means[k, i] = whole + q * means[x, i] + r * means[y, i]


@compiled
def _score_parts(body, green, seen, means, met, looks, limits, scores):
    """Score panels that have parts, and these, where the cluster above the panel needs them.

    Args:
        body: The body.
        green: Green's function of the design.
        seen: How many of its first clusters hold all that were looked at.
        means, met: Of :func:`_mean_potentials`, of all clusters.
        looks: ``linear``, ``told`` and ``crossing``, as there.
        limits: The threshold, and the weights of the terminals.
        scores: Filled.
    """
    kids, function, own = integers(body.kids), integers(body.function), doubles(body.own)
    (linear, told, crossing), (threshold, weight) = looks, limits
    stored, clusters = body.stored, 2 * body.n - 1
    if stored == clusters:
        return
    panels, above = np.empty((2, stored), np.int64)
    last, count = stored, 0
    for k in range(seen):
        if not met[k] or not 0 <= kids[2 * k] < seen or PARTS * scores[k] <= threshold:
            continue
        for c in range(2):
            panel = kids[2 * k + c]
            part = kids[2 * panel]
            if not met[panel] or part < stored:
                continue
            panels[count], above[count] = panel, k
            count += 1
            for d in range(2):
                met[part + d], told[part + d] = True, told[panel] * (1.0 - linear[panel])
            last = max(last, part + 2)
    if count == 0:
        return
    last = _mean_potentials(
        body, green, (stored, last, clusters), means, met, crossing, linear, told
    )
    _make_up(body, (stored, last), means, met, linear)
    for j in range(last - stored + count):  # parts first
        k = last - 1 - j if j < last - stored else panels[j - last + stored]
        if not met[k]:
            continue
        a, scores[k] = kids[2 * k], 0.0
        if a >= 0 and met[a]:
            value = 0.0
            for i in range(weight.shape[0]):
                d = float(means[a, i] - means[a + 1, i])
                value += weight[i] * d * d
            value *= PARTS * body.scale / own[function[k]]
            for c in range(2):
                value = max(value, scores[a + c]) + 0.5 * min(value, scores[a + c])
            scores[k] = (1.0 - linear[k]) * value
        elif a >= 0:
            scores[a] = scores[a + 1] = INHERITED
    for j in range(count + last - stored):  # wholes first
        k = panels[j] if j < count else j - count + stored
        if not met[k]:
            continue
        if j < count:
            _pass_on(k, PARTS * scores[above[j]], linear, told, scores)
        a = kids[2 * k]
        for c in range(2):
            if a >= 0 and met[a] and kids[2 * (a + c)] >= 0:
                _pass_on(a + c, scores[k], linear, told, scores)


@compiled
def _pass_on(part, above, linear, told, scores):
    """Let a cluster have a part of the score above it as far as that sees a linear potential."""
    rest = 1.0 - told[part] * (1.0 - linear[part])
    scores[part] = told[part] * scores[part] + rest * DECAY * above


@compiled
def _raise_scores(body, mean, met, evenness, crossing, weight, scores):
    """Score a body's first clusters from the mean potentials of those that were met.

    What was met below a cluster that sees a linear potential does not count: ``evenness`` holds
    ``linear`` and ``told`` of :func:`_mean_potentials`.

    No charge is beyond a wall. A part that crosses one can carry charge where it is inside only if
    it is split too, which its own score does not tell. So that is at least the score of the body,
    times the part's share of its length.
    """
    kids, function, own = integers(body.kids), integers(body.function), doubles(body.own)
    extent, count = doubles(body.extent), met.shape[0]
    linear, told = evenness
    for k in range(count - 1, -1, -1):
        if not met[k]:
            scores[k] = INHERITED
            continue
        a, scores[k] = kids[2 * k], 0.0
        if 0 <= a < count and met[a]:
            value = 0.0
            for i in range(weight.shape[0]):
                d = float(mean[a, i] - mean[kids[2 * k + 1], i])
                value += weight[i] * d * d
            value *= body.scale / own[function[k]]
            for c in range(2):
                below = scores[kids[2 * k + c]]
                value = max(value, below) + 0.5 * min(value, below)
            scores[k] = (1.0 - linear[k]) * value
    if not body.neutral:
        net = 0.0
        for i in range(weight.shape[0]):
            net += weight[i] * float(mean[0, i]) ** 2
        scores[0] = max(scores[0], crossing[0] * net / (own[0] / body.scale + body.tie))
    seen = np.ones(count)
    for k in range(count):
        if not met[k]:
            continue
        for c in range(2):
            part = kids[2 * k + c]
            if 0 <= part < count and met[part] and kids[2 * part] >= 0:
                _pass_on(part, scores[k], linear, told, scores)
                seen[part] = seen[k] * smooth((1.0 - linear[k]) / _SEEN)
    whole = scores[0]
    for k in range(count - 1, -1, -1):
        if not met[k]:
            continue
        wide = smooth((body.scale * extent[k] - _WIDE[0]) / (_WIDE[1] - _WIDE[0]))
        least = max(_CROSSED * wide, whole * extent[k] / extent[0])
        scores[k] = max(scores[k], seen[k] * crossing[k] * least)
        if 0 <= kids[2 * k] < count:
            scores[k] = max(scores[k], scores[kids[2 * k]], scores[kids[2 * k + 1]])
