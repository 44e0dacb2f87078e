"""Compiled kernels that split a surface into clusters and change to their charge functions."""

from __future__ import annotations

import numpy as np

from capsense._jit import compiled, kernel

_COLUMNS = 64
"""Columns of a matrix that are taken at a time."""
_BLOCK = 64
"""Rows and columns of a table that are turned at a time."""
_TIE = 1e-6
"""Cuts that halve a cluster equally well, to this part of it, are taken in turns: were it always
the first, symmetric shapes would be resolved better on one side."""
_SHARP = 0.3
"""Share of the spread of normals that a jump between two of them must have to be an edge."""


@compiled
def split(features, charges, order, first, last, kids):
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
        kids: Filled with the two parts of each cluster, -1 for a single panel, shape (2 n - 1, 2).
    """
    n = features.shape[0]
    for i in range(n):
        order[i] = i
    first[0], last[0] = 0, n
    made, k = 1, 0
    values = np.empty(n)
    while k < made:
        a, b = first[k], last[k]
        kids[k, 0] = kids[k, 1] = -1
        if b - a > 1:
            axis, best = 0, -1.0
            for d in range(6):
                low, high = np.inf, -np.inf
                for i in range(a, b):
                    low = min(low, features[order[i], d])
                    high = max(high, features[order[i], d])
                if high - low > best:
                    axis, best = d, high - low
            for i in range(a, b):
                values[i] = features[order[i], axis]
            _sort(values[a:b], order[a:b])
            cut = _cut(values[a:b], order[a:b], charges, axis >= 3, k % 2 == 1)
            kids[k, 0], kids[k, 1] = made, made + 1
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
def _cut(values, members, charges, of_normals, last):
    """How many of the sorted members the first part gets; of equal cuts, the first or the last."""
    n = values.shape[0]
    spread = values[n - 1] - values[0]
    if of_normals:
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
    tie = _TIE * (total if of_normals else spread)
    for i in range(n - 1):
        half += charges[members[i]]
        if values[i + 1] > values[i]:
            off = (
                abs(2.0 * half - total)
                if of_normals
                else (abs(values[i] + values[i + 1] - values[0] - values[n - 1]))
            )
            if off < best - tie or (last and off < best + tie):
                best, cut = off, i + 1
    return cut


@kernel
def moments(kids, panel, charge, center, spread):
    """Charge, centre of charge and second central moments of all clusters, from their parts.

    ``panel`` is the panel of a cluster without parts, whose row of ``charge``, ``center`` and
    ``spread`` is filled; the others are written.
    """
    for k in range(kids.shape[0] - 1, -1, -1):
        if kids[k, 0] < 0:
            continue
        a, b = kids[k, 0], kids[k, 1]
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
def to_functions(values, kids, panel, charge, function, out):
    """Integrate columns of panel values with every charge function, some columns at a time.

    Args:
        values: Mean values on the panels, shape (n, k).
        kids: Parts of the clusters, shape (2 n - 1, 2).
        panel: Panel of a cluster without parts, shape (2 n - 1,).
        charge: Charges of the clusters, shape (2 n - 1,).
        function: Number of a cluster's function, -1 for a single panel, shape (2 n - 1,).
        out: Filled, function 0 with the mean over the body, shape (n, k).
    """
    means = np.empty((kids.shape[0], _COLUMNS))
    for start in range(0, values.shape[1], _COLUMNS):
        width = min(_COLUMNS, values.shape[1] - start)
        for k in range(kids.shape[0] - 1, -1, -1):
            a, b = kids[k, 0], kids[k, 1]
            mean = means[k]
            if a < 0:
                line = values[panel[k]]
                for c in range(width):
                    mean[c] = line[start + c]
            else:
                first, second, line = means[a], means[b], out[function[k]]
                share = charge[a] / charge[k]
                for c in range(width):
                    mean[c] = share * first[c] + (1.0 - share) * second[c]
                    line[start + c] = first[c] - second[c]
        for c in range(width):
            out[0, start + c] = means[0, c]


@compiled
def means_of_clusters(means, last, kids, charge):
    """Means between clusters from those between the smallest ones.

    Args:
        means: Of a symmetric function, between clusters without parts here, shape (k, k).
        last: Which clusters these are, shape (k,).
        kids: Parts of the clusters, behind them; -1 for none, shape (t, 2).
        charge: Charges of the clusters, shape (t,).

    Returns:
        Row by row up to the diagonal, shape (t (t + 1) / 2,).
    """
    count, many = kids.shape[0], last.shape[0]
    rows, share = np.empty((count, many), np.float32), np.empty(count, np.float32)
    for j in range(many):
        rows[last[j]] = means[j]
    for a in range(count - 1, -1, -1):
        if kids[a, 0] >= 0:
            first, second, mean = rows[kids[a, 0]], rows[kids[a, 1]], rows[a]
            share[a] = charge[kids[a, 0]] / charge[a]
            for j in range(many):
                mean[j] = second[j] + share[a] * (first[j] - second[j])
    out, line = np.empty(count * (count + 1) // 2, np.float32), np.empty(count, np.float32)
    for a in range(count):
        for j in range(many):
            line[last[j]] = rows[a, j]
        for k in range(count - 1, -1, -1):
            x, y = kids[k]
            if x >= 0:
                line[k] = line[y] + share[k] * (line[x] - line[y])
        for k in range(a + 1):
            out[a * (a + 1) // 2 + k] = line[k]
    return out


@compiled
def energies_of_functions(rows, kids, panel, charge, function, out):
    """Integrate rows of panel values with every charge function, to a symmetric table.

    Args:
        rows: What :func:`to_functions` makes of a symmetric table of panels, shape (n, n).
        kids, panel, charge, function: As there.
        out: Filled, symmetric to the last bit, single precision, shape (n, n).
    """
    n = rows.shape[0]
    mean = np.empty(kids.shape[0])
    for f in range(n):
        line = out[f]
        for k in range(kids.shape[0] - 1, -1, -1):
            a, b = kids[k, 0], kids[k, 1]
            if a < 0:
                mean[k] = rows[f, panel[k]]
            else:
                share = charge[a] / charge[k]
                mean[k] = share * mean[a] + (1.0 - share) * mean[b]
                line[function[k]] = mean[a] - mean[b]
        line[0] = mean[0]
    for start in range(0, n, _BLOCK):  # blocks stay in the cache while they are turned
        for low in range(0, start + 1, _BLOCK):
            for i in range(start, min(start + _BLOCK, n)):
                for j in range(low, min(low + _BLOCK, i)):
                    out[i, j] = out[j, i]


@kernel
def prune(kids, panel, wanted, new_kids, new_panel, function, room):
    """Leave out panels: clusters without any go, those with one part left become that part.

    Args:
        kids: Parts of the clusters of the whole tree, -1 for single panels, shape (2 n - 1, 2).
        panel: Panel of a cluster without parts, shape (2 n - 1,).
        wanted: Which panels stay, at least one, shape (n,).
        new_kids, new_panel, function: Filled with the tree of m panels, as in ``Tree``; room for n.
        room: Room to work in, shape (2, 2 n - 1).

    Returns:
        m, the number of panels that stay.
    """
    stands, queue = room[0], room[1]  # the cluster that a cluster has become, -1 for none
    count = 0
    for k in range(kids.shape[0] - 1, -1, -1):
        if kids[k, 0] < 0:
            stands[k] = k if wanted[panel[k]] else -1
            count += 1 if wanted[panel[k]] else 0
        else:
            a, b = stands[kids[k, 0]], stands[kids[k, 1]]
            stands[k] = k if a >= 0 and b >= 0 else max(a, b)
    queue[0] = stands[0]
    made, functions = 1, 0
    for k in range(2 * count - 1):
        old = queue[k]
        if kids[old, 0] < 0:
            new_kids[k, 0] = new_kids[k, 1] = -1
            new_panel[k], function[k] = panel[old], -1
        else:
            functions += 1
            new_panel[k], function[k] = -1, functions
            for c in range(2):
                queue[made] = stands[kids[old, c]]
                new_kids[k, c] = made
                made += 1
    return count
