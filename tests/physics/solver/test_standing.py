"""Meshes in a frame of their own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs
from capsense.solver.tree import shape_cache as store
from capsense.solver.tree.shape_cache import standing

Array = np.ndarray

PRISM = cs.TriMesh(
    np.array([[0, 0, 0], [30, 0, 0], [0, 20, 0], [0, 0, 15], [30, 0, 15], [0, 20, 15]]) * 1e-3,
    [[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]],
)


def hull(seed: int) -> cs.TriMesh:
    """A body of flat faces without any symmetry, 2 to 4 cm long."""
    points = np.random.default_rng(seed).normal(size=(30, 3)) * (0.01, 0.007, 0.005)
    found = trimesh.convex.convex_hull(points)
    return cs.TriMesh(found.vertices, found.faces)


def reframed(mesh: cs.TriMesh, seed: int) -> tuple[cs.TriMesh, cs.Pose]:
    """The mesh in another frame, in single precision, in another order; and that frame."""
    rng = np.random.default_rng(seed)
    frame = cs.Pose(rng.uniform(-0.02, 0.02, 3), rng.normal(size=4))
    order = rng.permutation(len(mesh.vertices))
    vertices = frame.inverse().apply(mesh.vertices).astype(np.float32)[order]
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    turn = (rng.integers(3, size=len(faces))[:, None] + np.arange(3)) % 3
    return cs.TriMesh(vertices, np.take_along_axis(faces, turn, axis=1)), frame


@pytest.mark.parametrize("mesh", [PRISM, *map(hull, range(8))])
def test_the_corners_are_those_given(mesh: cs.TriMesh) -> None:
    """Invariant: a rigid motion, to half of the grid; normals stay out."""
    found = standing(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.axes) == approx(1.0)
    back = found.corners @ found.axes.T + found.middle
    given = mesh.vertices[mesh.faces]
    apart = np.abs(given[:, None].mean(axis=2) - back[None].mean(axis=2)).max(axis=2)
    assert sorted(apart.argmin(axis=1)) == list(range(len(given)))
    extent = np.ptp(mesh.vertices, axis=0).max()
    assert apart.min(axis=1).max() < 1e-5 * extent
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (given, back)]
    np.testing.assert_allclose(normals[0], normals[1][apart.argmin(axis=1)], atol=3e-5 * extent**2)


@pytest.mark.parametrize("seed", range(4))
def test_frame_and_order_do_not_matter(seed: int) -> None:
    """Invariant: the same corners in the same order, and axes that are the body's own."""
    mesh = hull(seed)
    one = standing(mesh.vertices, mesh.faces)
    for k in range(5):
        other_mesh, frame = reframed(mesh, k)
        other = standing(other_mesh.vertices, other_mesh.faces)
        np.testing.assert_allclose(frame.rotation @ other.axes, one.axes, atol=1e-5)
        assert np.abs(other.corners - one.corners).max() < 2e-5 * np.ptp(mesh.vertices)


@pytest.mark.parametrize("mesh", [PRISM, hull(2)])
def test_a_mesh_reads_the_same_in_any_frame(
    mesh: cs.TriMesh, simulators: Callable[..., cs.Simulator]
) -> None:
    """Invariant: measured 2e-7 of the largest change; 2e-3 where panels followed the frame."""
    sim = simulators("six_patch_bare")
    pose = cs.Pose.from_euler((0.01, 0.0, 0.03), (0.4, 0.5, 0.6))
    first = sim.step(cs.Scene([cs.Body(mesh, pose)])).delta
    for k in range(3):
        other, frame = reframed(mesh, k)
        found = sim.step(cs.Scene([cs.Body(other, pose @ frame)])).delta
        assert np.abs(found - first).max() < 1e-5 * np.abs(first).max()


def test_panels_stand_in_the_frame_given() -> None:
    """Invariant: panels of the store lie on the mesh as it was given, and point out of it.

    Measured 0.3 % of the extent: edges are rounded where triangles are few.
    """
    mesh, _ = reframed(hull(3), 0)
    panels = store.rigid(mesh, 300)[0].panels
    extent = np.ptp(mesh.vertices, axis=0).max()
    assert np.abs(mesh.signed_distance(panels.centers)).max() < 0.006 * extent
    outside = panels.centers + 1e-3 * panels.normals
    assert mesh.signed_distance(outside).min() > 0
