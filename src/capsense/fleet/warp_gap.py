"""The gap law of many environments as Warp kernels: what bodies near a flat design add.

The twin of these kernels is :mod:`capsense.solver.gap.gap_kernels`; their inputs are described in
:mod:`capsense.fleet.warp_near`. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import math

import warp as wp

from capsense.fleet.warp_cut import Response, held_off, lift, smooth
from capsense.fleet.warp_mesh import Hit, Outlines
from capsense.fleet.warp_near import GapLaw, NearBodies, may_meet, nearest_of
from capsense.solver.gap.gap_kernels import REACH

wp.set_module_options({"enable_backward": False})

_REACH0, _REACH1 = wp.constant(REACH[0]), wp.constant(REACH[1])
_PI = wp.constant(math.pi)


@wp.func
def _arc(distance: float, across: float, up: float):
    """Length of an arc that leaves the face at a right angle, over a distance."""
    angle = wp.min(wp.atan2(across, up), 2.5)
    return distance * wp.where(angle > 1.0e-3, angle / wp.sin(wp.max(angle, 1.0e-3)), 1.0)


@wp.func
def _flatter(normal: wp.vec3, ratio: float):
    """Normal of a lifted face; of length 0 where there is none."""
    out = wp.vec3(ratio * normal[0], ratio * normal[1], wp.min(normal[2], 0.0))
    size = wp.length(out)
    return wp.where(size < 1.0e-9, 0.0, 1.0) * out / wp.max(size, 1.0e-9)


@wp.func
def _support(hit: Hit, ratio: float, back: wp.vec3, far: float):
    """Distance from a place to lifted faces, and how far its way points down, see the twin."""
    one = _flatter(hit.first, ratio)
    two = _flatter(hit.second, ratio)
    along = far
    up = float(1.0)
    if wp.length(one) > 0.0:
        first = wp.dot(one, back)
        second = wp.dot(two, back)
        both = wp.dot(one, two)
        if hit.faces == 1:
            along = wp.max(first, 0.0)
            up = -one[2]
        elif wp.length(two) > 0.0:
            if first < second * both:
                along = wp.max(second, 0.0)
                up = -two[2]
            elif second < first * both:
                along = wp.max(first, 0.0)
                up = -one[2]
    return along, up


@wp.func
def lengths(gap: GapLaw, green: Response, hit: Hit, x: wp.vec3):
    """Lengths of the field lines from a place on the face to a body, and to the lifted body [m]."""
    h0 = gap.validity
    least = gap.least
    if hit.off <= 0.0:
        return least, h0
    across = wp.sqrt(hit.way[0] * hit.way[0] + hit.way[1] * hit.way[1])
    true = _arc(wp.length(hit.way), across, hit.way[2])
    p = x + hit.way
    dx = wp.max(wp.max(green.box0[0] - p[0], p[0] - green.box1[0]), 0.0)
    dy = wp.max(wp.max(green.box0[1] - p[1], p[1] - green.box1[1]), 0.0)
    beside = dx * dx + dy * dy
    height = wp.max(hit.way[2], 0.0)
    if beside + height * height >= 4.0 * h0 * h0:
        return true, true
    p[2] = gap.top + height
    moved = lift(p, h0, green) - x
    wide = wp.sqrt(moved[0] * moved[0] + moved[1] * moved[1])
    far = wp.length(moved)
    lifted = _arc(far, wide, moved[2])
    if hit.faces > 0:  # another point of the lifted surface, which is flatter, may be nearer
        along, up = _support(hit, height / (2.0 * h0), -moved, far)
        if along < far:
            lower = _arc(along, along * wp.sqrt(wp.max(0.0, 1.0 - up * up)), along * up)
            share = smooth(1.0 - wp.sqrt(beside) / h0)
            lifted += share * (wp.min(lower, lifted) - lifted)
    true = held_off(true, least)
    return true, wp.max(lifted, true)


@wp.func
def place_of(gap: GapLaw, length: float):
    """Place of a length among the heights of the table, and the share of the next one."""
    x = wp.log(length / gap.lowest) / gap.log_ratio
    k = wp.clamp(wp.int32(wp.floor(x)), 0, gap.change.shape[1] - 2)
    return k, wp.clamp(x - float(k), 0.0, 1.0)


@wp.func
def met_by(outlines: Outlines, gap: GapLaw, near: NearBodies, q: int, grounded: bool, v: int):
    """A bit for every near body that may count in a block of cells; nodes alone on pours."""
    met = wp.int64(0)
    for k in range(near.count[v]):
        b = near.body[k, v]
        sunk = near.sunk[b, v]
        x = wp.vec3(gap.center[q][0], gap.center[q][1], gap.top + sunk)
        reach = _REACH1 * (gap.validity + sunk) + gap.radius[q]
        if (near.slot[b, v] >= 0 or not grounded) and may_meet(near, b, v, x, reach):
            hit = nearest_of(outlines, near, b, v, x)
            if hit.off < reach:
                met = met | (wp.int64(1) << wp.int64(wp.min(k, 63)))
    return met


@wp.func
def nearest_cell(
    outlines: Outlines, gap: GapLaw, green: Response, near: NearBodies, met: wp.int64, x: wp.vec3,
    v: int,
):  # fmt: skip
    """The shortest field line from a place, that to the lifted body, and whose these are.

    The last is a place in ``near.body``, -1 for none; ``met`` is as of :func:`met_by`.
    """
    best = float(1.0e30)
    high = float(1.0e30)
    body = int(-1)
    for k in range(near.count[v]):
        if ((met >> wp.int64(wp.min(k, 63))) & wp.int64(1)) != wp.int64(0):
            hit = nearest_of(outlines, near, near.body[k, v], v, x)
            true, lifted = lengths(gap, green, hit, x)
            sunk = near.sunk[near.body[k, v], v]
            if sunk > 0.0:  # it stands lower than where it is solved for
                lower = x + wp.vec3(0.0, 0.0, sunk)
                hit = nearest_of(outlines, near, near.body[k, v], v, lower)
                true, _high = lengths(gap, green, hit, x)
            if true < best:
                best = true
                high = wp.max(true, lifted)
                body = k
    return best, high, body


@wp.func
def _add_cell(
    gap: GapLaw, near: NearBodies, c: int, p: int, best: float, high: float, body: int, v: int
):  # fmt: skip
    """Add what one cell changes, of lengths as of :func:`nearest_cell`."""
    if body < 0 or high <= best:
        return
    scale = gap.validity + near.sunk[near.body[body, v], v]
    weight = 1.0 - smooth((best / scale - _REACH0) / (_REACH1 - _REACH0))
    if weight <= 0.0:
        return
    weight *= gap.areas[c] / (4.0 * _PI)
    k, s = place_of(gap, best)
    m, w = place_of(gap, high)
    one = weight / (best + gap.series[c])
    two = weight / (high + gap.series[c])
    columns = gap.columns.shape[1]
    slot = near.slot[near.body[body, v], v]
    for col in range(columns + 1):
        value = one * ((1.0 - s) * gap.change[c, k, col] + s * gap.change[c, k + 1, col])
        value -= two * ((1.0 - w) * gap.change[c, m, col] + w * gap.change[c, m + 1, col])
        to = col
        if col == columns:
            to = wp.where(slot < 0, -1, columns + slot)
        if to >= 0:
            near.part[p, to, v] = near.part[p, to, v] + value


@wp.func
def strain_place(gap: GapLaw, length: float, below: float):
    """Place of a compressed length among the strains, and the share of the next one."""
    strain = 1.0 - length / gap.cover
    k = int(0)
    while k < gap.strains.shape[0] - 2 and gap.strains[k + 1] < strain:
        k += 1
    rest = below * gap.eps
    low = 1.0 / (rest + (1.0 - gap.strains[k]) * gap.cover)
    high = 1.0 / (rest + (1.0 - gap.strains[k + 1]) * gap.cover)
    return k, wp.clamp((1.0 / (rest + length) - low) / (high - low), 0.0, 1.0)


@wp.func
def line_length(hit: Hit, length: float):
    """Length of the field line to a nearest point; its distance where that is ``length`` or more.

    Negative inside of a body.
    """
    off = hit.off
    if off > 0.0 and off < length:
        across = wp.sqrt(hit.way[0] * hit.way[0] + hit.way[1] * hit.way[1])
        off = _arc(off, across, hit.way[2])
    return off


@wp.func
def compressed_length(
    outlines: Outlines, gap: GapLaw, near: NearBodies, met: wp.int64, x: wp.vec3, v: int
):  # fmt: skip
    """Length of the field line through the cover from a place below it, and whose this is.

    The second is a place in ``near.body``, -1 where nothing is pressed in; ``met`` is as of
    :func:`met_by`.
    """
    length = gap.cover
    body = int(-1)
    for k in range(near.count[v]):
        if ((met >> wp.int64(wp.min(k, 63))) & wp.int64(1)) != wp.int64(0):
            b = near.body[k, v]
            hit = nearest_of(outlines, near, b, v, x + wp.vec3(0.0, 0.0, near.sunk[b, v]))
            off = line_length(hit, length)
            if off < length:
                length = wp.max(off, gap.cover - gap.limit)
                body = k
    return length, body


@wp.func
def _add_compressed(
    outlines: Outlines, gap: GapLaw, near: NearBodies, met: wp.int64, c: int, p: int, v: int
):  # fmt: skip
    """Add what one cell changes as a body is pressed into the cover above it.

    ``met`` is as of :func:`met_by`.
    """
    x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top - gap.cover)
    length, body = compressed_length(outlines, gap, near, met, x, v)
    if body < 0:
        return
    k, share = strain_place(gap, length, gap.below[c])
    weight = gap.areas[c] / (4.0 * _PI * gap.cover)
    columns = gap.columns.shape[1]
    slot = near.slot[near.body[body, v], v]
    for col in range(columns + 1):
        value = (1.0 - share) * gap.pressed[c, k, col] + share * gap.pressed[c, k + 1, col]
        to = col
        if col == columns:
            to = wp.where(slot < 0, -1, columns + slot)
        if to >= 0:
            near.part[p, to, v] = near.part[p, to, v] + weight * value


@wp.kernel
def local_change(outlines: Outlines, gap: GapLaw, green: Response, near: NearBodies):
    """Local change by near bodies of a chunk's cells [m], as ``gap_kernels.local_change``."""
    v, p = wp.tid()
    if near.count[v] == 0:
        return
    for k in range(near.part.shape[1]):
        near.part[p, k, v] = 0.0
    grounded = gap.owner[p] < 0
    if grounded and near.columns[v] == gap.terminals:
        return
    for q in range(gap.chunks[p], gap.chunks[p + 1]):
        met = met_by(outlines, gap, near, q, grounded, v)
        if met != wp.int64(0):
            for c in range(gap.blocks[q], gap.blocks[q + 1]):
                x = wp.vec3(gap.points[c][0], gap.points[c][1], gap.top)
                best, high, body = nearest_cell(outlines, gap, green, near, met, x, v)
                _add_cell(gap, near, c, p, best, high, body, v)
                if gap.below[c] >= 0.0:
                    _add_compressed(outlines, gap, near, met, c, p, v)


@wp.func
def local_of(gap: GapLaw, near: NearBodies, i: int, j: int, v: int):
    """The local change of an entry of the matrix of terminals and nodes [m]."""
    total = float(0.0)
    t = gap.terminals
    columns = gap.columns.shape[1]
    a = wp.min(i, j)
    k = wp.max(i, j)
    if k < t:
        for side in range(2):
            row = wp.where(side == 0, i, j)
            other = wp.where(side == 0, j, i)
            for col in range(columns):
                if gap.columns[row, col] == other:
                    for p in range(gap.span[row], gap.span[row + 1]):
                        total += 0.5 * near.part[p, col, v]
    elif a < t:
        for p in range(gap.span[a], gap.span[a + 1]):
            total += near.part[p, columns + k - t, v]
    elif a == k:
        for p in range(gap.owner.shape[0]):
            total -= near.part[p, columns + k - t, v]
    return total
