"""Triangle meshes: exact distances against slow twins, winding, refusals."""

import time
import warnings

import numpy as np
import pytest
import trimesh
from approximate import approx
from numba import njit

from capsense.errors import SceneError
from capsense.scene import Body, Box, Capsule, Ellipsoid, Pose, Scene, ShapeKind, Sphere, TriMesh
from capsense.scene.geometry_kernels import triangle_distance2


def tri_mesh(mesh):
    return TriMesh(mesh.vertices, mesh.faces)


@njit
def distances(triangles, points):
    """Distances from points to a surface, by trying every triangle."""
    out = np.full(len(points), np.inf)
    for i in range(len(points)):
        x, y, z = points[i]
        for m in range(len(triangles)):
            out[i] = min(out[i], triangle_distance2(triangles[m], x, y, z))
    return np.sqrt(out)


def solid_angles(triangles, points):
    """How often a surface winds around points (van Oosterom and Strackee 1983), shape (n,)."""
    out = np.zeros(len(points))
    for i, p in enumerate(points):
        a, b, c = np.moveaxis(triangles - p, 1, 0)
        x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        top = np.einsum("ij,ij->i", a, np.cross(b, c))
        dots = [np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))]
        below = x * y * z + dots[0] * z + dots[1] * x + dots[2] * y
        out[i] = np.arctan2(top, below).sum() / (2 * np.pi)
    return out


def torus():
    return trimesh.creation.torus(0.05, 0.018, major_sections=96, minor_sections=48)


MESHES = {
    "sphere": trimesh.creation.icosphere(subdivisions=3, radius=0.05),
    "capsule": Capsule(0.03, 0.12).to_trimesh(),
    "ellipsoid": Ellipsoid((0.06, 0.03, 0.045)).to_trimesh(),
    "torus": torus(),
    "tetrahedron": trimesh.Trimesh(
        np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]) * 0.1,
        [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)],
    ),
}


@pytest.mark.parametrize("name", MESHES)
def test_distances_match_the_slow_twins(name):
    """Differential: sizes by trying every triangle, signs by solid angles, near and far."""
    mesh = MESHES[name]
    shape = tri_mesh(mesh)
    triangles = shape.vertices[shape.faces]
    rng = np.random.default_rng(0)
    near = mesh.triangles_center[rng.integers(0, len(triangles), 300)]
    p = np.concatenate([
        rng.uniform(*mesh.bounds, (500, 3)), near + rng.normal(scale=0.003, size=near.shape),
        rng.uniform(-1, 1, (100, 3)),
    ])  # fmt: skip
    found = shape.signed_distance(p)
    np.testing.assert_allclose(np.abs(found), distances(triangles, p), rtol=1e-9, atol=1e-12)
    around = solid_angles(triangles, p)
    np.testing.assert_array_equal(found < 0, around > 0.5)
    assert 100 < (found < 0).sum() < 800
    np.testing.assert_allclose(shape.ray_distance(p, down=True), found, atol=1e-15)


@pytest.mark.parametrize("shape", [Box((0.1, 0.06, 0.04)), Box((0.05, 0.002, 0.05))])
def test_boxes_are_exact(shape):
    """Analytic: also at points whose rays meet edges and vertices, and lie in faces."""
    mesh = shape.to_trimesh()
    rng = np.random.default_rng(1)
    p = np.concatenate([
        np.round(rng.uniform(-0.08, 0.08, (20_000, 3)), 2), rng.uniform(-0.08, 0.08, (5000, 3))
    ])  # fmt: skip
    exact = shape.signed_distance(p)
    for _ in range(3):
        found = tri_mesh(mesh).signed_distance(p)
        np.testing.assert_allclose(np.abs(found), np.abs(exact), atol=1e-15)
        clear = np.abs(exact) > 1e-12
        np.testing.assert_array_equal(found[clear] < 0, exact[clear] < 0)
        mesh = mesh.subdivide()


def test_round_shapes_are_nearly_those_of_their_meshes():
    """Analytic: a ball of 20,480 triangles, to its sagitta of 6e-6 m."""
    ball = Sphere(0.05)
    shape = tri_mesh(trimesh.creation.icosphere(subdivisions=5, radius=0.05))
    p = np.random.default_rng(2).uniform(-0.1, 0.1, (20_000, 3))
    error = shape.signed_distance(p) - ball.signed_distance(p)
    assert error.min() > -1e-12
    assert error.max() < 3e-5


