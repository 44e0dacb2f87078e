"""What the Warp kernels of a fleet work with, and how they cut bodies into clusters.

A *view* is one sensor in one environment. What belongs to a view has its number as the last index,
so that neighbouring threads of a GPU touch neighbouring numbers. Every body is cut into K clusters:
starting from the whole, the one that is largest against its distance from the design is split. The
cluster that is split keeps its place for the first part, and the second part takes the next one,
so that the change from clusters to charge functions, and of matrices with it, is done in place.

Symbols and formulas are those of ``docs/theory.md``; lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.face_kernels import DEEP, FADED, STEEP, WALL_EDGE, WALL_PENALTY
from capsense.solver.interaction.pair_kernels import LIFTED
from capsense.solver.selection.evaluation_kernels import LONG

wp.set_module_options({"enable_backward": False, "fast_math": True})

WIDTH = 64
"""Columns of a table that a thread works out at a time."""
row = wp.types.vector(length=WIDTH, dtype=wp.float32)
SOURCES = 16
"""Sources that a thread works out at a time."""
many = wp.types.vector(length=SOURCES, dtype=wp.float32)
four = wp.types.matrix(shape=(4, 3), dtype=wp.float32)
"""Four points of a cluster."""
five = wp.types.vector(length=5, dtype=wp.float32)

_WIDTH = wp.constant(WIDTH)
_NEAREST = wp.constant(1e-3)
_HALF = wp.constant(0.5)
_CROSSING, _CROSSED = wp.constant(2.0), wp.constant(4.0)
_MANY = wp.constant(12)
"""Bodies of more panels for each cluster are wide ones, see ``BodyTable.share``."""
_LONG0, _LONG1 = (wp.constant(x) for x in LONG)
_LIFTED, _WALL_PENALTY, _FADED = (wp.constant(x) for x in (LIFTED, WALL_PENALTY, FADED))
_DEEP, _BEHIND = wp.constant(DEEP[0]), wp.constant(DEEP[1])
_STEEP, _WALL_EDGE = wp.constant(STEEP), wp.constant(WALL_EDGE)


@wp.struct
class Shapes:
    """All shapes, of size 1, one behind the other."""

    first: wp.array(dtype=wp.int32)  # first cluster of a shape
    functions: wp.array(dtype=wp.int32)  # how many functions have energies
    block: wp.array(dtype=wp.int64)  # where its energies begin …
    inside: wp.array(dtype=wp.int64)  # … and its impedances, if it is a dielectric's
    radius: wp.array(dtype=wp.float32)
    capacitance: wp.array(dtype=wp.float32)  # in free space
    children: wp.array2d(dtype=wp.int32)  # parts of a cluster, from 0 within the shape; -1 for none
    function: wp.array(dtype=wp.int32)
    charge: wp.array(dtype=wp.float32)
    center: wp.array(dtype=wp.vec3)
    points: wp.array2d(dtype=wp.vec3)
    extent: wp.array(dtype=wp.float32)
    softening_length: wp.array(dtype=wp.float32)
    potential_coefficients: wp.array(dtype=wp.float32)
    neumann_to_dirichlet: wp.array(dtype=wp.float32)


@wp.struct
class Places:
    """What stands in the places of all environments, (e, b)."""

    choice: wp.array2d(dtype=wp.int32)
    scale: wp.array2d(dtype=wp.float32)
    inverse_susceptibility: wp.array2d(dtype=wp.vec2)  # complex, as ties are
    ground_elastance: wp.array2d(dtype=wp.vec2)
    neutral: wp.array2d(dtype=wp.int32)
    slack: wp.array2d(dtype=wp.vec3)  # half of what is cut off along each axis
    group: wp.array(dtype=wp.int32)  # joined places have the same number, (b,)
    hidden: wp.array2d(dtype=wp.int32)  # whether a sensor does not see a place, (s, b)


@wp.struct
class Response:
    """Green's function of the design."""

    sources: wp.array(dtype=wp.vec3)  # far ones, then near ones
    table: wp.array2d(dtype=row)  # (sources, passes)
    columns: wp.array2d(dtype=many)  # the same table, (columns, batches of sources)
    far: wp.int32  # how many are far ones
    passes: wp.int32  # that these have
    first: wp.int32  # column of the first ψ in these
    phi_columns: wp.int32  # columns of charges: of terminals, then of nodes
    terminals: wp.int32
    floor: wp.float32
    has_face: wp.int32
    extent: wp.float32  # shortest side of the domain
    validity: wp.float32  # distance from which the Green's function is valid
    blend0: wp.float32
    blend1: wp.float32
    box0: wp.vec3
    box1: wp.vec3
    room0: wp.vec3
    room1: wp.vec3
    walls: wp.array3d(dtype=wp.vec3)  # ``Space.inner`` and ``Space.fade``, (2, 2, 2)
    middle: wp.vec3
    length: wp.float32  # of what kernels take for a length of one [m]; poses are in metres


