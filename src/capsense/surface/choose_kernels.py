"""The step, compiled: which clusters and charge functions a scene needs."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.green_kernels import smooth
from capsense.surface.score_kernels import DECAY, INHERITED, score

_FULL = 0.1
"""How far something of a cluster within reach has to be represented for its function to be whole:
what only fine clusters reach comes with them, not at once."""
_PARTED = 0.1
"""Fade of a function from which on its two clusters are represented by their parts alone."""
USED, FRONTIER, LEAF = 2, 1, 0
"""State of a cluster: its function is used; it is split for an estimate only; it is not split."""


class Cut(NamedTuple):
    """The clusters that a scene needs, parts behind wholes, body after body."""

    body: NDArray[Any]
    """Body of a cluster, shape (k,)."""
    node: NDArray[Any]
    """Its place in the body's tree, shape (k,)."""
    kids: NDArray[Any]
    """Its parts in this list, -1 for a leaf, shape (k, 2)."""
    share: NDArray[Any]
    """Share of the first part in its equilibrium charge, shape (k,)."""
    parts: NDArray[Any]
    """Shares of its two parts in the charge within reach, beside ``whole``, shape (k, 2)."""
    leaf: NDArray[Any]
    """Its number among the leaves, else -1, shape (k,)."""
    whole: NDArray[Any]
    """How far it is represented by itself, not by its parts: 1 where it is not split, (k,)."""
    fade: NDArray[Any]
    """How far its function is faded in, 0 to 1, shape (k,)."""
    above: NDArray[Any]
    """The same of the cluster above, 1 at the top, shape (k,)."""
    there: NDArray[Any]
    """How far something of it within reach is represented, 0 to 1, shape (k,)."""
    leaves: NDArray[Any]
    """The leaves in this list: clusters that are represented by themselves, shape (l,)."""


class Functions(NamedTuple):
    """The charge functions of a cut: those solved for, then those of the estimate."""

    cluster: NDArray[Any]
    """Cluster in the cut that a function splits, -1 - cluster for the net charge, shape (f,)."""
    number: NDArray[Any]
    """Its number among the functions of the shape, shape (f,)."""
    body: NDArray[Any]
    """Its body, shape (f,)."""
    fade: NDArray[Any]
    """How far it is faded in, 0 to 1, shape (f,)."""
    above: NDArray[Any]
    """The same of the function above, 1 at the top, shape (f,)."""
    ends: NDArray[Any]
    """Which part of the two that it splits its cluster into are panels, 0 to 1, shape (f,); 0 where
    something of the cluster is out of reach."""
    solved: int
    """How many are solved for."""


@compiled
def chosen(bodies, green, threshold, width):
    """Return the cut of a scene: see :func:`score` and :func:`choose`."""
    first = np.zeros(bodies.shape[0] + 1, np.int64)
    for b in range(bodies.shape[0]):
        first[b + 1] = first[b] + 2 * bodies[b].n - 1
    weight, scores, entry = np.empty(green.terminals), np.empty(first[-1]), np.empty(first[-1])
    seen = score(bodies, first, green, threshold, weight, scores, entry)
    return choose(bodies, first, seen, (scores, entry), threshold, width)


@compiled
def choose(bodies, first, seen, found, threshold, width):
    """Return the clusters whose score is above a threshold, and those directly below them.

    A function fades in while its score grows from ``threshold`` to ``width`` times that. Scores
    that are inherited are written where they are used. A panel that was looked into is left to its
    parts as far as the function above it would be there if it were one of parts.
    """
    total, (scores, entry) = first[-1], found
    state, place = np.full(total, np.int8(-1)), np.empty(total, np.int64)
    fades, above, met = np.empty(total), np.empty(total), np.empty(total, np.int64)
    count = leaves = np.int64(0)  # not the literal, for which Numba would compile another version
    for b in range(bodies.shape[0]):
        kids, stored = integers(bodies[b].kids), bodies[b].stored
        o, k, last = first[b], -1, 0
        state[o], above[o] = FRONTIER, 1.0
        while k < last:
            k += 1
            if state[o + k] < 0:
                continue
            place[o + k], met[count] = count, o + k
            count += 1
            fades[o + k] = 0.0
            if kids[2 * k] < 0:
                state[o + k] = LEAF
            leaves += _whole(state[o + k], above[o + k]) > 0.0
            if state[o + k] == LEAF:
                continue
            fades[o + k] = min(_faded(scores[o + k], threshold, width), above[o + k])
            state[o + k] = USED if fades[o + k] > 0.0 else FRONTIER
            for c in range(2):
                part, below = o + kids[2 * k + c], kids[2 * kids[2 * k + c]]
                above[part] = fades[o + k]
                inherits = part - o < stored and (part - o >= seen[b] or scores[part] == INHERITED)
                if part - o < stored <= below:
                    share = 0.0 if inherits else _faded(entry[part], threshold, width)
                    above[part] = min(above[part], share)
                state[part] = FRONTIER if above[part] > 0.0 else LEAF
                if inherits:
                    scores[part] = DECAY * scores[o + k]
                last = max(last, part - o)
    return _collect(bodies, first, state, place, fades, above, met[:count], leaves)


