"""The step of many environments as Warp kernels: potentials, pairs, and the solution.

The twin of these kernels is :mod:`capsense.surface.step` with the same cut; see
:mod:`capsense.fleet.warp_cut` for what they work with. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.green_kernels import FAR_LEAST, NEAR_LEAST
from capsense.fleet.warp_cut import WIDTH, Places, Response, Shapes, WarpCut, row
from capsense.surface.pair_kernels import BARRIER, FAR, SOFT

wp.set_module_options({"enable_backward": False, "fast_math": True})

_DROPPED = wp.constant(1e-5)
"""Functions whose pivot is so small against their own energy are left out."""
_SOFT, _FAR, _BARRIER = wp.constant(SOFT), wp.constant(FAR), wp.constant(BARRIER)
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)
_WIDTH = wp.constant(WIDTH)


@wp.func
def _unit(p: wp.vec3, source: wp.vec3, floor: float, least: float):
    """Potential of a unit charge and its image in the floor."""
    dx = p[0] - source[0]
    dy = p[1] - source[1]
    dz = p[2] - source[2]
    ez = p[2] + source[2] - 2.0 * floor
    across = dx * dx + dy * dy
    return 1.0 / wp.sqrt(wp.max(across + dz * dz, least * least)) - 1.0 / wp.sqrt(across + ez * ez)


@wp.kernel
def rows(green: Response, cut: WarpCut, out: wp.array3d(dtype=wp.float32)):
    """Means of φ⁰ and ψ over all clusters, (n, w, v): 64 columns a thread."""
    i, part, v = wp.tid()
    total = row()
    if cut.node[i, v] >= 0:
        p0 = cut.points[i, 0, v]
        p1 = cut.points[i, 1, v]
        p2 = cut.points[i, 2, v]
        p3 = cut.points[i, 3, v]
        inner = 0.25 * (1.0 - cut.beyond[i, v])
        near = cut.near[i, v]
        if near < 1.0 and inner > 0.0 and part < green.far_table.shape[1]:
            for s in range(green.far.shape[0]):
                q = green.far[s]
                value = (
                    _unit(p0, q, green.floor, _FAR_LEAST) + _unit(p1, q, green.floor, _FAR_LEAST)
                    + _unit(p2, q, green.floor, _FAR_LEAST) + _unit(p3, q, green.floor, _FAR_LEAST)
                )  # fmt: skip
                total += (1.0 - near) * inner * value * green.far_table[s, part]
        if near > 0.0 and inner > 0.0:
            for s in range(green.near.shape[0]):
                q = green.near[s]
                value = (
                    _unit(p0, q, green.floor, _NEAR_LEAST) + _unit(p1, q, green.floor, _NEAR_LEAST)
                    + _unit(p2, q, green.floor, _NEAR_LEAST)
                    + _unit(p3, q, green.floor, _NEAR_LEAST)
                )  # fmt: skip
                total += near * inner * value * green.near_table[s, part]
    for c in range(_WIDTH):
        out[i, part * _WIDTH + c, v] = total[c]


@wp.func
def _mean(cut: WarpCut, i: int, j: int, v: int, mirrored: float, floor: float):
    """Mean of 1/r between two clusters, the second one mirrored in the floor where that is 1."""
    a0 = cut.points[i, 0, v]
    a1 = cut.points[i, 1, v]
    a2 = cut.points[i, 2, v]
    a3 = cut.points[i, 3, v]
    flip = wp.vec3(1.0, 1.0, 1.0 - 2.0 * mirrored)
    lift = wp.vec3(0.0, 0.0, 2.0 * mirrored * floor)
    b0 = wp.cw_mul(flip, cut.points[j, 0, v]) + lift
    b1 = wp.cw_mul(flip, cut.points[j, 1, v]) + lift
    b2 = wp.cw_mul(flip, cut.points[j, 2, v]) + lift
    b3 = wp.cw_mul(flip, cut.points[j, 3, v]) + lift
    d = 0.5 * (a0 + a3 - b0 - b3)
    square = wp.dot(d, d)
    size = cut.extent[i, v] + cut.extent[j, v]
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a0 - a1)
        y = 0.5 * (a0 - a2)
        z = 0.5 * (b0 - b1)
        w = 0.5 * (b0 - b2)
        inverse = 1.0 / wp.sqrt(square)
        second = inverse * inverse
        whole = wp.dot(x, x) + wp.dot(y, y) + wp.dot(z, z) + wp.dot(w, w)
        ax = wp.dot(x, d)
        ay = wp.dot(y, d)
        az = wp.dot(z, d)
        aw = wp.dot(w, d)
        along = 3.0 * (ax * ax + ay * ay + az * az + aw * aw) * second
        return inverse * (1.0 + 0.5 * (along - whole) * second)
    bound = _SOFT * wp.max(cut.extent[i, v], cut.extent[j, v])
    fourth = bound * bound * bound * bound + 1.0e-24
    total = float(0.0)
    for p in range(4):
        a = cut.points[i, p, v]
        total += _soft(a - b0, fourth) + _soft(a - b1, fourth)
        total += _soft(a - b2, fourth) + _soft(a - b3, fourth)
    return total / 16.0


@wp.func
def _soft(d: wp.vec3, fourth: float):
    square = wp.dot(d, d)
    return 1.0 / wp.sqrt(wp.sqrt(square * square + fourth))


@wp.kernel
def pairs(green: Response, cut: WarpCut, clusters: int, out: wp.array3d(dtype=wp.float32)):
    """Mean of 1/r between bodies, and of -1/r to images in the floor, (n, n, v)."""
    i, j, v = wp.tid()
    if j > i:
        return
    value = float(0.0)
    if cut.node[i, v] >= 0 and cut.node[j, v] >= 0:
        value = -_mean(cut, i, j, v, 1.0, green.floor)
        if i // clusters != j // clusters:
            value += _mean(cut, i, j, v, 0.0, green.floor)
        if i == j:
            x = cut.beyond[i, v]
            value += _BARRIER * x * x * x
    out[i, j, v] = value
    out[j, i, v] = value


@wp.kernel
def to_functions(cut: WarpCut, clusters: int, values: wp.array3d(dtype=wp.float32)):
    """Integrate what clusters have in the first index with the charge functions, in place."""
    b, c, v = wp.tid()
    o = b * clusters
    for k in range(clusters - 1):
        j = clusters - 1 - k
        if cut.number[o + j, v] >= 0:
            i = o + cut.split[o + j, v]
            x = values[i, c, v]
            y = values[o + j, c, v]
            p = cut.part[o + j, v]
            values[i, c, v] = p * x + (1.0 - p) * y
            values[o + j, c, v] = x - y


@wp.kernel
def assemble(
    shapes: Shapes, places: Places, cut: WarpCut, sensors: int, clusters: int, lead: int,
    potentials: wp.array3d(dtype=wp.float32), matrix: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """The matrix of all functions, its lower half, from their pairs; in place."""
    f, g, v = wp.tid()
    if g > f:
        return
    e = v // sensors
    x = cut.number[f, v]
    y = cut.number[g, v]
    if x < 0 or y < 0:
        matrix[f, g, v] = wp.where(f == g, 1.0, 0.0)
        return
    value = matrix[f, g, v]
    for k in range(lead, potentials.shape[1]):
        value -= potentials[f, k, v] * potentials[g, k, v]
    b = f // clusters
    if b == g // clusters:
        u = places.choice[e, b]
        place = shapes.block[u] + wp.int64(x * shapes.functions[u] + y)
        inside = places.softness[e, b]
        own = shapes.energy[place]
        if inside != 0.0:
            own += inside * shapes.impedance[place]
        value += own / places.scale[e, b]
        if x == 0 and y == 0:
            value += places.tie[e, b]
    matrix[f, g, v] = value


@wp.kernel
def factorise(
    cut: WarpCut, matrix: wp.array3d(dtype=wp.float32), terminals: int,
    potentials: wp.array3d(dtype=wp.float32), dropped: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Cholesky factor L of every matrix; φ⁰ of the functions is replaced by L⁻¹ φ⁰."""
    v = wp.tid()
    n = matrix.shape[0]
    lost = int(0)
    for i in range(n):
        if cut.number[i, v] < 0:
            for t in range(terminals):
                potentials[i, t, v] = 0.0
        else:
            for j in range(i):
                total = matrix[i, j, v]
                for k in range(j):
                    total -= matrix[i, k, v] * matrix[j, k, v]
                matrix[i, j, v] = total / matrix[j, j, v]
            own = matrix[i, i, v]
            total = own
            for k in range(i):
                total -= matrix[i, k, v] * matrix[i, k, v]
            keep = float(1.0)
            if total > _DROPPED * wp.abs(own):
                matrix[i, i, v] = wp.sqrt(total)
            else:
                lost += 1
                keep = 0.0
                matrix[i, i, v] = 1.0
                for k in range(i):
                    matrix[i, k, v] = 0.0
            for t in range(terminals):
                right = keep * potentials[i, t, v]
                for k in range(i):
                    right -= matrix[i, k, v] * potentials[k, t, v]
                potentials[i, t, v] = right / matrix[i, i, v]
    dropped[v] = lost


@wp.kernel
def change(
    green: Response, functions: int, potentials: wp.array3d(dtype=wp.float32),
    capacitance: wp.array4d(dtype=wp.float32), delta: wp.array4d(dtype=wp.float32),
):  # fmt: skip
    """Maxwell matrices of the electrodes and their change [F], (e, s, m, m)."""
    i, j, v = wp.tid()
    e = v // delta.shape[1]
    s = v % delta.shape[1]
    total = float(0.0)
    for f in range(functions):
        total += potentials[f, i, v] * potentials[f, j, v]
    total = wp.min(green.unit * total, green.screened[i, j])
    delta[e, s, i, j] = total
    capacitance[e, s, i, j] = green.empty[i, j] + total
