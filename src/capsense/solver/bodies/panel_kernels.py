"""Compiled kernels: mutual potentials and fluxes of flat panels that carry even charge.

Lengths in metres, 4π eps0 = 1. Panels are given by the ends of their four ``edges`` (n, 4, 2, 3)
and their ``normals`` (n, 3), see :mod:`capsense.field.polygon_kernels`. ``flat`` (10, n) holds
centre, second moments xx, yy, zz, xy, xz, yz and reach of all panels, ``coarse`` and ``fine``
(n, q, 4) points and weights on them.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._dense import three
from capsense._jit import kernel
from capsense._simd import (
    dot,
    rsqrt,
    vadd,
    vdiv,
    vlog,
    vmadd,
    vmul,
    vsub,
    where_above,
    wide_span,
    wide_splat,
)
from capsense.field.polygon_kernels import polygon_potential, solid_angle

NEAR = 2.2
"""Pairs nearer than this many sums of their reaches are integrated in closed form."""
TOUCHING = 1.25
"""Pairs nearer than this many sums of their reaches take the fine points."""
_TINY = 1e-300
_ATAN = 0.0805374449538, -0.138776856032, 0.199777106478, -0.333329491539
"""Of (atan(x) - x) / x³ up to tan(π/8), in powers of x²; S. Moshier, Cephes (1989),
atanf."""


@kernel
def _mean_potential(points, edges, normal):
    """Mean of the potential of one panel over weighted points (q, 4), times the panel's area."""
    total = 0.0
    for k in range(points.shape[0]):
        if points[k, 3] != 0.0:
            total += points[k, 3] * polygon_potential(
                edges, normal, points[k, 0], points[k, 1], points[k, 2]
            )
    return total


@kernel
def fill_points(corners, lines, out):
    """Fill in points on panels and their weights: for near and for touching pairs, and rims.

    The mean over a panel of its own potential is found on its rim: the energy of an evenly charged
    polygon goes with the third power of its size, so that it is two thirds of the sum over edges of
    their distance from a corner times the integral of the potential along them. Two edges meet at
    that corner and drop out.

    Args:
        corners: Of the panels [m], shape (n, 4, 3).
        lines: Places on 0 ... 1 and weights, shapes (q,), three times: along both ways across a
            panel, twice, and along an edge.
        out: Filled: shapes (n, q², 4) twice, weights of a panel adding up to one, and (n, 2 q, 4).
    """
    coarse, fine, rim = out
    for k in range(corners.shape[0]):
        _across(corners[k], lines[0], coarse[k])
        _across(corners[k], lines[1], fine[k])
        _along(corners[k], lines[2], rim[k])


@kernel
def _across(corners, line, out):
    """Fill in points on a polygon and weights that sum to one, shape (q², 4)."""
    places, weights = line
    count, total = places.shape[0], 0.0
    # the Jacobian of a bilinear map of a plane polygon is linear in s and t
    first = _double(corners, 0, 1, 0, 3)
    along, up = _double(corners, 0, 1, 1, 2) - first, _double(corners, 3, 2, 0, 3) - first
    for i in range(count):
        for j in range(count):
            s, t, o = places[j], places[i], i * count + j
            a, b, c, d = (1.0 - s) * (1.0 - t), s * (1.0 - t), s * t, (1.0 - s) * t
            for x in range(3):
                out[o, x] = (
                    a * corners[0, x] + b * corners[1, x] + c * corners[2, x] + d * corners[3, x]
                )
            out[o, 3] = weights[i] * weights[j] * (first + s * along + t * up)
            total += out[o, 3]
    for o in range(count * count):
        out[o, 3] /= total


@kernel
def _along(corners, line, out):
    """Fill in points on the two edges that do not meet at the first corner, shape (2 q, 4)."""
    places, weights = line
    count, total = places.shape[0], 0.0
    for e in range(2):
        double = _double(corners, 0, e + 1, e + 1, e + 2)
        for i in range(count):
            o = e * count + i
            for x in range(3):
                start = corners[e + 1, x]
                out[o, x] = start + places[i] * (corners[e + 2, x] - start)
            out[o, 3] = double * weights[i]
            total += out[o, 3]
    for o in range(2 * count):
        out[o, 3] *= 4.0 / 3.0 / total


@kernel
def _double(corners, a, b, c, d):
    """Area of the parallelogram of two ways, from corner a to b and from c to d [m²]."""
    ux, uy, uz = (
        corners[b, 0] - corners[a, 0], corners[b, 1] - corners[a, 1], corners[b, 2] - corners[a, 2],
    )  # fmt: skip
    vx, vy, vz = (
        corners[d, 0] - corners[c, 0], corners[d, 1] - corners[c, 1], corners[d, 2] - corners[c, 2],
    )  # fmt: skip
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return math.sqrt(x * x + y * y + z * z)


