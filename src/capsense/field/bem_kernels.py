"""Compiled kernels of the boundary-element solver: potentials and fields of charged polygons.

A panel is a planar polygon (holes allowed) that carries one surface charge density. Its edges
are stored flat, counter-clockwise about the panel's normal for the outline, clockwise for holes.
Closed forms: :mod:`capsense.field.polygon_kernels`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._thread_pool import filled, in_parts
from capsense.field.polygon_kernels import polygon_gradient, polygon_potential, solid_angle

Array = NDArray[np.float64]

_OUTER = 1.6
"""Pairs nearer than this many sums of their diameters average the outer integral too."""
_NEAR = 2.0
"""Panels nearer than this many of their own diameters are integrated in closed form."""
_FAR = 4.0
"""Panels farther than this many of their own diameters are met by their area and second moments."""


class Panels(NamedTuple):
    """Planar polygonal panels as flat arrays, as the kernels take them."""

    edges: Array
    """Ends of all edges [m], shape (k, 2, 3)."""
    first: NDArray[np.int64]
    """Edges of panel p are ``first[p]:first[p + 1]``, shape (n + 1,)."""
    normals: Array
    """Unit normals, shape (n, 3)."""
    centers: Array
    """Centroids [m], shape (n, 3)."""
    diameters: Array
    """Largest distance from the centroid to a vertex, doubled [m], shape (n,)."""
    quad: Array
    """Points of a quadrature [m], shape (n, q, 3)."""
    weights: Array
    """Their weights [m²], zero for those not used, shape (n, q)."""

    @property
    def size(self) -> int:
        """Number of panels n."""
        return len(self.centers)

    @property
    def areas(self) -> Array:
        """Panel areas [m²], shape (n,)."""
        return self.weights.sum(axis=1)


@kernel
def _flux_mean(p, i, j, floor):
    """The mean of :func:`_mean_normal_gradient`, so that Gauss's law holds exactly.

    Panel i is met in closed form and panel j by quadrature: from any point of a closed surface the
    solid angles of its panels sum to 2π. Else matter of a high permittivity gains a charge.
    """
    edges, normal = p.edges[p.first[i] : p.first[i + 1]], p.normals[i]
    total = 0.0
    for q in range(p.quad.shape[1]):
        w = p.weights[j, q]
        if w != 0.0:
            x, y, z = p.quad[j, q, 0], p.quad[j, q, 1], p.quad[j, q, 2]
            if i != j:
                total += w * solid_angle(edges, normal, x, y, z)
            total -= w * solid_angle(edges, normal, x, y, 2.0 * floor - z)
    return total / p.weights[i].sum()


@kernel
def _panel_potential(p, j, x, y, z):
    """Potential of unit charge density on panel j, times 4π eps0 [m]."""
    dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], z - p.centers[j, 2]
    if dx * dx + dy * dy + dz * dz < (_NEAR * p.diameters[j]) ** 2:
        return polygon_potential(p.edges[p.first[j] : p.first[j + 1]], p.normals[j], x, y, z)
    total = 0.0
    for q in range(p.quad.shape[1]):
        w = p.weights[j, q]
        if w != 0.0:
            ex, ey, ez = x - p.quad[j, q, 0], y - p.quad[j, q, 1], z - p.quad[j, q, 2]
            total += w / math.sqrt(ex * ex + ey * ey + ez * ez)
    return total


@kernel
def _imaged_potential(p, j, floor, x, y, z):
    """Potential of a panel and of its image in the grounded plane z = ``floor``."""
    return _panel_potential(p, j, x, y, z) - _panel_potential(p, j, x, y, 2.0 * floor - z)


@kernel
def _panel_gradient(p, j, x, y, z, out):
    dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], z - p.centers[j, 2]
    if dx * dx + dy * dy + dz * dz < (_NEAR * p.diameters[j]) ** 2:
        polygon_gradient(p.edges[p.first[j] : p.first[j + 1]], p.normals[j], x, y, z, out)
        return
    out[:] = 0.0
    for q in range(p.quad.shape[1]):
        w = p.weights[j, q]
        if w != 0.0:
            ex, ey, ez = x - p.quad[j, q, 0], y - p.quad[j, q, 1], z - p.quad[j, q, 2]
            r2 = ex * ex + ey * ey + ez * ez
            f = -w / (r2 * math.sqrt(r2))
            out[0] += f * ex
            out[1] += f * ey
            out[2] += f * ez


@kernel
def _mean_normal_gradient(p, i, j, floor, grad):
    """Mean over panel i of n_i · ∇ of panel j's unit potential and its image's.

    Panels are met by quadrature when close, at the centroid otherwise; a panel's own
    contribution is the principal value, zero.
    """
    nx, ny, nz = p.normals[i, 0], p.normals[i, 1], p.normals[i, 2]
    x, y = p.centers[i, 0], p.centers[i, 1]
    total = 0.0
    for image in range(2):
        sign = 1.0 if image == 0 else -1.0
        if image == 0 and i == j:
            continue
        zc = p.centers[i, 2] if image == 0 else 2.0 * floor - p.centers[i, 2]
        dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], zc - p.centers[j, 2]
        reach = _OUTER * (p.diameters[j] + p.diameters[i])
        if dx * dx + dy * dy + dz * dz < reach * reach:
            along = nx * p.normals[j, 0] + ny * p.normals[j, 1] + nz * p.normals[j, 2]
            apart = abs(nx * dx + ny * dy + nz * dz)
            if image == 0 and apart < 1e-12 and abs(along) > 1.0 - 1e-12:
                continue
            value, area = 0.0, 0.0
            for q in range(p.quad.shape[1]):
                w = p.weights[i, q]
                if w != 0.0:
                    z = p.quad[i, q, 2] if image == 0 else 2.0 * floor - p.quad[i, q, 2]
                    _panel_gradient(p, j, p.quad[i, q, 0], p.quad[i, q, 1], z, grad)
                    value += w * (grad[0] * nx + grad[1] * ny + sign * grad[2] * nz)
                    area += w
            total += sign * value / area
        else:
            _panel_gradient(p, j, x, y, zc, grad)
            total += sign * (grad[0] * nx + grad[1] * ny + sign * grad[2] * nz)
    return total


def potential_matrix(points: Array, floor: float, panels: Panels) -> Array:
    """Return G [m], shape (points, panels): potential times 4π eps0 of unit charge densities.

    The grounded plane z = ``floor`` is met by image charges.
    """
    points, out = np.ascontiguousarray(points), np.empty((len(points), len(panels.centers)))
    filled(_fill_far_potentials, out, points, floor, _moments(panels))
    return filled(_fill_potentials, out, points, floor, panels)


@compiled
def _fill_potentials(start, stop, points, floor, p, out):
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(out.shape[1]):
            if not _is_far(p, j, x, y, z, 0.0):
                out[i, j] = _imaged_potential(p, j, floor, x, y, z)


def system_matrix(kind: NDArray[np.int64], contrast: Array, floor: float, panels: Panels) -> Array:
    """Return the boundary-element matrix, shape (n, n), rows scaled by 4π eps0.

    ``kind``: 0 conductors, 1 interfaces, 2 interfaces of parts that are no upright boxes.
    Conductor rows average the potential over the panel (Galerkin, outer integral by quadrature).
    Interface rows state that the normal displacement is continuous:
    ``2π σ + contrast · 4π eps0 E_n = 0`` with contrast = (e1 − e2) / (e1 + e2), where the normal
    points from medium 2 into medium 1 and E_n is the principal value.
    """
    n = len(panels.centers)
    return system_block(kind, contrast, floor, panels, (0, n), (0, n))


def system_block(
    kind: NDArray[np.int64], contrast: Array, floor: float, panels: Panels,
    rows: tuple[int, int], columns: tuple[int, int],
) -> Array:  # fmt: skip
    """Return the block of :func:`system_matrix` with rows and columns from … to …."""
    some = slice(*rows)
    out = np.empty((rows[1] - rows[0], columns[1] - columns[0]))
    moments, centers = _moments(panels, slice(*columns)), panels.centers[some]
    filled(_fill_far_potentials, out, centers, floor, moments)
    flux = np.flatnonzero(kind[some] == 1)
    if len(flux):
        turned = -contrast[some][flux, None] * panels.normals[some][flux]
        in_parts(_fill_far_gradients, len(flux), flux, centers[flux], turned, floor, moments, out)
    return filled(_fill_system, out, (rows[0], columns[0]), kind, contrast, floor, panels)


@compiled
def _fill_system(start, stop, origin, kind, contrast, floor, p, out):
    (row, column), grad = origin, np.empty(3)
    for i in range(row + start, row + stop):
        line = out[i - row]
        x, y, z = p.centers[i, 0], p.centers[i, 1], p.centers[i, 2]
        for j in range(column, column + out.shape[1]):
            if kind[i] == 2:
                line[j - column] = -contrast[i] * _flux_mean(p, i, j, floor)
            elif _is_far(p, j, x, y, z, p.diameters[i]) and (
                kind[i] == 1 or not _over_floor(p, i, j, floor)
            ):
                continue
            elif kind[i] == 1:
                line[j - column] = -contrast[i] * _mean_normal_gradient(p, i, j, floor, grad)
            else:
                line[j - column] = _mean_potential(p, i, j, floor)
        if kind[i] and 0 <= i - column < out.shape[1]:
            line[i - column] += 2.0 * math.pi


@kernel
def _is_far(p, j, x, y, z, diameter):
    """Whether panel j is met by moments from a point, or from the middle of another panel."""
    dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], z - p.centers[j, 2]
    own = p.diameters[j]
    reach = max(_FAR * own, _OUTER * (own + diameter))
    return dx * dx + dy * dy + dz * dz >= reach * reach


@kernel
def _over_floor(p, i, j, floor):
    """Whether panel i, so close to the floor that its width counts, is above panel j's image."""
    dx, dy = p.centers[i, 0] - p.centers[j, 0], p.centers[i, 1] - p.centers[j, 1]
    reach = _OUTER * (p.diameters[j] + p.diameters[i])
    return p.diameters[i] > p.centers[i, 2] - floor and dx * dx + dy * dy < reach * reach


