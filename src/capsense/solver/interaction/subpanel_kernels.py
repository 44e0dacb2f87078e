"""The step, compiled: what the parts of a body's panels meet within the body."""

from __future__ import annotations

import numpy as np

from capsense._jit import compiled
from capsense.solver.tree.mean_kernels import add_means, cluster_moments, rectangles


@compiled
def add_parts(bodies, cut, leaves, out):
    """Add to pairs what parts of panels meet in their body beyond what its energies have.

    These hold what panels meet as wholes. A part meets every other cluster by the mean of 1/r, less
    the mean of that over all parts of its panel that are leaves, or over those of both panels; with
    their charges for weights.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        cut: The clusters.
        leaves: Those that are represented by themselves.
        out: Added to [1/m], shape (l, l).
    """
    n = cut.active.shape[0]
    # first leaf of the body, and the first one that is a part; literals would be types of their own
    start, first = np.int64(0), np.int64(-1)
    for i in range(n):
        body = bodies[leaves.owner[i]]
        if first < 0 and cut.node[cut.active[i]] >= body.n_panel_clusters:
            first = i
        if i + 1 == n or leaves.owner[i + 1] != leaves.owner[i]:
            if first >= 0:
                _add_of_body(body, cut, leaves, (start, first, i + 1), out)
            start, first = i + 1, -1


@compiled
def _add_of_body(body, cut, leaves, span, out):
    """Add what subpanels meet in one body, given by its leaves: its first, the first that is a
    part, the one behind."""
    start, first, stop = span
    factor = np.float32(1.0 + body.inside * body.inverse_susceptibility)
    group, weight, groups = _panels(body, cut, (first, stop))
    n = stop - start
    points, extent = leaves.true[start:stop], leaves.extent[start:stop]
    known, wanted, means = np.full((n, 2), -1), np.ones(n), np.zeros((n, n), np.float32)
    tables = cluster_moments(points, extent), rectangles(points, wanted), known
    add_means(points, extent, (np.int64(0), first - start, n, 1.0), wanted, tables, means)
    parts, off = stop - first, first - start
    single, double = np.zeros((groups, n), np.float32), np.zeros((groups, groups), np.float32)
    for i in range(parts):
        line = means[off + i]
        for j in range(i):
            means[off + j, off + i] = line[off + j]
    for i in range(parts):
        line, to, share = means[off + i], single[group[i]], np.float32(weight[i])
        for j in range(n):
            to[j] += share * line[j]
    for i in range(parts):
        to, share = double[group[i]], np.float32(weight[i])
        for g in range(groups):
            to[g] += share * single[g, off + i]
    for i in range(parts):
        line, own = means[off + i], group[i]
        for j in range(off + i + 1):
            less = single[own, j] if j < off else double[own, group[j - off]]
            out[first + i, start + j] += factor * (line[j] - less)
            out[start + j, first + i] = out[first + i, start + j]


@compiled
def _panels(body, cut, span):
    """Panel of each leaf that is a part, counted from 0; its share in all of these; their number.

    ``span`` is the first leaf of a body that is a part, and the one behind its last.
    """
    first, stop = span
    group, weight = np.empty(stop - first, np.int64), np.empty(stop - first)
    begin = end = cut.active[stop - 1]
    while begin > 0 and cut.body[begin - 1] == cut.body[end]:
        begin -= 1
    while end < cut.body.shape[0] and cut.body[end] == cut.body[begin]:
        end += 1  # the last clusters may be out of reach, and have no leaf
    number, share = np.empty(end - begin, np.int64), np.empty(end - begin)
    count = 0
    for a in range(begin, end):
        if cut.node[a] < body.n_panel_clusters:
            number[a - begin], share[a - begin] = -1, 1.0
        for c in range(2):
            x = cut.children[a, c]
            if x >= 0 and cut.node[x] >= body.n_panel_clusters:
                if number[a - begin] < 0:
                    number[a - begin] = count
                    count += 1
                number[x - begin] = number[a - begin]
                part = cut.child_weights[a, c]
                if (
                    part == 0.0 and cut.node[a] < body.n_panel_clusters
                ):  # they hardly stand for it yet
                    part = cut.charge_fraction[a] if c == 0 else 1.0 - cut.charge_fraction[a]
                share[x - begin] = share[a - begin] * part
    whole = np.zeros(count)
    for j in range(first, stop):
        a = cut.active[j]
        group[j - first] = number[a - begin]
        weight[j - first] = share[a - begin] * cut.self_weight[a]
        whole[group[j - first]] += weight[j - first]
    for j in range(stop - first):
        weight[j] /= whole[group[j]]
    return group, weight, count
