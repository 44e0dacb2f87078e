"""Steps of the reduction of meshes, on meshes of a few triangles: what each leaves unchanged."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx
from scipy.spatial.transform import Rotation

from capsense.solver.bodies import simplify, triangles
from capsense.solver.bodies.simplify import add_offsets, collapse, fitted

Array = np.ndarray
SIZE = np.array([0.06, 0.04, 0.03])


def block(cuts: int) -> tuple[Array, Array]:
    """A block, its faces cut into 4^cuts times two triangles."""
    mesh = trimesh.creation.box(SIZE)
    for _ in range(cuts):
        mesh = mesh.subdivide()
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def ball(cuts: int) -> tuple[Array, Array]:
    mesh = trimesh.creation.icosphere(subdivisions=cuts, radius=1.0)
    return np.array(mesh.vertices), np.array(mesh.faces, np.int64)


def sheet() -> tuple[Array, Array]:
    """A square of two triangles."""
    return np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 3, 0.0]]), np.array(
        [[0, 1, 2], [0, 2, 3]]
    )


def areas(corners: Array) -> Array:
    return 0.5 * np.linalg.norm(normals(corners), axis=1)


def normals(corners: Array) -> Array:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def volume(corners: Array) -> float:
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def closed(faces: Array) -> bool:
    """Whether every edge is passed once each way."""
    edges = [(int(f[k]), int(f[(k + 1) % 3])) for f in faces for k in range(3)]
    return len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)


def test_flat_faces_are_reduced_with_little_error() -> None:
    """Analytic: a block of 192 triangles becomes one of few; area, volume, corners stay.

    Joined vertices keep a thousandth of the way to the middles of their edges.
    """
    vertices, faces = block(2)
    moved, reduced = triangles._collapsed(vertices, faces, 60)
    corners = moved[reduced]
    assert len(reduced) <= 60
    assert closed(reduced)
    whole = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[2] * SIZE[0])
    assert volume(corners) == approx(SIZE.prod(), rel=1e-3)
    assert areas(corners).sum() == approx(whole, rel=1e-3)
    apart = np.linalg.norm(moved[:, None] - block(0)[0], axis=2).min(axis=0)
    assert apart.max() < 2e-3 * SIZE.max()


@pytest.mark.parametrize("count", [40, 200, 319])
def test_a_ball_stays_a_convex_ball(count: int) -> None:
    """Invariant: closed, no triangle turned over, none a sliver; vertices near the sphere."""
    moved, reduced = triangles._collapsed(*ball(2), count)
    corners = moved[reduced]
    assert count - 1 <= len(reduced) <= count
    assert closed(reduced)
    outward = np.einsum("ij,ij->i", normals(corners), corners.mean(axis=1))
    assert outward.min() > 0
    assert np.linalg.norm(moved, axis=1).min() > 0.9
    assert np.linalg.norm(moved, axis=1).max() < 1.1
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    assert (longest**2 / areas(corners)).max() < 8.0


def test_a_ring_stays_a_ring() -> None:
    """Invariant: its hole is not pinched off: vertices - edges + faces stays 0."""
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=16, minor_sections=10)
    moved, reduced = triangles._collapsed(np.array(mesh.vertices), np.array(mesh.faces), 120)
    assert len(reduced) <= 120
    assert closed(reduced)
    assert len(moved) - 3 * len(reduced) // 2 + len(reduced) == 0


def test_the_cheapest_edges_go_first() -> None:
    """Invariant: a ball with a flat lid loses the lid's inner vertices before any other."""
    vertices, faces = ball(2)
    vertices[:, 2] = np.minimum(vertices[:, 2], 0.7)
    inner = np.flatnonzero(vertices[:, 2] == 0.7)
    left = len(faces) - 2 * 6
    moved, reduced = triangles._collapsed(vertices, faces, left)
    apart = np.linalg.norm(moved[:, None] - vertices, axis=2).min(axis=0)
    assert len(reduced) == left
    gone = np.flatnonzero(apart > 1e-9)
    assert len(gone) >= 6
    assert np.isin(gone, inner).all()


