"""The step, compiled: the system of the chosen charge functions, its solution, what is left."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._dense import (
    WIDTH,
    add_products,
    cholesky,
    mirror,
    multiply_part,
    padded,
    square,
    substitute,
    subtract_product,
    whole_lines,
)
from capsense._jit import compiled, kernel
from capsense._simd import (
    WIDE,
    at,
    doubles,
    madd,
    put_span,
    span,
    vsub,
    wide_span,
    wide_splat,
)
from capsense.solver.placement.truncation_kernels import add_own
from capsense.solver.selection.selection_kernels import Functions, is_there

SHEET = 6.0
"""Impedance of a thin sheet to charge that moves from one part of a cluster to the other, times its
thickness. It is the same for clusters of any size: with wave number k along a sheet it is 2 / (k t)
times the energy in free space, which goes with k. The value makes square sheets of eps 3 to 80 and
1 to 3 mm read within 30 % of boxes of that thickness, mostly within 15 %."""
GAIN = 1.3
"""Weight of the functions directly below the cut, which represent all below them too."""
COARSE = 0.6
"""What panels are too coarse for, by estimate, over the energy of the functions that end in them.
``benchmarks/limits.py`` sets the estimate beside the errors of wide boxes near a sensor."""
_RAISE = 0.03
"""By what part of itself a diagonal is raised first."""
_AMPLE = 4.0
"""And by so many times what makes the matrix definite."""
_ROWS = 4
"""Rows of a matrix whose products are taken at a time."""
_CACHED = 100_000
"""Numbers that stay in a processor's cache: means over clusters are taken for so many at a time."""


class System(NamedTuple):
    """What the charges of the functions follow from; f functions, n of them solved for."""

    phi: NDArray[Any]
    """φ⁰ of the functions, shape (f, lead)."""
    matrix: NDArray[Any]
    """Energies of those solved for [1/m], shape (n, n)."""
    rest: NDArray[Any]
    """Energies of the functions outside the system with those in it, shape (f - n, n)."""
    diagonal: NDArray[Any]
    """Energies of all functions by themselves [1/m], shape (f,)."""


class Reduced(NamedTuple):
    """The solution of a system, for m columns of φ⁰."""

    delta: NDArray[Any]
    """ΔC [m], shape (m, m)."""
    left: NDArray[Any]
    """The part of it due to functions outside the system [m], shape (m, m)."""
    coarse: NDArray[Any]
    """Estimate of what panels are too coarse for, of the diagonal [m], shape (m,)."""
    charge: NDArray[Any]
    """Charges of all functions [m], shape (f, m)."""
    shift: float
    """What was added to the diagonal to make it definite, relative; -1 where nothing did."""


@kernel
def _differences(cut, functions, values, out, start):
    """Integrals with the first functions of what has the means ``values`` (k, m) on clusters.

    They fill m columns of ``out`` from ``start`` on, a row each function; m is a multiple of 16.
    """
    width, zero = values.shape[1], wide_splat(np.float32(0.0))
    for f in range(out.shape[0]):
        x, y, o = functions.cluster[f], np.int64(-1), f * out.shape[1] + start
        if not functions.net[f]:
            x, y = cut.children[x, 0], cut.children[x, 1]
        for i in range(0, width, WIDE):
            less = wide_span(values, y * width + i) if y >= 0 else zero
            put_span(out, o + i, vsub(wide_span(values, x * width + i), less))


@kernel
def _climb(cut, values):
    """Fill the means (k, m) of all clusters of a cut from those of its leaves, m as above.

    Those of clusters of which nothing is within reach have to be zero before.
    """
    width, zero = values.shape[1], wide_splat(np.float32(0.0))
    for a in range(cut.node.shape[0] - 1, -1, -1):
        o, x, y = a * width, cut.children[a, 0] * width, cut.children[a, 1] * width
        if x < 0 or not is_there(cut, a):
            continue
        whole = np.float32(cut.self_weight[a])
        p, q = np.float32(cut.child_weights[a, 0]), np.float32(cut.child_weights[a, 1])
        for i in range(0, width, WIDE):
            own = madd(whole, wide_span(values, o + i), zero) if whole > 0.0 else zero
            own = madd(q, wide_span(values, y + i), own)
            put_span(values, o + i, madd(p, wide_span(values, x + i), own))