def test_cavities_stay_and_overlaps_unite():
    outer, inner = Box((0.1, 0.1, 0.1)).to_trimesh(), Box((0.04, 0.04, 0.04)).to_trimesh()
    inner.invert()
    hollow = tri_mesh(trimesh.util.concatenate([outer, inner]))
    assert hollow.volume == approx(1e-3 - 6.4e-5)
    found = hollow.signed_distance([(0, 0, 0), (0, 0.001, 0.03), (0, 0, 0.06)])
    np.testing.assert_allclose(found, [0.02, -0.01, 0.01], atol=1e-15)

    shifted = Box((0.1, 0.1, 0.1)).to_trimesh()
    shifted.apply_translation((0.05, 0.011, 0.013))
    both = tri_mesh(trimesh.util.concatenate([outer, shifted]))
    p = np.random.default_rng(3).uniform(-0.1, 0.15, (5000, 3))
    box = Box((0.1, 0.1, 0.1))
    expected = np.minimum(box.signed_distance(p), box.signed_distance(p - [0.05, 0.011, 0.013]))
    np.testing.assert_array_equal(both.signed_distance(p) < 0, expected < 0)


def test_many_points_take_little_time():
    """30,000 points and 2000 triangles: measured 0.11 s on one core."""
    shape = tri_mesh(trimesh.creation.torus(0.05, 0.018, major_sections=50, minor_sections=20))
    p = np.random.default_rng(4).uniform(-0.25, 0.25, (30_000, 3))
    shape.signed_distance(p[:2])
    start = time.process_time()
    shape.signed_distance(p)
    assert time.process_time() - start < 1.0


