"""Vector instructions inside compiled code, against numpy."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from capsense._simd import (
    SIMD_WIDTH,
    WIDE,
    at,
    dot,
    has_guess,
    horizontal_sum,
    madd,
    muladd,
    put_span,
    span,
    splat,
    vadd,
    vdiv,
    vlog,
    vmadd,
    vmul,
    vsub,
    where_above,
    wide_span,
    wide_splat,
)
from capsense.solver.bodies.panel_kernels import angle_of

ROOTS = """
import numpy as np
from numba import njit
from capsense._simd import put_span, rsqrt, span, wide_span

@njit
def roots(x, one, eight, sixteen):
    for k in range(x.size):
        one[k] = rsqrt(x[k])
    for k in range(0, x.size, 8):
        put_span(eight, k, rsqrt(span(x, k)))
    for k in range(0, x.size, 16):
        put_span(sixteen, k, rsqrt(wide_span(x, k)))

x = np.geomspace(1e-30, 1e30, 20_000).astype(np.float32)
one, eight, sixteen = np.empty((3, x.size), np.float32)
roots(x, one, eight, sixteen)
for found in (one, eight, sixteen):
    assert np.abs(found * np.sqrt(x.astype(float)) - 1.0).max() < 3e-7
guess = "rsqrtps" in "".join(roots.inspect_asm().values())
"""


@njit
def _combine(x, y, scalar, two, out):
    for k in range(0, x.size, SIMD_WIDTH):
        left, right = span(x, k), span(y, k)
        put_span(out, k, vmadd(left, right, vadd(madd(scalar, left, splat(two)), right)))


@njit
def _apart(x, y, out):
    for k in range(0, x.size, SIMD_WIDTH):
        u, v = span(x, k), span(y, k)
        put_span(out, k, dot(u, u, u, u, v, vsub(u, v), vmul(v, v)))


@njit
def _larger(x, y, over, other, out):
    for k in range(0, x.size, SIMD_WIDTH):
        put_span(out, k, where_above(span(x, k), span(y, k), span(over, k), span(other, k)))


@njit
def _sums(x, out):
    for a in range(out.size):
        out[a] = horizontal_sum(span(x, a * SIMD_WIDTH))


@njit
def _fused(a, b, c):
    return muladd(a, b, c)


@njit
def _shift(x, out):
    for k in range(3, x.size - 8, 8):
        put_span(out, k, span(x, k + 1))


@njit
def _turn_round(x, out):
    for k in range(x.size):
        out[k] = at(x, x.size - 1 - k)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_every_lane_and_row_is_treated_alike(kind):
    """Differential: s x + 2 + x y + y, row by row and element by element."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 37, SIMD_WIDTH)).astype(kind)
    out = np.full_like(x, np.nan)
    _combine(x, y, kind(-1.5), kind(2.0), out)
    np.testing.assert_allclose(out, x * y - 1.5 * x + 2.0 + y, rtol=0, atol=20 * np.finfo(kind).eps)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_differences_and_products(kind):
    """Differential: ``x x + x y + x (x - y) + y y``, element by element."""
    x, y = np.random.default_rng(7).normal(size=(2, 11, SIMD_WIDTH)).astype(kind)
    out = np.empty_like(x)
    _apart(x, y, out)
    wanted = x * x + x * y + x * (x - y) + y * y
    np.testing.assert_allclose(out, wanted, rtol=0, atol=40 * np.finfo(kind).eps)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lanes_are_chosen(kind):
    """Differential; equal numbers are not above each other."""
    x, y, over, other = np.random.default_rng(6).normal(size=(4, 11, SIMD_WIDTH)).astype(kind)
    y[::2, 3] = x[::2, 3]
    out = np.empty_like(x)
    _larger(x, y, over, other, out)
    np.testing.assert_array_equal(out, np.where(x > y, over, other))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_lanes_are_added_up(kind):
    """Differential."""
    x = np.random.default_rng(4).normal(size=(11, SIMD_WIDTH)).astype(kind)
    out = np.empty(11, kind)
    _sums(x, out)
    np.testing.assert_allclose(out, x.sum(axis=1), rtol=0, atol=20 * np.finfo(kind).eps)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_scalars_are_multiplied_and_added(kind):
    """Differential, to a rounding of the product."""
    for a, b, c in np.random.default_rng(5).normal(size=(50, 3)).astype(kind):
        assert abs(_fused(a, b, c) - (a * b + c)) <= 8 * np.finfo(kind).eps


def test_roots():
    """Analytic: to the 3e-7 that is promised, for one, eight, sixteen, from 1e-30 to 1e30."""
    found = {}
    exec(ROOTS, found)
    target = found["roots"].targetctx.codegen().magic_tuple()
    assert found["guess"] == has_guess(target)


