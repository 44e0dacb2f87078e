"""Scenes with lossy matter: the same system with complex energies, in NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from capsense.surface.solve_kernels import GAIN, Solution, leaf_charges, prepared
from capsense.surface.step_kernels import Green


def solve_lossy(
    records: NDArray[np.void],
    ties: NDArray[np.complex128],
    softness: NDArray[np.complex128],
    impedances: Sequence[NDArray[np.float32] | None],
    green: Green,
    threshold: float,
    width: float,
) -> Solution:
    """Solve a scene whose energies are complex; what is returned is the part in phase.

    Args:
        records: The bodies, whose real softness is not looked at, nor are ties where ``ties`` are
            finite.
        ties: Energy of the bodies' net charges [1/m], infinite for floating ones, shape (n,).
        softness: 1 / (eps - 1), shape (n,).
        impedances: Interior impedance of each body, None for conductors and changing surfaces.
        green, threshold, width: As in ``solve_kernels.solve``.
    """
    plain = records.copy()
    plain["tie"], plain["impedance"] = 0.0, 0
    cut, functions, phi, real, below, own, points, extent, owner = prepared(
        plain, green, threshold, width
    )
    n, m = functions.solved, green.terminals
    matrix = np.concatenate([real, below]).astype(complex)
    diagonal = own.astype(complex)
    net = functions.cluster < 0
    for b in range(len(records)):
        mine = np.flatnonzero((functions.body == b) & ~net)
        z = impedances[b]
        if z is not None:
            number = functions.number
            inside = mine[mine < n]
            factor = softness[b] / records["scale"][b]
            matrix[np.ix_(mine, inside)] += factor * z[np.ix_(number[mine], number[inside])]
            diagonal[mine] += factor * z[number[mine], number[mine]]
        root = np.flatnonzero((functions.body == b) & net)
        others = np.flatnonzero(net & (records["group"][functions.body] == records["group"][b]))
        matrix[np.ix_(root, others)] += ties[b] if np.isfinite(ties[b]) else records["tie"][b]
        diagonal[root] = matrix[root, root]
    clusters = np.where(net, 0, functions.cluster)
    fade = np.where(net, 1.0, cut.fade[clusters])
    root = np.sqrt(fade[:n])
    system = root[:, None] * matrix[:n] * root
    np.fill_diagonal(system, np.diag(matrix[:n]))
    solved = root[:, None] * scipy.linalg.solve(system, root[:, None] * phi[:n, :m], assume_a="sym")
    lack = GAIN * (1 - fade) * (1 - (1 - np.where(net, 1.0, cut.above[clusters])) ** 4) / diagonal
    residual = phi[:, :m] - matrix @ solved
    extra = lack[:, None] * residual
    left = residual.T @ extra
    x = np.zeros((len(fade), m), complex)
    x[:n], x[n:] = solved, extra[n:]
    delta = phi[:n, :m].T @ solved + left
    charge = leaf_charges(cut, functions, np.ascontiguousarray(x.real), len(points))
    return Solution(
        np.ascontiguousarray(0.5 * (delta + delta.T).real), np.ascontiguousarray(left.real),
        charge, points, extent, owner, n, 0.0,
    )  # fmt: skip
