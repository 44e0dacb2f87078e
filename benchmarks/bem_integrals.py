"""Compiled integrals over flat panels, for ``bem_reference.py``.

A panel is a triangle or a quadrilateral, given by four corners (4, 3), two of them perhaps the
same, its unit normal, centroid, area, and largest distance of a corner from the centroid.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

ORDERS = (1, 2, 4, 6, 10)
NODES = np.zeros((11, 10))
WEIGHTS = np.zeros((11, 10))
for _n in ORDERS:
    _x, _w = np.polynomial.legendre.leggauss(_n)
    NODES[_n, :_n], WEIGHTS[_n, :_n] = (_x + 1) / 2, _w / 2


@njit(cache=True)
def _charged(v, n, x, y, z, field):
    """Potential at a point of a flat panel ``v`` (4, 3) of unit charge density; its field."""
    h = (x - v[0, 0]) * n[0] + (y - v[0, 1]) * n[1] + (z - v[0, 2]) * n[2]
    height, potential, angle = abs(h), 0.0, 0.0
    field[:] = 0.0
    for k in range(4):
        a, b = v[k], v[(k + 1) % 4]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        length = math.sqrt(ex * ex + ey * ey + ez * ez)
        if length < 1e-12:
            continue
        ex, ey, ez = ex / length, ey / length, ez / length
        mx, my, mz = ey * n[2] - ez * n[1], ez * n[0] - ex * n[2], ex * n[1] - ey * n[0]
        dx, dy, dz = a[0] - x, a[1] - y, a[2] - z
        t = dx * mx + dy * my + dz * mz  # distance to the edge's line, in the plane
        s = dx * ex + dy * ey + dz * ez
        e = s + length
        square = t * t + h * h
        if square < 1e-20 * length * length:
            continue
        near, far = math.sqrt(s * s + square), math.sqrt(e * e + square)
        log = math.log((far + e) / (near + s)) if s + e > 0 else math.log((near - s) / (far - e))
        potential += t * log
        angle += math.atan2(t * e, square + height * far) - math.atan2(
            t * s, square + height * near
        )
        field[0] += mx * log
        field[1] += my * log
        field[2] += mz * log
    side = 1.0 if h > 0 else (-1.0 if h < 0 else 0.0)
    for k in range(3):
        field[k] += side * n[k] * angle
    return potential - height * angle


@njit(cache=True)
def _order(gap, small, large):
    """Points of the outer rule along each direction, by the distance of the centres."""
    if gap > 14.0 * large:
        return 1
    if gap > 4.0 * large:
        return 2
    return 4 if gap > 1.5 * large or small > 0.7 * large else 6


@njit(cache=True)
def _point(v, a, b, out):
    """A point of a panel at (a, b) of the unit square, and the Jacobian's size there."""
    ux = uy = uz = wx = wy = wz = 0.0
    for k in range(3):
        lower = v[0, k] + a * (v[1, k] - v[0, k])
        upper = v[3, k] + a * (v[2, k] - v[3, k])
        out[k] = lower + b * (upper - lower)
    ux, uy, uz = (
        (1 - b) * (v[1, 0] - v[0, 0]) + b * (v[2, 0] - v[3, 0]),
        (1 - b) * (v[1, 1] - v[0, 1]) + b * (v[2, 1] - v[3, 1]),
        (1 - b) * (v[1, 2] - v[0, 2]) + b * (v[2, 2] - v[3, 2]),
    )
    wx, wy, wz = (
        (1 - a) * (v[3, 0] - v[0, 0]) + a * (v[2, 0] - v[1, 0]),
        (1 - a) * (v[3, 1] - v[0, 1]) + a * (v[2, 1] - v[1, 1]),
        (1 - a) * (v[3, 2] - v[0, 2]) + a * (v[2, 2] - v[1, 2]),
    )
    cx, cy, cz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
    return math.sqrt(cx * cx + cy * cy + cz * cz)


