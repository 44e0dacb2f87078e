"""The step, compiled: gaps between conductors of different potentials; 4π eps0 = 1.

Charge functions do not resolve a gap much narrower than their clusters. Two bodies are therefore
held apart where they meet each other: points of either that are a distance d < 2 L from the other
are moved away from it, until it is L + d² / (4 L). What that removes is local: it is a capacitance
between the two,

  c = ∫ [1 / l - 1 / l_h] dA / 4π,

with l the length of the field line from a point of the one to the other, and l_h the same where
they are held apart. In a network of terminals and conductors, c is one more capacitor. L is a part
of the smaller body's size, so that it does not change with pose; where the two are nearer than that
their clusters are split until they are small enough for L.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._simd import doubles, integers
from capsense.field.face_kernels import held_off, smooth
from capsense.solver.bodies.outline import (
    BOX,
    CAPSULE,
    CHANGING,
    CYLINDER,
    ELLIPSOID,
    MESH,
    SPHERE,
    nearest,
)

SHARE = 0.1
"""Length by which bodies are held apart, over the second-largest extent of the smaller one."""
PANEL = 0.4
"""Least of these lengths, over the larger panels of the two."""
CLUSTER = 4.0, 6.0
"""Extents of clusters, over that length, at which they come to be split, and are."""
REACH = 2.5, 3.0
"""Distances between bodies, over that length, from which on none comes to be split, and none is."""
LEAST = 0.0025
"""Least length of a field line, over that length: bodies do not come nearer than that."""
TOLERANCE = 0.03
"""What a finer quadrature changes relative to which patches come to be divided."""
FLOOR = 0.05
"""What counts as much as nothing beside this, over 1 / L."""
DEPTH = 12
"""So many times patches are divided at most."""
_ROOM = 128
"""Patches that wait to be looked at."""
_SAMPLES = 64
"""Clusters of which the size of panels is taken."""


class Facing(NamedTuple):
    """Conductors of different potentials that are near each other, p pairs of them."""

    pairs: int
    """How many."""
    first: NDArray[Any]
    """Their bodies, shapes (p,)."""
    second: NDArray[Any]
    length: NDArray[Any]
    """Length L by which they are held apart [m], shape (p,)."""
    weight: NDArray[Any]
    """How far their clusters may be split for that, 0 to 1, shape (p,)."""
    point: NDArray[Any]
    room: NDArray[Any]
    """Room that :func:`nearest` takes."""


@compiled
def facing_of(bodies):
    """Find conductors of different potentials that are near each other, by bounding boxes."""
    count, free = bodies.shape[0], False
    for b in range(count):
        free = free or _is_free(bodies[b])
    most = (count * (count - 1)) // 2 if free else 0
    first, second = np.empty(most, np.int64), np.empty(most, np.int64)
    length, weight = np.empty(most), np.empty(most)
    point, room, p = np.empty(9), np.empty(140), 0
    for b in range(count if free else 0):
        for a in range(b):
            one, two = bodies[a], bodies[b]
            if one.group == two.group or not (_is_free(one) or _is_free(two)):
                continue
            if not (_conducts(one) and _conducts(two)):
                continue
            size = SHARE * min(_second_extent(one), _second_extent(two))
            # panels are looked at if they may matter
            apart = _boxes_apart(one, two)
            panels = 0.0
            if apart < REACH[1] * max(size, PANEL * max(_extent(one), _extent(two))):
                panels = PANEL * max(_panel_size(one), _panel_size(two))
            size = max(size, panels)
            if apart >= REACH[1] * size:
                continue
            apart = max(apart, _beyond(one, two, point, room), _beyond(two, one, point, room))
            if apart >= REACH[1] * size:
                continue
            first[p], second[p], length[p] = a, b, size
            weight[p] = smooth((REACH[1] - apart / size) / (REACH[1] - REACH[0]))
            p += 1
    return Facing(p, first[:p], second[:p], length[:p], weight[:p], point, room)


@compiled
def mark(facing, near):
    """Mark bodies that face another one, shape (b,)."""
    for p in range(facing.pairs):
        near[facing.first[p]] = near[facing.second[p]] = True


@kernel
def _is_free(body):
    """Whether a conductor is not at ground."""
    return _conducts(body) and (body.neutral != 0 or body.ground_elastance > 0.0)


@kernel
def _conducts(body):
    """Whether it is a conductor with an outline; not a dielectric that is taken for one.

    Of a surface that changes, the outline is only what is near the design.
    """
    return (
        body.outline not in (0, CHANGING)
        and body.inverse_susceptibility == 0.0
        and body.polarization_stiffness == 0.0
    )


@kernel
def _half_sizes(body):
    """Half the extents of an outline along the axes of its own frame [m]."""
    s, a, b, c = body.scale, body.sizes[0], body.sizes[1], body.sizes[2]
    kind = body.outline
    if kind == SPHERE:
        return s * a, s * a, s * a
    if kind == CAPSULE:
        return s * a, s * a, s * (a + b)
    if kind == CYLINDER:
        return s * a, s * a, s * b
    if kind == MESH:
        corners = doubles(body.boxes)
        return (
            0.5 * s * (corners[3] - corners[0]), 0.5 * s * (corners[4] - corners[1]),
            0.5 * s * (corners[5] - corners[2]),
        )  # fmt: skip
    return s * a, s * b, s * c


@kernel
def _middle(body):
    """Middle of an outline in the sensor frame [m]."""
    x = y = z = 0.0
    if body.outline == MESH:
        corners, s = doubles(body.boxes), 0.5 * body.scale
        x, y, z = (
            s * (corners[0] + corners[3]), s * (corners[1] + corners[4]),
            s * (corners[2] + corners[5]),
        )  # fmt: skip
    r, p = body.rotation, body.position
    return (
        p[0] + r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        p[1] + r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        p[2] + r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@kernel
def _second_extent(body):
    """The second-largest extent of an outline [m]."""
    a, b, c = _half_sizes(body)
    return 2.0 * max(min(a, b), min(max(a, b), c))


@compiled
def slenderness(bodies, near, length):
    """How slender the most slender of the near bodies is, 0 to 1.

    0 where the second-largest extent is a length [m] or more, 1 where it is nothing beside that.
    """
    out = 0.0
    for b in range(bodies.shape[0]):
        if near[b] and bodies[b].outline != CHANGING:
            out = max(out, 1.0 - _second_extent(bodies[b]) / length)
    return out


@kernel
def _extent(body):
    """The largest extent of an outline [m]."""
    a, b, c = _half_sizes(body)
    return 2.0 * max(a, max(b, c))


@kernel
def _panel_size(body):
    """Mean extent of a body's panels, by area, from some of them [m]."""
    children, extent = integers(body.children), doubles(body.extent)
    total = area = 0.0
    count = 2 * body.n - 1
    stride = max(1, count // _SAMPLES)
    for k in range(count - 1, -1, -stride):
        if children[2 * k] < 0:
            e = extent[k]
            total += e * e * e
            area += e * e
    return body.scale * total / max(area, 1e-300)


@kernel
def _boxes_apart(one, two):
    """Distance between the bounding boxes of two bodies along the sensor frame's axes [m]."""
    a, b = _middle(one), _middle(two)
    s, t, square = _half_sizes(one), _half_sizes(two), 0.0
    for i in range(3):
        off = abs(a[i] - b[i])
        for k in range(3):
            off -= abs(one.rotation[i, k]) * s[k] + abs(two.rotation[i, k]) * t[k]
        square += max(off, 0.0) ** 2
    return math.sqrt(square)


@kernel
def _beyond(one, two, point, room):
    """Distance of a body from a ball around another one [m], or less."""
    x, y, z = _middle(two)
    a, b, c = _half_sizes(two)
    radius = math.sqrt(a * a + b * b + c * c)
    if two.outline == SPHERE:
        radius = a
    elif two.outline == CAPSULE:
        radius = c
    off, _ = nearest(one, x, y, z, point, room)
    return off - radius


@kernel
def crowded(bodies, facing, b, k):
    """How far cluster k of body b has to be split since it is near another conductor, 0 to 1."""
    out, body = 0.0, bodies[b]
    for p in range(facing.pairs):
        if facing.first[p] == b:
            other = facing.second[p]
        elif facing.second[p] == b:
            other = facing.first[p]
        else:
            continue
        length = facing.length[p]
        size = body.scale * doubles(body.extent)[k]
        share = smooth((size / length - CLUSTER[0]) / (CLUSTER[1] - CLUSTER[0]))
        if share <= out:
            continue
        center, r, s = doubles(body.center), body.rotation, body.scale
        x, y, z = center[3 * k], center[3 * k + 1], center[3 * k + 2]
        off, _ = nearest(
            bodies[other],
            body.position[0] + s * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z),
            body.position[1] + s * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z),
            body.position[2] + s * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z),
            facing.point, facing.room,
        )  # fmt: skip
        near = REACH[1] - (off - 0.6 * size) / length
        out = max(out, share * facing.weight[p] * smooth(near / (REACH[1] - REACH[0])))
    return out


