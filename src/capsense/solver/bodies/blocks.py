"""Blocks of a rigid body alone in space: potentials of its panels, their fluxes, its inside.

Metres, 4π eps0 = 1. The unknown of a panel is its charge, spread evenly.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl
from numpy.typing import NDArray

from capsense.errors import SceneError
from capsense.field.polygon_kernels import solid_angle
from capsense.solver.bodies import panel_kernels as kernels
from capsense.solver.bodies.panels import SurfacePanels

Array = NDArray[np.float64]

_BEND = 0.5
"""How far the points on touching panels crowd towards edges, where the other's potential bends."""
_WALL_PENALTY = 1e6
"""Impedance between unconnected parts of a body, over the mean of the diagonal."""
_LEAST_RATE = 1e-3
"""Least rate (of at most 4π) at which a pattern of charge is let through the inside."""


def free_block(panels: SurfacePanels) -> Array:
    """Mean potentials of unit charges on the panels of a body alone in space.

    Args:
        panels: Panels of the body.

    Returns:
        F [1/m], shape (n, n), symmetric and positive definite: F_kl is the mean over panel k of
        the potential of unit charge spread evenly on panel l.
    """
    out = np.empty((len(panels), len(panels)))
    kernels.fill_free(_packed(panels), panels.mirrors, out)
    return out


def flux_block(panels: SurfacePanels) -> Array:
    """Fluxes of the fields of unit charges on the panels through the panels.

    Args:
        panels: Panels of the body.

    Returns:
        Shape (n, n), the integral of E along the normal over panel k from unit charge on panel l;
        principal value, zero on the diagonal. Columns of a closed surface add up to 2π.
    """
    p = _packed(panels)
    out = np.empty((len(panels), len(panels)))
    kernels.fill_flux(p, out)
    return out


def impedance(panels: SurfacePanels, free: Array) -> Array:
    """What a dielectric adds to the free-space block: F + Z / (eps − 1) on charges that add to 0.

    With u the potential on the surface, a body of relative permittivity eps carries the bound
    charge x = −(eps − 1) Y u, 4π Y being the operator from u to its flux inside. In terms of the
    layer of charge y = F⁻¹ u that makes u inside, this flux is (2π − B) y, B the flux block;
    F B is symmetric (Calderón's identity) up to the panels' size and is made so, which gives
    Z = 4π F (2πF − F B)⁻¹ F on charges without sum. The patterns of charge that linear and
    quadratic potentials make inside, known in closed form, are then put in by the update of
    Broyden, Fletcher, Goldfarb and Shanno, which keeps Z positive; uniform fields are so exact.

    Args:
        panels: Panels of a closed surface, n of them.
        free: Their free-space block [1/m], shape (n, n).

    Returns:
        Z [1/m], shape (n, n), symmetric, positive semidefinite; zero on the equilibrium charge of
        the whole body. Charge that would cross between unconnected parts finds a very large Z.

    Raises:
        SceneError: The surface is open.
    """
    if not panels.closed:
        raise SceneError(
            "the surface is open, so it has no inside; a dielectric needs a closed surface"
        )
    region = _regions(panels)
    inside = np.eye(region.max() + 1)[region]
    charge = sl.cho_solve(sl.cho_factor(free, lower=True), inside)
    mixed = free @ flux_block(panels)
    passed = 2 * math.pi * free - 0.5 * (mixed + mixed.T)
    passed = _projected(passed, charge, inside)
    z = _projected(_inverted(passed, free, inside), charge, inside)
    for potential, flux in reversed(_harmonics(panels)):
        u = (potential[:, :, None] * inside[:, None, :]).reshape(len(panels), -1)
        g = (flux[:, :, None] * inside[:, None, :]).reshape(len(panels), -1)
        own = charge * inside
        weights = own / own.sum(axis=0)
        u -= inside @ (weights.T @ u)
        z = _updated(z, u, g)
    total = charge.sum(axis=1)
    crossing = inside - np.outer(np.ones(len(panels)), inside.T @ total / total.sum())
    if inside.shape[1] > 1:
        z += _WALL_PENALTY * float(np.diag(z).mean()) * (crossing @ crossing.T)
    return z


def _projected(matrix: Array, charge: Array, inside: Array) -> Array:
    """PᵀMP, P taking the equilibrium charges of the parts out until no part has net charge."""
    weights = charge @ np.linalg.inv(inside.T @ charge)
    side = (matrix @ weights) @ inside.T
    corner = inside @ (weights.T @ matrix @ weights) @ inside.T
    return matrix - side - side.T + corner


def _inverted(passed: Array, free: Array, inside: Array) -> Array:
    """4π F G⁺ F, where G may be singular on the equilibrium charges and nowhere else."""
    lifted = passed + float(np.abs(passed).mean()) * (inside @ inside.T)
    try:
        factor = np.linalg.cholesky(lifted)
    except np.linalg.LinAlgError:
        rates, modes = sl.eigh(lifted, free)
        half = (free @ modes) / np.sqrt(np.maximum(rates, _LEAST_RATE))
        return 4 * math.pi * half @ half.T
    half = sl.solve_triangular(factor, free, lower=True, check_finite=False)
    return 4 * math.pi * half.T @ half


