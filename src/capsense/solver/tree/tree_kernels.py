"""Compiled kernels that split a surface into clusters and change to their charge functions."""

from __future__ import annotations

import numpy as np

from capsense._dense import mirror
from capsense._jit import compiled, kernel

_BLOCK = 64
"""Rows and columns of a table that are turned at a time."""
_TIE = 1e-6
"""Cuts that halve a cluster equally well, to this part of it, are taken in turns: were it always
the first, symmetric shapes would be resolved better on one side."""
_SHARP = 0.3
"""Share of the spread of normals that a jump between two of them must have to be an edge."""


@compiled
def split(features, charges, order, first, last, children):
    """Split a surface into a binary tree of clusters, breadth first.

    A cluster is split across the feature that varies most: in the middle of its extent along a
    coordinate, at the largest jump of a normal. Panels that do not differ are halved.

    Args:
        features: Centres and scaled normals of the panels in whole numbers of some grain, shape
            (n, 6).
        charges: Equilibrium charges of the panels, shape (n,).
        order: Filled with the panels, those of a cluster side by side, shape (n,).
        first: Filled with the first place in ``order`` of each cluster, shape (2 n - 1,).
        last: Filled with the place behind the last one, shape (2 n - 1,).
        children: Filled with the two parts of each cluster, -1 for a single panel, shape
            (2 n - 1, 2).
    """
    n = features.shape[0]
    for i in range(n):
        order[i] = i
    first[0], last[0] = 0, n
    made, k = 1, 0
    values, room, ends = np.empty(n), np.empty(n, np.int64), np.empty((2, 6))
    while k < made:
        a, b = first[k], last[k]
        children[k, 0] = children[k, 1] = -1
        if b - a > 1:
            ends[0], ends[1] = np.inf, -np.inf
            for i in range(a, b):
                line = features[order[i]]
                for d in range(6):
                    ends[0, d], ends[1, d] = min(ends[0, d], line[d]), max(ends[1, d], line[d])
            axis = 0
            for d in range(1, 6):
                if ends[1, d] - ends[0, d] > ends[1, axis] - ends[0, axis]:
                    axis = d
            low, high = ends[0, axis], ends[1, axis]
            for i in range(a, b):
                values[i] = features[order[i], axis]
            if axis < 3 and low < high:
                cut = _parted(values[a:b], order[a:b], (low, high), k % 2 == 1, room)
            else:
                _sort(values[a:b], order[a:b])
                cut = _cut(values[a:b], order[a:b], charges, k % 2 == 1)
            children[k, 0], children[k, 1] = made, made + 1
            first[made], last[made] = a, a + cut
            first[made + 1], last[made + 1] = a + cut, b
            made += 2
        k += 1


