"""Outlines of bodies as the kernels take them: distances to a shape of size one, in its own frame.

Primitives have closed forms; meshes are searched by their tree of boxes.
"""

from __future__ import annotations

import math

import numpy as np

from capsense._jit import kernel
from capsense._simd import doubles
from capsense.scene.geometry_kernels import Boxes
from capsense.scene.mesh_shape import TriangleShape
from capsense.scene.shapes import Shape, ShapeKind

BOX, SPHERE, CAPSULE, CYLINDER, ELLIPSOID, MESH = (1 + int(kind) for kind in ShapeKind if kind < 6)
"""Codes of ``BODY["outline"]``; 0 where a body has none."""
CHANGING = 1 + MESH
"""That of the near triangles of a surface that changes: such as a mesh, but never pressed out."""
_STEPS = 30
"""Newton steps towards the nearest point of an ellipsoid, at most."""


def write_outline(record: np.void, shape: Shape) -> None:
    """Enter the outline of a shape in a record of ``BODY`` that stands for it at its size.

    Arrays of the shape are pointed to, so that it has to be kept.
    """
    if isinstance(shape, TriangleShape):
        write_triangles(record, shape._boxes, MESH, shape.closed)
    elif int(shape.kind) < MESH - 1:
        record["outline"], record["closed"] = 1 + int(shape.kind), True
        record["sizes"] = shape.params


def write_triangles(record: np.void, boxes: Boxes, code: int, closed: bool) -> None:
    """Enter triangles as the outline of a body, with a code of its own; they have to be kept."""
    record["outline"], record["closed"] = code, closed
    record["triangles"] = boxes.triangles.ctypes.data
    record["boxes"] = boxes.corners.ctypes.data
    record["triangle_count"], record["levels"] = len(boxes.triangles), boxes.levels


@kernel
def reach_down(body):
    """How far the outline of a body reaches below its middle [m]; for meshes, its bounding box."""
    return reach_along(body, 0.0, 1.0)


@kernel
def reach_along(body, u, w):
    """How far an outline reaches from its middle along (u, 0, w) [m]; that of meshes, their box."""
    r, kind = body.rotation, body.outline
    x = abs(u * r[0, 0] + w * r[2, 0])
    y = abs(u * r[0, 1] + w * r[2, 1])
    z = abs(u * r[0, 2] + w * r[2, 2])
    a, b, c = body.sizes[0], body.sizes[1], body.sizes[2]
    if kind == SPHERE:
        return body.scale * a
    if kind == CAPSULE:
        return body.scale * (a + b * z)
    if kind == CYLINDER:
        return body.scale * (b * z + a * math.sqrt(max(0.0, 1.0 - z * z)))
    if kind == ELLIPSOID:
        return body.scale * math.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2)
    if kind == BOX:
        return body.scale * (a * x + b * y + c * z)
    corners = doubles(body.boxes)
    return (
        0.5
        * body.scale
        * (
            x * (corners[3] - corners[0])
            + y * (corners[4] - corners[1])
            + z * (corners[5] - corners[2])
        )
    )


@kernel
def middle_height(body):
    """Height of the middle of a body's outline [m]; for meshes, that of its bounding box."""
    return middle_along(body, 2)


@kernel
def middle_along(body, i):
    """The middle of a body's outline along axis i [m]; for meshes, that of its bounding box."""
    if body.outline < MESH:
        return body.position[i]
    corners, r = doubles(body.boxes), body.rotation
    return body.position[i] + 0.5 * body.scale * (
        r[i, 0] * (corners[0] + corners[3]) + r[i, 1] * (corners[1] + corners[4])
        + r[i, 2] * (corners[2] + corners[5])
    )  # fmt: skip


