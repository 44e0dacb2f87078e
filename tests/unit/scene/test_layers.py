"""Layered depth images: sorting, what they enclose, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from layered_views import stretch, unite, view

from capsense.errors import SceneError
from capsense.scene import Body, Box, Capsule, Layers, Pose, Scene, ShapeKind, Sphere

BLOCK = np.full((4, 6), 0.1), np.full((4, 6), 0.2), (0.06, 0.04)


@pytest.mark.parametrize("layers", [1, 2, 6])
def test_slots_are_sorted_and_disjoint(layers):
    """Differential: against sorting in Python, every pixel, for random overlaps and holes."""
    rng = np.random.default_rng(layers)
    front = rng.uniform(0, 1, (layers, 9, 7)).astype(np.float32)
    back = front + rng.uniform(-0.1, 0.3, front.shape).astype(np.float32)
    front[rng.random(front.shape) < 0.3] = np.nan
    back[rng.random(front.shape) < 0.1] = np.inf
    shape = Layers(front, back, (0.7, 0.9))
    most = 0
    for j, i in np.ndindex(9, 7):
        ends = zip(front[:, j, i], back[:, j, i], strict=True)
        expected = unite([(p, q) for p, q in ends if p < q and np.isfinite(q)])
        n, most = len(expected), max(most, len(expected))
        found = np.column_stack([shape.front[:, j, i], shape.back[:, j, i]])
        np.testing.assert_array_equal(found[:n], np.reshape(expected, (-1, 2)))
        assert np.isnan(found[n:]).all()
        assert shape.hit[:, j, i].sum() == n
    assert shape.front.shape == shape.back.shape == (most, 9, 7)
    assert shape.resolution == (9, 7)
    assert shape.front.dtype == np.float32


def test_sorting_again_changes_nothing():
    """Invariant: to the last bit, also of what touches in single precision only."""
    rng = np.random.default_rng(0)
    front = rng.uniform(0, 1, (5, 6, 6))
    front[1] = front[0] + 0.1 + 1e-12
    shape = Layers(front, front + 0.1, (1, 1))
    again = Layers(shape.front, shape.back, shape.size)
    assert again.front.tobytes() == shape.front.tobytes()
    assert again.back.tobytes() == shape.back.tobytes()
    np.testing.assert_array_equal(again.bounds(), shape.bounds())


def test_a_full_image_is_a_block():
    """Analytic: bounds, volume, size in a scene, and the blocks that are drawn."""
    shape, box = Layers(*BLOCK), Box((0.06, 0.04, 0.1))
    np.testing.assert_allclose(shape.bounds(), box.bounds() + np.array([0, 0, 0.15]), atol=1e-8)
    np.testing.assert_allclose(shape.params, box.params, atol=1e-8)
    assert shape.volume == approx(box.volume, rel=1e-6)
    assert shape.pixel == approx((0.01, 0.01))
    mesh = shape.to_trimesh()
    assert mesh.volume == approx(box.volume, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds, shape.bounds(), atol=1e-8)


def test_bounds_enclose_what_is_hit_and_no_more():
    """Analytic: pixels of different slots, in the corners of their squares."""
    front = np.full((2, 5, 6), np.nan)
    front[0, 1, 2], front[1, 1, 2], front[0, 3, 4] = 0.3, 0.1, 0.2
    shape = Layers(front, front + 0.05, (0.6, 0.5))
    np.testing.assert_allclose(shape.bounds(), [[-0.1, -0.15, 0.1], [0.2, 0.15, 0.35]], atol=1e-7)
    np.testing.assert_allclose(shape.to_trimesh().bounds, shape.bounds(), atol=1e-7)


def test_points_inside_are_those_of_the_blocks():
    """Differential: the sign against every interval of a point's pixel; exact values on one."""
    rng = np.random.default_rng(4)
    front = rng.uniform(0, 0.2, (3, 15, 11))
    back = front + rng.uniform(-0.02, 0.08, front.shape)
    shape = Layers(front, back, (0.11, 0.15))
    p = rng.uniform(-0.08, 0.3, (20_000, 3)) * (1, 1, 0.7)
    column, row = np.floor((p[:, :2] + (0.055, 0.075)) / 0.01).astype(int).T
    inside = np.zeros(len(p), bool)
    for n in np.flatnonzero((column >= 0) & (column < 11) & (row >= 0) & (row < 15)):
        at = (slice(None), row[n], column[n])
        inside[n] = ((front[at] < p[n, 2]) & (p[n, 2] < back[at])).any()
    found = shape.signed_distance(p)
    assert inside.sum() > 100
    np.testing.assert_array_equal(found < 0, inside)
    low, high = shape.bounds()
    assert np.all((p[inside] >= low) & (p[inside] <= high))
    on_block = Layers(*BLOCK).signed_distance([(0, 0, 0.13), (0, 0, 0.0), (0, 0, 0.3), (1, 0, 0)])
    np.testing.assert_allclose(on_block, [-0.03, 0.1, 0.1, np.inf], atol=1e-7)
    with pytest.raises(SceneError, match=r"give \(n, 3\)"):
        shape.signed_distance((0, 0, 0))


