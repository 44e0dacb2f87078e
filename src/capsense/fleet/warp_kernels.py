"""The step of many environments as Warp kernels: potentials, pairs, and the matrix.

The twin of these kernels is :mod:`capsense.surface.step` with the same cut; see
:mod:`capsense.fleet.warp_cut` for what they work with. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.green_kernels import FAR_LEAST, NEAR_LEAST
from capsense.fleet.warp_cut import WIDTH, Leaf, Places, Response, Shapes, WarpCut, row, smooth
from capsense.surface.pair_kernels import _WIDE as WIDE
from capsense.surface.pair_kernels import BARRIER, FAR

wp.set_module_options({"enable_backward": False, "fast_math": True})

_FAR = wp.constant(FAR)
_BARRIER, _STIFF = wp.constant(BARRIER), wp.constant(600.0)
"""Energy of charge that is out of reach [1/m]; with losses at most the second number [m] over the
square of a large cluster's extent: more of it would hide what is in reach, see ``warp_cut.weigh``.
"""
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)
_WIDTH = wp.constant(WIDTH)
_WIDE = wp.constant(WIDE)


@wp.func
def _unit(p: wp.vec3, source: wp.vec3, floor: float, least: float):
    """Potential of a unit charge and its image in the floor."""
    dx = p[0] - source[0]
    dy = p[1] - source[1]
    dz = p[2] - source[2]
    ez = p[2] + source[2] - 2.0 * floor
    across = dx * dx + dy * dy
    return 1.0 / wp.sqrt(wp.max(across + dz * dz, least * least)) - 1.0 / wp.sqrt(across + ez * ez)


@wp.func
def four_units(
    p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, p3: wp.vec3, source: wp.vec3, floor: float, least: float
):
    """The sum of that over four points."""
    return (_unit(p0, source, floor, least) + _unit(p1, source, floor, least)
            + _unit(p2, source, floor, least) + _unit(p3, source, floor, least))  # fmt: skip


@wp.kernel
def rows(green: Response, cut: WarpCut, out: wp.array3d(dtype=wp.float32)):
    """Means of φ⁰ and ψ over all clusters, (n, w, v), up to a view's width: 64 columns a thread."""
    i, part, v = wp.tid()
    if part * _WIDTH >= cut.width[v]:
        return
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
                value = four_units(p0, p1, p2, p3, q, green.floor, _FAR_LEAST)
                total += (1.0 - near) * inner * value * green.far_table[s, part]
        if near > 0.0 and inner > 0.0:
            for s in range(green.near.shape[0]):
                q = green.near[s]
                value = four_units(p0, p1, p2, p3, q, green.floor, _NEAR_LEAST)
                total += near * inner * value * green.near_table[s, part]
    for c in range(_WIDTH):
        out[i, part * _WIDTH + c, v] = total[c]


@wp.func
def leaf_of(cut: WarpCut, i: int, v: int):
    """A cluster's points, and the distance below which 1/r from them is bounded."""
    out = Leaf()
    out.p0 = cut.points[i, 0, v]
    out.p1 = cut.points[i, 1, v]
    out.p2 = cut.points[i, 2, v]
    out.p3 = cut.points[i, 3, v]
    out.u0 = cut.unlifted[i, 0, v]
    out.u1 = cut.unlifted[i, 1, v]
    out.u2 = cut.unlifted[i, 2, v]
    out.u3 = cut.unlifted[i, 3, v]
    out.lifted = cut.lifted[i, v]
    out.extent = cut.extent[i, v]
    out.soft = cut.soft[i, v]
    out.beyond = cut.beyond[i, v]
    out.near = cut.near[i, v]
    return out


