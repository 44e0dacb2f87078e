"""Arcs and curves as chords, and outlines from loose edges; in any one unit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

XY = tuple[float, float]


def quarter_segments(radius: float, error: float) -> int:
    """Chords to a quarter circle that leave it by at most ``error``: 2 to 32."""
    if radius <= error:
        return 2
    return int(min(max(math.ceil(math.pi / 4 / math.acos(1.0 - error / radius)), 2), 32))


def arc_through(start: XY, mid: XY, end: XY, error: float) -> list[XY]:
    """Points of an arc through three points; both ends are among them."""
    (ax, ay), (bx, by), (cx, cy) = start, mid, end
    d = 2 * (ax * (by - cy) + bx * (cy - ay) + cx * (ay - by))
    reach = max(math.dist(start, mid), math.dist(mid, end))
    if abs(d) < 1e-9 * max(reach, 1e-300) ** 2:
        return [start, mid, end]
    a2, b2, c2 = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    x = (a2 * (by - cy) + b2 * (cy - ay) + c2 * (ay - by)) / d
    y = (a2 * (cx - bx) + b2 * (ax - cx) + c2 * (bx - ax)) / d
    radius = math.dist((x, y), start)
    first = math.atan2(ay - y, ax - x)
    turn = (math.atan2(cy - y, cx - x) - first) % (2 * math.pi)
    if (math.atan2(by - y, bx - x) - first) % (2 * math.pi) > turn:
        turn -= 2 * math.pi
    if start == end:
        turn = 2 * math.pi
    count = max(2, math.ceil(abs(turn) / (math.pi / 2) * quarter_segments(radius, error)))
    angles = first + turn * np.arange(1, count) / count
    inner = [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]
    return [start, *inner, end]


def bezier(corners: Sequence[XY], error: float) -> list[XY]:
    """Points of a Bézier curve of any degree."""
    control = np.array(corners, dtype=float)
    bend = float(np.abs(np.diff(control, 2, axis=0)).max()) if len(control) > 2 else 0.0
    count = max(2, min(64, math.ceil(math.sqrt(bend / error))))
    out = []
    for t in np.linspace(0.0, 1.0, count + 1):
        points = control
        while len(points) > 1:
            points = (1 - t) * points[:-1] + t * points[1:]
        out.append((float(points[0, 0]), float(points[0, 1])))
    return out


def even_odd(rings: Sequence[BaseGeometry]) -> BaseGeometry:
    """The area inside an odd number of closed outlines."""
    out: BaseGeometry = MultiPolygon()
    for ring in rings:
        out = out.symmetric_difference(ring if ring.is_valid else ring.buffer(0))
    return out


def outline_of(lines: Sequence[BaseGeometry], snap: float) -> tuple[BaseGeometry | None, int]:
    """The area that lines enclose, holes left out, and how many ends hang loose.

    Ends that are nearer to one another than ``snap`` are joined.
    """
    ends: list[XY] = []
    snapped = []
    for line in lines:
        points = [tuple(p) for p in shapely.get_coordinates(line)]
        for k in (0, -1):
            near = next((e for e in ends if math.dist(e, points[k]) <= snap), None)
            if near is None:
                ends.append(points[k])
            else:
                points[k] = near
        if len(set(points)) > 1:
            snapped.append(shapely.LineString(points))
    if not snapped:
        return None, 0
    faces = shapely.get_parts(shapely.polygonize([shapely.union_all(snapped)]))
    if not len(faces):
        return None, len(ends)
    rings = [Polygon(p.exterior) for p in shapely.get_parts(shapely.union_all(faces))]
    rings += [Polygon(h) for p in faces for h in p.interiors]
    rings = [r for k, r in enumerate(rings) if not any(r.equals(o) for o in rings[:k])]
    area = even_odd(rings)
    return (None if area.is_empty else area), 0
