"""Compiled line intersections, called from the solver's kernels.
All functions are free of allocations and never return NaN for finite lines of non-zero
direction. Misses are ``(inf, -inf)``, so ``t0 <= t1`` tells a hit. The readable references are
the ``line_intervals`` methods of :mod:`capsense.scene.shapes`. Numba is imported by the kernel
modules only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from capsense._jit import kernel
from capsense.scene.shape import ShapeKind
from capsense.scene.shapes import PARALLEL

Array = NDArray[np.float64]

_BOX = int(ShapeKind.BOX)
_SPHERE = int(ShapeKind.SPHERE)
_CAPSULE = int(ShapeKind.CAPSULE)
_CYLINDER = int(ShapeKind.CYLINDER)
_ELLIPSOID = int(ShapeKind.ELLIPSOID)
_PARALLEL = float(PARALLEL)
_INF = math.inf


@kernel
def slab(o: float, d: float, half: float) -> tuple[float, float]:
    """Line against −half <= x <= half, one coordinate."""
    if d == 0.0:
        if abs(o) <= half:
            return -_INF, _INF
        return _INF, -_INF
    t0 = (-half - o) / d
    t1 = (half - o) / d
    if t0 <= t1:
        return t0, t1
    return t1, t0


@kernel
def ball(
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, radius: float
) -> tuple[float, float]:
    """Line against a ball; the discriminant is taken at the foot of the perpendicular."""
    a = dx * dx + dy * dy + dz * dz
    middle = -(ox * dx + oy * dy + oz * dz) / a
    fx = ox + middle * dx
    fy = oy + middle * dy
    fz = oz + middle * dz
    square = radius * radius - (fx * fx + fy * fy + fz * fz)
    if square < 0.0:
        return _INF, -_INF
    half = math.sqrt(square / a)
    return middle - half, middle + half


@kernel
def cylinder(
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    radius: float,
    half: float,
) -> tuple[float, float]:
    """Line against a cylinder along z of half length ``half``."""
    s0, s1 = slab(oz, dz, half)
    if s0 > s1:
        return _INF, -_INF
    d2 = dx * dx + dy * dy
    if d2 <= _PARALLEL * (d2 + dz * dz):
        if ox * ox + oy * oy <= radius * radius:
            return s0, s1
        return _INF, -_INF
    t0, t1 = ball(ox, oy, 0.0, dx, dy, 0.0, radius)
    t0 = max(t0, s0)
    t1 = min(t1, s1)
    if t0 > t1:
        return _INF, -_INF
    return t0, t1


@kernel
def line_interval(
    kind: int,
    params: Array,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, float]:
    """Stretch of the line o + t d inside a convex primitive, all in the body's frame.

    Args:
        kind: A :class:`~capsense.scene.shape.ShapeKind`; meshes always miss here, see
            :func:`mesh_line_intervals`.
        params: Sizes [m] of the shape, shape (3,).
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.

    Returns:
        Entry and exit parameter; ``(inf, -inf)`` for a miss.
    """
    if kind == _BOX:
        t0, t1 = slab(ox, dx, params[0])
        u0, u1 = slab(oy, dy, params[1])
        v0, v1 = slab(oz, dz, params[2])
        t0 = max(t0, max(u0, v0))
        t1 = min(t1, min(u1, v1))
        if t0 > t1:
            return _INF, -_INF
        return t0, t1
    if kind == _SPHERE:
        return ball(ox, oy, oz, dx, dy, dz, params[0])
    if kind == _CAPSULE:
        r = params[0]
        h = params[1]
        t0, t1 = cylinder(ox, oy, oz, dx, dy, dz, r, h)
        u0, u1 = ball(ox, oy, oz - h, dx, dy, dz, r)
        v0, v1 = ball(ox, oy, oz + h, dx, dy, dz, r)
        return min(t0, min(u0, v0)), max(t1, max(u1, v1))
    if kind == _CYLINDER:
        return cylinder(ox, oy, oz, dx, dy, dz, params[0], params[1])
    if kind == _ELLIPSOID:
        a = 1.0 / params[0]
        b = 1.0 / params[1]
        c = 1.0 / params[2]
        return ball(ox * a, oy * b, oz * c, dx * a, dy * b, dz * c, 1.0)
    return _INF, -_INF


@kernel
def contains(kind: int, params: Array, x: float, y: float, z: float) -> bool:
    """Whether a point in a convex primitive's frame lies in it; meshes and layers: never."""
    if kind == _BOX:
        return abs(x) <= params[0] and abs(y) <= params[1] and abs(z) <= params[2]
    if kind == _ELLIPSOID:
        return (x / params[0]) ** 2 + (y / params[1]) ** 2 + (z / params[2]) ** 2 <= 1.0
    if kind == _CYLINDER:
        return abs(z) <= params[1] and x * x + y * y <= params[0] * params[0]
    if kind == _CAPSULE:
        z -= min(max(z, -params[1]), params[1])
    elif kind != _SPHERE:
        return False
    return x * x + y * y + z * z <= params[0] * params[0]


