"""The Gmsh mesher: conformity, groups, sizes, and manners towards Gmsh's global state."""

from __future__ import annotations

import importlib
import os
import signal
from typing import Any

import numpy as np
import pytest
import shapely
import trimesh
from approximate import approx
from mesh_test_designs import rectangle, roof, sheet, two_patches
from p1_twin import boundary_faces, capacitance_p1

import capsense.mesh.gmsh_mesher as mesher
from capsense.design.geometry import Facet, Surface
from capsense.design.model import Conductor, Design, Domain, Electrode, Layer, Role
from capsense.errors import MeshError, MissingDependencyError
from capsense.mesh import TetMesh, mesh_design

gmsh = pytest.importorskip("gmsh", exc_type=(ImportError, OSError))


@pytest.fixture(scope="module")
def patches() -> TetMesh:
    return mesh_design(two_patches(), size_at_edges=3e-3, size_far=0.05, growth=0.5)


def covered_area(mesh: TetMesh, group: str, outline: shapely.Polygon) -> float:
    """Area [m²] of the element faces in z = 0, within an outline, with all corners in a group."""
    faces = np.concatenate(
        [mesh.tets[:, list(f)] for f in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))]
    )
    faces = np.unique(np.sort(faces, axis=1), axis=0)
    faces = faces[np.isin(faces, mesh.node_groups[group]).all(axis=1)]
    at = mesh.points[faces]
    kept = (np.abs(at[..., 2]) < 1e-9).all(axis=1)
    kept &= shapely.contains_xy(outline, *at.mean(axis=1)[:, :2].T)
    sides = np.cross(at[kept, 1] - at[kept, 0], at[kept, 2] - at[kept, 0])
    return float(np.linalg.norm(sides, axis=1).sum() / 2)


def test_groups_follow_the_design(patches):
    assert list(patches.node_groups) == ["ground", "E1", "E2", "pour"]
    assert list(patches.cell_groups) == ["plate"]
    assert patches.volumes.sum() == approx(0.2**3, rel=1e-9)


def test_sheets_are_unions_of_element_faces(patches):
    design = two_patches()
    for item in (*design.electrodes, *design.conductors):
        outline = item.surface.facets[0].polygon
        area = covered_area(patches, item.name, outline)
        assert area == approx(outline.area, rel=1e-9)
    electrode = patches.points[patches.node_groups["E1"]]
    np.testing.assert_allclose(electrode.min(axis=0), [-0.025, -0.01, 0.0], atol=1e-10)
    np.testing.assert_allclose(electrode.max(axis=0), [-0.005, 0.01, 0.0], atol=1e-10)


def test_every_node_on_a_sheet_is_in_its_group(patches):
    x, y, z = patches.points.T
    on = (np.abs(z) < 1e-9) & (np.abs(x - 0.015) < 0.010001) & (np.abs(y) < 0.010001)
    np.testing.assert_array_equal(np.flatnonzero(on), patches.node_groups["E2"])


def test_ground_is_the_whole_box_and_nothing_else(patches):
    np.testing.assert_array_equal(patches.node_groups["ground"], np.unique(boundary_faces(patches)))


