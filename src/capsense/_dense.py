"""Compiled dense algebra on small tables: products, Cholesky factors, substitution.

Eight columns at a time, as :mod:`capsense._simd` has it.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import kernel
from capsense._simd import (
    at,
    horizontal_sum,
    madd,
    put_span,
    span,
    splat,
    vadd,
    vmadd,
    vsub,
    wide_span,
    wide_splat,
)

WIDTH = 32
"""Tables have a multiple of so many columns."""
_TILE = 16
"""Side of the tiles that a matrix is turned over in."""


@kernel
def padded(count, width):
    """The least multiple of ``width`` that is not below ``count``."""
    return width * ((count + width - 1) // width)


@kernel
def three(table, place, width):
    """Sixteen elements from a place on, those ``width`` behind, and those twice as far behind."""
    x, y = wide_span(table, place), wide_span(table, place + width)
    return x, y, wide_span(table, place + 2 * width)


@kernel
def multiply(left, table, out):
    """``out = left @ table``, shapes (k, s), (s, w) and (k, w); w a multiple of 32."""
    multiply_part(left, table, left.shape[1], table.shape[1], out)


@kernel
def multiply_part(left, table, depth, width, out):
    """``left @ table`` of the first ``depth`` rows of the table and the first ``width`` columns
    only.

    Four rows and 32 columns at a time: their sums stay in registers.
    """
    k, s, w = left.shape[0], left.shape[1], table.shape[1]
    zero = wide_splat(np.float32(0.0))
    for j in range(0, width, WIDTH):
        for i in range(0, k - 3, 4):
            a0 = a1 = b0 = b1 = c0 = c1 = d0 = d1 = zero
            p = i * s
            for t in range(depth):
                o = t * w + j
                v0, v1 = wide_span(table, o), wide_span(table, o + 16)
                x = at(left, p + t)
                a0, a1 = madd(x, v0, a0), madd(x, v1, a1)
                x = at(left, p + s + t)
                b0, b1 = madd(x, v0, b0), madd(x, v1, b1)
                x = at(left, p + 2 * s + t)
                c0, c1 = madd(x, v0, c0), madd(x, v1, c1)
                x = at(left, p + 3 * s + t)
                d0, d1 = madd(x, v0, d0), madd(x, v1, d1)
            _put(out, i * w + j, 16, a0, a1)
            _put(out, (i + 1) * w + j, 16, b0, b1)
            _put(out, (i + 2) * w + j, 16, c0, c1)
            _put(out, (i + 3) * w + j, 16, d0, d1)
        for i in range(k - k % 4, k):
            a0 = a1 = zero
            for t in range(depth):
                o = t * w + j
                x = at(left, i * s + t)
                a0, a1 = madd(x, wide_span(table, o), a0), madd(x, wide_span(table, o + 16), a1)
            _put(out, i * w + j, 16, a0, a1)


@kernel
def _put(out, place, width, a, b):
    put_span(out, place, a)
    put_span(out, place + width, b)


@kernel
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


@kernel
def square(rows, f):
    """Square of row f of some, whose length is a multiple of 8."""
    width, total = rows.shape[1], splat(np.float32(0.0))
    for k in range(f * width, (f + 1) * width, 8):
        total = vmadd(span(rows, k), span(rows, k), total)
    return float(horizontal_sum(total))


@kernel
def subtract_product(left, f, right, out, row):
    """Take row f of ``left @ right`` off a row of ``out``, shapes (k, n), (n, m) and (l, m).

    Columns go eight at a time; m is a multiple of 8.
    """
    n, m = left.shape[1], right.shape[1]
    o, whole = f * n, n - n % 4
    for c in range(0, m, 8):
        s0 = s1 = s2 = s3 = splat(0.0)
        for e in range(0, whole, 4):
            p = e * m + c
            s0 = madd(at(left, o + e), span(right, p), s0)
            s1 = madd(at(left, o + e + 1), span(right, p + m), s1)
            s2 = madd(at(left, o + e + 2), span(right, p + 2 * m), s2)
            s3 = madd(at(left, o + e + 3), span(right, p + 3 * m), s3)
        for e in range(whole, n):
            s0 = madd(at(left, o + e), span(right, e * m + c), s0)
        p = row * m + c
        put_span(out, p, vsub(span(out, p), vadd(vadd(s0, s1), vadd(s2, s3))))


@kernel
def add_products(left, right, out):
    """``out += left.T @ right``, shapes (n, m), (n, m) and (m, m); m a multiple of 8."""
    n, m = left.shape
    for i in range(m):
        for c in range(0, m, 8):
            total = span(out, i * m + c)
            for f in range(n):
                total = madd(at(left, f * m + i), span(right, f * m + c), total)
            put_span(out, i * m + c, total)


@kernel
def whole_lines(n):
    """Columns that a matrix of n rows has for :func:`cholesky`.

    An odd number of 16s, so that a column's elements do not compete for places in the cache.
    """
    return 16 * (((n + 15) // 16) | 1)


@kernel
def mirror(matrix):
    """Fill in what is above the diagonal of a symmetric matrix, tile by tile."""
    n = matrix.shape[0]
    for first in range(0, n, _TILE):
        for second in range(0, first + 1, _TILE):
            for i in range(first, min(first + _TILE, n)):
                for j in range(second, min(second + _TILE, i)):
                    matrix[j, i] = matrix[i, j]


@kernel
def cholesky(matrix):
    """Replace the upper half of a symmetric matrix by its Cholesky factor U, ``matrix = Uᵀ U``.

    Four rows and 16 columns at a time: their sums stay in registers.

    Args:
        matrix: Shape (n, w), w at least n and a multiple of 16; what is below the diagonal and
            behind the first n columns is lost, and counts for nothing.

    Returns:
        Whether the matrix is positive definite.
    """
    n, w = matrix.shape
    for i in range(0, n, 4):
        _reduce(matrix, i)
        for f in range(i, min(i + 4, n)):
            begin = f - f % 8
            for q in range(i, f):
                x = -at(matrix, q * w + f)
                for j in range(begin, w, 8):
                    o = f * w + j
                    put_span(matrix, o, madd(x, span(matrix, q * w + j), span(matrix, o)))
            if not matrix[f, f] > 0.0:
                return False
            scale, zero = 1.0 / np.sqrt(matrix[f, f]), splat(0.0)
            for j in range(begin, w, 8):
                put_span(matrix, f * w + j, madd(scale, span(matrix, f * w + j), zero))
    return True


@kernel
def _reduce(matrix, i):
    """Take off four rows from row i on what those before them account for."""
    n, w = matrix.shape
    for j in range(i - i % 16, w, 16):
        if i + 4 <= n:
            o = i * w + j
            a0, b0, c0, d0 = (
                span(matrix, o), span(matrix, o + w), span(matrix, o + 2 * w),
                span(matrix, o + 3 * w),
            )  # fmt: skip
            a1, b1, c1, d1 = (
                span(matrix, o + 8), span(matrix, o + w + 8), span(matrix, o + 2 * w + 8),
                span(matrix, o + 3 * w + 8),
            )  # fmt: skip
            for p in range(i):
                u, v = span(matrix, p * w + j), span(matrix, p * w + j + 8)
                x = -at(matrix, p * w + i)
                a0, a1 = madd(x, u, a0), madd(x, v, a1)
                x = -at(matrix, p * w + i + 1)
                b0, b1 = madd(x, u, b0), madd(x, v, b1)
                x = -at(matrix, p * w + i + 2)
                c0, c1 = madd(x, u, c0), madd(x, v, c1)
                x = -at(matrix, p * w + i + 3)
                d0, d1 = madd(x, u, d0), madd(x, v, d1)
            _put(matrix, o, 8, a0, a1)
            _put(matrix, o + w, 8, b0, b1)
            _put(matrix, o + 2 * w, 8, c0, c1)
            _put(matrix, o + 3 * w, 8, d0, d1)
            continue
        for f in range(i, n):
            a0, a1 = span(matrix, f * w + j), span(matrix, f * w + j + 8)
            for p in range(i):
                x = -at(matrix, p * w + f)
                a0 = madd(x, span(matrix, p * w + j), a0)
                a1 = madd(x, span(matrix, p * w + j + 8), a1)
            _put(matrix, f * w + j, 8, a0, a1)


@kernel
def substitute(factor, sides):
    """Replace right-hand sides (n, m) by the solution; ``factor`` is from :func:`cholesky`.

    Columns go eight at a time; m is a multiple of 8.
    """
    (n, m), w = sides.shape, factor.shape[1]
    for c in range(0, m, 8):
        for i in range(n):
            line, o = i * w, i * m + c
            total = madd(1.0 / at(factor, line + i), span(sides, o), splat(0.0))
            put_span(sides, o, total)
            for k in range(i + 1, n):
                o = k * m + c
                put_span(sides, o, madd(-at(factor, line + k), total, span(sides, o)))
        for i in range(n - 1, -1, -1):
            line, o = i * w, i * m + c
            total, other = span(sides, o), splat(0.0)
            for k in range(i + 1, n - 1, 2):
                total = madd(-at(factor, line + k), span(sides, k * m + c), total)
                other = madd(-at(factor, line + k + 1), span(sides, (k + 1) * m + c), other)
            if (n - i) % 2 == 0:
                total = madd(-at(factor, line + n - 1), span(sides, (n - 1) * m + c), total)
            put_span(sides, o, madd(1.0 / at(factor, line + i), vadd(total, other), splat(0.0)))


@kernel
def eliminate(matrix, sides):
    """Replace right-hand sides (n, m) by the solution for a symmetric matrix (n, n), lost.

    Real or complex. Without pivots, which it needs none of where its real part is positive
    definite, as energies are, and losses have one sign (Higham, *Accuracy and Stability of
    Numerical Algorithms*, section 10.4).
    Compiled, as the bits of a BLAS depend on how many threads it has.
    """
    n, m = sides.shape
    for k in range(n):
        for i in range(k + 1, n):
            share = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= share * matrix[k, j]
            for c in range(m):
                sides[i, c] -= share * sides[k, c]
    for k in range(n - 1, -1, -1):
        for c in range(m):
            sides[k, c] /= matrix[k, k]
        for i in range(k):
            for c in range(m):
                sides[i, c] -= matrix[i, k] * sides[k, c]
