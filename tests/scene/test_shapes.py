"""Convex primitives: analytic values, compiled against readable, invariants, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from capsense.errors import SceneError
from capsense.scene import Box, Capsule, Cylinder, Ellipsoid, Pose, Sphere, TriMesh
from capsense.scene.kernels import body_line_interval, line_interval

SHAPES = [
    Box((0.10, 0.04, 0.02)),
    Sphere(0.05),
    Capsule(0.03, 0.12),
    Cylinder(0.04, 0.06),
    Ellipsoid((0.06, 0.03, 0.045)),
]
shapes = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)


@njit
def _compiled(kind, params, o, d):
    out = np.empty((o.shape[0], 2))
    for i in range(o.shape[0]):
        out[i] = line_interval(kind, params, o[i, 0], o[i, 1], o[i, 2], d[i, 0], d[i, 1], d[i, 2])
    return out


def compiled(shape, o, d):
    o = np.asarray(o, dtype=float)
    return _compiled(int(shape.kind), shape.params, o, np.broadcast_to(d, o.shape).copy())


def random_lines(shape, n, seed=0):
    """Lines of every kind: free, parallel to an axis, in the plane of a face, from far away."""
    rng = np.random.default_rng(seed)
    top = shape.bounds()[1]
    o = rng.uniform(-1.3, 1.3, (n, 3)) * top
    d = rng.normal(size=(n, 3))
    axis = rng.integers(3, size=n)
    straight = rng.random(n) < 0.3
    d[straight] = np.eye(3)[axis[straight]] * rng.choice([-2.0, 1.0], straight.sum())[:, None]
    grazing = rng.random(n) < 0.2
    o[grazing, axis[grazing] - 1] = (top * rng.choice([-1.0, 1.0], (n, 1)))[
        grazing, axis[grazing] - 1
    ]
    o[rng.random(n) < 0.02] = 0.0
    return o + d * rng.choice([0.0, 1.0, -30.0], (n, 1)), d


@shapes
def test_compiled_equals_readable(shape):
    """Differential: 1e5 lines, a fifth of them grazing a face."""
    o, d = random_lines(shape, 100_000)
    slow, fast = shape.line_intervals(o, d), compiled(shape, o, d)
    assert not np.isnan(slow).any()
    assert not np.isnan(fast).any()
    hit_slow, hit_fast = slow[:, 0] <= slow[:, 1], fast[:, 0] <= fast[:, 1]
    assert 0.2 < hit_slow.mean() < 0.95
    # Rounding may settle a touching line either way; such a stretch is short or in a face.
    both = hit_slow & hit_fast
    differing = np.flatnonzero(hit_slow != hit_fast)
    assert len(differing) < 100
    for i in differing:
        t = (slow if hit_slow[i] else fast)[i].mean()
        assert abs(shape.signed_distance((o[i] + t * d[i])[None])[0]) < 1e-12
    np.testing.assert_allclose(fast[both], slow[both], rtol=1e-9, atol=1e-7)
    misses = ~hit_fast
    assert np.all(fast[misses] == [np.inf, -np.inf])
    assert np.all(slow[~hit_slow] == [np.inf, -np.inf])


@shapes
def test_interval_ends_lie_on_the_surface(shape):
    """Invariant: |sdf| is zero at both ends, negative between them, and positive outside."""
    o, d = random_lines(shape, 20_000, seed=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t = shape.line_intervals(o, d)
    hit = t[:, 0] < t[:, 1] - 1e-6
    o, d, t = o[hit], d[hit], t[hit]

    def sdf(u):
        return shape.signed_distance(o + u[:, None] * d)

    assert np.abs(sdf(t[:, 0])).max() < 1e-9
    assert np.abs(sdf(t[:, 1])).max() < 1e-9
    assert sdf(t.mean(axis=1)).max() < 1e-12
    assert sdf(t[:, 0] - 1e-3).min() > -1e-12
    assert sdf(t[:, 1] + 1e-3).min() > -1e-12


@shapes
def test_lines_that_miss_stay_outside(shape):
    """Invariant: along a line without a stretch inside, the distance is never negative."""
    o, d = random_lines(shape, 5_000, seed=2)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o -= np.einsum("ij,ij->i", o, d)[:, None] * d
    miss = ~np.isfinite(shape.line_intervals(o, d)[:, 0])
    for t in np.linspace(-0.15, 0.15, 61):
        assert shape.signed_distance(o[miss] + t * d[miss]).min() > -1e-12


def test_analytic_intervals():
    """Analytic: values by hand, in units of t along directions that are not of length one."""
    cases = [
        (Box((2, 4, 6)), (0, 0, -10), (0, 0, 2), (3.5, 6.5)),
        (Box((2, 2, 2)), (-2, -2, 0), (1, 1, 0), (1, 3)),
        (Box((2, 2, 2)), (1, 0, 0), (0, 0, 1), (-1, 1)),
        (Sphere(1), (0, 0.6, 0), (1, 0, 0), (-0.8, 0.8)),
        (Sphere(1), (0, 1, 5), (0, 0, 5), (-1, -1)),
        (Capsule(1, 2), (0, 0, 0), (0, 0, 1), (-2, 2)),
        (Capsule(1, 2), (0, 0, 1.6), (1, 0, 0), (-0.8, 0.8)),
        (Capsule(1, 2), (0, 0.6, 0), (0, 0, 1), (-1.8, 1.8)),
        (Cylinder(1, 2), (0.6, 0, 0), (0, 1, 0), (-0.8, 0.8)),
        (Cylinder(1, 2), (0.5, 0.5, 9), (0, 0, -1), (8, 10)),
        (Cylinder(1, 2), (-3, 0, 0), (1, 0, 0.5), (2, 2)),  # touches the rim
        (Ellipsoid((1, 2, 3)), (0, 0, 7), (0, 0, 1), (-10, -4)),
        (Ellipsoid((1, 2, 3)), (0.6, 0, 0), (0, 1, 0), (-1.6, 1.6)),
    ]
    for shape, o, d, expected in cases:
        assert tuple(shape.line_intervals([o], d)[0]) == pytest.approx(expected), shape
        assert tuple(compiled(shape, [o], d)[0]) == pytest.approx(expected), shape


def test_analytic_distances():
    """Analytic: values by hand, off faces, edges and corners, and inside."""
    cases = [
        (Box((2, 4, 6)), [(2, 0, 0), (4, 6, 3), (3, 4, 3), (0, 0, 0)], [1, 5, 8**0.5, -1]),
        (Sphere(1), [(0, 3, 4), (0, 0, 0)], [4, -1]),
        (Capsule(1, 2), [(3, 0, 0), (0, 3, 5), (0, 0, 2.5), (0, 0, 0)], [2, 4, 0.5, -1]),
        (Cylinder(1, 2), [(3, 0, 0), (4, 0, 5), (0, 0, 1.5), (0, 0, 0)], [2, 5, 0.5, -1]),
        (Ellipsoid((1, 2, 3)), [(3, 0, 0), (0, 0, 5), (0, 0, 0), (0, -3, 0)], [2, 2, -1, 1]),
        (Ellipsoid((2, 2, 2)), [(3, 4, 0), (0, 0, 0), (0.5, 0, 0)], [3, -2, -1.5]),
    ]
    for shape, points, expected in cases:
        np.testing.assert_allclose(shape.signed_distance(points), expected, atol=1e-8)


@pytest.mark.parametrize("radii", [(0.06, 0.03, 0.045), (0.2, 0.01, 0.01), (0.05, 0.05, 0.002)])
def test_ellipsoid_distance_is_exact(radii):
    """Differential: points set off a surface point along its normal, outside and inside."""
    shape = Ellipsoid(radii)
    rng = np.random.default_rng(3)
    r = np.array(radii)
    on = rng.normal(size=(5000, 3))
    on = r * on / np.linalg.norm(on, axis=1, keepdims=True)
    normal = on / r**2
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # The foot is unique up to the smallest radius of curvature inside, and everywhere outside.
    d = rng.uniform(-0.9 * r.min() ** 2 / r.max(), 0.2, 5000)
    found = shape.signed_distance(on + d[:, None] * normal)
    np.testing.assert_allclose(found, d, atol=3e-9 * r.min(), rtol=1e-9)


@shapes
def test_bounds_volume_and_surface_mesh(shape):
    """Differential: the drawn mesh has the shape's box and volume, and lies on its surface."""
    mesh = shape.to_trimesh()
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, shape.bounds(), atol=2e-4)
    assert mesh.volume == pytest.approx(shape.volume, rel=6e-3)
    assert np.abs(shape.signed_distance(mesh.vertices)).max() < 1e-9