@pytest.mark.parametrize("name", ["sphere", "capsule", "box"])
def test_volumes_converge(name):
    """Analytic: of solids seen at 128 pixels; measured 0.2 % and better."""
    shape, pose = {
        "sphere": (Sphere(0.06), Pose((0.004, 0.003, 0.15))),
        "capsule": (Capsule(0.04, 0.1), Pose.from_euler((0, 0, 0.15), (0.4, 1.2, 0.3))),
        "box": (Box((0.12, 0.1, 0.06)), Pose.from_euler((0, 0, 0.15), (0.5, 0.4, 0.3))),
    }[name]
    layers = Layers(*view(shape, pose, 128, 0.3), (0.3, 0.3))
    assert layers.volume == approx(shape.volume, rel=5e-3)
    low, high = layers.bounds()
    points = pose.apply(shape.to_trimesh().vertices)
    assert np.all(np.abs(low - points.min(axis=0)) < 0.006)
    assert np.all(np.abs(high - points.max(axis=0)) < 0.006)


def test_the_views_of_the_tests_are_right():
    """Analytic: the helper's lines through a ball and along a box."""
    o = np.array([[0.0, 0.3, -1.0], [0.0, 0.51, 0.0], [0.1, 0.0, 7.0]])
    d = np.tile([0.0, 0.0, 1.0], (3, 1))
    found = np.array(stretch(Sphere(0.5), o, d)).T
    half = np.sqrt(0.25 - 0.01)
    expected = [[0.6, 1.4], [np.nan, np.nan], [-7 - half, -7 + half]]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    low, high = stretch(Box((1, 2, 3)), np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose([low[0], high[0]], [-1, 1], atol=1e-9)


def test_a_layered_body_in_a_scene():
    """Invariant: packing gives the bounding box of the turned image, and its own kind."""
    layers = Layers(*BLOCK)
    pose = Pose.from_euler((0.1, 0.2, 0.3), (0.3, 0.4, 0.5))
    packed = Scene([Body(layers, pose, "steel")]).pack()
    assert packed.kinds[0] == ShapeKind.LAYERS
    low, high = layers.bounds()
    corners = [[(low, high)[k][0], (low, high)[j][1], (low, high)[i][2]]
               for k in (0, 1) for j in (0, 1) for i in (0, 1)]  # fmt: skip
    turned = pose.apply(corners)
    np.testing.assert_allclose(packed.bounds[0], [turned.min(axis=0), turned.max(axis=0)])


def test_layers_do_not_change():
    shape = Layers(*BLOCK)
    for values in (shape.front, shape.back):
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(4), np.ones(4), (1, 1)), r"front has shape \(4,\)"),
        ((np.zeros((2, 3)), np.ones((3, 2)), (1, 1)), "back has shape"),
        ((np.zeros((2, 2)), np.ones((2, 2)), (1, -1)), "size is"),
        ((np.zeros((2, 2)), np.ones((2, 2)), (0, 1)), "size is"),
        ((np.zeros((2, 2)), np.ones((2, 2)), (1, np.nan)), "size is"),
        ((np.full((2, 2), np.nan), np.ones((2, 2)), (1, 1)), "no pixel holds an interval"),
        ((np.ones((2, 2)), np.zeros((2, 2)), (1, 1)), "no pixel holds an interval"),
        ((np.zeros((2, 2)), np.full((2, 2), np.inf), (1, 1)), "no pixel holds an interval"),
    ],
)
def test_bad_layers_are_refused(arguments, message):
    with pytest.raises(SceneError, match=message):
        Layers(*arguments)
