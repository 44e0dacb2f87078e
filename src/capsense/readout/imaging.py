"""Sensitivity of capacitances to permittivity in space, and images from capacitances.

For two electrodes with unit potentials φ_i and φ_j the Maxwell matrix has the derivative
``∂C_ij/∂ε = ∫ ∇φ_i · ∇φ_j dV`` (Geselowitz 1971; in capacitance tomography, the sensitivity
theorem). On a rectilinear grid the energy of a cell is that of its twelve edges, each with a
quarter of the cell's cross-section; so discretised, the derivative is exact for 7-point fields.

A sensitivity matrix J has a row for each pair of electrodes and a column for each voxel. An image
is the voxels' change of permittivity that explains a change of capacitances d = J g. There are far
fewer pairs than voxels: what an image shows is where something is, not what.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from capsense._validate import as_number
from capsense.constants import EPS0
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, finite, require, require_whole

Axes = tuple[ArrayLike, ArrayLike, ArrayLike]


def electrode_pairs(count: int, *, diagonal: bool = False) -> tuple[tuple[int, int], ...]:
    """Pairs i < j of ``count`` electrodes, row by row; with ``diagonal`` also i = j."""
    shift = 0 if diagonal else 1
    return tuple((i, j) for i in range(count) for j in range(i + shift, count))


def sensitivity(potentials: ArrayLike, axes: Axes, pairs: Sequence[tuple[int, int]]) -> Array:
    """Derivatives of Maxwell matrix entries by the relative permittivity of voxels.

    Args:
        potentials: Potential at the grid's nodes with each electrode at 1 V in turn, others at
            0 V, shape (nx, ny, nz, M).
        axes: Node coordinates along x, y and z [m], rising.
        pairs: Pairs (i, j) of electrodes.

    Returns:
        J [F], shape (len(pairs), (nx−1)(ny−1)(nz−1)): voxels are the grid's cells, z fastest.
        For two electrodes side by side J is negative between them, where matter adds to their
        (negative) entry of C, and positive above, where both fields point the same way.

    Raises:
        ReadoutError: Shapes do not fit, an axis does not rise, or an electrode does not exist.
    """
    phi, (x, y, z) = _field(potentials, axes, pairs)
    volume = EPS0 * x[:, None, None] * y[None, :, None] * z[None, None, :]
    out = np.zeros((len(pairs), *volume.shape))
    for axis, spacing in enumerate((x, y, z)):
        shape = [1, 1, 1]
        shape[axis] = len(spacing)
        weight = 0.25 * volume / spacing.reshape(shape) ** 2
        rise = np.diff(phi, axis=axis)
        for row, (i, j) in enumerate(pairs):
            out[row] += weight * _four_edges(rise[..., i] * rise[..., j], axis)
    return out.reshape(len(pairs), -1)


def grounded_sensitivity(
    potentials: ArrayLike, axes: Axes, pairs: Sequence[tuple[int, int]]
) -> Array:
    """What a little grounded conductor in a voxel adds to Maxwell matrix entries.

    A conductor held at 0 V that is small against its distance, of capacitance c by itself (4πε₀a
    for a sphere), adds ``ΔC_ij = c φ_i φ_j`` to every entry: it takes the charge that brings it to
    0 V. People and grounded machines are seen by this, and not by their permittivity.

    Args:
        potentials: As for :func:`sensitivity`.
        axes: As for :func:`sensitivity`.
        pairs: Pairs (i, j) of electrodes.

    Returns:
        J, without unit, shape (len(pairs), voxels); an image is capacitance in voxels [F].

    Raises:
        ReadoutError: Shapes do not fit, an axis does not rise, or an electrode does not exist.
    """
    phi, _ = _field(potentials, axes, pairs)
    out = []
    for i, j in pairs:
        product = phi[..., i] * phi[..., j]
        along = 0.5 * (product[1:] + product[:-1])
        out.append(0.25 * _four_edges(along, 0).ravel())
    return np.array(out).reshape(len(pairs), -1)


def voxel_centres(axes: Axes) -> Array:
    """Middles of the grid's cells [m], shape (voxels, 3), in the order of J's columns."""
    middle = [0.5 * (np.asarray(a)[1:] + np.asarray(a)[:-1]) for a in axes]
    return np.stack(np.meshgrid(*middle, indexing="ij"), axis=-1).reshape(-1, 3)


def _field(
    potentials: ArrayLike, axes: Axes, pairs: Sequence[tuple[int, int]]
) -> tuple[Array, tuple[Array, ...]]:
    """Checked potentials, and the spacings of the axes."""
    phi = finite("potentials", potentials)
    if len(axes) != 3:
        raise ReadoutError(f"{len(axes)} axes are given; give node coordinates along x, y and z")
    steps = tuple(_axis(name, a) for name, a in zip("xyz", axes, strict=True))
    if phi.ndim != 4 or phi.shape[:3] != tuple(len(s) + 1 for s in steps):
        raise ReadoutError(
            f"potentials have shape {phi.shape}; these axes need "
            f"{(*(len(s) + 1 for s in steps), 'M')}"
        )
    for pair in pairs:
        if len(pair) != 2:
            raise ReadoutError(f"pair {pair} names {len(pair)} electrodes; give two")
        for electrode in pair:
            require_whole(f"pair {pair}", "an electrode", electrode, 0, phi.shape[3] - 1)
    return phi, steps


def _axis(name: str, nodes: ArrayLike) -> Array:
    """Spacings of an axis."""
    array = finite(f"axis {name}", nodes)
    if array.ndim != 1 or len(array) < 2 or not (np.diff(array) > 0).all():
        raise ReadoutError(f"axis {name} must hold at least two rising coordinates in metres")
    return np.diff(array)


def _four_edges(product: Array, axis: int) -> Array:
    """Sum over a cell's four edges along ``axis``."""
    for across in range(3):
        if across != axis:
            nodes = np.moveaxis(product, across, 0)
            product = np.moveaxis(nodes[1:] + nodes[:-1], 0, across)
    return product


