"""Compiled preconditioned conjugate gradients on the lattice, eight right-hand sides at a time.

Vectors have shape (n, 8): the lanes of one node lie together, so that a pass over the links
serves all right-hand sides. Every pass goes storey by storey, column by column.

The floor node of a column stands for the columns that it goes on from, as their mean weighted by
the links that lead to it; a ceiling node for the one above that its column leads into. With these
two kept up to date, by :func:`lift` and :func:`lower`, a pass needs to know nothing of storeys.

Rows of nodes that are no unknowns are never written, save those of floors and ceilings. At unknowns
that are off, inside a conductor, solutions and directions are zero, residuals mean nothing.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from capsense._jit import kernel
from capsense._simd import LANES, at, load, madd, splat, store, vadd, vmadd, widen

_ZERO = np.float32(0.0)


class Operator(NamedTuple):
    """The equations of a scene."""

    weight: Any
    """Weights of the links along x, y, z, single precision, (3, n)."""
    diagonal: Any
    """Diagonal of the operator, (n,)."""
    inverse: Any
    """Inverse pivots, zero at nodes that are off, (n,)."""
    storeys: Any
    """First node and shape of each storey, (storeys, 4)."""
    joints: Any
    """First joint of each storey, and the number of joints behind, (storeys + 1,)."""
    ceiling: Any
    """Ceiling node of each joint."""
    parent: Any
    """The node that each ceiling node stands for."""
    floor: Any
    """Floor nodes, each once."""
    share: Any
    """Part of each joint in the floor node's link, (joints,)."""


class Vectors(NamedTuple):
    """What the iteration works on, each of shape (n, 8)."""

    u: Any
    """The solution."""
    r: Any
    """The right-hand sides at first, the residual afterwards."""
    z: Any
    """Preconditioned residual and, in turn, the image of the direction."""
    p: Any
    """The direction."""


@kernel
def lift(op, begin, end, v):
    """Set floor nodes to the weighted mean of the columns below, for joints [begin, end)."""
    zero = splat(_ZERO)
    for j in range(begin, end):
        store(v, op.parent[j] - 1, zero)
    for j in range(begin, end):
        floor = op.parent[j] - 1
        store(v, floor, madd(op.share[j], load(v, op.ceiling[j] - 1), load(v, floor)))


@kernel
def lower(op, begin, end, v):
    """Set ceiling nodes to the nodes they stand for, for joints [begin, end)."""
    for j in range(begin, end):
        store(v, op.ceiling[j], load(v, op.parent[j]))


@kernel
def _flow_in(wx, wy, wz, diagonal, sx, sy, p, a, below, here, above, add):
    """Minus the operator times p at node a, plus ``add``, given p below, at and above it."""
    v = madd(at(wx, a - sx), load(p, a - sx), add)
    v = madd(at(wx, a), load(p, a + sx), v)
    v = madd(at(wy, a - sy), load(p, a - sy), v)
    v = madd(at(wy, a), load(p, a + sy), v)
    v = madd(at(wz, a - 1), below, v)
    v = madd(at(wz, a), above, v)
    return madd(-at(diagonal, a), here, v)


@kernel
def _lower_factor(wx, wy, wz, inverse, sx, sy, z, a, v, below):
    """The lower factor's equation at node a, given its solution below: its side and its solution.

    What waits for the node below comes last.
    """
    v = madd(at(wy, a - sy), load(z, a - sy), v)
    v = madd(at(wx, a - sx), load(z, a - sx), v)
    own = madd(at(inverse, a), v, splat(_ZERO))
    side = madd(at(wz, a - 1), below, v)
    return side, madd(at(inverse, a) * at(wz, a - 1), below, own)


@kernel
def start(op, vectors, rz, fresh):
    """Turn right-hand sides into residuals, r ← r − A u, and solve the lower factor for z.

    Where ``fresh``, u is zero. Writes r · M⁻¹ r per lane to ``rz`` (1, 8), M being the product of
    the incomplete factors.
    """
    wx, wy, wz, inverse = op.weight[0], op.weight[1], op.weight[2], op.inverse
    u, r, z = vectors.u, vectors.r, vectors.z
    zero = splat(_ZERO)
    every = splat(0.0)
    if not fresh:
        lift(op, 0, op.ceiling.shape[0], u)
        lower(op, 0, op.ceiling.shape[0], u)
    for s in range(op.storeys.shape[0]):
        first, nx, ny, nz = op.storeys[s]
        sx, sy = ny * nz, nz
        if s > 0:
            lift(op, op.joints[s - 1], op.joints[s], z)
        for i in range(1, nx - 1):
            total = zero
            for j in range(1, ny - 1):
                begin = first + i * sx + j * sy
                if not fresh:
                    below, here = load(u, begin), load(u, begin + 1)
                    for a in range(begin + 1, begin + nz - 1):
                        above = load(u, a + 1)
                        v = _flow_in(wx, wy, wz, op.diagonal, sx, sy, u, a, below, here, above,
                                     load(r, a))  # fmt: skip
                        store(r, a, v)
                        below, here = here, above
                last = load(z, begin)
                for a in range(begin + 1, begin + nz - 1):
                    v, last = _lower_factor(wx, wy, wz, inverse, sx, sy, z, a, load(r, a), last)
                    store(z, a, last)
                    total = vmadd(last, v, total)
            every = vadd(widen(total), every)
    store(rz, 0, every)