def slow_quadric(vertices: Array, faces: Array, at: int, x: Array) -> float:
    """Sum of weights times squares of distances of a point from the planes at a vertex."""
    total = 0.0
    edges: dict[tuple[int, int], list[int]] = {}
    for number, face in enumerate(faces):
        for k in range(3):
            edge = sorted((int(face[k]), int(face[(k + 1) % 3])))
            edges.setdefault((edge[0], edge[1]), []).append(number)
    unit = normals(vertices[faces])
    unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    for number, face in enumerate(faces):
        if at in face:
            height = unit[number] @ (x - vertices[at])
            total += areas(vertices[faces])[number] * height**2
    for edge, owners in edges.items():
        if at not in edge:
            continue
        way = vertices[edge[1]] - vertices[edge[0]]
        weight = triangles._STIFF * (way @ way)
        bent = len(owners) == 2 and unit[owners[0]] @ unit[owners[1]] < triangles._BENT
        if len(owners) == 1:
            upright = np.cross(way, unit[owners[0]]) / np.linalg.norm(way)
            total += weight * (upright @ (x - vertices[at])) ** 2
        if bent or len(owners) != 2:
            total += sum(weight * (unit[o] @ (x - vertices[at])) ** 2 for o in owners)
    return total


@pytest.mark.parametrize("mesh", [block(1), ball(0), sheet()], ids=["block", "ball", "sheet"])
def test_quadrics_against_distances_from_planes(mesh: tuple[Array, Array]) -> None:
    """Differential: at random points, at every vertex."""
    vertices, faces = mesh
    quadrics, edges = triangles._quadrics(vertices, faces, triangles._sharp(vertices, faces))
    rng = np.random.default_rng(0)
    for at in range(len(vertices)):
        x, y, z = point = rng.uniform(-1, 1, 3)
        terms = [x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 2 * x, 2 * y, 2 * z, 1.0]
        assert quadrics[at] @ terms == approx(slow_quadric(vertices, faces, at, point))
    pairs = {tuple(sorted((int(f[k]), int(f[(k + 1) % 3])))) for f in faces for k in range(3)}
    assert {tuple(sorted(e)) for e in edges.tolist()} == pairs
    assert len(edges) == len(pairs)


def least_squares(vertices: Array, quadric: Array, ends: tuple[int, int]) -> Array:
    """Where a sum of two quadrics is least, held to the middle of the edge."""
    q = quadric[ends[0]] + quadric[ends[1]]
    matrix = np.array([[q[0], q[1], q[2]], [q[1], q[3], q[4]], [q[2], q[4], q[5]]])
    middle = 0.5 * (vertices[ends[0]] + vertices[ends[1]])
    stay = simplify._STAY * np.trace(matrix) * np.eye(3)
    step = np.linalg.solve(matrix + stay, -(matrix @ middle + q[6:9]))
    far = np.linalg.norm(step) > np.linalg.norm(vertices[ends[0]] - vertices[ends[1]])
    return middle if far else middle + step


