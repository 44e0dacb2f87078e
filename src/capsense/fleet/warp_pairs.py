"""The step of many environments as Warp kernels: potentials on leaves, pairs of them, and forces.

The twins of these kernels are :mod:`capsense.solver.placement.placement_kernels`, ``pair_kernels``
and ``gradient_kernels``; see :mod:`capsense.fleet.warp_cut` for what they work with. Lengths in
metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.face_kernels import FADED, WALL_PENALTY
from capsense.field.green_kernels import LEAST
from capsense.fleet.warp_cut import (
    WIDTH,
    Response,
    WarpActiveTree,
    at_edges,
    four,
    idle,
    is_free,
    lift_back,
    off_box,
    off_walls,
    row,
    smooth,
)
from capsense.solver.interaction.pair_kernels import WIDE_CLUSTER
from capsense.solver.tree.mean_kernels import FAR

wp.set_module_options({"enable_backward": False, "fast_math": True})

COLUMNS = 8
"""Columns that a thread works out at a time."""
some = wp.types.vector(length=COLUMNS, dtype=wp.float32)
pulls = wp.types.matrix(shape=(COLUMNS, 6), dtype=wp.float32)
_WIDTH, _COLUMNS, _FAR, _WIDE = (wp.constant(x) for x in (WIDTH, COLUMNS, FAR, WIDE_CLUSTER))
_WALL_PENALTY, _STIFF = wp.constant(WALL_PENALTY), wp.constant(600.0)
"""Energy of charge that is out of reach [1/m]; with losses at most the second number [m] over the
square of a large cluster's extent: more of it would hide what is in reach, see ``warp_cut.weigh``.
"""
_FADED = wp.constant(FADED)
_OF_ITSELF = wp.constant(0.9)
"""Clusters at a wall meet their images at most so much, over how they meet themselves."""
_NEAR_LEAST, _FAR_LEAST = wp.constant(LEAST[0]), wp.constant(LEAST[-1])


@wp.struct
class Leaf:
    """One leaf in the sensor frame, as ``WarpActiveTree`` has it."""

    points: four
    unlifted: four  # the same before they were lifted off the design
    lifted: wp.int32
    extent: wp.float32
    softening_length: wp.float32
    outside_fraction: wp.float32
    barrier: wp.float32
    free: wp.int32
    near: wp.float32


@wp.func
def body_of(cut: WarpActiveTree, leaf: int):
    """Whose leaf it is."""
    n = cut.number.shape[0]
    return wp.where(leaf < n, leaf // cut.clusters, (leaf - n) // (2 * cut.clusters))


@wp.func
def leaf_of(cut: WarpActiveTree, i: int, v: int):
    """A leaf that was placed."""
    out = Leaf()
    out.points = cut.points[i, v]
    out.unlifted = cut.unlifted[i, v]
    out.lifted = cut.lifted[i, v]
    out.extent = cut.extent[i, v]
    out.softening_length = cut.softening_length[i, v]
    out.outside_fraction = cut.outside_fraction[i, v]
    out.near = cut.near[i, v]
    out.barrier = cut.barrier[i, v]
    out.free = is_free(cut, body_of(cut, i), v)
    return out


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
def first_source(green: Response, leaf: Leaf):
    """The first source that counts at a leaf."""
    return wp.where(leaf.near < 1.0, 0, green.far)


@wp.func
def last_source(green: Response, leaf: Leaf):
    """The end of the sources that count at a leaf; nothing counts beyond the walls."""
    stop = wp.where(leaf.near > 0.0, green.sources.shape[0], green.far)
    return wp.where(leaf.outside_fraction < 1.0, stop, 0)


@wp.func
def share_of(green: Response, leaf: Leaf, s: int):
    """What a source counts at each of a leaf's four points."""
    return (
        0.25 * (1.0 - leaf.outside_fraction) * wp.where(s < green.far, 1.0 - leaf.near, leaf.near)
    )


@wp.func
def least_of(green: Response, s: int):
    """Distance below which a source acts as at this one [m]."""
    return wp.where(s < green.far, _FAR_LEAST, _NEAR_LEAST)