@shapes
def test_breadth_is_that_of_the_largest_ball_inside(shape):
    """Differential: twice the greatest depth of a primitive; a mesh may own to a little less."""
    axes = [np.linspace(-t, t, 41) for t in shape.bounds()[1]]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    deepest = -shape.signed_distance(points).min()
    assert shape.breadth == pytest.approx(2 * deepest, rel=1e-9)
    mesh = shape.to_trimesh()
    copied = TriMesh(mesh.vertices, mesh.faces, cell=0.002)
    assert shape.breadth - 0.006 <= copied.breadth <= shape.breadth


@pytest.mark.parametrize("scale", [1e-3, 0.1, 1.5])
def test_surface_meshes_of_any_size_are_closed(scale):
    """Small ones too: every kind, as a solid of triangles of the same volume."""
    kinds = (
        Box((scale, 2 * scale, scale)), Sphere(scale), Capsule(scale, 4 * scale),
        Cylinder(scale, 2 * scale), Ellipsoid((scale, 2 * scale, 3 * scale)),
    )  # fmt: skip
    for shape in kinds:
        mesh = shape.to_trimesh()
        assert TriMesh(mesh.vertices, mesh.faces).volume == pytest.approx(shape.volume, rel=6e-3)


@shapes
def test_distance_is_one_lipschitz(shape):
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-0.15, 0.15, (2, 5000, 3))
    change = np.abs(shape.signed_distance(a) - shape.signed_distance(b))
    assert np.all(change <= np.linalg.norm(a - b, axis=1) + 1e-12)