@pytest.mark.parametrize("mesh", [block(1), ball(1)], ids=["block", "ball"])
def test_the_place_of_a_joined_vertex(mesh: tuple[Array, Array]) -> None:
    """Differential: against a linear solve; its cost is the planes' and the length's."""
    vertices, faces = mesh
    quadrics, edges = triangles._quadrics(vertices, faces, triangles._sharp(vertices, faces))
    place = np.empty(3)
    for u, v in edges.tolist():
        cost = simplify._cost(vertices, quadrics, u, v, place)
        np.testing.assert_allclose(place, least_squares(vertices, quadrics, (u, v)), atol=1e-9)
        q = quadrics[u] + quadrics[v]
        x, y, z = place
        terms = [x * x, 2 * x * y, 2 * x * z, y * y, 2 * y * z, z * z, 2 * x, 2 * y, 2 * z, 1.0]
        square = ((vertices[u] - vertices[v]) ** 2).sum()
        expected = max(q @ terms, 0.0) + simplify._EVEN * (q[0] + q[3] + q[5]) * square
        assert cost == approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("apex", "keeps"),
    [
        ((0.5, 1.0, 0.0), True),
        ((0.5, 0.6, 1.0), True),  # 59 degrees
        ((0.5, 0.25, 1.0), False),  # 76 degrees, where the cosine is 0.24
        ((0.5, 0.27, 1.0), True),  # 0.26
        ((0.5, -1.0, 0.0), False),
        ((0.5, 0.005, 0.0), False),  # a sliver
        ((0.5, 0.02, 0.0), True),
    ],
)
def test_which_moves_of_a_corner_are_allowed(apex: tuple[float, ...], keeps: bool) -> None:
    """Analytic: not beyond a cosine of a quarter, not to a height of a hundredth, at any size."""
    vertices = np.array([[0.5, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    for size, shift in ((1.0, 0.0), (1.0, 5.0), (1e-3, 0.0), (200.0, 3.0)):
        place = size * np.array(apex) + shift
        assert simplify._keeps_facing(size * vertices + shift, 0, 1, 2, place) == keeps


def slow_offsets(points: Array, normal: Array, corners: Array) -> tuple[Array, Array]:
    """Nearest triangle that faces alike, and height over its plane, of every point."""
    unit = normals(corners) / (2 * areas(corners)[:, None])
    owner, height = [], []
    for p, n in zip(points, normal, strict=True):
        flat = np.repeat(p[None], len(corners), axis=0)
        near = trimesh.triangles.closest_point(corners, flat)
        distance = np.where(unit @ n > 0.5, np.linalg.norm(near - p, axis=1), np.inf)
        owner.append(int(distance.argmin()) if np.isfinite(distance).any() else -1)
        height.append(unit[owner[-1]] @ (p - corners[owner[-1]].mean(axis=0)))
    return np.array(owner), np.array(height)


def test_offsets_against_all_triangles() -> None:
    """Differential: random points with random normals about a ball of loose triangles."""
    vertices, faces = ball(0)
    corners = vertices[faces]
    corners = 0.8 * corners + 0.2 * corners.mean(axis=1, keepdims=True)
    rng = np.random.default_rng(1)
    points, normal = rng.normal(size=(2, 60, 3))
    points *= 1.2 / np.linalg.norm(points, axis=1, keepdims=True)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    weights = rng.uniform(0.5, 2.0, 60)
    centers = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    unit = normals(corners) / (2 * areas(corners)[:, None])
    found = np.zeros((len(faces), 2))
    add_offsets(points, normal, weights, corners, unit, centers, reach, found)
    owner, height = slow_offsets(points, normal, corners)
    expected = np.zeros((len(faces), 2))
    np.add.at(expected, owner, np.stack([weights, weights * height], axis=1))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_fitted_ball_lies_as_much_within_as_without() -> None:
    """Analytic: 80 triangles with corners on a sphere come to its mean radius, by symmetry alike.

    A triangle's mean height is then zero, so that the volume is the sphere's to second order.
    """
    vertices, faces = ball(1)
    fine, many = ball(2)
    moved = fitted(vertices, faces, fine[many])
    assert volume(vertices[faces]) / volume(fine[many]) < 0.91
    assert volume(moved[faces]) == approx(volume(fine[many]), rel=5e-3)
    out = np.einsum("ij,ij->i", moved, vertices)
    np.testing.assert_allclose(moved, out[:, None] * vertices, atol=2e-3)
    shift = np.array([5.0, -2.0, 1.0])
    other = fitted(3.0 * vertices + shift, faces, 3.0 * fine[many] + shift)
    np.testing.assert_allclose(other, 3.0 * moved + shift, atol=1e-9)


def test_a_flat_sheet_that_is_fitted_takes_the_height_of_the_surface() -> None:
    """Analytic: one that lies 0.1 above it comes down by 0.1, and no triangle moves further than
    a part of its size."""
    vertices, faces = sheet()
    low = vertices[faces] - [0.0, 0.0, 0.1]
    np.testing.assert_allclose(fitted(vertices, faces, low)[:, 2], -0.1, atol=1e-3)
    deep = vertices[faces] - [0.0, 0.0, 50.0]
    limit = simplify._ROUNDS * simplify._FARTHEST * np.sqrt(areas(vertices[faces]).max())
    np.testing.assert_allclose(fitted(vertices, faces, deep)[:, 2], -limit, rtol=1e-2)


@pytest.mark.parametrize("mesh", [block(0), ball(0), sheet()], ids=["block", "ball", "sheet"])
@pytest.mark.parametrize("share", [0.2, 0.45, 0.8, 3.0])
def test_divided_edges_are_short_and_the_surface_is_the_same(
    mesh: tuple[Array, Array], share: float
) -> None:
    """Invariant: area, volume, closedness and facing; no edge is longer than was asked for."""
    vertices, faces = mesh
    corners = vertices[faces]
    longest = share * np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max()
    points, parts = triangles._divided(vertices, faces, longest)
    small = points[parts]
    assert np.linalg.norm(np.roll(small, -1, axis=1) - small, axis=2).max() <= longest
    assert areas(small).sum() == approx(areas(corners).sum(), rel=1e-12)
    assert volume(small) == approx(volume(corners), rel=1e-12, abs=1e-15)
    assert closed(parts) == closed(faces)
    assert len(np.unique(points.round(9), axis=0)) == len(points)
    np.testing.assert_allclose(normals(small).sum(axis=0), normals(corners).sum(axis=0), atol=1e-12)
    if share > 1:
        np.testing.assert_array_equal(parts, faces)


def test_which_edges_are_sharp() -> None:
    """Analytic: a block's twelve from both sides, its diagonals not; rims; no edge of a ball.

    Neither the winding of a face nor a bend below 40 degrees counts.
    """
    vertices, faces = block(0)
    sharp = triangles._sharp(vertices, faces)
    length = np.linalg.norm(vertices[np.roll(faces, -1, axis=1)] - vertices[faces], axis=2)
    straight = np.isclose(length[..., None], SIZE).any(axis=2)
    np.testing.assert_array_equal(sharp, straight)
    np.testing.assert_array_equal(triangles._sharp(*sheet()), [[1, 1, 0], [0, 1, 1]])
    assert not triangles._sharp(*ball(2)).any()
    turned = faces.copy()
    turned[3] = turned[3, ::-1]
    length = np.linalg.norm(vertices[np.roll(turned, -1, axis=1)] - vertices[turned], axis=2)
    straight = np.isclose(length[..., None], SIZE).any(axis=2)
    np.testing.assert_array_equal(triangles._sharp(vertices, turned), straight)
    for degrees, bent in ((38.0, False), (41.0, True)):
        turn = np.radians(degrees)
        roof = np.array([[0, 0, 0], [0, 1, 0], [-1, 0.5, 0],
                         [np.cos(turn), 0.5, np.sin(turn)]])  # fmt: skip
        found = triangles._sharp(roof, np.array([[0, 1, 2], [1, 0, 3]]))
        assert found[0, 0] == found[1, 0] == bent


@pytest.mark.parametrize("areas_of", [[1.0], [1.0, 1.0], [1.0, 0.01], [3.0, 2.0, 1e-6, 0.5]])
@pytest.mark.parametrize("count", [300, 2000])
def test_shares_of_parts(areas_of: list[float], count: int) -> None:
    """Invariant: they add up, each has its least, and larger parts go with a power of the area."""
    area = np.array(areas_of)
    found = triangles._shares(area, count)
    least = min(triangles._LEAST, triangles._EVENLY * count / len(area))
    assert found.sum() == approx(count, abs=len(area))
    assert found.min() >= int(least)
    large = found > least + 1
    density = found[large] / area[large] ** triangles._POWER
    np.testing.assert_allclose(density, density[:1].repeat(large.sum()), rtol=0.02)


def test_slivers_are_halved_where_there_are_triangles_enough() -> None:
    """By hand: long ones down to about the usual length, short ones never, nor what is none."""
    right = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    usual = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.05, 0.0866, 0]]) + np.zeros((190, 1, 1))
    strip = right[None] * [1.0, 0.01, 0.0]
    short = right * [[[0.05, 0.0005, 0.0]]] * np.ones((9, 1, 1))
    corners = np.concatenate([usual, strip, short])
    found = triangles._halved(corners, np.zeros(corners.shape[:2], bool), 200)
    np.testing.assert_array_equal(found[:190], usual)
    np.testing.assert_array_equal(found[191:200], short)
    assert areas(found).sum() == approx(areas(corners).sum(), rel=1e-12)
    pieces = np.concatenate([found[190:191], found[200:]])
    longest = np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=2).max(axis=1)
    assert 0.05 < longest.min() <= longest.max() < 0.13
    assert len(found) <= 1.25 * 200


