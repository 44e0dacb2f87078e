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
Ints = NDArray[np.int64]

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


def flux_block(panels: SurfacePanels, rows: Ints | None = None) -> Array:
    """Fluxes of the fields of unit charges on the panels through the panels.

    Args:
        panels: Panels of the body.
        rows: Through which panels, shape (k,); all by default.

    Returns:
        Shape (k, n), the integral of E along the normal over panel k from unit charge on panel l;
        principal value, zero on the diagonal. Columns of a closed surface add up to 2π.
    """
    rows = np.arange(len(panels)) if rows is None else rows
    out = np.empty((len(rows), len(panels)))
    kernels.fill_flux(_packed(panels), rows, out)
    return out


class _Patterns:
    """Charges that mirror images of a body keep or reverse, and matrices on them.

    A matrix that does not change when the panels are mirrored takes patterns of one kind to those
    of the same kind. There are up to eight kinds, of an eighth of the panels each: what costs the
    third power of the panels costs 64 times less.

    Args:
        panels: Panels of the body.
        same: Labels that the images of a panel must share, shape (n,).
    """

    def __init__(self, panels: SurfacePanels, same: Ints) -> None:
        image, first, self._by = panels.mirrors
        if not (same[image] == same).all():
            image, first = np.arange(len(panels))[None], np.arange(len(panels))
            self._by = np.zeros_like(first)
        self.firsts, self._number = np.unique(first, return_inverse=True)
        self._maps, self._image = image, image[:, self.firsts]
        self._signs: Array = np.ones((1, 1))  # of each kind, under each map
        while len(self._signs) < len(image):
            self._signs = np.block([[self._signs, self._signs], [self._signs, -self._signs]])
        stays = self._image == self.firsts
        self._times = np.sqrt(stays.sum(axis=0))
        self._kinds = [np.flatnonzero(~stays[signs < 0.0].any(axis=0)) for signs in self._signs]

    def matrix(self, rows: Array) -> list[Array]:
        """A matrix on the patterns of each kind, from its rows of the first images, (k, n)."""
        turned = rows[:, self._image] / (self._times[:, None, None] * self._times)
        return [
            np.einsum("g,agb->ab", signs, turned)[np.ix_(kind, kind)]
            for signs, kind in zip(self._signs, self._kinds, strict=True)
        ]

    def vectors(self, values: Array) -> list[Array]:
        """The share of each kind in values on panels, (n, m) -> (patterns, m)."""
        scale = 1.0 / (math.sqrt(len(self._image)) * self._times[:, None])
        return [
            (scale * np.einsum("g,gam->am", signs, values[self._image]))[kind]
            for signs, kind in zip(self._signs, self._kinds, strict=True)
        ]

    def values(self, vectors: list[Array]) -> Array:
        """The values on panels, (n, m), from those of the patterns of each kind."""
        out = np.zeros((len(self._by), vectors[0].shape[1]))
        for signs, kind, vector in zip(self._signs, self._kinds, vectors, strict=True):
            whole = np.zeros((len(self.firsts), vector.shape[1]))
            whole[kind] = self._times[kind, None] * vector
            out += signs[self._by, None] * whole[self._number]
        return out / math.sqrt(len(self._image))

    def block(self, matrices: list[Array]) -> Array:
        """The matrix on panels, (n, n), from those on the patterns of each kind."""
        maps, count = len(self._image), len(self.firsts)
        whole = np.zeros((maps, count, count))
        for out, kind, matrix in zip(whole, self._kinds, matrices, strict=True):
            out[np.ix_(kind, kind)] = matrix
        turned = np.tensordot(self._signs, whole, 1) * (self._times[:, None] * self._times / maps)
        rows = np.ascontiguousarray(turned[self._by, :, self._number].T)  # of the first images
        out = np.empty((len(self._by), len(self._by)))
        for image in self._maps:
            out[image[self.firsts]] = rows.take(image, axis=1)
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
    kinds = _Patterns(panels, region)
    potentials, insides = kinds.matrix(free[kinds.firsts]), kinds.vectors(inside)
    fluxes = kinds.matrix(flux_block(panels, kinds.firsts))
    charges = [
        sl.cho_solve(sl.cho_factor(own, lower=True), within)
        for own, within in zip(potentials, insides, strict=True)
    ]
    charge, z = kinds.values(charges), []
    parts = np.linalg.inv(inside.T @ charge)
    for own, through, within, part in zip(potentials, fluxes, insides, charges, strict=True):
        mixed, weights = own @ through, part @ parts
        passed = 2 * math.pi * own - 0.5 * (mixed + mixed.T)
        passed = _projected(passed, weights, within)
        z.append(_projected(_inverted(passed, own, within), weights, within))
    for potential, flux in reversed(_harmonics(panels)):
        u = (potential[:, :, None] * inside[:, None, :]).reshape(len(panels), -1)
        g = (flux[:, :, None] * inside[:, None, :]).reshape(len(panels), -1)
        share = charge * inside
        u -= inside @ ((share / share.sum(axis=0)).T @ u)
        z = _updated(z, kinds.vectors(u), kinds.vectors(g))
    out, total = kinds.block(z), charge.sum(axis=1)
    crossing = inside - np.outer(np.ones(len(panels)), inside.T @ total / total.sum())
    if inside.shape[1] > 1:
        out += _WALL_PENALTY * float(np.diag(out).mean()) * (crossing @ crossing.T)
    return out


def _projected(matrix: Array, weights: Array, inside: Array) -> Array:
    """PᵀMP, P taking charges with these weights out until no part has net charge."""
    side = (matrix @ weights) @ inside.T
    corner = inside @ (weights.T @ matrix @ weights) @ inside.T
    return np.asarray(matrix - side - side.T + corner)


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


def _updated(z: list[Array], potential: list[Array], flux: list[Array]) -> list[Array]:
    """The Z nearest in kind that takes ``flux`` (n, m) to 4π ``potential``, all by patterns."""
    energy: Array = np.sum([u.T @ g for u, g in zip(potential, flux, strict=True)], axis=0)
    energy = 0.5 * (energy + energy.T)
    inverse = np.linalg.pinv(energy, rcond=1e-9, hermitian=True)
    scaled = [u @ inverse for u in potential]
    found = [block @ g for block, g in zip(z, flux, strict=True)]
    core = 4 * math.pi * energy + sum(g.T @ f for g, f in zip(flux, found, strict=True))
    sides = [f @ u.T for f, u in zip(found, scaled, strict=True)]
    return [
        block - side - side.T + u @ core @ u.T
        for block, side, u in zip(z, sides, scaled, strict=True)
    ]


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