@pytest.mark.parametrize(
    ("name", "features", "guess"), [("generic", "", False), ("haswell", "+avx,+avx2,+fma", True)]
)
def test_roots_on_other_processors(name, features, guess):
    """The same where there is no guess to start from, and where there is one of eight only."""
    env = {**os.environ, "NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
    if guess and not has_guess(_combine.targetctx.codegen().magic_tuple()):
        pytest.skip("this processor cannot run what is compiled for one with AVX")
    code = ROOTS + f"assert guess == {guess}"
    subprocess.run([sys.executable, "-c", code], env=env, check=True)


def test_where_there_is_no_guess():
    """Invariant: other kinds of processor, and x86 without AVX."""
    assert not has_guess(("aarch64-unknown-linux-gnu", "cortex-a72", "+neon"))
    assert not has_guess(("x86_64-unknown-linux-gnu", "nehalem", "+sse4.2,-avx,+avx512f"))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, np.uint8])
def test_elements_are_read_as_they_lie_in_memory(kind):
    """Differential: a matrix turned round as one long row."""
    x = np.arange(12).astype(kind).reshape(3, 4)
    out = np.zeros(12, kind)
    _turn_round(x, out)
    np.testing.assert_array_equal(out, x.ravel()[::-1])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_spans_begin_anywhere(kind):
    """Differential: a row moved by one element, in pieces of eight."""
    x = np.arange(43).astype(kind)
    out = np.zeros_like(x)
    _shift(x, out)
    np.testing.assert_array_equal(out[3:35], x[4:36])
    assert not out[:3].any()
    assert not out[35:].any()


@njit
def _wide(x, y, scalar, two, out, sums):
    for k in range(0, x.size, WIDE):
        left, right = wide_span(x, k), wide_span(y, k)
        value = vmadd(left, right, vadd(madd(scalar, left, wide_splat(two)), right))
        value = where_above(left, right, value, dot(left, right, left, right, left, left, value))
        put_span(out, k, value)
        sums[k // WIDE] = horizontal_sum(value)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_sixteen_at_a_time(kind):
    """Differential: products, sums, choices and their sums, element by element."""
    x, y = np.random.default_rng(8).normal(size=(2, 9, WIDE)).astype(kind)
    out, sums = np.full_like(x, np.nan), np.empty(9, kind)
    _wide(x, y, kind(-1.5), kind(2.0), out, sums)
    wanted = x * y - 1.5 * x + 2.0 + y
    wanted = np.where(x > y, wanted, x * y + y * x + x * x + wanted)
    np.testing.assert_allclose(out, wanted, rtol=0, atol=60 * np.finfo(kind).eps)
    np.testing.assert_allclose(sums, wanted.sum(axis=1), rtol=0, atol=300 * np.finfo(kind).eps)


@njit
def _quotients(x, y, out):
    for k in range(0, x.size, SIMD_WIDTH):
        put_span(out, k, vdiv(span(x, k), span(y, k)))


@njit
def _logarithms(x, out):
    for k in range(0, x.size, SIMD_WIDTH):
        put_span(out, k, vlog(span(x, k)))
    for k in range(0, x.size - WIDE, 3 * WIDE):
        put_span(out, k, vlog(wide_span(x, k)))


@njit
def _angles(y, x, out):
    for k in range(0, x.size, WIDE):
        put_span(out, k, angle_of(wide_span(x, k), wide_span(y, k)))


def test_quotients() -> None:
    """Differential: numpy's, to the last bit."""
    x, y = np.random.default_rng(3).normal(size=(2, 4096)).astype(np.float32)
    out = np.empty_like(x)
    _quotients(x, y, out)
    np.testing.assert_array_equal(out, x / y)


def test_logarithms() -> None:
    """Differential: numpy's in double precision, from 1e-37 to 1e38, densely about 1."""
    rng = np.random.default_rng(4)
    x = np.concatenate([10.0 ** rng.uniform(-37, 38, 80_000), 1 + rng.uniform(-0.4, 0.6, 80_000)])
    x = np.append(x, [1.0, 2.0, 0.5, 0.70710677, 0.7071068, 1.4142135, 1.4142137, 1e-37])
    x = x.astype(np.float32)
    out = np.empty_like(x)
    _logarithms(x, out)
    truth = np.log(x.astype(float))
    assert (np.abs(out - truth) / np.maximum(np.abs(truth), 1.0)).max() < 1.2e-7
    near = np.abs(truth) < 1e-2  # there it is the relative error that counts
    assert (np.abs(out - truth)[near] <= 2e-7 * np.abs(truth)[near]).all()


def test_angles() -> None:
    """Differential: numpy's in double precision, all around, on the axes and at the origin."""
    rng = np.random.default_rng(5)
    angle, length = rng.uniform(-np.pi, np.pi, 80_000), 10.0 ** rng.uniform(-30, 30, 80_000)
    x, y = length * np.cos(angle), length * np.sin(angle)
    x = np.append(x, 2 * [0, 1, 0, 1, 1, 1, 2, 0]).astype(np.float32)
    y = np.append(y, 2 * [0, 0, 1, 1, -1, 0.41421357, 1, -1]).astype(np.float32)
    out = np.empty_like(x)
    _angles(y, x, out)
    truth = np.arctan2(y.astype(float), x.astype(float))
    assert np.abs(out - truth).max() < 4e-7
    left = np.empty(16, np.float32)
    _angles(np.zeros(16, np.float32), np.full(16, -1, np.float32), left)
    np.testing.assert_allclose(left, np.pi, rtol=1e-7)