@pytest.mark.parametrize("count", [30, 77, 400])
def test_halved_triangles_cover_the_same_surface(count: int) -> None:
    """Invariant: as many as wanted, alike in size; smaller at sharp edges where these are told."""
    vertices, faces = block(0)
    corners = vertices[faces]
    sharp = triangles._sharp(vertices, faces)
    found = triangles._halved(corners, np.zeros_like(sharp), count)
    assert count <= len(found) <= 1.25 * count
    assert areas(found).sum() == approx(areas(corners).sum(), rel=1e-12)
    assert volume(found) == approx(SIZE.prod(), rel=1e-12)
    longest = np.linalg.norm(np.roll(found, -1, axis=1) - found, axis=2).max(axis=1)
    assert longest.max() < 3.0 * longest.min()
    assert (longest**2 / areas(found)).max() < triangles._SLIVER
    if count == 400:
        graded = triangles._halved(corners, sharp, count)
        low, high = -0.5 * SIZE, 0.5 * SIZE

        def rim(points: Array) -> Array:
            """Distance of each triangle's centre from the nearest edge of the block."""
            off = np.minimum(points - low, high - points)
            return np.sort(off, axis=1)[:, 1]

        near, size = rim(graded.mean(axis=1)), np.sqrt(areas(graded))
        middle = np.median(near)
        assert size[near < 0.5 * middle].mean() < 0.6 * size[near > 2 * middle].mean()
        assert volume(graded) == approx(SIZE.prod(), rel=1e-12)


