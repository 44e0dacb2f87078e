"""The step of many environments as Warp kernels: charges, what functions that are not solved for
would add, and how the matrices change as bodies move, by the closed adjoint.

Every cluster that is not split has one more function, the difference of its two parts. It adds the
energy that the potential which the charges leave has in it alone, times ``GAIN``, as functions
below the cut do in :mod:`capsense.solver.system.system_kernels`. Its own energy is that in free
space, and in charge that is out of reach.

For derivatives, as in :mod:`capsense.solver.gradients.gradient_kernels`, charges are held while
they move in the field of the other charges, of all images and of the design; what changes with the
share of near sources or with the lift off the design is left out, as there. The charges are those
solved for, x = A⁻¹ Φ, those of the estimate on the parts of clusters, y = D (φ - B x), and what
these take from the first, -A⁻¹ Bᵀ y: see ``system_kernels._add_adjoint``. Floating conductors of
the design follow.

What has a column for each terminal has ``2 lead`` columns: real parts, then imaginary ones, which
mean something in views with losses only; for derivatives, real parts alone. Lengths in metres,
4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.fleet.warp_cut import (
    SOURCES,
    Places,
    Response,
    Shapes,
    WarpActiveTree,
    idle,
    many,
)
from capsense.fleet.warp_pairs import (
    COLUMNS,
    Leaf,
    body_of,
    columns_of,
    first_source,
    last_source,
    leaf_of,
    mean,
    more,
    seen,
    some,
)  # fmt: skip
from capsense.fleet.warp_solve import Left, own, times
from capsense.solver.system.system_kernels import COARSE, GAIN

wp.set_module_options({"enable_backward": False, "fast_math": True})

_SOURCES, _COLUMNS = wp.constant(SOURCES), wp.constant(COLUMNS)
_COARSE, _GAIN = wp.constant(COARSE), wp.constant(GAIN)


@wp.kernel
def coarse(
    cut: WarpActiveTree, matrix: wp.array3d(dtype=wp.float32), loss: wp.array2d(dtype=wp.float32),
    charge: wp.array3d(dtype=wp.float32), out: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """What panels are too coarse for [m], see ``system_kernels.COARSE``, (t, v)."""
    t, v = wp.tid()
    if t >= cut.columns[v]:
        return
    total = float(0.0)
    for f in range(matrix.shape[0]):
        if cut.number[f, v] >= 0 and cut.panel_end_fraction[f, v] > 0.0:
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
            total += _COARSE * cut.panel_end_fraction[f, v] * wp.length(energy) * square
    out[t, v] = total


@wp.kernel
def modes(
    cut: WarpActiveTree, phi_columns: int, rows: wp.array3d(dtype=wp.float32),
    charge: wp.array3d(dtype=wp.float32), added: int, out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Sums of ψ over all charges, (modes, 2 lead, v); ``added`` to what there is."""
    k, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    start = rows.shape[1] - out.shape[0]
    if start + k >= cut.width[v] or idle(cut, phi_columns, first, v):
        return
    total = some()
    if added != 0:
        total = columns_of(out, k, first, v)
    for f in range(rows.shape[0]):
        total += rows[f, start + k, v] * columns_of(charge, f, first, v)
    for c in range(_COLUMNS):
        out[k, first + c, v] = total[c]