def back_projection(matrix: ArrayLike) -> Array:
    """Linear back-projection: R = Jᵀ, each voxel's row divided by its length; one product a frame.

    A voxel is as bright as the change looks like its own signal. What a single voxel changes is
    therefore brightest in that voxel (Cauchy–Schwarz); everything else is blurred.

    Args:
        matrix: J, shape (pairs, voxels).

    Returns:
        R, shape (voxels, pairs).

    Raises:
        ReadoutError: J is no matrix, or a number is not finite.
    """
    return _unit_columns(_checked(matrix)).T


def tikhonov(matrix: ArrayLike, strength: float = 1e-2, *, standardised: bool = True) -> Array:
    """Tikhonov regularisation: R = Jᵀ (J Jᵀ + λ I)⁻¹, one matrix product a frame.

    The image minimises ``|J g − d|² + λ |g|²``; it is drawn towards the electrodes, where little
    explains much. Standardised, each voxel is divided by √(R J)_vv, what its own signal would make
    of it, and what a single voxel changes is brightest in that voxel (Pascual-Marqui 2002).

    Args:
        matrix: J, shape (pairs, voxels).
        strength: λ as a share of the largest eigenvalue of J Jᵀ, above zero. The more noise, the
            more.
        standardised: Whether to show where something is; otherwise the minimiser itself.

    Returns:
        R, shape (voxels, pairs).

    Raises:
        ReadoutError: ``strength`` is not above zero, J is no matrix or zero, or a number is not
            finite.
    """
    j = _checked(matrix)
    require("Tikhonov", "strength", strength, 0.0, "", open_=True)
    normal = j @ j.T
    loaded = normal + strength * _largest(normal) * np.eye(len(j))
    inverse = np.asarray(np.linalg.solve(loaded, j).T, dtype=float)
    if not standardised:
        return inverse
    own = (inverse * j.T).sum(axis=1)
    return np.asarray(inverse / np.sqrt(np.where(own > 0, own, 1.0))[:, None], dtype=float)


def landweber(
    matrix: ArrayLike,
    iterations: int = 200,
    *,
    low: float = 0.0,
    high: float = math.inf,
    unit_voxels: bool = False,
) -> Callable[[ArrayLike], Array]:
    """Projected Landweber iteration: ``g ← clip(g + α Jᵀ (d − J g), low, high)``.

    α is 1/λ_max(J Jᵀ), below the 2/λ_max that converges. The projection onto what matter can be
    (no permittivity below vacuum's) keeps images from ringing.

    Args:
        matrix: J, shape (pairs, voxels).
        iterations: Number of steps.
        low: Least change of relative permittivity; 0 keeps images positive.
        high: Largest change.
        unit_voxels: Whether images and bounds count each voxel by the signal that it gives [F], not
            by its permittivity: fairer to what is far away.

    Returns:
        A function that takes d, changes of capacitance [F], shape (pairs,) or (n, pairs), to
        images, shape (voxels,) or (n, voxels). It raises :class:`ReadoutError` if the shape does
        not fit.

    Raises:
        ReadoutError: J is no matrix or zero, or bounds or iterations are out of range.
    """
    j = _checked(matrix)
    require_whole("Landweber", "iterations", iterations, 1)
    if not as_number(low) < as_number(high):
        raise ReadoutError(f"low = {low!r}, high = {high!r}; give numbers, low below high")
    j = _unit_columns(j) if unit_voxels else j
    return partial(_landweber, j, 1.0 / _largest(j @ j.T), iterations, low, high)


def _landweber(
    j: Array, step: float, iterations: int, low: float, high: float, change: ArrayLike
) -> Array:
    d = finite("change", change)
    if d.shape[-1:] != (len(j),):
        raise ReadoutError(f"change has shape {d.shape}; give {len(j)} numbers an image")
    image = np.clip(np.zeros((*d.shape[:-1], j.shape[1])), low, high)
    for _ in range(iterations):
        image = np.clip(image + step * ((d - image @ j.T) @ j), low, high)
    return image


def _checked(matrix: ArrayLike) -> Array:
    j = finite("J", matrix)
    if j.ndim != 2 or not j.size:
        raise ReadoutError(f"J has shape {j.shape}; give it as (pairs, voxels)")
    return j


def _unit_columns(j: Array) -> Array:
    """Columns divided by their lengths; those that are zero stay so."""
    length = np.linalg.norm(j, axis=0)
    return np.asarray(j / np.where(length > 0, length, 1.0), dtype=float)


def _largest(normal: Array) -> float:
    """Largest eigenvalue of J Jᵀ."""
    largest = float(np.linalg.eigvalsh(normal)[-1])
    if largest <= 0:
        raise ReadoutError("the sensitivity matrix is zero; check the potentials")
    return largest
