"""Conducting fabrics on the covers of many environments, as Warp kernels; 4π eps0 = 1.

The twin of these kernels is ``fabric_change`` of :mod:`capsense.solver.gap.gap_kernels`. Lengths
are over the solver's ``length``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from capsense.field.soft import Soft
from capsense.fleet.warp_gap import line_length
from capsense.fleet.warp_mesh import Outlines
from capsense.fleet.warp_near import GapLaw, NearBodies, may_meet, nearest_of
from capsense.fleet.warp_network import Circuit
from capsense.fleet.warp_outline import middle_height, reach_down
from capsense.fleet.warp_slope import line_turns

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(math.pi)
_FAR = wp.constant(10.0)
"""Compression is carried on to so many bending lengths."""


@wp.struct
class Fabric:
    """A fabric of f cells, and the pairs of terminals that they screen, see ``PressedTable``."""

    bending: wp.float32  # bending length, 0 for none
    points: wp.array(dtype=wp.vec2)  # (f,)
    areas: wp.array(dtype=wp.float32)
    density: wp.array3d(dtype=wp.float32)
    pair: wp.array(dtype=wp.vec2i)  # terminals whose matrix entry changes, (p,)
    first: wp.array(dtype=wp.int32)  # first of the screening cells of each pair, (p + 1,)
    cell: wp.array(dtype=wp.int32)  # these cells
    columns: wp.array(dtype=wp.vec2i)  # columns of their densities for the two terminals


@wp.struct
class FabricState:
    """Compression below the fabric in every view."""

    touches: wp.array2d(dtype=wp.int32)  # whether a body reaches below the face, (b, v)
    pressed: wp.array2d(dtype=wp.float32)  # compression by bodies, (f, v)
    count: wp.array(dtype=wp.int32)  # cells that bodies compress, (v,)
    cell: wp.array2d(dtype=wp.int32)  # these, in the first rows, (f, v)
    depth: wp.array2d(dtype=wp.float32)  # compression as the fabric carries it on, (f, v)


@wp.struct
class FabricSlopes:
    """What derivatives of a fabric's part by the poses of bodies are made of."""

    rise: wp.array2d(dtype=wp.float32)  # how far a body was pressed out of the face, (b, v)
    owner: wp.array2d(dtype=wp.int32)  # body that compresses a cell, -1 for none, (f, v)
    way: wp.array2d(dtype=wp.spatial_vector)  # derivative of its compression, (f, v)
    source: wp.array2d(dtype=wp.int32)  # cell whose compression is carried on to a cell, (f, v)
    part: wp.array3d(dtype=wp.spatial_vector)  # of the entry of each pair, (p, b, v)


def pack_fabric(soft: Soft, device: Any) -> Fabric:
    """Lay a fabric out for the kernels."""
    out, known = Fabric(), soft.sheet_terminals
    out.bending = soft.spread
    a, b = np.tril_indices(known.shape[1])
    both = np.stack([known[:, a], known[:, b]], axis=-1)  # terminals, (f, pairs of columns, 2)
    cell, column = np.nonzero((both >= 0).all(axis=-1))
    pair, row = np.unique(np.sort(both[cell, column], axis=-1), axis=0, return_inverse=True)
    order = np.argsort(row.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(row.ravel(), minlength=len(pair)))])
    for name, values, kind in (
        ("points", soft.sheet_points, wp.vec2), ("areas", soft.sheet_areas, wp.float32),
        ("density", soft.sheet_density, wp.float32), ("pair", pair, wp.vec2i),
        ("first", first, wp.int32), ("cell", cell[order], wp.int32),
        ("columns", np.stack([a, b], axis=-1)[column[order]], wp.vec2i),
    ):  # fmt: skip
        setattr(out, name, wp.array(np.ascontiguousarray(values), dtype=kind, device=device))
    return out


@wp.kernel
def find_touching(
    outlines: Outlines, gap: GapLaw, near: NearBodies, node: wp.array2d(dtype=wp.int32),
    clusters: int, out: FabricState,
):  # fmt: skip
    """Enter the bodies, of whatever matter, that reach below the face, (b, v).

    ``node`` and ``clusters`` are of ``WarpActiveTree``, which would be more than a GPU takes.
    """
    b, v = wp.tid()
    e = v // near.sensors
    u = near.choice[e, b]
    out.touches[b, v] = 0
    if node[b * clusters, v] >= 0 and outlines.kind[u] != 0:
        at = near.pose[b, v]
        scale = near.scale[e, b]
        middle = middle_height(outlines, u, at, scale)
        reach = reach_down(outlines, u, wp.transform_get_rotation(at), scale)
        if middle >= gap.top and middle - reach < gap.top:
            out.touches[b, v] = 1