@compiled
def hold_apart(bodies, facing, leaves, green):
    """Move points of leaves away from the bodies that these face.

    Of two points that face each other, the one that is moved away from the design is moved by more:
    a body does not come nearer to the design by that.

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        facing: The pairs of bodies.
        leaves: Clusters that are represented by themselves; their points are moved.
        green: Green's function of the design.
    """
    for p in range(facing.pairs):
        for side in range(2):
            b, other = facing.first[p], facing.second[p]
            if side == 1:
                b, other = other, b
            for k in range(leaves.owner.shape[0]):
                if leaves.owner[k] == b:
                    for q in range(4):
                        _move_apart(leaves.true[k, q], leaves.points[k, q], bodies[other],
                                    facing.length[p], green.box, facing)  # fmt: skip


@kernel
def _move_apart(true, out, other, length, box, facing):
    """Move a point away from another body [m].

    Args:
        true: Where it is, for the distance, shape (3,).
        out: What is moved, shape (3,).
        other: The body.
        length: See :class:`Facing`.
        box: Corners of the design, shape (2, 3).
        facing: Room to work in.
    """
    point = facing.point
    off, faces = nearest(other, true[0], true[1], true[2], point, facing.room)
    if off >= 2.0 * length:
        return
    by, away, square = held_off(max(off, 0.0), length) - off, 0.0, 0.0
    for i in range(3):
        if abs(off) > 1e-9:
            point[6 + i] = (true[i] - point[i]) / off
        else:
            point[6 + i] = point[3 + i] if faces > 0 else 0.0
        side = max(true[i] - box[1, i], 0.0) - max(box[0, i] - true[i], 0.0)
        away += point[6 + i] * side
        square += side * side
    share = 0.5 + 0.5 * away / math.sqrt(square + 1e-12)
    for i in range(3):
        out[i] += share * by * point[6 + i]