coordinate = st.floats(-0.2, 0.2).map(lambda v: round(v, 3))
vector = st.tuples(coordinate, coordinate, coordinate)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(SHAPES), vector, vector.filter(any))
def test_any_line(shape, o, d):
    """Differential: coarse coordinates make parallel, touching and central lines common."""
    slow, fast = shape.line_intervals([o], d)[0], compiled(shape, [o], d)[0]
    assert not np.isnan(slow).any()
    assert not np.isnan(fast).any()
    if np.isfinite(slow).all() and np.isfinite(fast).all():
        np.testing.assert_allclose(fast, slow, rtol=1e-6, atol=1e-6)
    else:  # a touching line may go either way
        t = next((i.mean() for i in (slow, fast) if np.isfinite(i).all()), None)
        if t is not None:
            point = np.array(o) + t * np.array(d)
            assert abs(shape.signed_distance(point[None])[0]) < 1e-9


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(SHAPES), vector, vector.filter(any), vector, st.tuples(*[coordinate] * 4))
def test_rigid_motion_changes_nothing(shape, o, d, position, quaternion):
    """Invariant: moving body and line together leaves the parameters of the stretch."""
    pose = Pose(position, quaternion if any(quaternion) else (0, 0, 0, 1))
    o, d = np.array(o), np.array(d)
    length = np.linalg.norm(d)
    t0, t1 = shape.line_intervals([o], d)[0]
    origin, direction = pose.apply(o), pose.rotation @ d
    u0, u1 = body_line_interval(
        int(shape.kind),
        shape.params,
        pose.rotation,
        np.array(pose.position),
        *origin,
        *direction,
    )
    if t1 - t0 > 1e-3 / length or u1 - u0 > 1e-3 / length:
        middle = o + 0.5 * (max(t0, u0) + min(t1, u1)) * d
        if shape.signed_distance(middle[None])[0] < -1e-6:
            assert (u0, u1) == pytest.approx((t0, t1), rel=1e-6, abs=1e-6 / length)


def test_near_parallel_lines_are_continuous():
    """A slope going to zero neither jumps nor overflows, down to the smallest floats."""
    for shape in SHAPES:
        for axis in range(3):
            d = np.zeros(3)
            d[axis] = 1.0
            straight = shape.line_intervals([[0.001, 0.002, 0.003]], d)[0]
            for slope in (1e-9, 1e-11, 1e-12, 1e-13, 1e-20, 1e-160, 1e-310):
                tilted = d + slope * (d == 0)
                found = compiled(shape, [[0.001, 0.002, 0.003]], tilted)[0]
                np.testing.assert_allclose(found, straight, atol=1e-8)


def test_shapes_are_values():
    assert Box((1, 2, 3)) == Box(np.array([1.0, 2.0, 3.0]))
    assert len({Sphere(1), Sphere(1.0), Sphere(2)}) == 2
    with pytest.raises(AttributeError):
        Sphere(1).radius = 2
    with pytest.raises(ValueError, match="read-only"):
        Sphere(1).params[0] = 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Box((1, 2)), "Box: size has 2 entries"),
        (lambda: Box(0.1), "three lengths"),
        (lambda: Box((1, 2, 0)), "above zero"),
        (lambda: Box((1, 2, np.nan)), "not finite"),
        (lambda: Sphere(-1), "radius is -1 m"),
        (lambda: Sphere("x"), "one length"),
        (lambda: Sphere(np.inf), "not finite"),
        (lambda: Capsule(0.1, 0), "Capsule: length is 0 m"),
        (lambda: Cylinder(0, 1), "Cylinder: radius is 0 m"),
        (lambda: Ellipsoid((1, -2, 3)), "above zero"),
        (lambda: Sphere(1).signed_distance((0, 0, 0)), "give \\(n, 3\\)"),
        (lambda: Sphere(1).line_intervals([(0, 0, 0)], (0, 0, 0)), "length zero"),
        (lambda: Sphere(1).line_intervals([(0, 0, 0)], (0, 0, np.nan)), "not finite"),
        (lambda: Sphere(1).line_intervals([(0, 0, 0)], (0, 1)), "direction has shape"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(SceneError, match=words):
        make()
