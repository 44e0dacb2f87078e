"""Whether electrodes lie in bodies: the quick answer against all points, one by one."""

from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
from approximate import approx

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


@pytest.mark.parametrize("opened", [False, True])
def test_surfaces_that_change_meet_what_rigid_ones_do(opened: bool) -> None:
    """Differential: of their triangles, those over and under the sheets tell as much as all."""
    ball, sheets, rng, met = (
        cs.Sphere(0.02).to_trimesh(),
        Sheets(PADS),
        np.random.default_rng(5),
        [],
    )
    stretched = ball.vertices * [1.0, 2.0, 0.5]
    faces = ball.faces[ball.vertices[ball.faces][:, :, 1].max(axis=1) < 0.017] if opened else (
        ball.faces)  # fmt: skip
    soft = cs.DeformableSurface(ball.vertices, faces)
    rigid = cs.TriMesh(stretched, faces)
    for _ in range(150):
        place = cs.Pose(rng.uniform(-0.05, 0.05, 3), rng.normal(size=4))
        changing = soft.update(stretched, place)
        for conducting in (False, True):
            expected = sheets.meet(cs.Body(rigid, place, "steel"), conducting)
            assert sheets.meet(changing, conducting) == expected
            met.append(expected)
    assert 20 < sum(met) < 280


@pytest.mark.parametrize(
    ("height", "words"),
    [
        (-0.005, r"electrodes '.*' lie inside 'bar', up to 5 mm deep, and readings mean nothing"),
        (2e-5, r"electrodes '.*' touch 'bar' and readings mean nothing until this ends; keep bod"),
        (0.001, None),
    ],
)
def test_a_simulator_warns_once_of_a_body_in_its_electrodes(
    height: float, words: str | None
) -> None:
    """It names electrodes and body, of a step, and of a batch."""
    place = cs.Pose((0, 0, height + 0.01))
    scene = cs.Scene([cs.Body(cs.Box((0.1, 0.1, 0.02)), place, "steel", name="bar")])
    for call in (lambda sim: sim.step(scene), lambda sim: sim.step_batch([scene, scene])):
        sim = cs.Simulator("six_patch_bare")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call(sim)
            call(sim)
        told = [str(w.message) for w in caught]
        assert len(told) == (words is not None)
        assert all(re.match(words or "", text) for text in told), told
    if words is not None:
        unnamed = cs.Scene([cs.Body(cs.Box((0.1, 0.1, 0.02)), place, "steel")])
        with pytest.warns(UserWarning, match=r"'bodies\[0\]'"):
            cs.Simulator("six_patch_bare").step(unnamed)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize(
    ("gap", "touched", "inside"),
    [(0.01, False, False), (3e-4, False, False), (1e-4, True, False), (0.0, True, False),
     (-1e-4, True, False), (-3e-4, True, True), (-0.005, True, True)],
)  # fmt: skip
def test_conductors_touch_and_all_matter_surrounds(
    side: int, mesh: bool, gap: float, touched: bool, inside: bool
) -> None:
    """Analytic: a wide plate above or below both sheets; 0.2 mm count as nothing."""
    plate = cs.Box((0.2, 0.2, 0.02))
    shape = cs.TriMesh(plate.to_trimesh().vertices, plate.to_trimesh().faces) if mesh else plate
    face = 0.002 if side > 0 else 0.0
    body = cs.Body(shape, cs.Pose((0.01, 0.0, face + side * (gap + 0.01))))
    assert Sheets(PADS).meet(body, conducting=True) is touched
    assert Sheets(PADS).meet(body, conducting=False) is inside


def open_box(side: float) -> cs.TriMesh:
    """A cube about the origin without its lid, the face at the top."""
    mesh = cs.Box((side, side, side)).to_trimesh()
    return cs.TriMesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] < 0.5])


def test_an_open_box_holds_what_its_lid_would_close() -> None:
    """Analytic: less than half of the directions leave through the opening, below its plane only.

    Distances are those from the five faces, and do not depend on the pose.
    """
    half = 0.01
    place = cs.Pose((0.1, -0.2, 0.3), (0.3, -0.1, 0.5, 0.8))
    body = cs.Body(open_box(2 * half), place, "steel")
    rng = np.random.default_rng(3)
    points = rng.uniform(-2 * half, 2 * half, (150, 3))
    held = (np.abs(points) < half).all(axis=1)
    sides = [cs.Box((2 * half, 2 * half, 1e-12)), cs.Box((2 * half, 1e-12, 2 * half))]
    near = np.full(len(points), np.inf)
    for axis, sign in ((2, -1), (1, -1), (1, 1), (0, -1), (0, 1)):
        moved = points.copy()
        moved[:, axis] -= sign * half
        turned = moved[:, [1, 0, 2]] if axis == 0 else moved
        near = np.minimum(near, np.abs(sides[axis != 2].signed_distance(turned)))
    found = np.concatenate([distances(body, place.apply(p[None])) for p in points])
    assert 10 < held.sum() < 50
    np.testing.assert_array_equal(found < 0, held)
    np.testing.assert_allclose(np.abs(found), near, atol=1e-8)
    below = points[:, 2] < 0
    together = distances(body, place.apply(points[below]))
    np.testing.assert_allclose(together, found[below], atol=1e-12)


@pytest.mark.parametrize("count", [10, 100])
def test_points_on_sheets_are_spread_by_area(count: int) -> None:
    """Analytic: all corners, and a mean near the centroid of two triangles of unequal size."""
    corners = np.concatenate([CORNERS, 0.2 * CORNERS + [0.1, 0.0, 0.0]])
    points = points_on(corners, count)
    size = np.array([1.0, 0.04])
    spread = points[-count:]
    second = spread[:, 0] > 0.05
    assert second.sum() == approx(count * size[1] / size.sum(), abs=1)
    inner = spread[~second]
    for x in (inner[:, 0], 0.03 - inner[:, 1], 0.03 - inner[:, 0] + inner[:, 1]):
        assert (x >= -1e-12).all()
    np.testing.assert_allclose(inner.mean(axis=0), CORNERS[0].mean(axis=0), atol=0.04 / count**0.5)
    gaps = np.linalg.norm(inner[:, None] - inner, axis=2) + np.eye(len(inner))
    assert gaps.min() > 0.2 * 0.03 / count**0.5
    apart = np.linalg.norm(points[:, None] - corners.reshape(-1, 3), axis=2).min(axis=0)
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)