def test_layers_are_unions_of_elements(patches):
    plate = patches.cell_groups["plate"]
    assert patches.volumes[plate].sum() == approx(0.08 * 0.06 * 0.002, rel=1e-9)
    corners = patches.points[patches.tets[plate]]
    assert corners[..., 2].min() == approx(-0.002, abs=1e-9)
    assert corners[..., 2].max() == approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("thickness", "across", "wanted"),
    [(0.008, 1.0, 8e-3), (0.008, 2.0, 4e-3), (0.008, 8.0, 2e-3), (0.004, 0.2, 0.016)],
)
def test_elements_within_a_layer_are_its_thickness_over_layers_across(thickness, across, wanted):
    """Analytic: that long, though no shorter than at rims nor longer than far away."""
    low, high = np.array([-0.02, -0.02, 0.03]), np.array([0.02, 0.02, 0.03 + thickness])
    design = Design(
        "slab", Domain((0.1, 0.1, 0.1), 0.03), (Electrode("E1", rectangle(0, 0.01)),),
        (Layer("slab", "glass", 5.0, low, high),),
    )  # fmt: skip
    mesh = mesh_design(design, size_at_edges=2e-3, size_far=0.016, growth=2.0, layers_across=across)
    at = mesh.points[mesh.edges]
    inside = (np.abs(at[..., :2]) < 0.02001).all(axis=(1, 2))
    level = (np.abs(at[..., 2] - high[2]) < 1e-9).all(axis=1)  # of its top face
    lengths = np.linalg.norm(np.diff(at[inside & level], axis=1)[:, 0], axis=1)
    assert np.median(lengths) == approx(wanted, rel=0.2)


def test_element_sizes_grow_from_the_rims():
    design = Design("one", Domain((0.2, 0.2, 0.2), 0.1), (Electrode("E1", rectangle(0, 0.04)),))
    mesh = mesh_design(design, size_at_edges=2e-3, size_far=0.03, growth=0.4)
    lengths = np.linalg.norm(np.diff(mesh.points[mesh.edges], axis=1)[:, 0], axis=1)
    middles = mesh.points[mesh.edges].mean(axis=1)
    rim = shapely.box(-0.02, -0.02, 0.02, 0.02).exterior
    in_plane = shapely.distance(shapely.points(middles[:, :2]), rim)
    away = np.hypot(in_plane, middles[:, 2])
    wanted = np.minimum(2e-3 + 0.4 * away, 0.03)
    # Delaunay tetrahedra have links a little longer than the size asked for: 1.21 measured.
    assert np.median(lengths / wanted) == approx(1.2, abs=0.15)
    assert np.median(lengths[away < 1e-9]) == approx(2e-3, rel=0.15)
    assert mesh.quality().min_dihedral > 5.0
    coarse = mesh_design(design, size_at_edges=8e-3, size_far=0.03, growth=0.4)
    assert coarse.n_tets < mesh.n_tets / 2


def test_capacitance_on_the_mesh_converges_to_the_reference():
    """Differential: two coplanar stripes in a grounded cube, by boundary elements [pF].

    The edge singularity makes P1's error first order, so two sizes extrapolate. Measured: +22.4 %
    and +11.5 %, extrapolated +0.6 % and, for the mutual capacitance, -1.3 %.
    """
    reference = np.array([2.40904, -1.2114])
    stripes = tuple(
        Electrode(name, rectangle((x, 0.0), (0.01, 0.1)))
        for name, x in (("E1", 0.0075), ("E2", -0.0075))
    )
    design = Design("stripes", Domain((0.5, 0.5, 0.5), 0.25), stripes)
    coarse, fine = (
        1e12 * capacitance_p1(mesh_design(design, size_at_edges=h), 1.0, ["E1", "E2"])[0]
        for h in (2e-3, 1e-3)
    )
    errors = np.array([coarse[0], fine[0]]) / reference[0] - 1
    assert errors == approx([0.224, 0.115], abs=0.02)
    extrapolated = 2 * fine - coarse
    assert extrapolated[0] == approx(reference[0], rel=0.015)
    assert extrapolated[1] == approx(reference[1], rel=0.03)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("flipped", [False, True])
def test_holes_of_either_direction(sign, flipped):
    ring = shapely.box(-0.02, -0.02, 0.02, 0.02).difference(shapely.box(-0.01, -0.01, 0.01, 0.01))
    ring = shapely.geometry.polygon.orient(ring, sign)
    axes = np.diag([1.0, -1.0, -1.0]) if flipped else np.eye(3)
    surface = Surface((Facet(ring, np.zeros(3), axes),), sheet(ring).rims)
    design = Design("ring", Domain((0.1, 0.1, 0.1), 0.05), (Electrode("E1", surface),))
    mesh = mesh_design(design, size_at_edges=6e-3)
    assert covered_area(mesh, "E1", ring) == approx(12e-4, rel=1e-9)


