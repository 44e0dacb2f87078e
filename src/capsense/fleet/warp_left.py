"""The step of many environments as Warp kernels: charges, and what functions that are not solved
for would add.

Every cluster that is not split has one more function, the difference of its two parts. It adds the
energy that the potential which the charges leave has in it alone, times ``GAIN``, as functions
below the cut do in :mod:`capsense.surface.solve_kernels`. Its own energy is that in free space, and
in charge that is out of reach.

What has a column for each terminal has ``2 lead`` columns: real parts, then imaginary ones, which
mean something in views with losses only. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.green_kernels import FAR_LEAST, NEAR_LEAST
from capsense.fleet.warp_cut import (
    SOURCES,
    Leaf,
    Places,
    Response,
    Shapes,
    WarpCut,
    many,
)
from capsense.fleet.warp_kernels import four_units, leaf_of, mean, more, own
from capsense.fleet.warp_solve import Left, over, times
from capsense.surface.pair_kernels import BARRIER
from capsense.surface.solve_kernels import COARSE

wp.set_module_options({"enable_backward": False, "fast_math": True})

COLUMNS = 8
"""Columns that a thread works out at a time."""
some = wp.types.vector(length=COLUMNS, dtype=wp.float32)
_SOURCES = wp.constant(SOURCES)
_COLUMNS = wp.constant(COLUMNS)
_BARRIER, _COARSE = wp.constant(BARRIER), wp.constant(COARSE)
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)


@wp.kernel
def charges(
    cut: WarpCut, lead: int, matrix: wp.array3d(dtype=wp.float32),
    loss: wp.array2d(dtype=wp.float32), potentials: wp.array3d(dtype=wp.float32),
    quadrature: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Charges L⁻ᵀ L⁻¹ φ⁰ of the functions from L⁻¹ φ⁰, (n, 2 lead, v)."""
    t, v = wp.tid()
    n = matrix.shape[0]
    lossy = cut.lossy[v] != 0
    for step in range(n):
        i = n - 1 - step
        total = wp.vec2(potentials[i, t, v], quadrature[i, t, v])
        pivot = wp.vec2(matrix[i, i, v], 0.0)
        if pivot[0] <= 0.0 or cut.number[i, v] < 0:
            total = wp.vec2()
        elif lossy:
            for k in range(i + 1, n):
                below = wp.vec2(matrix[k, i, v], matrix[i, k, v])
                total -= times(below, wp.vec2(out[k, t, v], out[k, lead + t, v]))
            pivot[1] = loss[i, v]
            total = over(total, pivot)
        else:
            for k in range(i + 1, n):
                total[0] -= matrix[k, i, v] * out[k, t, v]
            total[0] = total[0] / pivot[0]
        out[i, t, v] = total[0]
        out[i, lead + t, v] = total[1]


