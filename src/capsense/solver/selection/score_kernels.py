"""The step, compiled: what each charge function of a scene is worth."""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.face_kernels import smooth
from capsense.solver.selection.evaluation_kernels import (
    far_potentials,
    look,
    place,
    room_for,
    screening,
    with_room,
)

DECAY = 0.35
"""Score of a part over that of the whole, 2 ** -1.5, in a linear potential."""
_CROSSED = 0.3
"""Least score of large clusters that cross a wall: so much that functions are fully faded in. Their
points lie among the sources that represent the wall, 40 mm behind it, and would attract themselves
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


_LAYERS = 0.25
"""What scores of dipoles count for."""
_USUAL = 0.015
"""Threshold up to which clusters are looked into as far as they usually are."""


@compiled
def score(bodies, green, threshold, weight):
    """Share of the electrodes' energies that each charge function takes up alone.

    Writes the weights 1/energy of the terminals. Clusters that are small against their distance
    from the design, and cross no wall, are not looked into: φ⁰ is linear there, and parts have
    :data:`DECAY` times the score of the cluster above. Panels are looked into where functions above
    them count, see :func:`_score_parts`.

    Returns:
        The clusters that were looked at, and the row of each body's first one, shape (b + 1,).
    """
    terminals, looks = green.terminals, room_for(np.int64(0), green.phi_columns)
    energy, first = np.zeros(terminals), np.zeros(bodies.shape[0] + 1, np.int64)
    coarser = max(1.0, (threshold / _USUAL) ** (1.0 / 3.0))
    for b in range(bodies.shape[0]):
        looks = with_room(looks, first[b], 2 * bodies[b].n - 1)
        first[b + 1] = look(bodies[b], green, coarser, looks, first[b])
        _add_energies(bodies[b], looks, (first[b], first[b + 1]), energy)
    whole = 0.0
    for i in range(terminals):
        whole += energy[i] ** 2
    for i in range(terminals):
        weight[i] = 1.0 / (energy[i] + 0.01 * math.sqrt(whole) + 1e-300)
    last = first[-1]
    for b in range(bodies.shape[0]):
        rows = first[b], first[b + 1]
        looks = with_room(looks, last, 2 * bodies[b].n - 1)
        last = _score_panels(bodies[b], green, looks, (*rows, last), weight)
        _raise_scores(bodies[b], looks, rows, weight, np.empty(rows[1] - rows[0]))
        last = _score_parts(bodies[b], green, looks, (*rows, last), (threshold, weight))
    return looks, first


@kernel
def _add_energies(body, looks, rows, energy):
    """Add what the clusters of a body take up of each terminal's energy, by themselves.

    They have the rows from rows[0] to rows[1].
    """
    means = looks.means
    for k in range(rows[1] - 1, rows[0] - 1, -1):
        x = looks.children[k]
        if x >= 0:
            screening = (
                looks.ancestor_weight[k] * (1.0 - looks.linearity[k]) / _energy(body, looks.node[k])
            )
            for i in range(energy.shape[0]):
                d = float(means[x, i] - means[x + 1, i])
                energy[i] += d * d * screening
    if not body.neutral:
        for i in range(energy.shape[0]):
            energy[i] += float(means[rows[0], i]) ** 2 / _net_energy(body)


@kernel
def _energy(body, k):
    """Energy of the function of a cluster [1/m]; of a dielectric about that on a half-space."""
    own = doubles(body.own)[integers(body.function)[k]]
    return (1.0 + body.polarization_stiffness) * own / body.scale


@kernel
def _net_energy(body):
    """Energy of a body's net charge [1/m]."""
    inside = 1.0 + body.polarization_stiffness if body.layer > 0.0 else 1.0
    return inside * doubles(body.own)[0] / body.scale + body.ground_elastance


