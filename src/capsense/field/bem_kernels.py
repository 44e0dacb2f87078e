"""Compiled kernels of the boundary-element solver: potentials and fields of charged polygons.

A panel is a planar polygon (holes allowed) that carries one surface charge density. Its edges
are stored flat, counter-clockwise about the panel's normal for the outline, clockwise for holes.
The closed forms are those of Wilton et al., *Potential integrals for uniform and linear source
distributions on polygonal and polyhedral domains*, IEEE Trans. Antennas Propag. 32 (1984).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

_TINY = 1e-30
_OUTER = 1.6
"""Pairs nearer than this many sums of their diameters average the outer integral too."""
_NEAR = 2.0
"""Panels nearer than this many of their own diameters are integrated in closed form."""


@njit(cache=True)
def polygon_potential(edges, normal, x, y, z):
    """Return ∫ dS' / |r − r'| [m] over a polygon given by its edges (k, 2, 3)."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    d = nx * (x - edges[0, 0, 0]) + ny * (y - edges[0, 0, 1]) + nz * (z - edges[0, 0, 2])
    h = abs(d)
    total = 0.0
    for e in range(edges.shape[0]):
        ax, ay, az = edges[e, 0, 0], edges[e, 0, 1], edges[e, 0, 2]
        lx, ly, lz = edges[e, 1, 0] - ax, edges[e, 1, 1] - ay, edges[e, 1, 2] - az
        length = math.sqrt(lx * lx + ly * ly + lz * lz)
        if length < 1e-15:
            continue
        lx, ly, lz = lx / length, ly / length, lz / length
        px, py, pz = ax - x, ay - y, az - z
        lm = px * lx + py * ly + pz * lz
        lp = lm + length
        # outward in-plane normal of the edge: l x n
        ux, uy, uz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
        t = px * ux + py * uy + pz * uz
        r0 = t * t + h * h
        if r0 < 1e-24:
            continue
        rp = math.sqrt(r0 + lp * lp)
        rm = math.sqrt(r0 + lm * lm)
        far = lm + lp > 0.0
        log = math.log((rp + lp) / (rm + lm) if far else (rm - lm) / (rp - lp))
        total += t * log
        if h > 1e-12:
            total -= h * (math.atan(t * lp / (r0 + h * rp)) - math.atan(t * lm / (r0 + h * rm)))
    return total


@njit(cache=True)
def polygon_gradient(edges, normal, x, y, z, out):
    """Write ∇ ∫ dS' / |r − r'| (dimensionless) into ``out`` (3,).

    On the polygon itself the normal part is the principal value, zero.
    """
    nx, ny, nz = normal[0], normal[1], normal[2]
    d = nx * (x - edges[0, 0, 0]) + ny * (y - edges[0, 0, 1]) + nz * (z - edges[0, 0, 2])
    h = abs(d)
    gx, gy, gz, beta = 0.0, 0.0, 0.0, 0.0
    for e in range(edges.shape[0]):
        ax, ay, az = edges[e, 0, 0], edges[e, 0, 1], edges[e, 0, 2]
        lx, ly, lz = edges[e, 1, 0] - ax, edges[e, 1, 1] - ay, edges[e, 1, 2] - az
        length = math.sqrt(lx * lx + ly * ly + lz * lz)
        if length < 1e-15:
            continue
        lx, ly, lz = lx / length, ly / length, lz / length
        px, py, pz = ax - x, ay - y, az - z
        lm = px * lx + py * ly + pz * lz
        lp = lm + length
        ux, uy, uz = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
        t = px * ux + py * uy + pz * uz
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


@njit(cache=True)
def _panel_potential(j, edges, first, normals, centers, diameters, quad, weights, x, y, z):
    dx, dy, dz = x - centers[j, 0], y - centers[j, 1], z - centers[j, 2]
    if dx * dx + dy * dy + dz * dz < (_NEAR * diameters[j]) ** 2:
        return polygon_potential(edges[first[j] : first[j + 1]], normals[j], x, y, z)
    total = 0.0
    for q in range(quad.shape[1]):
        w = weights[j, q]
        if w != 0.0:
            ex, ey, ez = x - quad[j, q, 0], y - quad[j, q, 1], z - quad[j, q, 2]
            total += w / math.sqrt(ex * ex + ey * ey + ez * ez)
    return total