@wp.struct
class WarpActiveTree:
    """Clusters and functions of every view, K for each place; n = b K.

    Leaves are the clusters and, behind all of them, the two parts of each, l = 3 n.
    """

    clusters: wp.int32  # K
    pose: wp.array2d(dtype=wp.transform)  # of the bodies in the sensor frame, (b, v)
    moved: wp.array2d(dtype=wp.vec3)  # from a body's origin to that of what is left of it, (b, v)
    node: wp.array2d(dtype=wp.int32)  # cluster of the shape that a leaf is, -1 for none, (l, v)
    score: wp.array2d(dtype=wp.float32)
    split: wp.array2d(dtype=wp.int32)  # place of the cluster that was split for this one, (n, v)
    part: wp.array2d(dtype=wp.float32)  # share of the first part, (n, v)
    mix: wp.array2d(dtype=wp.float32)  # the same in the functions solved for, see weigh, (n, v)
    weight: wp.array2d(dtype=wp.float32)
    barrier: wp.array2d(dtype=wp.float32)  # energy that keeps charge off [1/m], (l, v)
    # of conductors not at ground, what is out of reach: capacitance, middle; then 1, (b, v)
    outside: wp.array2d(dtype=five)
    walled: wp.array(dtype=wp.int32)  # whether these differ, (v,)
    number: wp.array2d(dtype=wp.int32)  # function of the shape, -1 for none, (n, v)
    panel_end_fraction: wp.array2d(
        dtype=wp.float32
    )  # which part of its two parts are panels, (n, v)
    out: wp.array2d(dtype=wp.float32)  # how far a cluster's leaves are out of reach, (n, v)
    points: wp.array2d(dtype=four)  # of the leaves, (l, v)
    unlifted: wp.array2d(dtype=four)  # the same before they were lifted off the design
    lifted: wp.array2d(dtype=wp.int32)  # whether they were, (l, v)
    extent: wp.array2d(dtype=wp.float32)
    softening_length: wp.array2d(dtype=wp.float32)  # distance below which 1/r is bounded [m]
    outside_fraction: wp.array2d(dtype=wp.float32)
    near: wp.array2d(dtype=wp.float32)  # share of the near sources, (l, v)
    leader: wp.array2d(dtype=wp.int32)  # first of the places that a place is joined with, (b, v)
    ground_elastance: wp.array2d(
        dtype=wp.vec2
    )  # energy of the net charge of the leader and all others, (b, v)
    slot: wp.array2d(dtype=wp.int32)  # number of the node that a body is part of, else -1, (b, v)
    columns: wp.array(dtype=wp.int32)  # terminals and nodes, (v,)
    lossy: wp.array(dtype=wp.int32)  # whether a view has matter with losses, (v,)
    width: wp.array(dtype=wp.int32)  # columns of φ⁰ and ψ that are not zero, (v,)


@wp.func
def smooth(x: float):
    y = wp.clamp(x, 0.0, 1.0)
    return y * y * (3.0 - 2.0 * y)


@wp.func
def off_box(p: wp.vec3, low: wp.vec3, high: wp.vec3):
    """How far a point is from a box along each axis."""
    return wp.vec3(
        wp.max(wp.max(low[0] - p[0], p[0] - high[0]), 0.0),
        wp.max(wp.max(low[1] - p[1], p[1] - high[1]), 0.0),
        wp.max(wp.max(low[2] - p[2], p[2] - high[2]), 0.0),
    )


@wp.func
def _unit(pose: wp.transform):
    """The pose with a quaternion of length 1; of length 0, it is not finite, nor is the reading."""
    q = wp.transform_get_rotation(pose)
    return wp.transform(wp.transform_get_translation(pose), q / wp.length(q))