def test_tilted_facets_and_shared_ridges():
    design = Design("roof", Domain((0.2, 0.2, 0.2), 0.1), (Electrode("E1", roof()),))
    mesh = mesh_design(design, size_at_edges=4e-3, growth=0.6)
    x, y, z = mesh.points[mesh.node_groups["E1"]].T
    on_flat = (x > -1e-9) & (np.abs(z) < 1e-9)
    on_tilt = (x < 1e-9) & (np.abs(z - np.tan(np.pi / 6) * x) < 1e-9)
    assert (on_flat | on_tilt).all()
    assert (on_flat & on_tilt).sum() >= 6
    assert x.min() == approx(-0.02 * np.cos(np.pi / 6), abs=1e-9)
    assert z.min() == approx(-0.01, abs=1e-9)
    assert y.max() == approx(0.02, abs=1e-9)


def test_a_curved_closed_conductor_is_meshed_facet_by_facet():
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    facets = []
    for corners in sphere.triangles:
        u = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        n = np.cross(u, corners[2] - corners[0])
        n /= np.linalg.norm(n)
        axes = np.array([u, np.cross(n, u), n])
        polygon = shapely.Polygon((corners - corners[0]) @ axes[:2].T)
        facets.append(Facet(polygon, corners[0], axes))
    surface = Surface(tuple(facets), np.empty((0, 2, 3)))
    design = Design("ball", Domain((0.2, 0.2, 0.2), 0.1), (Electrode("E1", surface),))
    mesh = mesh_design(design, size_at_edges=0.01)
    assert mesh.volumes.sum() == approx(0.2**3, rel=1e-9)

    def height(points: np.ndarray) -> np.ndarray:
        """Height over the nearest facet plane: zero on this convex surface, negative inside."""
        offsets = np.einsum("fd,fd->f", sphere.face_normals, sphere.triangles[:, 0])
        return (points @ sphere.face_normals.T - offsets).max(axis=1)

    assert np.abs(height(mesh.points[mesh.node_groups["E1"]])).max() < 1e-8
    inner = height(mesh.centroids) < 0
    assert mesh.volumes[inner].sum() == approx(sphere.volume, rel=1e-6)


def test_overlapping_layers_belong_to_the_last():
    def slab(name: str, low: float, high: float) -> Layer:
        return Layer(name, name, 2.0, np.array([-0.03, -0.03, low]), np.array([0.03, 0.03, high]))

    design = two_patches(layers=(slab("a", -0.01, -0.002), slab("b", -0.004, -0.001)))
    mesh = mesh_design(design, size_at_edges=5e-3, growth=0.8)
    volumes = {name: mesh.volumes[cells].sum() for name, cells in mesh.cell_groups.items()}
    assert volumes["b"] == approx(0.06 * 0.06 * 0.003, rel=1e-9)
    assert volumes["a"] == approx(0.06 * 0.06 * 0.006, rel=1e-9)


@pytest.mark.parametrize(
    ("design", "message"),
    [
        (
            two_patches(conductors=(Conductor("bar", Role.GROUND, rectangle(0, (0.02, 0.002))),)),
            "electrode 'E1' touches 'bar'",
        ),
        (
            two_patches(electrodes=(Electrode("E1", rectangle(0.09, 0.02)),)),
            "electrode 'E1' touches 'ground'",
        ),
        (
            two_patches(electrodes=(Electrode("E1", rectangle(0.2, 0.02)),)),
            "conductor 'E1' reaches outside the domain",
        ),
        (
            two_patches(electrodes=(Electrode("pour", rectangle(0, 0.02)),)),
            "name 'pour' is used twice",
        ),
        (
            two_patches(layers=(Layer("far", "x", 2.0, np.full(3, 1.0), np.full(3, 2.0)),)),
            "layer 'far' lies outside the domain",
        ),
    ],
)
def test_impossible_designs_are_refused(design, message):
    with pytest.raises(MeshError, match=message):
        mesh_design(design, size_at_edges=0.01, growth=1.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"size_at_edges": 0.0}, "size_at_edges must be positive"),
        ({"growth": -1.0}, "growth must be positive"),
        ({"size_far": np.inf}, "size_far must be positive"),
        ({"size_at_edges": 0.1, "size_far": 0.05}, "below size_at_edges"),
    ],
)
def test_wrong_sizes_are_refused(settings, message):
    with pytest.raises(MeshError, match=message):
        mesh_design(two_patches(), **settings)