def test_triangles_that_coincide_are_kept_once() -> None:
    """Invariant: copies, turned copies and slivers without area go; the first of each stays."""
    vertices, faces = ball(1)
    corners = vertices[faces]
    flat = np.stack([corners[0, 0], corners[0, 1], 0.5 * (corners[0, 0] + corners[0, 1])])[None]
    doubled = np.concatenate([corners, corners[:7], corners[7:12, ::-1], flat])
    keep = triangles._apart(doubled)
    np.testing.assert_array_equal(keep, np.arange(len(doubled)) < len(corners))
    middle = corners[0].mean(axis=0)
    along = corners[0, 1] - corners[0, 0]
    turn = Rotation.from_rotvec(np.radians(60.0) * along / np.linalg.norm(along))
    crossed = np.stack([corners[0], turn.apply(corners[0] - middle) + middle])
    assert triangles._apart(crossed).all()


def test_collapse_overwrites_what_it_is_given() -> None:
    """Invariant: rows that are left name distinct vertices that exist, others are not used."""
    vertices, faces = ball(1)
    sharp = triangles._sharp(vertices, faces)
    left = collapse(vertices, faces, *triangles._quadrics(vertices, faces, sharp), 50)
    assert len(left) == len(np.unique(left)) == 50
    assert (faces[left] != np.roll(faces[left], 1, axis=1)).all()
    assert closed(faces[left])
