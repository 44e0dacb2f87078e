"""How the matrices of many environments change as bodies move, by the closed adjoint, on Warp.

The twin of these kernels is :mod:`capsense.surface.gradient_kernels`. Charges x = A⁻¹ Φ are held
while they move in the field of the other charges, of all images and of the design; what changes
with the share of near sources or with the lift off the design is left out, as there. What functions
that are not solved for add is left out too, which the CPU follows. Floating
conductors of the design follow: columns are of electrodes, what floats mixed in. Lengths in
metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.field.green_kernels import FAR_LEAST, NEAR_LEAST
from capsense.fleet.warp_cut import Response, WarpCut
from capsense.fleet.warp_kernels import bound
from capsense.fleet.warp_solve import Circuit
from capsense.surface.pair_kernels import FAR

wp.set_module_options({"enable_backward": False, "fast_math": True})

_FAR = wp.constant(FAR)
_NEAR_LEAST, _FAR_LEAST = wp.constant(NEAR_LEAST), wp.constant(FAR_LEAST)


@wp.kernel
def follow(circuit: Circuit, whole: wp.array3d(dtype=wp.vec2d), out: wp.array3d(dtype=wp.float32)):
    """Potential of each terminal while an electrode is at 1 V, (t, n, v); floating ones follow.

    ``whole`` is as ``eliminate`` leaves it: row p of a floating conductor holds its coupling with
    those before it, these still in the network.
    """
    j, v = wp.tid()
    for a in range(whole.shape[0]):
        volts = float(0.0)
        if a == j:
            volts = 1.0
        if a >= circuit.driven:
            charge = wp.float32(0.0)
            for c in range(a):
                charge += wp.float32(whole[a, c, v][0] / whole[a, a, v][0]) * out[c, j, v]
            volts = -charge
        out[a, j, v] = volts


@wp.kernel
def followed(
    circuit: Circuit, turn: wp.array3d(dtype=wp.float32), values: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Columns of electrodes (x, n, v) from those of terminals, what floats mixed in."""
    x, j, v = wp.tid()
    total = values[x, j, v]
    for a in range(circuit.driven, turn.shape[0]):
        total += values[x, a, v] * turn[a, j, v]
    out[x, j, v] = total


@wp.func
def _source(p: wp.vec3, source: wp.vec3, floor: float, least: float):
    """Gradient of the potential of a unit charge and of its image in the floor."""
    d = p - source
    e = wp.vec3(d[0], d[1], p[2] + source[2] - 2.0 * floor)
    square = wp.dot(d, d)
    image = wp.dot(e, e)
    out = e / (image * wp.sqrt(image))
    if square > least * least:
        out -= d / (square * wp.sqrt(square))
    return out


@wp.func
def _near(d: wp.vec3, fourth: float):
    """Gradient of a bounded 1/r."""
    square = wp.dot(d, d)
    whole = wp.sqrt(square * square + fourth)
    return -square / (whole * whole * wp.sqrt(whole)) * d