@wp.func
def seen(green: Response, leaf: Leaf, s: int):
    """Mean potential over a leaf of a source's unit charge and its image in the floor."""
    total = float(0.0)
    for q in range(4):
        total += _unit(leaf.points[q], green.sources[s], green.floor, least_of(green, s))
    return share_of(green, leaf, s) * total


@wp.kernel
def rows(green: Response, cut: WarpActiveTree, out: wp.array3d(dtype=wp.float32)):
    """Means of φ⁰ and ψ over all clusters, (n, w, v), up to a view's width: 64 columns a thread."""
    i, part, v = wp.tid()
    if part * _WIDTH >= cut.width[v]:
        return
    total = row()
    if cut.node[i, v] >= 0:
        leaf = leaf_of(cut, i, v)
        start = wp.where(part < green.passes, first_source(green, leaf), green.far)
        for s in range(start, last_source(green, leaf)):
            total += seen(green, leaf, s) * green.table[s, part]
    for c in range(_WIDTH):
        out[i, part * _WIDTH + c, v] = total[c]


@wp.func
def _facing(points: four, mirrored: float, floor: float):
    """Four points, mirrored in the floor where that is 1."""
    out = points
    for q in range(4):
        out[q, 2] = (1.0 - 2.0 * mirrored) * points[q, 2] + 2.0 * mirrored * floor
    return out


@wp.func
def _fourth(near: float):
    return near * near * near * near + 1.0e-24


@wp.func
def _between(a: four, b: four, fourth: float):
    """Mean of a bounded 1/r between four points each."""
    total = float(0.0)
    for p in range(4):
        for q in range(4):
            d = a[p] - b[q]
            square = wp.dot(d, d)
            total += 1.0 / wp.sqrt(wp.sqrt(square * square + fourth))
    return total / 16.0


@wp.func
def mean(a: Leaf, cut: WarpActiveTree, j: int, v: int, mirrored: float, floor: float):
    """Mean of 1/r between two clusters, the second one mirrored in the floor where that is 1."""
    b = _facing(cut.points[j, v], mirrored, floor)
    d = 0.5 * (a.points[0] + a.points[3] - b[0] - b[3])
    square = wp.dot(d, d)
    size = a.extent + cut.extent[j, v]
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a.points[0] - a.points[1])
        y = 0.5 * (a.points[0] - a.points[2])
        z = 0.5 * (b[0] - b[1])
        w = 0.5 * (b[0] - b[2])
        inverse = 1.0 / wp.sqrt(square)
        second = inverse * inverse
        whole = wp.dot(x, x) + wp.dot(y, y) + wp.dot(z, z) + wp.dot(w, w)
        ax = wp.dot(x, d)
        ay = wp.dot(y, d)
        az = wp.dot(z, d)
        aw = wp.dot(w, d)
        along = 3.0 * (ax * ax + ay * ay + az * az + aw * aw) * second
        return inverse * (1.0 + 0.5 * (along - whole) * second)
    return _between(a.points, b, _fourth(wp.max(a.softening_length, cut.softening_length[j, v])))


@wp.func
def more(a: Leaf, cut: WarpActiveTree, j: int, v: int):
    """What two clusters of a body meet each other more for being lifted off the design."""
    fourth = _fourth(wp.max(a.softening_length, cut.softening_length[j, v]))
    return _between(a.points, cut.points[j, v], fourth) - _between(
        a.unlifted, cut.unlifted[j, v], fourth
    )


@wp.kernel
def pairs(green: Response, cut: WarpActiveTree, out: wp.array3d(dtype=wp.float32)):
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
        if i // cut.clusters != j // cut.clusters:
            value += mean(leaf, cut, j, v, 0.0, green.floor)
        elif i != j and leaf.lifted + cut.lifted[j, v] > 0:
            value += more(leaf, cut, j, v)
        if i == j:
            held = cut.barrier[i, v]
            if cut.walled[v] == 0:
                held = wp.min(held, _STIFF / (cut.extent[i, v] * cut.extent[i, v]))
            value += held
    out[i, j, v] = value
    out[j, i, v] = value


