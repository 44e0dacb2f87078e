"""Triangle meshes: distance grid and line crossings against the exact surface, refusals."""

import warnings

import numpy as np
import pytest
import trimesh
from numba import njit

from capsense.errors import SceneError
from capsense.scene import Body, Box, Capsule, Ellipsoid, Pose, Scene, ShapeKind, Sphere, TriMesh
from capsense.scene.distance_kernels import triangle_distance2
from capsense.scene.kernels import mesh_line_intervals


def tri_mesh(mesh, **kwargs):
    return TriMesh(mesh.vertices, mesh.faces, **kwargs)


def exact_crossings(triangles, o, d):
    """Sorted parameters where one line crosses a surface (Möller and Trumbore 1997)."""
    a, e1, e2 = triangles[:, 0], *(triangles[:, k] - triangles[:, 0] for k in (1, 2))
    p = np.cross(d, e2)
    det = np.einsum("ij,ij->i", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = o - a
        u = np.einsum("ij,ij->i", s, p) / det
        q = np.cross(s, e1)
        v = q @ d / det
        t = np.einsum("ij,ij->i", e2, q) / det
    return np.sort(t[(u >= 0) & (v >= 0) & (u + v <= 1)])


def random_lines(mesh, n, seed=0):
    rng = np.random.default_rng(seed)
    middle, extent = mesh.bounds.mean(axis=0), np.ptp(mesh.bounds, axis=0)
    d = rng.normal(size=(n, 3))
    return middle + rng.uniform(-0.5, 0.5, (n, 3)) * extent, d / np.linalg.norm(d, axis=1)[:, None]


@njit
def distances(triangles, points):
    """Exact distances from points to a surface."""
    out = np.full(len(points), np.inf)
    for i in range(len(points)):
        x, y, z = points[i]
        for m in range(len(triangles)):
            out[i] = min(out[i], triangle_distance2(triangles[m], x, y, z))
    return np.sqrt(out)


def torus():
    return trimesh.creation.torus(0.05, 0.018, major_sections=96, minor_sections=48)


SMOOTH = {
    "sphere": trimesh.creation.icosphere(subdivisions=4, radius=0.05),
    "capsule": Capsule(0.03, 0.12).to_trimesh(),
    "ellipsoid": Ellipsoid((0.06, 0.03, 0.045)).to_trimesh(),
    "torus": torus(),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_crossings_match_the_exact_surface(name):
    """Differential: every stretch of 300 lines, against exact line-triangle intersection.

    Measured: crossings lie within 0.04 cell of the surface. Along the line this grows with the
    slope, so lines that graze are left to the test of grazing lines.
    """
    mesh = SMOOTH[name]
    shape = tri_mesh(mesh)
    o, d = random_lines(mesh, 300)
    found = shape.line_intervals(o, d)
    triangles = shape.vertices[shape.faces]
    compared = 0
    for i in range(len(o)):
        exact = exact_crossings(triangles, o[i], d[i])
        exact = exact[np.r_[True, np.diff(exact) > 1e-9]] if len(exact) else exact
        assert len(exact) % 2 == 0
        lengths = exact[1::2] - exact[0::2]
        gaps = exact[2::2] - exact[1:-1:2]
        if min([*lengths, *gaps], default=1.0) < 4 * shape.cell:
            continue
        n = len(exact) // 2
        np.testing.assert_allclose(found[i, :n].ravel(), exact, atol=0.25 * shape.cell)
        assert np.all(found[i, n:] == [np.inf, -np.inf])
        on = o[i] + found[i, :n].reshape(-1, 1) * d[i]
        assert np.all(distances(triangles, on) < 0.06 * shape.cell)
        compared += n
    assert compared > 100


def test_flat_faces_are_exact():
    """Analytic: crossings of a box's faces, away from its edges, on grids of any alignment."""
    box = Box((0.15, 0.15, 0.02))
    for cell in (None, 0.0037, 0.011):
        shape = tri_mesh(box.to_trimesh(), cell=cell)
        rng = np.random.default_rng(1)
        o = np.column_stack([rng.uniform(-0.03, 0.03, (500, 2)), np.full(500, 1.0)])
        d = np.column_stack([rng.uniform(-0.02, 0.02, (500, 2)), np.full(500, -3.0)])
        found = shape.line_intervals(o, d)
        np.testing.assert_allclose(found[:, 0], box.line_intervals(o, d), atol=1e-7)
        assert np.all(found[:, 1:] == [np.inf, -np.inf])


def test_a_plate_thinner_than_a_cell_is_seen():
    """Analytic: a 1 mm plate on a 3 mm grid keeps its faces, by the nodes in its middle."""
    plate = Box((0.15, 0.15, 0.001))
    shape = tri_mesh(plate.to_trimesh(), cell=0.003)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = shape.line_intervals([[0.0101, -0.0203, 0.5]], (0, 0, 1))
    np.testing.assert_allclose(found[0, 0], [-0.5005, -0.4995], atol=1e-7)


def test_slanted_lines_meet_a_plate_thinner_than_a_step():
    """Analytic: no line slips through between two samples, wherever the samples fall."""
    plate = Box((0.15, 0.15, 0.001))
    shape = tri_mesh(plate.to_trimesh(), cell=0.003)
    rng = np.random.default_rng(5)
    o = np.column_stack([rng.uniform(-0.05, 0.05, (1000, 2)), np.zeros(1000)])
    d = np.column_stack([rng.uniform(-0.6, 0.6, (1000, 2)), np.ones(1000)])
    found = shape.line_intervals(o, d)
    np.testing.assert_allclose(found[:, 0], plate.line_intervals(o, d), atol=1e-7)
    assert np.all(found[:, 1:] == [np.inf, -np.inf])


def test_a_grazing_line_does_not_flicker():
    """Analytic: as a line leaves a ball, its chord shrinks steadily down to nothing."""
    shape = tri_mesh(trimesh.creation.icosphere(subdivisions=5, radius=0.05))
    heights = np.linspace(0.045, 0.0505, 2000)
    o = np.column_stack([heights, 0.003 * np.cos(9e3 * heights), np.full(2000, 0.2)])
    t = shape.line_intervals(o, (0, 0, 1))[:, 0]
    chord = np.where(np.isfinite(t[:, 0]), t[:, 1] - t[:, 0], 0.0)
    exact = 2 * np.sqrt(np.maximum(0.05**2 - (o[:, :2] ** 2).sum(axis=1), 0.0))
    # A shift of the surface by e changes chord² by 8·height·e. Measured: e = 0.02 cell.
    assert np.abs(chord**2 - exact**2).max() < 8 * 0.05 * 0.03 * shape.cell
    assert chord[exact > 2 * shape.cell].min() > 0


def test_distance_near_the_surface():
    """Analytic: within two cells of a ball the distance is right to 0.06 cell, measured 0.04."""
    ball = Sphere(0.05)
    shape = tri_mesh(trimesh.creation.icosphere(subdivisions=5, radius=0.05))
    rng = np.random.default_rng(2)
    p = rng.normal(size=(5000, 3))
    p *= (rng.uniform(0.047, 0.053, 5000) / np.linalg.norm(p, axis=1))[:, None]
    error = (shape.signed_distance(p) - ball.signed_distance(p)) / shape.cell
    assert np.abs(error).max() < 0.06
    far = rng.uniform(-0.5, 0.5, (2000, 3))
    error = shape.signed_distance(far) - ball.signed_distance(far)
    assert error.min() > -0.2 * shape.cell
    assert np.all(error < 2 * np.linalg.norm(far, axis=1))


def test_signs_agree_with_the_solid_everywhere():
    """Differential: inside and outside at every node, on faces seen edge-on by the rays."""
    box = Box((0.1, 0.06, 0.04))
    for mesh in (box.to_trimesh(), box.to_trimesh().subdivide().subdivide()):
        grid = tri_mesh(mesh, cell=0.005).grid
        axes = [grid.origin[k] + grid.cell * np.arange(grid.values.shape[k]) for k in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        exact = box.signed_distance(nodes)
        clear = np.abs(exact) > 1e-6
        assert np.all((grid.values.ravel() < 0)[clear] == (exact < 0)[clear])


def test_stretches_beyond_four_are_joined_to_the_fourth():
    parts = [trimesh.creation.box(extents=(0.01, 0.1, 0.1)) for _ in range(6)]
    for i, part in enumerate(parts):
        part.apply_translation((0.03 * i, 0, 0))
    shape = tri_mesh(trimesh.util.concatenate(parts))
    found = shape.line_intervals([[-1.0, 0.001, 0.002]], (1, 0, 0))[0]
    starts = 0.995 + 0.03 * np.arange(4)
    np.testing.assert_allclose(found[:, 0], starts, atol=1e-6)
    np.testing.assert_allclose(found[:, 1], [*(starts[:3] + 0.01), 1.155], atol=1e-6)
    out = np.full((6, 2), np.nan)
    grid = shape.grid
    n = mesh_line_intervals(
        grid.values, grid.origin, 1 / grid.cell, -1.0, 0.001, 0.002, 1.0, 0.0, 0.0,
        -np.inf, np.inf, out,
    )  # fmt: skip
    assert n == 6
    np.testing.assert_allclose(out[:, 1] - out[:, 0], 0.01, atol=1e-6)


def test_cavities_stay_and_overlaps_unite():
    outer, inner = Box((0.1, 0.1, 0.1)).to_trimesh(), Box((0.04, 0.04, 0.04)).to_trimesh()
    inner.invert()
    hollow = tri_mesh(trimesh.util.concatenate([outer, inner]))
    assert hollow.volume == pytest.approx(1e-3 - 6.4e-5)
    found = hollow.line_intervals([[0, 0.001, 0.5]], (0, 0, 1))[0, :2]
    np.testing.assert_allclose(found, [[-0.55, -0.52], [-0.48, -0.45]], atol=1e-6)

    shifted = Box((0.1, 0.1, 0.1)).to_trimesh()
    shifted.apply_translation((0.05, 0.011, 0.013))
    both = tri_mesh(trimesh.util.concatenate([outer, shifted]))
    found = both.line_intervals([[0, 0, 0.002]], (1, 0, 0))[0]
    np.testing.assert_allclose(found[0], [-0.05, 0.1], atol=1e-6)
    assert np.all(found[1:] == [np.inf, -np.inf])


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
        assert shape.volume == pytest.approx(good.volume)
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
    assert shape.volume == pytest.approx(4 * 6e-6)


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


def test_the_grid_is_built_once_and_is_shared_by_moved_bodies():
    shape = tri_mesh(torus())
    body = Body(shape)
    assert body.moved(Pose((0, 0, 1))).shape.grid is shape.grid
    with pytest.raises(ValueError, match="read-only"):
        shape.vertices[0] = 0
    with pytest.raises(AttributeError):
        shape.cell = 1.0


def test_lost_walls_are_reported():
    outer, inner = Box((0.1, 0.1, 0.1)).to_trimesh(), Box((0.0991, 0.0992, 0.0993)).to_trimesh()
    inner.invert()
    mesh = trimesh.util.concatenate([outer, inner])
    shape = tri_mesh(mesh)
    with pytest.warns(UserWarning, match="pass a smaller cell"):
        _ = shape.grid


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
            lambda s: s.grid,
            lambda s: s.signed_distance([(0, 0, 0)]),
            lambda s: s.line_intervals([(0, 0, 0)], (0, 0, 1)),
        ):
            with pytest.raises(SceneError, match=f"({why}).*no inside.*surface.*convex_hull"):
                ask(shape)
    assert TriMesh(V, F).closed


def test_copies_of_faces_are_dropped():
    """A ball with some faces twice, once turned over, is the ball."""
    shape = TriMesh(V, np.concatenate([F, F[:7, ::-1], F[:3]]))
    assert shape.closed
    assert len(shape.faces) == len(F)
    assert shape.volume == pytest.approx(TriMesh(V, F).volume)


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
        (lambda: TriMesh(V, F, cell=0), "cell is 0"),
        (lambda: TriMesh(V, F, cell=1.0), "at most 0.1"),
        (lambda: TriMesh(V, F, cell="x"), "cell is 'x'"),
        (lambda: TriMesh(V, F, cell=1e-5), "larger one"),
        (lambda: TriMesh(V, F).signed_distance((0, 0, 0)), "give \\(n, 3\\)"),
        (lambda: TriMesh(V, F).line_intervals([(0, 0, 0)], (0, 0, 0)), "length zero"),
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
    assert triangle_distance2(sliver, 2.0, 0.0, 4.0) == pytest.approx(16.0)
    assert triangle_distance2(sliver, 6.0, 0.0, 4.0) == pytest.approx(25.0)
    assert triangle_distance2(np.zeros((3, 3)), 3.0, 4.0, 0.0) == pytest.approx(25.0)
