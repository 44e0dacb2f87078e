"""What the compiled step is given, where points stand to the design and the walls, and potentials
of point charges at many points, eight at a time.

Lengths in metres, 4π eps0 = 1; symbols as in ``docs/theory.md``.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from capsense._jit import compiled, pasted
from capsense._simd import at, horizontal_sum, madd, muladd, put_span, rsqrt, span, splat, vmadd

WIDTH = 32
"""Tables have a multiple of so many columns."""


def _pointer(kind: Any) -> Any:
    @intrinsic
    def pointer(typing: Any, address: Any) -> Any:
        """A pointer to the numbers that stand at an address."""

        def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.intp), code

    return pointer


singles, doubles, integers = _pointer(types.float32), _pointer(types.float64), _pointer(types.int64)


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
def multiply(left, table, out):
    """``out = left @ table``, shapes (k, s), (s, w) and (k, w); w a multiple of 32."""
    multiply_part(left, table, left.shape[1], table.shape[1], out)


@compiled
def multiply_part(left, table, depth, width, out):
    """The same, of the first ``depth`` rows of the table and the first ``width`` columns only.

    Four rows and 32 columns at a time: sixteen sums stay in registers.
    """
    k, s, w = left.shape[0], left.shape[1], table.shape[1]
    zero = splat(np.float32(0.0))
    for j in range(0, width, WIDTH):
        for i in range(0, k - 3, 4):
            a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = zero
            c0 = c1 = c2 = c3 = d0 = d1 = d2 = d3 = zero
            p = i * s
            for t in range(depth):
                o = t * w + j
                v0, v1, v2, v3 = (
                    span(table, o),
                    span(table, o + 8),
                    span(table, o + 16),
                    span(table, o + 24),
                )
                x = at(left, p + t)
                a0, a1, a2, a3 = madd(x, v0, a0), madd(x, v1, a1), madd(x, v2, a2), madd(x, v3, a3)
                x = at(left, p + s + t)
                b0, b1, b2, b3 = madd(x, v0, b0), madd(x, v1, b1), madd(x, v2, b2), madd(x, v3, b3)
                x = at(left, p + 2 * s + t)
                c0, c1, c2, c3 = madd(x, v0, c0), madd(x, v1, c1), madd(x, v2, c2), madd(x, v3, c3)
                x = at(left, p + 3 * s + t)
                d0, d1, d2, d3 = madd(x, v0, d0), madd(x, v1, d1), madd(x, v2, d2), madd(x, v3, d3)
            _put(out, i * w + j, a0, a1, a2, a3)
            _put(out, (i + 1) * w + j, b0, b1, b2, b3)
            _put(out, (i + 2) * w + j, c0, c1, c2, c3)
            _put(out, (i + 3) * w + j, d0, d1, d2, d3)
        for i in range(k - k % 4, k):
            a0 = a1 = a2 = a3 = zero
            for t in range(depth):
                o = t * w + j
                x = at(left, i * s + t)
                a0, a1 = madd(x, span(table, o), a0), madd(x, span(table, o + 8), a1)
                a2, a3 = madd(x, span(table, o + 16), a2), madd(x, span(table, o + 24), a3)
            _put(out, i * w + j, a0, a1, a2, a3)


@pasted
def _put(out, place, a, b, c, d):
    put_span(out, place, a)
    put_span(out, place + 8, b)
    put_span(out, place + 16, c)
    put_span(out, place + 24, d)


@compiled
def multiply_simd(left, table, out):
    """``out = left @ table``, shapes (k, s), (s, w) and (k, w); w a multiple of 8, k of 4."""
    k, s, w = left.shape[0], left.shape[1], table.shape[1]
    for j in range(0, w, 8):
        for i in range(0, k, 4):
            a = b = c = d = splat(np.float32(0.0))
            p = i * s
            for t in range(s):
                v = span(table, t * w + j)
                a, b = madd(at(left, p + t), v, a), madd(at(left, p + s + t), v, b)
                c = madd(at(left, p + 2 * s + t), v, c)
                d = madd(at(left, p + 3 * s + t), v, d)
            o = i * w + j
            put_span(out, o, a)
            put_span(out, o + w, b)
            put_span(out, o + 2 * w, c)
            put_span(out, o + 3 * w, d)


@compiled
def cholesky(matrix):
    """Replace the lower half of a symmetric matrix (n, n) by its Cholesky factor.

    Returns:
        Whether the matrix is positive definite.
    """
    n = matrix.shape[0]
    zero = splat(matrix[0, 0] * 0.0)
    for i in range(n):
        for j in range(0, i + 1, 4):
            if j + 4 <= i:
                a = b = c = d = zero
                o, p = i * n, j * n
                whole = j - j % 8
                for k in range(0, whole, 8):
                    v = span(matrix, o + k)
                    a, b = vmadd(v, span(matrix, p + k), a), vmadd(v, span(matrix, p + n + k), b)
                    c = vmadd(v, span(matrix, p + 2 * n + k), c)
                    d = vmadd(v, span(matrix, p + 3 * n + k), d)
                s0, s1, s2, s3 = (
                    horizontal_sum(a),
                    horizontal_sum(b),
                    horizontal_sum(c),
                    horizontal_sum(d),
                )
                for k in range(whole, j):
                    x = at(matrix, o + k)
                    s0 = muladd(x, at(matrix, p + k), s0)
                    s1 = muladd(x, at(matrix, p + n + k), s1)
                    s2 = muladd(x, at(matrix, p + 2 * n + k), s2)
                    s3 = muladd(x, at(matrix, p + 3 * n + k), s3)
                l0 = (matrix[i, j] - s0) / matrix[j, j]
                l1 = (matrix[i, j + 1] - s1 - l0 * matrix[j + 1, j]) / matrix[j + 1, j + 1]
                l2 = (matrix[i, j + 2] - s2 - l0 * matrix[j + 2, j]
                      - l1 * matrix[j + 2, j + 1]) / matrix[j + 2, j + 2]  # fmt: skip
                l3 = (matrix[i, j + 3] - s3 - l0 * matrix[j + 3, j] - l1 * matrix[j + 3, j + 1]
                      - l2 * matrix[j + 3, j + 2]) / matrix[j + 3, j + 3]  # fmt: skip
                matrix[i, j], matrix[i, j + 1], matrix[i, j + 2], matrix[i, j + 3] = l0, l1, l2, l3
            else:
                for e in range(j, min(j + 4, i + 1)):
                    total = matrix[i, e]
                    for k in range(e):
                        total = muladd(-at(matrix, i * n + k), at(matrix, e * n + k), total)
                    if e < i:
                        matrix[i, e] = total / matrix[e, e]
                    elif not total > 0.0:
                        return False
                    else:
                        matrix[i, i] = np.sqrt(total)
    return True


@compiled
def substitute(factor, sides):
    """Replace right-hand sides (n, m) by the solution; ``factor`` is from :func:`cholesky`.

    Columns go eight at a time; m is a multiple of 8.
    """
    n, m = sides.shape
    for c in range(0, m, 8):
        for i in range(n):
            total = span(sides, i * m + c)
            for k in range(i):
                total = madd(-at(factor, i * n + k), span(sides, k * m + c), total)
            put_span(sides, i * m + c, madd(1.0 / factor[i, i], total, splat(0.0)))
        for i in range(n - 1, -1, -1):
            done = madd(1.0 / factor[i, i], span(sides, i * m + c), splat(0.0))
            put_span(sides, i * m + c, done)
            for k in range(i):
                put_span(sides, k * m + c,
                         madd(-at(factor, i * n + k), done, span(sides, k * m + c)))  # fmt: skip


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
