"""The step, compiled: dielectrics in the first millimetres in front of a flat design.

A dielectric is a conductor that floats, with the impedance of its inside in series. The lift that
keeps bodies off the design changes the gap and not the inside. With D the change of the Maxwell
matrix by the lifted dielectric, F' that by the same body as a floating conductor, lifted, and F
that by the conductor where it is, by the gap law, the dielectric where it is changes

  (F⁻¹ + R)⁻¹,   R = D⁻¹ − F'⁻¹ ≥ 0.

It is never more than F, becomes F as the permittivity grows, and D where nothing is lifted. The
law adds charge to conductors, F ≥ F'; where it does not by its errors, nothing is added: the
inverses have poles there. The result may exceed F by as much.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._dense import eliminate
from capsense._jit import compiled

_SWEEPS = 30
"""Sweeps of Jacobi's method at most."""
_SMALL = 1e-6
"""Lower bound of eigenvalues, over the largest."""


@compiled
def in_series(
    dielectric: NDArray[Any], lifted: NDArray[Any], conductor: NDArray[Any]
) -> NDArray[Any]:
    """Change of the Maxwell matrix by a dielectric near a design, from three others; see above.

    Args:
        dielectric: D [m], symmetric, shape (m, m).
        lifted: F' [m], positive semidefinite, shape (m, m).
        conductor: F [m], shape (m, m).

    Returns:
        Its change [m], shape (m, m).
    """
    m = dielectric.shape[0]
    value, vector = eigen(lifted)
    largest = 0.0
    for i in range(m):
        largest = max(largest, value[i])
    if largest == 0.0:
        return dielectric.copy()
    root, inverse = np.empty(m), np.empty(m)
    for i in range(m):
        root[i] = math.sqrt(max(value[i], _SMALL * largest))
        inverse[i] = 1.0 / root[i]
    base = _scaled(vector, inverse)  # lifted becomes 1
    share, turn = eigen(_congruent(dielectric, base))
    base = _product(base, turn)
    back = _product(_transposed(turn), _transposed(_scaled(vector, root)))
    inside = np.empty(m)
    for i in range(m):
        inside[i] = math.sqrt(1.0 / min(max(share[i], _SMALL), 1.0) - 1.0)
    more = _positive_part(_congruent(difference(conductor, lifted), base))
    one = _identity(m)
    for i in range(m):
        more[i, i] += 1.0
    added = _behind(more, inside)
    same = _behind(one, inside)  # D, but for what was bounded
    change, out = _congruent(difference(added, same), back), np.empty((m, m))
    for i in range(m):
        for j in range(m):
            out[i, j] = dielectric[i, j] + 0.5 * (change[i, j] + change[j, i])
    return out


@compiled
def _behind(front: NDArray[Any], inside: NDArray[Any]) -> NDArray[Any]:
    """(front⁻¹ + diag(inside²))⁻¹ without an inverse of ``front``, which may be singular."""
    m = front.shape[0]
    half, matrix = _scaled(front, inside), _identity(m)
    for i in range(m):
        for j in range(m):
            matrix[i, j] += inside[i] * half[i, j]
    side = _transposed(half)
    eliminate(matrix, side)
    return difference(front, _product(half, side))


@compiled
def _positive_part(matrix: NDArray[Any]) -> NDArray[Any]:
    """A symmetric matrix without its negative eigenvalues."""
    value, vector = eigen(matrix)
    for i in range(value.shape[0]):
        value[i] = max(value[i], 0.0)
    return _product(_scaled(vector, value), _transposed(vector))


@compiled
def eigen(matrix: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Eigenvalues (m,) and eigenvectors (m, m), in columns, of a symmetric matrix, by Jacobi.

    Golub and Van Loan, *Matrix Computations*, section 8.5.
    """
    m, scale = matrix.shape[0], 0.0
    a, vector, value = np.empty((m, m)), _identity(m), np.empty(m)
    for i in range(m):
        for j in range(m):
            a[i, j] = 0.5 * (matrix[i, j] + matrix[j, i])
            scale = max(scale, abs(a[i, j]))
    for _ in range(_SWEEPS):
        most = 0.0
        for p in range(m):
            for q in range(p + 1, m):
                most = max(most, abs(a[p, q]))
                if abs(a[p, q]) <= 1e-15 * scale:
                    continue
                ratio = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                tangent = math.copysign(1.0, ratio) / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
                c = 1.0 / math.sqrt(1.0 + tangent * tangent)
                s = tangent * c
                for k in range(m):
                    x, y = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * x - s * y, s * x + c * y
                for k in range(m):
                    x, y = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * x - s * y, s * x + c * y
                for k in range(m):
                    x, y = vector[k, p], vector[k, q]
                    vector[k, p], vector[k, q] = c * x - s * y, s * x + c * y
        if most <= 1e-14 * scale:
            break
    for i in range(m):
        value[i] = a[i, i]
    return value, vector


# Loops, not array expressions: Numba's overloads of these take seconds of a first reading.


@compiled
def _identity(m: int) -> NDArray[Any]:
    """The unit matrix, shape (m, m)."""
    out = np.zeros((m, m))
    for i in range(m):
        out[i, i] = 1.0
    return out


@compiled
def _transposed(matrix: NDArray[Any]) -> NDArray[Any]:
    """A copy of a matrix with rows and columns exchanged."""
    out = np.empty((matrix.shape[1], matrix.shape[0]))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[j, i] = matrix[i, j]
    return out


@compiled
def _scaled(matrix: NDArray[Any], factor: NDArray[Any]) -> NDArray[Any]:
    """A copy of a matrix with each column times its factor."""
    out = np.empty(matrix.shape)
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            out[i, j] = matrix[i, j] * factor[j]
    return out


@compiled
def difference(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """``left - right``."""
    out = np.empty(left.shape)
    for i in range(left.shape[0]):
        for j in range(left.shape[1]):
            out[i, j] = left[i, j] - right[i, j]
    return out


@compiled
def _congruent(matrix: NDArray[Any], base: NDArray[Any]) -> NDArray[Any]:
    """``base.T @ matrix @ base``."""
    return _product(_product(_transposed(base), matrix), base)


@compiled
def _product(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """``left @ right``, bit-identical for any number of threads."""
    out = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                out[i, j] += left[i, k] * right[k, j]
    return out


def in_series_lossy(
    dielectric: NDArray[Any], lifted: NDArray[np.float64], conductor: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """As :func:`in_series`, of a body with losses, whose D is complex."""
    value, vector = np.linalg.eigh(0.5 * (lifted + lifted.T))
    if value[-1] <= 0.0:
        return dielectric
    root = np.sqrt(np.maximum(value, _SMALL * value[-1]))
    base, back, one = vector / root, (vector * root).T, np.eye(len(root))
    own = base.T @ dielectric @ base + _SMALL * one
    inside = np.linalg.inv(own) - one
    real = _positive_part(np.ascontiguousarray(inside.real))
    inside = real + 0.5j * (inside.imag + inside.imag.T)

    def behind(front: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.linalg.solve(one + front @ inside, front.astype(complex))

    more = _positive_part(base.T @ (conductor - lifted) @ base)
    out = back.T @ (behind(one + more) - behind(one)) @ back
    return np.asarray(dielectric + 0.5 * (out + out.T))