@compiled
def assembled(bodies, cut, functions, rows, pairs, phi_columns):
    """Set up the system of a cut from the rows (l, w) and pairs (l, l) of its leaves."""
    total, solved = functions.cluster.shape[0], functions.solved
    wide, outer = _integrals(cut, functions, rows, pairs)
    modes = rows.shape[1] - phi_columns
    psi = np.empty((total, modes), np.float32)
    phi, own = np.empty((total, phi_columns)), np.empty(total)
    for f in range(total):
        for i in range(phi_columns):
            phi[f, i] = wide[f, i]
        for k in range(modes):
            psi[f, k] = wide[f, phi_columns + k]
        own[f] = -square(psi, f)
    response = _products(psi, solved)
    matrix, rest = np.empty((solved, solved)), np.empty((total - solved, solved))
    for f in range(total):
        if f >= solved:  # its two parts are leaves
            parts = cut.children[functions.cluster[f]]
            x, y = cut.active_index[parts[0]], cut.active_index[parts[1]]
            own[f] += float(pairs[x, x]) + float(pairs[y, y]) - 2.0 * float(pairs[x, y])
            for e in range(solved):
                rest[f - solved, e] = float(outer[f, e]) - float(response[f, e])
            continue
        for e in range(f + 1):
            matrix[f, e] = float(outer[f, e]) - float(response[f, e])
    for inside in (False, True):  # what is above the diagonal is filled in last
        add_own(bodies, cut, functions, inside, matrix, rest, own)
    _add_matter(bodies, functions, matrix, own)
    mirror(matrix)
    for f in range(solved):
        own[f] = matrix[f, f]
    return System(phi, matrix, rest, own)


