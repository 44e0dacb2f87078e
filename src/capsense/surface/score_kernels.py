"""The step, compiled: what each charge function of a scene is worth."""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.green_kernels import SHORE, smooth
from capsense.surface.look_kernels import Looks, far_potentials, look, looks_of, place

DECAY = 0.35
"""Score of a part over that of the whole, 2 ** -1.5, in a linear potential."""
INHERITED = -1.0
"""Score of what has :data:`DECAY` times that of the cluster above."""
_CROSSED = 0.3
"""Least score of large clusters that cross a wall: so much that functions are fully faded in. Their
points lie among the sources that stand for the wall, 40 mm behind it, and would attract themselves
so much that no definite matrix were left."""
_FULLY = 2.5
"""Functions are fully faded in from so many times the threshold on, with all presets."""
_SEEN = 0.1
"""Part of a cluster that does not see a linear potential from which on what crosses a wall within
it counts in full."""
_FREE = 0.01, 0.1
"""Panels come to be looked into where the design takes between these parts of the square of their
functions' energy."""
_WIDE = 0.08, 0.12
"""Clusters come to be large between these extents [m]."""


@compiled
def score(bodies, first, green, threshold, weight, scores, entry):
    """Share of the electrodes' energies that each charge function takes up alone.

    Writes the weights 1/energy of the terminals, and into ``scores`` the score of every cluster,
    raised by those of its parts; ``first`` (b + 1,) has each body's first cluster. Clusters that
    are small against their distance from the design, and cross no wall, are not looked into: φ⁰ is
    linear there. Where nothing was looked at the score is :data:`INHERITED`.

    Panels are looked into where functions above them count, for which ``entry`` is filled: see
    :func:`_score_parts`.

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
    counts = np.empty(total)
    for b in range(bodies.shape[0]):
        looks = looks_of(all_looks, first[b], first[b + 1])
        seen[b] = look(bodies[b], green, looks)
        _add_energies(bodies[b], looks, seen[b], energy)
    whole = 0.0
    for i in range(terminals):
        whole += energy[i] ** 2
    for i in range(terminals):
        weight[i] = 1.0 / (energy[i] + 0.01 * math.sqrt(whole) + 1e-300)
    for b in range(bodies.shape[0]):
        looks = looks_of(all_looks, first[b], first[b + 1])
        of, enter = scores[first[b] : first[b + 1]], entry[first[b] : first[b + 1]]
        _score_panels(bodies[b], green, seen[b], looks, weight, of)
        _raise_scores(
            bodies[b], looks_of(looks, np.int64(0), seen[b]), weight, of[: seen[b]], counts
        )
        _score_parts(bodies[b], green, seen[b], looks, (threshold, weight), of, enter)
    return seen


@kernel
def _add_energies(body, looks, seen, energy):
    """Add what the first clusters of a body take up of each terminal's energy, by themselves."""
    kids, means = integers(body.kids), looks.means
    for k in range(seen - 1, -1, -1):
        x, y = kids[2 * k], kids[2 * k + 1]
        if looks.met[k] and 0 <= x < seen and looks.met[x]:
            stiffness = looks.told[k] * (1.0 - looks.linear[k]) / _energy(body, k)
            for i in range(energy.shape[0]):
                d = float(means[x, i] - means[y, i])
                energy[i] += d * d * stiffness
    if not body.neutral:
        for i in range(energy.shape[0]):
            energy[i] += float(means[0, i]) ** 2 / _net_energy(body)


@kernel
def _energy(body, k):
    """Energy of the function of a cluster [1/m]; of a dielectric about that on a half-space."""
    own = doubles(body.own)[integers(body.function)[k]]
    return (1.0 + body.stiffer) * own / body.scale


@kernel
def _net_energy(body):
    """Energy of a body's net charge [1/m]."""
    return doubles(body.own)[0] / body.scale + body.tie


@kernel
def _own_score(body, looks, k, weight):
    """Score of the function of a cluster, from the potentials of its two parts.

    It counts for more where the design leaves the function less of its energy: twice over for
    that, and once more as the errors of all that is left out there go the same way.
    """
    x, value = integers(body.kids)[2 * k], 0.0
    for i in range(weight.shape[0]):
        d = float(looks.means[x, i] - looks.means[x + 1, i])
        value += weight[i] * d * d
    return value / (_energy(body, k) * looks.stiff[k] ** 3)


@kernel
def _raised(value, first, second):
    """A score, raised by those of the two parts."""
    for below in (first, second):
        value = max(value, below) + 0.5 * min(value, below)
    return value


@kernel
def _pass_on(part, above, looks, scores):
    """Let a cluster have a part of the score above it as far as that sees a linear potential."""
    rest = 1.0 - looks.told[part] * (1.0 - looks.linear[part])
    scores[part] = looks.told[part] * scores[part] + rest * DECAY * above


@kernel
def _share(looks, k):
    """What the score of a panel or a part counts."""
    taken = 1.0 - looks.stiff[k] * looks.stiff[k]
    return min(1.0, max(0.0, (taken - _FREE[0]) / (_FREE[1] - _FREE[0])))


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


@kernel
def _raise_scores(body, looks, weight, scores, counts):
    """Score a body's first clusters from the mean potentials of those that were met.

    What was met below a cluster that sees a linear potential does not count.

    No charge is beyond a wall. A part that crosses one can carry charge where it is inside only if
    it is split too, which its own score does not tell. So that is at least the score of the body,
    times the part's share of its length. ``counts`` (n,) is room to work in.
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
    for k in range(count):
        counts[k] = 1.0
    for k in range(count):
        if not met[k]:
            continue
        for c in range(2):
            part = kids[2 * k + c]
            if 0 <= part < count and met[part] and 0 <= kids[2 * part] < body.stored:
                _pass_on(part, scores[k], looks, scores)
                counts[part] = counts[k] * smooth((1.0 - looks.linear[k]) / _SEEN)
    whole = scores[0]
    # what has no net charge carries none where no function of it counts
    forced = min(_CROSSED, _FULLY * whole) if body.neutral else _CROSSED
    for k in range(count - 1, -1, -1):
        if not met[k]:
            continue
        wide = smooth((body.scale * extent[k] - _WIDE[0]) / (_WIDE[1] - _WIDE[0]))
        least = max(forced * wide, whole * extent[k] / extent[0])
        scores[k] = max(scores[k], counts[k] * crossing[k] * least)
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
        out = place(body, green, places[j], points, j, looks)[2]
        inner[j] = 1.0 - smooth(out / SHORE)
    far_potentials(points, places, inner, green, looks.means)
    for k in nodes:
        scores[k] = _share(looks, k) * _own_score(body, looks, k, weight)
