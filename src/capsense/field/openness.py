"""Which points around a design bodies can reach, judged by the view they have."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense._thread_pool import filled
from capsense.design.model import Design
from capsense.design.solid import first_hit, paths

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
    return paths(points, rays, triangles)


@kernel
def _fill_views(
    start: int, stop: int, points: Array, rays: Array, triangles: Array, floor: float, out: Array
) -> None:
    for i in range(start, stop):
        total = 0.0
        for r in range(len(rays)):
            if first_hit(points[i], rays[r], triangles, False) == math.inf:
                view = 1.0
                if rays[r, 2] < 0.0:
                    view = min(1.0, (floor - points[i, 2]) / rays[r, 2] / _FLOOR_REACH)
                total += max(view, 0.0)
        out[i] = total / len(rays)