@kernel
def _own_score(body, looks, row, weight):
    """Score of the function of a cluster, from the potentials of its two parts.

    It counts for more where the design leaves the function less of its energy: twice over for
    that, and once more as the errors of all that is left out there go the same way.
    """
    x, value = looks.children[row], 0.0
    for i in range(weight.shape[0]):
        d = float(looks.means[x, i] - looks.means[x + 1, i])
        value += weight[i] * d * d
    if body.layer > 0.0:  # those left out are added in the field of the design
        return _LAYERS * value / _energy(body, looks.node[row])
    return value / (_energy(body, looks.node[row]) * looks.screening_factor[row] ** 3)


@kernel
def _raised(value, first, second):
    """A score, raised by those of the two parts."""
    for below in (first, second):
        value = max(value, below) + 0.5 * min(value, below)
    return value


@kernel
def _pass_on(part, above, looks):
    """Let a cluster have a part of the score above it as far as that sees a linear potential."""
    rest = 1.0 - looks.ancestor_weight[part] * (1.0 - looks.linearity[part])
    looks.score[part] = looks.ancestor_weight[part] * looks.score[part] + rest * DECAY * above


@kernel
def _share(looks, row):
    """What the score of a panel or a part counts."""
    taken = 1.0 - looks.screening_factor[row] * looks.screening_factor[row]
    return min(1.0, max(0.0, (taken - _FREE[0]) / (_FREE[1] - _FREE[0])))


@kernel
def _has_parts(body, looks, row):
    """Whether a cluster is a panel that has parts."""
    return integers(body.children)[2 * looks.node[row]] >= body.n_panel_clusters


@compiled
def _score_panels(body, green, looks, rows, weight):
    """Score panels that have parts, if near; others have no score of their own.

    ``rows`` are the first of the body, the one behind its last, and the first one that is free.

    Returns:
        The first one that is free then.
    """
    nodes, count = np.empty(rows[1] - rows[0], np.int64), 0
    for k in range(rows[0], rows[1]):
        looks.score[k] = 0.0
        if _has_parts(body, looks, k) and _share(looks, k) > 0.0:
            nodes[count] = k
            count += 1
    last = _score_nodes(body, green, nodes[:count], looks, rows[2], weight)
    return _raise_nodes(body, green, nodes[:count], looks, last, weight)


@kernel
def _raise_scores(body, looks, rows, weight, counts):
    """Score a body's clusters from the mean potentials of those that were looked at.

    What was looked at below a cluster that sees a linear potential does not count.

    No charge is beyond a wall. A part that crosses one can carry charge where it is inside only if
    it is split too, which its own score does not tell. So that is at least the score of the body,
    times the part's share of its length. ``counts``, one for each, is workspace.
    """
    children, extent, (start, stop) = integers(body.children), doubles(body.extent), rows
    scores, crossing = looks.score, looks.wall_crossing_weight
    for k in range(stop - 1, start - 1, -1):
        x = looks.children[k]
        if 0 <= x < stop:
            own = _own_score(body, looks, k, weight)
            scores[k] = (1.0 - looks.linearity[k]) * _raised(own, scores[x], scores[x + 1])
        counts[k - start] = 1.0
    if not body.neutral:
        net = 0.0
        for i in range(weight.shape[0]):
            net += weight[i] * float(looks.means[start, i]) ** 2
        scores[start] = max(scores[start], crossing[start] * net / _net_energy(body))
    for k in range(start, stop):
        x = looks.children[k]
        if not 0 <= x < stop:
            continue
        for part in range(x, x + 2):
            if 0 <= children[2 * looks.node[part]] < body.n_panel_clusters:
                _pass_on(part, scores[k], looks)
                counts[part - start] = counts[k - start] * smooth(
                    (1.0 - looks.linearity[k]) / _SEEN
                )
    whole = scores[start]
    # what has no net charge carries none where no function of it counts
    forced = min(_CROSSED, _FULLY * whole) if body.neutral else _CROSSED
    for k in range(stop - 1, start - 1, -1):
        size, x = extent[looks.node[k]], looks.children[k]
        wide = smooth((body.scale * size - _WIDE[0]) / (_WIDE[1] - _WIDE[0]))
        least = max(forced * wide, whole * size / extent[0])
        scores[k] = max(scores[k], counts[k - start] * crossing[k] * least)
        if 0 <= x < stop:
            scores[k] = max(scores[k], scores[x], scores[x + 1])


