"""Triangle meshes as simulators have them: reduced without loss, kept as files."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import trimesh
from approximate import approx

from capsense.scene import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere, TriMesh
from capsense.solver.bodies.panels import SurfacePanels, panels_of
from capsense.solver.bodies.triangles import reduced_triangles
from capsense.solver.tree import shape_cache as store
from capsense.solver.tree.rigid import RigidShape, rigid_shape

BALL = trimesh.creation.icosphere(5, radius=0.05)


def capsule(radius: float, length: float, count: int = 100) -> trimesh.Trimesh:
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=(count, count))
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def cylinder(radius: float, length: float, sections: int) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=radius, height=length, sections=sections)


def hand() -> trimesh.Trimesh:
    """Four fingers that reach into a palm."""
    palm = trimesh.creation.icosphere(3)
    palm.apply_scale((0.05, 0.042, 0.014))
    parts = [palm]
    for y in (-0.03, -0.01, 0.01, 0.03):
        finger = capsule(0.008, 0.07, 20)
        finger.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
        finger.apply_translation((-0.07, y, 0.0))
        parts.append(finger)
    return trimesh.util.concatenate(parts)


def free(mesh: trimesh.Trimesh, count: int) -> float:
    """Capacitance in free space over 4π eps0 [m]."""
    return rigid_shape(panels_of(np.array(mesh.triangles), count)).capacitance


def longest(panels: SurfacePanels) -> float:
    """Longest edge over that of an equilateral triangle of the mean area."""
    edge = np.linalg.norm(panels.corners - np.roll(panels.corners, 1, axis=1), axis=2)
    return float(edge.max() / np.sqrt(2.31 * panels.areas.mean()))


@pytest.mark.parametrize(
    ("mesh", "shape"),
    [
        (BALL, Sphere(0.05)),
        (capsule(0.04, 0.25), Capsule(0.04, 0.25)),
        (capsule(0.008, 0.07), Capsule(0.008, 0.07)),
        (cylinder(0.04, 0.25, 400).subdivide().subdivide(), Cylinder(0.04, 0.25)),
    ],
    ids=["ball", "capsule", "finger", "cylinder"],
)
@pytest.mark.parametrize("count", [700, 1120])
@pytest.mark.e2e
def test_reduced_round_bodies_keep_their_capacitance(mesh, shape, count):
    """Differential: a primitive of 900 panels, to 0.2 %; some meshes are shorter by 0.1 %."""
    expected = rigid_shape(panels_of(shape, 900)).capacitance
    assert free(mesh, count) == approx(expected, rel=2e-3)


def test_a_few_triangles_make_a_ball():
    """Analytic: a hundred triangles, as a finger of a person has, are right to 0.3 %."""
    assert free(BALL, 100) == approx(0.05, rel=3e-3)


def test_crossing_parts():
    """Differential: a hand of five parts, 500 triangles against 2,000."""
    mesh = hand()
    assert free(mesh, 500) == approx(free(mesh, 2000), rel=5e-3)


def test_small_parts_have_triangles_of_their_own():
    """A ball of 1 cm beside one of half a metre, and more parts than triangles wanted."""
    small, large = BALL.copy(), BALL.copy()
    small.apply_scale(0.2)
    small.apply_translation((0.1, 0, 0))
    large.apply_scale(10.0)
    both = trimesh.util.concatenate([small, large])
    number = np.bincount(reduced_triangles(np.array(both.triangles), 700).parts)
    assert number.min() >= 100
    assert number.max() > 2 * number.min()
    crumbs = []
    for k in range(200):
        crumb = trimesh.creation.icosphere(1, radius=0.001)
        crumb.apply_translation((0.01 * (k % 20), 0.01 * (k // 20), 0))
        crumbs.append(crumb)
    many = reduced_triangles(np.array(trimesh.util.concatenate(crumbs).triangles), 1500)
    assert many.parts.max() == 199
    assert len(many.corners) <= 200 * 16


@pytest.mark.e2e
def test_long_triangles_are_divided():
    """A cylinder's mantle of slivers from end to end is covered evenly."""
    for mesh in (cylinder(0.02, 0.4, 32), cylinder(0.02, 0.4, 400), capsule(0.02, 0.4)):
        panels = panels_of(np.array(mesh.triangles), 500)
        assert panels.closed
        assert longest(panels) < 4.0
        assert len(panels) < 1.3 * 500


