"""The step of many environments as Warp kernels: from solutions to the matrices of electrodes.

Conductors near the design that are not at ground are nodes of a network, as
:mod:`capsense.solver.system.network_kernels` has them: their columns follow those of the terminals,
and they are eliminated from the matrix of both. Lengths in metres, 4π eps0 = 1, unless units say
else.
"""

from __future__ import annotations

import warp as wp

from capsense.fleet.warp_cut import WarpActiveTree
from capsense.fleet.warp_gap import local_of
from capsense.fleet.warp_near import GapLaw, NearBodies
from capsense.fleet.warp_pairs import body_of
from capsense.fleet.warp_slope import Slopes
from capsense.fleet.warp_solve import Left, over, times
from capsense.solver.system.step import FIELD_ERROR
from capsense.solver.system.system_kernels import GAIN

wp.set_module_options({"enable_backward": False, "fast_math": True})

_GAIN, _FIELD_ERROR = wp.constant(GAIN), wp.constant(FIELD_ERROR)


@wp.struct
class Circuit:
    """The t terminals of a design, of which k are driven, n of these electrodes."""

    electrodes: wp.int32
    driven: wp.int32
    unit: wp.float32  # capacitance that kernels take for one [F]
    metre: wp.float32  # the same of a metre: 4π eps0 [F]
    omega: wp.float32  # angular frequency [rad/s]
    empty_maxwell: wp.array2d(dtype=wp.float64)  # matrix of all in the empty domain [F], (t, t)
    empty: wp.array2d(dtype=wp.float64)  # that of the driven ones, the others eliminated, (k, k)
    screened: wp.array2d(dtype=wp.float32)  # bound of what an entry changes by [F], (t, t)
    due: wp.array(dtype=wp.int32)  # whether an environment is reported, (e,)


@wp.kernel
def change(
    gap: GapLaw, near: NearBodies, potentials: wp.array3d(dtype=wp.float32),
    quadrature: wp.array3d(dtype=wp.float32), left: Left, whole: wp.array3d(dtype=wp.vec2d),
):  # fmt: skip
    """Complex change of the matrices of terminals and nodes [m], (t, t, v), and parts of it."""
    i, j, v = wp.tid()
    if wp.max(i, j) >= near.columns[v]:
        return
    total = wp.vec2()
    more = wp.vec2()
    phi_columns = left.residual.shape[1] // 2
    for f in range(potentials.shape[0]):
        total += times(
            wp.vec2(potentials[f, i, v], quadrature[f, i, v]),
            wp.vec2(potentials[f, j, v], quadrature[f, j, v]),
        )
        own = left.energy[f, v]
        if own[0] > 0.0:
            x = wp.vec2(left.residual[f, i, v], 0.0)
            y = wp.vec2(left.residual[f, j, v], 0.0)
            if near.lossy[v] != 0:
                x[1] = left.residual[f, phi_columns + i, v]
                y[1] = left.residual[f, phi_columns + j, v]
            more += _GAIN * over(times(x, y), own)
    total += more
    left.below[i, j, v] = more[0]
    if near.count[v] > 0:
        total[0] = total[0] + local_of(gap, near, i, j, v)
        if i == j and i >= gap.terminals:
            total[0] = total[0] + near.capacitance[i - gap.terminals, v]
    whole[i, j, v] = wp.vec2d(wp.float64(total[0]), wp.float64(total[1]))


@wp.func
def _times(x: wp.vec2d, y: wp.vec2d):
    return wp.vec2d(x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0])


@wp.func
def _eliminate(whole: wp.array3d(dtype=wp.vec2d), p: int, v: int):
    """Take the last row and column out of a matrix; they stay as they are."""
    pivot = whole[p, p, v]
    inverse = wp.vec2d(pivot[0], -pivot[1]) / wp.dot(pivot, pivot)
    for i in range(p):
        share = _times(whole[i, p, v], inverse)
        for j in range(p):
            whole[i, j, v] -= _times(share, whole[p, j, v])