@kernel
def fill_free(panels, mirrors, out):
    """Write the free-space block: F_kl [1/m], mean over panel k of the potential of panel l.

    Far pairs: point charges and second moments. Near pairs: closed form of one panel, averaged
    over points of the other, both ways, weighted with the fourth power of the other's reach. The
    mirror images of a pair are copied.
    """
    flat, edges, normals, areas = panels.flat, panels.edges, panels.normals, panels.areas
    coarse, fine, rim = panels.coarse, panels.fine, panels.rim
    image, first, by = mirrors
    n = areas.shape[0]
    for i in range(n):
        line = out[i]
        if first[i] < i:
            turned, other = image[by[i]], out[first[i]]
            for j in range(n):
                line[j] = other[turned[j]]
            continue
        x0, y0, z0 = flat[0, i], flat[1, i], flat[2, i]
        xx, yy, zz = flat[3, i], flat[4, i], flat[5, i]
        xy, xz, yz = flat[6, i], flat[7, i], flat[8, i]
        for j in range(i + 1, n):
            x, y, z = flat[0, j] - x0, flat[1, j] - y0, flat[2, j] - z0
            r2 = x * x + y * y + z * z + _TINY
            axx, ayy, azz = flat[3, j] + xx, flat[4, j] + yy, flat[5, j] + zz
            mix = x * y * (flat[6, j] + xy) + x * z * (flat[7, j] + xz) + y * z * (flat[8, j] + yz)
            second = 3.0 * (x * x * axx + y * y * ayy + z * z * azz + 2.0 * mix) / r2
            line[j] = (1.0 + (second - axx - ayy - azz) / (2.0 * r2)) / math.sqrt(r2)
        reach = flat[9, i]
        line[i] = _mean_potential(rim[i], edges[i], normals[i]) / areas[i]
        for j in range(n):
            if first[j] < i:  # an image of a pair of that row
                line[j] = out[first[j], image[by[j], i]]
            elif j > i:
                like = j  # the first that j is mapped to by what maps panel i to itself
                for g in range(1, image.shape[0]):
                    if image[g, i] == i:
                        like = min(like, image[g, j])
                if like < j:
                    line[j] = line[like]
                    continue
                x, y, z = flat[0, j] - x0, flat[1, j] - y0, flat[2, j] - z0
                span = reach + flat[9, j]
                r2 = x * x + y * y + z * z
                if r2 < NEAR * NEAR * span * span:
                    small, large = (j, i) if flat[9, j] < (1.0 + 1e-6) * reach else (i, j)
                    rule = fine if r2 < TOUCHING * TOUCHING * span * span else coarse
                    value = _mean_potential(rule[small], edges[large], normals[large])
                    line[j] = value / areas[large]


@kernel
def fill_flux(panels, rows, out):
    """Write rows of the flux block: flux through panel k from unit charge spread evenly on panel l.

    The flux from a point is the solid angle under which it sees the panel, so that the fluxes
    through a closed surface add up to 2π for every point on it. Near pairs average that over
    points of l, far pairs take the field of point charges and second moments.
    """
    flat, edges, normals, areas = panels.flat, panels.edges, panels.normals, panels.areas
    coarse, fine = panels.coarse, panels.fine
    n = areas.shape[0]
    for place in range(rows.shape[0]):
        k, line = rows[place], out[place]
        x0, y0, z0 = flat[0, k], flat[1, k], flat[2, k]
        xx, yy, zz = flat[3, k], flat[4, k], flat[5, k]
        xy, xz, yz = flat[6, k], flat[7, k], flat[8, k]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        area = areas[k]
        for j in range(n):
            x, y, z = x0 - flat[0, j], y0 - flat[1, j], z0 - flat[2, j]
            r2 = x * x + y * y + z * z + _TINY
            axx, ayy, azz = flat[3, j] + xx, flat[4, j] + yy, flat[5, j] + zz
            axy, axz, ayz = flat[6, j] + xy, flat[7, j] + xz, flat[8, j] + yz
            mx, my, mz = (
                axx * x + axy * y + axz * z,
                axy * x + ayy * y + ayz * z,
                axz * x + ayz * y + azz * z,
            )
            along = nx * x + ny * y + nz * z
            second = 7.5 * (mx * x + my * y + mz * z) / r2 - 1.5 * (axx + ayy + azz)
            value = along * (1.0 + second / r2) - 3.0 * (nx * mx + ny * my + nz * mz) / r2
            line[j] = area * value / (r2 * math.sqrt(r2))
        for j in range(n):
            x, y, z = x0 - flat[0, j], y0 - flat[1, j], z0 - flat[2, j]
            span = flat[9, k] + flat[9, j]
            r2 = x * x + y * y + z * z
            if r2 < NEAR * NEAR * span * span:
                rule = fine if r2 < TOUCHING * TOUCHING * span * span else coarse
                value = 0.0
                for q in range(rule.shape[1]):
                    p = rule[j, q]
                    value -= p[3] * solid_angle(edges[k], normals[k], p[0], p[1], p[2])
                line[j] = value
        line[k] = 0.0