@kernel
def forward(op, vectors, alpha, rz):
    """Go on along the direction, r ← r − alpha A p, and solve the lower factor for z.

    ``alpha`` has shape (2, 8): alpha and −alpha; A p lies in z, which it leaves for the solution.
    Writes r · M⁻¹ r per lane to ``rz`` (1, 8).
    """
    wx, wy, wz, inverse = op.weight[0], op.weight[1], op.weight[2], op.inverse
    r, z = vectors.r, vectors.z
    zero = splat(_ZERO)
    every = splat(0.0)
    back = load(alpha, 1)
    for s in range(op.storeys.shape[0]):
        first, nx, ny, nz = op.storeys[s]
        sx, sy = ny * nz, nz
        if s > 0:
            lift(op, op.joints[s - 1], op.joints[s], z)
        for i in range(1, nx - 1):
            total = zero
            for j in range(1, ny - 1):
                begin = first + i * sx + j * sy
                last = load(z, begin)
                for a in range(begin + 1, begin + nz - 1):
                    v = vmadd(back, load(z, a), load(r, a))
                    store(r, a, v)
                    v, last = _lower_factor(wx, wy, wz, inverse, sx, sy, z, a, v, last)
                    store(z, a, last)
                    total = vmadd(last, v, total)
            every = vadd(widen(total), every)
    store(rz, 0, every)


@kernel
def backward(op, vectors, alpha, beta, fresh, pap):
    """Solve the upper factor, take a new direction, and write its image to z.

    With the solution z: u ← u + alpha p and p ← z + beta p, or p ← z alone where ``fresh``; then
    z ← A p, and p · A p per lane to ``pap`` (1, 8). The image of a plane is taken as soon as its
    neighbours have their direction, while all three are in the nearest cache. What comes to it
    from floor nodes, which know their direction last, is added at the end.
    """
    wx, wy, wz, inverse = op.weight[0], op.weight[1], op.weight[2], op.inverse
    u, z, p = vectors.u, vectors.z, vectors.p
    zero = splat(_ZERO)
    every = splat(0.0)
    on, b = load(alpha, 0), load(beta, 0)
    for j in range(op.floor.shape[0]):
        store(p, op.floor[j], zero)
    for s in range(op.storeys.shape[0] - 1, -1, -1):
        first, nx, ny, nz = op.storeys[s]
        sx, sy = ny * nz, nz
        lower(op, op.joints[s], op.joints[s + 1], p)
        for j in range(op.joints[s], op.joints[s + 1]):
            store(z, op.ceiling[j], load(z, op.parent[j] - 1))
        for i in range(nx - 2, 0, -1):
            for j in range(ny - 2, 0, -1):
                begin = first + i * sx + j * sy
                last = load(z, begin + nz - 1)
                for a in range(begin + nz - 2, begin, -1):
                    v = madd(at(wy, a), load(z, a + sy), zero)
                    v = madd(at(wx, a), load(z, a + sx), v)
                    own = madd(at(inverse, a), v, load(z, a))
                    last = madd(at(inverse, a) * at(wz, a), last, own)
                    store(z, a, last)
                    if fresh:
                        store(p, a, last)
                    else:
                        old = load(p, a)
                        store(u, a, vmadd(on, old, load(u, a)))
                        store(p, a, vmadd(b, old, last))
                if s > 0:  # for the storey below, when the image has taken its place
                    store(z, begin, last)
            if i < nx - 2:
                every = vadd(widen(_image(op, vectors, first, ny, nz, i + 1)), every)
        every = vadd(widen(_image(op, vectors, first, ny, nz, 1)), every)
    lift(op, 0, op.ceiling.shape[0], p)
    for j in range(op.floor.shape[0]):
        a = op.floor[j]
        missing = madd(-at(wz, a), load(p, a), zero)
        store(z, a + 1, vadd(missing, load(z, a + 1)))
        every = vadd(widen(vmadd(missing, load(p, a + 1), zero)), every)
    store(pap, 0, every)


@kernel
def _image(op, vectors, first, ny, nz, i):
    """Write the operator times p to z in plane i of a storey; returns p · A p per lane."""
    wx, wy, wz, diagonal = op.weight[0], op.weight[1], op.weight[2], op.diagonal
    z, p = vectors.z, vectors.p
    zero = splat(_ZERO)
    total = zero
    sx, sy = ny * nz, nz
    for j in range(1, ny - 1):
        begin = first + i * sx + j * sy
        below, here = load(p, begin), load(p, begin + 1)
        for a in range(begin + 1, begin + nz - 1):
            above = load(p, a + 1)
            v = _flow_in(wx, wy, wz, diagonal, sx, sy, p, a, below, here, above, zero)
            v = madd(np.float32(-1.0), v, zero)
            store(z, a, v)
            total = vmadd(here, v, total)
            below, here = here, above
    return total