@wp.kernel
def press_cells(
    outlines: Outlines, gap: GapLaw, fabric: Fabric, near: NearBodies, out: FabricState
):
    """Compression of the cells by bodies, (f, v)."""
    c, v = wp.tid()
    x = wp.vec3(fabric.points[c][0], fabric.points[c][1], gap.top - gap.cover)
    length = gap.cover
    for b in range(out.touches.shape[0]):
        if out.touches[b, v] != 0 and may_meet(near, b, v, x, gap.cover):
            off = line_length(nearest_of(outlines, near, b, v, x), length)
            if off < length:
                length = wp.max(off, gap.cover - gap.limit)
    out.pressed[c, v] = gap.cover - length


@wp.kernel
def list_pressed(out: FabricState):
    """List the cells that are compressed."""
    v = wp.tid()
    count = int(0)
    for c in range(out.pressed.shape[0]):
        if out.pressed[c, v] > 0.0:
            out.cell[count, v] = c
            count += 1
    out.count[v] = count


@wp.func
def _carried(fabric: Fabric, state: FabricState, c: int, v: int):
    """Compression of a cell as the fabric carries it on, and the cell that it comes from."""
    source = c
    most = state.pressed[c, v]
    if fabric.bending > 0.0:
        for k in range(state.count[v]):
            q = state.cell[k, v]
            far = wp.length(fabric.points[c] - fabric.points[q]) / fabric.bending
            depth = state.pressed[q, v] * wp.exp(-far)
            if far < _FAR and depth > most:
                most = depth
                source = q
    return most, source


@wp.kernel
def spread(fabric: Fabric, out: FabricState):
    """Compression of the cells as the fabric carries it on, (f, v)."""
    c, v = wp.tid()
    most, _source = _carried(fabric, out, c, v)
    out.depth[c, v] = most


@wp.func
def _product(gap: GapLaw, fabric: Fabric, c: int, columns: wp.vec2i, k: int):
    """Product of two densities at a cell, times the square of the rest of the thickness [V²]."""
    rest = 1.0 - gap.strains[k]
    return fabric.density[c, k, columns[0]] * fabric.density[c, k, columns[1]] * rest * rest


@wp.func
def _swept(gap: GapLaw, fabric: Fabric, c: int, columns: wp.vec2i, strain: float):
    """Integral of two densities' product over strain at a cell [V²], see the twin."""
    out = float(0.0)
    for k in range(gap.strains.shape[0] - 1):
        start = gap.strains[k]
        end = gap.strains[k + 1]
        stop = wp.min(end, strain)
        if stop > start:
            one = _product(gap, fabric, c, columns, k)
            two = _product(gap, fabric, c, columns, k + 1)
            share = (stop - start) / (end - start)
            mean = one + 0.5 * share * (two - one)
            out += mean * (stop - start) / ((1.0 - stop) * (1.0 - start))
    return out


@wp.kernel
def fabric_change(
    gap: GapLaw, fabric: Fabric, state: FabricState, whole: wp.array3d(dtype=wp.vec2d)
):
    """Add what compression below the fabric changes of the matrices of terminals, (p, v)."""
    p, v = wp.tid()
    if state.count[v] == 0:
        return
    total = float(0.0)
    for k in range(fabric.first[p], fabric.first[p + 1]):
        c = fabric.cell[k]
        strain = state.depth[c, v] / gap.cover
        if strain > 0.0:
            total += fabric.areas[c] * _swept(gap, fabric, c, fabric.columns[k], strain)
    value = wp.vec2d(wp.float64(total / (4.0 * _PI * gap.eps * gap.cover)), wp.float64(0.0))
    i = fabric.pair[p][0]
    j = fabric.pair[p][1]
    whole[i, j, v] = whole[i, j, v] + value
    if i != j:
        whole[j, i, v] = whole[j, i, v] + value


@wp.kernel
def find_rise(near: NearBodies, out: FabricSlopes):
    """How far bodies were pressed out of the face, (b, v)."""
    b, v = wp.tid()
    rise = float(0.0)
    for k in range(near.count[v]):
        if near.body[k, v] == b and near.below[b, v] > 0.0:
            for p in range(near.depth.shape[0]):
                rise = wp.max(rise, near.depth[p, b, v])
            rise = wp.min(rise, near.below[b, v])
    out.rise[b, v] = rise


