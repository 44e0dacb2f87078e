"""Forces between clusters of charge, each given by four points; 4π eps0 = 1.

Single precision, eight others at a time (:mod:`capsense._simd`). A force is the gradient of a
potential at a cluster, a torque that about the origin of the sensor frame.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import compiled, pasted
from capsense._simd import SIMD_WIDTH, at, madd, put_span, rsqrt, span, splat, vadd, vmadd
from capsense.surface.pair_kernels import SOFT, cluster_moments


@compiled
def source_lines(points, sources, floor, out):
    """What every source does to the sum over four points (k, 4, 3), each of unit charge.

    ``out`` (6, k, s) is filled with: potential [1/m]; force along x, y, z [1/m²]; force along x and
    y, times the height of the source for its own part and of the image for that of the image [1/m].
    """
    width = sources.shape[1]
    layer = out.shape[1] * width
    zero, minus = splat(np.float32(0.0)), np.float32(-1.0)
    two = splat(np.float32(2.0) * floor)
    for i in range(points.shape[0]):
        for s in range(0, width, SIMD_WIDTH):
            sx, sy, high = span(sources, s), span(sources, width + s), span(sources, 2 * width + s)
            low = madd(minus, high, two)
            value = fx = fy = fz = gx = gy = zero
            for q in range(4):
                o = 12 * i + 3 * q
                dx = madd(minus, sx, splat(at(points, o)))
                dy = madd(minus, sy, splat(at(points, o + 1)))
                z = splat(at(points, o + 2))
                dz, ez = madd(minus, high, z), madd(minus, low, z)
                across = vmadd(dx, dx, vmadd(dy, dy, zero))
                a = rsqrt(vmadd(dz, dz, across))
                b = rsqrt(vmadd(ez, ez, across))
                value = vadd(value, madd(minus, b, a))
                a = vmadd(vmadd(a, a, zero), madd(minus, a, zero), zero)
                b = vmadd(vmadd(b, b, zero), b, zero)
                both, arm = vadd(a, b), vmadd(high, a, vmadd(low, b, zero))
                fx, fy = vmadd(dx, both, fx), vmadd(dy, both, fy)
                fz = vmadd(dz, a, vmadd(ez, b, fz))
                gx, gy = vmadd(dx, arm, gx), vmadd(dy, arm, gy)
            o = i * width + s
            _put_six(out, o, layer, value, fx, fy, fz, gx, gy)


@compiled
def _put_six(out, place, layer, a, b, c, d, e, f):
    put_span(out, place, a)
    put_span(out, place + layer, b)
    put_span(out, place + 2 * layer, c)
    put_span(out, place + 3 * layer, d)
    put_span(out, place + 4 * layer, e)
    put_span(out, place + 5 * layer, f)


@compiled
def wide_moments(points, extent, width):
    """Moments of the clusters, shape (10, width)."""
    out = np.ones((10, width), np.float32)
    moments = cluster_moments(points, extent)
    for i in range(10):
        for j in range(extent.shape[0]):
            out[i, j] = moments[i, j]
    return out


@compiled
def weigh(shapes, i, others, n, sign, weight):
    """Give the clusters that cluster i meets by moments the weight ``sign``, others zero."""
    sign, none = np.float32(sign), np.float32(0.0)
    x, y, z, reach = shapes[0, i], shapes[1, i], shapes[2, i], shapes[9, i]
    for j in range(n):
        dx, dy, dz = x - others[0, j], y - others[1, j], z - others[2, j]
        far = reach + others[9, j]
        weight[j] = sign if dx * dx + dy * dy + dz * dz > far * far else none
    for j in range(n, weight.shape[0]):
        weight[j] = none


@compiled
def pair_line(shapes, i, others, weight, out, row):
    """Add force and torque on cluster i by others, by moments, to row ``row`` of ``out``."""
    width = others.shape[1]
    layer, zero, minus = out.shape[1] * width, splat(np.float32(0.0)), np.float32(-1.0)
    x, y, z = shapes[0, i], shapes[1, i], shapes[2, i]
    ax, ay, az = shapes[3, i], shapes[4, i], shapes[5, i]
    bx, by, bz = shapes[6, i], shapes[7, i], shapes[8, i]
    own = splat(ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz)
    for j in range(0, width, SIMD_WIDTH):
        dx = madd(minus, span(others, j), splat(x))
        dy = madd(minus, span(others, width + j), splat(y))
        dz = madd(minus, span(others, 2 * width + j), splat(z))
        cx, cy, cz = (
            span(others, 3 * width + j), span(others, 4 * width + j), span(others, 5 * width + j)
        )  # fmt: skip
        ex, ey, ez = (
            span(others, 6 * width + j), span(others, 7 * width + j), span(others, 8 * width + j)
        )  # fmt: skip
        inverse = rsqrt(_dot(dx, dy, dz, dx, dy, dz, splat(np.float32(1e-12))))
        second = vmadd(inverse, inverse, zero)
        a = madd(ax, dx, madd(ay, dy, madd(az, dz, zero)))
        b = madd(bx, dx, madd(by, dy, madd(bz, dz, zero)))
        c, e = _dot(cx, cy, cz, dx, dy, dz, zero), _dot(ex, ey, ez, dx, dy, dz, zero)
        whole = _dot(cx, cy, cz, cx, cy, cz, _dot(ex, ey, ez, ex, ey, ez, own))
        along = vmadd(vmadd(a, a, vmadd(b, b, vmadd(c, c, vmadd(e, e, zero)))), second, zero)
        third = vmadd(vmadd(span(weight, j), inverse, zero), second, zero)
        fifth = madd(np.float32(3.0), vmadd(third, second, zero), zero)
        radial = madd(np.float32(0.5), whole, madd(np.float32(-2.5), along, zero))
        radial = vmadd(fifth, radial, madd(minus, third, zero))
        a, b = vmadd(a, fifth, zero), vmadd(b, fifth, zero)
        c, e = vmadd(c, fifth, zero), vmadd(e, fifth, zero)
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
        _put_six(
            out, o, layer, vadd(fx, span(out, o)), vadd(fy, span(out, o + layer)),
            vadd(fz, span(out, o + 2 * layer)), vadd(tx, span(out, o + 3 * layer)),
            vadd(ty, span(out, o + 4 * layer)), vadd(tz, span(out, o + 5 * layer)),
        )  # fmt: skip


@pasted
def _dot(x, y, z, u, v, w, addend):
    return vmadd(x, u, vmadd(y, v, vmadd(z, w, addend)))


@pasted
def _cross(x, y, u, v):
    """``x v - y u``."""
    zero = splat(np.float32(0.0))
    return vmadd(x, v, madd(np.float32(-1.0), vmadd(y, u, zero), zero))


@compiled
def near_pairs(points, others, extent, i, start, stop, n, weight, near, out, row):
    """The same for clusters without weight, point by point, but those from start to stop.

    ``near`` (14, l) is room for their points, bounds and numbers.
    """
    sign = np.float32(-1.0 if stop > start else 1.0)
    count = 0
    for j in range(n):
        if weight[j] != 0.0 or start <= j < stop:
            continue
        for q in range(4):
            for k in range(3):
                near[3 * q + k, count] = others[j, q, k]
        near[12, count] = (SOFT * max(extent[i], extent[j])) ** 4
        near[13, count] = j
        count += 1
    width = near.shape[1]
    for k in range(0, count, SIMD_WIDTH):
        zero, minus = splat(np.float32(0.0)), np.float32(-1.0)
        gx = gy = gz = tx = ty = tz = zero
        bound = span(near, 12 * width + k)
        for p in range(4):
            x, y, z = (
                np.float32(points[i, p, 0]), np.float32(points[i, p, 1]),
                np.float32(points[i, p, 2]),
            )  # fmt: skip
            fx = fy = fz = zero
            for q in range(4):
                o = 3 * q * width + k
                dx = madd(minus, span(near, o), splat(x))
                dy = madd(minus, span(near, o + width), splat(y))
                dz = madd(minus, span(near, o + 2 * width), splat(z))
                s = _dot(dx, dy, dz, dx, dy, dz, zero)
                u = rsqrt(vmadd(s, s, bound))
                # s / (s s + bound)^(5/4)
                pull = vmadd(vmadd(u, u, zero), vmadd(u, rsqrt(u), zero), zero)
                pull = vmadd(s, pull, zero)
                fx, fy, fz = vmadd(pull, dx, fx), vmadd(pull, dy, fy), vmadd(pull, dz, fz)
            gx, gy, gz = vadd(gx, fx), vadd(gy, fy), vadd(gz, fz)
            tx = madd(y, fz, madd(-z, fy, tx))
            ty = madd(z, fx, madd(-x, fz, ty))
            tz = madd(x, fy, madd(-y, fx, tz))
        _put_six(near, k, width, gx, gy, gz, tx, ty, tz)  # the points are needed no more
    factor = np.float32(-0.0625) * sign
    for k in range(count):
        for r in range(6):
            out[r, row, int(near[13, k])] += factor * near[r, k]
