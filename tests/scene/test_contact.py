"""Whether electrodes lie in bodies: the quick answer against all points, one by one."""

from __future__ import annotations

import numpy as np
import pytest

import capsense as cs
from capsense.scene.contact import TOUCH, Sheets, distances, points_on

CORNERS = np.array([[[0, 0, 0], [0.03, 0, 0], [0.03, 0.03, 0]]], float)
PADS = [CORNERS - np.array([0.035, 0, 0]), CORNERS + np.array([0.005, -0.01, 0.002])]


@pytest.mark.parametrize("shape", [cs.Sphere(0.02), cs.Box((0.03, 0.03, 0.015)), "mesh"])
def test_sheets_meet_what_their_points_meet(shape: cs.Shape | str) -> None:
    """Differential: bodies on their way past the sheets, far, near, touching and around them."""
    if isinstance(shape, str):
        ball = cs.Sphere(0.02).to_trimesh()
        shape = cs.TriMesh(ball.vertices, ball.faces)
    sheets, points = Sheets(PADS), np.concatenate([points_on(pad) for pad in PADS])
    rng = np.random.default_rng(4)
    met = []
    for _ in range(60):
        place = cs.Pose(rng.uniform(-0.05, 0.05, 3), rng.normal(size=4))
        body = cs.Body(shape, place, "steel")
        off = distances(body, points)
        if abs(off.min() + TOUCH) > 1e-5:
            expected = off.min() < -TOUCH
            assert sheets.meet(body, conducting=False) == expected
            met.append(expected)
    assert 5 < sum(met) < 55
