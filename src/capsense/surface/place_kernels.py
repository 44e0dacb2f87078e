"""What the compiled step is given, and where points stand to the design and the walls.

Lengths in metres, 4π eps0 = 1; symbols as in ``docs/theory.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled

BODY = np.dtype(
    [
        ("n", np.int64),  # panels; there are 2 n - 1 clusters
        ("kids", np.int64), ("function", np.int64), ("charge", np.int64), ("center", np.int64),
        ("points", np.int64), ("extent", np.int64), ("own", np.int64), ("energy", np.int64),
        ("impedance", np.int64),  # all of these: where the arrays of a RigidShape stand
        ("spread", np.int64),  # second moments of a changing surface, else 0: it has no energies
        ("scale", np.float64),  # the body is so many times as large as the shape
        ("rotation", np.float64, (3, 3)), ("position", np.float64, 3),
        ("neutral", np.int64),  # whether it carries no net charge
        ("group", np.int64),  # bodies that touch are one conductor, named by its first body
        ("tie", np.float64),  # energy of a group's net charge beyond that of its field [1/m]
        ("sheet", np.float64),  # thickness of a changing sheet of a dielectric [m]; else 0
        ("softness", np.float64),  # 1 / (eps - 1), 0 for a conductor
    ]
)  # fmt: skip
"""One body, as the kernels take it."""

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