@compiled
def _integrals(cut, functions, rows, pairs):
    """Integrate rows (l, w) with all functions, and pairs (l, l) with all and those solved for.

    Pairs are taken some columns at a time, so that the clusters' means stay in the processor's
    cache. The second result has a few columns too many.
    """
    clusters, leaves, solved = cut.node.shape[0], cut.active.shape[0], functions.solved
    total, width = functions.cluster.shape[0], rows.shape[1]
    means, wide = np.zeros((clusters, width), np.float32), np.empty((total, width), np.float32)
    for j in range(leaves):
        for i in range(width):
            means[cut.active[j], i] = rows[j, i]
    _climb(cut, means)
    _differences(cut, functions, means, wide, np.int64(0))
    most = padded(max(_CACHED // clusters, 4 * WIDE), WIDE)
    many = min(most, max(WIDE, padded(leaves, WIDE)))
    half = np.empty((solved, many * ((leaves + many - 1) // many)), np.float32)
    part = np.zeros((clusters, many), np.float32)
    for start in range(0, leaves, many):
        for j in range(leaves):
            line, o = part[cut.active[j]], j * leaves + start
            for i in range(min(many, leaves - start)):
                line[i] = at(pairs, o + i)
        _climb(cut, part)
        _differences(cut, functions, part, half, start)
    many = min(most, max(WIDE, padded(solved, WIDE)))
    outer = np.empty((total, many * ((solved + many - 1) // many)), np.float32)
    part = np.zeros((clusters, many), np.float32)
    for start in range(0, solved, many):
        for j in range(leaves):
            line, o = part[cut.active[j]], start * half.shape[1] + j
            for e in range(min(many, solved - start)):
                line[e] = at(half, o + e * half.shape[1])
        _climb(cut, part)
        _differences(cut, functions, part, outer, start)
    return wide, outer


@compiled
def _products(psi, solved):
    """Products of all rows of ψ with the first ``solved`` ones, up to the row's own."""
    total, modes = psi.shape
    turned = np.zeros((modes, padded(solved, WIDTH)), np.float32)
    for f in range(solved):
        for k in range(modes):
            turned[k, f] = psi[f, k]
    out = np.empty((total, turned.shape[1]), np.float32)
    for f in range(0, total, _ROWS):
        end = min(f + _ROWS, total)
        width = min(padded(end, WIDTH), turned.shape[1])
        multiply_part(psi[f:end], turned, _depth(psi[f:end]), width, out[f:end])
    return out


@kernel
def _depth(rows):
    """Up to which column rows have anything; the last modes are zero far from the sensor."""
    depth = rows.shape[1]
    while depth > 0:
        for f in range(rows.shape[0]):
            if rows[f, depth - 1] != 0.0:
                return depth
        depth -= 1
    return 0


@kernel
def _add_matter(bodies, functions, matrix, own):
    """Add what ties bodies to ground, and the sheets of dielectrics."""
    solved = functions.solved
    for f in range(functions.cluster.shape[0]):
        body = bodies[functions.body[f]]
        if functions.net[f]:
            for e in range(f + 1):
                if functions.net[e] and bodies[functions.body[e]].group == body.group:
                    matrix[f, e] += body.ground_elastance
        if body.layer > 0.0:
            across = doubles(body.own)[functions.number[f]] / body.scale
            across *= 1.0 + body.inverse_susceptibility
            own[f] += across
            if f < solved:
                matrix[f, f] += across
        elif not functions.net[f] and body.sheet > 0.0:
            more = -doubles(body.faces)[functions.number[f]] / body.scale
            if functions.number[f] >= body.n_tabulated:
                more += SHEET * body.inverse_susceptibility / body.sheet
            own[f] += more
            if f < solved:
                matrix[f, f] += more


@compiled
def part_of(functions, system, wanted):
    """The functions of the wanted bodies (b,), and their system, as if there were no others."""
    total, count, solved = functions.cluster.shape[0], 0, 0
    kept = np.empty(total, np.int64)
    for f in range(total):
        if wanted[functions.body[f]]:
            kept[count] = f
            count += 1
            solved += f < functions.solved
    kept = kept[:count]
    phi = np.empty((count, system.phi.shape[1]))
    matrix, rest = np.empty((solved, solved)), np.empty((count - solved, solved))
    for a in range(count):
        f = kept[a]
        phi[a] = system.phi[f]
        for b in range(solved):
            if a < solved:
                matrix[a, b] = system.matrix[f, kept[b]]
            else:
                rest[a - solved, b] = system.rest[f - functions.solved, kept[b]]
    part = Functions(
        functions.cluster[kept], functions.net[kept], functions.number[kept],
        functions.body[kept], functions.fade[kept], functions.parent_fade[kept],
        functions.panel_end_fraction[kept], solved,
    )  # fmt: skip
    return part, System(phi, matrix, rest, system.diagonal[kept])


@compiled
def reduced(functions, system, adjoint):
    """Solve a system.

    Functions that fade in by t are taken as √t A √t with their own energy whole. What they lack,
    and functions not solved for, add the energy that the potential they leave has in them alone.
    """
    phi, matrix, rest, own = system
    total, solved, m = functions.cluster.shape[0], functions.solved, phi.shape[1]
    root, lack = np.empty(solved), np.zeros(total)
    for f in range(total):
        fade = functions.fade[f]
        if f < solved:
            root[f] = math.sqrt(fade)
        if fade < 1.0:
            lack[f] = GAIN * (1.0 - fade) * (1.0 - (1.0 - functions.parent_fade[f]) ** 4) / own[f]
    factor, x = np.empty((solved, whole_lines(solved))), np.zeros((total, m))
    for f in range(solved):
        for i in range(m):
            x[f, i] = root[f] * phi[f, i]
    delta, left = np.zeros((m, m)), np.zeros((m, m))
    shift = factorise(matrix, root, own, factor)
    if shift < 0.0:
        delta[0, 0] = np.nan
        return Reduced(delta, left, np.zeros(m), x, shift)
    substitute(factor, x[:solved])
    for f in range(solved):
        for i in range(m):
            x[f, i] *= root[f]
    add_products(phi[:solved], x[:solved], delta)
    for f in range(total):
        if lack[f] > 0.0 and f < solved:
            subtract_product(matrix, f, x, phi, f)
        elif lack[f] > 0.0:
            subtract_product(rest, f - solved, x, phi, f)
    charge = np.zeros((total, m))
    for f in range(total):
        for i in range(m):
            charge[f, i] = lack[f] * phi[f, i]
    add_products(phi, charge, left)
    coarse = np.zeros(m)
    for f in range(solved):
        for i in range(m):
            coarse[i] += COARSE * functions.panel_end_fraction[f] * own[f] * x[f, i] ** 2
    if adjoint:
        _add_adjoint(matrix, rest, root, lack, factor, charge, x)
    for f in range(solved, total):
        for i in range(m):
            x[f, i] = charge[f, i]
    for i in range(m):
        for j in range(m):
            delta[i, j] += left[i, j]
    for i in range(m):
        for j in range(i):
            delta[i, j] = delta[j, i] = 0.5 * (delta[i, j] + delta[j, i])
    return Reduced(delta, left, coarse, x, shift)


@kernel
def factorise(matrix, root, own, factor):
    """Cholesky factor of √t A √t with A's own diagonal; see :func:`capsense._dense.cholesky`.

    Where bodies lie within each other or within the sensor, approximate energies may leave no
    definite matrix. The diagonal is then raised, by more than what makes it definite: else little
    energy might be left to some charge, and readings would be huge.

    Returns:
        By how much it was raised, relative to itself; -1 where there is no factor.
    """
    shift, n, definite = 0.0, root.shape[0], False
    if n == 0:  # no function counts
        return shift
    while shift < 1e3:
        for f in range(n):
            for e in range(n):
                factor[f, e] = root[f] * matrix[f, e] * root[e]
            for e in range(n, factor.shape[1]):
                factor[f, e] = 0.0
            factor[f, f] = matrix[f, f] + shift * abs(own[f])
        before, definite = definite, cholesky(factor)
        if definite and (before or shift == 0.0):
            return shift
        shift = max(_RAISE, (_AMPLE if definite else 2.0) * shift)
    return -1.0


@compiled
def _add_adjoint(matrix, rest, root, lack, factor, charge, x):
    """Add to the charges x of the functions solved for what the estimate asks of them.

    The estimate is y · (φ - A x) with charges y: its derivative has the charges y - R A'⁻¹ R Aᵀ y
    besides x, where R = √t and A' is the matrix that was factorised.
    """
    solved, m = root.shape[0], x.shape[1]
    back = np.zeros((solved, m))
    for f in range(lack.shape[0]):
        if lack[f] > 0.0:
            for e in range(solved):
                value = at(matrix, f * solved + e) if f < solved else (
                    at(rest, (f - solved) * solved + e))  # fmt: skip
                for c in range(0, m, 8):
                    o = e * m + c
                    put_span(back, o, madd(root[e] * value, span(charge, f * m + c), span(back, o)))
    substitute(factor, back)
    for f in range(solved):
        for i in range(m):
            x[f, i] += charge[f, i] - root[f] * back[f, i]


@compiled
def leaf_charges(cut, functions, x, leaves):
    """Charges on the leaves (l, m) of charges of the functions (f, m)."""
    clusters, m = cut.node.shape[0], x.shape[1]
    charge = np.zeros((clusters, m))
    for f in range(functions.cluster.shape[0]):
        a = functions.cluster[f]
        for i in range(m):
            if functions.net[f]:
                charge[a, i] += x[f, i]
            else:
                charge[cut.children[a, 0], i] += x[f, i]
                charge[cut.children[a, 1], i] -= x[f, i]
    out = np.empty((leaves, m))
    for a in range(clusters):
        if cut.active_index[a] >= 0:
            for i in range(m):
                out[cut.active_index[a], i] = cut.self_weight[a] * charge[a, i]
        if cut.children[a, 0] >= 0:
            for i in range(m):
                charge[cut.children[a, 0], i] += cut.child_weights[a, 0] * charge[a, i]
                charge[cut.children[a, 1], i] += cut.child_weights[a, 1] * charge[a, i]
    return out