@njit(cache=True)
def _pair(v, nv, cv, av, rv, w, nw, cw, aw, rw, mirror, want, nodes, weights, point, field):
    """∬ 1/r over two panels, or (``want``) the flux through the first of the second's field.

    With ``mirror``, the second panel is mirrored in z = 0.
    """
    sign = -1.0 if mirror else 1.0
    dx, dy, dz = cv[0] - cw[0], cv[1] - cw[1], cv[2] - sign * cw[2]
    gap = math.sqrt(dx * dx + dy * dy + dz * dz)
    order = _order(gap, min(rv, rw), max(rv, rw))
    if order == 1:
        if want:
            return av * aw * (dx * nv[0] + dy * nv[1] + dz * nv[2]) / gap**3
        return av * aw / gap
    swap = rw < rv and not want
    if order >= 4:  # face to face: the rule must see the panels' distance
        height = abs(dx * nw[0] + dy * nw[1] + dz * sign * nw[2])
        if 1e-9 < height < (rw if swap else rv):
            order = 10
    total = 0.0
    for i in range(order):
        for j in range(order):
            if swap:
                jac = _point(w, nodes[order, i], nodes[order, j], point)
                value = _charged(v, nv, point[0], point[1], sign * point[2], field)
            else:
                jac = _point(v, nodes[order, i], nodes[order, j], point)
                value = _charged(w, nw, point[0], point[1], sign * point[2], field)
                if want:
                    value = field[0] * nv[0] + field[1] * nv[1] + sign * field[2] * nv[2]
            total += weights[order, i] * weights[order, j] * jac * value
    return total


@njit(cache=True, parallel=True)
def potentials(v, nv, cv, av, rv, w, nw, cw, aw, rw, same, nodes, weights):
    """∬ (1/r − image) of all pairs; ``same``: of a set with itself, made symmetric."""
    out = np.empty((len(av), len(aw)))
    for i in prange(len(av)):
        point, field = np.empty(3), np.empty(3)
        for j in range(i + 1 if same else len(aw)):
            value = 0.0
            for mirror in (False, True):
                one = _pair(
                    v[i], nv[i], cv[i], av[i], rv[i], w[j], nw[j], cw[j], aw[j], rw[j],
                    mirror, False, nodes, weights, point, field,
                )  # fmt: skip
                value += -one if mirror else one
            out[i, j] = value
    return out


@njit(cache=True, parallel=True)
def fluxes(v, nv, cv, av, rv, w, nw, cw, aw, rw, same, mirror, nodes, weights):
    """Flux through panels v of the field of panels w, or of w mirrored."""
    out = np.zeros((len(av), len(aw)))
    for i in prange(len(av)):
        point, field = np.empty(3), np.empty(3)
        for j in range(len(aw)):
            if not (same and i == j):
                out[i, j] = _pair(
                    v[i], nv[i], cv[i], av[i], rv[i], w[j], nw[j], cw[j], aw[j], rw[j],
                    mirror, True, nodes, weights, point, field,
                )  # fmt: skip
    return out


@njit(cache=True, parallel=True)
def curved_fluxes(x, normal, weight, piece, reach, out):
    """Overwrite fluxes between panels of one smooth piece; points (n, q, 3) on the true surface.

    Flat panels lose the curvature, which is all there is: the kernel is n·d/d³, about 1/(2Rd).
    """
    center = np.empty((len(x), 3))
    mean = np.zeros((len(x), 3))
    area = np.empty(len(x))
    for i in range(len(x)):
        area[i] = weight[i].sum()
        for k in range(3):
            center[i, k] = (weight[i] * x[i, :, k]).sum() / area[i]
            mean[i, k] = (weight[i] * normal[i, :, k]).sum()
    for i in prange(len(x)):
        for j in range(len(x)):
            if i == j or piece[i] != piece[j]:
                continue
            a = center[i, 0] - center[j, 0]
            b = center[i, 1] - center[j, 1]
            c = center[i, 2] - center[j, 2]
            gap = math.sqrt(a * a + b * b + c * c)
            if gap > 8 * max(reach[i], reach[j]):
                out[i, j] = area[j] * (a * mean[i, 0] + b * mean[i, 1] + c * mean[i, 2]) / gap**3
                continue
            total = 0.0
            for p in range(x.shape[1]):
                for q in range(x.shape[1]):
                    a = x[i, p, 0] - x[j, q, 0]
                    b = x[i, p, 1] - x[j, q, 1]
                    c = x[i, p, 2] - x[j, q, 2]
                    d = a * a + b * b + c * c
                    flux = a * normal[i, p, 0] + b * normal[i, p, 1] + c * normal[i, p, 2]
                    total += weight[i, p] * weight[j, q] * flux / (d * math.sqrt(d))
            out[i, j] = total
