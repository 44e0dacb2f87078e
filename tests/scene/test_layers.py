"""Layered depth images: kernels against the slow twin, convergence to exact shapes, invariants."""

from __future__ import annotations

import numpy as np
import pytest
from layered_views import fields_around, view

from capsense.errors import SceneError
from capsense.scene import Box, Capsule, Layers, Pose, Scene, ShapeKind, Sphere
from capsense.scene.body import Body
from capsense.scene.layer_build import build_values, sort_slots
from capsense.scene.layer_kernels import layer_inside
from capsense.scene.layer_parts import add_stretch
from capsense.scene.layer_reference import ReferenceLayers, unite

SOLIDS = {
    "sphere": (Sphere(0.06), Pose((0.004, 0.003, 0.15))),
    "capsule": (Capsule(0.04, 0.1), Pose.from_euler((0.004, 0.003, 0.15), (0.4, 1.2, 0.3))),
    "tilted box": (Box((0.12, 0.1, 0.06)), Pose.from_euler((0.004, 0.003, 0.15), (0.5, 0.4, 0.3))),
    "box": (Box((0.12, 0.1, 0.06)), Pose((0.004, 0.003, 0.15))),
}


def random_layers(rng, layers, rows, columns, smooth):
    """Fronts and backs with holes, steps and overlaps; smooth ones without steps."""
    size = (0.1 * columns / 10, 0.07 * rows / 10)
    shape = (layers, rows, columns)
    if smooth:
        x = np.linspace(0, 1, columns)[None, None, :]
        y = np.linspace(0, 1, rows)[None, :, None]
        wave = rng.uniform(0.005, 0.01) * np.sin(3 * x + 2 * y + np.arange(layers)[:, None, None])
        front = 0.05 + 0.06 * np.arange(layers)[:, None, None] + wave
        back = front + 0.03 + 0.5 * wave
    else:
        front = rng.uniform(0.0, 0.2, shape)
        back = front + rng.uniform(-0.02, 0.08, shape)
    front = np.where(rng.random(shape) < rng.uniform(0, 0.5), np.nan, front)
    return front, back, size


def random_lines(rng, n):
    """Lines along axes and in any direction."""
    o = rng.uniform(-0.06, 0.06, (n, 3)) + np.array([0, 0, 0.1])
    d = rng.normal(size=(n, 3)) * rng.choice([0.05, 1.0], (n, 1))
    axis = rng.integers(0, 3, n)
    straight = rng.random(n) < 0.5
    d[straight] = np.eye(3)[axis[straight]] * rng.choice([-2.0, 1.0], (straight.sum(), 1))
    return o, d


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("layers", [1, 3])
def test_lines_match_the_slow_twin(layers, smooth):
    """Differential: every stretch of random lines through random images, all three steps of it:
    silhouettes and margins, surfaces, crossings."""
    compared = 0
    for seed in range(6):
        rng = np.random.default_rng([seed, layers, smooth])
        rows, columns = rng.integers(1, 20, 2)
        front, back, size = random_layers(rng, layers, rows, columns, smooth)
        if not (front < back).any():
            continue
        shape = Layers(front, back, size)
        slow = ReferenceLayers(front, back, size)
        o, d = random_lines(rng, 60)
        shape.__class__.max_intervals, kept = 64, shape.max_intervals
        try:
            found = shape.line_intervals(o, d)
        finally:
            shape.__class__.max_intervals = kept
        for i in range(len(o)):
            expected = slow.stretches(o[i], d[i])
            scale = 1.0 / np.linalg.norm(d[i])
            got = [tuple(row) for row in found[i] if row[0] <= row[1]]
            got = unite([(a - 1e-8 * scale, b + 1e-8 * scale) for a, b in got])
            expected = unite([(a - 1e-8 * scale, b + 1e-8 * scale) for a, b in expected])
            long = [s for s in expected if s[1] - s[0] > 1e-6 * scale]
            got = [s for s in got if s[1] - s[0] > 1e-6 * scale]
            np.testing.assert_allclose(got, long, atol=2e-6 * scale)
            compared += len(long)
    assert compared > 100