@kernel
def body_line_interval(
    kind: int,
    params: Array,
    rotation: Array,
    position: Array,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> tuple[float, float]:
    """As :func:`line_interval`, for a line in the sensor frame and a body standing in it.

    Args:
        kind: A :class:`~capsense.scene.shape.ShapeKind`.
        params: Sizes [m] of the shape, shape (3,).
        rotation: Body's frame to sensor frame, shape (3, 3).
        position: Origin of the body's frame [m] in the sensor frame, shape (3,).
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.

    Returns:
        Entry and exit parameter; ``(inf, -inf)`` for a miss.
    """
    px = ox - position[0]
    py = oy - position[1]
    pz = oz - position[2]
    r = rotation
    return line_interval(
        kind,
        params,
        r[0, 0] * px + r[1, 0] * py + r[2, 0] * pz,
        r[0, 1] * px + r[1, 1] * py + r[2, 1] * pz,
        r[0, 2] * px + r[1, 2] * py + r[2, 2] * pz,
        r[0, 0] * dx + r[1, 0] * dy + r[2, 0] * dz,
        r[0, 1] * dx + r[1, 1] * dy + r[2, 1] * dz,
        r[0, 2] * dx + r[1, 2] * dy + r[2, 2] * dz,
    )


@kernel
def grid_value(grid: NDArray[np.float32], x: float, y: float, z: float) -> float:
    """Trilinear interpolation at (x, y, z) in cells; points outside are drawn to the edge."""
    x = min(max(x, 0.0), grid.shape[0] - 1.0)
    y = min(max(y, 0.0), grid.shape[1] - 1.0)
    z = min(max(z, 0.0), grid.shape[2] - 1.0)
    i = min(int(x), grid.shape[0] - 2)
    j = min(int(y), grid.shape[1] - 2)
    k = min(int(z), grid.shape[2] - 2)
    x -= i
    y -= j
    z -= k
    a = grid[i, j, k] * (1.0 - z) + grid[i, j, k + 1] * z
    b = grid[i, j + 1, k] * (1.0 - z) + grid[i, j + 1, k + 1] * z
    c = grid[i + 1, j, k] * (1.0 - z) + grid[i + 1, j, k + 1] * z
    d = grid[i + 1, j + 1, k] * (1.0 - z) + grid[i + 1, j + 1, k + 1] * z
    a = a * (1.0 - y) + b * y
    c = c * (1.0 - y) + d * y
    return a * (1.0 - x) + c * x


@kernel
def _crossing(
    grid: NDArray[np.float32],
    px: float,
    py: float,
    pz: float,
    ux: float,
    uy: float,
    uz: float,
    a: float,
    fa: float,
    b: float,
    fb: float,
) -> float:
    """Zero of the interpolated distance between two points of a line, by Ridders' method.

    The bracket at least halves in every round, so an end that happens to touch zero does no
    harm; on a linear stretch the first round is exact and the second confirms it.
    """
    last = _INF
    s = a
    for _ in range(30):
        m = 0.5 * (a + b)
        fm = grid_value(grid, px + m * ux, py + m * uy, pz + m * uz)
        root = math.sqrt(fm * fm - fa * fb)
        if root == 0.0:
            return m
        s = m + (m - a) * (fm / root if fa > fb else -fm / root)
        if b - a < 1e-7 or abs(s - last) < 1e-7:
            break
        last = s
        f = grid_value(grid, px + s * ux, py + s * uy, pz + s * uz)
        if (fm <= 0.0) != (f <= 0.0):
            if s < m:
                a, fa, b, fb = s, f, m, fm
            else:
                a, fa, b, fb = m, fm, s, f
        elif (fa <= 0.0) != (f <= 0.0):
            b, fb = min(s, m), f if s < m else fm
        else:
            a, fa = max(s, m), f if s > m else fm
    return s


@kernel
def mesh_line_intervals(
    grid: NDArray[np.float32],
    origin: Array,
    inv_h: float,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    begin: float,
    stop: float,
    out: Array,
) -> int:
    """Stretches of the line o + t d inside a signed-distance grid, all in the body's frame.

    Only t from ``begin`` to ``stop`` is looked at; a stretch that goes on beyond ends there.
    The line is followed in steps of the distance less half a cell, and of half a cell at least;
    crossings are then found to 1e-7 of a cell on the trilinear interpolant. Where three samples
    show a nearest approach, their parabola's extremum is probed, so that a grazing
    line does not flicker.

    Args:
        grid: Signed distances [m], shape (nx, ny, nz), positive all over its boundary.
        origin: First node [m], shape (3,).
        inv_h: Reciprocal of the node spacing [1/m].
        ox, oy, oz: A point [m] on the line.
        dx, dy, dz: Direction, of any non-zero length.
        out: Receives entry and exit of each stretch in ascending order, shape (K, 2). Rows that
            are not used are left alone. If there are more than K stretches, the last row ends
            at the last exit.

    Returns:
        The number of rows written.
    """
    speed = math.sqrt(dx * dx + dy * dy + dz * dz) * inv_h
    scale = inv_h / speed
    ux, uy, uz = dx * scale, dy * scale, dz * scale
    px, py, pz = (ox - origin[0]) * inv_h, (oy - origin[1]) * inv_h, (oz - origin[2]) * inv_h
    hx, hy, hz = 0.5 * (grid.shape[0] - 1), 0.5 * (grid.shape[1] - 1), 0.5 * (grid.shape[2] - 1)
    x0, x1 = slab(px - hx, ux, hx)
    y0, y1 = slab(py - hy, uy, hy)
    z0, z1 = slab(pz - hz, uz, hz)
    s = max(begin * speed, max(x0, max(y0, z0)))
    end = min(stop * speed, min(x1, min(y1, z1)))
    n = 0
    if s >= end:
        return n
    v = grid_value(grid, px + s * ux, py + s * uy, pz + s * uz)
    before_s = s
    before_v = v
    entry = s / speed
    inside = v <= 0.0
    while s < end:
        step = max(0.5, abs(v) * inv_h - 0.5)
        next_s = min(s + step, end)
        next_v = grid_value(grid, px + next_s * ux, py + next_s * uy, pz + next_s * uz)
        next_inside = next_v <= 0.0
        if next_inside != inside:
            t = _crossing(grid, px, py, pz, ux, uy, uz, s, v, next_s, next_v) / speed
            if next_inside:
                entry = t
            else:
                row = min(n, out.shape[0] - 1)
                if row == n:
                    out[row, 0] = entry
                    n += 1
                out[row, 1] = t
            inside = next_inside
        elif (
            (before_v <= 0.0) == inside
            and abs(v) <= abs(before_v)
            and abs(v) < abs(next_v)
            and abs(v) * inv_h < 1.0
        ):
            # All three on one side, nearest in the middle: does the line touch in between?
            l0 = s - before_s
            l1 = next_s - s
            if l0 > 0.0 and l1 > 0.0:
                g0 = (v - before_v) / l0
                g1 = (next_v - v) / l1
                probe = s - 0.5 * (g0 * l1 + g1 * l0) / (g1 - g0)
                f = grid_value(grid, px + probe * ux, py + probe * uy, pz + probe * uz)
                if (f <= 0.0) != inside:
                    a = _crossing(grid, px, py, pz, ux, uy, uz, before_s, before_v, probe, f)
                    b = _crossing(grid, px, py, pz, ux, uy, uz, probe, f, next_s, next_v)
                    row = min(n, out.shape[0] - 1)
                    if inside:
                        if row == n:
                            out[row, 0] = entry
                            n += 1
                        out[row, 1] = a / speed
                        entry = b / speed
                    else:
                        if row == n:
                            out[row, 0] = a / speed
                            n += 1
                        out[row, 1] = b / speed
        before_s = s
        before_v = v
        s = next_s
        v = next_v
    if inside:
        row = min(n, out.shape[0] - 1)
        if row == n:
            out[row, 0] = entry
            n += 1
        out[row, 1] = end / speed
    return n
