"""The step, compiled: which clusters and charge functions a scene needs."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.face_kernels import smooth
from capsense.solver.gap.body_gap_kernels import crowded
from capsense.solver.selection.score_kernels import DECAY, score

_FULL = 0.1
"""How far something of a cluster within reach has to be represented for its function to be whole:
what only fine clusters reach comes with them, not at once."""
_PARTED = 0.1
"""Fade of a function from which on its two clusters are represented by their parts alone."""


class ActiveTree(NamedTuple):
    """The clusters that a scene needs, body after body: parts behind wholes, of panels last."""

    body: NDArray[Any]
    """Body of a cluster, shape (k,)."""
    node: NDArray[Any]
    """Its place in the body's tree, shape (k,)."""
    children: NDArray[Any]
    """Its parts in this list, -1 for a leaf, shape (k, 2)."""
    charge_fraction: NDArray[Any]
    """Share of the first part in its equilibrium charge, shape (k,)."""
    child_weights: NDArray[Any]
    """Shares of its two parts in the charge within reach, beside ``whole``, shape (k, 2)."""
    active_index: NDArray[Any]
    """Its number among the leaves, else -1, shape (k,)."""
    self_weight: NDArray[Any]
    """How far it is represented by itself, not by its parts: 1 where it is not split, (k,)."""
    fade: NDArray[Any]
    """How far its function is faded in, 0 to 1, shape (k,)."""
    parent_fade: NDArray[Any]
    """Fade of the cluster above, 1 at the top, shape (k,)."""
    inside_weight: NDArray[Any]
    """How far something of it within reach is represented, 0 to 1, shape (k,)."""
    active: NDArray[Any]
    """The leaves in this list: clusters that are represented by themselves, shape (l,)."""


class Functions(NamedTuple):
    """The charge functions of a cut: those solved for, then those of the estimate."""

    cluster: NDArray[Any]
    """Cluster in the cut whose charge a function is made of, shape (f,)."""
    net: NDArray[Any]
    """Whether it is the net charge of that cluster, a whole body; otherwise its charge is that of
    the cluster's first part less that of the second; shape (f,)."""
    number: NDArray[Any]
    """Its number among the functions of the shape, shape (f,)."""
    body: NDArray[Any]
    """Its body, shape (f,)."""
    fade: NDArray[Any]
    """How far it is faded in, 0 to 1, shape (f,)."""
    parent_fade: NDArray[Any]
    """Fade of the function above, 1 at the top, shape (f,)."""
    panel_end_fraction: NDArray[Any]
    """Which part of the two that it splits its cluster into are panels, 0 to 1, shape (f,); 0 where
    something of the cluster is out of reach."""
    solved: int
    """How many are solved for."""


@compiled
def chosen(bodies, green, threshold, width, facing):
    """Return the cut of a scene: see :func:`score` and :func:`choose`."""
    looks, first = score(bodies, green, threshold, np.empty(green.terminals))
    return choose(bodies, looks, first, threshold, width, facing)


class _Queue(NamedTuple):
    """The clusters of a cut while it is made; the capacity is n."""

    body: NDArray[Any]
    node: NDArray[Any]
    first: NDArray[Any]
    """Its first part in this list, which the second follows; -1 for what is not split, (n,)."""
    row: NDArray[Any]
    """Its row among the clusters that were looked at, -1 for others, shape (n,)."""
    score: NDArray[Any]
    fade: NDArray[Any]
    parent_fade: NDArray[Any]


@compiled
def _with_room(queue, filled, more):
    """A copy with capacity for more behind those that are filled; as :func:`with_room`."""
    if filled + more <= queue.body.shape[0]:
        return queue
    n = 2 * filled + more
    out = _Queue(
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64),
        np.empty(n), np.empty(n), np.empty(n),
    )  # fmt: skip
    for k in range(filled):
        out.body[k], out.node[k] = queue.body[k], queue.node[k]
        out.first[k], out.row[k] = queue.first[k], queue.row[k]
        out.score[k], out.fade[k], out.parent_fade[k] = (
            queue.score[k],
            queue.fade[k],
            queue.parent_fade[k],
        )
    return out