@compiled
def _sort(values, members):
    """Heap sort by value, equal ones by number."""
    n = values.shape[0]
    for start in range(n // 2 - 1, -n, -1):
        root, end = start, n
        if start < 0:  # the largest is in place; sift the one that takes its turn
            root, end = 0, n + start
            values[0], values[end] = values[end], values[0]
            members[0], members[end] = members[end], members[0]
        while 2 * root + 1 < end:
            child = 2 * root + 1
            if child + 1 < end and (
                values[child] < values[child + 1]
                or (values[child] == values[child + 1] and members[child] < members[child + 1])
            ):
                child += 1
            if values[root] > values[child] or (
                values[root] == values[child] and members[root] > members[child]
            ):
                break
            values[root], values[child] = values[child], values[root]
            members[root], members[child] = members[child], members[root]
            root = child


@kernel
def _parted(values, members, ends, last, room):
    """Bring members below the middle of their values to the front; returns how many these are.

    The cut is half-way between two values; of equally good ones it is the first or the last.
    """
    (low, high), n = ends, values.shape[0]
    below, above = low, high  # about the middle, and the next ones
    further, beyond = -np.inf, np.inf
    for i in range(n):
        v = values[i]
        if v + v <= low + high:
            if v > below:
                further, below = below, v
            elif further < v < below:
                further = v
        elif v < above:
            above, beyond = v, above
        elif above < v < beyond:
            beyond = v
    best, cut, tie = np.inf, below, _TIE * (high - low)
    for one, other in ((further, below), (below, above), (above, beyond)):
        off = abs(one + other - low - high)
        if off < best - tie or (last and off < best + tie):
            best, cut = off, one
    front, behind = 0, 0
    for i in range(n):
        if values[i] <= cut:
            members[front] = members[i]
            front += 1
        else:
            room[behind] = members[i]
            behind += 1
    for i in range(behind):
        members[front + i] = room[i]
    return front


@kernel
def _cut(values, members, charges, last):
    """How many of the members, sorted by a normal, the first part gets.

    Of equally good cuts it is the first or the last.
    """
    n = values.shape[0]
    spread = values[n - 1] - values[0]
    jump, at = 0.0, -1
    for i in range(n - 1):
        if values[i + 1] - values[i] > jump:
            jump, at = values[i + 1] - values[i], i + 1
    if jump > _SHARP * spread:
        return at
    total = 0.0
    for i in range(n):
        total += charges[members[i]]
    best, cut, half = np.inf, n // 2, 0.0
    for i in range(n - 1):
        half += charges[members[i]]
        if values[i + 1] > values[i]:
            off = abs(2.0 * half - total)
            if off < best - _TIE * total or (last and off < best + _TIE * total):
                best, cut = off, i + 1
    return cut


@kernel
def moments(children, panel, charge, center, spread):
    """Charge, centre of charge and second central moments of all clusters, from their parts.

    ``panel`` is the panel of a cluster without parts, whose row of ``charge``, ``center`` and
    ``spread`` is filled; the others are written.
    """
    for k in range(children.shape[0] - 1, -1, -1):
        if children[k, 0] < 0:
            continue
        a, b = children[k, 0], children[k, 1]
        whole = charge[a] + charge[b]
        p, q = charge[a] / whole, charge[b] / whole
        charge[k] = whole
        for i in range(3):
            center[k, i] = p * center[a, i] + q * center[b, i]
        for i in range(3):
            for j in range(3):
                spread[k, i, j] = p * (
                    spread[a, i, j] + (center[a, i] - center[k, i]) * (center[a, j] - center[k, j])
                ) + q * (
                    spread[b, i, j] + (center[b, i] - center[k, i]) * (center[b, j] - center[k, j])
                )


@compiled
def means(children, charge, values):
    """Fill means of all clusters (t, 3) from those of clusters without parts, by their charges."""
    for k in range(children.shape[0] - 1, -1, -1):
        if children[k, 0] >= 0:
            a, b = children[k, 0], children[k, 1]
            p = charge[a] / charge[k]
            for i in range(3):
                values[k, i] = p * values[a, i] + (1.0 - p) * values[b, i]


@kernel
def _upwards(children, order):
    """Clusters such that parts come before their cluster, and no others between.

    Args:
        children: Parts of the clusters, shape (t, 2).
        order: Filled with the clusters, shape (t,).

    Returns:
        How many clusters at most wait for the other part of theirs.
    """
    count = children.shape[0]
    order[0], waiting = 0, 1
    for place in range(count - 1, -1, -1):  # clusters that wait stand first, done ones last
        waiting -= 1
        k = order[waiting]
        if children[k, 0] >= 0:
            for c in range(2):
                order[waiting] = children[k, c]
                waiting += 1
        order[place] = k
    most = 0
    for k in order:
        waiting += 1 if children[k, 0] < 0 else -1
        most = max(most, waiting)
    return most


@compiled
def to_functions(values, children, panel, charge, function, out):
    """Integrate columns of panel values with every charge function.

    Args:
        values: Mean values on the panels, shape (n, k).
        children: Parts of the clusters, shape (2 n - 1, 2).
        panel: Panel of a cluster without parts, shape (2 n - 1,).
        charge: Charges of the clusters, shape (2 n - 1,).
        function: Number of a cluster's function, -1 for a single panel, shape (2 n - 1,).
        out: Filled, function 0 with the mean over the body, shape (n, k).
    """
    order = np.empty(children.shape[0], np.int64)
    width, top = values.shape[1], 0
    means = np.empty((_upwards(children, order), width))
    for k in order:
        if children[k, 0] < 0:
            line, mean = values[panel[k]], means[top]
            for c in range(width):
                mean[c] = line[c]
            top += 1
            continue
        top -= 1
        first, second, line = means[top - 1], means[top], out[function[k]]
        share = charge[children[k, 0]] / charge[k]
        for c in range(width):
            line[c] = first[c] - second[c]
        for c in range(width):
            first[c] = share * first[c] + (1.0 - share) * second[c]
    for c in range(width):
        out[0, c] = means[0, c]


@compiled
def table_of_functions(block, children, panel, charge, function):
    """Integrate a symmetric table of panel values with every charge function, both ways.

    Args:
        block: Mean values between panels, shape (n, n).
        children, panel, charge, function: As in :func:`to_functions`.

    Returns:
        Symmetric to the last bit, shape (n, n), single precision.
    """
    n = block.shape[0]
    rows, out = np.empty((n, n)), np.empty((n, n), np.float32)
    to_functions(block, children, panel, charge, function, rows)
    for start in range(0, n, _BLOCK):  # blocks stay in the cache while they are turned
        for low in range(0, start + 1, _BLOCK):
            for i in range(start, min(start + _BLOCK, n)):
                for j in range(low, min(low + _BLOCK, i)):
                    rows[i, j], rows[j, i] = rows[j, i], rows[i, j]
    to_functions(rows, children, panel, charge, function, out)
    mirror(out)
    return out


@compiled
def means_of_clusters(means, last, children, charge, rows, out):
    """Means between clusters from those between the smallest ones.

    Args:
        means: Of a symmetric function, between clusters without parts here, shape (k, k).
        last: Which clusters these are, ascending, shape (k,).
        children: Parts of the clusters, behind them; -1 for none, shape (t, 2).
        charge: Charges of the clusters, shape (t,).
        rows: Room to work in, shape (t, k), single precision.
        out: Filled row by row up to the diagonal, shape (t (t + 1) / 2,), single precision.
    """
    count, many = children.shape[0], last.shape[0]
    share = np.empty(count, np.float32)
    for j in range(many):
        rows[last[j]] = means[j]
    for a in range(count - 1, -1, -1):
        if children[a, 0] >= 0:
            first, second, mean = rows[children[a, 0]], rows[children[a, 1]], rows[a]
            share[a] = charge[children[a, 0]] / charge[a]
            for j in range(many):
                mean[j] = second[j] + share[a] * (first[j] - second[j])
    for low in range(0, many, _BLOCK):  # blocks stay in the cache while they are turned
        high = min(low + _BLOCK, many)
        for start in range(0, last[high - 1] + 1, _BLOCK):
            for j in range(low, high):
                place = last[j] * (last[j] + 1) // 2
                for a in range(start, min(start + _BLOCK, last[j] + 1)):
                    out[place + a] = rows[a, j]
    for k in range(count - 1, -1, -1):
        if children[k, 0] >= 0:
            i, j = children[k, 0], children[k, 1]
            first, second = out[i * (i + 1) // 2 :], out[j * (j + 1) // 2 :]
            line = out[k * (k + 1) // 2 :]
            for a in range(k + 1):
                line[a] = second[a] + share[k] * (first[a] - second[a])


@kernel
def prune(children, panel, wanted, new_kids, new_panel, function, room):
    """Leave out panels: clusters without any go, those with one part left become that part.

    Args:
        children: Parts of the clusters of the whole tree, -1 for single panels, shape (2 n - 1, 2).
        panel: Panel of a cluster without parts, shape (2 n - 1,).
        wanted: Which panels stay, at least one, shape (n,).
        new_kids, new_panel, function: Filled with the tree of m panels, as in ``Tree``; capacity n.
        room: Room to work in, shape (2, 2 n - 1).

    Returns:
        m, the number of panels that stay.
    """
    stands, queue = room[0], room[1]  # the cluster that a cluster has become, -1 for none
    count = 0
    for k in range(children.shape[0] - 1, -1, -1):
        if children[k, 0] < 0:
            stands[k] = k if wanted[panel[k]] else -1
            count += 1 if wanted[panel[k]] else 0
        else:
            a, b = stands[children[k, 0]], stands[children[k, 1]]
            stands[k] = k if a >= 0 and b >= 0 else max(a, b)
    queue[0] = stands[0]
    made, functions = 1, 0
    for k in range(2 * count - 1):
        old = queue[k]
        if children[old, 0] < 0:
            new_kids[k, 0] = new_kids[k, 1] = -1
            new_panel[k], function[k] = panel[old], -1
        else:
            functions += 1
            new_panel[k], function[k] = -1, functions
            for c in range(2):
                queue[made] = stands[children[old, c]]
                new_kids[k, c] = made
                made += 1
    return count


@compiled
def in_order(children, panel):
    """The panels of a binary tree of clusters, those of a cluster side by side, shape (n,)."""
    out, found = np.empty((children.shape[0] + 1) // 2, np.int64), 0
    stack, top = np.empty(children.shape[0], np.int64), 1
    stack[0] = 0
    while top > 0:
        top -= 1
        k = stack[top]
        if panel[k] >= 0:
            out[found] = panel[k]
            found += 1
            continue
        stack[top], stack[top + 1] = children[k, 1], children[k, 0]
        top += 2
    return out