@kernel
def _faded(score, threshold, width):
    """How far a function of some score is faded in, 0 to 1."""
    return smooth(math.log(max(score, 1e-300) / threshold) / math.log(width))


@kernel
def _whole(state, above):
    """How far a cluster is represented by itself: it gives way to its parts as it is entered."""
    return 1.0 if state == LEAF else 1.0 - smooth(above / _PARTED)


@compiled
def _collect(bodies, first, state, place, fades, above, met, leaves):
    count = met.shape[0]
    cut = Cut(
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty((count, 2), np.int64),
        np.zeros(count), np.zeros((count, 2)), np.empty(count, np.int64), np.empty(count),
        np.empty(count), np.empty(count), np.ones(count), np.empty(leaves, np.int64),
    )  # fmt: skip
    leaf = b = 0
    for a in range(count):
        at = met[a]
        while at >= first[b + 1]:
            b += 1
        k, kids, charge = at - first[b], integers(bodies[b].kids), doubles(bodies[b].charge)
        cut.body[a], cut.node[a] = b, k
        cut.fade[a], cut.above[a] = fades[at], above[at]
        cut.whole[a] = _whole(state[at], above[at])
        cut.leaf[a] = cut.kids[a, 0] = cut.kids[a, 1] = -1
        if cut.whole[a] > 0.0:
            cut.leaf[a], cut.leaves[leaf] = leaf, a
            leaf += 1
        if state[at] != LEAF:
            for c in range(2):
                cut.kids[a, c] = place[first[b] + kids[2 * k + c]]
            cut.share[a] = charge[kids[2 * k]] / charge[k]
            cut.parts[a, 0] = (1.0 - cut.whole[a]) * cut.share[a]
            cut.parts[a, 1] = (1.0 - cut.whole[a]) - cut.parts[a, 0]
    return cut


@compiled
def functions_of(bodies, cut, beyond):
    """List the charge functions of a cut, those to be solved for first.

    ``beyond`` is how far each leaf is out of reach. Where one is in part, charge is held off by an
    energy that tells nothing of how coarse panels are, so that none of its functions counts for
    that.
    """
    count = bodies.shape[0]
    reaches_out = np.zeros(cut.node.shape[0], np.bool_)
    for a in range(cut.node.shape[0] - 1, -1, -1):
        if cut.leaf[a] >= 0:
            reaches_out[a] = beyond[cut.leaf[a]] > 0.0
        if cut.kids[a, 0] >= 0:
            count += is_there(cut, cut.kids[a, 0]) and is_there(cut, cut.kids[a, 1])
            for c in range(2):
                reaches_out[a] = reaches_out[a] or reaches_out[cut.kids[a, c]]
    cluster, number = np.empty(count, np.int64), np.empty(count, np.int64)
    body = np.empty(count, np.int64)
    fade, above, ends = np.empty(count), np.empty(count), np.zeros(count)
    f = solved = 0
    for rest in range(2):
        for a in range(cut.node.shape[0]):
            b = cut.body[a]
            if rest == 0 and cut.node[a] == 0 and not bodies[b].neutral and is_there(cut, a):
                cluster[f], number[f], body[f] = -1 - a, 0, b
                fade[f] = above[f] = smooth(cut.there[a] / _FULL)
                f += 1
            x, y = cut.kids[a]
            parted = x >= 0 and is_there(cut, x) and is_there(cut, y)
            if parted and (cut.fade[a] == 0.0) == (rest == 1):
                # functions are numbered breadth first, as clusters are
                cluster[f], number[f], body[f] = a, _function(bodies[b], cut.node[a]), b
                full = smooth(min(cut.there[x], cut.there[y]) / _FULL)
                fade[f], above[f] = full * cut.fade[a], full * cut.above[a]
                ends[f] = 0.0 if reaches_out[a] else _panels(bodies[b], cut.node[a])
                f += 1
        if rest == 0:
            solved = f
    return Functions(
        cluster[:f], number[:f], body[:f], fade[:f], above[:f], ends[:f], solved
    )  # fmt: skip


@kernel
def is_there(cut, a):
    """Whether anything of a cluster is within reach."""
    return cut.whole[a] + cut.parts[a, 0] + cut.parts[a, 1] > 0.0


@kernel
def _function(body, node):
    return integers(body.function)[node]


@compiled
def _panels(body, node):
    kids, out = integers(body.kids), 0.0
    for c in range(2):
        if kids[2 * kids[2 * node + c]] < 0:
            out += 0.5
    return out