@wp.func
def _pair(cut: WarpCut, i: int, j: int, v: int, mirrored: float, floor: float, origin: wp.vec3):
    """Force on cluster i, and torque about an origin, of the mean of 1/r to another."""
    flip = wp.vec3(1.0, 1.0, 1.0 - 2.0 * mirrored)
    lift = wp.vec3(0.0, 0.0, 2.0 * mirrored * floor)
    a0 = cut.points[i, 0, v]
    a3 = cut.points[i, 3, v]
    b0 = wp.cw_mul(flip, cut.points[j, 0, v]) + lift
    b3 = wp.cw_mul(flip, cut.points[j, 3, v]) + lift
    d = 0.5 * (a0 + a3 - b0 - b3)
    square = wp.dot(d, d)
    size = cut.extent[i, v] + cut.extent[j, v]
    force = wp.vec3()
    torque = wp.vec3()
    if square > _FAR * _FAR * size * size:
        x = 0.5 * (a0 - cut.points[i, 1, v])
        y = 0.5 * (a0 - cut.points[i, 2, v])
        z = 0.5 * (b0 - wp.cw_mul(flip, cut.points[j, 1, v]) - lift)
        w = 0.5 * (b0 - wp.cw_mul(flip, cut.points[j, 2, v]) - lift)
        inverse = 1.0 / wp.sqrt(square)
        third = inverse * inverse * inverse
        fifth = third * inverse * inverse
        whole = wp.dot(x, x) + wp.dot(y, y) + wp.dot(z, z) + wp.dot(w, w)
        ax = wp.dot(x, d)
        ay = wp.dot(y, d)
        az = wp.dot(z, d)
        aw = wp.dot(w, d)
        along = ax * ax + ay * ay + az * az + aw * aw
        force = -third * d + 1.5 * fifth * whole * d
        force += fifth * (3.0 * (ax * x + ay * y + az * z + aw * w) - 7.5 * along / square * d)
        torque = wp.cross(0.5 * (a0 + a3) - origin, force)
        torque += 3.0 * fifth * wp.cross(ax * x + ay * y, d)
    else:
        fourth = bound(cut, i, j, v)
        for p in range(4):
            a = cut.points[i, p, v]
            pull = wp.vec3()
            for q in range(4):
                pull += _near(a - wp.cw_mul(flip, cut.points[j, q, v]) - lift, fourth)
            force += pull / 16.0
            torque += wp.cross(a - origin, pull) / 16.0
    return wp.spatial_vector(force, torque)


@wp.kernel
def forces(
    green: Response, cut: WarpCut, clusters: int, charge: wp.array3d(dtype=wp.float32),
    near: wp.array3d(dtype=wp.float32), far: wp.array3d(dtype=wp.float32),
    out: wp.array3d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Gradient of electrode j's potential at each cluster, and its torque about its body's origin.

    Shape (n, n electrodes, v).
    """
    i, j, v = wp.tid()
    total = wp.spatial_vector()
    if cut.node[i, v] >= 0:
        origin = wp.transform_get_translation(cut.pose[i // clusters, v])
        share = 0.25 * (1.0 - cut.beyond[i, v])
        for p in range(4):
            at = cut.points[i, p, v]
            pull = wp.vec3()
            if cut.near[i, v] > 0.0:
                for s in range(green.near.shape[0]):
                    pull += (cut.near[i, v] * near[s, j, v]) * _source(
                        at, green.near[s], green.floor, _NEAR_LEAST
                    )
            if cut.near[i, v] < 1.0:
                for s in range(green.far.shape[0]):
                    pull += ((1.0 - cut.near[i, v]) * far[s, j, v]) * _source(
                        at, green.far[s], green.floor, _FAR_LEAST
                    )
            total += share * wp.spatial_vector(pull, wp.cross(at - origin, pull))
        for k in range(cut.node.shape[0]):
            if cut.node[k, v] >= 0:
                q = charge[k, j, v]
                total += q * _pair(cut, i, k, v, 1.0, green.floor, origin)
                if k // clusters != i // clusters:
                    total -= q * _pair(cut, i, k, v, 0.0, green.floor, origin)
    out[i, j, v] = total


@wp.kernel
def slopes(
    circuit: Circuit, cut: WarpCut, clusters: int,
    charge: wp.array3d(dtype=wp.float32), pull: wp.array3d(dtype=wp.spatial_vector),
    out: wp.array4d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Derivative of the matrices by the pose of each body [F/m], [F/rad], (v, b, n, n)."""
    b, i, v = wp.tid()
    for j in range(circuit.electrodes):
        total = wp.spatial_vector()
        for k in range(clusters):
            f = b * clusters + k
            if cut.node[f, v] >= 0:
                total += charge[f, i, v] * pull[f, j, v] + charge[f, j, v] * pull[f, i, v]
        force = wp.spatial_top(total)
        torque = wp.spatial_bottom(total) + wp.cross(cut.moved[b, v], force)
        out[v, b, i, j] = circuit.unit * wp.spatial_vector(force, torque)