@compiled
def _score_parts(body, green, looks, rows, limits):
    """Score the parts of panels where the cluster above the panel needs them.

    Scores of panels and parts are raised by those directly below them alone, so that parts are
    looked at only where the whole is split.

    Args:
        body: The body.
        green: Green's function of the design.
        looks: What was found; extended. Scores of parts are filled, those of their panels raised.
        rows: As of :func:`_score_panels`.
        limits: The threshold, and the weights of the terminals.

    Returns:
        The first row that is free then.
    """
    (start, stop, last), (threshold, weight) = rows, limits
    if body.n_panel_clusters == 2 * body.n - 1:
        return last
    nodes, count = np.empty(stop - start, np.int64), 0
    for k in range(start, stop):
        x = looks.children[k]
        if not 0 <= x < stop:
            continue
        for panel in range(x, x + 2):
            if _has_parts(body, looks, panel):
                looks.refinement_score[panel] = _share(looks, panel) * looks.score[k]
                if looks.refinement_score[panel] > threshold:
                    nodes[count] = panel
                    count += 1
    children = integers(body.children)
    while count > 0:
        below, many = np.empty(2 * count, np.int64), 0
        for k in nodes[:count]:
            for part in range(looks.children[k], looks.children[k] + 2):
                if looks.score[k] > threshold and children[2 * looks.node[part]] >= 0:
                    below[many] = part
                    many += 1
        last = _raise_nodes(body, green, below[:many], looks, last, weight)
        nodes, count = below, many
    return last


@compiled
def _raise_nodes(body, green, nodes, looks, last, weight):
    """Raise the scores of panels or parts, which are known, by those of their parts.

    Returns:
        The first row that is free, which was ``last``.
    """
    children, below, count = integers(body.children), np.empty(2 * nodes.shape[0], np.int64), 0
    for k in nodes:
        for part in range(looks.children[k], looks.children[k] + 2):
            looks.score[part] = 0.0
            if children[2 * looks.node[part]] >= 0:
                below[count] = part
                count += 1
    last = _score_nodes(body, green, below[:count], looks, last, weight)
    for k in nodes:
        x = looks.children[k]
        looks.score[k] = _raised(looks.score[k], looks.score[x], looks.score[x + 1])
    return last


@compiled
def _score_nodes(body, green, nodes, looks, last, weight):
    """Score panels and parts by themselves, whatever the potential is like.

    Where a cluster is far from the design, charge within its panels does nothing: scores count in
    as much as the design leaves these less energy than they have in free space.

    Returns:
        The first row that is free, which was ``last``.
    """
    children, many = integers(body.children), 2 * nodes.shape[0]
    points, rows, inner = np.empty((many, 3), np.float32), np.empty(many, np.int64), np.ones(many)
    space, middle = green.space, np.empty(3)
    for j in range(many):
        k, rows[j] = nodes[j // 2], last + j
        if j % 2 == 0:
            looks.children[k] = rows[j]
        looks.node[rows[j]], looks.children[rows[j]] = children[2 * looks.node[k]] + j % 2, -1
        square, height, _, out = place(body, space, looks.node[rows[j]], points, j, middle)
        size = body.scale * doubles(body.extent)[looks.node[rows[j]]]
        looks.screening_factor[rows[j]] = screening(space.has_face, size, square, height)
        inner[j] = 1.0 - smooth(out)
    far_potentials(points, rows, inner, green, looks.means)
    for k in nodes:
        looks.score[k] = _share(looks, k) * _own_score(body, looks, k, weight)
    return last + many