@wp.kernel
def strengths(
    green: Response, cut: WarpActiveTree, sums: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Strength of the design's sources, a terminal at 1 V and charges in place, (s, 2 lead, v).

    Those of near sources are not worked out where a view needs none.
    """
    batch, c, v = wp.tid()
    width = cut.width[v]
    near = _SOURCES * batch >= green.far
    if (near and width < green.columns.shape[0]) or idle(cut, green.phi_columns, c, v):
        return
    total = many()
    if c < green.first:
        total = green.columns[c, batch]
    for k in range(green.first, width):
        total += sums[k - green.first, c, v] * green.columns[k, batch]
    for s in range(wp.min(_SOURCES, out.shape[0] - _SOURCES * batch)):
        out[_SOURCES * batch + s, c, v] = total[s]


@wp.kernel
def to_clusters(
    cut: WarpActiveTree, phi_columns: int, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Charges of clusters from those of functions; these become those of the shapes' functions."""
    c, v = wp.tid()
    if idle(cut, phi_columns, c, v):
        return
    for step in range(cut.leader.shape[0]):
        b = cut.leader.shape[0] - 1 - step
        o = b * cut.clusters
        leader = cut.leader[b, v]
        if leader != b:
            charge[leader * cut.clusters, c, v] -= charge[o, c, v]
    for b in range(cut.leader.shape[0]):
        o = b * cut.clusters
        out[o, c, v] = charge[o, c, v]
        for k in range(1, cut.clusters):
            apart = charge[o + k, c, v]
            out[o + k, c, v] = apart
            if cut.number[o + k, v] >= 0:
                i = o + cut.split[o + k, v]
                whole = out[i, c, v]
                p = cut.mix[o + k, v]
                out[i, c, v] = p * whole + apart
                out[o + k, c, v] = (1.0 - p) * whole - apart
        if cut.walled[v] != 0:
            for k in range(cut.clusters):
                charge[o + k, c, v] = out[o + k, c, v]
            for step in range(cut.clusters - 1):
                k = cut.clusters - 1 - step
                if cut.number[o + k, v] >= 0:
                    i = o + cut.split[o + k, v]
                    x = charge[i, c, v]
                    y = charge[o + k, c, v]
                    charge[i, c, v] = x + y
                    charge[o + k, c, v] = x - cut.part[o + k, v] * (x + y)


@wp.func
def _fallen(
    green: Response,
    cut: WarpActiveTree,
    leaf: Leaf,
    body: int,
    charge: wp.array3d(dtype=wp.float32),
    parts: int,
    first: int,
    v: int,
):
    """How far charges lower the potentials on a leaf of a body, columns from ``first`` on.

    Those are on clusters, or on the ``parts`` of them. What charges of its own body do in free
    space is left out.
    """
    out = some()
    n = cut.number.shape[0]
    for j in range(parts * n, (1 + 2 * parts) * n):
        if cut.node[j, v] >= 0:
            value = mean(leaf, cut, j, v, 1.0, green.floor)
            if body_of(cut, j) != body:
                value -= mean(leaf, cut, j, v, 0.0, green.floor)
            elif leaf.lifted + cut.lifted[j, v] > 0:
                value -= more(leaf, cut, j, v)
            out += value * columns_of(charge, j, first, v)
    return out


@wp.func
def _met(
    green: Response, cut: WarpActiveTree, leaf: Leaf, body: int, first: int, v: int,
    left: Left,
):  # fmt: skip
    """Potentials on a leaf, but for its body's charges in free space."""
    out = _fallen(green, cut, leaf, body, left.on, 0, first, v)
    for s in range(first_source(green, leaf), last_source(green, leaf)):
        out += seen(green, leaf, s) * columns_of(left.strength, s, first, v)
    return out


@wp.kernel
def residuals(shapes: Shapes, places: Places, green: Response, cut: WarpActiveTree, left: Left):
    """Potentials that all charges leave in the function below each cluster, and its energy.

    Both are filled in ``left``; the energy [1/m] is zero where a cluster is a panel or there is
    none.
    """
    i, chunk, v = wp.tid()
    k = cut.node[i, v]
    first = _COLUMNS * chunk
    imaginary = first >= green.phi_columns
    if idle(cut, green.phi_columns, first, v):
        return
    b = i // cut.clusters
    e = v // places.hidden.shape[0]
    part = cut.number.shape[0] + 2 * i
    if cut.node[part, v] < 0:
        left.energy[i, v] = wp.vec2()
        return
    x = shapes.function[k]
    leaf = leaf_of(cut, part, v)
    out = _met(green, cut, leaf, b, first, v, left)
    whole = own(shapes, places, e, b, x, x)
    whole[0] += leaf.barrier
    leaf = leaf_of(cut, part + 1, v)
    out -= _met(green, cut, leaf, b, first, v, left)
    whole[0] += leaf.barrier
    o = b * cut.clusters
    other = wp.where(imaginary, first - green.phi_columns, first + green.phi_columns)
    for j in range(cut.clusters):
        y = wp.where(j == 0, 0, cut.number[o + j, v])
        if y >= 0:
            value = own(shapes, places, e, b, x, y)
            out -= value[0] * columns_of(left.charge, o + j, first, v)
            if cut.lossy[v] != 0:
                sign = wp.where(imaginary, 1.0, -1.0)
                out -= sign * value[1] * columns_of(left.charge, o + j, other, v)
    for c in range(_COLUMNS):
        left.residual[i, first + c, v] = out[c]
    left.energy[i, v] = whole


@wp.kernel
def estimated(cut: WarpActiveTree, left: Left, out: wp.array3d(dtype=wp.float32)):
    """Charges on the parts of clusters that belong to the estimate, in the rows behind those of
    the clusters, (l, lead, v)."""
    i, c, v = wp.tid()
    n = cut.number.shape[0]
    charge = float(0.0)
    own = left.energy[i, v][0]
    if own > 0.0:
        charge = _GAIN * left.residual[i, c, v] / own
    out[n + 2 * i, c, v] = charge
    out[n + 2 * i + 1, c, v] = -charge


@wp.kernel
def felt(
    green: Response, cut: WarpActiveTree, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Potentials at the design's sources by charges on parts of clusters, (s, lead, v)."""
    s, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = some()
    for i in range(cut.number.shape[0], cut.node.shape[0]):
        if cut.node[i, v] >= 0:
            leaf = leaf_of(cut, i, v)
            if s >= first_source(green, leaf) and s < last_source(green, leaf):
                total += seen(green, leaf, s) * columns_of(charge, i, first, v)
    for c in range(_COLUMNS):
        out[s, first + c, v] = total[c]


@wp.kernel
def answered(
    green: Response, cut: WarpActiveTree, potential: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Sums of ψ over charges from their potentials at the sources, (modes, lead, v)."""
    k, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = some()
    if green.first + k < cut.width[v]:
        for batch in range(green.columns.shape[1]):
            few = green.columns[green.first + k, batch]
            for s in range(wp.min(_SOURCES, potential.shape[0] - _SOURCES * batch)):
                total += few[s] * columns_of(potential, _SOURCES * batch + s, first, v)
    for c in range(_COLUMNS):
        out[k, first + c, v] = total[c]


@wp.kernel
def energies_below(
    shapes: Shapes, places: Places, cut: WarpActiveTree,
    charge: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Less the energies of the shapes' functions with charges on parts, (n, lead, v)."""
    j, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    n = cut.number.shape[0]
    b = j // cut.clusters
    total = some()
    y = wp.where(j == b * cut.clusters, 0, cut.number[j, v])
    if cut.node[b * cut.clusters, v] >= 0 and y >= 0:
        for k in range(b * cut.clusters, (b + 1) * cut.clusters):
            if cut.node[n + 2 * k, v] >= 0:
                x = shapes.function[cut.node[k, v]]
                value = own(shapes, places, v // places.hidden.shape[0], b, x, y)
                total -= value[0] * columns_of(charge, n + 2 * k, first, v)
    for c in range(_COLUMNS):
        out[j, first + c, v] = total[c]


@wp.kernel
def pairs_below(
    green: Response, cut: WarpActiveTree, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Add how far charges on parts of clusters lower the potentials on clusters, (n, lead, v)."""
    i, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    if cut.node[i, v] >= 0:
        leaf = leaf_of(cut, i, v)
        total = _fallen(green, cut, leaf, i // cut.clusters, charge, 1, first, v)
        for c in range(_COLUMNS):
            out[i, first + c, v] = out[i, first + c, v] + total[c]


@wp.kernel
def modes_below(
    cut: WarpActiveTree, rows: wp.array3d(dtype=wp.float32), sums: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Add the potentials in functions by the design, from sums of ψ over charges, (n, lead, v)."""
    f, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = columns_of(out, f, first, v)
    start = rows.shape[1] - sums.shape[0]
    for k in range(start, cut.width[v]):
        total += rows[f, k, v] * columns_of(sums, k - start, first, v)
    for c in range(_COLUMNS):
        out[f, first + c, v] = total[c]


@wp.kernel
def add(values: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)):
    """Add values to others."""
    i, c, v = wp.tid()
    out[i, c, v] = out[i, c, v] + values[i, c, v]