@kernel
def add_products(left, a, right, sums):
    """Add row a of ``left`` times a vector, eight rows of products."""
    s0, s1, s2, s3, s4, s5, s6, s7 = sums
    k = a * LANES
    return (
        madd(at(left, k), right, s0), madd(at(left, k + 1), right, s1),
        madd(at(left, k + 2), right, s2), madd(at(left, k + 3), right, s3),
        madd(at(left, k + 4), right, s4), madd(at(left, k + 5), right, s5),
        madd(at(left, k + 6), right, s6), madd(at(left, k + 7), right, s7),
    )  # fmt: skip


@kernel
def _flush(sums, out):
    """Add eight rows of products in single precision to ``out`` (8, 8) in double."""
    s0, s1, s2, s3, s4, s5, s6, s7 = sums
    store(out, 0, vadd(widen(s0), load(out, 0)))
    store(out, 1, vadd(widen(s1), load(out, 1)))
    store(out, 2, vadd(widen(s2), load(out, 2)))
    store(out, 3, vadd(widen(s3), load(out, 3)))
    store(out, 4, vadd(widen(s4), load(out, 4)))
    store(out, 5, vadd(widen(s5), load(out, 5)))
    store(out, 6, vadd(widen(s6), load(out, 6)))
    store(out, 7, vadd(widen(s7), load(out, 7)))


@kernel
def finish(op, vectors, alpha, out):
    """Go on along the direction, u ← u + alpha p and r ← r − alpha A p; add uᵀ r to ``out``."""
    u, r, z, p = vectors.u, vectors.r, vectors.z, vectors.p
    zero = splat(_ZERO)
    on, back = load(alpha, 0), load(alpha, 1)
    for s in range(op.storeys.shape[0]):
        first, nx, ny, nz = op.storeys[s]
        for i in range(1, nx - 1):
            sums = (zero, zero, zero, zero, zero, zero, zero, zero)
            for j in range(1, ny - 1):
                begin = first + (i * ny + j) * nz
                for a in range(begin + 1, begin + nz - 1):
                    store(u, a, vmadd(on, load(p, a), load(u, a)))
                    v = vmadd(back, load(z, a), load(r, a))
                    store(r, a, v)
                    sums = add_products(u, a, v, sums)
            _flush(sums, out)


@kernel
def inner(op, left, right, out):
    """Add leftᵀ right over the unknowns to ``out`` (8, 8)."""
    zero = splat(_ZERO)
    for s in range(op.storeys.shape[0]):
        first, nx, ny, nz = op.storeys[s]
        for i in range(1, nx - 1):
            sums = (zero, zero, zero, zero, zero, zero, zero, zero)
            for j in range(1, ny - 1):
                begin = first + (i * ny + j) * nz
                for a in range(begin + 1, begin + nz - 1):
                    sums = add_products(left, a, load(right, a), sums)
            _flush(sums, out)


@kernel
def solve(op, vectors, fresh, tolerance, max_iterations, left, sums, factors, out):
    """Iterate until the energy still missing is below ``tolerance`` in every lane.

    Each iteration lowers the energy of a lane by α (r · z) exactly (Hestenes and Stiefel 1952).
    What is still missing is estimated from the last decrements and their ratio. Where ``fresh``,
    the solution is zero before. ``tolerance`` and ``left`` (output) are per lane, in the units of
    the energy. ``sums`` (4, 8) in double and ``factors`` (3, 8) in single precision are room to
    work in. Adds uᵀ r to ``out`` (8, 8) and returns the iterations done, one at least.
    """
    rz, pap, old, previous = sums[0:1], sums[1:2], sums[2], sums[3]
    alpha, beta = factors[0:2], factors[2:3]
    start(op, vectors, rz, fresh)
    iteration = 0
    while True:
        for k in range(LANES):
            beta[0, k] = 0.0 if iteration == 0 or old[k] <= 0.0 else rz[0, k] / old[k]
        backward(op, vectors, alpha, beta, iteration == 0, pap)
        done = True
        for k in range(LANES):
            step = rz[0, k] / pap[0, k] if pap[0, k] > 0.0 else 0.0
            alpha[0, k], alpha[1, k] = step, -step
            decrement = step * rz[0, k]
            if decrement <= 0.0:
                left[k] = 0.0
            else:
                ratio = 0.5
                if iteration > 0 and previous[k] > 0.0:
                    ratio = min(max(decrement / previous[k], 0.1), 0.9)
                left[k] = decrement * ratio / (1.0 - ratio)
            previous[k] = decrement
            old[k] = rz[0, k]
            if left[k] > tolerance[k] or (iteration == 0 and decrement > tolerance[k]):
                done = False
        iteration += 1
        if done or iteration >= max_iterations:
            finish(op, vectors, alpha, out)
            return iteration
        forward(op, vectors, alpha, rz)
