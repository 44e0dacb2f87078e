"""Compiled right-hand sides of a scene, eight at a time, and the energies they come to."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from capsense._jit import kernel
from capsense._simd import LANES, load, madd, narrow, splat, store, vadd, vmadd, widen
from capsense.solve.factor_kernels import factorise
from capsense.solve.pcg_kernels import add_products, solve

_ZERO = np.float32(0.0)


class Setup(NamedTuple):
    """What a scan leaves to set up an operator with, and room to do it."""

    extra: Any
    """Conductance of each node's ties, single precision, (n,)."""
    taken: Any
    """Room for the factors, (3, n)."""
    changed: Any
    """How many nodes went on or off, and which, (n + 1,)."""


@kernel
def carry_over(changed, active, phi, u):
    """Make the last scene's solution a start for this one, at the nodes that went on or off."""
    zero = splat(_ZERO)
    for i in range(1, changed[0] + 1):
        a = changed[i]
        store(u, a, zero if active[a] == 0 else madd(np.float32(-1.0), load(phi, a), zero))


@kernel
def load_scene(phi, lanes, first, n_held, ties, energies, r, value, drop, energy):
    """Fill one block's right-hand sides, and each tie's and energy term's value per lane.

    The block's lanes are those from number ``first`` on; the first ``n_held`` of them are
    terminals. ``lanes[c]`` is the number of conductor c's lane, or −1. Adds each lane's own energy
    to ``energy`` (1, 8).
    """
    none = splat(0.0)
    every = load(energy, 0)
    for a in range(r.shape[0]):
        store(r, a, splat(_ZERO))
    for i in range(ties.shape[0]):
        tie = ties[i]
        point, coef = tie.point, tie.coef
        v = madd(coef[0], widen(load(phi, point[0])), none)
        for t in range(1, 4):
            v = madd(coef[t], widen(load(phi, point[t])), v)
        store(value, i, v)
        if first <= tie.end < first + n_held:
            value[i, tie.end - first] += tie.end_coef
        if first <= lanes[tie.conductor] < first + LANES:
            value[i, lanes[tie.conductor] - first] = -1.0
        v = load(value, i)
        if tie.node >= 0:
            store(r, tie.node, narrow(madd(-tie.weight, v, widen(load(r, tie.node)))))
        every = vmadd(madd(tie.weight, v, none), v, every)
    for i in range(energies.shape[0]):
        term = energies[i]
        v = none
        if term.a >= 0:
            v = widen(load(phi, term.a))
        if term.b >= 0:
            v = madd(-1.0, widen(load(phi, term.b)), v)
        store(drop, i, v)
        if first <= term.end < first + n_held:
            if term.a < 0:
                drop[i, term.end - first] += 1.0
            if term.b < 0:
                drop[i, term.end - first] -= 1.0
        v = load(drop, i)
        every = vmadd(madd(term.weight, v, none), v, every)
        if term.drives:
            if term.a >= 0:
                store(r, term.a, narrow(madd(-term.weight, v, widen(load(r, term.a)))))
            if term.b >= 0:
                store(r, term.b, narrow(madd(term.weight, v, widen(load(r, term.b)))))
    store(energy, 0, every)


@kernel
def add_energies(ties, energies, value, drop, other_value, other_drop, u, out):
    """Add the energy that ties and changed links hold to ``out`` (8, 8).

    Σ w v ⊗ (v' + u) over the ties and Σ w d ⊗ (d' + Δu) over the changed links, where Δu counts
    only for those that drive; unprimed are one block's lanes, primed ones and u the other's.
    """
    none = splat(0.0)
    sums = (load(out, 0), load(out, 1), load(out, 2), load(out, 3), load(out, 4), load(out, 5),
            load(out, 6), load(out, 7))  # fmt: skip
    for i in range(ties.shape[0]):
        tie = ties[i]
        v = load(other_value, i)
        if tie.node >= 0:
            v = vadd(widen(load(u, tie.node)), v)
        sums = add_products(value, i, madd(tie.weight, v, none), sums)
    for i in range(energies.shape[0]):
        term = energies[i]
        v = load(other_drop, i)
        if term.drives:
            if term.a >= 0:
                v = vadd(widen(load(u, term.a)), v)
            if term.b >= 0:
                v = madd(-1.0, widen(load(u, term.b)), v)
        sums = add_products(drop, i, madd(term.weight, v, none), sums)
    s0, s1, s2, s3, s4, s5, s6, s7 = sums
    store(out, 0, s0)
    store(out, 1, s1)
    store(out, 2, s2)
    store(out, 3, s3)
    store(out, 4, s4)
    store(out, 5, s5)
    store(out, 6, s6)
    store(out, 7, s7)


@kernel
def solve_block(op, setup, unknown, active, vectors, fresh, phi, lanes, first, n_held, ties,
                energies, value, drop, tolerance, relative, max_iterations, wanted, left, sums,
                factors, own, energy):  # fmt: skip
    """Solve for the lanes of one block, and add their energies to ``energy`` (8, 8).

    For the first block, sets up operator and preconditioner before. All of it is one call: between
    calls, threads wait for the interpreter. Iterates until the energy that is missing is below
    ``tolerance`` or ``relative`` times the lane's own, of which ``own`` (1, 8) holds what ties and
    changed links do not. Writes what was ``wanted`` and what is ``left`` (8,). Where ``fresh``,
    nothing was solved before. Returns the iterations.
    """
    if first == 0:
        factorise(op.weight, setup.extra, unknown, op.storeys, op.ceiling, op.parent, op.share,
                  op.diagonal, active, op.inverse, setup.taken, setup.changed)  # fmt: skip
    if not fresh:
        carry_over(setup.changed, active, phi, vectors.u)
    load_scene(phi, lanes, first, n_held, ties, energies, vectors.r, value, drop, own)
    for k in range(LANES):
        wanted[k] = max(tolerance, relative * max(0.2 * abs(own[0, k]), 1e-9))
    done = solve(op, vectors, fresh, wanted, max_iterations, left, sums, factors, energy)
    for k in range(LANES):
        for m in range(LANES):
            energy[k, m] = -energy[k, m]
    add_energies(ties, energies, value, drop, value, drop, vectors.u, energy)
    for k in range(LANES):
        for m in range(k):
            energy[k, m] = energy[m, k] = 0.5 * (energy[k, m] + energy[m, k])
    return done