@compiled
def choose(bodies, looks, first, threshold, width, facing):
    """Return the clusters whose score is above a threshold, and those directly below them.

    A function fades in while its score grows from ``threshold`` to ``width`` times that. A panel
    that was looked into is left to its parts as far as the function above it would be there if it
    were one of parts. Clusters that are large for the gap to a conductor that faces them are split
    too.
    """
    queue = _Queue(
        np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int64),
        np.empty(0), np.empty(0), np.empty(0),
    )  # fmt: skip
    count = leaves = np.int64(0)  # not the literal, for which Numba would compile another version
    for b in range(bodies.shape[0]):
        queue = _with_room(queue, count, 2 * bodies[b].n - 1)
        _put(queue, count, b, (np.int64(0), first[b]), looks.score[first[b]], 1.0)
        limits = threshold / (1.0 + bodies[b].demand), width
        count, more = _split(bodies, b, looks, queue, count, limits, facing)
        leaves += more
    return _collect(bodies, queue, count, leaves)


@kernel
def _split(bodies, b, looks, queue, start, limits, facing):
    """Put the clusters of a body that a scene needs in the queue, parts of panels last.

    The whole is there, at ``start``.

    Returns:
        The place behind the last one, and how many of them are leaves.
    """
    body = bodies[b]
    children, stop, leaves = integers(body.children), start + 1, 0
    for parts in range(2):
        i = start - 1
        while i + 1 < stop:
            i += 1
            if (max(queue.node[i], children[2 * queue.node[i]]) >= body.n_panel_clusters) != (
                parts == 1
            ):
                continue
            queue.first[i], queue.fade[i] = -1, 0.0
            if queue.parent_fade[i] > 0.0 and children[2 * queue.node[i]] >= 0:
                queue.first[i] = stop
                least = crowded(bodies, facing, b, queue.node[i])
                stop = _put_parts(body, looks, queue, (i, stop), limits, least)
            leaves += _whole(queue.first[i], queue.parent_fade[i]) > 0.0
    return stop, leaves


@kernel
def _put_parts(body, looks, queue, places, limits, least):
    """Put the two parts of the cluster at places[0] in the queue, from places[1] on.

    Its function is faded in to ``least`` at least.

    Returns:
        The place behind them.
    """
    children, (i, stop), (threshold, width) = integers(body.children), places, limits
    queue.fade[i] = min(max(_faded(queue.score[i], threshold, width), least), queue.parent_fade[i])
    row = queue.row[i]
    for c in range(2):
        part, above = children[2 * queue.node[i] + c], queue.fade[i]
        seen = looks.children[row] + c if row >= 0 and looks.children[row] >= 0 else -1
        if part < body.n_panel_clusters <= children[2 * part]:  # a panel that has parts
            share = _faded(looks.refinement_score[seen], threshold, width) if seen >= 0 else 0.0
            above = min(above, max(share, least))
        value = looks.score[seen] if seen >= 0 else DECAY * queue.score[i]
        stop = _put(queue, stop, queue.body[i], (part, seen), value, above)
    return stop


@kernel
def _put(queue, place, b, cluster, score, above):
    """Put a cluster, given by its place in the tree and its row, at a place in the queue.

    Returns:
        The place behind it.
    """
    queue.body[place], queue.score[place], queue.parent_fade[place] = b, score, above
    queue.node[place], queue.row[place] = cluster
    return place + 1


@kernel
def _faded(score, threshold, width):
    """How far a function of some score is faded in, 0 to 1."""
    return smooth(math.log(max(score, 1e-300) / threshold) / math.log(width))


@kernel
def _whole(first, above):
    """How far a cluster is represented by itself: it gives way to its parts as it is entered."""
    return 1.0 if first < 0 else 1.0 - smooth(above / _PARTED)


