"""Kuhn lattices: numbering, volume, and the 7-point stencil."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from p1_twin import boundary_faces, link_weights, stiffness

from capsense.constants import EPS0
from capsense.errors import MeshError
from capsense.mesh import kuhn_tets

X = np.array([-1.0, -0.4, 0.1, 1.3])
Y = np.array([0.0, 0.2, 0.9])
Z = np.array([0.0, 0.05, 0.15, 0.4, 1.0])


def test_nodes_are_numbered_in_c_order_and_cells_own_six_tetrahedra():
    mesh = kuhn_tets(X, Y, Z)
    assert mesh.n_points == 4 * 3 * 5
    assert mesh.n_tets == 6 * 3 * 2 * 4
    i, j, k = 2, 1, 3
    np.testing.assert_array_equal(mesh.points[(i * 3 + j) * 5 + k], [X[i], Y[j], Z[k]])
    cell = (1 * 2 + 0) * 4 + 2
    corners = np.unique(mesh.tets[6 * cell : 6 * cell + 6])
    np.testing.assert_allclose(mesh.points[corners].min(axis=0), [X[1], Y[0], Z[2]])
    np.testing.assert_allclose(mesh.points[corners].max(axis=0), [X[2], Y[1], Z[3]])


def test_tetrahedra_fill_the_box_and_conform():
    mesh = kuhn_tets(X, Y, Z)
    assert mesh.volumes.sum() == approx(2.3 * 0.9 * 1.0, rel=1e-12)
    # Conforming: the boundary is that of the box, two triangles for each outer lattice face.
    assert len(boundary_faces(mesh)) == 2 * 2 * (3 * 2 + 2 * 4 + 3 * 4)


def test_ground_is_the_outer_surface():
    mesh = kuhn_tets(X, Y, Z)
    outer = np.unique(boundary_faces(mesh))
    np.testing.assert_array_equal(mesh.node_groups["ground"], outer)


def test_diagonal_links_carry_no_weight_and_axis_links_a_positive_one():
    mesh = kuhn_tets(X, Y, Z)
    eps_r = np.random.default_rng(0).uniform(1, 80, mesh.n_tets)
    weights = link_weights(mesh, eps_r)
    spans = mesh.points[mesh.edges[:, 1]] - mesh.points[mesh.edges[:, 0]]
    along_axis = (spans != 0).sum(axis=1) == 1
    assert np.abs(weights[~along_axis]).max() < 1e-13 * weights.max()
    assert weights[along_axis].min() > 0
    assert mesh.quality().negative_links == 0


def test_stiffness_is_the_classical_stencil_on_a_uniform_lattice():
    h = 0.1
    axis = np.arange(5) * h
    matrix = stiffness(kuhn_tets(axis, axis, axis), 2.0).toarray() / (2.0 * EPS0 * h)
    centre = (2 * 5 + 2) * 5 + 2
    expected = np.zeros(125)
    expected[centre] = 6
    expected[[centre - 25, centre + 25, centre - 5, centre + 5, centre - 1, centre + 1]] = -1
    np.testing.assert_allclose(matrix[centre], expected, atol=1e-12)


def test_graded_weights_average_the_four_cross_sections():
    mesh = kuhn_tets(X, Y, Z)
    weights = link_weights(mesh)
    number = {tuple(edge): w for edge, w in zip(mesh.edges.tolist(), weights, strict=True)}
    dy, dz = np.diff(Y), np.diff(Z)
    for i in range(3):
        for j in range(3):
            for k in range(5):
                section = 0.0
                for a, b, share in ((0, 0, 2), (-1, -1, 2), (0, -1, 1), (-1, 0, 1)):
                    if 0 <= j + a < len(dy) and 0 <= k + b < len(dz):
                        section += share / 6 * dy[j + a] * dz[k + b]
                node = (i * 3 + j) * 5 + k
                expected = EPS0 * section / (X[i + 1] - X[i])
                assert number[node, node + 15] == approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "bad", [[0.0], [0.0, 0.0, 1.0], [1.0, 0.0], [0.0, np.nan], [[0.0, 1.0]], [0.0, np.inf]]
)
def test_wrong_coordinates_are_refused(bad):
    with pytest.raises(MeshError, match="y must be"):
        kuhn_tets(X, bad, Z)