@wp.kernel
def eliminate(circuit: Circuit, near: NearBodies, left: Left, whole: wp.array3d(dtype=wp.vec2d)):
    """Take nodes, then floating conductors of the design out of the matrices, the last one first.

    What is left is in farads, the empty domain's matrix added. What is in doubt of each terminal's
    own entry is added up.
    """
    v = wp.tid()
    t = circuit.empty_maxwell.shape[0]
    nodes = near.columns[v] - t
    for step in range(nodes):
        p = t + nodes - 1 - step
        if whole[p, p, v][0] > wp.float64(0.0):  # else nothing of a node may be within reach
            _eliminate(whole, p, v)
    for i in range(t):
        if near.count[v] > 0:
            _doubt(t, nodes, i, left, whole, v)
        else:
            left.doubt[i, v] = left.doubt[i, v] + wp.abs(left.below[i, i, v])
        own = wp.abs(wp.float32(whole[i, i, v][0]))
        doubt = left.doubt[i, v] + _FIELD_ERROR * own
        left.doubt[i, v] = wp.where(left.dropped[v] > 0, own, doubt)
        for j in range(t):
            value = whole[i, j, v]
            real = circuit.unit * wp.float32(value[0])
            if real > circuit.screened[i, j]:  # the lesser of NaN and a number would be the number
                real = circuit.screened[i, j]
            whole[i, j, v] = wp.vec2d(
                circuit.empty_maxwell[i, j] + wp.float64(real), wp.float64(circuit.unit) * value[1]
            )
    for step in range(t - circuit.driven):
        _eliminate(whole, t - 1 - step, v)


@wp.func
def _volts(t: int, left: Left, whole: wp.array3d(dtype=wp.vec2d), a: int, i: int, v: int):
    """Potential of a terminal or node with terminal i at 1 V, nodes before it being known."""
    out = float(0.0)
    if a == i:
        out = 1.0
    if a >= t and whole[a, a, v][0] > wp.float64(0.0):
        for c in range(a):
            volts = wp.where(c == i, 1.0, 0.0)
            if c >= t:
                volts = left.volts[c - t, i, v]
            out -= wp.float32(whole[a, c, v][0] / whole[a, a, v][0]) * volts
    return out


@wp.func
def _doubt(t: int, nodes: int, i: int, left: Left, whole: wp.array3d(dtype=wp.vec2d), v: int):
    """Reduce what is in doubt of terminals and nodes to a terminal [m], as ``step.solve``."""
    for k in range(nodes):
        left.volts[k, i, v] = _volts(t, left, whole, t + k, i, v)
    below = float(0.0)
    root = float(0.0)
    for a in range(t + nodes):
        x = wp.where(a == i, 1.0, 0.0)
        if a >= t:
            x = left.volts[a - t, i, v]
        if x != 0.0:
            for b in range(t + nodes):
                y = wp.where(b == i, 1.0, 0.0)
                if b >= t:
                    y = left.volts[b - t, i, v]
                if y != 0.0:
                    below += x * y * left.below[a, b, v]
            root += wp.sqrt(left.doubt[a, v]) * wp.abs(x)
    left.doubt[i, v] = wp.abs(below) + root * root