@wp.kernel
def cell_slopes(
    outlines: Outlines, gap: GapLaw, fabric: Fabric, near: NearBodies, state: FabricState,
    out: FabricSlopes,
):  # fmt: skip
    """Derivatives of the compression of cells by the pose of the body in each, (f, v)."""
    c, v = wp.tid()
    x = wp.vec3(fabric.points[c][0], fabric.points[c][1], gap.top - gap.cover)
    length = gap.cover
    owner = int(-1)
    if state.pressed[c, v] > 0.0:
        for b in range(state.touches.shape[0]):
            if state.touches[b, v] != 0:
                y = x + wp.vec3(0.0, 0.0, out.rise[b, v])
                off = line_length(nearest_of(outlines, near, b, v, y), length)
                if off < length:
                    length = off
                    owner = b
    out.owner[c, v] = owner
    out.way[c, v] = wp.spatial_vector()
    if owner >= 0 and length > gap.cover - gap.limit:
        y = x + wp.vec3(0.0, 0.0, out.rise[owner, v])
        out.way[c, v] = -line_turns(outlines, gap, near, y, owner, v)


@wp.kernel
def find_sources(fabric: Fabric, state: FabricState, out: FabricSlopes):
    """Cells whose compression is carried on to others, (f, v)."""
    c, v = wp.tid()
    _most, source = _carried(fabric, state, c, v)
    out.source[c, v] = source


@wp.func
def _swept_slope(gap: GapLaw, fabric: Fabric, c: int, columns: wp.vec2i, strain: float):
    """Derivative of :func:`_swept` by the strain [V²]."""
    out = float(0.0)
    for k in range(gap.strains.shape[0] - 1):
        start = gap.strains[k]
        end = gap.strains[k + 1]
        if start <= strain and strain < end:
            one = _product(gap, fabric, c, columns, k)
            two = _product(gap, fabric, c, columns, k + 1)
            slope = (two - one) / (end - start)
            mean = one + 0.5 * slope * (strain - start)
            out = mean / ((1.0 - strain) * (1.0 - strain))
            out += 0.5 * slope * (strain - start) / ((1.0 - strain) * (1.0 - start))
    return out


@wp.kernel
def pair_slopes(gap: GapLaw, fabric: Fabric, state: FabricState, out: FabricSlopes):
    """Derivatives of the fabric's part of each entry by the poses of bodies, (p, b, v)."""
    p, b, v = wp.tid()
    total = wp.spatial_vector()
    if state.count[v] > 0:
        for k in range(fabric.first[p], fabric.first[p + 1]):
            c = fabric.cell[k]
            depth = state.depth[c, v]
            if depth > 0.0:
                q = out.source[c, v]
                if out.owner[q, v] == b:
                    slope = _swept_slope(gap, fabric, c, fabric.columns[k], depth / gap.cover)
                    slope *= fabric.areas[c] * depth / state.pressed[q, v]
                    total += slope * out.way[q, v]
    out.part[p, b, v] = total / (4.0 * _PI * gap.eps * gap.cover * gap.cover)


@wp.kernel
def add_slopes(
    circuit: Circuit, fabric: Fabric, moved: wp.array2d(dtype=wp.vec3), slopes: FabricSlopes,
    volts: wp.array3d(dtype=wp.float32), out: wp.array4d(dtype=wp.spatial_vector),
):  # fmt: skip
    """Add derivatives of the fabric's part of the electrodes' matrices, as ``slopes`` of
    :mod:`capsense.fleet.warp_network`."""
    b, i, v = wp.tid()
    for j in range(circuit.electrodes):
        total = wp.spatial_vector()
        for p in range(fabric.pair.shape[0]):
            a = fabric.pair[p][0]
            c = fabric.pair[p][1]
            share = volts[a, i, v] * volts[c, j, v]
            if a != c:
                share += volts[c, i, v] * volts[a, j, v]
            total += share * slopes.part[p, b, v]
        force = wp.spatial_top(total)
        torque = wp.spatial_bottom(total) + wp.cross(moved[b, v], force)
        more = wp.spatial_vector(circuit.metre * force, circuit.unit * torque)
        out[v, b, i, j] = out[v, b, i, j] + more