@njit(cache=True)
def _panel_gradient(j, edges, first, normals, centers, diameters, quad, weights, x, y, z, out):
    dx, dy, dz = x - centers[j, 0], y - centers[j, 1], z - centers[j, 2]
    if dx * dx + dy * dy + dz * dz < (_NEAR * diameters[j]) ** 2:
        polygon_gradient(edges[first[j] : first[j + 1]], normals[j], x, y, z, out)
        return
    out[:] = 0.0
    for q in range(quad.shape[1]):
        w = weights[j, q]
        if w != 0.0:
            ex, ey, ez = x - quad[j, q, 0], y - quad[j, q, 1], z - quad[j, q, 2]
            r2 = ex * ex + ey * ey + ez * ez
            f = -w / (r2 * math.sqrt(r2))
            out[0] += f * ex
            out[1] += f * ey
            out[2] += f * ez


@njit(cache=True)
def _mean_normal_gradient(
    i, j, floor, edges, first, normals, centers, diameters, quad, weights, grad
):
    """Mean over panel i of n_i · ∇ of panel j's unit potential and its image's.

    Panels are met by quadrature when close, at the centroid otherwise; a panel's own
    contribution is the principal value, zero.
    """
    nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
    total = 0.0
    for image in range(2):
        sign = 1.0 if image == 0 else -1.0
        if image == 0 and i == j:
            continue
        zc = centers[i, 2] if image == 0 else 2.0 * floor - centers[i, 2]
        dx, dy, dz = (
            centers[i, 0] - centers[j, 0],
            centers[i, 1] - centers[j, 1],
            zc - centers[j, 2],
        )
        reach = _OUTER * (diameters[j] + diameters[i])
        if dx * dx + dy * dy + dz * dz < reach * reach:
            if (
                image == 0
                and abs(nx * dx + ny * dy + nz * dz) < 1e-12
                and (
                    abs(nx * normals[j, 0] + ny * normals[j, 1] + nz * normals[j, 2]) > 1.0 - 1e-12
                )
            ):
                continue
            value, area = 0.0, 0.0
            for q in range(quad.shape[1]):
                w = weights[i, q]
                if w != 0.0:
                    z = quad[i, q, 2] if image == 0 else 2.0 * floor - quad[i, q, 2]
                    _panel_gradient(
                        j,
                        edges,
                        first,
                        normals,
                        centers,
                        diameters,
                        quad,
                        weights,
                        quad[i, q, 0],
                        quad[i, q, 1],
                        z,
                        grad,
                    )
                    value += w * (grad[0] * nx + grad[1] * ny + sign * grad[2] * nz)
                    area += w
            total += sign * value / area
        else:
            _panel_gradient(
                j,
                edges,
                first,
                normals,
                centers,
                diameters,
                quad,
                weights,
                centers[i, 0],
                centers[i, 1],
                zc,
                grad,
            )
            total += sign * (grad[0] * nx + grad[1] * ny + sign * grad[2] * nz)
    return total


