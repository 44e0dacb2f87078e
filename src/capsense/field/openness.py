"""Which points around a design bodies can reach, judged by the view they have."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense._thread_pool import filled
from capsense.design.model import Design

Array = NDArray[np.float64]

_RAYS = 48
_FLOOR_REACH = 0.05
"""A floor nearer than this along a ray [m] counts as closed in proportion."""


def openness(design: Design, points: Array) -> Array:
    """Share of the directions in which a point has a free view, shape (n, 3) -> (n,).

    A ray that meets a conductor has none, one that reaches a side wall or the ceiling has a free
    view, and one that meets the floor after a distance d counts min(1, d / 50 mm). In front of a
    sheet it is more than one half; behind a sheet that lies a few millimetres above the floor
    below 0.2; inside a closed housing 0. Layers are transparent.
    """
    triangles = np.concatenate([body.surface.triangles for body in design.sheets])
    k = np.arange(_RAYS) + 0.5
    z, turn = 1 - 2 * k / _RAYS, k * math.pi * (3 - math.sqrt(5))
    side = np.sqrt(1 - z * z)
    rays = np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)
    floor = design.domain.floor
    out = np.empty(len(points))
    return filled(_fill_views, out, np.ascontiguousarray(points), rays, triangles, floor)


def free_path(design: Design, points: Array, rays: Array) -> Array:
    """Distance to the first conductor along unit rays [m], (n, 3), (n, 3) -> (n,); may be inf."""
    triangles = np.concatenate([body.surface.triangles for body in design.sheets])
    out = np.empty(len(points))
    return filled(
        _fill_paths, out, np.ascontiguousarray(points), np.ascontiguousarray(rays), triangles
    )


@kernel
def _fill_views(
    start: int, stop: int, points: Array, rays: Array, triangles: Array, floor: float, out: Array
) -> None:
    for i in range(start, stop):
        total = 0.0
        for r in range(len(rays)):
            if _path(points[i], rays[r], triangles, False) == math.inf:
                view = 1.0
                if rays[r, 2] < 0.0:
                    view = min(1.0, (floor - points[i, 2]) / rays[r, 2] / _FLOOR_REACH)
                total += max(view, 0.0)
        out[i] = total / len(rays)


@kernel
def _fill_paths(
    start: int, stop: int, points: Array, rays: Array, triangles: Array, out: Array
) -> None:
    for i in range(start, stop):
        out[i] = _path(points[i], rays[i], triangles, True)


@kernel
def _path(point: Array, ray: Array, triangles: Array, nearest: bool) -> float:
    """Distance to the nearest, or just any, triangle that a ray meets (Möller, Trumbore 1997)."""
    found = math.inf
    for t in range(len(triangles)):
        a0, a1, a2 = triangles[t, 0, 0], triangles[t, 0, 1], triangles[t, 0, 2]
        ux, uy, uz = triangles[t, 1, 0] - a0, triangles[t, 1, 1] - a1, triangles[t, 1, 2] - a2
        vx, vy, vz = triangles[t, 2, 0] - a0, triangles[t, 2, 1] - a1, triangles[t, 2, 2] - a2
        px, py, pz = ray[1] * vz - ray[2] * vy, ray[2] * vx - ray[0] * vz, ray[0] * vy - ray[1] * vx
        det = ux * px + uy * py + uz * pz
        if det == 0.0:
            continue
        sx, sy, sz = point[0] - a0, point[1] - a1, point[2] - a2
        b = (sx * px + sy * py + sz * pz) / det
        if b < 0.0 or b > 1.0:
            continue
        qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
        c = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / det
        if c >= 0.0 and b + c <= 1.0:
            distance = (vx * qx + vy * qy + vz * qz) / det
            if 1e-6 < distance < found:
                found = distance
                if not nearest:
                    break
    return found