def test_winding_is_mended():
    """Differential: inside out, at random, and as a soup, a ball is the same ball."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    good = tri_mesh(mesh)
    assert good.volume > 0
    rng = np.random.default_rng(3)
    turned = np.where(rng.random(len(mesh.faces))[:, None] < 0.4, mesh.faces[:, ::-1], mesh.faces)
    soup = mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3)
    for v, f in [(mesh.vertices, mesh.faces[:, ::-1]), (mesh.vertices, turned), soup]:
        shape = TriMesh(v, f)
        assert shape.volume == approx(good.volume)
        assert len(shape.vertices) == len(mesh.vertices)
        assert shape.to_trimesh().is_volume


@pytest.mark.parametrize("seed", range(4))
def test_winding_is_mended_part_by_part(seed):
    """Analytic: separate parts of any winding all end with their normals out."""
    parts = [trimesh.creation.box(extents=(0.01, 0.02, 0.03)) for _ in range(4)]
    for i, part in enumerate(parts):
        part.apply_translation((0.1 * i, 0, 0))
    mesh = trimesh.util.concatenate(parts)
    turn = np.random.default_rng(seed).random(len(mesh.faces)) < 0.5
    shape = TriMesh(mesh.vertices, np.where(turn[:, None], mesh.faces[:, ::-1], mesh.faces))
    assert shape.volume == approx(4 * 6e-6)


def test_pack_uses_the_box_of_the_mesh():
    mesh = torus()
    mesh.apply_translation((0.2, -0.1, 0.3))
    shape = tri_mesh(mesh)
    pose = Pose((0.1, 0.2, 0.3), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    packed = Scene([Body(shape, pose)]).pack()
    assert packed.kinds[0] == ShapeKind.MESH
    points = pose.apply(mesh.vertices)
    np.testing.assert_allclose(
        packed.bounds[0], [points.min(axis=0), points.max(axis=0)], atol=1e-12
    )


def test_a_mesh_does_not_change():
    shape = tri_mesh(torus())
    body = Body(shape)
    assert body.moved(Pose((0, 0, 1))).shape is shape
    with pytest.raises(ValueError, match="read-only"):
        shape.vertices[0] = 0
    with pytest.raises(AttributeError):
        shape.faces = 1


def test_faces_that_repeat_a_vertex_are_dropped():
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    faces = np.vstack([mesh.faces, [[0, 0, 1]]])
    with pytest.warns(UserWarning, match="dropped 1 of 81"):
        assert len(TriMesh(mesh.vertices, faces).faces) == 80


BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
V, F = np.array(BALL.vertices), np.array(BALL.faces)


def moebius():
    """A closed one-sided surface, every edge with two faces: the six-vertex projective plane."""
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5), (0, 5, 1)]
    faces += [(1, 2, 4), (2, 3, 5), (3, 4, 1), (4, 5, 2), (5, 1, 3)]
    return np.random.default_rng(0).random((6, 3)), np.array(faces)


def open_surfaces():
    """Surfaces without an inside, and why."""
    return [
        (TriMesh(V, F[1:]), "not closed \\(3 of 120"),
        (TriMesh(V[:4], [[0, 1, 2], [2, 1, 0]]), "no volume"),
        (TriMesh(*moebius()), "one-sided"),
        (TriMesh(V, np.concatenate([F, [[0, 1, 7]]])), "not closed|more than two faces"),
        (TriMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]), "not closed"),
    ]


def test_open_surfaces_are_taken_and_have_no_inside():
    """Making one is fine; what needs an inside says so, and what to do."""
    for shape, why in open_surfaces():
        assert not shape.closed
        assert np.isfinite(shape.bounds()).all()
        assert np.isfinite(shape.params).all()
        for ask in (
            lambda s: s.volume,
            lambda s: s.signed_distance([(0, 0, 0)]),
        ):
            with pytest.raises(SceneError, match=f"({why}).*no inside.*conductors.*convex_hull"):
                ask(shape)
    assert TriMesh(V, F).closed


def test_copies_of_faces_are_dropped():
    """A ball with some faces twice, once turned over, is the ball."""
    shape = TriMesh(V, np.concatenate([F, F[:7, ::-1], F[:3]]))
    assert shape.closed
    assert len(shape.faces) == len(F)
    assert shape.volume == approx(TriMesh(V, F).volume)


def test_open_surfaces_are_wound_alike():
    """Differential: half a ball of random winding has normals that agree with each other."""
    half = F[V[F].mean(axis=1)[:, 2] > 0]
    rng = np.random.default_rng(6)
    turned = np.where(rng.random(len(half))[:, None] < 0.5, half[:, ::-1], half)
    shape = TriMesh(V, turned)
    corners = shape.vertices[shape.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    side = np.einsum("ij,ij->i", normal, corners.mean(axis=1))
    assert (side > 0).all() or (side < 0).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TriMesh(1000 * V, F), "vertices \\* 1e-3"),
        (lambda: TriMesh(V, np.where(F == 3, 99, F)), "indices run from 0 to 41"),
        (lambda: TriMesh(V, np.where(F == 3, -1, F)), "indices run from 0 to 41"),
        (lambda: TriMesh(np.where(V.max() == V, np.nan, V), F), "not finite"),
        (lambda: TriMesh(V, F.astype(float)), "integer"),
        (lambda: TriMesh(V[:, :2], F), "vertices have shape"),
        (lambda: TriMesh("mesh", F), "vertices are not numbers"),
        (lambda: TriMesh(V, F[:0]), "faces have shape"),
        (lambda: TriMesh(V, np.zeros((4, 4), int)), "triangles only"),
        (lambda: TriMesh(0 * V, F), "every face repeats a vertex"),
        (lambda: TriMesh(V, F).signed_distance((0, 0, 0)), "give \\(n, 3\\)"),
    ],
)
@pytest.mark.filterwarnings("ignore:TriMesh. dropped")
def test_bad_meshes_are_refused(make, words):
    with pytest.raises(SceneError, match=words):
        make()


def test_point_to_triangle_distance():
    """Differential: against trimesh, and on slivers of no area against their longest side."""
    rng = np.random.default_rng(4)
    triangles, points = rng.normal(size=(2000, 3, 3)), 2 * rng.normal(size=(2000, 3))
    found = [triangle_distance2(t, *p) for t, p in zip(triangles, points, strict=True)]
    nearest = trimesh.triangles.closest_point(triangles, points)
    np.testing.assert_allclose(found, ((points - nearest) ** 2).sum(axis=1), atol=1e-12)
    sliver = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert triangle_distance2(sliver, 2.0, 0.0, 4.0) == approx(16.0)
    assert triangle_distance2(sliver, 6.0, 0.0, 4.0) == approx(25.0)
    assert triangle_distance2(np.zeros((3, 3)), 3.0, 4.0, 0.0) == approx(25.0)


def test_pieces_are_the_large_parts_and_the_others_together():
    """Analytic: three boxes, and two specks of far less than a thousandth of the area."""
    sizes = [(0.2, 0.1, 0.1), (0.1, 0.02, 0.02), (0.05, 0.05, 0.05), (1e-3,) * 3, (5e-4,) * 3]
    boxes = [trimesh.creation.box(extents=size) for size in sizes]
    for k, box in enumerate(boxes):
        box.apply_translation((0.3 * k, 0.1 * k, 0))
    mesh = trimesh.util.concatenate(boxes)
    shape = TriMesh(mesh.vertices, mesh.faces)
    assert shape.parts == 5
    assert len(shape.pieces) == 4
    volumes = sorted(piece.volume for piece in shape.pieces)
    assert volumes == approx(sorted([1e-9 + 1.25e-10, 2e-3, 4e-5, 1.25e-4]))
    found = sorted(map(tuple, shape.piece_bounds.transpose(1, 0, 2).reshape(-1, 6).round(9)))
    wanted = [box.bounds.reshape(-1) for box in boxes[:3]]
    low = np.minimum(boxes[3].bounds[0], boxes[4].bounds[0])
    high = np.maximum(boxes[3].bounds[1], boxes[4].bounds[1])
    wanted.append(np.concatenate([low, high]))
    np.testing.assert_allclose(found, sorted(map(tuple, np.round(wanted, 9))), atol=1e-8)


def test_many_faces_that_repeat_a_vertex_are_told_of():
    """One in 320 is dropped without a word, one in twelve with one."""
    for rounds, told in ((2, False), (0, True)):
        ball = trimesh.creation.icosphere(rounds)
        faces = np.concatenate([ball.faces, [[0, 0, 1]]])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = TriMesh(ball.vertices, faces)
        assert len(found.faces) == len(ball.faces)
        assert ["dropped 1 of" in str(w.message) for w in caught] == [True] * told
