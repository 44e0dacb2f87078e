"""Compiled kernels: closed forms of the potential and field of a uniformly charged flat polygon.

A polygon is given by its edges (k, 2, 3), the ends of each: counter-clockwise about the unit
normal for the outline, clockwise for holes. Edges of length zero are left out. The potential is a
sum over edges of distance times logarithm, less height times solid angle (Wilton et al., *Potential
integrals for uniform and linear source distributions on polygonal and polyhedral domains*, IEEE
Trans. Antennas Propag. 32, 1984). The solid angle is that of the triangles between the first
corner and each edge (van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30, 1983).
"""

from __future__ import annotations

import math

from capsense._jit import kernel

_TINY = 1e-30


@kernel
def polygon_potential(edges, normal, x, y, z):
    """Return ∫ dS' / |r − r'| [m] over a polygon, to rounding errors also close to its edges."""
    ox, oy, oz, o = _seen(edges[0, 0], x, y, z)
    total, real, imaginary = 0.0, 1.0, 0.0
    for e in range(edges.shape[0]):
        ax, ay, az, a = _seen(edges[e, 0], x, y, z)
        bx, by, bz, b = _seen(edges[e, 1], x, y, z)
        lx, ly, lz, length = _seen(edges[e, 1], edges[e, 0, 0], edges[e, 0, 1], edges[e, 0, 2])
        if length == 0.0:
            continue
        cx, cy, cz = ay * lz - az * ly, az * lx - ax * lz, ax * ly - ay * lx  # a × b
        apart = normal[0] * cx + normal[1] * cy + normal[2] * cz
        if apart != 0.0:
            low, high = ax * lx + ay * ly + az * lz, bx * lx + by * ly + bz * lz
            if low >= 0.0:
                ratio = (b * length + high) / (a * length + low)
            elif high <= 0.0:
                ratio = (a * length - low) / (b * length - high)
            else:  # the foot of the perpendicular lies on the edge
                square = cx * cx + cy * cy + cz * cz
                ratio = (b * length + high) * (a * length - low) / square
            total += apart / length * math.log(ratio)
        p = (a * b + ax * bx + ay * by + az * bz) * o
        p += (ox * ax + oy * ay + oz * az) * b + (ox * bx + oy * by + oz * bz) * a
        q = ox * cx + oy * cy + oz * cz
        real, imaginary = _turned(real, imaginary, p, q)
    height = normal[0] * ox + normal[1] * oy + normal[2] * oz
    return total - 2.0 * abs(height * math.atan2(imaginary, real))


@kernel
def solid_angle(edges, normal, x, y, z):
    """Return the solid angle of a polygon from a point [sr], positive in front of it.

    It is zero in the polygon's plane, and the normal part of :func:`polygon_gradient` with the
    other sign.
    """
    ox, oy, oz, o = _seen(edges[0, 0], x, y, z)
    if abs(normal[0] * ox + normal[1] * oy + normal[2] * oz) <= 1e-12:
        return 0.0
    real, imaginary = 1.0, 0.0
    for e in range(edges.shape[0]):
        ax, ay, az, a = _seen(edges[e, 0], x, y, z)
        bx, by, bz, b = _seen(edges[e, 1], x, y, z)
        p = (a * b + ax * bx + ay * by + az * bz) * o
        p += (ox * ax + oy * ay + oz * az) * b + (ox * bx + oy * by + oz * bz) * a
        q = ox * (ay * bz - az * by) + oy * (az * bx - ax * bz) + oz * (ax * by - ay * bx)
        real, imaginary = _turned(real, imaginary, p, q)
    return -2.0 * math.atan2(imaginary, real)


@kernel
def _seen(point, x, y, z):
    """Vector from a point to another, and its length."""
    dx, dy, dz = point[0] - x, point[1] - y, point[2] - z
    return dx, dy, dz, math.sqrt(dx * dx + dy * dy + dz * dz)


@kernel
def _turned(real, imaginary, p, q):
    """Product of two complex numbers up to a positive factor: only its argument counts."""
    if p == 0.0 and q == 0.0:
        return real, imaginary
    real, imaginary = real * p - imaginary * q, real * q + imaginary * p
    size = abs(real) + abs(imaginary)
    if size < 1e-100 or size > 1e100:
        return real / size, imaginary / size
    return real, imaginary


@kernel
def polygon_gradient(edges, normal, x, y, z, out):
    """Write ∇ ∫ dS' / |r − r'| (dimensionless) into ``out`` (3,).

    On the polygon itself the normal part is the principal value, zero.
    """
    nx, ny, nz = normal[0], normal[1], normal[2]
    d = nx * (x - edges[0, 0, 0]) + ny * (y - edges[0, 0, 1]) + nz * (z - edges[0, 0, 2])
    h = abs(d)
    gx, gy, gz, beta = 0.0, 0.0, 0.0, 0.0
    for e in range(edges.shape[0]):
        ux, uy, uz, t, lm, lp, length = _edge(edges[e], normal, x, y, z)
        if length < 1e-15:
            continue
        r0 = t * t + h * h + _TINY
        rp = math.sqrt(r0 + lp * lp)
        rm = math.sqrt(r0 + lm * lm)
        if lm + lp > 0.0:
            log = math.log((rp + lp) / (rm + lm + _TINY))
        else:
            log = math.log((rm - lm) / (rp - lp + _TINY))
        gx -= ux * log
        gy -= uy * log
        gz -= uz * log
        if h > 1e-12:
            beta += math.atan(t * lp / (r0 + h * rp)) - math.atan(t * lm / (r0 + h * rm))
    if h > 1e-12:
        s = beta if d > 0 else -beta
        gx -= nx * s
        gy -= ny * s
        gz -= nz * s
    out[0], out[1], out[2] = gx, gy, gz


@kernel
def _edge(ends, normal, x, y, z):
    """An edge of a polygon (2, 3), seen from a point.

    Returns:
        Its normal in the plane, outward; how far its line lies that way; where its ends lie along
        the line; its length. The first six mean nothing where that is zero.
    """
    ax, ay, az = ends[0, 0], ends[0, 1], ends[0, 2]
    lx, ly, lz = ends[1, 0] - ax, ends[1, 1] - ay, ends[1, 2] - az
    length = math.sqrt(lx * lx + ly * ly + lz * lz)
    lx, ly, lz = lx / length, ly / length, lz / length
    nx, ny, nz = normal[0], normal[1], normal[2]
    ux, uy, uz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
    px, py, pz = ax - x, ay - y, az - z
    low = px * lx + py * ly + pz * lz
    return ux, uy, uz, px * ux + py * uy + pz * uz, low, low + length, length