def test_too_many_facets_are_refused(monkeypatch):
    monkeypatch.setattr(mesher, "MAX_FACETS", 2)
    with pytest.raises(MeshError, match="3 facets; at most 2"):
        mesh_design(two_patches())


def small() -> Design:
    surface = sheet(shapely.box(-0.02, -0.02, 0.02, 0.02))
    return Design("small", Domain((0.1, 0.1, 0.1), 0.05), (Electrode("E1", surface),))


def test_gmsh_is_left_as_it_was_found():
    handler = signal.getsignal(signal.SIGINT)
    first = mesh_design(small(), size_at_edges=0.02)
    assert not gmsh.isInitialized()
    assert signal.getsignal(signal.SIGINT) is handler
    again = mesh_design(small(), size_at_edges=0.02)
    assert again.tets.shape == first.tets.shape  # its last bits hang on where arrays lie in memory
    one, other = np.sort(first.points, axis=0), np.sort(again.points, axis=0)
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_gmsh_is_finalised_after_a_failure(monkeypatch):
    def fail(*_: Any) -> None:
        raise Exception("no luck")

    monkeypatch.setattr(gmsh.model.mesh, "generate", fail)
    with pytest.raises(MeshError, match="could not mesh design 'small': no luck"):
        mesh_design(small())
    assert not gmsh.isInitialized()


@pytest.mark.usefixtures("broken_pipes_ignored")
def test_a_session_of_the_caller_survives():
    gmsh.initialize(interruptible=False, readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.Algorithm3D", 10)
        gmsh.model.add("mine")
        gmsh.model.occ.addSphere(0, 0, 0, 1)
        gmsh.model.occ.synchronize()
        mesh = mesh_design(small(), size_at_edges=0.02)
        assert gmsh.isInitialized()
        assert gmsh.model.getCurrent() == "mine"
        assert gmsh.model.getEntities(3) == [(3, 1)]
        assert "capsense design" not in gmsh.model.list()
        assert gmsh.option.getNumber("Mesh.Algorithm3D") == 10
    finally:
        gmsh.finalize()
    # in long runs Gmsh has numbered the same nodes in another order
    alone = mesh_design(small(), size_at_edges=0.02)
    points, expected = (m.points[np.lexsort(np.round(m.points, 9).T)] for m in (mesh, alone))
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-9)
    assert mesh.n_tets == alone.n_tets


@pytest.mark.parametrize(
    ("failure", "fix"),
    [
        (ModuleNotFoundError("No module named 'gmsh'"), r'pip install "capsense\[mesh\]"'),
        (
            OSError("libGLU.so.1: cannot open shared object file: No such file or directory"),
            r"shared library libGLU\.so\.1 is missing.*apt-get install -y libglu1-mesa",
        ),
    ],
)
def test_a_missing_gmsh_names_the_fix(monkeypatch, failure, fix):
    def missing(name: str) -> None:
        raise failure

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(MissingDependencyError, match=fix):
        mesh_design(small())


def test_a_connection_that_breaks_does_not_end_the_process(patches):
    """Regression: Gmsh made a broken pipe deadly, for sockets and pipes of the whole process."""
    reading, writing = os.pipe()
    os.close(reading)
    with pytest.raises(BrokenPipeError):
        os.write(writing, b"x")
    os.close(writing)