@wp.kernel
def bound_walls(
    green: Response, cut: WarpActiveTree, rows: wp.array3d(dtype=wp.float32),
    pairs: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Let no cluster that is nearer to a wall than to the design meet its images more than itself.

    Points of large ones may lie among the sources that stand for the wall; no definite matrix would
    be left. They come to be out of reach instead, as those beyond the wall are.
    """
    i, v = wp.tid()
    if cut.node[i, v] < 0 or cut.walled[v] == 0:
        return
    center = 0.5 * (cut.points[i, v][0] + cut.points[i, v][3])
    low = center - green.room0
    high = green.room1 - center
    room = wp.min(wp.min(wp.min(low[0], low[1]), low[2]), wp.min(wp.min(high[0], high[1]), high[2]))
    away = wp.length(off_box(center, green.box0, green.box1))
    if room > wp.min(away, cut.extent[i, v]):
        return
    met = float(0.0)
    for k in range(green.first, cut.width[v]):
        met += rows[i, k, v] * rows[i, k, v]
    most = _OF_ITSELF * wp.max(pairs[i, i, v], 0.0)
    if met > most:
        less = wp.sqrt(most / met)
        for k in range(cut.width[v]):
            rows[i, k, v] = less * rows[i, k, v]
        cut.outside_fraction[i, v] = 1.0 - less * (1.0 - cut.outside_fraction[i, v])


@wp.kernel
def bound_images(
    green: Response, cut: WarpActiveTree, rows: wp.array3d(dtype=wp.float32),
    pairs: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Let no cluster meet its images more than in a mirror, as ``pair_kernels.bound_images``."""
    i, v = wp.tid()
    if cut.node[i, v] < 0 or green.has_face == 0:
        return
    leaf = leaf_of(cut, i, v)
    face = green.box1[2]
    least = float(1e9)
    inverse = float(0.0)
    for q in range(4):
        height = leaf.points[q][2] - face
        least = wp.min(least, height)
        inverse += 0.25 / wp.max(height, 1e-9)
    arms = wp.length(leaf.points[0] - leaf.points[1]) * wp.length(leaf.points[0] - leaf.points[2])
    side = wp.sqrt(3.0 * arms)
    if inverse * side < _WIDE or least < 0.0:
        return
    met = _between(leaf.points, _facing(leaf.points, 1.0, green.floor), _fourth(0.0))
    for k in range(green.first, cut.width[v]):
        met += rows[i, k, v] * rows[i, k, v]
    extra = met - _mirror(2.0 / (inverse * side)) / side
    pairs[i, i, v] = pairs[i, i, v] + wp.max(extra, 0.0) * smooth(10.0 * extra / met)


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


@wp.func
def columns_of(values: wp.array3d(dtype=wp.float32), row: int, first: int, v: int):
    """Some columns of a row of a view."""
    out = some()
    for c in range(_COLUMNS):
        out[c] = values[row, first + c, v]
    return out


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
def wall_slope(green: Response, leaf: Leaf, origin: wp.vec3):
    """How much further out of reach a leaf is as it moves along x, y, z and turns about them."""
    c = 0.5 * (leaf.points[0] + leaf.points[3])
    off = off_walls(c, leaf.free, green)
    way = wp.length(off)
    slope = wp.vec3()
    if way < 1.0 and leaf.outside_fraction < 1.0:
        for i in range(3):
            side = wp.where(off[i] < 0.0, 0, 1)
            slope[i] = 6.0 * (1.0 - way) * off[i] / green.walls[1, leaf.free, side][i]
    return wp.spatial_vector(slope, wp.cross(c - origin, slope))


@wp.func
def barrier_slope(green: Response, leaf: Leaf):
    """How the energy that keeps charge off a leaf grows as it comes further out of reach."""
    x = leaf.outside_fraction
    y = wp.max(1.0 - x, 1.0e-6)
    off = off_walls(0.5 * (leaf.points[0] + leaf.points[3]), leaf.free, green)
    if wp.length(at_edges(off, leaf.free, green)) >= wp.length(off):
        return 3.0 * _WALL_PENALTY * x * x
    return wp.where(x * x < _FADED * y, x * (2.0 - x) / (y * y * leaf.extent), 0.0)


@wp.func
def source_forces(
    green: Response, leaf: Leaf, strength: wp.array3d(dtype=wp.float32), origin: wp.vec3,
    first: int, v: int,
):  # fmt: skip
    """Forces on a leaf, and torques about an origin, by sources: columns from ``first`` on."""
    out = pulls()
    slope = wall_slope(green, leaf, origin)
    fading = wp.length_sq(slope) > 0.0
    for s in range(first_source(green, leaf), last_source(green, leaf)):
        force = wp.vec3()
        torque = wp.vec3()
        for q in range(4):
            p = leaf.points[q]
            pull = _source(p, green.sources[s], green.floor, least_of(green, s))
            if leaf.lifted != 0:
                p = leaf.unlifted[q]
                pull = lift_back(pull, p, green.validity, green)
            force += pull
            torque += wp.cross(p - origin, pull)
        both = share_of(green, leaf, s) * wp.spatial_vector(force, torque)
        if fading:
            both -= seen(green, leaf, s) / (1.0 - leaf.outside_fraction) * slope
        out += wp.outer(columns_of(strength, s, first, v), both)
    return out


@wp.func
def _near(d: wp.vec3, fourth: float):
    """Gradient of a bounded 1/r."""
    square = wp.dot(d, d)
    whole = wp.sqrt(square * square + fourth)
    return -square / (whole * whole * wp.sqrt(whole)) * d


@wp.func
def pair_force(
    green: Response, a: Leaf, cut: WarpActiveTree, j: int, v: int, mirrored: float, origin: wp.vec3
):  # fmt: skip
    """Force on a cluster, and torque about an origin, of the mean of 1/r to another."""
    b = _facing(cut.points[j, v], mirrored, green.floor)
    d = 0.5 * (a.points[0] + a.points[3] - b[0] - b[3])
    square = wp.dot(d, d)
    size = a.extent + cut.extent[j, v]
    force = wp.vec3()
    torque = wp.vec3()
    if square > _FAR * _FAR * size * size and a.lifted == 0:
        x = 0.5 * (a.points[0] - a.points[1])
        y = 0.5 * (a.points[0] - a.points[2])
        z = 0.5 * (b[0] - b[1])
        w = 0.5 * (b[0] - b[2])
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
        torque = wp.cross(0.5 * (a.points[0] + a.points[3]) - origin, force)
        torque += 3.0 * fifth * wp.cross(ax * x + ay * y, d)
    else:
        fourth = _fourth(wp.max(a.softening_length, cut.softening_length[j, v]))
        for p in range(4):
            pull = wp.vec3()
            for q in range(4):
                pull += _near(a.points[p] - b[q], fourth)
            at = a.points[p]
            if a.lifted != 0:
                at = a.unlifted[p]
                pull = lift_back(pull, at, green.validity, green)
            force += pull / 16.0
            torque += wp.cross(at - origin, pull) / 16.0
    return wp.spatial_vector(force, torque)


@wp.kernel
def forces(
    green: Response, cut: WarpActiveTree, charge: wp.array3d(dtype=wp.float32),
    strength: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Gradient of terminals' potentials at each leaf, and its torque about its body's origin.

    Shape (l, lead, v).
    """
    i, chunk, v = wp.tid()
    first = _COLUMNS * chunk
    if idle(cut, green.phi_columns, first, v):
        return
    total = pulls()
    if cut.node[i, v] >= 0:
        leaf = leaf_of(cut, i, v)
        body = body_of(cut, i)
        origin = wp.transform_get_translation(cut.pose[body, v])
        total = source_forces(green, leaf, strength, origin, first, v)
        for j in range(cut.node.shape[0]):
            if cut.node[j, v] >= 0:
                pull = pair_force(green, leaf, cut, j, v, 1.0, origin)
                if body_of(cut, j) != body or (i != j and leaf.lifted + cut.lifted[j, v] > 0):
                    pull -= pair_force(green, leaf, cut, j, v, 0.0, origin)
                total += wp.outer(columns_of(charge, j, first, v), pull)
        if leaf.barrier > 0.0:
            pull = -0.5 * barrier_slope(green, leaf) * wall_slope(green, leaf, origin)
            total += wp.outer(columns_of(charge, i, first, v), pull)
    for c in range(_COLUMNS):
        out[i, first + c, v] = wp.spatial_vector(
            total[c, 0], total[c, 1], total[c, 2], total[c, 3], total[c, 4], total[c, 5]
        )