@compiled
def _collect(bodies, queue, count, leaves):
    cut = ActiveTree(
        queue.body[:count], queue.node[:count], np.empty((count, 2), np.int64), np.zeros(count),
        np.zeros((count, 2)), np.empty(count, np.int64), np.empty(count), queue.fade[:count],
        queue.parent_fade[:count], np.ones(count), np.empty(leaves, np.int64),
    )  # fmt: skip
    leaf = 0
    for a in range(count):
        body, k, first = bodies[cut.body[a]], cut.node[a], queue.first[a]
        children, charge = integers(body.children), doubles(body.charge)
        cut.self_weight[a] = _whole(first, cut.parent_fade[a])
        cut.active_index[a] = cut.children[a, 0] = cut.children[a, 1] = -1
        if cut.self_weight[a] > 0.0:
            cut.active_index[a], cut.active[leaf] = leaf, a
            leaf += 1
        if first >= 0:
            cut.children[a, 0], cut.children[a, 1] = first, first + 1
            cut.charge_fraction[a] = charge[children[2 * k]] / charge[k]
            cut.child_weights[a, 0] = (1.0 - cut.self_weight[a]) * cut.charge_fraction[a]
            cut.child_weights[a, 1] = (1.0 - cut.self_weight[a]) - cut.child_weights[a, 0]
    return cut


@compiled
def functions_of(bodies, cut, beyond):
    """List the charge functions of a cut, those to be solved for first.

    ``beyond`` is how far each leaf is out of reach. Where one is in part, charge is held off by an
    energy that does not depend on how coarse panels are, so that none of its functions counts for
    that.
    """
    count = bodies.shape[0]
    reaches_out = np.zeros(cut.node.shape[0], np.bool_)
    for a in range(cut.node.shape[0] - 1, -1, -1):
        if cut.active_index[a] >= 0:
            reaches_out[a] = beyond[cut.active_index[a]] > 0.0
        if cut.children[a, 0] >= 0:
            count += is_there(cut, cut.children[a, 0]) and is_there(cut, cut.children[a, 1])
            for c in range(2):
                reaches_out[a] = reaches_out[a] or reaches_out[cut.children[a, c]]
    cluster, number = np.empty(count, np.int64), np.empty(count, np.int64)
    net, body = np.zeros(count, np.bool_), np.empty(count, np.int64)
    fade, above, ends = np.empty(count), np.empty(count), np.zeros(count)
    f = solved = 0
    for rest in range(2):
        for a in range(cut.node.shape[0]):
            b = cut.body[a]
            if rest == 0 and cut.node[a] == 0 and not bodies[b].neutral and is_there(cut, a):
                cluster[f], net[f], number[f], body[f] = a, True, 0, b
                fade[f] = above[f] = smooth(cut.inside_weight[a] / _FULL)
                f += 1
            x, y = cut.children[a]
            parted = x >= 0 and is_there(cut, x) and is_there(cut, y)
            if parted and (cut.fade[a] == 0.0) == (rest == 1):
                # functions are numbered breadth first, as clusters are
                cluster[f], number[f], body[f] = a, _function(bodies[b], cut.node[a]), b
                full = smooth(min(cut.inside_weight[x], cut.inside_weight[y]) / _FULL)
                fade[f], above[f] = full * cut.fade[a], full * cut.parent_fade[a]
                ends[f] = 0.0 if reaches_out[a] else _panels(bodies[b], cut.node[a])
                f += 1
        if rest == 0:
            solved = f
    return Functions(
        cluster[:f], net[:f], number[:f], body[:f], fade[:f], above[:f], ends[:f], solved
    )


@kernel
def is_there(cut, a):
    """Whether anything of a cluster is within reach."""
    return cut.self_weight[a] + cut.child_weights[a, 0] + cut.child_weights[a, 1] > 0.0


@kernel
def _function(body, node):
    return integers(body.function)[node]


@compiled
def _panels(body, node):
    children, out = integers(body.children), 0.0
    for c in range(2):
        if children[2 * children[2 * node + c]] < 0:
            out += 0.5
    return out
