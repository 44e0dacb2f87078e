"""What a scan of a scene finds: ties, energies and couplings, as records and how they are added."""

from __future__ import annotations

import numpy as np

from capsense._jit import kernel
from capsense.constants import EPS0

UNIT = EPS0 * 1e-3
"""Weights are stored in this unit [F], which makes them of order one."""

STOREY = np.dtype(
    [
        ("first", np.int64),
        ("shape", np.int64, (3,)),
        ("begin", np.int64, (3,)),
        ("lowest", np.int64, (3,)),
        ("highest", np.int64, (3,)),
    ]
)
"""First node and shape of a storey, where its coordinates begin along each axis, and the first and
last node on a line whose values may be used together (the floor's and ceiling's may not)."""
LINK = np.dtype([("weight", np.float32), ("eps_r", np.float32), ("cut", np.int64)])
"""Weight and permittivity in the empty domain, and the number of the link's cut; −1: none."""
NODE = np.dtype([("owner", np.int64), ("kink", np.bool_), ("plain", np.bool_)])
"""What holds a node, whether the background field has a kink there, and whether its links along x,
y and z to the next nodes are all whole."""
CUT = np.dtype(
    [
        ("half", np.float64, (2,)),
        ("length", np.float64, (2,)),
        ("owner", np.int64, (2,)),
    ]
)
"""Weights of both half-links, their lengths as fractions of the link, what holds their ends."""
TIE = np.dtype(
    [
        ("node", np.int64),
        ("weight", np.float64),
        ("conductor", np.int64),
        ("point", np.int64, (4,)),
        ("coef", np.float64, (4,)),
        ("end", np.int64),
        ("end_coef", np.float64),
    ]
)
"""A conductance from a node (−1: a held end) to a conductor, at a place where the background
potential is ``Σ_k coef[k] φ[point[k]] + end_coef φ_end``."""
ENERGY = np.dtype(
    [
        ("a", np.int64),
        ("b", np.int64),
        ("end", np.int64),
        ("weight", np.float64),
        ("drives", np.bool_),
    ]
)
"""Adds ``weight · Δφ_i Δφ_j`` over a link from a to b (−1: the held ``end``). Where it drives, it
loads both ends too (a dielectric)."""
COUPLE = np.dtype([("a", np.int64), ("b", np.int64), ("weight", np.float64)])
"""Two conductors that face each other on one link."""


@kernel
def storey_of(storeys, node, guess):
    """Number of the storey that a node is of, searched from a guess on."""
    s = guess
    while node < storeys[s].first:
        s -= 1
    while s + 1 < storeys.shape[0] and node >= storeys[s + 1].first:
        s += 1
    return s


@kernel
def room(ties, energies, couples, counts):
    """Whether the buffers hold what one link may add."""
    return (
        counts[0] + 8 <= ties.shape[0]
        and counts[1] + 4 <= energies.shape[0]
        and counts[2] + 8 <= couples.shape[0]
    )


@kernel
def add_energy(energies, counts, a, b, end, weight, drives):
    term = energies[counts[1]]
    term.a, term.b, term.end, term.weight, term.drives = a, b, end, weight, drives
    counts[1] += 1


@kernel
def add_tie(ties, counts, extra, node, conductor, point, end, weight):
    """Tie a node (−1: a held end) to a conductor, where the background has a node's potential.

    That of the node ``point``; of the held ``end`` if this is −1.
    """
    tie = ties[counts[0]]
    tie.node, tie.conductor, tie.weight = node, conductor, weight
    for k in range(4):
        tie.point[k], tie.coef[k] = max(point, 0), 0.0
    tie.coef[0] = 1.0 if point >= 0 else 0.0
    tie.end, tie.end_coef = end, 1.0 if point < 0 else 0.0
    if node >= 0:
        extra[node] += weight
    counts[0] += 1


@kernel
def value_beside_sheet(tie, na, nb, end, s, shift):
    """Background potential at fraction s of a half-link from na or to nb: linear along it."""
    point, coef = tie.point, tie.coef
    for k in range(4):
        point[k], coef[k] = na if na >= 0 else nb, 0.0
    at_b = s - shift
    coef[0] = 1.0 - at_b if na >= 0 else at_b
    tie.end = end
    tie.end_coef = at_b if na >= 0 else 1.0 - at_b


@kernel
def value_on_link(tie, a, b, nodes, c, m, lowest, highest, t, shift):
    """Coefficients of the background potential at t on the link from a to b.

    Cubic where both neighbours beyond the link are smooth, of lower order beside an electrode or
    a layer's face, and at the ends of the line at ``lowest`` and ``highest``. The drop over a
    dielectric in front of the conductor is added linearly: ``phi(t) + shift (phi_a − phi_b)``.
    """
    stride = b - a
    before = m > lowest and m < highest and not nodes[a].kink
    after = m + 1 < highest and not nodes[b].kink
    x1, x2 = c[m], c[m + 1]
    l0, l1, l2, l3 = 0.0, (t - x2) / (x1 - x2), (t - x1) / (x2 - x1), 0.0
    if before:
        x0 = c[m - 1]
        l0 = (t - x1) * (t - x2) / ((x0 - x1) * (x0 - x2))
        l1 *= (t - x0) / (x1 - x0)
        l2 *= (t - x0) / (x2 - x0)
    if after:
        x3 = c[m + 2]
        l3 = (t - x1) * (t - x2) / ((x3 - x1) * (x3 - x2))
        l1 *= (t - x3) / (x1 - x3)
        l2 *= (t - x3) / (x2 - x3)
        if before:
            l0 *= (t - x3) / (c[m - 1] - x3)
            l3 *= (t - c[m - 1]) / (x3 - c[m - 1])
    point, coef = tie.point, tie.coef
    point[0], point[1] = a - stride if before else a, a
    point[2], point[3] = b, b + stride if after else b
    coef[0], coef[1], coef[2], coef[3] = l0, l1 + shift, l2 - shift, l3
    tie.end, tie.end_coef = -3, 0.0