@compiled
def add_between(bodies, facing, node, matrix):
    """Add the local capacitances between bodies to the matrix of terminals and nodes [m].

    Args:
        bodies: Records of :data:`~capsense.solver.tree.rigid.BODY`, shape (b,).
        facing: The pairs.
        node: Row of each body that is a node, else -1, shape (b,).
        matrix: Added to, shape (t, t).
    """
    for p in range(facing.pairs):
        a, b = facing.first[p], facing.second[p]
        if _second_extent(bodies[b]) < _second_extent(bodies[a]):
            a, b = b, a
        c = local_capacitance(bodies[a], bodies[b], facing.length[p], facing.point, facing.room)
        i, j = node[a], node[b]
        if i >= 0:
            matrix[i, i] += c
        if j >= 0:
            matrix[j, j] += c
        if i >= 0 and j >= 0:
            matrix[i, j] -= c
            matrix[j, i] -= c


@compiled
def local_capacitance(body, other, length, point, room):
    """What holding two bodies apart removes from the capacitance between them [m].

    Args:
        body: The one whose surface is integrated over.
        other: The other one.
        length: See :class:`Facing` [m].
        point, room: Room that :func:`nearest` takes.
    """
    work = np.empty(6), point, room, np.empty((_ROOM, 6)), np.empty((_ROOM, 9))
    total = 0.0
    if body.outline == MESH:
        if body.triangle_count > 0:
            triangles = doubles(body.triangles)
            for k in range(body.triangle_count):
                total += _over_triangle(body, other, length, triangles, 9 * k, work)
    else:
        for face in range(_faces(body.outline)):
            total += _over_face(body, other, length, face, work)
    return total / (4.0 * math.pi)