@wp.func
def _need(
    shapes: Shapes, green: Response, at: wp.transform, scale: float, first: int, node: int,
    wide: bool,
):  # fmt: skip
    """Extent of a cluster over its distance from the design; 0 for a single panel.

    Of wide bodies: in the field of a charge at a distance d, the function of a cluster of extent s
    has an energy like s³/d⁴; its fourth root is taken, over that of s⁻¹ for the whole body. Where a
    cluster crosses a wall, its share of the body's length is added, times a factor.
    """
    if shapes.children[node, 0] < 0:
        return float(0.0)
    size = scale * shapes.extent[node]
    p = wp.transform_point(at, scale * shapes.center[node])
    away = wp.length(off_box(p, green.box0, green.box1))
    low = p - green.room0
    high = green.room1 - p
    room = wp.min(wp.min(wp.min(low[0], low[1]), low[2]), wp.min(wp.min(high[0], high[1]), high[2]))
    crossing = smooth(2.0 - 4.0 * wp.abs(room) / (size + 1e-9))
    crossing = crossing * smooth((size / green.extent - _LONG0) / (_LONG1 - _LONG0))
    crossing = crossing * shapes.extent[node] / shapes.extent[first]
    near = size / (wp.max(away, _HALF * size) + _NEAREST)
    if wide:
        smaller = wp.sqrt(wp.sqrt(shapes.extent[first] / shapes.extent[node]))
        return smaller * near + _CROSSED * crossing
    return near + _CROSSING * crossing


@wp.func
def idle(cut: WarpActiveTree, phi_columns: int, first: int, v: int):
    """Whether no column from this one on means something in a view."""
    imaginary = first >= phi_columns
    at = wp.where(imaginary, first - phi_columns, first)
    return at >= cut.columns[v] or (imaginary and cut.lossy[v] == 0)


@wp.kernel
def mark(mask: wp.array(dtype=wp.bool), due: wp.array(dtype=wp.int32)):
    """Marks of the environments that a mask names."""
    e = wp.tid()
    due[e] = wp.where(mask[e], 1, 0)


@wp.kernel
def stand(
    shapes: Shapes, places: Places, green: Response, due: wp.array(dtype=wp.int32),
    bodies: wp.array2d(dtype=wp.transform), sensors: wp.array2d(dtype=wp.transform),
    cut: WarpActiveTree,
):  # fmt: skip
    """Where bodies stand in the sensors' frames, and which of them a sensor sees.

    In environments that are not due it sees none.
    """
    b, v = wp.tid()
    e = v // sensors.shape[1]
    s = v % sensors.shape[1]
    u = places.choice[e, b]
    o = b * cut.clusters
    cut.node[o, v] = -1
    cut.number[o, v] = -1
    if u < 0 or places.hidden[s, b] != 0 or due[e] == 0:
        return
    frame = _unit(sensors[e, s])
    body = _unit(bodies[e, b])
    turn = wp.quat_inverse(wp.transform_get_rotation(frame))
    off = wp.transform_get_translation(body) - wp.transform_get_translation(frame)
    off = off / green.length
    at = wp.transform(wp.quat_rotate(turn, off), turn * wp.transform_get_rotation(body))
    slack = places.slack[e, b]
    off = wp.transform_point(wp.transform_inverse(at), green.middle)
    moved = wp.transform_vector(at, wp.min(wp.max(off, -slack), slack))
    at = wp.transform(wp.transform_get_translation(at) + moved, wp.transform_get_rotation(at))
    cut.pose[b, v] = at
    cut.moved[b, v] = moved
    scale = places.scale[e, b]
    away = off_box(wp.transform_get_translation(at), green.room0, green.room1)
    if (
        wp.max(away[0], wp.max(away[1], away[2]))
        > scale * shapes.radius[u] + _WALL_EDGE * green.extent
    ):
        return
    cut.node[o, v] = shapes.first[u]