@wp.kernel
def coarse(
    cut: WarpCut, matrix: wp.array3d(dtype=wp.float32), loss: wp.array2d(dtype=wp.float32),
    charge: wp.array3d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """What panels are too coarse for [m], see ``solve_kernels.COARSE``, (t, v)."""
    t, v = wp.tid()
    total = float(0.0)
    for f in range(matrix.shape[0]):
        if cut.number[f, v] >= 0 and cut.ends[f, v] > 0.0:
            energy = wp.vec2()  # from its factor
            for k in range(f + 1):
                entry = wp.vec2(matrix[f, k, v], 0.0)
                if cut.lossy[v] != 0:
                    entry[1] = wp.where(k < f, matrix[k, f, v], loss[f, v])
                energy += times(entry, entry)
            square = charge[f, t, v] * charge[f, t, v]
            if cut.lossy[v] != 0:
                imaginary = charge[f, charge.shape[1] // 2 + t, v]
                square += imaginary * imaginary
            total += _COARSE * cut.ends[f, v] * wp.length(energy) * square
    out[t, v] = total


@wp.kernel
def modes(
    cut: WarpCut, lead: int, rows: wp.array3d(dtype=wp.float32),
    charge: wp.array3d(dtype=wp.float32), added: int, out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Sums of ψ over all charges, (modes, 2 lead, v); ``added`` to what there is."""
    k, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    if lead + k >= cut.width[v] or (first >= lead and cut.lossy[v] == 0):
        return
    total = some()
    if added != 0:
        for c in range(_COLUMNS):
            total[c] = out[k, first + c, v]
    for f in range(rows.shape[0]):
        value = rows[f, lead + k, v]
        for c in range(_COLUMNS):
            total[c] = total[c] + value * charge[f, first + c, v]
    for c in range(_COLUMNS):
        out[k, first + c, v] = total[c]


@wp.kernel
def strengths(
    cut: WarpCut, lead: int, applied: int, table: wp.array2d(dtype=many),
    sums: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Strength of the design's sources, a terminal at ``applied`` V and charges in place.

    Shape (s, 2 lead, v).
    Those of sources that a view does not need are not worked out.
    """
    batch, c, v = wp.tid()
    width = table.shape[0]
    if width > cut.width[v] or (c >= lead and cut.lossy[v] == 0):
        return
    total = many()
    if c < lead and applied != 0:
        total = table[c, batch]
    for k in range(lead, width):
        total += sums[k - lead, c, v] * table[k, batch]
    for s in range(wp.min(_SOURCES, out.shape[0] - _SOURCES * batch)):
        out[_SOURCES * batch + s, c, v] = total[s]


@wp.kernel
def to_clusters(
    cut: WarpCut, clusters: int, lead: int, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Charges of clusters from those of functions; these become those of the shapes' functions."""
    c, v = wp.tid()
    if c >= lead and cut.lossy[v] == 0:
        return
    for step in range(cut.leader.shape[0]):
        b = cut.leader.shape[0] - 1 - step
        o = b * clusters
        leader = cut.leader[b, v]
        if leader != b:
            charge[leader * clusters, c, v] -= charge[o, c, v]
    for b in range(cut.leader.shape[0]):
        o = b * clusters
        out[o, c, v] = charge[o, c, v]
        for k in range(1, clusters):
            apart = charge[o + k, c, v]
            out[o + k, c, v] = apart
            if cut.number[o + k, v] >= 0:
                i = o + cut.split[o + k, v]
                whole = out[i, c, v]
                p = cut.mix[o + k, v]
                out[i, c, v] = p * whole + apart
                out[o + k, c, v] = (1.0 - p) * whole - apart
        if cut.walled[v] != 0:
            for k in range(clusters):
                charge[o + k, c, v] = out[o + k, c, v]
            for step in range(clusters - 1):
                k = clusters - 1 - step
                if cut.number[o + k, v] >= 0:
                    i = o + cut.split[o + k, v]
                    x = charge[i, c, v]
                    y = charge[o + k, c, v]
                    charge[i, c, v] = x + y
                    charge[o + k, c, v] = x - cut.part[o + k, v] * (x + y)


@wp.func
def _met(
    green: Response, cut: WarpCut, leaf: Leaf, body: int, clusters: int, first: int, v: int,
    left: Left,
):  # fmt: skip
    """Potentials on a cluster of a body, columns from ``first`` on, but for its body's charges."""
    out = some()
    inner = 0.25 * (1.0 - leaf.beyond)
    if leaf.near > 0.0 and inner > 0.0:
        for s in range(green.near.shape[0]):
            q = green.near[s]
            value = (
                inner
                * leaf.near
                * four_units(leaf.p0, leaf.p1, leaf.p2, leaf.p3, q, green.floor, _NEAR_LEAST)
            )
            for c in range(_COLUMNS):
                out[c] = out[c] + value * left.near[s, first + c, v]
    if leaf.near < 1.0 and inner > 0.0:
        for s in range(green.far.shape[0]):
            q = green.far[s]
            value = (
                inner
                * (1.0 - leaf.near)
                * four_units(leaf.p0, leaf.p1, leaf.p2, leaf.p3, q, green.floor, _FAR_LEAST)
            )
            for c in range(_COLUMNS):
                out[c] = out[c] + value * left.far[s, first + c, v]
    for j in range(cut.number.shape[0]):
        if cut.node[j, v] >= 0:
            value = mean(leaf, cut, j, v, 1.0, green.floor)
            if j // clusters != body:
                value -= mean(leaf, cut, j, v, 0.0, green.floor)
            elif leaf.lifted + cut.lifted[j, v] > 0:
                value -= more(leaf, cut, j, v)
            for c in range(_COLUMNS):
                out[c] = out[c] + value * left.on[j, first + c, v]
    return out


@wp.kernel
def residuals(
    shapes: Shapes, places: Places, green: Response, cut: WarpCut, clusters: int, left: Left
):
    """Potentials that all charges leave in the function below each cluster, and its energy.

    Both are filled in ``left``; the energy [1/m] is zero where a cluster is a panel or there is
    none.
    """
    i, chunk, v = wp.tid()
    k = cut.node[i, v]
    first = _COLUMNS * chunk
    imaginary = first >= green.lead
    if imaginary and cut.lossy[v] == 0:
        return
    b = i // clusters
    e = v // places.hidden.shape[0]
    part = cut.number.shape[0] + 2 * i
    if cut.node[part, v] < 0:
        left.energy[i, v] = wp.vec2()
        return
    x = shapes.function[k]
    leaf = leaf_of(cut, part, v)
    out = _met(green, cut, leaf, b, clusters, first, v, left)
    whole = own(shapes, places, e, b, x, x)
    whole[0] += _BARRIER * leaf.beyond * leaf.beyond * leaf.beyond
    leaf = leaf_of(cut, part + 1, v)
    out -= _met(green, cut, leaf, b, clusters, first, v, left)
    whole[0] += _BARRIER * leaf.beyond * leaf.beyond * leaf.beyond
    o = b * clusters
    other = wp.where(imaginary, first - green.lead, first + green.lead)
    for j in range(clusters):
        y = wp.where(j == 0, 0, cut.number[o + j, v])
        if y >= 0:
            value = own(shapes, places, e, b, x, y)
            for c in range(_COLUMNS):
                out[c] = out[c] - value[0] * left.charge[o + j, first + c, v]
            if cut.lossy[v] != 0:
                sign = wp.where(imaginary, 1.0, -1.0)
                for c in range(_COLUMNS):
                    out[c] = out[c] - sign * value[1] * left.charge[o + j, other + c, v]
    for c in range(_COLUMNS):
        left.residual[i, first + c, v] = out[c]
    left.energy[i, v] = whole
