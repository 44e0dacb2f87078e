"""Materials of the pixels of depth frames, against a loop over all of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from capsense.scene.image_kernels import MAX_GROUPS, sort_pixels

Array = np.ndarray
NEAR, FAR, CONDUCTOR = 0.1, 0.9, 1000.0


def frame(seed: int, shared: tuple[int, ...] = ()) -> tuple[Array, Array]:
    """Depths and permittivities, these of length one along some axes."""
    rng = np.random.default_rng(seed)
    shape = (2, 5, 4)
    depth = rng.uniform(-0.1, 1.1, shape)
    depth[0, 0, :2] = NEAR, FAR
    depth[rng.random(shape) < 0.1] = math.nan
    size = [1 if axis in shared else n for axis, n in enumerate(shape)]
    eps_r = rng.choice([0.0, 1.0, 3.0, 80.0, 2000.0, math.inf], size)
    return depth, eps_r


def slowly(depth: Array, eps_r: Array) -> tuple[Array, list[float]]:
    """Numbers of the materials, and their permittivities."""
    known: list[float] = []
    group = np.full(depth.shape, -1)
    for at in np.ndindex(depth.shape):
        e = float(np.broadcast_to(eps_r, depth.shape)[at])
        if not NEAR < depth[at] < FAR or e in (0.0, 1.0):
            continue
        e = math.inf if e >= CONDUCTOR else e
        if e not in known:
            known.append(e)
        group[at] = known.index(e)
    return group, known


@pytest.mark.parametrize("shared", [(), (0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2)])
def test_materials_are_numbered_as_they_appear(shared: tuple[int, ...]) -> None:
    """Differential: from near to far, and along any axis that permittivities share."""
    met = 0
    for seed in range(10):
        depth, eps_r = frame(seed, shared)
        group, known = np.full(depth.shape, 99, np.int8), np.zeros(MAX_GROUPS)
        count = sort_pixels(depth, eps_r, NEAR, FAR, CONDUCTOR, group, known)
        expected, materials = slowly(depth, eps_r)
        np.testing.assert_array_equal(group, expected)
        assert known[:count].tolist() == materials
        met += count
    assert met > 0


@pytest.mark.parametrize("value", [0.5, -3.0, math.nan])
@pytest.mark.parametrize("at", [(0, 0, 0), (0, 3, 1), (1, 4, 3), (1, 0, 2)])
def test_a_permittivity_that_is_none_is_found(value: float, at: tuple[int, int, int]) -> None:
    """Analytic: the number of the first such pixel, unless it shows nothing."""
    depth, eps_r = np.full((2, 5, 4), 0.5), np.full((2, 5, 4), 3.0)
    eps_r[at] = eps_r[1, 4, 3] = value
    group, known = np.empty(depth.shape, np.int8), np.zeros(MAX_GROUPS)
    flat = int(np.ravel_multi_index(at, depth.shape))
    assert sort_pixels(depth, eps_r, NEAR, FAR, CONDUCTOR, group, known) == -2 - flat
    depth[at] = depth[1, 4, 3] = FAR
    assert sort_pixels(depth, eps_r, NEAR, FAR, CONDUCTOR, group, known) == 1


@pytest.mark.parametrize("most", [1, 3])
def test_too_many_materials(most: int) -> None:
    """Analytic: as many as there is room for, and not one more."""
    depth, known = np.full((1, 1, most + 1), 0.5), np.zeros(most)
    group = np.empty(depth.shape, np.int8)
    eps_r = np.arange(2.0, most + 3.0).reshape(depth.shape)
    assert sort_pixels(depth, eps_r, NEAR, FAR, CONDUCTOR, group, known) == -1
    eps_r[..., -1] = eps_r[..., 0]
    assert sort_pixels(depth, eps_r, NEAR, FAR, CONDUCTOR, group, known) == most
