"""Potentials of sources and at points, many at a time, against numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.field.green_kernels import point_potentials, source_potentials

Array = np.ndarray


def potentials(points: Array, sources: Array, floor: float, least: float) -> Array:
    """Bounded 1/r of unit charges (3, s) less that of their images in the floor."""
    s = sources.T.astype(float)
    image = s * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * floor]
    direct = np.linalg.norm(points[..., None, :] - s, axis=-1)
    return 1 / np.maximum(direct, least) - 1 / np.linalg.norm(points[..., None, :] - image, axis=-1)


@pytest.mark.parametrize("count", [1, 2, 5, 24, 57])
def test_potentials_of_sources(count: int) -> None:
    """Differential: means over four points, to single precision."""
    points, sources = random_points(count)
    out = np.empty((count, 48), np.float32)
    source_potentials(points, sources, np.float32(-0.01), np.float32(1e-3), out)
    wanted = potentials(points.astype(float), sources, -0.01, 1e-3)
    np.testing.assert_allclose(out, wanted.mean(axis=1), rtol=3e-6, atol=3e-6 * out.max())
    assert out[0, 5] == approx(wanted[0, :, 5].mean(), rel=1e-5)


@pytest.mark.parametrize("columns", [8, 24])
@pytest.mark.parametrize("count", [16, 48])
def test_potentials_at_points(count: int, columns: int) -> None:
    """Differential: of any number of columns of charges, to single precision."""
    points, sources = random_points(count)
    table = np.random.default_rng(columns).normal(size=(48, columns)).astype(np.float32)
    out = np.full((columns, count), np.float32(math.nan))
    limits = np.float32(-0.01), np.float32(1e-3)
    point_potentials(np.ascontiguousarray(points[:, 0].T), sources, table, limits, out)
    wanted = potentials(points[:, 0].astype(float), sources, -0.01, 1e-3) @ table
    np.testing.assert_allclose(out.T, wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())


def random_points(count: int) -> tuple[Array, Array]:
    """Points (k, 4, 3), one of which is within the bound of a source, and sources (3, 48)."""
    rng = np.random.default_rng(count)
    points = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2], (count, 4, 3)).astype(np.float32)
    sources = rng.uniform([-0.1, -0.1, -5e-3], [0.1, 0.1, 0.0], (48, 3)).T.astype(np.float32)
    points[0, 0] = sources[:, 5] + np.float32(1e-5)
    return points, np.ascontiguousarray(sources)


def test_potential_of_a_source_in_the_floor_is_none() -> None:
    """Analytic: a charge and its image cancel."""
    points = np.random.default_rng(1).uniform(0.02, 0.1, (3, 4, 3)).astype(np.float32)
    sources = np.repeat(np.array([[0.0], [0.0], [-0.01]], np.float32), 16, axis=1)
    out = np.empty((3, 16), np.float32)
    source_potentials(points, sources, np.float32(-0.01), np.float32(1e-3), out)
    np.testing.assert_allclose(out, 0.0, atol=1e-5)
