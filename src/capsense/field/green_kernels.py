"""Green's function as compiled code takes it: potentials of its point charges, eight at a time, and
where points stand to the design and the walls.

Lengths in metres, 4π eps0 = 1; symbols as in ``docs/theory.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._dense import WIDTH
from capsense._jit import compiled
from capsense._simd import muladd, rsqrt
from capsense.design.model import Design
from capsense.field.green import GreenFunction

NEAR_LEAST, FAR_LEAST = 1e-3, 3e-3
"""Distances from near and far sources [m] below which their potential grows no more. They lie
deeper than that under the surfaces of the design."""
SHORE = 5e-3
"""Bodies fade out over this distance beyond the room, and behind the face of a flat design [m]."""
NEAR_FACE = 2e-3
"""Clusters farther from the design [m] keep their gap to it."""
DEEP, STEEP = 3e-3, 4.0
"""What is deeper behind the face of a flat design [m] comes to be screened by it; depth from the
sides counts so many times."""
GAP = 1.5e-4, 7e-4, 0.18, 2e-5
"""Least gap to a flat design [m]: the square of a cluster's extent over the third, at least the
first, at most the second; less by the thickness of a cover, but not less than the fourth."""
_FLAT = 1e-4
"""Sheets of a flat design rise by less than this [m]."""
MARGIN = 0.015
"""What lies nearer than this [m] to the ceiling and the side walls is left out: at ground, the
walls take nearly all of what would meet it."""


class Green(NamedTuple):
    """A design's Green's function, as the kernels take it; single precision."""

    near: NDArray[Any]
    """Sources for points near the sensor [m], shape (3, s)."""
    near_table: NDArray[Any]
    """What each source adds to φ⁰ and ψ, shape (s, w)."""
    far: NDArray[Any]
    """Sources for points far from it [m], shape (3, f)."""
    far_table: NDArray[Any]
    """The same of these, shape (f, v), v <= w."""
    score_table: NDArray[Any]
    """φ⁰ alone, from the far sources, shape (f, lead)."""
    lead: int
    """Columns of φ⁰, padded."""
    terminals: int
    """How many of them are terminals."""
    floor: float
    """Height of the floor [m]."""
    box: NDArray[Any]
    """Corners of the design [m], shape (2, 3)."""
    blend: NDArray[Any]
    """Distances [m] from ``box`` between which near sources give way to far ones, shape (2,)."""
    room: NDArray[Any]
    """Corners of the part of the domain where bodies count [m], shape (2, 3)."""
    cover: float
    """Thickness of what covers the electrodes of a flat design [m]; infinite for other designs."""


def cover_of(design: Design) -> float:
    """Thickness of what covers the sheets of a flat design [m]; infinite for other designs."""
    heights = np.concatenate([body.surface.bounds[:, 2] for body in design.sheets])
    floors = [np.ptp(body.surface.bounds[:, 2]) for body in design.sheets]
    if max(floors) > _FLAT:
        return math.inf
    top = max([float(heights.max()), *(float(layer.upper[2]) for layer in design.layers)])
    return top - float(heights.max())


def pack_green(green: GreenFunction, design: Design) -> Green:
    """Lay the Green's function of a design out for the kernels."""
    walls = np.array([design.domain.lower, design.domain.upper])
    room = walls + MARGIN * np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, -1.0]])
    terminals = green.near_phi.shape[1]
    lead = 8 * -(-terminals // 8)

    def table(phi: NDArray, modes: NDArray) -> NDArray:
        width = WIDTH * -(-(lead + modes.shape[1]) // WIDTH)
        out = np.zeros((len(phi), width), np.float32)
        out[:, :terminals] = phi
        out[:, lead : lead + modes.shape[1]] = modes
        return out

    far = table(green.far_phi, green.far_modes)
    return Green(
        np.ascontiguousarray(green.near_sources.T), table(green.near_phi, green.near_modes),
        np.ascontiguousarray(green.far_sources.T), far, np.ascontiguousarray(far[:, :lead]),
        lead, terminals, float(green.floor), np.asarray(green.box, float),
        np.asarray(green.blend, float), room, cover_of(design),
    )  # fmt: skip


@compiled
def source_potentials(points, sources, floor, least, out):
    """Mean over four points of the potential of every unit source and its image in the floor.

    Args:
        points: [m], shape (k, 4, 3), single precision, as all that follows.
        sources: [m], shape (3, s).
        floor: Height of the floor [m].
        least: No point counts as nearer to a source than this [m]; where bodies reach into the
            sensor, they would meet sources that stand for charges elsewhere.
        out: Filled [1/m], shape (k, s).
    """
    quarter = np.float32(0.25)
    two, bound = np.float32(2.0) * floor, least * least
    for i in range(points.shape[0]):
        for q in range(points.shape[1]):
            x, y, z = points[i, q, 0], points[i, q, 1], points[i, q, 2]
            for s in range(sources.shape[1]):
                dx = x - sources[0, s]
                dy = y - sources[1, s]
                dz = z - sources[2, s]
                ez = z + sources[2, s] - two
                across = muladd(dx, dx, dy * dy)
                value = rsqrt(max(muladd(dz, dz, across), bound)) - rsqrt(muladd(ez, ez, across))
                value *= quarter
                if q == 0:
                    out[i, s] = value
                else:
                    out[i, s] += value


@compiled
def point_potentials(points, sources, floor, least, out):
    """The same at single points, shape (k, 3)."""
    two, bound = np.float32(2.0) * floor, least * least
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for s in range(sources.shape[1]):
            dx = x - sources[0, s]
            dy = y - sources[1, s]
            dz = z - sources[2, s]
            ez = z + sources[2, s] - two
            across = muladd(dx, dx, dy * dy)
            out[i, s] = rsqrt(max(muladd(dz, dz, across), bound)) - rsqrt(muladd(ez, ez, across))


@compiled
def smooth(x):
    """Smoothstep: 0 up to 0, 1 from 1 on."""
    x = min(1.0, max(0.0, x))
    return x * x * (3.0 - 2.0 * x)


@compiled
def beyond(points, green):
    """How far a leaf is out of reach: 0 in the room, 1 beyond the walls or far behind the face."""
    out, depth = 0.0, 1.0
    for i in range(3):
        c = 0.5 * (points[0, i] + points[3, i])
        off = max(green.room[0, i] - c, c - green.room[1, i], 0.0)
        out += off * off
        if i < 2:
            depth = min(depth, STEEP * (c - green.box[0, i]), STEEP * (green.box[1, i] - c))
        else:
            depth = min(depth, green.box[1, 2] - c)
    deep = depth - DEEP if green.cover < 1.0 else 0.0
    return smooth(max(math.sqrt(out), deep) / SHORE)


@compiled
def least_gap(extent, cover):
    """Least gap [m] between a cluster and a flat design, see :data:`GAP`."""
    return max(GAP[3], min(GAP[1], max(GAP[0], extent * extent / GAP[2])) - cover)


@compiled
def lift(points, gap, box):
    """Keep points (k, 3) off a flat design: a distance d < 2 gap becomes gap + d² / (4 gap).

    The space between the design and the floor counts as within it.
    """
    for q in range(points.shape[0]):
        square, depth, axis, side = 0.0, 1.0, 2, 1
        for i in range(3):
            for k in range(2):
                if i == 2 and k == 0:
                    continue
                off = points[q, i] - box[1, i] if k == 1 else box[0, i] - points[q, i]
                square += max(off, 0.0) ** 2
                if -off < depth:
                    depth, axis, side = -off, i, k
        way = math.sqrt(square)
        if way >= 2.0 * gap:
            continue
        if way == 0.0:
            points[q, axis] = box[1, axis] + gap if side == 1 else box[0, axis] - gap
            continue
        ratio = (gap + way * way / (4.0 * gap)) / way
        for i in range(3):
            edge = min(points[q, i], box[1, i])
            if i < 2:
                edge = max(edge, box[0, i])
            points[q, i] = edge + ratio * (points[q, i] - edge)


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


@compiled
def near_share(distance, blend):
    """One below the first distance of a blend, zero above the second, smooth in between."""
    return smooth((blend[1] - distance) / (blend[1] - blend[0]))