@wp.func
def mean(a: Leaf, cut: WarpCut, j: int, v: int, mirrored: float, floor: float):
    """Mean of 1/r between two clusters, the second one mirrored in the floor where that is 1."""
    flip = wp.vec3(1.0, 1.0, 1.0 - 2.0 * mirrored)
    lift = wp.vec3(0.0, 0.0, 2.0 * mirrored * floor)
    b0 = wp.cw_mul(flip, cut.points[j, 0, v]) + lift
    b1 = wp.cw_mul(flip, cut.points[j, 1, v]) + lift
    b2 = wp.cw_mul(flip, cut.points[j, 2, v]) + lift
    b3 = wp.cw_mul(flip, cut.points[j, 3, v]) + lift
    d = 0.5 * (a.p0 + a.p3 - b0 - b3)
    square = wp.dot(d, d)
    size = a.extent + cut.extent[j, v]
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a.p0 - a.p1)
        y = 0.5 * (a.p0 - a.p2)
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
    fourth = _fourth(wp.max(a.soft, cut.soft[j, v]))
    return _between(a, b0, b1, b2, b3, fourth)


@wp.func
def _between(a: Leaf, b0: wp.vec3, b1: wp.vec3, b2: wp.vec3, b3: wp.vec3, fourth: float):
    """Mean of a bounded 1/r between a cluster and four points."""
    return 0.25 * (
        _four(a.p0, b0, b1, b2, b3, fourth) + _four(a.p1, b0, b1, b2, b3, fourth)
        + _four(a.p2, b0, b1, b2, b3, fourth) + _four(a.p3, b0, b1, b2, b3, fourth)
    )  # fmt: skip


@wp.func
def _fourth(near: float):
    return near * near * near * near + 1.0e-24


@wp.func
def bound(cut: WarpCut, i: int, j: int, v: int):
    """Fourth power of the distance below which 1/r of two clusters is bounded."""
    return _fourth(wp.max(cut.soft[i, v], cut.soft[j, v]))


@wp.func
def more(a: Leaf, cut: WarpCut, j: int, v: int):
    """What two clusters of a body meet each other more for being lifted off the design."""
    fourth = _fourth(wp.max(a.soft, cut.soft[j, v]))
    total = float(0.0)
    for q in range(4):
        b = cut.points[j, q, v]
        total += _four(b, a.p0, a.p1, a.p2, a.p3, fourth)
        b = cut.unlifted[j, q, v]
        total -= _four(b, a.u0, a.u1, a.u2, a.u3, fourth)
    return 0.25 * total


@wp.func
def _four(a: wp.vec3, b0: wp.vec3, b1: wp.vec3, b2: wp.vec3, b3: wp.vec3, fourth: float):
    """Mean of a bounded 1/r between a point and four others."""
    return 0.25 * (_soft(a - b0, fourth) + _soft(a - b1, fourth)
                   + _soft(a - b2, fourth) + _soft(a - b3, fourth))  # fmt: skip


@wp.func
def _soft(d: wp.vec3, fourth: float):
    square = wp.dot(d, d)
    return 1.0 / wp.sqrt(wp.sqrt(square * square + fourth))


@wp.kernel
def pairs(green: Response, cut: WarpCut, clusters: int, out: wp.array3d(dtype=wp.float32)):
    """Mean of 1/r between bodies, and of -1/r to images in the floor, (n, n, v).

    They are added to what :func:`energies` and :func:`from_functions` left, in views that have it.
    """
    i, j, v = wp.tid()
    if j > i:
        return
    value = float(0.0)
    if cut.node[i, v] >= 0 and cut.node[j, v] >= 0:
        leaf = leaf_of(cut, i, v)
        if cut.walled[v] != 0:
            value = out[i, j, v]
        value -= mean(leaf, cut, j, v, 1.0, green.floor)
        if i // clusters != j // clusters:
            value += mean(leaf, cut, j, v, 0.0, green.floor)
        elif i != j and leaf.lifted + cut.lifted[j, v] > 0:
            value += more(leaf, cut, j, v)
        if i == j:
            x = cut.beyond[i, v]
            barrier = _BARRIER
            if cut.walled[v] == 0:
                barrier = wp.min(barrier, _STIFF / (cut.extent[i, v] * cut.extent[i, v]))
            value += barrier * x * x * x
    out[i, j, v] = value
    out[j, i, v] = value


