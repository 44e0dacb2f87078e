"""Outlines of bodies as the Warp kernels take them: nearest points of primitives and meshes.

The twin of these functions is :mod:`capsense.solver.bodies.outline`. Ways to the nearest point are
worked out, not the point itself: near contact a way is short, and has all digits of its precision.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.fleet.warp_mesh import LEVELS, Hit, Outlines, farthest_vertex, to_mesh
from capsense.scene.mesh_shape import TriangleShape
from capsense.solver.bodies import outline
from capsense.solver.tree.rigid import RigidShape

wp.set_module_options({"enable_backward": False})

_SPHERE, _CAPSULE, _BOX, _CYLINDER, _ELLIPSOID, _MESH = (
    wp.constant(code)
    for code in (
        outline.SPHERE, outline.CAPSULE, outline.BOX, outline.CYLINDER, outline.ELLIPSOID,
        outline.MESH,
    )
)  # fmt: skip
_STEPS = wp.constant(20)
"""Newton steps towards the nearest point of an ellipsoid, at most."""


def pack_outlines(
    shapes: Sequence[RigidShape], array: Callable[[NDArray[Any], Any], Any]
) -> Outlines:
    """Lay the outlines of shapes out one behind the other; ``array`` makes arrays of the device."""
    meshes = [getattr(shape, "_outline", None) for shape in shapes]
    trees = [m._boxes if isinstance(m, TriangleShape) else None for m in meshes]
    none = np.zeros((1, 3, 3)), np.zeros((1, 2, 3))  # one of each, as Warp's arrays are not empty
    triangles = np.concatenate([none[0], *(t.triangles for t in trees if t is not None)])
    corners = np.concatenate([none[1], *(t.corners for t in trees if t is not None)])
    counts = np.array([0 if t is None else len(t.triangles) for t in trees])
    boxes = np.array([0 if t is None else len(t.corners) for t in trees])
    levels = np.array([0 if t is None else t.levels for t in trees])
    records = [shape.record for shape in shapes]
    kinds = np.where(levels > LEVELS, 0, [int(r["outline"]) for r in records])
    out = Outlines()
    for name, values in (
        ("kind", kinds), ("closed", [int(r["closed"]) for r in records]), ("count", counts),
        ("levels", levels), ("first", 1 + np.cumsum(counts) - counts),
        ("box", 1 + np.cumsum(boxes) - boxes),
    ):  # fmt: skip
        setattr(out, name, array(np.asarray(values), wp.int32))
    out.sizes = array(np.array([r["sizes"] for r in records]), wp.vec3)
    out.triangles = array(triangles, wp.vec3)
    out.low, out.high = array(corners[:, 0], wp.vec3), array(corners[:, 1], wp.vec3)
    return out


@wp.func
def reach_down(outlines: Outlines, u: int, turn: wp.quat, scale: float):
    """How far an outline reaches below its middle [m]; for meshes, its bounding box."""
    kind = outlines.kind[u]
    s = outlines.sizes[u]
    z = wp.quat_rotate_inv(turn, wp.vec3(0.0, 0.0, 1.0))
    out = float(0.0)
    if kind == _SPHERE:
        out = s[0]
    elif kind == _CAPSULE:
        out = s[0] + s[1] * wp.abs(z[2])
    elif kind == _CYLINDER:
        out = s[1] * wp.abs(z[2]) + s[0] * wp.sqrt(wp.max(0.0, 1.0 - z[2] * z[2]))
    elif kind == _ELLIPSOID:
        out = wp.length(wp.cw_mul(s, z))
    elif kind == _BOX:
        out = s[0] * wp.abs(z[0]) + s[1] * wp.abs(z[1]) + s[2] * wp.abs(z[2])
    else:
        k = outlines.box[u]
        half = 0.5 * (outlines.high[k] - outlines.low[k])
        out = half[0] * wp.abs(z[0]) + half[1] * wp.abs(z[1]) + half[2] * wp.abs(z[2])
    return scale * out


@wp.func
def middle_height(outlines: Outlines, u: int, at: wp.transform, scale: float):
    """Height of the middle of an outline [m]; for meshes, that of its bounding box."""
    height = wp.transform_get_translation(at)[2]
    if outlines.kind[u] == _MESH:
        k = outlines.box[u]
        middle = 0.5 * scale * (outlines.low[k] + outlines.high[k])
        height += wp.quat_rotate(wp.transform_get_rotation(at), middle)[2]
    return height


@wp.func
def farthest_point(outlines: Outlines, u: int, at: wp.transform, scale: float, way: wp.vec3):
    """Point of an outline that is farthest along a direction [m]; on a level face, its middle."""
    turn = wp.transform_get_rotation(at)
    kind = outlines.kind[u]
    s = outlines.sizes[u]
    along = wp.quat_rotate_inv(turn, way)
    far = 1.0e3 * along
    p = wp.vec3()
    if kind == _SPHERE:
        p = s[0] * along
    elif kind == _CAPSULE:
        p = s[0] * along + wp.vec3(0.0, 0.0, wp.clamp(far[2], -s[1], s[1]))
    elif kind == _CYLINDER:
        beside = wp.sqrt(far[0] * far[0] + far[1] * far[1])
        p = wp.min(beside, s[0]) / wp.max(beside, 1e-12) * far
        p[2] = wp.clamp(far[2], -s[1], s[1])
    elif kind == _ELLIPSOID:
        p = wp.cw_mul(s, wp.normalize(wp.cw_mul(s, along)))
    elif kind == _BOX:
        for k in range(3):
            p[k] = wp.clamp(far[k], -s[k], s[k])
    else:
        p = farthest_vertex(outlines, u, along)
    return wp.transform_point(at, scale * p)


@wp.func
def nearest(outlines: Outlines, u: int, at: wp.transform, scale: float, x: wp.vec3):
    """Nearest point of an outline that is placed somewhere to a point of the sensor frame [m]."""
    turn = wp.transform_get_rotation(at)
    p = wp.quat_rotate_inv(turn, x - wp.transform_get_translation(at)) / scale
    kind = outlines.kind[u]
    s = outlines.sizes[u]
    hit = Hit()
    if kind == _BOX:
        hit = _to_box(p, s)
    elif kind == _CYLINDER:
        hit = _to_cylinder(p, s)
    else:
        hit.faces = 1
        if kind == _SPHERE or kind == _CAPSULE:  # noqa: SIM109 - Warp knows no membership
            axis = p
            if kind == _CAPSULE:
                axis[2] = p[2] - wp.clamp(p[2], -s[1], s[1])
            off = wp.length(axis)
            hit.off = off - s[0]
            hit.way = (s[0] / wp.max(off, 1e-12) - 1.0) * axis
        elif kind == _ELLIPSOID:
            hit = _to_ellipsoid(p, s)
        else:
            hit = to_mesh(outlines, u, p)
        if hit.faces == 1:
            size = wp.max(wp.abs(hit.off), 1e-12)
            hit.first = -hit.way / wp.where(hit.off < 0.0, -size, size)
    if hit.faces > 2:
        hit.faces = 0
    hit.off = scale * hit.off
    hit.way = wp.quat_rotate(turn, scale * hit.way)
    hit.first = wp.quat_rotate(turn, hit.first)
    hit.second = wp.quat_rotate(turn, hit.second)
    return hit


@wp.func
def _to_box(p: wp.vec3, s: wp.vec3):
    hit = Hit()
    way = wp.vec3()
    for k in range(3):
        way[k] = wp.clamp(p[k], -s[k], s[k]) - p[k]
    off = wp.length(way)
    if off == 0.0:
        dx = wp.abs(p[0]) - s[0]
        dy = wp.abs(p[1]) - s[1]
        dz = wp.abs(p[2]) - s[2]
        off = wp.max(dx, wp.max(dy, dz))
        if off == dx:
            way[0] = wp.where(p[0] < 0.0, dx, -dx)
        elif off == dy:
            way[1] = wp.where(p[1] < 0.0, dy, -dy)
        else:
            way[2] = wp.where(p[2] < 0.0, dz, -dz)
    faces = int(0)
    for k in range(3):
        if way[k] != 0.0:
            normal = wp.vec3()
            normal[k] = wp.where(p[k] < 0.0, -1.0, 1.0)
            if faces == 0:
                hit.first = normal
            else:
                hit.second = normal
            faces += 1
    hit.off = off
    hit.way = way
    hit.faces = faces
    return hit


@wp.func
def _to_cylinder(p: wp.vec3, s: wp.vec3):
    hit = Hit()
    off = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    out = wp.vec3(p[0], p[1], 0.0) / wp.max(off, 1e-12)
    beside = wp.max(off - s[0], 0.0)
    up = wp.clamp(p[2], -s[1], s[1]) - p[2]
    distance = wp.sqrt(beside * beside + up * up)
    way = wp.vec3(0.0, 0.0, up) - beside * out
    if distance == 0.0:
        distance = wp.max(off - s[0], wp.abs(p[2]) - s[1])
        if distance == off - s[0]:
            way = -distance * out
        else:
            up = wp.where(p[2] < 0.0, distance, -distance)
            way = wp.vec3(0.0, 0.0, up)
    faces = int(0)
    if up != 0.0:
        hit.first = wp.vec3(0.0, 0.0, wp.where(p[2] < 0.0, -1.0, 1.0))
        faces = 1
    if beside > 0.0:
        if faces == 0:
            hit.first = out
        else:
            hit.second = out
        faces += 1
    hit.off = distance
    hit.way = way
    hit.faces = faces
    return hit


@wp.func
def _to_ellipsoid(p: wp.vec3, s: wp.vec3):
    """By Newton's method, as ``outline._ellipsoid``."""
    hit = Hit()
    square = wp.cw_mul(s, s)
    low = wp.min(square[0], wp.min(square[1], square[2])) * (1.0e-6 - 1.0)
    t = wp.max(
        wp.max(s[0] * wp.abs(p[0]) - square[0], s[1] * wp.abs(p[1]) - square[1]),
        s[2] * wp.abs(p[2]) - square[2],
    )
    t = wp.max(t, low)
    going = int(1)
    for _ in range(_STEPS):
        if going == 1:
            value = float(-1.0)
            slope = float(0.0)
            for k in range(3):
                u = s[k] * p[k] / (square[k] + t)
                value += u * u
                slope -= 2.0 * u * u / (square[k] + t)
            if slope == 0.0:
                going = 0
            else:
                after = wp.max(t - value / slope, low)
                if after <= t and value < 1.0e-4:  # rounding alone is left
                    going = 0
                t = after
    way = wp.vec3()
    for k in range(3):
        way[k] = -t * p[k] / (square[k] + t)
    hit.way = way
    hit.off = wp.where(t < 0.0, -wp.length(way), wp.length(way))
    hit.faces = 1
    return hit