def _moments(panels: Panels, some: slice = slice(None)) -> Array:
    """Centres, areas and second moments of panels, shape (10, n).

    With T = 3 Q − tr(Q) 1 of the second moments Q about the centre, the potential of unit density
    is A/r + rᵀTr/(2 r⁵), r from the centre (J. D. Jackson, *Classical Electrodynamics*, 4.1). The
    rows are x, y, z, A, Txx, Tyy, Tzz, Txy, Txz, Tyz.
    """
    centers, weights = panels.centers[some], panels.weights[some]
    off = panels.quad[some] - centers[:, None]
    second = np.einsum("nq,nqa,nqb->nab", weights, off, off)
    turned = 3 * second - np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    a, b = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    return np.ascontiguousarray(np.vstack([centers.T, weights.sum(axis=1), turned[:, a, b].T]))


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fill_far_potentials(
    start: int, stop: int, points: Array, floor: float, moments: Array, out: Array
) -> None:
    cx, cy, cz, area, xx, yy, zz, xy, xz, yz = moments
    for i in range(start, stop):
        x, y, z, image = points[i, 0], points[i, 1], points[i, 2], 2.0 * floor - points[i, 2]
        for j in range(out.shape[1]):
            dx, dy, up, down = x - cx[j], y - cy[j], z - cz[j], image - cz[j]
            flat = dx * dx * xx[j] + dy * dy * yy[j] + 2.0 * dx * dy * xy[j]
            side = 2.0 * (dx * xz[j] + dy * yz[j])
            across = dx * dx + dy * dy
            s, t = 1.0 / np.sqrt(across + up * up), 1.0 / np.sqrt(across + down * down)
            one = flat + up * (up * zz[j] + side)
            two = flat + down * (down * zz[j] + side)
            out[i, j] = s * (area[j] + 0.5 * one * s**4) - t * (area[j] + 0.5 * two * t**4)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def _fill_far_gradients(
    start: int, stop: int, rows: NDArray[np.int64], points: Array, normals: Array, floor: float,
    moments: Array, out: Array,
) -> None:  # fmt: skip
    """Write normals · ∇ of the potentials at points into rows of ``out``."""
    cx, cy, cz, area, xx, yy, zz, xy, xz, yz = moments
    for k in range(start, stop):
        i = rows[k]
        x, y, z, image = points[k, 0], points[k, 1], points[k, 2], 2.0 * floor - points[k, 2]
        u, v, w = normals[k]
        for j in range(out.shape[1]):
            dx, dy, up, down = x - cx[j], y - cy[j], z - cz[j], image - cz[j]
            across = dx * dx + dy * dy
            total = 0.0
            for dz, side, sign in ((up, w, 1.0), (down, -w, -1.0)):
                s = 1.0 / np.sqrt(across + dz * dz)
                a = dx * xx[j] + dy * xy[j] + dz * xz[j]
                b = dx * xy[j] + dy * yy[j] + dz * yz[j]
                c = dx * xz[j] + dy * yz[j] + dz * zz[j]
                along = dx * u + dy * v + dz * side
                form = dx * a + dy * b + dz * c
                total += sign * s**3 * (
                    -along * area[j] + s * s * (a * u + b * v + c * side)
                    - 2.5 * s**4 * form * along
                )  # fmt: skip
            out[i, j] = total