@wp.kernel
def bound_images(
    green: Response, cut: WarpCut, rows: wp.array3d(dtype=wp.float32),
    pairs: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Let no cluster meet its images more than in a mirror, as ``pair_kernels.bound_images``."""
    i, v = wp.tid()
    if cut.node[i, v] < 0 or green.cover > 1.0:
        return
    leaf = leaf_of(cut, i, v)
    face = green.box1[2]
    least = wp.min(wp.min(leaf.p0[2], leaf.p1[2]), wp.min(leaf.p2[2], leaf.p3[2])) - face
    inverse = 0.25 * (
        1.0 / wp.max(leaf.p0[2] - face, 1e-9) + 1.0 / wp.max(leaf.p1[2] - face, 1e-9)
        + 1.0 / wp.max(leaf.p2[2] - face, 1e-9) + 1.0 / wp.max(leaf.p3[2] - face, 1e-9)
    )  # fmt: skip
    side = wp.sqrt(3.0 * wp.length(leaf.p0 - leaf.p1) * wp.length(leaf.p0 - leaf.p2))
    if inverse * side < _WIDE or least < 0.0:
        return
    leaf.soft = 0.0
    met = _imaged(leaf, green.floor)
    for k in range(green.lead, cut.width[v]):
        met += rows[i, k, v] * rows[i, k, v]
    extra = met - _mirror(2.0 / (inverse * side)) / side
    pairs[i, i, v] = pairs[i, i, v] + wp.max(extra, 0.0) * smooth(10.0 * extra / met)


@wp.func
def _imaged(a: Leaf, floor: float):
    """Mean of 1/r between a cluster and its own image in the floor, point by point."""
    flip = wp.vec3(1.0, 1.0, -1.0)
    lift = wp.vec3(0.0, 0.0, 2.0 * floor)
    b0 = wp.cw_mul(flip, a.p0) + lift
    b1 = wp.cw_mul(flip, a.p1) + lift
    b2 = wp.cw_mul(flip, a.p2) + lift
    b3 = wp.cw_mul(flip, a.p3) + lift
    fourth = _fourth(0.0)
    return _between(a, b0, b1, b2, b3, fourth)


@wp.func
def _mirror(t: float):
    """Mean of 1/r between parallel unit squares a distance t apart, one above the other."""
    square = t * t
    a = wp.sqrt(1.0 + square)
    b = wp.sqrt(2.0 + square)
    whole = 2.0 * wp.log((1.0 + b) / a) - t * wp.atan(1.0 / (t * b))
    first = 0.5 * (b + (1.0 + square) * wp.log((1.0 + b) / a))
    first -= 0.5 * (a + square * wp.log((1.0 + a) / t))
    return 4.0 * (whole - 2.0 * first + (b * b * b - 2.0 * a * a * a + t * t * t) / 3.0)


@wp.kernel
def to_functions(cut: WarpCut, clusters: int, limited: int, values: wp.array3d(dtype=wp.float32)):
    """Integrate what clusters have in the first index with the charge functions, in place.

    ``limited`` says that the second index is of columns, of which a view has its width.
    """
    c, v = wp.tid()
    if limited != 0 and c >= cut.width[v]:
        return
    for b in range(cut.leader.shape[0]):
        o = b * clusters
        for k in range(clusters - 1):
            j = clusters - 1 - k
            if cut.number[o + j, v] >= 0:
                i = o + cut.split[o + j, v]
                x = values[i, c, v]
                y = values[o + j, c, v]
                p = cut.mix[o + j, v]
                values[i, c, v] = p * x + (1.0 - p) * y
                values[o + j, c, v] = x - y
        leader = cut.leader[b, v]
        if leader != b:
            values[o, c, v] -= values[leader * clusters, c, v]


@wp.func
def own(shapes: Shapes, places: Places, e: int, b: int, x: int, y: int):
    """Energy of two functions of a body, complex."""
    u = places.choice[e, b]
    place = shapes.block[u] + wp.int64(x * shapes.functions[u] + y)
    out = wp.vec2(shapes.energy[place], 0.0)
    inside = places.softness[e, b]
    if inside[0] != 0.0 or inside[1] != 0.0:
        out += inside * shapes.impedance[place]
    return out / places.scale[e, b]


@wp.kernel
def energies(
    shapes: Shapes, places: Places, cut: WarpCut, clusters: int, out: wp.array3d(dtype=wp.float32)
):
    """Energies of the shapes' functions, (n, n, v), where views have others, see ``weigh``."""
    i, j, v = wp.tid()
    if cut.walled[v] == 0:
        return
    b = i // clusters
    value = float(0.0)
    if b == j // clusters and cut.node[b * clusters, v] >= 0:
        x = wp.where(i % clusters == 0, 0, cut.number[i, v])
        y = wp.where(j % clusters == 0, 0, cut.number[j, v])
        if x >= 0 and y >= 0:
            value = own(shapes, places, v // places.hidden.shape[0], b, x, y)[0]
    out[i, j, v] = value


@wp.kernel
def from_functions(
    cut: WarpCut, clusters: int, walled: int, values: wp.array3d(dtype=wp.float32)
):  # fmt: skip
    """What clusters have of what the shapes' functions have in the first index, in place.

    ``walled`` asks for it only in views whose functions are others, see ``weigh``.
    """
    c, v = wp.tid()
    if cut.walled[v] < walled:
        return
    for b in range(cut.leader.shape[0]):
        o = b * clusters
        for k in range(1, clusters):
            if cut.number[o + k, v] >= 0:
                i = o + cut.split[o + k, v]
                whole = values[i, c, v]
                apart = values[o + k, c, v]
                p = cut.part[o + k, v]
                values[i, c, v] = whole + (1.0 - p) * apart
                values[o + k, c, v] = whole - p * apart


@wp.kernel
def assemble(
    shapes: Shapes, places: Places, cut: WarpCut, clusters: int, lead: int,
    potentials: wp.array3d(dtype=wp.float32), matrix: wp.array3d(dtype=wp.float32),
    loss: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """The matrix of all functions from their pairs, in place: its real part in the lower half.

    The imaginary part is in the upper half, and that of the diagonal in ``loss``.
    """
    f, g, v = wp.tid()
    if g > f:
        return
    e = v // places.hidden.shape[0]
    x = cut.number[f, v]
    y = cut.number[g, v]
    value = wp.vec2(wp.where(f == g, 1.0, 0.0), 0.0)
    if x >= 0 and y >= 0:
        value = wp.vec2(matrix[f, g, v], 0.0)
        for k in range(lead, cut.width[v]):
            value[0] -= potentials[f, k, v] * potentials[g, k, v]
        b = f // clusters
        c = g // clusters
        apart = cut.walled[v] == 0  # else the pairs have the shapes' energies
        first = cut.leader[b, v]
        other = cut.leader[c, v]
        joined = f == b * clusters and first != b
        another = g == c * clusters and other != c
        if b == c:
            if apart:
                value += own(shapes, places, e, b, x, y)
            if x == 0 and y == 0 and not joined:
                value += cut.tie[b, v]
        if apart and joined and first == c:
            value -= own(shapes, places, e, c, 0, y)
        if apart and another and other == b:
            value -= own(shapes, places, e, b, x, 0)
        if apart and joined and another and first == other:
            value += own(shapes, places, e, first, 0, 0)
    matrix[f, g, v] = value[0]
    if f == g:
        loss[f, v] = value[1]
    else:
        matrix[g, f, v] = value[1]
