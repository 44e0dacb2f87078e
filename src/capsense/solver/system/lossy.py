"""The step of scenes with losses: energies are complex; 4π eps0 = 1."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._dense import eliminate, whole_lines
from capsense.field.green_kernels import Green
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.gap.gap_kernels import fabric_change, near_bodies, press_out
from capsense.solver.gap.series_kernels import in_series_lossy
from capsense.solver.interaction.layer_kernels import face_charges, faces_of, fine_layers
from capsense.solver.system.step import SERIES, Solution, conductors_of, estimate, only, prepared
from capsense.solver.system.system_kernels import COARSE, GAIN, factorise, leaf_charges


def _product(left: NDArray[Any], right: NDArray[Any]) -> NDArray[Any]:
    """``left @ right``, bit-identical for any number of threads."""
    return np.einsum("ij,jk->ik", left, right)


def solve_lossy(
    records: NDArray[np.void],
    ties: NDArray[np.complex128],
    inverse_susceptibility: NDArray[np.complex128],
    green: Green,
    threshold: float,
    width: float,
) -> Solution:
    """Solve a scene whose energies are complex; charges are the part in phase.

    Args:
        records: The bodies, whose real softness is not looked at, nor are ties where ``ties`` are
            finite. Energies are linear in softness.
        ties: Energy of the bodies' net charges [1/m], infinite for floating ones, shape (n,).
        inverse_susceptibility: 1 / (eps - 1), shape (n,).
        green, threshold, width: As in :func:`prepared`.
    """
    fabric = np.zeros((green.terminals, green.terminals))
    fabric_change(records, green, fabric)
    records = records.copy()
    ties = np.where(records["layer"] > 0.0, 0.0, ties)  # of layers of dipoles
    records["inverse_susceptibility"] = np.abs(inverse_susceptibility)
    near = near_bodies(records, green, True)
    press_out(records, near, green)
    found = _lossy_lifted(records, ties, inverse_susceptibility, green, threshold, width)
    if not near.any():
        return found._replace(delta=found.delta + fabric)

    alone = only(records, near)
    own = found.delta
    if not near.all():
        own = _lossy_lifted(
            alone, ties[near], inverse_susceptibility[near], green, threshold, width
        ).delta
    alone["inverse_susceptibility"] = 0.0
    low, high = conductors_of(alone, green, threshold, width)
    change = in_series_lossy(own, low, high) - own
    delta = found.delta + change
    doubt = SERIES * np.abs(np.diag(change))[: green.electrodes].max(initial=0.0)
    return found._replace(delta=delta + fabric, error=found.error + float(doubt), near=near)


def _lossy_lifted(
    records: NDArray[np.void],
    ties: NDArray[np.complex128],
    inverse_susceptibility: NDArray[np.complex128],
    green: Green,
    threshold: float,
    width: float,
) -> Solution:
    """As :func:`solve_lossy`, of bodies that are lifted near the design."""
    plain = records.copy()
    plain["ground_elastance"], plain["inverse_susceptibility"] = 0.0, 0.0
    none = facing_of(plain[:0])
    cut, leaves, functions, system = prepared(plain, green, threshold, width, none, plain)
    fine = fine_layers(plain, functions, system.phi, green)
    fine = np.einsum("b,bij->ij", 1.0 / (1.0 + inverse_susceptibility), fine)
    plain["inverse_susceptibility"] = 1.0
    inside = prepared(plain, green, threshold, width, none, plain)[3]
    phi, real, below, own = system
    n, m = functions.solved, green.terminals
    factor = inverse_susceptibility[functions.body]
    matrix = np.concatenate([real, below]).astype(complex)
    matrix += factor[:, None] * np.concatenate([inside.matrix - real, inside.rest - below])
    diagonal = own + factor * (inside.diagonal - own)
    net = functions.net
    for b in range(len(records)):
        root = np.flatnonzero((functions.body == b) & net)
        others = np.flatnonzero(net & (records["group"][functions.body] == records["group"][b]))
        matrix[np.ix_(root, others)] += (
            ties[b] if np.isfinite(ties[b]) else records["ground_elastance"][b]
        )
    diagonal[:n] = np.diag(matrix)
    fade = functions.fade
    root = np.sqrt(fade[:n])
    faded = root[:, None] * matrix[:n] * root
    factor = np.empty((n, whole_lines(n)))
    shift = factorise(matrix[:n].real.copy(), root, diagonal.real.copy(), factor)
    np.fill_diagonal(faded, diagonal[:n] + shift * np.abs(diagonal[:n].real))
    solved = (root[:, None] * phi[:n, :m]).astype(complex)
    eliminate(faded, solved)
    solved *= root[:, None] if shift >= 0.0 else np.nan
    lack = GAIN * (1 - fade) * (1 - (1 - functions.parent_fade) ** 4) / diagonal
    residual = phi[:, :m] - _product(matrix, solved)
    extra = lack[:, None] * residual
    left = _product(residual.T, extra)
    x = np.zeros((len(fade), m), complex)
    x[:n], x[n:] = solved, extra[n:]
    delta = _product(phi[:n, :m].T, solved) + left
    delta, left = delta + fine, left + SERIES * fine
    coarse = (
        COARSE * (functions.panel_end_fraction[:n] * np.abs(diagonal[:n])) @ np.abs(solved) ** 2
    )
    charge = leaf_charges(cut, functions, np.ascontiguousarray(x.real), len(leaves.points))
    leaves, first = faces_of(leaves)
    charge = face_charges(charge, first)
    delta, left = 0.5 * (delta + delta.T), np.ascontiguousarray(left.real)
    error = estimate(np.ascontiguousarray(delta.real), left, coarse, shift, green.electrodes)
    return Solution(
        delta, left, coarse, charge,
        leaves.points, leaves.extent, leaves.softening_length, leaves.owner, n, shift, error,
        np.zeros(len(records), np.bool_), np.full(len(records), -1), np.zeros((m, m)),
    )  # fmt: skip
