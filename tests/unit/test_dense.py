"""Products and factors of dense matrices, against numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from capsense._dense import (
    add_products,
    cholesky,
    mirror,
    multiply,
    multiply_simd,
    square,
    substitute,
    subtract_product,
    whole_lines,
)


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5, 7, 8, 61])
@pytest.mark.parametrize("width", [32, 96])
def test_multiply(rows: int, width: int) -> None:
    """Differential: with any number of rows; nothing beside the result is written."""
    rng = np.random.default_rng(rows)
    left = rng.normal(size=(rows, 45)).astype(np.float32)
    table = rng.normal(size=(45, width)).astype(np.float32)
    room = np.full((rows + 2, width), np.float32(7.0))
    multiply(left, table, room[1:-1])
    np.testing.assert_allclose(room[1:-1], left.astype(float) @ table, rtol=0, atol=2e-5)
    assert (room[[0, -1]] == 7.0).all()


@pytest.mark.parametrize("rows", [4, 12])
@pytest.mark.parametrize("width", [8, 24])
def test_multiply_lanes(rows: int, width: int) -> None:
    """Differential: narrow tables."""
    rng = np.random.default_rng(rows)
    left = rng.normal(size=(rows, 45)).astype(np.float32)
    table = rng.normal(size=(45, width)).astype(np.float32)
    room = np.full((rows + 2, width), np.float32(7.0))
    multiply_simd(left, table, room[1:-1])
    np.testing.assert_allclose(room[1:-1], left.astype(float) @ table, rtol=0, atol=2e-5)
    assert (room[[0, -1]] == 7.0).all()


@pytest.mark.parametrize("n", [1, 3, 4, 15, 16, 17, 50])
def test_products_of_rows_and_their_squares(n: int) -> None:
    """Differential: any length of a row for products, multiples of eight for squares."""
    rng = np.random.default_rng(n)
    left, right = rng.normal(size=(5, n)), rng.normal(size=(n, 16))
    before = rng.normal(size=(7, 16))
    out = before.copy()
    for f in range(5):
        subtract_product(left, f, right, out, f + 1)
    np.testing.assert_allclose(out[1:-1], before[1:-1] - left @ right, rtol=0, atol=1e-12 * n)
    np.testing.assert_array_equal(out[[0, -1]], before[[0, -1]])
    rows = rng.normal(size=(3, 8 * n)).astype(np.float32)
    found = [square(rows, f) for f in range(3)]
    np.testing.assert_allclose(found, (rows.astype(float) ** 2).sum(axis=1), rtol=1e-5)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 40])
def test_matrices_are_mirrored(n: int) -> None:
    """Invariant: what is not above the diagonal stays, the rest follows from it."""
    matrix = np.random.default_rng(n).normal(size=(n, n))
    wanted = np.tril(matrix) + np.tril(matrix, -1).T
    mirror(matrix)
    np.testing.assert_array_equal(matrix, wanted)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 9, 31, 66])
def test_cholesky_and_substitute(n: int) -> None:
    """Differential: factor and solution; what is below the diagonal counts for nothing."""
    rng = np.random.default_rng(n)
    half = rng.normal(size=(n, n))
    matrix = half @ half.T + 0.1 * np.eye(n)
    work = np.full((n, whole_lines(n)), math.nan)
    work[:, :n] = np.triu(matrix) + np.tril(work[:, :n], -1)
    assert cholesky(work)
    found = np.triu(work[:, :n])
    np.testing.assert_allclose(found.T, np.linalg.cholesky(matrix), rtol=0, atol=1e-11 * n)
    sides = rng.normal(size=(n, 16))
    found = sides.copy()
    substitute(work, found)
    wanted = np.linalg.solve(matrix, sides)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("n", [1, 3, 4, 6, 17])
def test_cholesky_finds_out_what_is_not_definite(n: int) -> None:
    """Analytic: one eigenvalue below zero, wherever it shows; nothing, and what is no number."""
    rng = np.random.default_rng(n)
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    for k in range(n):
        size = np.ones(n)
        size[k] = -0.01
        work = np.zeros((n, whole_lines(n)))
        work[:, :n] = (axes * size) @ axes.T
        assert not cholesky(work)
        for low in (-1.0, 0.0, math.nan):
            work = np.eye(n, whole_lines(n))
            work[k, k] = low
            assert not cholesky(work)


@pytest.mark.parametrize("m", [8, 16, 24])
def test_products_of_wide_matrices(m: int) -> None:
    """Differential: designs of more than eight terminals, eight columns at a time."""
    left, right = np.random.default_rng(m).normal(size=(2, 5, m))
    out = np.ones((m, m))
    add_products(left, right, out)
    np.testing.assert_allclose(out, 1.0 + left.T @ right, rtol=1e-13, atol=1e-13)
