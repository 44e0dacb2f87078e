"""The step, compiled: what bodies in the first millimetres in front of a design add.

Bodies are solved for where the Green's function is valid: points nearer than twice the validity
distance h0 are lifted, a distance z to h0 + z² / (4 h0). What that takes away is local. Each cell p
of the electrodes adds T(p, l) - T(p, l_g), where T is the table of the design's own boundary
elements (:mod:`capsense.field.gap_table`), l the length of the field line from p to the body, and
l_g that to the lifted body.

Cells, and all lengths in front of a bent film, are in coordinates of its face.

Conductors near the design that are not at ground are nodes of a network, like terminals: they are
solved for at ground and at 1 V, the local changes are added, and the nodes are eliminated.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import compiled, kernel
from capsense._simd import doubles
from capsense.field.face_kernels import held_off, lift, off_face, on_face, smooth
from capsense.field.soft import BODY
from capsense.solver.bodies.outline import (
    CHANGING,
    middle_along,
    middle_height,
    nearest,
    reach_along,
    reach_down,
)

REACH = 5.0, 8.0
"""What is farther than this from a cell, over h0, comes to count for nothing, and does not."""
WAYS, EXACT = 30, 1e-4
"""Steps down through a body at most, and how exactly its surface is found, over h0."""


@compiled
def near_bodies(bodies, green, dielectric):
    """Conductors, or dielectrics, with an outline that may be within twice h0 of a face, (b,).

    Not bodies that are mostly behind the face, nor those from the floor of the domain to its
    ceiling: these surround it.
    """
    out, gap = np.zeros(bodies.shape[0], np.bool_), green.gap
    if gap.areas.shape[0] == 0:
        return out
    for b in range(bodies.shape[0]):
        body = bodies[b]
        if body.outline == 0 or (body.inverse_susceptibility != 0.0) != dielectric:
            continue
        if body.outline == CHANGING:  # it has this outline only where it is near
            out[b] = True
        else:
            low, reach = middle_height(body), reach_down(body)
            around = (
                low - reach <= green.active_bounds[0, 2]
                and low + reach >= green.active_bounds[1, 2]
            )
            middle, lowest, _ = stand_of(body, gap)
            out[b] = middle >= gap.top and lowest < gap.top + 2.0 * gap.validity and not around
    return out


@kernel
def stand_of(body, gap):
    """Heights over the face's zero of the middle of a body, and of its lowest point or less [m].

    And the way up at the middle, (u, 0, w).
    """
    if gap.curvature == 0.0:
        middle = middle_height(body)
        return middle, middle - reach_down(body), (0.0, 1.0)
    x, z = middle_along(body, 0), middle_along(body, 2) + 1.0 / gap.curvature
    far = max(math.sqrt(x * x + z * z), 1e-9 / gap.curvature)
    u, w, middle = x / far, z / far, far - 1.0 / gap.curvature
    return middle, middle - reach_along(body, u, w), (u, w)


@compiled
def press_out(bodies, near, green):
    """Move near bodies that overlap the face of the design away from it until they touch it.

    Physics engines let hard bodies overlap. What lies inside of a body that way is in contact with
    it. A cover that gives way is compressed: ``sunk`` keeps how far below its place a body stands
    in it. Bodies whose middle is behind the face stay where they are.
    """
    gap, point, room = green.gap, np.empty(9), np.empty(140)
    for b in range(bodies.shape[0]):
        if not near[b] or bodies[b].outline == CHANGING:
            continue
        middle, lowest, (u, w) = stand_of(bodies[b], gap)
        below = gap.top - lowest
        if below <= 0.0 or middle < gap.top:
            continue
        deepest, far = 0.0, 1e3 * bodies[b].scale
        x, y, z = bodies[b].position[0], bodies[b].position[1], bodies[b].position[2]
        if gap.curvature == 0.0:
            z = gap.top
        _nearest(bodies[b], x - far * u, y, z - far * w, point, room)
        x, y, z = on_face(point[0], point[1], point[2], gap.curvature)
        if _faces_cell(x, y, gap):  # the lowest point
            deepest = max(0.0, gap.top - z)
        for k in range(gap.block_radius.shape[0]):
            x, y, z = off_face(
                gap.block_center[k, 0], gap.block_center[k, 1], gap.top, gap.curvature
            )
            off, _ = _nearest(bodies[b], x, y, z, point, room)
            if off > gap.block_radius[k] or gap.terminal[gap.blocks[k]] < 0:
                continue
            for c in range(gap.blocks[k], gap.blocks[k + 1]):
                x, y, z = off_face(
                    float(gap.points[c, 0]), float(gap.points[c, 1]), gap.top, gap.curvature
                )
                depth = 0.0
                for _ in range(WAYS):  # down to where the surface is
                    off, _ = _nearest(bodies[b], x - depth * u, y, z - depth * w, point, room)
                    if off >= -EXACT * gap.validity:
                        break
                    depth -= off
                deepest = max(deepest, depth)
        up = max(0.0, min(deepest, below))
        bodies[b].position[0] += up * u
        bodies[b].position[2] += up * w
        bodies[b].sunk += min(up, gap.soft.limit)


@kernel
def _faces_cell(x, y, gap):
    """Whether (x, y) of the face is in front of a cell of a terminal."""
    for k in range(gap.block_radius.shape[0]):
        dx, dy = gap.block_center[k, 0] - x, gap.block_center[k, 1] - y
        if gap.terminal[gap.blocks[k]] < 0 or dx * dx + dy * dy > (2.0 * gap.block_radius[k]) ** 2:
            continue
        for c in range(gap.blocks[k], gap.blocks[k + 1]):
            dx, dy = float(gap.points[c, 0]) - x, float(gap.points[c, 1]) - y
            if dx * dx + dy * dy < gap.areas[c]:
                return True
    return False


@compiled
def local_change(bodies, near, node, green, matrix):
    """Add the local change of near bodies to the matrix of terminals and nodes [m], 4π eps0 = 1.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        near: Which are near, shape (b,).
        node: Row of the matrix of each body that is a node, else -1, shape (b,).
        green: Green's function of the design.
        matrix: Added to, shape (t, t).
    """
    gap = green.gap
    chosen, count = np.empty(bodies.shape[0], np.int64), np.int64(0)
    point, room, moved = np.empty(9), np.empty(140), np.empty((1, 3))
    for k in range(gap.block_radius.shape[0]):
        x, y, z = off_face(gap.block_center[k, 0], gap.block_center[k, 1], gap.top, gap.curvature)
        grounded, count = gap.terminal[gap.blocks[k]] < 0, np.int64(0)
        for b in range(bodies.shape[0]):
            if near[b] and (node[b] >= 0 or not grounded):
                sunk = bodies[b].sunk
                reach = REACH[1] * (gap.validity + sunk) + gap.block_radius[k]
                off, _ = _nearest(bodies[b], x, y, z + sunk, point, room)
                if off < reach:
                    chosen[count] = b
                    count += 1
        if count == 0:
            continue
        for c in range(gap.blocks[k], gap.blocks[k + 1]):
            _add_cell(bodies, chosen, count, node, green, c, (point, room, moved), matrix)
            if gap.soft.top == BODY and gap.soft.below[c] >= 0.0:
                _add_compressed(bodies, chosen, count, node, gap, c, (point, room), matrix)


@kernel
def _nearest(body, x, y, z, point, room):
    """As :func:`nearest`, which is thus compiled for one precision of the coordinates."""
    return nearest(body, np.float64(x), np.float64(y), np.float64(z), point, room)


@kernel
def _add_compressed(bodies, chosen, count, node, gap, c, work, matrix):
    """Add what one cell changes as a body is pressed into the cover above it."""
    soft, n = gap.soft, gap.change.shape[2] - 1
    x, y = float(gap.points[c, 0]), float(gap.points[c, 1])
    length, at = compressed_length(bodies, chosen, count, gap, x, y, work)
    if at < 0:
        return
    i, body = gap.terminal[c], node[chosen[at]]
    k, p = _strain_place(soft, length, float(soft.below[c]))
    weight = float(gap.areas[c]) / (4.0 * math.pi * soft.thickness)
    for col in range(n + 1):
        value = (1.0 - p) * float(soft.change[c, k, col]) + p * float(soft.change[c, k + 1, col])
        _add_to(matrix, gap, i, col, body, weight * value)


@kernel
def _add_to(matrix, gap, i, col, body, value):
    """Add the charge that a cell of terminal i gains in a column of the table.

    ``body`` is the row of the body above it, -1 for one at ground.
    """
    if col < gap.change.shape[2] - 1:
        j = gap.columns[i, col]  # the last row, of index -1, is that of grounded sheets
        if i >= 0 and j >= 0:
            matrix[i, j] += 0.5 * value
            matrix[j, i] += 0.5 * value
    elif body >= 0:
        if i >= 0:
            matrix[i, body] += value
            matrix[body, i] += value
        matrix[body, body] -= value


@kernel
def _strain_place(soft, length, below):
    """Place of a compressed length among the strains, and the share of the next one.

    Densities are nearly linear in the reciprocal of the distance from the electrode.
    """
    strain, last = 1.0 - length / soft.thickness, soft.strains.shape[0] - 2
    k = 0
    while k < last and soft.strains[k + 1] < strain:
        k += 1
    rest = below * soft.eps
    low = 1.0 / (rest + (1.0 - soft.strains[k]) * soft.thickness)
    high = 1.0 / (rest + (1.0 - soft.strains[k + 1]) * soft.thickness)
    share = (1.0 / (rest + length) - low) / (high - low)
    return k, min(max(share, 0.0), 1.0)


@kernel
def compressed_length(bodies, chosen, count, gap, x, y, work):
    """Length of the field line through the cover at (x, y) [m], and the place of its body.

    The place is -1 where no body is pressed into the cover there.
    """
    soft, (point, room) = gap.soft, work
    length, at = soft.thickness, -1
    for k in range(count):
        bottom = soft.bottom + bodies[chosen[k]].sunk
        off, _ = _nearest(bodies[chosen[k]], x, y, bottom, point, room)
        if off < length:
            if off > 0.0:
                dx, dy = point[0] - x, point[1] - y
                off = _arc(off, math.sqrt(dx * dx + dy * dy), point[2] - bottom)
            if off < length:
                length, at = max(off, soft.thickness - soft.limit), k
    return length, at


@kernel
def _add_cell(bodies, chosen, count, node, green, c, work, matrix):
    """Add what one cell changes."""
    gap, (point, room, moved) = green.gap, work
    x, y, z = float(gap.points[c, 0]), float(gap.points[c, 1]), gap.top
    place = off_face(x, y, z, gap.curvature)
    best, lifted, body = math.inf, math.inf, -1
    for k in range(count):
        off, faces = _nearest(bodies[chosen[k]], place[0], place[1], place[2], point, room)
        _turn_onto_face(point, gap.curvature)
        true, high = lengths(off, faces, point, x, y, green, moved)
        sunk = bodies[chosen[k]].sunk
        if sunk > 0.0:  # it stands lower than where it is solved for
            off, faces = _nearest(bodies[chosen[k]], x, y, z + sunk, point, room)
            point[2] -= sunk
            true, _ = lengths(off, faces, point, x, y, green, moved)
        if true < best:
            best, lifted, body = true, max(true, high), chosen[k]
    if body < 0:
        return
    scale = gap.validity + bodies[body].sunk
    weight = 1.0 - smooth((best / scale - REACH[0]) / (REACH[1] - REACH[0]))
    if lifted <= best or weight <= 0.0:
        return
    i, n, depth = gap.terminal[c], gap.change.shape[2] - 1, float(gap.series[c])
    weight *= float(gap.areas[c]) / (4.0 * math.pi)
    k, p = _place(best, gap)
    m, q = _place(lifted, gap)
    a, b = weight / (best + depth), weight / (lifted + depth)
    for col in range(n + 1):
        one = a * ((1.0 - p) * float(gap.change[c, k, col]) + p * float(gap.change[c, k + 1, col]))
        two = b * ((1.0 - q) * float(gap.change[c, m, col]) + q * float(gap.change[c, m + 1, col]))
        _add_to(matrix, gap, i, col, node[body], one - two)


@kernel
def _turn_onto_face(point, curvature):
    """Nearest point and faces, as of :func:`nearest`, in coordinates of the face."""
    if curvature == 0.0:
        return
    x, y, z = on_face(point[0], point[1], point[2], curvature)
    c, s = math.cos(curvature * x), math.sin(curvature * x)
    point[0], point[1], point[2] = x, y, z
    for k in (3, 6):
        u, w = point[k], point[k + 2]
        point[k], point[k + 2] = c * u - s * w, s * u + c * w


@compiled
def fabric_change(bodies, green, matrix):
    """Add what compression below a conducting fabric on the cover changes [m], 4π eps0 = 1.

    The fabric follows the bodies that are pressed into it, of whatever matter. Where it has a
    bending length, compression falls off beside them over that. As a part of its area moves, the
    matrix changes by the integral of eps E_i E_j over the volume that it sweeps (Hadamard's
    formula), E_i the field at it with terminal i at 1 V.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        green: Green's function of the design.
        matrix: Added to, shape (t, t).
    """
    gap, soft = green.gap, green.gap.soft
    if soft.top == BODY:
        return
    chosen, count = np.empty(bodies.shape[0], np.int64), np.int64(0)
    for b in range(bodies.shape[0]):
        if bodies[b].outline != 0:
            middle = middle_height(bodies[b])
            if middle >= gap.top and middle - reach_down(bodies[b]) < gap.top:
                chosen[count] = b
                count += 1
    if count == 0:
        return
    cells = soft.sheet_areas.shape[0]
    depth, point, room = np.zeros(cells), np.empty(9), np.empty(140)
    for c in range(cells):
        x, y = float(soft.sheet_points[c, 0]), float(soft.sheet_points[c, 1])
        length, at = compressed_length(bodies, chosen, count, gap, x, y, (point, room))
        if at >= 0:
            depth[c] = soft.thickness - length
    if soft.spread > 0.0:
        pressed = depth.copy()
        _spread(pressed, soft, depth)
    for c in range(cells):
        if depth[c] <= 0.0:
            continue
        weight = float(soft.sheet_areas[c]) / (4.0 * math.pi * soft.eps * soft.thickness)
        for a in range(soft.sheet_terminals.shape[1]):
            i = soft.sheet_terminals[c, a]
            for b in range(a + 1):
                j = soft.sheet_terminals[c, b]
                if i >= 0 and j >= 0:
                    value = weight * _swept(soft, c, a, b, depth[c] / soft.thickness)
                    matrix[i, j] += value
                    if i != j:
                        matrix[j, i] += value


@kernel
def _swept(soft, c, a, b, strain):
    """Integral of two densities' product over strain at a cell of the fabric [V²].

    Products times the square of the rest of the thickness are nearly constant.
    """
    out, density = 0.0, soft.sheet_density
    for k in range(soft.strains.shape[0] - 1):
        start, end = soft.strains[k], soft.strains[k + 1]
        stop = min(end, strain)
        if stop <= start:
            break
        one = float(density[c, k, a]) * float(density[c, k, b]) * (1.0 - start) ** 2
        two = float(density[c, k + 1, a]) * float(density[c, k + 1, b]) * (1.0 - end) ** 2
        share = (stop - start) / (end - start)
        mean = one + 0.5 * share * (two - one)
        out += mean * (1.0 / (1.0 - stop) - 1.0 / (1.0 - start))
    return out


@kernel
def _spread(depth, soft, out):
    """Compression of the cells as a fabric carries it on: the largest of exp(-r / l) times each."""
    for c in range(depth.shape[0]):
        if depth[c] <= 0.0:
            continue
        for q in range(depth.shape[0]):
            x = float(soft.sheet_points[q, 0] - soft.sheet_points[c, 0])
            y = float(soft.sheet_points[q, 1] - soft.sheet_points[c, 1])
            far = math.sqrt(x * x + y * y) / soft.spread
            if far < 10.0:
                out[q] = max(out[q], depth[c] * math.exp(-far))


@kernel
def _place(length, gap):
    """Place of a length among the heights of the table, and the share of the next one."""
    last = gap.heights.shape[0] - 2
    x = math.log(length / gap.heights[0]) / gap.log_ratio
    k = min(max(int(math.floor(x)), 0), last)
    return k, min(max(x - k, 0.0), 1.0)


@kernel
def lengths(off, faces, point, x, y, green, moved):
    """Lengths of the field lines from (x, y) on the face to a body, and to the lifted body [m].

    Args:
        off: Distance of the body from there [m], negative inside.
        faces, point: Its nearest point and the faces there, as of :func:`nearest`, but in
            coordinates of the face.
        x, y: The place [m].
        green: Green's function of the design.
        moved: Room to work in, shape (1, 3).
    """
    gap = green.gap
    h0, least = gap.validity, gap.least
    if off <= 0.0:
        return least, h0
    dx, dy, dz = point[0] - x, point[1] - y, point[2] - gap.top
    across, beside = math.sqrt(dx * dx + dy * dy), 0.0
    if across < -dz < 2.0 * gap.soft.limit:  # of a surface without an inside, in the cover
        return least, h0
    true = _arc(math.sqrt(across * across + dz * dz), across, dz)
    for i in range(2):
        out = max(gap.face[0, i] - point[i], point[i] - gap.face[1, i], 0.0)
        beside += out * out
    height = max(dz, 0.0)
    if beside + height * height >= 4.0 * h0 * h0:
        return true, true
    moved[0, 0], moved[0, 1], moved[0, 2] = point[0], point[1], max(point[2], gap.top)
    lift(moved, h0, gap.face)
    ex, ey, ez = moved[0, 0] - x, moved[0, 1] - y, moved[0, 2] - gap.top
    wide = math.sqrt(ex * ex + ey * ey)
    far = math.sqrt(wide * wide + ez * ez)
    lifted = _arc(far, wide, ez)
    if faces > 0:  # another point of the lifted surface, which is flatter, may be nearer
        ratio = height / (2.0 * h0)
        along, up = _support(point, faces, ratio, -ex, -ey, -ez, far)
        if along < far:
            lower = _arc(along, along * math.sqrt(max(0.0, 1.0 - up * up)), along * up)
            share = smooth(1.0 - math.sqrt(beside) / h0)
            lifted += share * (min(lower, lifted) - lifted)
    true = held_off(true, least)
    return true, max(lifted, true)


@kernel
def _support(point, faces, ratio, x, y, z, far):
    """Distance from a place to one or two lifted faces through a point.

    Args:
        point, faces: As of :func:`nearest`.
        ratio: Slope of the lift: faces are flatter by it.
        x, y, z: The place less the lifted point [m], ``far`` in length.

    Returns:
        The distance [m], and how far its direction points down, 0 to 1.
    """
    a, b, c = ratio * point[3], ratio * point[4], min(point[5], 0.0)
    size = math.sqrt(a * a + b * b + c * c)
    if size < 1e-9:
        return far, 1.0
    a, b, c = a / size, b / size, c / size
    first = a * x + b * y + c * z
    if faces == 1:
        return max(first, 0.0), -c
    d, e, f = ratio * point[6], ratio * point[7], min(point[8], 0.0)
    size = math.sqrt(d * d + e * e + f * f)
    if size < 1e-9:
        return far, 1.0
    d, e, f = d / size, e / size, f / size
    second, both = d * x + e * y + f * z, a * d + b * e + c * f
    if first < second * both:
        return max(second, 0.0), -f
    if second < first * both:
        return max(first, 0.0), -c
    return far, 1.0


@kernel
def _arc(distance, across, up):
    """Length of an arc that leaves the face at a right angle, over a distance."""
    angle = min(math.atan2(across, up), 2.5)
    return distance * (angle / math.sin(angle) if angle > 1e-4 else 1.0)


@kernel
def extent_of_body(body):
    """Extent of a body's charge [m]."""
    return body.scale * doubles(body.extent)[0]


@kernel
def move(out, body, way, change):
    """Place a record as a body that is moved along x, y or z [m], or turned about one of them.

    ``way`` is 0 to 2 for the one, 3 to 5 for the other [rad].
    """
    c, s = math.cos(change), math.sin(change)
    i, j, axis = (way + 1) % 3, (way + 2) % 3, way % 3
    for k in range(3):
        out.position[k] = body.position[k]
        for q in range(3):
            out.rotation[k, q] = body.rotation[k, q]
    if way < 3:
        out.position[way] += change
        return
    for k in range(3):
        out.rotation[i, k] = c * body.rotation[i, k] - s * body.rotation[j, k]
        out.rotation[j, k] = s * body.rotation[i, k] + c * body.rotation[j, k]
        out.rotation[axis, k] = body.rotation[axis, k]
