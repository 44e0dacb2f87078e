"""What is near a flat design in many environments, as Warp kernels; 4π eps0 = 1.

The twins of these kernels are ``near_bodies`` and ``press_out`` of
:mod:`capsense.solver.gap.gap_kernels`, and ``network_kernels.as_nodes``. A design's cells stand in
blocks, and a few blocks of one terminal are a *chunk*, which a thread works out for one view. Sums
of chunks are added in a fixed order. Lengths in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from capsense.field.green_kernels import Gap, Green, no_gap
from capsense.field.soft import BODY
from capsense.fleet.warp_cut import (
    Places,
    Response,
    Shapes,
    WarpActiveTree,
    five,
    off_walls,
    smooth,
)
from capsense.fleet.warp_mesh import Outlines
from capsense.fleet.warp_outline import farthest_point, middle_height, nearest, reach_down
from capsense.solver.gap.gap_kernels import EXACT, WAYS
from capsense.solver.system.network_kernels import COARSE
from capsense.solver.tree.matter import FLOATING_PENALTY

wp.set_module_options({"enable_backward": False})

_WAYS, _EXACT, _FLOATING_PENALTY = (
    wp.constant(WAYS),
    wp.constant(EXACT),
    wp.constant(FLOATING_PENALTY),
)
_COARSE = wp.constant(COARSE)
_BLOCKS = 3
"""About so many blocks are a chunk."""


@wp.struct
class GapLaw:
    """The table of a design, see ``gap_table.GapTable``: c cells in q blocks in p chunks."""

    validity: wp.float32
    least: wp.float32  # field lines are no shorter
    top: wp.float32
    lowest: wp.float32  # the first of the heights of the table [m]
    floor: wp.float32  # what reaches from here …
    ceiling: wp.float32  # … to here surrounds the domain
    log_ratio: wp.float32
    terminals: wp.int32
    slots: wp.int32  # conductors near the design that can be nodes
    cover: wp.float32  # thickness of a cover that gives way [m], 0 for none
    eps: wp.float32  # its relative permittivity
    limit: wp.float32  # its largest compression [m]
    points: wp.array(dtype=wp.vec2)
    below: wp.array(dtype=wp.float32)  # between it and a cell, thickness over eps [m]; -1 for none
    areas: wp.array(dtype=wp.float32)
    series: wp.array(dtype=wp.float32)
    columns: wp.array2d(dtype=wp.int32)
    change: wp.array3d(dtype=wp.float32)
    strains: wp.array(dtype=wp.float32)  # of the cover, and what they change, see ``Soft``
    pressed: wp.array3d(dtype=wp.float32)
    blocks: wp.array(dtype=wp.int32)  # first cell of each, and their number, (q + 1,)
    center: wp.array(dtype=wp.vec2)
    radius: wp.array(dtype=wp.float32)
    chunks: wp.array(dtype=wp.int32)  # first block of each, and their number, (p + 1,)
    owner: wp.array(dtype=wp.int32)  # terminal of a chunk, -1 for grounded sheets, (p,)
    span: wp.array(dtype=wp.int32)  # first chunk of each terminal and grounded sheets, (t + 2,)


@wp.struct
class NearBodies:
    """What is near the design in every view; b places for bodies.

    The first ones are arrays of ``Places``, ``Shapes`` and ``WarpActiveTree``: kernels that took
    all of these would have more arguments than a GPU takes.
    """

    sensors: wp.int32  # in each environment
    choice: wp.array2d(dtype=wp.int32)
    scale: wp.array2d(dtype=wp.float32)
    inverse_susceptibility: wp.array2d(dtype=wp.vec2)
    group: wp.array(dtype=wp.int32)
    radius: wp.array(dtype=wp.float32)
    pose: wp.array2d(dtype=wp.transform)
    slot: wp.array2d(dtype=wp.int32)
    columns: wp.array(dtype=wp.int32)
    lossy: wp.array(dtype=wp.int32)
    count: wp.array(dtype=wp.int32)  # bodies that are near, (v,)
    body: wp.array2d(dtype=wp.int32)  # these, in its first rows, (b, v)
    below: wp.array2d(dtype=wp.float32)  # how far a near body reaches below the face [m], (b, v)
    sunk: wp.array2d(dtype=wp.float32)  # how much lower it stands, in a cover [m], (b, v)
    foot: wp.array2d(dtype=wp.vec3)  # its lowest point [m], (b, v)
    depth: wp.array3d(dtype=wp.float32)  # how far it overlaps cells of a chunk [m], (p, b, v)
    capacitance: wp.array2d(dtype=wp.float32)  # of nodes to ground [m], (slots, v)
    part: wp.array3d(dtype=wp.float32)  # local change by columns, then by nodes, (p, n + slots, v)


def law_of(green: Green) -> Gap:
    """The gap law of a design as Warp has it: that of bent films is not on it."""
    gap = green.gap
    return no_gap(gap.validity, gap.face) if gap.curvature else gap


def pack_gap(green: Green, gap: Gap, slots: int, device: Any) -> GapLaw:
    """Lay the gap law of a design out for the kernels."""
    terminals = green.terminals
    out, cells = GapLaw(), len(gap.areas)
    out.floor, out.ceiling = float(green.active_bounds[0, 2]), float(green.active_bounds[1, 2])
    out.validity, out.top, out.lowest = gap.validity, gap.top, float(gap.heights[0])
    out.log_ratio, out.terminals, out.slots = gap.log_ratio, terminals, slots
    out.least = gap.least
    out.cover, out.eps, out.limit = gap.soft.thickness, gap.soft.eps, gap.soft.limit
    below = np.where(gap.soft.top == BODY, gap.soft.below, -1.0)  # a fabric has cells of its own
    owners = gap.terminal[gap.blocks[:-1]] if cells else np.zeros(0, np.int64)
    each = [np.flatnonzero(owners == t)[::_BLOCKS] for t in (*range(terminals), -1)]  # as they lie
    first = np.concatenate(each)
    owner = owners[first]
    span = np.cumsum([0, *map(len, each)])
    for name, values, kind in (
        ("points", gap.points, wp.vec2), ("areas", gap.areas, wp.float32),
        ("series", gap.series, wp.float32), ("below", below, wp.float32),
        ("columns", gap.columns, wp.int32),
        ("change", gap.change, wp.float32), ("strains", gap.soft.strains, wp.float32),
        ("pressed", gap.soft.change, wp.float32), ("blocks", gap.blocks, wp.int32),
        ("center", gap.block_center, wp.vec2), ("radius", gap.block_radius, wp.float32),
        ("chunks", [*first, len(owners)], wp.int32), ("owner", owner, wp.int32),
        ("span", span, wp.int32),
    ):  # fmt: skip
        setattr(out, name, wp.array(np.ascontiguousarray(values), dtype=kind, device=device))
    return out


@wp.kernel
def find_outside(shapes: Shapes, places: Places, green: Response, cut: WarpActiveTree):
    """How much of conductors not at ground is out of reach, as ``network_kernels``."""
    b, v = wp.tid()
    e = v // places.hidden.shape[0]
    out = five()
    cut.outside[b, v] = out
    u = places.choice[e, b]
    loose = places.neutral[e, b] != 0 or places.ground_elastance[e, b][0] > 0.0
    conducts = places.inverse_susceptibility[e, b] == wp.vec2()
    if u < 0 or places.hidden[v % places.hidden.shape[0], b] != 0 or not (loose and conducts):
        return
    first = shapes.first[u]
    scale = places.scale[e, b]
    outside = float(0.0)
    middle = wp.vec3()
    for k in range(wp.min(_COARSE, 2 * shapes.functions[u] - 1)):
        part = shapes.children[first + k, 0]
        if part < 0 or part >= _COARSE - 1:  # else its parts stand for it
            at = wp.transform_point(cut.pose[b, v], scale * shapes.center[first + k])
            share = shapes.charge[first + k] * smooth(wp.length(off_walls(at, 1, green)))
            outside += share
            middle += share * at
    if outside > 0.0:
        middle = middle / outside
        whole = scale * shapes.capacitance[u] * outside / shapes.charge[first]
        out[0] = whole
        for i in range(3):
            out[1 + i] = middle[i]
        cut.outside[b, v] = out


@wp.func
def outside_capacitance(places: Places, cut: WarpActiveTree, group: int, v: int):
    """Capacitance in free space of what is out of reach of a conductor, as ``network_kernels``."""
    charge = float(0.0)
    energy = float(0.0)
    for b in range(places.group.shape[0]):
        if places.group[b] == group and cut.outside[b, v][0] > 0.0:
            one = cut.outside[b, v]
            charge += one[0]
            energy += one[0]
            for c in range(b):
                other = cut.outside[c, v]
                if places.group[c] == group and other[0] > 0.0:
                    off = wp.vec3(one[1] - other[1], one[2] - other[2], one[3] - other[3])
                    least = wp.max(one[0], other[0])
                    energy += 2.0 * one[0] * other[0] / wp.max(wp.length(off), least)
    return wp.where(energy > 0.0, charge * charge / wp.max(energy, 1.0e-30), 0.0)


@wp.kernel
def connect(places: Places, cut: WarpActiveTree, terminals: int):
    """What ties the bodies of a view to ground; places that are joined are one conductor.

    Those that are out of sight count for the tie, which is at least what is out of reach has in
    free space. The leader of those in sight has the function of the net charge. That of each other
    member is its own equilibrium charge less the leader's, which is neutral.
    """
    v = wp.tid()
    e = v // places.hidden.shape[0]
    lossy = int(0)
    for b in range(places.group.shape[0]):
        o = b * cut.clusters
        leader = int(b)
        tie = places.ground_elastance[e, b]
        neutral = places.neutral[e, b]
        if cut.node[o, v] >= 0:
            others = int(0)
            grounded = int(0)
            ground = float(0.0)
            for c in range(places.group.shape[0]):
                if places.group[c] == places.group[b] and places.choice[e, c] >= 0:
                    if cut.node[c * cut.clusters, v] >= 0:
                        leader = wp.min(leader, c)
                        others = wp.where(c == b, others, 1)
                    if places.neutral[e, c] == 0:  # those out of sight count too
                        others = wp.where(c == b, others, 1)
                        if places.ground_elastance[e, c][0] == 0.0:
                            grounded = 1
                        else:
                            ground += 1.0 / places.ground_elastance[e, c][0]
            if others == 1:
                neutral = wp.where(grounded == 0 and ground == 0.0, 1, 0)
                tie = wp.vec2(wp.where(grounded == 1 or neutral == 1, 0.0, 1.0 / ground), 0.0)
            conducts = places.inverse_susceptibility[e, b] == wp.vec2()
            if conducts and (neutral != 0 or tie[0] > 0.0):
                found = cut.outside[b, v]
                found[4] = 1.0
                cut.outside[b, v] = found
                outside = outside_capacitance(places, cut, places.group[b], v)
                if outside * _FLOATING_PENALTY > 1.0 and (neutral != 0 or tie[0] * outside > 1.0):
                    neutral = int(0)
                    tie = wp.vec2(1.0 / outside, 0.0)
            cut.number[o, v] = wp.where(leader == b and neutral != 0, -1, 0)
            if tie[1] != 0.0 or places.inverse_susceptibility[e, b][1] != 0.0:
                lossy = 1
        cut.leader[b, v] = leader
        cut.ground_elastance[b, v] = tie
        cut.slot[b, v] = -1
    cut.lossy[v] = lossy
    cut.columns[v] = terminals


@wp.kernel
def find_near(outlines: Outlines, gap: GapLaw, cut: WarpActiveTree, near: NearBodies):
    """Enter the bodies that are near, and make nodes of those that are not at ground.

    Of places that are joined, all become one node, and are their own leaders, at ground or at 1 V.
    Where there are more nodes than slots, the rest is lifted and nothing is added.
    """
    v = wp.tid()
    nodes = int(0)
    count = int(0)
    if cut.lossy[v] == 0:
        for b in range(near.group.shape[0]):
            there = _is_near(outlines, gap, cut, near, b, v)
            neutral = cut.number[cut.leader[b, v] * cut.clusters, v] < 0
            if there and cut.slot[b, v] < 0 and (neutral or cut.ground_elastance[b, v][0] > 0.0):
                there = nodes < gap.slots
                if there:
                    _make_node(cut, near, b, neutral, nodes, v)
                    nodes += 1
            if there:
                near.body[count, v] = b
                count += 1
    near.count[v] = count
    cut.columns[v] = gap.terminals + nodes


@wp.func
def _make_node(cut: WarpActiveTree, near: NearBodies, b: int, neutral: bool, slot: int, v: int):
    """Make a node of a place and of those that it is joined with."""
    tie = cut.ground_elastance[b, v][0]
    own = float(0.0)
    if not neutral and tie < 0.5 * _FLOATING_PENALTY:
        own = 1.0 / tie
    near.capacitance[slot, v] = own
    for c in range(near.group.shape[0]):
        if near.group[c] == near.group[b] and cut.node[c * cut.clusters, v] >= 0:
            cut.slot[c, v] = slot
            cut.leader[c, v] = c
            cut.number[c * cut.clusters, v] = 0
            cut.ground_elastance[c, v] = wp.vec2()


@wp.func
def _is_near(
    outlines: Outlines, gap: GapLaw, cut: WarpActiveTree, near: NearBodies, b: int, v: int
):
    """Whether a conductor is within twice h0 of the face, as ``gap_kernels.near_bodies``."""
    e = v // near.sensors
    out = bool(False)
    if cut.node[b * cut.clusters, v] >= 0 and near.inverse_susceptibility[e, b][0] == 0.0:
        u = near.choice[e, b]
        at = near.pose[b, v]
        scale = near.scale[e, b]
        if outlines.kind[u] != 0:
            middle = middle_height(outlines, u, at, scale)
            lowest = middle - reach_down(outlines, u, wp.transform_get_rotation(at), scale)
            near.below[b, v] = gap.top - lowest
            around = lowest <= gap.floor and 2.0 * middle - lowest >= gap.ceiling
            out = middle >= gap.top and lowest < gap.top + 2.0 * gap.validity and not around
            if lowest < gap.top:
                near.foot[b, v] = farthest_point(outlines, u, at, scale, wp.vec3(0.0, 0.0, -1.0))
    return out


@wp.func
def may_meet(near: NearBodies, b: int, v: int, x: wp.vec3, off: float):
    """Whether a body may be within a distance of a point, by the ball that holds it."""
    e = v // near.sensors
    reach = near.scale[e, b] * near.radius[near.choice[e, b]] + off
    return wp.length(x - wp.transform_get_translation(near.pose[b, v])) < reach


@wp.func
def nearest_of(outlines: Outlines, near: NearBodies, b: int, v: int, x: wp.vec3):
    """Nearest point of the body in a place."""
    e = v // near.sensors
    return nearest(outlines, near.choice[e, b], near.pose[b, v], near.scale[e, b], x)


@wp.kernel
def press(outlines: Outlines, gap: GapLaw, near: NearBodies):
    """How far bodies overlap the cells of a chunk, as ``gap_kernels.press_out``, (p, b, v)."""
    v, p = wp.tid()
    for k in range(near.count[v]):
        b = near.body[k, v]
        deepest = float(0.0)
        if near.below[b, v] > 0.0 and gap.owner[p] >= 0:
            for q in range(gap.chunks[p], gap.chunks[p + 1]):
                deepest = wp.max(deepest, _overlap_of_block(outlines, gap, near, b, q, v))
        near.depth[p, b, v] = deepest


@wp.func
def _overlap_of_block(outlines: Outlines, gap: GapLaw, near: NearBodies, b: int, q: int, v: int):
    """How far a body overlaps the cells of a block [m]."""
    middle = wp.vec3(gap.center[q][0], gap.center[q][1], gap.top)
    foot = near.foot[b, v]
    deepest = float(0.0)
    if may_meet(near, b, v, middle, gap.radius[q]):
        hit = nearest_of(outlines, near, b, v, middle)
        if hit.off <= gap.radius[q]:
            for c in range(gap.blocks[q], gap.blocks[q + 1]):
                x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
                deepest = wp.max(deepest, _overlap(outlines, gap, near, b, v, x))
                beside = wp.vec2(foot[0] - x[0], foot[1] - x[1])
                if wp.dot(beside, beside) < gap.areas[c]:
                    deepest = wp.max(deepest, gap.top - foot[2])
    return deepest


@wp.func
def _overlap(outlines: Outlines, gap: GapLaw, near: NearBodies, b: int, v: int, x: wp.vec3):
    """How far down the surface of a body is below a place of the face [m]."""
    at = x
    going = int(1)
    for _ in range(_WAYS):
        if going == 1:
            hit = nearest_of(outlines, near, b, v, at)
            if hit.off >= -_EXACT * gap.validity:
                going = 0
            else:
                at[2] = at[2] + hit.off
    return x[2] - at[2]


@wp.kernel
def press_out(gap: GapLaw, near: NearBodies):
    """Move near bodies that overlap the face up until they touch it."""
    v = wp.tid()
    for k in range(near.count[v]):
        b = near.body[k, v]
        near.sunk[b, v] = 0.0
        if near.below[b, v] > 0.0:
            deepest = float(0.0)
            for p in range(gap.owner.shape[0]):
                deepest = wp.max(deepest, near.depth[p, b, v])
            at = near.pose[b, v]
            rise = wp.max(wp.min(deepest, near.below[b, v]), 0.0)
            near.sunk[b, v] = wp.min(rise, gap.limit)
            up = wp.vec3(0.0, 0.0, rise)
            near.pose[b, v] = wp.transform(
                wp.transform_get_translation(at) + up, wp.transform_get_rotation(at)
            )
