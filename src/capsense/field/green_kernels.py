"""Green's function as compiled code takes it: potentials of its point charges, eight at a time.

Lengths in metres, 4π eps0 = 1; symbols as in ``docs/theory.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from capsense._by_reference import by_reference
from capsense._dense import WIDTH, three
from capsense._jit import compiled, kernel
from capsense._simd import (
    WIDE,
    at,
    madd,
    put_span,
    rsqrt,
    vadd,
    vmadd,
    vmul,
    vsub,
    where_above,
    wide_splat,
)
from capsense.design.model import Design
from capsense.field.face import cover_of, face_box
from capsense.field.face_kernels import Space, fading, smooth
from capsense.field.gap_table import GapTable
from capsense.field.green import LEVELS, GreenFunction
from capsense.field.grid_kernels import Grid, grid_over
from capsense.field.soft import Soft, no_soft, pack_soft

LEAST = 1e-3, 2e-3, 3e-3
"""Distances from near, middle and far sources [m] below which their potential grows no more. They
lie deeper than that under the surfaces of the design."""
_AWAY = 1e3
"""Coordinates of sources without charge [m]."""
MARGIN = 0.03
"""What lies nearer than this to the ceiling and the side walls, over the domain's shortest side, is
left out: at ground, the walls take nearly all of what would meet it. An open domain has none, and
bodies count far beyond it (``Domain.sight``)."""


class Level(NamedTuple):
    """Point charges that represent a design at some distances from it; single precision.

    There are a multiple of ``WIDTH``. The last of them, without charge, are far away.
    """

    sources: NDArray[Any]
    """Where they are [m], shape (3, s)."""
    table: NDArray[Any]
    """What each adds to φ⁰ and ψ, shape (s, w); fewer columns where fewer modes count."""
    least: float
    """No point counts as nearer to one than this [m]."""


@by_reference
class Gap(NamedTuple):
    """A :class:`~capsense.field.gap_table.GapTable`, as the kernels take it; without cells if the
    design has none."""

    validity: float
    """Distance h0 from the face of the design [m] down to which its Green's function is valid."""
    face: NDArray[Any]
    """Corners of the design in coordinates of its face [m], shape (2, 3)."""
    curvature: float
    """Curvature of the face about the y axis [1/m]: 0 of a flat one, 1 / R of a bent film."""
    top: float
    """Height of the face [m]."""
    heights: NDArray[Any]
    log_ratio: float
    """Logarithm of the ratio of two heights."""
    points: NDArray[Any]
    areas: NDArray[Any]
    terminal: NDArray[Any]
    series: NDArray[Any]
    columns: NDArray[Any]
    change: NDArray[Any]
    blocks: NDArray[Any]
    """First cell of each block, and their number, shape (q + 1,)."""
    block_center: NDArray[Any]
    """Middle of each block, in coordinates of the face [m], shape (q, 2)."""
    block_radius: NDArray[Any]
    """Radius of a circle about it that holds its cells [m], shape (q,)."""
    least: float
    """Least length of a field line [m]: bodies do not come nearer than that."""
    soft: Soft
    """The cover, if it gives way."""


LEAST_LENGTH, _THIN = 0.8, 0.03
"""Least length of a field line, over the lowest height of the gap table, or over the second times
the thickness by permittivity of what covers the electrodes, where that is less."""


def no_gap(validity: float, face: NDArray[Any]) -> Gap:
    """The law of a design without one, whose Green's function is valid from a distance on [m]."""
    none, few = np.zeros(0), np.zeros((0, 2), np.float32)
    return Gap(
        validity, face, 0.0, 0.0, np.array([1.0, 2.0]), math.log(2.0), few,
        np.zeros(0, np.float32), np.zeros(0, np.int64), np.zeros(0, np.float32),
        np.zeros((0, 0), np.int64), np.zeros((0, 2, 1), np.float32), np.zeros(1, np.int64),
        np.zeros((0, 2)), none, 0.0, no_soft(0),
    )  # fmt: skip