def test_cracks_and_pinches_do_not_keep_a_mesh_from_being_reduced():
    """Corners in the middle of a neighbour's edge, loose triangles, edges of three faces."""
    cracked = trimesh.Trimesh(
        *trimesh.remesh.subdivide_to_size(cylinder(0.04, 0.2, 40).vertices,
                                          cylinder(0.04, 0.2, 40).faces, 0.01)
    )  # fmt: skip
    panels = panels_of(np.array(cracked.triangles), 400)
    assert 350 < len(panels) < 520
    whole = free(cylinder(0.04, 0.2, 40), 1200)
    assert rigid_shape(panels).capacitance == approx(whole, rel=1e-2)
    fins = np.array(BALL.triangles)[::50] * [[[1.0], [1.0], [1.3]]]
    panels = panels_of(np.concatenate([BALL.triangles, fins]), 500)
    assert not panels.closed
    assert len(panels) < 900


def test_half_a_ball():
    """Analytic: a hemispherical bowl of radius a has a (1/2 + 1/π), less 1 % for its rim."""
    centers = BALL.triangles_center
    bowl = BALL.submesh([np.flatnonzero(centers[:, 2] > 0)], append=True)
    shape = TriMesh(bowl.vertices, bowl.faces)
    assert not shape.closed
    panels = panels_of(shape, 700)
    assert not panels.closed
    expected = 0.05 * (0.5 + 1 / np.pi)
    assert -0.012 < rigid_shape(panels).capacitance / expected - 1 < 0.004


def test_turned_meshes_have_the_same_panels():
    """Moving a mesh in its frame moves its panels."""
    rng = np.random.default_rng(3)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))
    corners = np.array([[0, 0, 0], [0, 0, 0.015], [0.02, 0, 0], [0, 0.03, 0]])
    faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)])
    one = panels_of(TriMesh(corners, faces), 300)
    other = panels_of(TriMesh(corners @ turn[:3, :3].T + 0.1, faces), 300)
    np.testing.assert_allclose(other.centers, one.centers @ turn[:3, :3].T + 0.1, atol=1e-9)


