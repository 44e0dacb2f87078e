"""Vector instructions inside compiled code, against numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from capsense._simd import (
    LANES,
    aligned_zeros,
    at,
    load,
    madd,
    narrow,
    put,
    put_span,
    span,
    splat,
    store,
    vadd,
    vmadd,
    widen,
)


@njit
def _combine(x, y, scalar, two, out):
    for a in range(x.shape[0]):
        left, right = load(x, a), load(y, a)
        store(out, a, vmadd(left, right, vadd(madd(scalar, left, splat(two)), right)))


@njit
def _convert(single, double, wide, slim):
    for a in range(single.shape[0]):
        store(wide, a, widen(load(single, a)))
        store(slim, a, narrow(load(double, a)))


@njit
def _shift(x, out):
    for k in range(3, x.size - 8, 8):
        put_span(out, k, span(x, k + 1))


@njit
def _turn_round(x, out):
    for k in range(x.size):
        put(out, k, at(x, x.size - 1 - k))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_every_lane_and_row_is_treated_alike(kind):
    """Differential: s x + 2 + x y + y, row by row and lane by lane."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 37, LANES)).astype(kind)
    out = np.full_like(x, np.nan)
    _combine(x, y, kind(-1.5), kind(2.0), out)
    np.testing.assert_allclose(out, x * y - 1.5 * x + 2.0 + y, rtol=0, atol=20 * np.finfo(kind).eps)


def test_precision_is_raised_and_lowered_as_numpy_does():
    """Differential, to the last bit."""
    double = np.random.default_rng(4).normal(size=(9, LANES))
    single = double[::-1].astype(np.float32)
    wide, slim = np.empty_like(double), np.empty_like(single)
    _convert(single, double, wide, slim)
    np.testing.assert_array_equal(wide, single.astype(np.float64))
    np.testing.assert_array_equal(slim, double.astype(np.float32))


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64, np.uint8])
def test_elements_are_read_and_written_as_they_lie_in_memory(kind):
    """Differential: a matrix turned round as one long row."""
    x = np.arange(12).astype(kind).reshape(3, 4)
    out = np.zeros_like(x)
    _turn_round(x, out)
    np.testing.assert_array_equal(out.ravel(), x.ravel()[::-1])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_spans_begin_anywhere(kind):
    """Differential: a row moved by one element, in pieces of eight."""
    x = np.arange(43).astype(kind)
    out = np.zeros_like(x)
    _shift(x, out)
    np.testing.assert_array_equal(out[3:35], x[4:36])
    assert not out[:3].any()
    assert not out[35:].any()


def test_aligned_arrays_begin_on_a_cache_line():
    """Invariant: for all shapes; writable, zero, in C order."""
    for shape in ((1, LANES), (3, 7), (1000, LANES), (0, LANES)):
        values = aligned_zeros(shape, np.float32)
        assert values.ctypes.data % 64 == 0 or values.size == 0
        assert values.shape == shape
        assert values.flags.c_contiguous
        assert not values.any()
        values[...] = 1.0