def pack_gap(table: GapTable | None, clearance: float, design: Design) -> Gap:
    """Lay a table out for the kernels.

    Without one, bodies are kept off a flat design by half the distance ``clearance`` [m] down to
    which its Green's function was fitted.
    """
    face = face_box(design)
    if table is None:
        return no_gap(0.5 * clearance, face)
    count = len(table.areas)
    blocks = np.append(table.blocks, count)
    number = np.repeat(np.arange(len(table.blocks)), np.diff(blocks))
    points = np.asarray(table.points[:, :2], float)
    size = np.diff(blocks)
    center = np.stack([np.bincount(number, x) / size for x in points.T], axis=1)
    radius = np.zeros(len(size))
    np.maximum.at(radius, number, np.linalg.norm(points - center[number], axis=1))
    least = float(table.heights[0])
    cover = cover_of(design)
    if cover > 0.0:
        most = max([1.0, *(layer.eps_r for layer in design.layers)])
        least = min(least, _THIN * cover / most)
    return Gap(
        table.validity, face, 0.0 if design.film is None else 1.0 / design.film.radius, table.top,
        table.heights, math.log(table.heights[1] / table.heights[0]),
        np.ascontiguousarray(points, np.float32), np.ascontiguousarray(table.areas, np.float32),
        np.ascontiguousarray(table.terminal, np.int64),
        np.ascontiguousarray(table.series, np.float32),
        np.ascontiguousarray(table.columns, np.int64),
        np.ascontiguousarray(table.change, np.float32), blocks.astype(np.int64), center, radius,
        LEAST_LENGTH * least, pack_soft(table, design),
    )  # fmt: skip


@by_reference
class Green(NamedTuple):
    """A design's Green's function, as the kernels take it."""

    levels: tuple[Level, Level, Level]
    """Charges for points near the sensor, for those farther away, and for those far away."""
    score_table: NDArray[Any]
    """φ⁰ alone, from the last of these, shape (f, lead)."""
    grid: Grid
    """φ⁰ as a table over the domain, to some per cent."""
    phi_columns: int
    """Columns of φ⁰, padded."""
    terminals: int
    """How many of them are terminals."""
    electrodes: int
    """How many of these are electrodes, which come first."""
    local: int
    """Number of the terminal that is the local ground; -1 where that is earth."""
    floor: float
    """Height of the floor [m]."""
    box: NDArray[Any]
    """Corners of the design [m], shape (2, 3)."""
    blends: NDArray[Any]
    """Distances [m] from ``box`` between which a level gives way to the next one, shape (2, 2)."""
    active_bounds: NDArray[Any]
    """Corners of the part of the domain where bodies count [m], shape (2, 3)."""
    extent: float
    """Shortest side of the domain [m]."""
    gap: Gap
    """The first millimetres in front of a design."""
    space: Space
    """What single points need of all this."""


_PACKED: WeakKeyDictionary[GreenFunction, tuple[Design, Green]] = WeakKeyDictionary()


def pack_green(green: GreenFunction, design: Design) -> Green:
    """Lay the Green's function of a design out for the kernels, once for all its sensors."""
    known = _PACKED.get(green)
    if known is None or known[0] is not design:
        known = _PACKED[green] = design, _packed(green, design)
    return known[1]