# ---- files ----


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and no shapes in memory."""
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(tmp_path))
    forget()
    return tmp_path / "shapes"


def forget() -> None:
    """No shape is at hand any more, as in a process that has just started."""
    store._SHAPES.clear()
    store._IN_USE.clear()


def small_mesh() -> TriMesh:
    return TriMesh(BALL.vertices, BALL.faces)


def found(count: int = 100) -> RigidShape:
    """The shape of the mesh, as a process that has just started finds it."""
    forget()
    return store.rigid(small_mesh(), count)[0]


def assert_same(one: RigidShape, other: RigidShape) -> None:
    """To the last bit: a recording of the first process is replayed by others."""
    np.testing.assert_array_equal(one.potential_coefficients, other.potential_coefficients)
    np.testing.assert_array_equal(one.panels.corners, other.panels.corners)
    np.testing.assert_array_equal(one.panels.parts, other.panels.parts)
    assert one.panels.closed == other.panels.closed
    assert one.capacitance == other.capacitance
    for name in ("children", "function", "panel", "charge", "center", "points", "extent"):
        np.testing.assert_array_equal(getattr(one.tree, name), getattr(other.tree, name))


SIZES: list[Callable[[float], Shape]] = [
    lambda a: Box((a, a / 3, a / 7)),
    lambda a: Ellipsoid((a, a / 3, a / 7)),
    lambda a: Capsule(a / 7, a),
    lambda a: Cylinder(a / 7, a),
]


@pytest.mark.parametrize("shape", SIZES)
def test_bits_do_not_depend_on_the_size_met_first(
    folder: Path, shape: Callable[[float], Shape]
) -> None:
    """Regression: they did, so that what a process had done before changed its readings."""
    first, second = 0.3, 0.05
    exact = [shape(a).params / shape(a).params.max() for a in (first, second)]
    assert (exact[0] != exact[1]).any()
    met = store.rigid(shape(first), 100)[0]
    assert store.rigid(shape(second), 100)[0] is met
    forget()
    assert_same(store.rigid(shape(second), 100)[0], met)


@pytest.mark.parametrize("shape", SIZES)
def test_stored_panels_times_the_size_bound_the_shape(
    folder: Path, shape: Callable[[float], Shape]
) -> None:
    """Analytic: those of a box have its very corners, those of round shapes come near theirs."""
    body = shape(0.3)
    made, size = store.rigid(body, 400)
    corners = size * made.panels.corners.reshape(-1, 3)
    limit = 1e-9 if isinstance(body, Box) else 0.003
    np.testing.assert_allclose(
        [corners.min(axis=0), corners.max(axis=0)], body.bounds(), atol=limit
    )


def test_a_mesh_is_found_in_the_cache(folder, monkeypatch):
    made = found()
    assert len(list(folder.glob("*.npz"))) == 1
    monkeypatch.setattr(store, "panels_of", None)  # nothing is worked out again
    again = found()
    assert again is not made
    assert_same(again, made)
    np.testing.assert_allclose(
        again.neumann_to_dirichlet, made.neumann_to_dirichlet, rtol=1e-5, atol=1e-3
    )


def test_another_count_or_version_is_another_shape(folder, monkeypatch):
    assert len(found(100).panels) < len(found(140).panels)
    monkeypatch.setattr(store, "VERSION", -1)
    found(100)
    assert len(list(folder.glob("*.npz"))) == 3


def test_a_damaged_file_is_made_again(folder, caplog):
    made = found()
    (file,) = folder.glob("*.npz")
    file.write_bytes(file.read_bytes()[:-100])
    with caplog.at_level(logging.WARNING):
        assert_same(found(), made)
    assert "made again" in caplog.text
    caplog.clear()
    assert_same(found(), made)
    assert not caplog.text


def test_a_cache_that_cannot_be_written_is_passed_over(folder):
    folder.write_text("a file where the folder should be")
    assert len(found().panels) > 100


def test_the_oldest_files_go_first(folder, monkeypatch):
    found(100)
    (first,) = folder.glob("*.npz")
    monkeypatch.setattr(store, "_FILES", int(1.5 * first.stat().st_size))
    found(101)
    assert len(list(folder.glob("*.npz"))) == 1
    assert not first.exists()


def test_threads_share_a_shape(folder):
    with ThreadPoolExecutor(4) as pool:
        shapes = list(pool.map(lambda _: store.rigid(small_mesh(), 100)[0], range(8)))
    assert all(s is shapes[0] for s in shapes)


def test_a_copy_points_to_its_own_arrays(folder):
    """Addresses of another process would be fatal."""
    made = found()
    _ = made.record
    copy = pickle.loads(pickle.dumps(made))
    assert copy.record["potential_coefficients"] == copy.potential_coefficients.ctypes.data
    assert copy.record["children"] == copy.tree.children.ctypes.data
    assert copy.record["potential_coefficients"] != made.record["potential_coefficients"]
    assert_same(copy, made)


@pytest.mark.parametrize(("parts", "wanted"), [(1, 160), (8, 160), (10, 200), (13, 260), (40, 280)])
def test_meshes_of_more_parts_have_more_triangles(folder, monkeypatch, parts, wanted):
    """Analytic: a fifth of a primitive's panels for each part, from 1.6 to 2.8 times as many."""
    asked = []

    def panels(corners, count):
        asked.append(count)
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "panels_of", panels)
    one = trimesh.creation.box((0.01, 0.01, 0.01))
    row = [one.copy().apply_translation((0.02 * k, 0, 0)) for k in range(parts)]
    mesh = trimesh.util.concatenate(row)
    with pytest.raises(KeyboardInterrupt):
        store._mesh_shape(TriMesh(mesh.vertices, mesh.faces), 100, f"row of {parts}")
    assert asked == [wanted]


def test_the_longest_unused_shapes_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unit: when all of them take up too much room; a body that holds one keeps it."""
    forget()
    kept = [Capsule(0.01, 0.02 + 0.01 * k) for k in range(6)]
    room = store.rigid(kept[0], 50)[0].nbytes
    monkeypatch.setattr(store, "_KEPT", round(3.5 * room))
    found = [store.rigid(shape, 50)[0] for shape in kept]
    assert 2 <= len(store._SHAPES) <= 4
    assert list(store._SHAPES.values()) == found[-len(store._SHAPES) :]
    assert store.rigid(kept[0], 50)[0] is found[0]
    assert store.rigid(Capsule(0.01, 0.02), 50)[0] is found[0]