def _harmonics(panels: SurfacePanels) -> list[tuple[Array, Array]]:
    """Linear (n, 3) and quadratic (n, 5) potentials, means over panels, and fluxes out of them."""
    x = panels.centers - panels.areas @ panels.centers / panels.areas.sum()
    second = panels.moments + x[:, :, None] * x[:, None, :]
    normal = panels.areas[:, None] * panels.normals
    forms = np.zeros((5, 3, 3))
    for k, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        forms[k, a, b] = forms[k, b, a] = 0.5
    forms[3] = np.diag([1.0, -1.0, 0.0])
    forms[4] = np.diag([-0.5, -0.5, 1.0])
    potential = np.einsum("kab,nab->nk", forms, second)
    flux = 2 * np.einsum("na,kab,nb->nk", normal, forms, x)
    return [(x, normal), (potential, flux)]


def _updated(z: Array, potential: Array, flux: Array) -> Array:
    """The Z nearest in kind that takes ``flux`` (n, m) to 4π ``potential``."""
    energy = potential.T @ flux
    inverse = np.linalg.pinv(0.5 * (energy + energy.T), rcond=1e-9, hermitian=True)
    scaled = potential @ inverse
    found = z @ flux
    side = found @ scaled.T
    corner = scaled @ (flux.T @ found + 4 * math.pi * 0.5 * (energy + energy.T)) @ scaled.T
    return z - side - side.T + corner


def _regions(panels: SurfacePanels) -> NDArray[np.int64]:
    """Number of the volume that each panel bounds: cavities belong to what is round them."""
    parts, volume = panels.parts, panels.volumes
    solid = np.flatnonzero(volume > 0)
    solid = solid[np.argsort(volume[solid], kind="stable")]
    owner = np.arange(len(volume))
    edges = edges_of(panels)
    for k in np.flatnonzero(volume <= 0):
        point = panels.centers[np.argmax(parts == k)]
        for s in solid:
            seen = sum(
                solid_angle(edges[i], panels.normals[i], *point) for i in np.flatnonzero(parts == s)
            )
            if abs(seen) > 2 * math.pi:
                owner[k] = s
                break
    _, out = np.unique(owner[parts], return_inverse=True)
    return out.reshape(-1).astype(np.int64)


class _Packed(NamedTuple):
    """Panels as the kernels take them."""

    flat: Array
    """Centres, second moments xx, yy, zz, xy, xz, yz, and reaches; shape (10, n)."""
    edges: Array
    """Ends of the four edges of every panel [m], shape (n, 4, 2, 3)."""
    normals: Array
    """Unit normals, shape (n, 3)."""
    areas: Array
    """Areas [m²], shape (n,)."""
    coarse: Array
    """Points and weights for near pairs, shape (n, 9, 4)."""
    fine: Array
    """Points and weights for touching pairs, shape (n, 16, 4)."""
    rim: Array
    """Points and weights for a panel's own potential, shape (n, 12, 4)."""


def _packed(panels: SurfacePanels) -> _Packed:
    flat = np.empty((10, len(panels)))
    flat[:3] = panels.centers.T
    for k, (a, b) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        flat[3 + k] = panels.moments[:, a, b]
    trace = np.einsum("naa->n", panels.moments)
    spread = 2 * np.einsum("nab,nab->n", panels.moments, panels.moments) - trace**2
    flat[9] = np.sqrt(1.5 * (trace + np.sqrt(np.maximum(spread, 0.0))))
    n = len(panels)
    coarse, fine, rim = np.empty((n, 9, 4)), np.empty((n, 16, 4)), np.empty((n, 12, 4))
    lines = _line(3, 0.0), _line(4, _BEND), _line(6, 1.0)
    kernels.fill_points(panels.corners, lines, (coarse, fine, rim))
    normals = np.ascontiguousarray(panels.normals)
    return _Packed(flat, edges_of(panels), normals, panels.areas, coarse, fine, rim)


def edges_of(panels: SurfacePanels) -> Array:
    """Ends of the four edges of every panel [m], shape (n, 4, 2, 3)."""
    return np.stack([panels.corners, np.roll(panels.corners, -1, axis=1)], axis=2)


@lru_cache
def _line(order: int, bend: float) -> tuple[Array, Array]:
    """Gauss points and weights on 0 ... 1, moved towards the ends by ``bend`` of 3t² − 2t³."""
    t, w = np.polynomial.legendre.leggauss(order)
    t, w = 0.5 * (t + 1), 0.5 * w
    return t + bend * (3 * t**2 - 2 * t**3 - t), w * (1 + bend * (6 * t * (1 - t) - 1))
