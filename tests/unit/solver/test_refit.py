"""Clusters of deforming meshes at an instant: sums over their pieces, and what is divided."""

from __future__ import annotations

import numpy as np
import pytest
from rigged import over_square, rig

from capsense.scene import RestSurface, SurfaceMesh
from capsense.solver.tree.dynamic_surface import MeshBody, mesh_pieces
from capsense.solver.tree.refit_kernels import WIDE_PIECE, Refit


def entered(gap: float, finest: float = 0.002) -> tuple[MeshBody, Refit, np.ndarray]:
    """The hand so high over a square of 0.1 m, its clusters, and the vertices."""
    hand = rig(hand_only=True)
    vertices = hand.posed({"right_index_0": (0.0, -40.0, 0.0)})
    vertices = vertices - vertices[vertices[:, 2].argmin()] + [0.0, 0.0, gap]
    body = MeshBody(SurfaceMesh(vertices, RestSurface(hand.vertices, hand.faces)), True)
    record = body.record.copy()
    record["rotation"] = np.eye(3)
    return body, body.enter(record, over_square(), finest), vertices


@pytest.mark.parametrize("gap", [0.005, 0.5])
def test_clusters_are_sums_over_their_pieces(gap: float) -> None:
    """Differential: charge, centre and moments of the whole; parts make up each cluster."""
    body, made, vertices = entered(gap)
    hand = rig(hand_only=True)
    shape = SurfaceMesh(vertices, RestSurface(hand.vertices, hand.faces))
    _, pieces = mesh_pieces(shape)
    charge = pieces.areas
    np.testing.assert_allclose(made.charge[0], charge.sum(), rtol=1e-12)
    center = charge @ pieces.centers / charge.sum()
    np.testing.assert_allclose(made.center[0], center, atol=1e-12)
    arms = pieces.centers - center
    spread = np.einsum(
        "k,kij->ij", charge, pieces.moments + arms[:, :, None] * arms[:, None]
    ) / charge.sum()  # fmt: skip
    np.testing.assert_allclose(made.spread[0], spread, atol=1e-12)
    parents = np.flatnonzero(made.children[:, 0] >= 0)
    first, second = made.children[parents].T
    np.testing.assert_allclose(
        made.charge[first] + made.charge[second], made.charge[parents], rtol=1e-9
    )
    share = (made.charge[first] / made.charge[parents])[:, None]
    middle = share * made.center[first] + (1 - share) * made.center[second]
    np.testing.assert_allclose(middle, made.center[parents], atol=1e-9)
    assert sorted(made.function[parents]) == list(range(1, len(made.own)))
    assert (len(made.charge) == 2 * len(hand.faces) - 1) == (gap == 0.5)
    assert body.nbytes == hand.vertices.nbytes


def test_pieces_near_the_design_are_small() -> None:
    """Invariant: no undivided piece is wider than its share of the distance, but the finest."""
    _, made, _ = entered(0.005)
    last = np.flatnonzero(made.children[:, 0] < 0)
    x, y, z = made.center[last].T
    away = np.hypot(np.hypot(np.maximum(np.abs(x) - 0.05, 0), np.maximum(np.abs(y) - 0.05, 0)), z)
    assert (made.extent[last] < 1.3 * np.maximum(WIDE_PIECE * away, 0.002)).all()