@pytest.mark.parametrize("smooth", [False, True])
def test_fields_match_the_slow_twin(smooth):
    """Differential: front, back and margin at every pixel, with and without known outlines."""
    for seed in range(12):
        rng = np.random.default_rng([7, seed, smooth])
        rows, columns = rng.integers(1, 14, 2)
        front, back, size = random_layers(rng, 2, rows, columns, smooth)
        if not (front < back).any():
            continue
        outlines = [None, None]
        if seed % 2:
            for k, shape in enumerate([(rows, columns + 1, 2), (rows + 1, columns, 2)]):
                outlines[k] = np.sort(rng.random(shape).astype(np.float32), axis=-1)
                outlines[k][rng.random(shape[:2]) < 0.5] = (2.0, -1.0)
            shape = Layers.from_outlines(front, back, size, *outlines)
        else:
            shape = Layers(front, back, size)
        slow = ReferenceLayers(front, back, size, *outlines)
        whole = fields_around(shape)
        near = np.array([_grown(m > 0) for m in slow.m])
        np.testing.assert_array_equal(whole[..., 2] > 0, slow.m > 0)
        np.testing.assert_allclose(whole[..., 2][near], slow.m[near], atol=1e-7)
        np.testing.assert_allclose(whole[..., 0][near], slow.f[near], atol=1e-7)
        np.testing.assert_allclose(whole[..., 1][near], slow.b[near], atol=1e-7)