@kernel
def nearest(body, x, y, z, out, room):
    """Nearest point of a body's outline to a point of the sensor frame [m].

    Args:
        body: A record with an outline.
        x, y, z: The point [m].
        out: Filled with the nearest point [m] and up to two normals of faces that meet there,
            outwards, shape (9,).
        room: Workspace, shape (140,).

    Returns:
        The distance [m], negative inside; and how many normals there are: one on a face, two at an
        edge, none at corners. At edges and corners of a mesh it is one too, the way to the point:
        it turns evenly while the point passes from triangle to triangle.
    """
    dx, dy, dz = x - body.position[0], y - body.position[1], z - body.position[2]
    r, inverse = body.rotation, 1.0 / body.scale
    px = inverse * (r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz)
    py = inverse * (r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz)
    pz = inverse * (r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz)
    kind, a, b, c = body.outline, body.sizes[0], body.sizes[1], body.sizes[2]
    faces = 1
    ux = uy = uz = vx = vy = vz = 0.0  # normals of the faces in the body's own frame
    if kind in (SPHERE, CAPSULE):
        along = min(max(pz, -b), b) if kind == CAPSULE else 0.0
        off = math.sqrt(px * px + py * py + (pz - along) ** 2)
        distance, ratio = off - a, a / max(off, 1e-12)
        qx, qy, qz = ratio * px, ratio * py, along + ratio * (pz - along)
    elif kind == BOX:
        qx, qy, qz = min(max(px, -a), a), min(max(py, -b), b), min(max(pz, -c), c)
        distance = math.sqrt((px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2)
        if distance == 0.0:
            distance = max(abs(px) - a, max(abs(py) - b, abs(pz) - c))
            if distance == abs(px) - a:
                qx = math.copysign(a, px)
            elif distance == abs(py) - b:
                qy = math.copysign(b, py)
            else:
                qz = math.copysign(c, pz)
        faces = 0
        if qx != px:
            faces, ux = 1, math.copysign(1.0, px)
        if qy != py:
            if faces == 1:
                vy = math.copysign(1.0, py)
            else:
                uy = math.copysign(1.0, py)
            faces += 1
        if qz != pz:
            if faces == 1:
                vz = math.copysign(1.0, pz)
            else:
                uz = math.copysign(1.0, pz)
            faces += 1
    elif kind == CYLINDER:
        off = math.sqrt(px * px + py * py)
        ratio, qz = min(off, a) / max(off, 1e-12), min(max(pz, -b), b)
        qx, qy = ratio * px, ratio * py
        distance = math.sqrt(max(off - a, 0.0) ** 2 + (pz - qz) ** 2)
        if distance == 0.0:
            distance = max(off - a, abs(pz) - b)
            if distance == off - a:
                ratio = a / max(off, 1e-12)
                qx, qy = ratio * px, ratio * py
            else:
                qz = math.copysign(b, pz)
        faces = 0
        if qz != pz:
            faces, uz = 1, math.copysign(1.0, pz)
        if off > a:
            if faces == 1:
                vx, vy = px / off, py / off
            else:
                ux, uy = px / off, py / off
            faces += 1
    elif kind == ELLIPSOID:
        t = _ellipsoid(px, py, pz, a, b, c)
        qx, qy, qz = px / (1.0 + t / (a * a)), py / (1.0 + t / (b * b)), pz / (1.0 + t / (c * c))
        distance = math.sqrt((px - qx) ** 2 + (py - qy) ** 2 + (pz - qz) ** 2)
        distance = math.copysign(distance, t)
    else:
        distance = _on_mesh(body, px, py, pz, out, room)
        qx, qy, qz = out[0], out[1], out[2]
    if kind not in (BOX, CYLINDER) and faces == 1:
        size = math.copysign(max(abs(distance), 1e-12), distance)
        ux, uy, uz = (px - qx) / size, (py - qy) / size, (pz - qz) / size
    if faces > 2:
        faces = 0
    for i in range(3):
        out[i] = body.position[i] + body.scale * (r[i, 0] * qx + r[i, 1] * qy + r[i, 2] * qz)
        out[3 + i] = r[i, 0] * ux + r[i, 1] * uy + r[i, 2] * uz
        out[6 + i] = r[i, 0] * vx + r[i, 1] * vy + r[i, 2] * vz
    return body.scale * distance, faces


@kernel
def _ellipsoid(x, y, z, a, b, c):
    """The t for which (p_i / (1 + t / r_i²)) lies on an ellipsoid of radii r: by Newton's method.

    From where the sum is at least one it is convex and falls, so that steps never pass the root.
    """
    least = min(a, min(b, c))
    p, q, r = a * a, b * b, c * c
    # the largest of these lower bounds of the root, each from one term alone
    t = max(a * abs(x) - p, max(b * abs(y) - q, c * abs(z) - r))
    t = max(t, -least * least * (1.0 - 1e-6))
    for _ in range(_STEPS):
        u, v, w = a * x / (p + t), b * y / (q + t), c * z / (r + t)
        value = u * u + v * v + w * w - 1.0
        slope = -2.0 * (u * u / (p + t) + v * v / (q + t) + w * w / (r + t))
        if slope == 0.0 or abs(value) < 1e-13:
            break
        t -= value / slope
        t = max(t, -least * least * (1.0 - 1e-6))
    return t


@kernel
def _nearest_on_triangle(t, o, x, y, z):
    """Nearest point on the triangle whose corners begin at place ``o`` of an array.

    After C. Ericson, *Real-Time Collision Detection* (2005), section 5.1.5.

    Returns:
        The squared distance and the point.
    """
    ax, ay, az = t[o], t[o + 1], t[o + 2]
    ux, uy, uz = t[o + 3] - ax, t[o + 4] - ay, t[o + 5] - az
    vx, vy, vz = t[o + 6] - ax, t[o + 7] - ay, t[o + 8] - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    uu, uv, vv = (
        ux * ux + uy * uy + uz * uz,
        ux * vx + uy * vy + uz * vz,
        vx * vx + vy * vy + vz * vz,
    )
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    s, w = 0.0, 0.0
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        s = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s = d1 / max(d1 - d3, 1e-300)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / max(d2 - d6, 1e-300)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300)
        s = 1.0 - w
    else:
        whole = va + vb + vc
        s, w = vb / whole, vc / whole
    qx, qy, qz = ax + s * ux + w * vx, ay + s * uy + w * vy, az + s * uz + w * vz
    return (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2, qx, qy, qz


@kernel
def _on_mesh(body, x, y, z, out, room):
    """Nearest point on the triangles of a mesh, in its own frame, filled in ``out``.

    Returns:
        The distance, negative inside of a closed mesh.
    """
    triangles, corners = doubles(body.triangles), doubles(body.boxes)
    count, leaves = body.triangle_count, np.int64(1) << (body.levels - 1)
    best, top = math.inf, 1
    room[0], room[1] = 0.0, 0.0
    while top > 0:
        top -= 1
        k = int(room[2 * top])
        if room[2 * top + 1] >= best:
            continue
        if k >= leaves - 1:
            q = k - leaves + 1
            first = (q * count) >> (body.levels - 1)
            last = ((q + 1) * count) >> (body.levels - 1)
            for m in range(first, last):
                found = _nearest_on_triangle(triangles, 9 * m, x, y, z)
                if found[0] < best:
                    best, out[0], out[1], out[2] = found
            continue
        near, far = 2 * k + 1, 2 * k + 2
        to_near = _box2(corners, 6 * near, x, y, z)
        to_far = _box2(corners, 6 * far, x, y, z)
        if to_far < to_near:
            near, far, to_near, to_far = far, near, to_far, to_near
        room[2 * top], room[2 * top + 1] = far, to_far
        room[2 * top + 2], room[2 * top + 3] = near, to_near
        top += 2
    distance = math.sqrt(best)
    if body.closed and _inside(triangles, corners, count, body.levels, x, y, z, room):
        distance = -distance
    return distance


@kernel
def _box2(corners, o, x, y, z):
    """Squared distance to the box whose corners begin at a place of an array."""
    dx = max(0.0, max(corners[o] - x, x - corners[o + 3]))
    dy = max(0.0, max(corners[o + 1] - y, y - corners[o + 4]))
    dz = max(0.0, max(corners[o + 2] - z, z - corners[o + 5]))
    return dx * dx + dy * dy + dz * dz


@kernel
def _inside(triangles, corners, count, levels, x, y, z, room):
    """Whether a closed mesh winds around a point, by its crossings of a ray along z."""
    total, top, leaves = 0, 1, np.int64(1) << (levels - 1)
    room[0] = 0.0
    while top > 0:
        top -= 1
        k = int(room[top])
        o = 6 * k
        if (
            z > corners[o + 5] or x < corners[o] or x > corners[o + 3]
            or y < corners[o + 1] or y > corners[o + 4]
        ):  # fmt: skip
            continue
        if k < leaves - 1:
            room[top], room[top + 1] = 2 * k + 1, 2 * k + 2
            top += 2
            continue
        q = k - leaves + 1
        for m in range((q * count) >> (levels - 1), ((q + 1) * count) >> (levels - 1)):
            total += _crossing(triangles, 9 * m, x, y, z)
    return total != 0


@kernel
def _crossing(t, o, x, y, z):
    """How a ray upwards from a point crosses a triangle: 1, -1 from behind, else 0."""
    around = 0
    for e in range(3):
        f = (e + 1) % 3
        upward = t[o + 3 * e + 1] <= y
        if upward == (t[o + 3 * f + 1] <= y):
            continue
        a, b = (e, f) if upward else (f, e)
        s = (y - t[o + 3 * a + 1]) / (t[o + 3 * b + 1] - t[o + 3 * a + 1])
        if t[o + 3 * a] + s * (t[o + 3 * b] - t[o + 3 * a]) > x:
            around += 1 if upward else -1
    if around == 0:
        return 0
    ux, uy, uz = t[o + 3] - t[o], t[o + 4] - t[o + 1], t[o + 5] - t[o + 2]
    vx, vy, vz = t[o + 6] - t[o], t[o + 7] - t[o + 1], t[o + 8] - t[o + 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    height = t[o + 2]
    if nz != 0.0:
        height -= (nx * (x - t[o]) + ny * (y - t[o + 1])) / nz
    low = min(t[o + 2], min(t[o + 5], t[o + 8]))
    height = min(max(height, low), max(t[o + 2], max(t[o + 5], t[o + 8])))
    return around if height > z else 0
