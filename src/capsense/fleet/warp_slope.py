"""How the matrices of many environments change as bodies move, by the closed adjoint, on Warp.

The twin of these kernels is :mod:`capsense.surface.gradient_kernels`. Charges are held while they
move in the field of the other charges, of all images and of the design; what changes with the share
of near sources or with the lift off the design is left out, as there. The charges are those solved
for, x = A⁻¹ Φ, those of the estimate on the parts of clusters, y = D (φ - B x), and what these take
from the first, -A⁻¹ Bᵀ y: see ``solve_kernels._add_adjoint``. Floating conductors of the design
follow: columns are of electrodes, what floats mixed in. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.green_kernels import FAR_LEAST, NEAR_LEAST
from capsense.fleet.warp_cut import SOURCES, Leaf, Places, Response, Shapes, WarpCut, many
from capsense.fleet.warp_kernels import bound, four_units, leaf_of, mean, more, own
from capsense.fleet.warp_left import COLUMNS, some
from capsense.fleet.warp_solve import Circuit, Left
from capsense.surface.pair_kernels import FAR
from capsense.surface.solve_kernels import GAIN

wp.set_module_options({"enable_backward": False, "fast_math": True})

pulls = wp.types.matrix(shape=(COLUMNS, 6), dtype=wp.float32)
_SOURCES, _COLUMNS = wp.constant(SOURCES), wp.constant(COLUMNS)
_FAR, _GAIN = wp.constant(FAR), wp.constant(GAIN)
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)


@wp.kernel
def follow(circuit: Circuit, whole: wp.array3d(dtype=wp.vec2d), out: wp.array3d(dtype=wp.float32)):
    """Potential of each terminal while an electrode is at 1 V, (t, n, v); floating ones follow.

    ``whole`` is as ``eliminate`` leaves it: row p of a floating conductor holds its coupling with
    those before it, these still in the network.
    """
    j, v = wp.tid()
    for a in range(whole.shape[0]):
        volts = float(0.0)
        if a == j:
            volts = 1.0
        if a >= circuit.driven:
            charge = wp.float32(0.0)
            for c in range(a):
                charge += wp.float32(whole[a, c, v][0] / whole[a, a, v][0]) * out[c, j, v]
            volts = -charge
        out[a, j, v] = volts


@wp.kernel
def followed(
    circuit: Circuit, turn: wp.array3d(dtype=wp.float32), first: wp.array3d(dtype=wp.float32),
    other: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Columns of electrodes from the sum of those of terminals, (x, lead, v).

    What floats is mixed in. The first sum may have fewer rows.
    """
    x, j, v = wp.tid()
    total = float(0.0)
    if j < circuit.electrodes:
        for a in range(turn.shape[0]):
            if a == j or a >= circuit.driven:
                value = other[x, a, v]
                if x < first.shape[0]:
                    value += first[x, a, v]
                total += value * turn[a, j, v]
    out[x, j, v] = total


