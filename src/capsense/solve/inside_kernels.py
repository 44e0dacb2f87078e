"""Nodes inside conductors: which they are, and what becomes of their links."""

from __future__ import annotations

import math

from capsense._jit import kernel
from capsense.solve.column_kernels import pierce
from capsense.solve.finding_kernels import add_energy, add_tie, room, storey_of


@kernel
def place(c, t):
    """How many of the increasing numbers ``c`` lie below t."""
    low, high = 0, c.shape[0]
    while low < high:
        middle = (low + high) >> 1
        if c[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def mark_inside(storeys, axes, nodes, ceiling, parent, bodies, grids, inside, inside_nodes, before,
                out):  # fmt: skip
    """Mark free nodes inside conductors with the conductor's index, as seen along z.

    Clears the first ``before`` marks in ``inside_nodes``; returns how many nodes lie inside now.
    ``out`` is room for the stretches of one body.
    """
    for i in range(before):
        inside[inside_nodes[i]] = -1
    n = 0
    for s in range(storeys.shape[0]):
        storey = storeys[s]
        first, begin = storey.first, storey.begin
        nx, ny, nz = storey.shape[0], storey.shape[1], storey.shape[2]
        x, y = axes[begin[0] : begin[0] + nx], axes[begin[1] : begin[1] + ny]
        z = axes[begin[2] : begin[2] + nz]
        for m in range(bodies.shape[0]):
            body = bodies[m]
            bounds = body.bounds
            if body.conductor < 0 or bounds[1, 2] < z[1] or bounds[0, 2] > z[nz - 2]:
                continue
            for i in range(1, nx - 1):
                if x[i] < bounds[0, 0] or x[i] > bounds[1, 0]:
                    continue
                for j in range(1, ny - 1):
                    if y[j] < bounds[0, 1] or y[j] > bounds[1, 1]:
                        continue
                    count = pierce(2, x[i], y[j], -math.inf, math.inf, body, grids, out)
                    for c in range(count):
                        k = max(1, place(z, out[c, 0]))
                        while k < nz - 1 and z[k] <= out[c, 1]:
                            a = first + (i * ny + j) * nz + k
                            if nodes[a].owner == -1 and inside[a] < 0:
                                inside[a] = body.conductor
                                inside_nodes[n] = a
                                n += 1
                            k += 1
    for j in range(ceiling.shape[0]):
        if inside[parent[j]] >= 0:
            inside[ceiling[j]] = inside[parent[j]]
            inside_nodes[n] = ceiling[j]
            n += 1
    return n


@kernel
def close_inside(storeys, nodes, links, cuts, stored, weight, extra, inside, inside_nodes, ties,
                  energies, couples, within, counts):  # fmt: skip
    """Turn what conductors leave of the links from nodes inside them into ties.

    Returns False if the findings do not fit.
    """
    within[:] = 0.0
    s = 0
    for i in range(counts[3]):
        a = inside_nodes[i]
        s = storey_of(storeys, a, s)
        strides = (storeys[s].shape[1] * storeys[s].shape[2], storeys[s].shape[2], 1)
        deep = nodes[a].plain
        for axis in range(3):
            deep = deep and inside[a + strides[axis]] >= 0
        if deep:
            for axis in range(3):
                weight[axis, a] = 0.0
            for k in range(within.shape[0]):
                within[k] += stored[a, k]
        half = 0.0
        for axis in range(3):
            for way in range(1 if deep else 0, 2):
                lower = a if way == 0 else a - strides[axis]
                b = a + strides[axis] if way == 0 else lower
                link = links[axis, lower]
                if link.cut >= 0:
                    half += cuts[link.cut].half[way]
                    continue
                if link.weight == 0.0 or (way == 1 and inside[b] >= 0):
                    continue
                if not room(ties, energies, couples, counts):
                    return False
                if inside[b] >= 0:
                    weight[axis, lower] = 0.0
                    add_energy(energies, counts, a, b, -3, link.weight, False)
                    continue
                w = weight[axis, lower]
                weight[axis, lower] = 0.0
                if w <= 1e-5 * link.weight:
                    continue
                free = nodes[b].owner == -1
                add_tie(ties, counts, extra, b if free else -1, inside[a], a, -3, w)
        # what conductors leave of half-links to sheets
        rest = extra[a]
        extra[a] = 0.0
        if rest > 1e-5 * half:
            if not room(ties, energies, couples, counts):
                return False
            add_tie(ties, counts, extra, -1, inside[a], a, -3, rest)
    return True