@wp.kernel
def choose(shapes: Shapes, places: Places, green: Response, cut: WarpActiveTree):
    """Cut every body that a sensor sees into clusters."""
    b, v = wp.tid()
    e = v // places.hidden.shape[0]
    o = b * cut.clusters
    for j in range(1, cut.clusters):
        cut.node[o + j, v] = -1
        cut.number[o + j, v] = -1
    cut.panel_end_fraction[o, v] = 0.0
    first = cut.node[o, v]
    if first < 0:
        return
    at = cut.pose[b, v]
    scale = places.scale[e, b]
    wide = shapes.functions[places.choice[e, b]] > _MANY * cut.clusters
    cut.score[o, v] = _need(shapes, green, at, scale, first, first, wide)
    for j in range(1, cut.clusters):
        best = int(0)
        most = float(0.0)
        for i in range(j):
            if cut.score[o + i, v] > most:
                most = cut.score[o + i, v]
                best = i
        if most > 0.0:
            k = cut.node[o + best, v]
            x = first + shapes.children[k, 0]
            y = first + shapes.children[k, 1]
            cut.split[o + j, v] = best
            cut.part[o + j, v] = shapes.charge[x] / shapes.charge[k]
            cut.number[o + j, v] = shapes.function[k]
            cut.panel_end_fraction[o + j, v] = wp.where(
                shapes.children[x, 0] < 0, 0.5, 0.0
            ) + wp.where(shapes.children[y, 0] < 0, 0.5, 0.0)
            cut.node[o + best, v] = x
            cut.node[o + j, v] = y
            cut.score[o + best, v] = _need(shapes, green, at, scale, first, x, wide)
            cut.score[o + j, v] = _need(shapes, green, at, scale, first, y, wide)
        else:
            cut.score[o + j, v] = 0.0


@wp.func
def held_off(distance: float, length: float):
    """A distance that becomes ``length`` in contact, as ``face_kernels.held_off``."""
    if distance >= 2.0 * length:
        return distance
    return length + distance * distance / (4.0 * length)


@wp.func
def lift(p: wp.vec3, gap: float, green: Response):
    """Keep a point off a flat design, as ``face_kernels.lift``."""
    away = off_box(p, wp.vec3(green.box0[0], green.box0[1], p[2]), green.box1)
    way = wp.length(away)
    if way >= 2.0 * gap:
        return p
    q = p
    if way == 0.0:
        depth = green.box1[2] - p[2]
        axis = 2
        to = green.box1[2] + gap
        for i in range(2):
            if p[i] - green.box0[i] < depth:
                depth = p[i] - green.box0[i]
                axis = i
                to = green.box0[i] - gap
            if green.box1[i] - p[i] < depth:
                depth = green.box1[i] - p[i]
                axis = i
                to = green.box1[i] + gap
        q[axis] = to
        return q
    ratio = held_off(way, gap) / way
    for i in range(3):
        edge = wp.min(p[i], green.box1[i])
        if i < 2:
            edge = wp.max(edge, green.box0[i])
        q[i] = edge + ratio * (p[i] - edge)
    return q


@wp.func
def lift_back(force: wp.vec3, p: wp.vec3, gap: float, green: Response):
    """Force on a point before it is lifted by :func:`lift`, from that on the lifted point."""
    low = wp.vec3(green.box0[0], green.box0[1], p[2])
    away = off_box(p, low, green.box1)
    way = wp.length(away)
    if way >= 2.0 * gap:
        return force
    if way == 0.0:
        held = wp.normalize(lift(p, gap, green) - p)
        return force - wp.dot(force, held) * held
    out = force
    u = wp.vec3()
    for i in range(3):
        if away[i] > 0.0:
            u[i] = wp.where(p[i] < low[i], -away[i], away[i]) / way
            out[i] = force[i] * held_off(way, gap) / way
    along = wp.dot(force, u)
    return out + (way / (2.0 * gap) - held_off(way, gap) / way) * along * u


@wp.func
def is_free(cut: WarpActiveTree, b: int, v: int):
    """1 of a conductor that is not at ground, else 0."""
    return wp.where(cut.outside[b, v][4] > 0.0, 1, 0)


@wp.func
def off_walls(c: wp.vec3, free: int, green: Response):
    """How far a point is in what bodies fade out in, along each axis: minus before lower walls."""
    low = wp.cw_div(wp.max(green.walls[0, free, 0] - c, wp.vec3()), green.walls[1, free, 0])
    high = wp.cw_div(wp.max(c - green.walls[0, free, 1], wp.vec3()), green.walls[1, free, 1])
    return high - low


@wp.func
def at_edges(off: wp.vec3, free: int, green: Response):
    """What :func:`off_walls` returns at sides where all bodies fade out over one distance."""
    out = off
    for i in range(3):
        side = wp.where(off[i] < 0.0, 0, 1)
        if green.walls[1, free, side][i] != green.walls[1, 0, side][i]:
            out[i] = 0.0
    return out