@kernel
def _mean_potential(p, i, j, floor):
    """Mean over panel i of panel j's unit potential and its image's [m]."""
    x, y, z = p.centers[i, 0], p.centers[i, 1], p.centers[i, 2]
    dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], z - p.centers[j, 2]
    reach = _OUTER * (p.diameters[j] + p.diameters[i])
    if dx * dx + dy * dy + dz * dz >= reach * reach and not _over_floor(p, i, j, floor):
        return _imaged_potential(p, j, floor, x, y, z)
    area = p.weights[i].sum()
    value = 0.0
    for q in range(p.quad.shape[1]):
        w = p.weights[i, q]
        if w != 0.0:
            x, y, z = p.quad[i, q, 0], p.quad[i, q, 1], p.quad[i, q, 2]
            value += (w / area) * _imaged_potential(p, j, floor, x, y, z)
    return value


def normal_gradient_matrix(rows: NDArray[np.int64], floor: float, panels: Panels) -> Array:
    """Return n · ∇ of each panel's unit potential, averaged over the panels ``rows``."""
    return normal_gradient_block(rows, floor, panels, 0)


def normal_gradient_block(
    rows: NDArray[np.int64], floor: float, panels: Panels, first: int
) -> Array:
    """Rows of :func:`normal_gradient_matrix`, for the panels from ``first`` on."""
    out = np.empty((len(rows), len(panels.centers) - first))
    moments = _moments(panels, slice(first, None))
    centers, normals = panels.centers[rows], panels.normals[rows]
    filled(_fill_far_gradients, out, np.arange(len(rows)), centers, normals, floor, moments)
    return filled(_fill_normal_gradients, out, rows, first, floor, panels)