@kernel
def rectangle_potential(frames, o, points, p):
    """Potentials of unit charge spread evenly over sixteen rectangles, at a point each [1/m].

    The integral of 1/r over a rectangle with corners (left, below) and (x, y), seen from a height
    z > 0 (Wilton et al. 1984), with the logarithms, and the angles, of two corners in one.

    Args:
        frames: Table whose columns hold centre, both axes, normal and half sides, one number below
            the other; single precision.
        o: Where the first of these stands.
        points: Table whose columns hold points.
        p: Where the first coordinate of these stands.
    """
    n, w, zero = points.shape[1], frames.shape[1], wide_splat(np.float32(0.0))
    px, py, pz = three(points, p, n)
    cx, cy, cz = three(frames, o, w)
    dx, dy, dz = vsub(px, cx), vsub(py, cy), vsub(pz, cz)
    x, y, z = three(frames, o + 3 * w, w)
    u = dot(dx, dy, dz, x, y, z, zero)
    x, y, z = three(frames, o + 6 * w, w)
    v = dot(dx, dy, dz, x, y, z, zero)
    x, y, z = three(frames, o + 9 * w, w)
    z = dot(dx, dy, dz, x, y, z, zero)
    a, b = wide_span(frames, o + 12 * w), wide_span(frames, o + 13 * w)
    z = vadd(where_above(z, zero, z, vsub(zero, z)), wide_splat(np.float32(1e-9)))
    x, left, y, below = vsub(a, u), vsub(vsub(zero, a), u), vsub(b, v), vsub(vsub(zero, b), v)
    zz = vmul(z, z)
    xs, ls = vmadd(x, x, zz), vmadd(left, left, zz)
    ys, bs = vmadd(y, y, zz), vmadd(below, below, zz)
    r, s, t, e = (
        _root(vmadd(x, x, ys)), _root(vmadd(x, x, bs)),
        _root(vmadd(left, left, ys)), _root(vmadd(left, left, bs)),
    )  # fmt: skip
    out = vmul(x, _side(y, below, r, s, xs))
    out = vsub(out, vmul(left, _side(y, below, t, e, ls)))
    out = vmadd(y, _side(x, left, r, t, ys), out)
    out = vsub(out, vmul(below, _side(x, left, s, e, bs)))
    angle = vsub(
        _between(vmul(x, y), vmul(z, r), vmul(x, below), vmul(z, s)),
        _between(vmul(left, y), vmul(z, t), vmul(left, below), vmul(z, e)),
    )
    return vdiv(vsub(out, vmul(z, angle)), vmul(wide_splat(np.float32(4.0)), vmul(a, b)))


@kernel
def _root(square):
    """Square root of numbers above zero."""
    return vmul(square, rsqrt(square))


@kernel
def _side(end, start, far, near, square):
    """``log((end + far) / (start + near))``, far² = end² + square and near² = start² + square.

    Where a sum would be a small difference it is ``square`` over the other one.
    """
    zero, one = wide_splat(np.float32(0.0)), wide_splat(np.float32(1.0))
    last = vadd(far, where_above(end, zero, end, vsub(zero, end)))
    first = vadd(near, where_above(start, zero, start, vsub(zero, start)))
    over = vmul(where_above(end, zero, last, square), where_above(start, zero, one, first))
    under = vmul(where_above(end, zero, one, last), where_above(start, zero, first, square))
    return vlog(vdiv(over, under))


@kernel
def _between(p, q, r, s):
    """``atan(p / q) - atan(r / s)``, q and s above zero."""
    zero = wide_splat(np.float32(0.0))
    return angle_of(vmadd(q, s, vmul(p, r)), vmadd(p, s, vsub(zero, vmul(r, q))))


@kernel
def angle_of(x, y):
    """Angle of the points (x, y), from -π to π, to 3e-7; 0 at the origin."""
    zero, tiny = wide_splat(np.float32(0.0)), wide_splat(np.float32(1e-37))
    up, right = where_above(y, zero, y, vsub(zero, y)), where_above(x, zero, x, vsub(zero, x))
    low, high = where_above(up, right, right, up), where_above(up, right, up, right)
    wide = vsub(low, vmul(wide_splat(np.float32(0.4142135624)), high))
    above = where_above(wide, zero, vsub(low, high), low)
    below = where_above(wide, zero, vadd(low, high), high)
    part = where_above(wide, zero, wide_splat(np.float32(0.25 * math.pi)), zero)
    t = vdiv(above, where_above(below, tiny, below, tiny))
    square = vmul(t, t)
    series = wide_splat(np.float32(_ATAN[0]))
    series = vmadd(series, square, wide_splat(np.float32(_ATAN[1])))
    series = vmadd(series, square, wide_splat(np.float32(_ATAN[2])))
    series = vmadd(series, square, wide_splat(np.float32(_ATAN[3])))
    angle = vadd(part, vmadd(vmul(series, square), t, t))
    angle = where_above(up, right, vsub(wide_splat(np.float32(0.5 * math.pi)), angle), angle)
    angle = where_above(zero, x, vsub(wide_splat(np.float32(math.pi)), angle), angle)
    return where_above(zero, y, vsub(zero, angle), angle)