@kernel
def _faces(kind):
    """Faces that the surface of a primitive is cut into."""
    if kind == CAPSULE:
        return 14
    return 12 if kind == CYLINDER else 6


@kernel
def _on_face(body, face, u, v, out):
    """Point and outward normal of a primitive at a place (u, v) of a face, from -1 to 1 each.

    They are filled in ``out`` (6,), in the sensor frame [m]. A ball is a cube's faces, pushed out.

    Returns:
        Area over that of (u, v) [m²].
    """
    kind, a, b, c = body.outline, body.sizes[0], body.sizes[1], body.sizes[2]
    x = y = z = nx = ny = nz = area = 0.0
    if kind == BOX:
        side = 1.0 if face % 2 == 0 else -1.0
        if face < 2:
            x, y, z, nx, area = side * a, u * b, v * c, side, b * c
        elif face < 4:
            x, y, z, ny, area = u * a, side * b, v * c, side, a * c
        else:
            x, y, z, nz, area = u * a, v * b, side * c, side, a * b
    elif kind == CYLINDER or (kind == CAPSULE and face >= 10):
        turn = 0.25 * math.pi * (u + 1.0 + 2.0 * (face % 4))
        nx, ny = math.cos(turn), math.sin(turn)
        x, y, z, area = a * nx, a * ny, b * v, 0.25 * math.pi * a * b
        if kind == CYLINDER and face >= 4:
            share = 0.5 * (v + 1.0)
            nz = 1.0 if face < 8 else -1.0
            x, y, z, area = share * x, share * y, nz * b, 0.125 * math.pi * a * a * share
            nx = ny = 0.0
    else:
        side = 1.0 if face % 2 == 0 else -1.0
        half = 1.0
        if face < 2:
            x, y, z = u, v, side
        elif kind == CAPSULE:  # lateral faces of a half ball
            half = 0.5
            v = 0.5 * (v + 1.0) * (1.0 if face < 6 else -1.0)
            if face % 4 < 2:
                x, y, z = side, u, v
            else:
                x, y, z = u, side, v
        elif face < 4:
            x, y, z = side, u, v
        else:
            x, y, z = u, side, v
        size = 1.0 / math.sqrt(x * x + y * y + z * z)
        area = half * size * size * size
        nx, ny, nz = size * x, size * y, size * z
        if kind == ELLIPSOID:
            x, y, z = a * nx, b * ny, c * nz
            nx, ny, nz = nx / a, ny / b, nz / c
            size = math.sqrt(nx * nx + ny * ny + nz * nz)
            area *= a * b * c * size
            nx, ny, nz = nx / size, ny / size, nz / size
        else:
            area *= a * a
            x, y, z = a * nx, a * ny, a * nz
            if kind == CAPSULE:
                z += b if (face == 0 or (2 <= face < 6)) else -b
    r, s = body.rotation, body.scale
    for i in range(3):
        out[i] = body.position[i] + s * (r[i, 0] * x + r[i, 1] * y + r[i, 2] * z)
        out[3 + i] = r[i, 0] * nx + r[i, 1] * ny + r[i, 2] * nz
    return s * s * area