def _grown(mask):
    """A mask and all pixels around it."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    shifts = [padded[j : j + rows, i : i + columns] for j in range(3) for i in range(3)]
    return np.any(shifts, axis=0)


def chords(shape, o, d):
    t = shape.line_intervals(o, d).reshape(len(o), -1, 2)
    return np.maximum(t[..., 1] - t[..., 0], 0.0, where=t[..., 1] > t[..., 0],
                      out=np.zeros(t.shape[:2])).sum(axis=1)  # fmt: skip


@pytest.mark.parametrize("way", ["along the view", "across the view", "any way"])
@pytest.mark.parametrize("name", SOLIDS)
def test_chords_converge_to_the_exact_ones(name, way):
    """Analytic: mean error of the chords of 3000 lines through a solid seen at 32 to 256 pixels.

    Measured orders over the three doublings: about 1.0 for round bodies, whose rim is steep, 1.9
    for the tilted box, 0.8 for the upright one, whose edges the pixels do not tell.
    """
    shape, pose = SOLIDS[name]
    rng = np.random.default_rng(1)
    o = np.array(pose.position) + rng.uniform(-0.08, 0.08, (3000, 3))
    d = {"along the view": np.tile([0, 0, 1.0], (3000, 1)),
         "across the view": np.eye(3)[rng.integers(0, 2, 3000)],
         "any way": rng.normal(size=(3000, 3))}[way]  # fmt: skip
    d = d / np.linalg.norm(d, axis=1)[:, None]
    inverse = pose.inverse()
    exact = chords(shape, inverse.apply(o), d @ inverse.rotation.T)
    errors = []
    for n in (32, 64, 128, 256):
        layers = Layers(*view(shape, pose, n, 0.3), (0.3, 0.3))
        errors.append(np.abs(chords(layers, o, d) - exact).mean())
    order = np.log2(errors[0] / errors[-1]) / 3
    least, at_64 = {"sphere": (0.9, 0.4e-3), "capsule": (1.0, 0.4e-3),
                    "tilted box": (1.7, 0.25e-3), "box": (0.6, 1.2e-3)}[name]  # fmt: skip
    assert order > least
    assert errors[1] < at_64


def test_flat_faces_are_exact():
    """Analytic: planes are crossed where they are, along, across and slantwise, off the rim."""
    x = (np.arange(40) + 0.5) / 40 * 0.2 - 0.1
    front = 0.05 + 0.8 * x[None, :] - 0.6 * x[:, None]
    shape = Layers(front, front + 0.04, (0.2, 0.2))
    rng = np.random.default_rng(2)
    o = np.column_stack([rng.uniform(-0.04, 0.04, (500, 2)), np.full(500, 0.06)])
    for d in ((0, 0, 1), (1, 0, 0), (0, 1, 0), (0.3, 0.2, 1.0)):
        d = np.array(d, dtype=float)
        grow = d @ (-0.8, 0.6, 1)
        level = o @ (-0.8, 0.6, 1) - 0.05
        t = np.sort([-level / grow, (0.04 - level) / grow], axis=0).T
        ends = np.abs(o[:, None, :2] + t[..., None] * d[:2]).max(axis=(1, 2)) < 0.09
        assert ends.sum() > 50
        np.testing.assert_allclose(shape.line_intervals(o, d)[ends, 0], t[ends], atol=2e-8)


def test_steps_stay_steps():
    """Analytic: between two planes far apart, the wall stands in the middle, to a part of a pixel
    that falls with the height of the step."""
    pixel = 0.01
    front = np.full((4, 10), 0.05)
    front[:, 5:] = 0.05 + 100 * pixel
    shape = Layers(front, np.full((4, 10), 5.0), (0.1, 0.04))
    z = 0.05 + np.array([0.01, 0.5, 0.99])
    o = np.column_stack([np.zeros(3), np.zeros(3), z])
    t = shape.line_intervals(o, (1, 0, 0))[:, 0]
    np.testing.assert_allclose(t[:, 0], -0.05, atol=1e-9)
    width = 3 * pixel / 1.0 * pixel
    np.testing.assert_allclose(t[:, 1], width * (z - 0.55), atol=1e-8)


def test_crossings_move_smoothly():
    """Invariant: as depths change, crossings follow without jumps, over steps and slopes.

    Along the view a chord changes no faster than depths do, here by 3e-4 m a step, a little more
    where surfaces bend. Across, chords change by that over the slope; their mean over the range
    of 0.08 m in which the lines lie is bounded by 3e-4 m times 0.12 / 0.08.
    """
    rng = np.random.default_rng(3)
    front = 0.1 + 0.04 * rng.random((12, 12))
    moving = rng.normal(size=(12, 12)).clip(-3, 3)
    o = rng.uniform(-0.059, 0.059, (600, 3)) * (1, 1, 0.04 / 0.059) + (0, 0, 0.12)
    d = np.eye(3)[np.arange(600) % 3]
    last = None
    for s in np.linspace(0, 0.01, 100):
        now = chords(Layers(front + s * moving, np.full((12, 12), 0.2), (0.12, 0.12)), o, d)
        if last is not None:
            change = np.abs(now - last)
            assert change[2::3].max() < 2 * 3e-4
            assert change[0::3].mean() < 4.5e-4
            assert change[1::3].mean() < 4.5e-4
        last = now


def test_inside_agrees_with_lines_and_distance():
    """Invariant: a point is inside exactly where the line along the view through it is."""
    rng = np.random.default_rng(4)
    for layers in (1, 3):
        front, back, size = random_layers(rng, layers, 15, 11, False)
        shape = Layers(front, back, size)
        p = np.column_stack([
            rng.uniform(-0.07, 0.07, (3000, 2)), rng.uniform(-0.05, 0.3, 3000)
        ])  # fmt: skip
        g = shape.grid
        inside = [layer_inside(g.values, g.shape, g.origin, g.inverse, *q) for q in p]
        t = shape.line_intervals(p, (0, 0, 1))
        assert t.shape == (3000, 4, 2)
        on_line = ((t[..., 0] <= 0) & (t[..., 1] >= 0)).any(axis=1)
        np.testing.assert_array_equal(inside, on_line)
        np.testing.assert_array_equal(shape.signed_distance(p) <= 0, inside)
        low, high = shape.bounds()
        assert np.all((p[inside] >= low) & (p[inside] <= high))


def test_image_ends_where_its_pixels_do():
    """Analytic: a full image is a block of its width and height, but for rounded corners."""
    for rows, columns in ((5, 7), (10, 4)):
        shape = Layers(np.full((rows, columns), 0.1), np.full((rows, columns), 0.15), (0.3, 0.2))
        box = Box((0.3, 0.2, 0.05))
        rng = np.random.default_rng(5)
        o = rng.uniform(-0.5, 0.5, (200, 3)) * (0.3 - 0.9 / columns, 0.2 - 0.6 / rows, 0.04)
        for axis in range(3):
            t = shape.line_intervals(o + np.array([0, 0, 0.125]), np.eye(3)[axis])[:, 0]
            np.testing.assert_allclose(t, box.line_intervals(o, np.eye(3)[axis]), atol=1e-7)
        np.testing.assert_allclose(shape.volume, box.volume, rtol=1e-6)
        np.testing.assert_allclose(shape.to_trimesh().volume, box.volume, rtol=1e-6)


def test_volume_and_centre_of_a_sphere():
    """Analytic: the volume of a ball seen at 128 pixels."""
    ball = Sphere(0.06)
    layers = Layers(*view(ball, Pose((0.004, 0.003, 0.15)), 128, 0.3), (0.3, 0.3))
    assert abs(layers.volume / ball.volume - 1) < 0.01


def test_a_layered_body_in_a_scene():
    """Invariant: packing gives the bounding box of the turned image, and its own kind."""
    layers = Layers(np.full((4, 6), 0.1), np.full((4, 6), 0.2), (0.06, 0.04))
    pose = Pose.from_euler((0.1, 0.2, 0.3), (0.3, 0.4, 0.5))
    packed = Scene([Body(layers, pose, "steel")]).pack()
    assert packed.kinds[0] == ShapeKind.LAYERS
    low, high = layers.bounds()
    corners = [[(low, high)[k][0], (low, high)[j][1], (low, high)[i][2]]
               for k in (0, 1) for j in (0, 1) for i in (0, 1)]  # fmt: skip
    turned = pose.apply(corners)
    np.testing.assert_allclose(packed.bounds[0], [turned.min(axis=0), turned.max(axis=0)])


@pytest.mark.parametrize("room", [2, 3, 64])
def test_stretches_unite(room):
    """Differential: against sorting, as long as there is room; else nothing is lost."""
    rng = np.random.default_rng(6)
    for _ in range(300):
        a = rng.integers(0, 30, (rng.integers(1, 9), 1)).astype(float)
        pieces = np.hstack([a, a + rng.integers(1, 6, a.shape)])
        out, n = np.empty((room, 2)), 0
        for low, high in pieces:
            n = add_stretch(low, high, out, n)
        expected = np.array(unite([tuple(p) for p in pieces]))
        if room == 64:
            np.testing.assert_array_equal(out[:n], expected)
        else:
            assert 0 < n <= room
            assert np.all(out[:n, 0] < out[:n, 1])
            assert np.all(out[: n - 1, 1] < out[1:n, 0])
            inside = [np.any((out[:n, 0] <= p) & (p <= out[:n, 1])) for p in pieces.mean(axis=1)]
            assert all(inside)
            assert out[0, 0] == expected[0, 0]
            assert out[n - 1, 1] == expected[-1, 1]


def test_slots_are_sorted_and_disjoint():
    """Invariant: intervals of a pixel come in order of depth and do not touch."""
    rng = np.random.default_rng(8)
    front = rng.uniform(0, 1, (6, 9, 9))
    back = front + rng.uniform(-0.1, 0.3, front.shape)
    f, b, count = np.empty_like(front), np.empty_like(front), np.empty((9, 9), np.int64)
    found = sort_slots(front, back, f, b, count)
    assert found[0] == count.max()
    for j, i in np.ndindex(9, 9):
        ends = zip(front[:, j, i], back[:, j, i], strict=True)
        expected = unite([(p, q) for p, q in ends if p < q])
        n = count[j, i]
        np.testing.assert_array_equal(np.column_stack([f[:n, j, i], b[:n, j, i]]), expected)
    none = np.empty((0, 0, 2), np.float32)
    assert np.isfinite(build_values(f, b, count, found, 0.1, 0.3, none, none)[2:8]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros(4), np.ones(4), (1, 1)), r"front has shape \(4,\)"),
        ((np.zeros((2, 3)), np.ones((3, 2)), (1, 1)), "back has shape"),
        ((np.zeros((2, 2)), np.ones((2, 2)), (1, -1)), "size is"),
        ((np.zeros((2, 2)), np.ones((2, 2)), (1, np.nan)), "size is"),
        ((np.full((2, 2), np.nan), np.ones((2, 2)), (1, 1)), "no pixel holds an interval"),
        ((np.ones((2, 2)), np.zeros((2, 2)), (1, 1)), "no pixel holds an interval"),
        ((np.zeros((2, 2)), np.full((2, 2), np.inf), (1, 1)), "no pixel holds an interval"),
    ],
)
def test_bad_layers_are_refused(arguments, message):
    with pytest.raises(SceneError, match=message):
        Layers(*arguments)
