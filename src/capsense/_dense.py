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
    muladd,
    put_span,
    span,
    splat,
    vmadd,
    wide_span,
    wide_splat,
)

WIDTH = 32
"""Tables have a multiple of so many columns."""


@kernel
def multiply(left, table, out):
    """``out = left @ table``, shapes (k, s), (s, w) and (k, w); w a multiple of 32."""
    multiply_part(left, table, left.shape[1], table.shape[1], out)


@kernel
def multiply_part(left, table, depth, width, out):
    """The same, of the first ``depth`` rows of the table and the first ``width`` columns only.

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
            _put(out, i * w + j, a0, a1)
            _put(out, (i + 1) * w + j, b0, b1)
            _put(out, (i + 2) * w + j, c0, c1)
            _put(out, (i + 3) * w + j, d0, d1)
        for i in range(k - k % 4, k):
            a0 = a1 = zero
            for t in range(depth):
                o = t * w + j
                x = at(left, i * s + t)
                a0, a1 = madd(x, wide_span(table, o), a0), madd(x, wide_span(table, o + 16), a1)
            _put(out, i * w + j, a0, a1)


@kernel
def _put(out, place, a, b):
    put_span(out, place, a)
    put_span(out, place + 16, b)


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


@kernel
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