def _packed(green: GreenFunction, design: Design) -> Green:
    walls = np.array([design.domain.lower, design.domain.upper])
    extent = float(min(design.domain.size))
    margin = 0.0 if design.domain.open else MARGIN * extent
    room = design.domain.sight + margin * np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, -1.0]])
    terminals = green.near_phi.shape[1]
    phi_columns = 8 * -(-terminals // 8)

    def level(name: str, least: float) -> Level:
        positions, phi, modes = (
            getattr(green, f"{name}_{part}") for part in ("sources", "phi", "modes")
        )
        sources = np.full((3, _padded(len(positions))), _AWAY, np.float32)
        sources[:, : len(positions)] = positions.T
        table = np.zeros((_padded(len(phi)), _padded(phi_columns + modes.shape[1])), np.float32)
        table[: len(phi), :terminals] = phi
        table[: len(phi), phi_columns : phi_columns + modes.shape[1]] = modes
        return Level(sources, table, least)

    near, middle, far = map(level, LEVELS, LEAST)
    score_table = np.ascontiguousarray(far.table[:, :phi_columns])
    limits = np.float32(green.floor), np.float32(far.least)

    def phi(points: NDArray[np.float64]) -> NDArray[np.float32]:
        columns = np.full((3, _padded(len(points))), _AWAY, np.float32)
        columns[:, : len(points)] = points.T
        out = np.empty((phi_columns, columns.shape[1]), np.float32)
        point_potentials(columns, far.sources, score_table, limits, out)
        return np.clip(out[:, : len(points)].T, 0.0, 1.0)

    gap, has_face = pack_gap(green.gap, green.clearance, design), math.isfinite(cover_of(design))
    inner, fade = fading(room, np.asarray(green.box, float), extent)
    space = Space(
        has_face, gap.face, gap.curvature, room, extent, inner, fade, gap.validity, gap.soft.limit
    )
    return Green(
        (near, middle, far),
        score_table,
        grid_over(np.asarray(green.box, float), walls, phi),
        phi_columns,
        terminals,
        len(design.electrodes),
        terminals - 1 if design.local_ground else -1,
        float(green.floor),
        np.asarray(green.box, float),
        np.asarray(green.blends, float),
        room,
        extent,
        gap,
        space,
    )


def _padded(count: int) -> int:
    return WIDTH * -(-count // WIDTH)


@kernel
def source_potentials(points, sources, floor, least, out):
    """Mean over four points of the potential of every unit source and its image in the floor.

    Args:
        points: [m], shape (k, 4, 3), single precision, as all that follows.
        sources: [m], shape (3, s), s a multiple of 16.
        floor: Height of the floor [m].
        least: No point counts as nearer to a source than this [m]; where bodies reach into the
            sensor, they would meet sources that stand for charges elsewhere.
        out: Filled [1/m], shape (k, s).
    """
    width, quarter, zero = sources.shape[1], np.float32(0.25), wide_splat(np.float32(0.0))
    for i in range(points.shape[0]):
        for s in range(0, width, WIDE):
            x, y, up = three(sources, s, width)
            down, value = vsub(wide_splat(np.float32(2.0) * floor), up), zero
            for q in range(4):
                o = 12 * i + 3 * q
                px, py = wide_splat(at(points, o)), wide_splat(at(points, o + 1))
                pz, bound = wide_splat(at(points, o + 2)), wide_splat(least * least)
                value = vadd(value, _potential(px, py, pz, x, y, up, down, bound))
            put_span(out, i * width + s, madd(quarter, value, zero))


@kernel
def point_potentials(points, sources, table, limits, out):
    """Potentials of sources and their images at points, for every column of their charges.

    Args:
        points: [m], shape (3, p), p a multiple of 16.
        sources: [m], shape (3, s).
        table: Charges, shape (s, c), c a multiple of 8.
        limits: Floor and ``least`` [m], as :func:`source_potentials` takes them.
        out: Filled, shape (c, p).
    """
    count, width, columns = points.shape[1], sources.shape[1], table.shape[1]
    floor, least = limits
    twice, bound = np.float32(2.0) * floor, wide_splat(least * least)
    for c in range(0, columns, 8):
        for i in range(0, count, WIDE):
            x, y, z = three(points, i, count)
            a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = wide_splat(np.float32(0.0))
            for s in range(width):
                sx, sy = wide_splat(at(sources, s)), wide_splat(at(sources, width + s))
                up = at(sources, 2 * width + s)
                down = wide_splat(twice - up)
                value = _potential(x, y, z, sx, sy, wide_splat(up), down, bound)
                o = s * columns + c
                a0, a1 = madd(at(table, o), value, a0), madd(at(table, o + 1), value, a1)
                a2, a3 = madd(at(table, o + 2), value, a2), madd(at(table, o + 3), value, a3)
                a4, a5 = madd(at(table, o + 4), value, a4), madd(at(table, o + 5), value, a5)
                a6, a7 = madd(at(table, o + 6), value, a6), madd(at(table, o + 7), value, a7)
            o = c * count + i
            put_span(out, o, a0)
            put_span(out, o + count, a1)
            put_span(out, o + 2 * count, a2)
            put_span(out, o + 3 * count, a3)
            put_span(out, o + 4 * count, a4)
            put_span(out, o + 5 * count, a5)
            put_span(out, o + 6 * count, a6)
            put_span(out, o + 7 * count, a7)


@kernel
def _potential(x, y, z, sx, sy, up, down, bound):
    """Potential at (x, y, z) of a unit charge at height ``up`` and of its image at ``down``.

    ``bound`` is the square of the least distance from the charge.
    """
    dx, dy, dz, ez = vsub(x, sx), vsub(y, sy), vsub(z, up), vsub(z, down)
    across = vmadd(dx, dx, vmul(dy, dy))
    square = vmadd(dz, dz, across)
    direct = rsqrt(where_above(square, bound, square, bound))
    return vsub(direct, rsqrt(vmadd(ez, ez, across)))


@compiled
def distances(points, green):
    """Distance [m] of each leaf's centre from the design's box, shape (l,)."""
    out = np.empty(points.shape[0])
    for j in range(points.shape[0]):
        d = 0.0
        for i in range(3):
            c = 0.5 * (points[j, 0, i] + points[j, 3, i])
            off = max(green.box[0, i] - c, c - green.box[1, i], 0.0)
            d += off * off
        out[j] = math.sqrt(d)
    return out


@kernel
def level_share(distance, level, blends):
    """Share of a level at a distance from the design; over the levels they add to one."""
    up_to, before, last = 1.0, 0.0, blends.shape[0]
    if level < last:
        up_to = smooth((blends[level, 1] - distance) / (blends[level, 1] - blends[level, 0]))
    if level > 0:
        start, end = blends[level - 1, 0], blends[level - 1, 1]
        before = smooth((end - distance) / (end - start))
    return up_to - before
