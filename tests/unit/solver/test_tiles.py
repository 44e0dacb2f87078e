"""Tiles of boxes: the smaller, the nearer they are to an edge."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx

from capsense.solver.bodies.grids import box_tiles
from capsense.solver.bodies.panels import polygon_panels

SIZES = [(1.0, 1.0, 1.0), (0.6, 0.6, 0.1), (0.3, 0.6, 0.05), (1.0, 0.8, 0.03), (0.2, 0.2, 2.0)]


@pytest.mark.parametrize("size", SIZES, ids=repr)
def test_tiles_cover_a_box(size):
    """Analytic: area, volume and first moments; none overlap."""
    panels = polygon_panels(box_tiles(size, 2000).polygons())
    x, y, z = size
    assert panels.areas.sum() == approx(2 * (x * y + y * z + x * z), rel=1e-12)
    outward = (panels.areas[:, None] * panels.normals).T @ panels.centers
    np.testing.assert_allclose(outward, x * y * z * np.eye(3), atol=1e-12)
    assert np.abs(panels.centers).max(axis=0) == approx(np.array(size) / 2)
    for axis, sign in ((a, s) for a in range(3) for s in (-1, 1)):
        face = panels.normals[:, axis] * sign > 0.5
        low, high = (f(panels.corners[face], axis=1) for f in (np.min, np.max))
        for k in np.flatnonzero(face)[::97]:
            inside = ((low < panels.centers[k]) & (high > panels.centers[k])).sum(axis=1)
            assert (inside == 2).sum() == 1  # the third axis is that of the face


@pytest.mark.parametrize("size", SIZES, ids=repr)
@pytest.mark.parametrize(("count", "least"), [(500, 200), (2000, 1500)])
def test_sides_of_tiles(size, count, least):
    """Unit: about so many as asked for; each about as long as is said, and short at edges."""
    tiles = box_tiles(size, count)
    panels = polygon_panels(tiles.polygons())
    assert least < len(panels) <= count
    ratio = np.ptp(panels.corners, axis=1).max(axis=1) / tiles.side(panels.centers)
    assert ratio.max() <= 1.42 + 1e-9
    assert ratio.min() > 0.6
    assert tiles.least < 0.35 * tiles.most