@wp.kernel
def report(
    circuit: Circuit, whole: wp.array3d(dtype=wp.vec2d),
    capacitance: wp.array4d(dtype=wp.float32), delta: wp.array4d(dtype=wp.float32),
    conductance: wp.array4d(dtype=wp.float32), shields: wp.array3d(dtype=wp.float64),
    doubt: wp.array2d(dtype=wp.float32), error: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Matrices of the electrodes [F], [S], what shields couple to them [F], and errors [F]."""
    i, v = wp.tid()
    e = v // delta.shape[1]
    s = v % delta.shape[1]
    if circuit.due[e] == 0:
        return
    for j in range(circuit.electrodes):
        value = whole[i, j, v]
        capacitance[e, s, i, j] = wp.float32(value[0])
        delta[e, s, i, j] = wp.float32(value[0] - circuit.empty[i, j])
        conductance[e, s, i, j] = -circuit.omega * wp.float32(value[1])
    total = wp.float64(0.0)
    for j in range(circuit.electrodes, circuit.driven):
        total += whole[i, j, v][0]
    shields[e, s, i] = total
    if i == 0:
        largest = float(0.0)
        for t in range(circuit.electrodes):
            if largest == largest and not (doubt[t, v] <= largest):  # NaN is the largest
                largest = doubt[t, v]
        error[e, s] = circuit.unit * largest


@wp.kernel
def follow(
    circuit: Circuit, cut: WarpActiveTree, whole: wp.array3d(dtype=wp.vec2d),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Potential of each terminal and node while an electrode is at 1 V, (t, n, v).

    ``whole`` is as ``eliminate`` leaves it: row p of a floating conductor or node holds its
    coupling with those before it, these still in the network.
    """
    j, v = wp.tid()
    for a in range(cut.columns[v]):
        volts = float(0.0)
        if a == j:
            volts = 1.0
        if a >= circuit.driven and whole[a, a, v][0] > wp.float64(0.0):
            charge = wp.float32(0.0)
            for c in range(a):
                charge += wp.float32(whole[a, c, v][0] / whole[a, a, v][0]) * out[c, j, v]
            volts = -charge
        out[a, j, v] = volts


@wp.func
def _local_slope(
    gap: GapLaw, near: NearBodies, slopes: Slopes, k: int, i: int, j: int, v: int
):  # fmt: skip
    """Derivatives of the local change of an entry by a near body's pose, and by its ``sunk``."""
    total = wp.spatial_vector()
    sink = float(0.0)
    columns = gap.columns.shape[1]
    volts = slopes.volts
    slot = near.slot[near.body[k, v], v]
    for p in range(gap.owner.shape[0]):
        a = gap.owner[p]
        if a >= 0:
            for col in range(columns):
                c = gap.columns[a, col]
                if c >= 0:
                    share = volts[a, i, v] * volts[c, j, v] + volts[c, i, v] * volts[a, j, v]
                    total += 0.5 * share * slopes.part[p, col, k, v]
                    sink += 0.5 * share * slopes.sink[p, col, k, v]
        if slot >= 0:
            c = gap.terminals + slot
            share = -volts[c, i, v] * volts[c, j, v]
            if a >= 0:
                share += volts[a, i, v] * volts[c, j, v] + volts[c, i, v] * volts[a, j, v]
            total += share * slopes.part[p, columns, k, v]
            sink += share * slopes.sink[p, columns, k, v]
    return total, sink


@wp.kernel
def slopes(
    circuit: Circuit, gap: GapLaw, near: NearBodies, cut: WarpActiveTree, slopes: Slopes,
    out: wp.array4d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Derivative of the matrices by the pose of each body [F/m], [F/rad], (v, b, n, n)."""
    b, i, v = wp.tid()
    volts = slopes.volts
    charge = slopes.charge
    pull = slopes.pull
    for j in range(circuit.electrodes):
        total = wp.spatial_vector()
        for k in range(cut.columns[v]):
            for c in range(cut.columns[v]):
                share = volts[k, i, v] * volts[c, j, v]
                if share != 0.0:
                    for f in range(cut.node.shape[0]):
                        if body_of(cut, f) == b and cut.node[f, v] >= 0:
                            one = charge[f, k, v] * pull[f, c, v]
                            total += share * (one + charge[f, c, v] * pull[f, k, v])
        for k in range(near.count[v]):
            if near.body[k, v] == b:
                local, sink = _local_slope(gap, near, slopes, k, i, j, v)
                total += local
                total += total[2] * slopes.lift[b, v]
                if near.sunk[b, v] < gap.limit:
                    total += sink * slopes.lift[b, v]
        force = wp.spatial_top(total)
        torque = wp.spatial_bottom(total) + wp.cross(cut.moved[b, v], force)
        out[v, b, i, j] = wp.spatial_vector(circuit.metre * force, circuit.unit * torque)