@kernel
def _over_face(body, other, length, face, work):
    """Integrate the local change over a face of a primitive: by patches that are divided in four.

    How far their parts stand for a patch grows with what they change, so that the result is
    continuous.
    """
    place, point, room, stack, _ = work
    total, top = 0.0, 1
    stack[0, 0], stack[0, 1], stack[0, 2] = 0.0, 0.0, 1.0
    stack[0, 3], stack[0, 4], stack[0, 5] = 1.0, 0.0, 1.0  # half sides, depth, weight
    while top > 0:
        top -= 1
        u, v, hu = stack[top, 0], stack[top, 1], stack[top, 2]
        hv, depth, weight = stack[top, 3], stack[top, 4], stack[top, 5]
        _on_face(body, face, u - hu, v - hv, place)
        x, y, z = place[0], place[1], place[2]
        _on_face(body, face, u + hu, v + hv, place)
        radius = 0.55 * math.sqrt((place[0] - x) ** 2 + (place[1] - y) ** 2 + (place[2] - z) ** 2)
        # sides of a curved patch
        _on_face(body, face, u - hu, v, place)
        x, y, z = place[0], place[1], place[2]
        area = 4.0 * hu * hv * _on_face(body, face, u, v, place)
        wide = math.sqrt((place[0] - x) ** 2 + (place[1] - y) ** 2 + (place[2] - z) ** 2)
        x, y, z = place[0], place[1], place[2]
        _on_face(body, face, u, v - hv, place)
        high = math.sqrt((place[0] - x) ** 2 + (place[1] - y) ** 2 + (place[2] - z) ** 2)
        _on_face(body, face, u, v, place)
        radius = max(radius, 1.2 * math.sqrt(wide * wide + high * high))
        coarse, off = _change(other, length, place, point, room)
        if off - radius > 2.0 * length:
            continue
        two_u = wide > 0.5 * high or high <= 0.0
        two_v = high > 0.5 * wide
        share = 1.0
        if radius <= length:
            fine = 0.0
            for q in range(4):
                uu = u + (0.5 * hu if q % 2 else -0.5 * hu)
                vv = v + (0.5 * hv if q // 2 else -0.5 * hv)
                part = hu * hv * _on_face(body, face, uu, vv, place)
                fine += part * _change(other, length, place, point, room)[0]
            coarse *= area
            scale = abs(fine) + FLOOR * area / length
            share = smooth(abs(fine - coarse) / (TOLERANCE * scale) - 1.0)
            if depth >= DEPTH:
                share = 0.0
            total += weight * (1.0 - share) * fine
        if share <= 0.0:
            continue
        for q in range(4):
            if (q % 2 and not two_u) or (q // 2 and not two_v):
                continue
            stack[top, 0] = u + (0.5 * hu if q % 2 else -0.5 * hu) if two_u else u
            stack[top, 1] = v + (0.5 * hv if q // 2 else -0.5 * hv) if two_v else v
            stack[top, 2], stack[top, 3] = 0.5 * hu if two_u else hu, 0.5 * hv if two_v else hv
            stack[top, 4], stack[top, 5] = depth + 1.0, weight * share
            if radius > length:
                stack[top, 4] = depth
            top += 1
    return total


@kernel
def _over_triangle(body, other, length, triangles, start, work):
    """Integrate the local change over a triangle of a mesh, as :func:`_over_face`."""
    place, point, room, weights, stack = work
    r, s, total, top = body.rotation, body.scale, 0.0, 1
    for k in range(3):
        for i in range(3):
            value = body.position[i]
            for c in range(3):
                value += s * r[i, c] * triangles[start + 3 * k + c]
            stack[0, 3 * k + i] = value
    t = stack[0]
    ux, uy, uz = t[3] - t[0], t[4] - t[1], t[5] - t[2]
    vx, vy, vz = t[6] - t[0], t[7] - t[1], t[8] - t[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    whole = math.sqrt(nx * nx + ny * ny + nz * nz)
    if whole <= 0.0:
        return 0.0
    normal = (nx / whole, ny / whole, nz / whole)
    weights[0, 0], weights[0, 1], weights[0, 2] = 0.0, 1.0, 0.0
    while top > 0:
        top -= 1
        t = stack[top]
        a, b, c = (t[0], t[1], t[2]), (t[3], t[4], t[5]), (t[6], t[7], t[8])
        depth, weight, divided = weights[top, 0], weights[top, 1], weights[top, 2]
        area = 0.5 * whole * 0.25**divided
        mid = _third(a, b, c)
        radius = math.sqrt(max(_square(mid, a), max(_square(mid, b), _square(mid, c))))
        _put_place(place, mid, normal)
        coarse, off = _change(other, length, place, point, room)
        if off - radius > 2.0 * length:
            continue
        ab, bc, ca = _half(a, b), _half(b, c), _half(c, a)
        share = 1.0
        if radius <= length:
            fine = coarse
            for q in range(3):
                corner = _third(a, ab, ca) if q == 0 else (
                    _third(b, ab, bc) if q == 1 else _third(c, bc, ca))  # fmt: skip
                _put_place(place, corner, normal)
                fine += _change(other, length, place, point, room)[0]
            fine *= 0.25 * area
            coarse *= area
            scale = abs(fine) + FLOOR * area / length
            share = smooth(abs(fine - coarse) / (TOLERANCE * scale) - 1.0)
            if depth >= DEPTH:
                share = 0.0
            total += weight * (1.0 - share) * fine
        if share <= 0.0:
            continue
        deeper = depth + 1.0 if radius <= length else depth
        _put_triangle(stack[top], a, ab, ca)
        _put_triangle(stack[top + 1], ab, b, bc)
        _put_triangle(stack[top + 2], ca, bc, c)
        _put_triangle(stack[top + 3], ab, bc, ca)
        for q in range(4):
            weights[top + q, 0], weights[top + q, 1] = deeper, weight * share
            weights[top + q, 2] = divided + 1.0
        top += 4
    return total


@kernel
def _third(a, b, c):
    return (a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0


@kernel
def _half(a, b):
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])


@kernel
def _square(a, b):
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


@kernel
def _put_place(out, mid, normal):
    for i in range(3):
        out[i], out[3 + i] = mid[i], normal[i]


@kernel
def _put_triangle(out, a, b, c):
    for i in range(3):
        out[i], out[3 + i], out[6 + i] = a[i], b[i], c[i]


@kernel
def _change(other, length, place, point, room):
    """Change of 1/l by holding bodies apart at a point of a surface [1/m], and its distance [m].

    ``place`` (6,) is the point and its outward normal. Field lines that leave at an angle from the
    normal are arcs; none leaves backwards, through the body.
    """
    off, _ = nearest(other, place[0], place[1], place[2], point, room)
    if off >= 2.0 * length:
        return 0.0, off
    least, cosine = LEAST * length, 1.0
    if abs(off) > 1e-12:
        cosine = 0.0
        for i in range(3):
            cosine += place[3 + i] * (point[i] - place[i]) / off
    angle = math.acos(min(max(cosine, -1.0), 1.0))
    if off < 0.0:  # inside of the other body every face is in contact
        angle *= smooth(1.0 + off / (4.0 * least))
    factor = 1.0
    if angle > 1e-3:
        sine = math.sin(angle)
        if angle > 3.1:
            return 0.0, off
        factor = angle / sine
    true = max(off, 0.0)
    return (1.0 / held_off(true, least) - 1.0 / held_off(true, length)) / factor, off
