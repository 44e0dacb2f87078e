"""Facets, boxes and domains by themselves: places against closed forms and dense sampling."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from approximate import approx
from scipy.spatial.transform import Rotation

from capsense.design.geometry import TOUCH, Facet, Surface, box_facets, enters_box, find_contact
from capsense.design.model import Domain, Layer

LOWER, UPPER = np.array([-0.01, -0.02, 0.01]), np.array([0.03, 0.02, 0.02])


def sheet(center: tuple[float, float, float], turn: Rotation, size: tuple[float, float]) -> Facet:
    outline = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
    return Facet(outline, np.array(center), turn.as_matrix().T)


def enters(facet: Facet) -> bool:
    return enters_box(Surface((facet,), np.empty((0, 2, 3))), LOWER, UPPER)


def test_faces_of_a_box_bound_it() -> None:
    """Analytic: corners, outward normals, and the volume by the divergence theorem."""
    faces = box_facets(LOWER, UPPER)
    box = Surface(faces, np.empty((0, 2, 3)))
    np.testing.assert_allclose(box.bounds, [LOWER, UPPER], atol=1e-15)
    flux = sum(f.polygon.area * (f.axes[2] @ f.origin) for f in faces)
    assert flux / 3 == approx(np.prod(UPPER - LOWER))
    assert all(np.linalg.det(f.axes) == approx(1.0) for f in faces)


def test_a_sheet_on_a_face_is_not_inside() -> None:
    """Limits: on each face, and ten times the tolerance within it."""
    middle = (LOWER + UPPER) / 2
    for axis in range(3):
        turn = Rotation.from_rotvec([[0, np.pi / 2, 0], [np.pi / 2, 0, 0], [0, 0, 0]][axis])
        for level, way in ((LOWER, 1.0), (UPPER, -1.0)):
            for depth, wanted in ((0.0, False), (10 * TOUCH, True)):
                center = middle.copy()
                center[axis] = level[axis] + way * depth
                assert enters(sheet(tuple(center), turn, (0.002, 0.002))) == wanted


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("over", [False, True])
@pytest.mark.parametrize("gap", [-20.0, -0.9, 0.0, 0.5, 0.9, 1.1, 20.0])
def test_a_corner_touches_a_sheet_within_the_tolerance(side: float, over: bool, gap: float) -> None:
    """Limits: from above and from below, whichever way the sheet faces; gaps in tolerances."""
    flat = Rotation.from_rotvec([np.pi, 0, 0]) if over else Rotation.identity()
    plate = sheet((0.0, 0.0, 0.0), flat, (0.02, 0.02))
    height = side * (0.005 * 2**0.5 + gap * TOUCH)
    turn = Rotation.from_euler("xy", [90.0, 45.0], degrees=True)
    mark = sheet((0.001, 0.002, height), turn, (0.01, 0.01))
    lowest = mark.to_sensor(np.asarray(mark.polygon.exterior.coords)[:-1])
    assert (side * lowest[:, 2]).min() == approx(gap * TOUCH, abs=1e-12)
    one, other = (Surface((f,), np.empty((0, 2, 3))) for f in (plate, mark))
    for pair in ((one, other), (other, one)):
        point = find_contact(*pair)
        assert (point is not None) == (gap < 1)
        if point is not None:
            np.testing.assert_allclose(point, [0.001, 0.002, 0.0], atol=2.5 * 20 * TOUCH)


def test_sheets_that_enter_a_box_agree_with_dense_sampling() -> None:
    """Differential: sheets of random places and turns, with a hole, point by point."""
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 81)] * 2), axis=-1).reshape(-1, 2)
    seen = [0, 0]
    for turn in Rotation.random(300, random_state=rng):
        size = rng.uniform(0.01, 0.06, 2)
        facet = sheet(tuple(rng.uniform(-0.05, 0.06, 3)), turn, tuple(size))
        hole = shapely.box(*(-0.3 * size), *(0.3 * size))
        facet = Facet(facet.polygon.difference(hole), facet.origin, facet.axes)
        uv = grid * size
        points = facet.to_sensor(uv[(np.abs(uv) >= 0.3 * size).any(axis=1)])
        depth = float(np.minimum(points - LOWER, UPPER - points).min(axis=1).max())
        if abs(depth) < 0.001:
            continue  # sampling does not tell
        assert enters(facet) == (depth > 0)
        seen[depth > 0] += 1
    assert min(seen) > 30


def test_what_a_layer_contains() -> None:
    """Limits: open on all faces; each point by itself."""
    layer = Layer("l", "FR4", 4.5, LOWER, UPPER)
    middle = (LOWER + UPPER) / 2
    points = [middle]
    for axis in range(3):
        for level, way in ((LOWER, 1.0), (UPPER, -1.0)):
            for depth in (-1e-6, 0.0, 1e-6):
                points.append(middle.copy())
                points[-1][axis] = level[axis] + way * depth
    wanted = [True] + 6 * [False, False, True]
    assert layer.contains(np.array(points)).tolist() == wanted


def test_the_ground_of_an_open_domain_is_far_below() -> None:
    """Invariant: it goes with the size, many sizes down; of a closed one it is the box's floor."""
    low, wide = (Domain((s, 0.2 * s, 0.1 * s), 0.01, open=True).floor for s in (0.1, 0.5))
    assert wide == approx(5 * low)
    assert low < -1000 * 0.1
    assert Domain((0.5, 0.5, 0.5), 0.01).floor == -0.01