@wp.func
def barrier(x: float, held: float, extent: float):
    """Energy that keeps charge off a leaf that is out of reach, as ``face_kernels.barrier``."""
    soft = float(0.0)
    if held < x:
        soft = wp.min(x * x / wp.max(1.0 - x, 1.0e-9), _FADED) / extent
    return _WALL_PENALTY * held * held * held + soft


@wp.kernel
def place(shapes: Shapes, places: Places, green: Response, cut: WarpActiveTree):
    """Place all leaves in the sensor frame, and find where they stand to design and walls."""
    i, v = wp.tid()
    n = cut.number.shape[0]
    e = v // places.hidden.shape[0]
    b = i // cut.clusters
    k = int(-1)
    if i < n:
        k = cut.node[i, v]
    else:
        b = (i - n) // (2 * cut.clusters)
        whole = cut.node[(i - n) // 2, v]
        if whole >= 0:
            k = shapes.children[whole, (i - n) % 2]
            if k >= 0:
                k += shapes.first[places.choice[e, b]]
        cut.node[i, v] = k
    if k < 0:
        return
    scale = places.scale[e, b]
    size = scale * shapes.extent[k]
    points = four()
    for q in range(4):
        points[q] = wp.transform_point(cut.pose[b, v], scale * shapes.points[k, q])
    cut.unlifted[i, v] = points
    c = 0.5 * (points[0] + points[3])
    off = off_walls(c, is_free(cut, b, v), green)
    edge = wp.length(at_edges(off, is_free(cut, b, v), green))
    lifted = int(0)
    deep = float(0.0)
    if green.has_face != 0:
        depth = wp.min(1.0, green.box1[2] - c[2])
        for d in range(2):
            depth = wp.min(depth, _STEEP * (c[d] - green.box0[d]))
            depth = wp.min(depth, _STEEP * (green.box1[d] - c[d]))
        deep = (depth / green.validity - _DEEP) / _BEHIND
        for q in range(4):
            before = points[q]
            points[q] = lift(before, green.validity, green)
            if wp.length(points[q] - before) > _LIFTED:
                lifted = 1
    cut.points[i, v] = points
    cut.lifted[i, v] = lifted
    cut.extent[i, v] = size
    cut.softening_length[i, v] = scale * shapes.softening_length[k]
    cut.outside_fraction[i, v] = smooth(wp.max(wp.length(off), deep))
    cut.barrier[i, v] = barrier(cut.outside_fraction[i, v], smooth(wp.max(edge, deep)), size)
    away = wp.length(off_box(0.5 * (points[0] + points[3]), green.box0, green.box1))
    cut.near[i, v] = smooth((green.blend1 - away) / (green.blend1 - green.blend0))


@wp.kernel
def weigh(shapes: Shapes, places: Places, green: Response, cut: WarpActiveTree):
    """How many columns a view needs, and how its functions share charge among their parts.

    Fewer columns do where no cluster is near the design. Where clusters are out of reach, functions
    have so little charge on them that its energy, far above all others, hides nothing in single
    precision: in place of the equilibrium charge, one that goes like it over that energy. Together
    they stand for the same charges. With losses they stay as they are.
    """
    v = wp.tid()
    passes = green.passes
    walled = int(0)
    for i in range(cut.number.shape[0]):
        k = cut.node[i, v]
        if k >= 0:
            if cut.near[i, v] > 0.0:
                passes = green.table.shape[1]
            x = cut.outside_fraction[i, v]
            cut.out[i, v] = x
            walled = wp.where(x > 0.0 and cut.lossy[v] == 0, 1, walled)
            cut.weight[i, v] = shapes.charge[k] / (1.0 + cut.barrier[i, v] * cut.extent[i, v])
    cut.width[v] = _WIDTH * passes
    cut.walled[v] = walled
    for b in range(places.group.shape[0]):
        o = b * cut.clusters
        for step in range(cut.clusters - 1):
            j = o + cut.clusters - 1 - step
            if cut.number[j, v] >= 0:
                i = o + cut.split[j, v]
                cut.mix[j, v] = cut.part[j, v]
                cut.out[i, v] = wp.max(cut.out[i, v], cut.out[j, v])
                if cut.out[i, v] > 0.0:  # see choose_kernels.functions_of
                    cut.panel_end_fraction[j, v] = 0.0
                if walled != 0:
                    whole = cut.weight[i, v] + cut.weight[j, v]
                    cut.mix[j, v] = cut.weight[i, v] / whole
                    cut.weight[i, v] = whole