@njit(cache=True, parallel=True)
def potential_matrix(points, floor, edges, first, normals, centers, diameters, quad, weights):
    """Return G [m], shape (points, panels): potential times 4π eps0 of unit charge densities.

    The grounded plane z = ``floor`` is met by image charges.
    """
    n, m = points.shape[0], centers.shape[0]
    out = np.empty((n, m))
    for i in prange(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        zi = 2.0 * floor - z
        for j in range(m):
            out[i, j] = _panel_potential(
                j, edges, first, normals, centers, diameters, quad, weights, x, y, z
            ) - _panel_potential(
                j, edges, first, normals, centers, diameters, quad, weights, x, y, zi
            )
    return out


@njit(cache=True, parallel=True)
def system_matrix(
    is_interface, contrast, floor, edges, first, normals, centers, diameters, quad, weights
):
    """Return the boundary-element matrix, shape (n, n), rows scaled by 4π eps0.

    Conductor rows average the potential over the panel (Galerkin, outer integral by quadrature).
    Interface rows state that the normal displacement is continuous:
    ``2π σ + contrast · 4π eps0 E_n = 0`` with contrast = (e1 − e2) / (e1 + e2), where the normal
    points from medium 2 into medium 1 and E_n is the principal value.
    """
    n = centers.shape[0]
    out = np.empty((n, n))
    for i in prange(n):
        grad = np.empty(3)
        if is_interface[i]:
            for j in range(n):
                out[i, j] = -contrast[i] * _mean_normal_gradient(
                    i, j, floor, edges, first, normals, centers, diameters, quad, weights, grad
                )
            out[i, i] += 2.0 * math.pi
        else:
            area = weights[i].sum()
            for j in range(n):
                dx = centers[i, 0] - centers[j, 0]
                dy = centers[i, 1] - centers[j, 1]
                dz = centers[i, 2] - centers[j, 2]
                reach = _OUTER * (diameters[j] + diameters[i])
                near = dx * dx + dy * dy + dz * dz < reach * reach
                value = 0.0
                if near or (
                    diameters[i] > centers[i, 2] - floor and dx * dx + dy * dy < reach * reach
                ):
                    for q in range(quad.shape[1]):
                        w = weights[i, q]
                        if w != 0.0:
                            x, y, z = quad[i, q, 0], quad[i, q, 1], quad[i, q, 2]
                            value += (w / area) * (
                                _panel_potential(
                                    j,
                                    edges,
                                    first,
                                    normals,
                                    centers,
                                    diameters,
                                    quad,
                                    weights,
                                    x,
                                    y,
                                    z,
                                )
                                - _panel_potential(
                                    j,
                                    edges,
                                    first,
                                    normals,
                                    centers,
                                    diameters,
                                    quad,
                                    weights,
                                    x,
                                    y,
                                    2.0 * floor - z,
                                )
                            )
                else:
                    x, y, z = centers[i, 0], centers[i, 1], centers[i, 2]
                    value = _panel_potential(
                        j, edges, first, normals, centers, diameters, quad, weights, x, y, z
                    ) - _panel_potential(
                        j,
                        edges,
                        first,
                        normals,
                        centers,
                        diameters,
                        quad,
                        weights,
                        x,
                        y,
                        2.0 * floor - z,
                    )
                out[i, j] = value
    return out


@njit(cache=True, parallel=True)
def normal_gradient_matrix(rows, floor, edges, first, normals, centers, diameters, quad, weights):
    """Return n · ∇ of each panel's unit potential, averaged over the panels ``rows``."""
    n, m = rows.shape[0], centers.shape[0]
    out = np.empty((n, m))
    for k in prange(n):
        grad = np.empty(3)
        for j in range(m):
            out[k, j] = _mean_normal_gradient(
                rows[k], j, floor, edges, first, normals, centers, diameters, quad, weights, grad
            )
    return out


@njit(cache=True, parallel=True)
def flux_matrix(points, rows, floor, edges, first, normals, centers, diameters, quad, weights):
    """Return n · ∇ of 1 / |x − point| integrated over x on panels ``rows``, shape (points, rows).

    The grounded plane z = ``floor`` is met by an image of each point.
    """
    n, m = points.shape[0], rows.shape[0]
    out = np.empty((n, m))
    for i in prange(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        grad = np.empty(3)
        for k in range(m):
            j, total = rows[k], 0.0
            for image in range(2):
                sign = 1.0 if image == 0 else -1.0
                zs = z if image == 0 else 2.0 * floor - z
                _panel_gradient(
                    j, edges, first, normals, centers, diameters, quad, weights, x, y, zs, grad
                )
                # the gradient with respect to the point is minus that with respect to the panel
                total -= sign * (
                    grad[0] * normals[j, 0] + grad[1] * normals[j, 1] + grad[2] * normals[j, 2]
                )
            out[i, k] = total
    return out