@wp.func
def _body(cut: WarpCut, clusters: int, leaf: int):
    """Whose leaf it is."""
    n = cut.number.shape[0]
    return wp.where(leaf < n, leaf // clusters, (leaf - n) // (2 * clusters))


@wp.func
def _columns(values: wp.array3d(dtype=wp.float32), row: int, first: int, v: int):
    out = some()
    for c in range(_COLUMNS):
        out[c] = values[row, first + c, v]
    return out


@wp.kernel
def estimated(cut: WarpCut, left: Left, out: wp.array3d(dtype=wp.float32)):
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
    green: Response, cut: WarpCut, far: int, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Potentials at the near or the far sources by charges on parts of clusters, (s, lead, v)."""
    s, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = some()
    for i in range(cut.number.shape[0], cut.node.shape[0]):
        share = wp.where(far == 0, cut.near[i, v], 1.0 - cut.near[i, v])
        share *= 0.25 * (1.0 - cut.beyond[i, v])
        if cut.node[i, v] >= 0 and share > 0.0:
            p0 = cut.points[i, 0, v]
            p1 = cut.points[i, 1, v]
            p2 = cut.points[i, 2, v]
            p3 = cut.points[i, 3, v]
            if far == 0:
                share *= four_units(p0, p1, p2, p3, green.near[s], green.floor, _NEAR_LEAST)
            else:
                share *= four_units(p0, p1, p2, p3, green.far[s], green.floor, _FAR_LEAST)
            total += share * _columns(charge, i, first, v)
    for c in range(_COLUMNS):
        out[s, first + c, v] = total[c]


@wp.func
def _answer(
    table: wp.array2d(dtype=many), column: int, values: wp.array3d(dtype=wp.float32), first: int,
    v: int,
):  # fmt: skip
    total = some()
    if column < table.shape[0]:
        for batch in range(table.shape[1]):
            few = table[column, batch]
            for s in range(wp.min(_SOURCES, values.shape[0] - _SOURCES * batch)):
                total += few[s] * _columns(values, _SOURCES * batch + s, first, v)
    return total


@wp.kernel
def answered(
    green: Response, cut: WarpCut, near: wp.array3d(dtype=wp.float32),
    far: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Sums of ψ over charges from their potentials at the sources, (modes, lead, v)."""
    k, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = some()
    if green.lead + k < cut.width[v]:
        total = _answer(green.near_columns, green.lead + k, near, first, v)
        total += _answer(green.far_columns, green.lead + k, far, first, v)
    for c in range(_COLUMNS):
        out[k, first + c, v] = total[c]


@wp.kernel
def energies_below(
    shapes: Shapes, places: Places, cut: WarpCut, clusters: int,
    charge: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Energies of the shapes' functions with charges on parts of clusters, (n, lead, v)."""
    j, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    n = cut.number.shape[0]
    b = j // clusters
    total = some()
    y = wp.where(j == b * clusters, 0, cut.number[j, v])
    if cut.node[b * clusters, v] >= 0 and y >= 0:
        for k in range(b * clusters, (b + 1) * clusters):
            if cut.node[n + 2 * k, v] >= 0:
                x = shapes.function[cut.node[k, v]]
                value = own(shapes, places, v // places.hidden.shape[0], b, x, y)
                total += value[0] * _columns(charge, n + 2 * k, first, v)
    for c in range(_COLUMNS):
        out[j, first + c, v] = total[c]


@wp.kernel
def pairs_below(
    green: Response, cut: WarpCut, clusters: int, charge: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Add potentials on clusters of charges on parts of clusters, (n, lead, v)."""
    i, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    if cut.node[i, v] < 0:
        return
    total = some()
    leaf = leaf_of(cut, i, v)
    for j in range(cut.number.shape[0], cut.node.shape[0]):
        if cut.node[j, v] >= 0:
            value = -mean(leaf, cut, j, v, 1.0, green.floor)
            if _body(cut, clusters, j) != i // clusters:
                value += mean(leaf, cut, j, v, 0.0, green.floor)
            elif leaf.lifted + cut.lifted[j, v] > 0:
                value += more(leaf, cut, j, v)
            total += value * _columns(charge, j, first, v)
    for c in range(_COLUMNS):
        out[i, first + c, v] = out[i, first + c, v] + total[c]


@wp.kernel
def withdrawn(
    cut: WarpCut, lead: int, matrix: wp.array3d(dtype=wp.float32),
    rows: wp.array3d(dtype=wp.float32), sums: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Charges of the functions, -A⁻¹ times the potentials in place less those of the modes."""
    c, v = wp.tid()
    n = matrix.shape[0]
    for i in range(n):
        total = float(0.0)
        if cut.number[i, v] >= 0 and matrix[i, i, v] > 0.0:
            total = -out[i, c, v]
            for k in range(lead, cut.width[v]):
                total += rows[i, k, v] * sums[k - lead, c, v]
            for k in range(i):
                total -= matrix[i, k, v] * out[k, c, v]
            total = total / matrix[i, i, v]
        out[i, c, v] = total
    for step in range(n):
        i = n - 1 - step
        if matrix[i, i, v] > 0.0:
            total = out[i, c, v]
            for k in range(i + 1, n):
                total -= matrix[k, i, v] * out[k, c, v]
            out[i, c, v] = total / matrix[i, i, v]


@wp.func
def _source(p: wp.vec3, source: wp.vec3, floor: float, least: float):
    """Gradient of the potential of a unit charge and of its image in the floor."""
    d = p - source
    e = wp.vec3(d[0], d[1], p[2] + source[2] - 2.0 * floor)
    square = wp.dot(d, d)
    away = 1.0 / wp.sqrt(wp.dot(e, e))
    near = 1.0 / wp.sqrt(wp.max(square, least * least))
    near = wp.where(square > least * least, near * near * near, 0.0)
    return (away * away * away) * e - near * d


@wp.func
def _sources(
    leaf: Leaf, sources: wp.array(dtype=wp.vec3), strength: wp.array3d(dtype=wp.float32),
    floor: float, least: float, origin: wp.vec3, first: int, v: int,
):  # fmt: skip
    """Forces on a leaf, and torques about an origin, by sources: columns from ``first`` on."""
    out = pulls()
    for s in range(sources.shape[0]):
        source = sources[s]
        f0 = _source(leaf.p0, source, floor, least)
        f1 = _source(leaf.p1, source, floor, least)
        f2 = _source(leaf.p2, source, floor, least)
        f3 = _source(leaf.p3, source, floor, least)
        torque = wp.cross(leaf.p0 - origin, f0) + wp.cross(leaf.p1 - origin, f1)
        torque += wp.cross(leaf.p2 - origin, f2) + wp.cross(leaf.p3 - origin, f3)
        pull = wp.spatial_vector(f0 + f1 + f2 + f3, torque)
        out += wp.outer(_columns(strength, s, first, v), pull)
    return out


@wp.func
def _near(d: wp.vec3, fourth: float):
    """Gradient of a bounded 1/r."""
    square = wp.dot(d, d)
    whole = wp.sqrt(square * square + fourth)
    return -square / (whole * whole * wp.sqrt(whole)) * d


@wp.func
def _pair(cut: WarpCut, i: int, j: int, v: int, mirrored: float, floor: float, origin: wp.vec3):
    """Force on cluster i, and torque about an origin, of the mean of 1/r to another."""
    flip = wp.vec3(1.0, 1.0, 1.0 - 2.0 * mirrored)
    lift = wp.vec3(0.0, 0.0, 2.0 * mirrored * floor)
    a0 = cut.points[i, 0, v]
    a3 = cut.points[i, 3, v]
    b0 = wp.cw_mul(flip, cut.points[j, 0, v]) + lift
    b3 = wp.cw_mul(flip, cut.points[j, 3, v]) + lift
    d = 0.5 * (a0 + a3 - b0 - b3)
    square = wp.dot(d, d)
    size = cut.extent[i, v] + cut.extent[j, v]
    force = wp.vec3()
    torque = wp.vec3()
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a0 - cut.points[i, 1, v])
        y = 0.5 * (a0 - cut.points[i, 2, v])
        z = 0.5 * (b0 - wp.cw_mul(flip, cut.points[j, 1, v]) - lift)
        w = 0.5 * (b0 - wp.cw_mul(flip, cut.points[j, 2, v]) - lift)
        inverse = 1.0 / wp.sqrt(square)
        third = inverse * inverse * inverse
        fifth = third * inverse * inverse
        whole = wp.dot(x, x) + wp.dot(y, y) + wp.dot(z, z) + wp.dot(w, w)
        ax = wp.dot(x, d)
        ay = wp.dot(y, d)
        az = wp.dot(z, d)
        aw = wp.dot(w, d)
        along = ax * ax + ay * ay + az * az + aw * aw
        force = -third * d + 1.5 * fifth * whole * d
        force += fifth * (3.0 * (ax * x + ay * y + az * z + aw * w) - 7.5 * along / square * d)
        torque = wp.cross(0.5 * (a0 + a3) - origin, force)
        torque += 3.0 * fifth * wp.cross(ax * x + ay * y, d)
    else:
        fourth = bound(cut, i, j, v)
        for p in range(4):
            a = cut.points[i, p, v]
            pull = wp.vec3()
            for q in range(4):
                pull += _near(a - wp.cw_mul(flip, cut.points[j, q, v]) - lift, fourth)
            force += pull / 16.0
            torque += wp.cross(a - origin, pull) / 16.0
    return wp.spatial_vector(force, torque)


@wp.kernel
def forces(
    green: Response, cut: WarpCut, clusters: int, charge: wp.array3d(dtype=wp.float32),
    near: wp.array3d(dtype=wp.float32), far: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Gradient of electrodes' potentials at each leaf, and its torque about its body's origin.

    Shape (l, lead, v).
    """
    i, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    total = pulls()
    if cut.node[i, v] >= 0:
        body = _body(cut, clusters, i)
        origin = wp.transform_get_translation(cut.pose[body, v])
        leaf = leaf_of(cut, i, v)
        inner = 0.25 * (1.0 - leaf.beyond)
        floor = green.floor
        if leaf.near > 0.0 and inner > 0.0:
            total += (inner * leaf.near) * _sources(
                leaf, green.near, near, floor, _NEAR_LEAST, origin, first, v
            )
        if leaf.near < 1.0 and inner > 0.0:
            total += (inner - inner * leaf.near) * _sources(
                leaf, green.far, far, floor, _FAR_LEAST, origin, first, v
            )
        for j in range(cut.node.shape[0]):
            if cut.node[j, v] >= 0:
                pull = _pair(cut, i, j, v, 1.0, floor, origin)
                if _body(cut, clusters, j) != body:
                    pull -= _pair(cut, i, j, v, 0.0, floor, origin)
                total += wp.outer(_columns(charge, j, first, v), pull)
    for c in range(_COLUMNS):
        out[i, first + c, v] = wp.spatial_vector(
            total[c, 0], total[c, 1], total[c, 2], total[c, 3], total[c, 4], total[c, 5]
        )


@wp.kernel
def slopes(
    circuit: Circuit, cut: WarpCut, clusters: int,
    charge: wp.array3d(dtype=wp.float32), pull: wp.array3d(dtype=wp.spatial_vector),
    out: wp.array4d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Derivative of the matrices by the pose of each body [F/m], [F/rad], (v, b, n, n)."""
    b, i, v = wp.tid()
    for j in range(circuit.electrodes):
        total = wp.spatial_vector()
        for f in range(cut.node.shape[0]):
            if _body(cut, clusters, f) == b and cut.node[f, v] >= 0:
                total += charge[f, i, v] * pull[f, j, v] + charge[f, j, v] * pull[f, i, v]
        force = wp.spatial_top(total)
        torque = wp.spatial_bottom(total) + wp.cross(cut.moved[b, v], force)
        out[v, b, i, j] = circuit.unit * wp.spatial_vector(force, torque)
