"""Compiled kernels of the boundary-element solver: potentials and fields of charged polygons.

A panel is a planar polygon (holes allowed) that carries one surface charge density. Its edges
are stored flat, counter-clockwise about the panel's normal for the outline, clockwise for holes.
Closed forms: :mod:`capsense.field.polygon_kernels`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._thread_pool import filled
from capsense.field.polygon_kernels import polygon_gradient, polygon_potential, solid_angle

Array = NDArray[np.float64]

_OUTER = 1.6
"""Pairs nearer than this many sums of their diameters average the outer integral too."""
_NEAR = 2.0
"""Panels nearer than this many of their own diameters are integrated in closed form."""


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
    out = np.empty((len(points), len(panels.centers)))
    return filled(_fill_potentials, out, np.ascontiguousarray(points), floor, panels)


@kernel
def _fill_potentials(start, stop, points, floor, p, out):
    for i in range(start, stop):
        for j in range(out.shape[1]):
            out[i, j] = _imaged_potential(p, j, floor, points[i, 0], points[i, 1], points[i, 2])


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
    out = np.empty((rows[1] - rows[0], columns[1] - columns[0]))
    return filled(_fill_system, out, (rows[0], columns[0]), kind, contrast, floor, panels)


@compiled
def _fill_system(start, stop, origin, kind, contrast, floor, p, out):
    (row, column), grad = origin, np.empty(3)
    for i in range(row + start, row + stop):
        line = out[i - row]
        for j in range(column, column + out.shape[1]):
            if kind[i] == 2:
                line[j - column] = -contrast[i] * _flux_mean(p, i, j, floor)
            elif kind[i] == 1:
                line[j - column] = -contrast[i] * _mean_normal_gradient(p, i, j, floor, grad)
            else:
                line[j - column] = _mean_potential(p, i, j, floor)
        if kind[i] and 0 <= i - column < out.shape[1]:
            line[i - column] += 2.0 * math.pi


@kernel
def _mean_potential(p, i, j, floor):
    """Mean over panel i of panel j's unit potential and its image's [m]."""
    x, y, z = p.centers[i, 0], p.centers[i, 1], p.centers[i, 2]
    dx, dy, dz = x - p.centers[j, 0], y - p.centers[j, 1], z - p.centers[j, 2]
    reach = _OUTER * (p.diameters[j] + p.diameters[i])
    across = dx * dx + dy * dy
    near = across + dz * dz < reach * reach
    if not near and not (p.diameters[i] > z - floor and across < reach * reach):
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
    return filled(_fill_normal_gradients, out, rows, first, floor, panels)


@compiled
def _fill_normal_gradients(start, stop, rows, first, floor, p, out):
    grad = np.empty(3)
    for k in range(start, stop):
        for j in range(out.shape[1]):
            out[k, j] = _mean_normal_gradient(p, rows[k], first + j, floor, grad)


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
