"""TetMesh: validation, links, groups and quality figures."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from p1_twin import boundary_faces, link_weights

from capsense.errors import MeshError
from capsense.mesh import TetMesh, kuhn_tets

UNIT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
REGULAR = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)


def random_mesh(seed: int = 3) -> TetMesh:
    """A lattice whose inner nodes are shifted, so that no symmetry hides a mistake."""
    rng = np.random.default_rng(seed)
    mesh = kuhn_tets(np.linspace(0, 1, 5), np.linspace(0, 1, 4), np.linspace(0, 1, 6))
    points = mesh.points.copy()
    inner = np.setdiff1d(np.arange(mesh.n_points), mesh.node_groups["ground"])
    points[inner] += rng.uniform(-0.06, 0.06, (len(inner), 3))
    return TetMesh(points, mesh.tets, mesh.node_groups)


def test_inverted_tetrahedra_are_reoriented():
    mesh = TetMesh(UNIT, np.array([[0, 2, 1, 3]]))
    np.testing.assert_allclose(mesh.volumes, [1 / 6], rtol=1e-14)
    assert sorted(mesh.tets[0]) == [0, 1, 2, 3]


def test_links_are_unique_sorted_and_numbered_per_tetrahedron():
    mesh = random_mesh()
    expected = sorted(
        {
            (min(t[i], t[j]), max(t[i], t[j]))
            for t in mesh.tets.tolist()
            for i in range(4)
            for j in range(i)
        }
    )
    assert [tuple(edge) for edge in mesh.edges.tolist()] == expected
    for tet, links in zip(mesh.tets[:20], mesh.tet_edges[:20], strict=True):
        pairs = [(tet[i], tet[j]) for i, j in [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]]
        assert [tuple(sorted(p)) for p in pairs] == [tuple(e) for e in mesh.edges[links].tolist()]


def test_boundary_faces_close_the_surface():
    mesh = random_mesh()
    faces = mesh.points[boundary_faces(mesh)]
    areas = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
    assert areas.sum() / 2 == approx(6.0, rel=1e-12)


def test_arrays_are_copies_and_read_only():
    points = UNIT.copy()
    mesh = TetMesh(points, np.array([[0, 1, 2, 3]]), {"a": np.array([1])})
    points[0] = 9
    assert mesh.points[0, 0] == 0
    for array in (mesh.points, mesh.tets, mesh.edges, mesh.node_groups["a"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(TypeError):
        mesh.node_groups["b"] = np.array([0])  # type: ignore[index]


@pytest.mark.parametrize(
    ("points", "tets", "groups", "message"),
    [
        (UNIT * np.nan, [[0, 1, 2, 3]], {}, "4 of 4 points have a NaN"),
        (UNIT[:, :2], [[0, 1, 2, 3]], {}, r"points must have shape \(n, 3\)"),
        (UNIT, [[0, 1, 2, 4]], {}, "tets: 1 indices outside 0…3"),
        (UNIT, [[0, 1, 2, -1]], {}, "tets: 1 indices outside"),
        (UNIT, [[0.5, 1, 2, 3]], {}, "integers"),
        (UNIT, np.empty((0, 4), int), {}, "k > 0"),
        (UNIT * [1, 1, 0], [[0, 1, 2, 3]], {}, "1 of 1 tetrahedra are degenerate"),
        (UNIT, [[0, 1, 2, 2], [0, 1, 2, 3]], {}, "1 of 2 tetrahedra are degenerate"),
        (UNIT, [[0, 1, 2, 3]], {"E1": [7]}, "node group 'E1': 1 indices outside"),
    ],
)
def test_a_wrong_mesh_is_refused(points, tets, groups, message):
    with pytest.raises(MeshError, match=message):
        TetMesh(points, np.asarray(tets), groups)


def test_a_cell_belongs_to_one_group():
    mesh = kuhn_tets([0, 1], [0, 1], [0, 1])
    with pytest.raises(MeshError, match="2 tetrahedra are in more than one cell group"):
        mesh.with_groups(cell_groups={"a": [0, 1, 2], "b": [1, 2, 3]})


def test_groups_unite_and_name_cell_values():
    mesh = kuhn_tets([0, 1], [0, 1], [0, 1]).with_groups(
        node_groups={"a": [3, 1, 1], "b": [1, 2]}, cell_groups={"glass": [0, 5]}
    )
    assert mesh.group_nodes(["a", "b"]).tolist() == [1, 2, 3]
    assert mesh.group_nodes([]).tolist() == []
    assert mesh.cell_values({"glass": 5.0}).tolist() == [5, 1, 1, 1, 1, 5]
    with pytest.raises(MeshError, match="no node group 'c'; it has: ground, a, b"):
        mesh.group_nodes(["c"])
    with pytest.raises(MeshError, match="no cell group 'wood'; it has: glass"):
        mesh.cell_values({"wood": 2.0})


def test_moving_a_mesh_keeps_its_shape():
    mesh = random_mesh()
    moved = mesh.moved([1.0, -2.0, 3.0])
    np.testing.assert_allclose(moved.points - mesh.points, np.tile([1.0, -2.0, 3.0], (120, 1)))
    np.testing.assert_allclose(moved.volumes, mesh.volumes, rtol=1e-11)
    assert list(moved.node_groups) == ["ground"]


def test_quality_of_the_regular_tetrahedron():
    quality = TetMesh(REGULAR, np.array([[0, 1, 2, 3]])).quality()
    angle = np.degrees(np.arccos(1 / 3))
    assert quality.min_dihedral == approx(angle, rel=1e-12)
    assert quality.max_dihedral == approx(angle, rel=1e-12)
    assert quality.min_radius_ratio == approx(1.0, rel=1e-12)
    assert quality.max_aspect == approx(1.0, rel=1e-12)
    assert quality.volume == approx(8 / 3, rel=1e-12)
    assert quality.negative_links == 0


def test_quality_of_the_corner_tetrahedron():
    quality = TetMesh(UNIT, np.array([[0, 1, 2, 3]])).quality()
    assert quality.min_dihedral == approx(np.degrees(np.arctan(np.sqrt(2))), rel=1e-12)
    assert quality.max_dihedral == approx(90.0, rel=1e-12)
    inradius, circumradius = 1 / (3 + np.sqrt(3)), np.sqrt(3) / 2
    assert quality.min_radius_ratio == approx(3 * inradius / circumradius, rel=1e-12)
    # Longest link √2, altitude to the slanted face 1/√3.
    assert quality.max_aspect == approx(np.sqrt(6) * np.sqrt(2 / 3), rel=1e-12)


def test_negative_links_agree_with_the_link_weights():
    mesh = random_mesh()
    weights = link_weights(mesh)
    expected = int((weights < -1e-9 * weights.max()).sum())
    assert 0 < expected < len(mesh.edges)
    assert mesh.quality().negative_links == expected
    assert f"negative link weights {expected} (" in str(mesh.quality())