@compiled
def _fill_normal_gradients(start, stop, rows, first, floor, p, out):
    grad = np.empty(3)
    for k in range(start, stop):
        i = rows[k]
        x, y, z = p.centers[i, 0], p.centers[i, 1], p.centers[i, 2]
        for j in range(first, first + out.shape[1]):
            if not _is_far(p, j, x, y, z, p.diameters[i]):
                out[k, j - first] = _mean_normal_gradient(p, i, j, floor, grad)


def flux_matrix(points: Array, rows: NDArray[np.int64], floor: float, panels: Panels) -> Array:
    """Return n · ∇ of 1 / |x − point| integrated over x on panels ``rows``, shape (points, rows).

    The grounded plane z = ``floor`` is met by an image of each point.
    """
    out = np.empty((len(points), len(rows)))
    return filled(_fill_fluxes, out, np.ascontiguousarray(points), rows, floor, panels)


@compiled
def _fill_fluxes(start, stop, points, rows, floor, p, out):
    grad = np.empty(3)
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(out.shape[1]):
            j, total = rows[k], 0.0
            for image in range(2):
                sign = 1.0 if image == 0 else -1.0
                _panel_gradient(p, j, x, y, z if image == 0 else 2.0 * floor - z, grad)
                # the gradient with respect to the point is minus that with respect to the panel
                total -= sign * (
                    grad[0] * p.normals[j, 0] + grad[1] * p.normals[j, 1]
                    + grad[2] * p.normals[j, 2]
                )  # fmt: skip
            out[i, k] = total
