"""The step, compiled: the clusters that are not split further, and what the design does to them
and to their charges: means of potentials, and forces.

A *row* is a cluster's mean of the terminals' potentials φ⁰ (first ``Green.phi_columns`` columns)
and of the modes ψ of g.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._dense import multiply, three
from capsense._jit import compiled, kernel
from capsense._simd import (
    WIDE,
    at,
    dot,
    doubles,
    madd,
    put_span,
    rsqrt,
    vadd,
    vmadd,
    vmul,
    vsub,
    where_above,
    wide_span,
    wide_splat,
)
from capsense.field.face_kernels import barrier, keep_off, out_of_reach
from capsense.field.green_kernels import distances, level_share, source_potentials
from capsense.solver.selection.evaluation_kernels import put_offset
from capsense.solver.tree.mean_kernels import extent_of, quadrature4


class ActiveClusters(NamedTuple):
    """The clusters that are represented by themselves, see :class:`ActiveTree`."""

    points: NDArray[Any]
    """Four points of each [m], shape (l, 4, 3)."""
    true: NDArray[Any]
    """Four points of each before they are lifted off the design [m], shape (l, 4, 3)."""
    extent: NDArray[Any]
    """Extents [m], shape (l,)."""
    softening_length: NDArray[Any]
    """Distances below which 1/r from their points is bounded [m], shape (l,)."""
    outside_fraction: NDArray[Any]
    """How far each is out of reach, 0 to 1, see ``face_kernels.out_of_reach``, shape (l,)."""
    owner: NDArray[Any]
    """Body of each, ascending, shape (l,)."""
    self_interaction_weight: NDArray[Any]
    """How much clusters of a body meet each other, 1 for a conductor; 0 for those of a body that
    has energies of its own; shape (l,)."""
    table_rows: NDArray[Any]
    """Rows in a table of means of 1/r within a body, -1 for none, and where it stands, (l, 2)."""
    size: NDArray[Any]
    """How many times as large as in such a table the body of each is, shape (l,)."""
    offset: NDArray[Any]
    """From the middle of a layer of dipoles to its front [m]; zero of charges; shape (l, 3)."""
    barrier: NDArray[Any]
    """Energy that keeps charge off each that is out of reach, see ``face_kernels.barrier`` [1/m],
    shape (l,)."""


@compiled
def placed(bodies, cut, green):
    """Place the leaves of a cut in the sensor frame."""
    n = cut.active.shape[0]
    leaves = ActiveClusters(
        np.empty((n, 4, 3)), np.empty((n, 4, 3)), np.empty(n), np.empty(n), np.empty(n),
        np.empty(n, np.int64), np.zeros(n), np.full((n, 2), -1), np.empty(n), np.zeros((n, 3)),
        np.empty(n),
    )  # fmt: skip
    _fill_leaves(bodies, cut, green, leaves, (np.empty((3, 3)), np.empty((3, 3)), np.empty(3)))
    return leaves


@kernel
def _fill_leaves(bodies, cut, green, leaves, room):
    """Fill the clusters of :func:`placed`; ``room`` is workspace: two matrices and a vector of
    three."""
    moments, turn, middle = room
    space = green.space
    for j in range(cut.active.shape[0]):
        a, corners, points = cut.active[j], leaves.true[j], leaves.points[j]
        body, k = bodies[cut.body[a]], cut.node[a]
        leaves.owner[j], leaves.size[j] = cut.body[a], body.scale
        if k < body.top:
            leaves.table_rows[j, 0], leaves.table_rows[j, 1] = k, body.means
        if body.layer > 0.0:  # its dipoles do not meet each other, see ``layers``
            put_offset(body, k, body.layer, leaves.offset[j])
        elif body.potential_coefficients == 0:  # clusters meet each other at every step
            leaves.self_interaction_weight[j] = 1.0 + body.inside * body.inverse_susceptibility
        if body.points == 0:
            spread, center = doubles(body.spread), doubles(body.center)
            for i in range(3):
                middle[i] = center[3 * k + i]
                for q in range(3):
                    moments[i, q] = spread[9 * k + 3 * i + q]
            extent, soft = quadrature4(moments, middle, turn, corners)
        else:
            local, soft = doubles(body.points), doubles(body.softening_length)[k]
            for q in range(4):
                for i in range(3):
                    corners[q, i] = local[12 * k + 3 * q + i]
            extent = extent_of(corners)
        extent *= body.scale
        leaves.extent[j], leaves.softening_length[j] = extent, body.scale * soft
        for q in range(4):
            for i in range(3):
                points[q, i] = body.position[i] + body.scale * (
                    body.rotation[i, 0] * corners[q, 0] + body.rotation[i, 1] * corners[q, 1]
                    + body.rotation[i, 2] * corners[q, 2])  # fmt: skip
        for q in range(4):
            for i in range(3):
                corners[q, i] = points[q, i]  # before it is lifted
        beyond, held = out_of_reach(points, body.free, space, middle)
        leaves.outside_fraction[j] = beyond
        leaves.barrier[j] = barrier(beyond, held, body.free, extent)
        if space.has_face:
            keep_off(points, space)


@compiled
def leaf_rows(points, beyond, green):
    """Rows of the leaves, shape (l, w); no wider than those of far points where none is near."""
    distance = distances(points, green)
    n = points.shape[0]
    chosen, share = np.empty(n, np.int64), np.empty(n)
    some, out = np.empty((n, 4, 3), np.float32), np.empty((0, 0), np.float32)
    for k in range(len(green.levels)):
        count, level = 0, green.levels[k]
        for j in range(n):
            part = level_share(distance[j], k, green.blends) * (1.0 - beyond[j])
            if part > 0.0:
                chosen[count], share[count] = j, part
                for q in range(4):
                    for i in range(3):
                        some[count, q, i] = points[j, q, i]
                count += 1
        if out.shape[0] == 0 and (count > 0 or k + 1 == len(green.levels)):
            out = np.zeros((n, level.table.shape[1]), np.float32)
        if count > 0:
            _add_rows(some[:count], chosen, share, level, green.floor, out)
    return out


@compiled
def _add_rows(points, chosen, share, level, floor, out):
    sources, table, least = level
    values = np.empty((points.shape[0], sources.shape[1]), np.float32)
    source_potentials(points, sources, np.float32(floor), np.float32(least), values)
    rows = np.empty((points.shape[0], table.shape[1]), np.float32)
    multiply(values, table, rows)
    for c in range(points.shape[0]):
        part, line, to = np.float32(share[c]), rows[c], out[chosen[c]]
        for i in range(table.shape[1]):
            to[i] += part * line[i]


@kernel
def source_lines(points, sources, floor, least, out):
    """What every source does to the sum over four points (k, 4, 3), each of unit charge.

    Floor and ``least`` are as ``source_potentials`` takes them: a point that is nearer to a source
    than ``least`` [m] feels no force of it. ``out`` (6, k, s) is filled with: potential [1/m];
    force along x, y, z [1/m²]; force along x and y, times the height of the source for its own part
    and of the image for that of the image [1/m].
    """
    width = sources.shape[1]
    layer = out.shape[1] * width
    zero = wide_splat(np.float32(0.0))
    two, bound = wide_splat(np.float32(2.0) * floor), wide_splat(least * least)
    for i in range(points.shape[0]):
        for s in range(0, width, WIDE):
            sx, sy, high = three(sources, s, width)
            low = vsub(two, high)
            value = fx = fy = fz = gx = gy = zero
            for q in range(4):
                o = 12 * i + 3 * q
                dx = vsub(wide_splat(at(points, o)), sx)
                dy = vsub(wide_splat(at(points, o + 1)), sy)
                z = wide_splat(at(points, o + 2))
                dz, ez = vsub(z, high), vsub(z, low)
                across = vmadd(dx, dx, vmul(dy, dy))
                square = vmadd(dz, dz, across)
                a = rsqrt(where_above(square, bound, square, bound))
                b = rsqrt(vmadd(ez, ez, across))
                value = vadd(value, vsub(a, b))
                a = vmul(vmul(a, a), vsub(zero, a))
                a = where_above(square, bound, a, zero)
                b = vmul(vmul(b, b), b)
                both, arm = vadd(a, b), vmadd(high, a, vmul(low, b))
                fx, fy = vmadd(dx, both, fx), vmadd(dy, both, fy)
                fz = vmadd(dz, a, vmadd(ez, b, fz))
                gx, gy = vmadd(dx, arm, gx), vmadd(dy, arm, gy)
            o = i * width + s
            _put_six(out, o, layer, (value, fx, fy, fz, gx, gy))


@kernel
def _put_six(out, place, layer, six):
    a, b, c, d, e, f = six
    put_span(out, place, a)
    put_span(out, place + layer, b)
    put_span(out, place + 2 * layer, c)
    put_span(out, place + 3 * layer, d)
    put_span(out, place + 4 * layer, e)
    put_span(out, place + 5 * layer, f)


@kernel
def pair_line(shapes, i, others, weight, out, row):
    """Add force and torque on cluster i by others, by moments, to row ``row`` of ``out``."""
    width = others.shape[1]
    layer, zero = out.shape[1] * width, wide_splat(np.float32(0.0))
    x, y, z = shapes[0, i], shapes[1, i], shapes[2, i]
    ax, ay, az = shapes[3, i], shapes[4, i], shapes[5, i]
    bx, by, bz = shapes[6, i], shapes[7, i], shapes[8, i]
    own = wide_splat(ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz)
    for j in range(0, width, WIDE):
        ox, oy, oz = three(others, j, width)
        dx, dy, dz = vsub(wide_splat(x), ox), vsub(wide_splat(y), oy), vsub(wide_splat(z), oz)
        cx, cy, cz = three(others, 3 * width + j, width)
        ex, ey, ez = three(others, 6 * width + j, width)
        inverse = rsqrt(dot(dx, dy, dz, dx, dy, dz, wide_splat(np.float32(1e-12))))
        second = vmul(inverse, inverse)
        a = madd(ax, dx, madd(ay, dy, madd(az, dz, zero)))
        b = madd(bx, dx, madd(by, dy, madd(bz, dz, zero)))
        c, e = dot(cx, cy, cz, dx, dy, dz, zero), dot(ex, ey, ez, dx, dy, dz, zero)
        whole = dot(cx, cy, cz, cx, cy, cz, dot(ex, ey, ez, ex, ey, ez, own))
        along = vmul(vmadd(a, a, vmadd(b, b, vmadd(c, c, vmul(e, e)))), second)
        third = vmul(vmul(wide_span(weight, j), inverse), second)
        fifth = madd(np.float32(3.0), vmul(third, second), zero)
        radial = madd(np.float32(0.5), whole, madd(np.float32(-2.5), along, zero))
        radial = vmadd(fifth, radial, vsub(zero, third))
        a, b = vmul(a, fifth), vmul(b, fifth)
        c, e = vmul(c, fifth), vmul(e, fifth)
        # what turning the arms of i adds to the torque is this times (dx, dy, dz)
        ux = madd(ax, a, madd(bx, b, zero))
        uy = madd(ay, a, madd(by, b, zero))
        uz = madd(az, a, madd(bz, b, zero))
        fx = vmadd(radial, dx, vmadd(c, cx, vmadd(e, ex, ux)))
        fy = vmadd(radial, dy, vmadd(c, cy, vmadd(e, ey, uy)))
        fz = vmadd(radial, dz, vmadd(c, cz, vmadd(e, ez, uz)))
        tx = madd(y, fz, madd(-z, fy, _cross(uy, uz, dy, dz)))
        ty = madd(z, fx, madd(-x, fz, _cross(uz, ux, dz, dx)))
        tz = madd(x, fy, madd(-y, fx, _cross(ux, uy, dx, dy)))
        o = row * width + j
        _put_six(out, o, layer, (
            vadd(fx, wide_span(out, o)), vadd(fy, wide_span(out, o + layer)),
            vadd(fz, wide_span(out, o + 2 * layer)), vadd(tx, wide_span(out, o + 3 * layer)),
            vadd(ty, wide_span(out, o + 4 * layer)), vadd(tz, wide_span(out, o + 5 * layer)),
        ))  # fmt: skip


@kernel
def _cross(x, y, u, v):
    """``x v - y u``."""
    zero = wide_splat(np.float32(0.0))
    return vmadd(x, v, vsub(zero, vmul(y, u)))


@kernel
def near_pairs(points, others, soft, i, own, weight, near, line):
    """Add force and torque on cluster i by clusters without weight, point by point, but those from
    own[0] to own[1].

    ``near`` (14, l) is workspace for their points, bounds and numbers; ``line`` has shape (6, l).
    """
    start, stop = own
    sign = np.float32(-1.0 if stop > start else 1.0)
    count = 0
    for j in range(others.shape[0]):
        if weight[j] != 0.0 or start <= j < stop:
            continue
        for q in range(4):
            for k in range(3):
                near[3 * q + k, count] = others[j, q, k]
        near[12, count] = max(soft[i], soft[j]) ** 4
        near[13, count] = j
        count += 1
    width = near.shape[1]
    for k in range(0, count, WIDE):
        zero = wide_splat(np.float32(0.0))
        gx = gy = gz = tx = ty = tz = zero
        bound = wide_span(near, 12 * width + k)
        for p in range(4):
            x, y, z = (
                np.float32(points[i, p, 0]), np.float32(points[i, p, 1]),
                np.float32(points[i, p, 2]),
            )  # fmt: skip
            fx = fy = fz = zero
            for q in range(4):
                o = 3 * q * width + k
                ox, oy, oz = three(near, o, width)
                dx, dy = vsub(wide_splat(x), ox), vsub(wide_splat(y), oy)
                dz = vsub(wide_splat(z), oz)
                s = dot(dx, dy, dz, dx, dy, dz, zero)
                u = rsqrt(vmadd(s, s, bound))
                # s / (s s + bound)^(5/4)
                pull = vmul(vmul(u, u), vmul(u, rsqrt(u)))
                pull = vmul(s, pull)
                fx, fy, fz = vmadd(pull, dx, fx), vmadd(pull, dy, fy), vmadd(pull, dz, fz)
            gx, gy, gz = vadd(gx, fx), vadd(gy, fy), vadd(gz, fz)
            tx = madd(y, fz, madd(-z, fy, tx))
            ty = madd(z, fx, madd(-x, fz, ty))
            tz = madd(x, fy, madd(-y, fx, tz))
        _put_six(near, k, width, (gx, gy, gz, tx, ty, tz))  # the points are needed no more
    factor = np.float32(-0.0625) * sign
    for k in range(count):
        for r in range(6):
            line[r, int(near[13, k])] += factor * near[r, k]
